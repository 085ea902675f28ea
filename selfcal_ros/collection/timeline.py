# SPDX-License-Identifier: Apache-2.0
"""Assignment of instants to views by the stamps of the commands, never by arrival.

A plan may be measured repeatedly: readings of different runs
are never mixed. Commands name their run (`run_id`). If they do not, a run begins with a command
of view 0 that follows DONE or ABORT, or that places the plate again after a later view has been
measured; it is then named by the stamp of its first command.

A run that names itself and whose first command was received lasts until it ends or another one
begins: a command in between that belongs to no run that has begun is a stray and changes nothing.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from selfcal_ros.collection.inputs import Command, Phase, Reason
from selfcal_ros.errors import InputError
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.view import View, plan_keys

NO_END = np.iinfo(np.int64).max


@dataclass(frozen=True)
class Interval:
    """A span of time [start, end) in ns, with its view or reason of rejection."""

    start_ns: int
    end_ns: int
    view_index: int | None
    reason: Reason | None


@dataclass(frozen=True)
class Timeline:
    """The commands in the order of their stamps, divided into intervals.

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
        Views in the plan, or number of views seen.
    finished : bool
        Whether the last command is DONE or ABORT.
    last_stamp_ns : int
        Stamp of the last command.
    run_id : str
        Run of the last MEASURE; views of other runs are not used. Empty before the first MEASURE,
        and while its first command may be missing.
    model_terms : tuple of str
        Terms of the plan to be estimated, from the last MEASURE.
    artifact_from : str
        Result that made the plate known, from the last MEASURE.
    verify : str
        Result whose correction is on, from the last MEASURE.
    strays : tuple of Command
        Ignored commands, see `without_strays`.
    unmeasured : dict
        view_index -> name of a view that was placed without a MEASURE, and the time from then to
        the next command.
    """

    plan_id: str = ""
    artifact: Artifact | None = None
    views: dict[int, View] = field(default_factory=dict)
    intervals: tuple[Interval, ...] = ()
    views_planned: int = 0
    finished: bool = False
    last_stamp_ns: int = 0
    run_id: str = ""
    model_terms: tuple[str, ...] = ()
    strays: tuple[Command, ...] = ()
    artifact_from: str = ""
    verify: str = ""
    unmeasured: dict[int, tuple[str, Interval]] = field(default_factory=dict)

    @property
    def absent(self) -> list[int]:
        """Views before the last measured one of which there is no command."""
        return [
            index
            for index in range(max(self.views, default=0))
            if index not in self.views and index not in self.unmeasured
        ]

    def assign(self, stamps_ns: np.ndarray) -> np.ndarray:
        """Return the index of the interval of each stamp, int array; -1 before the first."""
        starts = np.array(
            [interval.start_ns for interval in self.intervals], dtype=np.int64
        )
        return np.searchsorted(starts, stamps_ns, "right") - 1

    def planned_view(self, view_index: int) -> tuple[Artifact, View]:
        """Return the plate and a view of it.

        Raises
        ------
        KeyError
            If there is no MEASURE of the view.
        """
        view = self.views[view_index]
        if self.artifact is None:
            raise KeyError(view_index)
        return self.artifact, view

    def of_view(self, view_index: int) -> list[Interval]:
        """Return the intervals in which readings of a view are used."""
        return [i for i in self.intervals if i.view_index == view_index]


def begins_run(command: Command) -> bool:
    """Return whether a command is the first of a run that names itself."""
    return command.phase in (Phase.PLACE, Phase.MEASURE) and command.run_id == str(
        command.stamp_ns
    )


def without_strays(commands: Iterable[Command]) -> list[Command]:
    """Return the commands by their stamps, without duplicates and strays.

    Strays are commands of runs that have not begun, within a run that names itself and whose
    first command was received, until its DONE or ABORT: forged, or left over from a recording.
    """
    regular: list[Command] = []
    begun: set[tuple[str, str]] = set()
    current: tuple[str, str] | None = None
    for command in sorted(set(commands), key=_sort_key):
        run = (command.plan_id, command.run_id)
        if begins_run(command):
            begun.add(run)
            current = run
        elif current is not None and run not in begun:
            continue
        if run == current and command.phase in (Phase.DONE, Phase.ABORT):
            current = None
        regular.append(command)
    return regular


def build_timeline(commands: Iterable[Command]) -> Timeline:
    """Return the timeline of a set of commands.

    A detection belongs to view i from the stamp of (MEASURE, i) to that of the next command.
    A second PLACE of a view restarts it and supersedes its earlier readings. So does a
    MEASURE in another pose.

    Raises
    ------
    InputError
        If two commands of the plan describe different plates.
    """
    commands = tuple(dict.fromkeys(commands))
    ordered = without_strays(commands)
    strays = tuple(sorted(set(commands) - set(ordered), key=_sort_key))
    measures = [number for number, c in enumerate(ordered) if c.phase == Phase.MEASURE]
    if not measures:
        last = ordered[-1].stamp_ns if ordered else 0
        return Timeline(
            intervals=tuple(_unused(ordered)), last_stamp_ns=last, strays=strays
        )
    newest = ordered[measures[-1]]
    plan_id, artifact = newest.plan_id, newest.artifact
    runs = _runs(ordered, plan_id)
    run_id = str(runs[measures[-1]])  # of its own plan, so it exists
    mine = [c for c, run in zip(ordered, runs, strict=True) if run == run_id]
    views: dict[int, View] = {}
    for command in mine:
        if command.phase != Phase.MEASURE:
            continue
        view = command.placed()
        if command.artifact != artifact:
            raise InputError(
                f"view command of '{view.name}'",
                f"describes a different plate from the rest of plan '{plan_id}'",
                "use one plate in one plan",
            )
        views[command.view_index] = view
    planned = max([c.views_planned for c in mine] + [max(views) + 1])
    intervals = tuple(_intervals(ordered, runs, run_id))
    unmeasured = {
        c.view_index: (c.placed().name, interval)
        for c, run, interval in zip(ordered, runs, intervals, strict=True)
        if run == run_id and c.phase == Phase.PLACE and c.view_index not in views
    }
    return Timeline(
        plan_id,
        artifact,
        dict(sorted(views.items())),
        intervals=intervals,
        views_planned=planned,
        finished=ordered[-1].phase in (Phase.DONE, Phase.ABORT),
        last_stamp_ns=ordered[-1].stamp_ns,
        run_id=run_id if _begin_is_known(mine[0], runs) else "",
        model_terms=newest.model_terms,
        strays=strays,
        artifact_from=newest.artifact_from,
        unmeasured=unmeasured,
        **plan_keys(newest),
    )


def _begin_is_known(first: Command, runs: list[str | None]) -> bool:
    """Return whether the first command received of a run is its actual first one.

    Commands that do not name their run may arrive in any order: an earlier one may follow.
    """
    return bool(
        first.run_id
        or (first.phase == Phase.PLACE and first.view_index == 0)
        or len(set(runs) - {None}) > 1
    )


def _runs(ordered: list[Command], plan_id: str) -> list[str | None]:
    """Return the run of each command, None for those of other plans."""
    placed = any(c.phase == Phase.PLACE and c.plan_id == plan_id for c in ordered)
    first = Phase.PLACE if placed else Phase.MEASURE
    out: list[str | None] = []
    run, ended, later = "", False, False
    for command in ordered:
        if command.plan_id != plan_id:
            out.append(None)
            continue
        over = command.phase in (Phase.DONE, Phase.ABORT)
        anew = (
            not over
            and command.view_index == 0
            and (ended or (later and command.phase == first))
        )
        fresh = command.run_id or (str(command.stamp_ns) if anew or not run else run)
        if fresh != run:
            run = fresh
            ended = False
            later = False
        ended |= over
        later |= command.phase == Phase.MEASURE and command.view_index > 0
        out.append(run)
    return out


def _sort_key(command: Command) -> tuple:
    return (
        command.stamp_ns,
        int(command.phase),
        command.plan_id,
        command.view_index,
        repr(command.view),
        repr(command.artifact),
        command.views_planned,
        command.run_id,
        command.model_terms,
        command.artifact_from,
        *plan_keys(command).values(),
    )


def _unused(ordered: list[Command]) -> list[Interval]:
    ends = [*(command.stamp_ns for command in ordered[1:]), NO_END][: len(ordered)]
    return [
        Interval(c.stamp_ns, end, None, Reason.OUTSIDE_VIEWS)
        for c, end in zip(ordered, ends, strict=True)
    ]


def _intervals(
    ordered: list[Command], runs: list[str | None], run_id: str
) -> list[Interval]:
    began: dict[int, int] = {}  # view_index -> stamp from which its MEASUREs are used
    placed: dict[
        int, int
    ] = {}  # view_index -> stamp of a PLACE not yet followed by a MEASURE
    poses: dict[int, tuple] = {}
    for command, run in zip(ordered, runs, strict=True):
        view = command.view_index
        if run == run_id and command.phase == Phase.PLACE:
            placed[view] = command.stamp_ns
        elif run == run_id and command.phase == Phase.MEASURE:
            pose = (command.placed().rotation_rad, command.placed().translation_m)
            start = placed.pop(view, began.get(view, command.stamp_ns))
            began[view] = start if poses.get(view, pose) == pose else command.stamp_ns
            poses[view] = pose
    out = []
    for interval, command, run in zip(_unused(ordered), ordered, runs, strict=True):
        index: int | None = None
        reason: Reason | None = interval.reason
        if command.phase == Phase.MEASURE and run != run_id:
            reason = Reason.OTHER_PLAN if run is None else Reason.OTHER_RUN
        elif (
            command.phase == Phase.MEASURE
            and command.stamp_ns < began[command.view_index]
        ):
            reason = Reason.SUPERSEDED
        elif command.phase == Phase.MEASURE:
            index = command.view_index
            reason = None
        out.append(Interval(interval.start_ns, interval.end_ns, index, reason))
    return out
