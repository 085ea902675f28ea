# SPDX-License-Identifier: Apache-2.0
"""The messages that collection works on, free of any middleware. Stamps are integer ns."""

from dataclasses import dataclass
from enum import IntEnum

from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.view import View


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
    """One view command. `artifact` and `view` are None for DONE and ABORT."""

    stamp_ns: int
    phase: Phase
    plan_id: str
    view_index: int = 0
    view: View | None = None
    artifact: Artifact | None = None
    views_planned: int = 0
    run_id: str = ""
