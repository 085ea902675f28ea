# SPDX-License-Identifier: Apache-2.0
"""Readings of each view from the detections in it, made again where these have changed."""

from collections import Counter

import numpy as np

from selfcal_ros.collection.exposures import Exposures
from selfcal_ros.collection.inputs import DETECTION, Reason
from selfcal_ros.collection.reduce import (
    Rules,
    canonical,
    clean,
    reduce_view,
    with_low_scores,
    with_rejections,
)
from selfcal_ros.collection.samples import NO_STAMPS, GrowingColumns, GrowingTable
from selfcal_ros.collection.timeline import Timeline
from selfcal_ros.model.readings import ViewReadings

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
        self, timeline: Timeline, exposures: Exposures
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
