# SPDX-License-Identifier: Apache-2.0
"""Which view an instant belongs to: by the stamps of the commands, never by arrival."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from selfcal_ros.collection.messages import Command, Phase
from selfcal_ros.collection.reasons import Reason
from selfcal_ros.errors import InputError
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.view import View

NO_END = np.iinfo(np.int64).max


@dataclass(frozen=True)
class Interval:
    """A span of time [start, end) in ns, and the view or the reason of rejection behind it."""

    start_ns: int
    end_ns: int
    view_index: int | None
    reason: Reason | None


@dataclass(frozen=True)
class Timeline:
    """The commands in the order of their stamps, cut into intervals.

    Attributes
    ----------
    plan_id : str
        Plan of the last MEASURE; views of other plans are not used.
    artifact : Artifact or None
        The plate, None before the first MEASURE.
    views : dict
        view_index -> View, in the order of the index.
    intervals : tuple of Interval
        All time from the first command on, without gaps.
    views_planned : int
        Views in the plan, or as many as were seen.
    finished : bool
        Whether the last command is DONE or ABORT.
    last_stamp_ns : int
        Stamp of the last command.
    """

    plan_id: str = ""
    artifact: Artifact | None = None
    views: dict[int, View] | None = None
    intervals: tuple[Interval, ...] = ()
    views_planned: int = 0
    finished: bool = False
    last_stamp_ns: int = 0

    def assign(self, stamps_ns: np.ndarray) -> np.ndarray:
        """Return the index of the interval of each stamp, int array; -1 before the first."""
        starts = np.array([interval.start_ns for interval in self.intervals], dtype=np.int64)
        return np.searchsorted(starts, stamps_ns, "right") - 1

    def of_view(self, view_index: int) -> list[Interval]:
        """Return the intervals in which readings of a view count."""
        return [i for i in self.intervals if i.view_index == view_index]


def build_timeline(commands: Iterable[Command]) -> Timeline:
    """Return the timeline of a set of commands.

    A detection belongs to view i from the stamp of (MEASURE, i) to that of the next command.
    A second PLACE of a view starts it anew: what was read before it is superseded. So does a
    MEASURE in another pose: what was read in the former pose cannot be read in this one.

    Raises
    ------
    InputError
        If two commands of the plan describe different plates.
    """
    ordered = sorted(set(commands), key=_sort_key)
    measures = [command for command in ordered if command.phase == Phase.MEASURE]
    if not measures:
        last = ordered[-1].stamp_ns if ordered else 0
        return Timeline(intervals=tuple(_unused(ordered)), views={}, last_stamp_ns=last)
    plan_id, artifact = measures[-1].plan_id, measures[-1].artifact
    views: dict[int, View] = {}
    for command in measures:
        if command.plan_id != plan_id:
            continue
        if command.artifact != artifact:
            raise InputError(f"view command of '{command.view.name}'", "describes another plate "
                             f"than the rest of plan '{plan_id}'", "use one plate in one plan")
        views[command.view_index] = command.view
    planned = max([c.views_planned for c in ordered if c.plan_id == plan_id] + [max(views) + 1])
    return Timeline(plan_id, artifact, dict(sorted(views.items())),
                    tuple(_intervals(ordered, plan_id)), planned,
                    ordered[-1].phase in (Phase.DONE, Phase.ABORT), ordered[-1].stamp_ns)


def _sort_key(command: Command) -> tuple:
    return (command.stamp_ns, int(command.phase), command.plan_id, command.view_index,
            repr(command.view), repr(command.artifact), command.views_planned, command.run_id)


def _unused(ordered: list[Command]) -> list[Interval]:
    ends = [*(command.stamp_ns for command in ordered[1:]), NO_END][:len(ordered)]
    return [Interval(c.stamp_ns, end, None, Reason.OUTSIDE_VIEWS)
            for c, end in zip(ordered, ends, strict=True)]


def _intervals(ordered: list[Command], plan_id: str) -> list[Interval]:
    began: dict[int, int] = {}  # view_index -> stamp from which its MEASUREs count
    placed: dict[int, int] = {}  # view_index -> stamp of a PLACE that no MEASURE has followed yet
    poses: dict[int, tuple] = {}
    for command in ordered:
        index = command.view_index
        if command.plan_id == plan_id and command.phase == Phase.PLACE:
            placed[index] = command.stamp_ns
        elif command.plan_id == plan_id and command.phase == Phase.MEASURE:
            pose = (command.view.rotation_rad, command.view.translation_m)
            start = placed.pop(index, began.get(index, command.stamp_ns))
            began[index] = start if poses.get(index, pose) == pose else command.stamp_ns
            poses[index] = pose
    out = []
    for interval, command in zip(_unused(ordered), ordered, strict=True):
        index, reason = None, interval.reason
        if command.phase == Phase.MEASURE and command.plan_id != plan_id:
            reason = Reason.OTHER_PLAN
        elif command.phase == Phase.MEASURE and command.stamp_ns < began[command.view_index]:
            reason = Reason.SUPERSEDED
        elif command.phase == Phase.MEASURE:
            index, reason = command.view_index, None
        out.append(Interval(interval.start_ns, interval.end_ns, index, reason))
    return out
