# SPDX-License-Identifier: Apache-2.0
"""Assignment of instants to views by the stamps of the commands, never by arrival.

A plan may be measured repeatedly: readings of different runs
are never mixed. Commands name their run (`run_id`). If they do not, a run begins with a command
of view 0 that follows DONE or ABORT, or that places the plate again after a later view has been
measured; it is then named by the stamp of its first command.

A run that names itself and whose first command was received lasts until it ends or another one
begins: a command in between that belongs to no run that has begun is a stray and changes nothing.
"""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from selfcal_ros.collection.exposures import Exposures
from selfcal_ros.collection.inputs import DETECTION, Command, Phase, Reason
from selfcal_ros.collection.reduce import (
    Rules,
    canonical,
    clean,
    reduce_view,
    with_low_scores,
    with_rejections,
)
from selfcal_ros.collection.samples import GrowingColumns, GrowingTable
from selfcal_ros.errors import InputError
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.readings import ViewReadings
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
            intervals=tuple(_unused(ordered)),
            views={},
            last_stamp_ns=last,
            strays=strays,
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


NO_STAMPS = np.zeros(0, dtype=np.int64)
TOGETHER = 65_536
"""Number of detections assigned to views together, to fit in cache."""
PLACE = {"interval": "i4", "view": "i4"}
"""Interval of the timeline and view of a detection; -1 = before the first, in no view."""


class ViewCache:
    """Detections, and the readings from them, recomputed for each view that has changed."""

    def __init__(self, rules: Rules) -> None:
        self._rules = rules
        self._table, self._place = GrowingTable(DETECTION), GrowingColumns(PLACE)
        self._looked_up = 0  # detections with stamps already returned
        self._scored = False
        self._timeline: Timeline | None = None
        self._changed = [NO_STAMPS]
        self._readings: dict[int, ViewReadings] = {}

    @property
    def table(self) -> np.ndarray:
        """All detections in the order of their arrival, structured array of `DETECTION`."""
        return self._table.rows

    @property
    def view_of(self) -> np.ndarray:
        """View of each detection, -1 for none; as of the last `readings`."""
        return self._place["view"]

    def append(self, table: np.ndarray) -> None:
        """Take detections."""
        self._table.append(canonical(table))
        scored = bool((np.isfinite(table["score"]) & (table["score"] > 0)).any())
        if scored and not self._scored:  # low scores are rejected from now on
            self._scored = True
            self._readings = {}

    def new_stamps(self) -> np.ndarray:
        """Return the stamps of the detections since the last call."""
        new = self.table["stamp"][self._looked_up :]
        self._looked_up = len(self._table)
        return new

    def changed_at(self, stamps_ns: np.ndarray) -> None:
        """Mark instants at which the stage's data has changed."""
        if len(stamps_ns):
            self._changed.append(stamps_ns)

    def readings(
        self,
        timeline: Timeline,
        exposures: Exposures,
    ) -> tuple[dict[int, ViewReadings], Counter]:
        """Return the readings of every view, and reason -> detections that belong to no view."""
        for index in self._assign(timeline):
            self._readings.pop(index, None)
        for index, view in timeline.views.items():
            cached = self._readings.get(index)
            if cached is None or cached.view != view:
                self._readings[index] = self._reduce(timeline, index, exposures)
        return {index: self._readings[index] for index in timeline.views}, self._loose(
            timeline
        )

    def _assign(self, timeline: Timeline) -> set[int]:
        """Find the view of each detection; return the views whose detections have changed."""
        n_assigned = len(self.view_of)
        old = (
            self.view_of[:n_assigned].copy() if timeline is not self._timeline else None
        )
        if self._timeline is None or timeline.artifact != self._timeline.artifact:
            self._readings = {}
        start = 0 if old is not None else n_assigned
        self._place.insert(np.full(len(self._table) - n_assigned, n_assigned), {})
        view_of = np.array(
            [
                -1 if interval.view_index is None else interval.view_index
                for interval in timeline.intervals
            ]
            + [-1]
        )
        for begin in range(start, len(self._table), TOGETHER):
            rows = slice(begin, begin + TOGETHER)
            interval = timeline.assign(self.table["stamp"][rows])
            self._place["interval"][rows], self._place["view"][rows] = (
                interval,
                view_of[interval],
            )
        touched = _different(self.view_of[n_assigned:])
        if old is not None:
            reassigned = old != self.view_of[:n_assigned]
            touched |= _different(old[reassigned]) | _different(
                self.view_of[:n_assigned][reassigned]
            )
        stamps = np.concatenate(self._changed)
        self._timeline, self._changed = timeline, [NO_STAMPS]
        return touched | _different(view_of[timeline.assign(stamps)])

    def _loose(self, timeline: Timeline) -> Counter:
        """Return reason -> number of detections that belong to no view."""
        counts = np.bincount(
            self._place["interval"] + 1, minlength=len(timeline.intervals) + 1
        ).tolist()
        loose = Counter({str(Reason.OUTSIDE_VIEWS): counts[0]})
        for interval, count in zip(timeline.intervals, counts[1:], strict=True):
            if interval.view_index is None:
                loose[str(interval.reason)] += count
        return +loose

    def _reduce(
        self, timeline: Timeline, index: int, exposures: Exposures
    ) -> ViewReadings:
        rows = np.flatnonzero(self.view_of == index)
        detections = self.table[_as_slice(rows)]
        good, low, reasons = clean(detections, self._rules, scored=self._scored)
        readings = reduce_view(
            *timeline.planned_view(index), good, exposures=exposures, rules=self._rules
        )
        readings = with_low_scores(readings, low, exposures)
        total = Counter(readings.rejected)
        total.update({str(reason): count for reason, count in reasons.items()})
        return with_rejections(readings, dict(sorted(total.items())))


def _different(views: np.ndarray) -> set[int]:
    """Return the distinct view indices, including -1."""
    return set((np.flatnonzero(np.bincount(views + 1)) - 1).tolist())


def _as_slice(rows: np.ndarray) -> np.ndarray | slice:
    """Return consecutive rising indices as a slice, to avoid copies."""
    if len(rows) and rows[-1] - rows[0] == len(rows) - 1:
        return slice(int(rows[0]), int(rows[-1]) + 1)
    return rows
