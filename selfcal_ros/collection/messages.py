# SPDX-License-Identifier: Apache-2.0
"""The messages that collection works on, free of any middleware. Stamps are integer ns."""

from dataclasses import dataclass
from enum import IntEnum

from selfcal_ros.errors import InputError
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.view import View

MAX_VIEWS = 10_000
"""Views of a plan."""
MAX_REPEATS = 1_000_000
"""Repeats of a mark in a view."""


class Kind(IntEnum):
    """What was detected; values of selfcal_msgs/MarkDetection."""

    GRID = 0
    ANGULAR = 1


class Phase(IntEnum):
    """What a command asks for; values of selfcal_msgs/ViewCommand."""

    PLACE = 0
    MEASURE = 1
    DONE = 2
    ABORT = 3


@dataclass(frozen=True, slots=True)
class EncoderSample:
    """Indicated positions of some joints at one instant: m, rad, m/s, rad/s."""

    stamp_ns: int
    names: tuple[str, ...]
    positions: tuple[float, ...]
    velocities: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True)
class Detection:
    """One mark seen; fields as in selfcal_msgs/MarkDetection (m, rad, stage axes)."""

    stamp_ns: int
    kind: int
    has_id: bool
    m: int
    n: int
    k: int
    offset_x: float
    offset_y: float
    offset_theta: float
    sigma: float
    score: float


@dataclass(frozen=True, slots=True)
class Command:
    """One view command. `artifact` and `view` are None for DONE and ABORT.

    `model_terms` are those that the plan wants estimated with the map, as it writes them.
    """

    stamp_ns: int
    phase: Phase
    plan_id: str
    view_index: int = 0
    view: View | None = None
    artifact: Artifact | None = None
    views_planned: int = 0
    run_id: str = ""
    model_terms: tuple[str, ...] = ()

    def placed(self) -> View:
        """Return the view that a PLACE or MEASURE names.

        Raises
        ------
        ValueError
            For a command without one.
        """
        if self.view is None:
            raise ValueError(f"{self.phase.name} names no view")
        return self.view

    def plate(self) -> Artifact:
        """Return the plate that a PLACE or MEASURE names.

        Raises
        ------
        ValueError
            For a command without one.
        """
        if self.artifact is None:
            raise ValueError(f"{self.phase.name} names no plate")
        return self.artifact


def check_command(command: Command) -> None:
    """Raise InputError for a command that no cell can follow.

    It has a pose off the lattice, asks for no marks, or a number in it cannot be meant.
    """
    where = f"view command {command.view_index}"
    if not 0 <= command.view_index <= MAX_VIEWS or not 0 <= command.views_planned <= MAX_VIEWS:
        raise InputError(where, f"a plan has at most {MAX_VIEWS} views", "correct the view_index")
    if command.view is None or command.artifact is None:
        if command.phase in (Phase.PLACE, Phase.MEASURE):
            raise InputError(where, "it describes no view", "fill its pose and its plate")
        return
    if not (command.view.grid or command.view.angular):
        raise InputError(where, "neither grid nor angular marks are wanted", "set one to true")
    if not 1 <= command.view.repeats <= MAX_REPEATS:
        raise InputError(where, f"{command.view.repeats} repeats", f"ask for 1 to {MAX_REPEATS}")
    command.view.lattice_pose(command.artifact)
