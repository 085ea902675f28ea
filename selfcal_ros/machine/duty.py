# SPDX-License-Identifier: Apache-2.0
"""What a cell under ROS has to do: which commands are new, which marks have to be seen again."""

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

from selfcal_ros.collection.inputs import Command, Phase
from selfcal_ros.units import NS_PER_S

PATIENCE_NS = NS_PER_S
"""Time after the last exposure from which a status includes all of them."""


@dataclass(frozen=True)
class Again:
    """What is still missing of a view: marks (m, n), lines k, check stops."""

    marks: Collection[tuple[int, int]] = ()
    lines: Collection[int] = ()
    checks: bool = False

    def __bool__(self) -> bool:
        """Return whether anything is missing."""
        return bool(self.marks or self.lines or self.checks)


class Duty:
    """The view that is to be measured, from commands and statuses; no clock of its own."""

    def __init__(self) -> None:
        self._acted: set[int] = set()  # stamps of commands
        self.command: Command | None = None
        """The MEASURE that is being carried out."""

    def take_command(self, command: Command) -> bool:
        """Return whether a command is new; a restarted sequencer latches its last one again."""
        if command.stamp_ns in self._acted:
            return False
        self._acted.add(command.stamp_ns)
        self.command = command if command.phase == Phase.MEASURE else None
        return True

    def missing(self, status: Any, now_ns: int, idle_since_ns: int) -> Again:
        """Return what a selfcal_msgs/ViewStatus names as missing of the view; nothing if too early.

        Parameters
        ----------
        status : message
            The status.
        now_ns, idle_since_ns : int
            The time, and that of the last exposure.
        """
        command = self.command
        if (
            command is None
            or status.complete
            or status.view_index != command.view_index
            or command.run_id not in ("", status.run_id)
            or now_ns < idle_since_ns + PATIENCE_NS
        ):
            return Again()
        marks = {*zip(status.missing_m, status.missing_n, strict=False)}
        return Again(
            marks, {*status.missing_k}, status.check_done < status.check_expected
        )
