# SPDX-License-Identifier: Apache-2.0
"""Expected and missing marks of a view, and its progress."""

from dataclasses import dataclass

import numpy as np

from selfcal_ros.collection.marks.check_stops import count_stops
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.readings import ViewReadings
from selfcal_ros.model.view import View

NAMED_AT_MOST = 200
"""Largest number of missing grid marks, and lines, named."""


@dataclass(frozen=True)
class Missing:
    """The first grid marks (m, n) and lines k not read as often as required."""

    m: tuple[int, ...] = ()
    n: tuple[int, ...] = ()
    k: tuple[int, ...] = ()


def mark_rows(artifact: Artifact, view: View) -> tuple[np.ndarray, np.ndarray]:
    """Return the first n expected for each m, and the number of marks, int arrays (nx,).

    Expected are the marks in the field of the stage, none in a view without grid marks.
    """
    if not view.grid:
        nothing = np.zeros(artifact.shape[0], dtype=int)
        return nothing, nothing
    return view.on_stage(artifact).mark_rows(artifact)


def expected_marks(artifact: Artifact, view: View) -> tuple[int, int]:
    """Return the numbers of grid marks and angular lines to be read in a view."""
    return int(mark_rows(artifact, view)[1].sum()), artifact.angular_count if view.angular else 0


def read_enough(view: View, readings: ViewReadings,
                min_repeats: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return which marks, and which lines, of the readings were read often enough, bool arrays.

    As often as the plan asks; with `min_repeats`, this many good readings suffice once the mark was
    read as often as the plan asks, outliers included.
    """
    found = []
    for count, tries in _tried(view, readings):
        enough = count >= view.repeats
        if min_repeats:
            enough |= (tries >= view.repeats) & (count >= min_repeats)
        found.append(enough)
    return found[0], found[1]


def _tried(view: View, readings: ViewReadings) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return readings and repeats, outliers included, of marks (without check stops) and lines."""
    return [(count, count + outliers if len(outliers) else count) for count, outliers in (
        (count_stops(view, readings)[0], readings.outliers),
        (readings.count_theta, readings.outliers_theta))]


def missing_marks(artifact: Artifact, view: View, readings: ViewReadings,
                  min_repeats: int = 0) -> Missing:
    """Return the first marks, in the order of (m, n) and of k, not read often enough."""
    first, count = mark_rows(artifact, view)
    grid, angular = expected_marks(artifact, view)
    end = np.cumsum(count)
    of_zero = end - count - first  # number of the mark n = 0 of each row
    done, done_theta = read_enough(view, readings, min_repeats)
    row = readings.m[done] + artifact.half[0]
    number = first_missing(np.sort(of_zero[row] + readings.n[done]), grid)
    row = np.searchsorted(end, number, "right")
    lines = first_missing(np.sort(readings.k[done_theta]), angular)
    return Missing(tuple((row - artifact.half[0]).tolist()),
                   tuple((number - of_zero[row]).tolist()), tuple(lines.tolist()))


def first_missing(done: np.ndarray, total: int) -> np.ndarray:
    """Return the first of the numbers 0..total-1 that are not in `done` (rising, each once)."""
    rank = np.arange(min(total - len(done), NAMED_AT_MOST))
    return rank + np.searchsorted(done - np.arange(len(done)), rank, "right")


@dataclass(frozen=True)
class ViewProgress:
    """Progress of a view; the fields of selfcal_msgs/ViewStatus."""

    view_index: int
    view: View
    grid_expected: int
    grid_done: int
    angular_expected: int
    angular_done: int
    readings: ViewReadings
    end_ns: int
    artifact: Artifact | None = None
    check_done: int = 0
    min_repeats: int = 0

    @property
    def check_expected(self) -> int:
        """Grid marks to be measured from all four sides as well."""
        return self.view.check_marks if self.view.grid else 0

    @property
    def missing(self) -> Missing:
        """Marks not read as often as the plan asks, at most 200 of each kind."""
        if self.artifact is None:
            return Missing()
        return missing_marks(self.artifact, self.view, self.readings, self.min_repeats)

    @property
    def needed(self) -> int:
        """Smallest number of detections needed to complete the view."""
        repeats, have = self.view.repeats, 0
        for count, tries in _tried(self.view, self.readings):
            more = repeats - count
            if self.min_repeats:
                more = np.minimum(more, np.maximum(repeats - tries, self.min_repeats - count))
            have += int((repeats - np.maximum(more, 0)).sum())
        return (repeats * (self.grid_expected + self.angular_expected) - have
                + self.check_expected - self.check_done)

    @property
    def complete(self) -> bool:
        """Whether every expected mark has been read often enough, and checked."""
        return (self.grid_done >= self.grid_expected
                and self.angular_done >= self.angular_expected
                and self.check_done >= self.check_expected)

    @property
    def coverage(self) -> float:
        """Fraction of the expected marks and checks that are complete, 0..1."""
        expected = self.grid_expected + self.angular_expected + self.check_expected
        done = self.grid_done + self.angular_done + self.check_done
        return done / expected if expected else 1.0
