# SPDX-License-Identifier: Apache-2.0
"""Expected and missing marks of a view, and its progress."""

from dataclasses import dataclass

import numpy as np

from selfcal_ros.collection.marks.stops import beside, count_stops, marks_shown
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
    """Return the numbers of grid marks and angular lines to be read in a view.

    Where images show several marks, those of every image are counted.
    """
    lines = artifact.angular_count if view.angular else 0
    if view.image is not None and view.grid:
        return sum(int(marks.sum()) for marks in marks_shown(artifact, view)), lines
    return int(mark_rows(artifact, view)[1].sum()), lines


def n_read_enough(
    artifact: Artifact, view: View, readings: ViewReadings, min_repeats: int = 0
) -> tuple[int, int]:
    """Return the numbers of grid marks and lines read often enough, see `read_enough`."""
    if not readings.cells:
        enough, enough_theta = read_enough(view, readings, min_repeats)
        return int(enough.sum()), int(enough_theta.sum())
    cell_marks = marks_shown(artifact, view)
    return (
        sum(
            int((marks & _read(artifact, cell, min_repeats)).sum())
            for marks, cell in zip(cell_marks, readings.cells, strict=True)
        ),
        int(read_enough(view, readings, min_repeats)[1].sum()),
    )


def _read(artifact: Artifact, cell: ViewReadings, min_repeats: int) -> np.ndarray:
    """Return the marks that were read often enough in a cell, bool (nx, ny)."""
    enough = read_enough(cell.view, cell, min_repeats)[0]
    out = np.zeros(artifact.shape, dtype=bool)
    out[artifact.index(cell.m[enough], cell.n[enough])] = True
    return out


def _missing_stops(
    artifact: Artifact, view: View, readings: ViewReadings, min_repeats: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the marks (m, n) at which an image has to be taken again: not all of it was read."""
    stops = np.zeros(artifact.shape, dtype=bool)
    for marks, cell in zip(marks_shown(artifact, view), readings.cells, strict=True):
        stops |= beside(
            marks & ~_read(artifact, cell, min_repeats), artifact, cell.view, -1
        )
    i, j = np.nonzero(stops)
    return artifact.marks_at(i[:NAMED_AT_MOST], j[:NAMED_AT_MOST])


def read_enough(
    view: View, readings: ViewReadings, min_repeats: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Return which marks, and which lines, of the readings were read often enough, bool arrays.

    As often as the plan asks; with `min_repeats`, this many good readings suffice once the mark was
    read as often as the plan asks, outliers included.
    """
    masks = []
    for count, tries in _tried(view, readings):
        enough = count >= view.repeats
        if min_repeats:
            enough |= (tries >= view.repeats) & (count >= min_repeats)
        masks.append(enough)
    return masks[0], masks[1]


def _tried(view: View, readings: ViewReadings) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return readings and repeats, outliers included, of marks (without check stops) and lines."""
    return [
        (count, count + outliers if len(outliers) else count)
        for count, outliers in (
            (count_stops(view, readings)[0], readings.outliers),
            (readings.count_theta, readings.outliers_theta),
        )
    ]


def missing_marks(
    artifact: Artifact, view: View, readings: ViewReadings, min_repeats: int = 0
) -> Missing:
    """Return the first marks, in the order of (m, n) and of k, not read often enough.

    Where images show several marks: those at which an image has to be taken again.
    """
    first, count = mark_rows(artifact, view)
    grid, angular = expected_marks(artifact, view)
    end = np.cumsum(count)
    of_zero = end - count - first  # number of the mark n = 0 of each row
    enough, enough_theta = read_enough(view, readings, min_repeats)
    lines = first_missing(np.sort(readings.k[enough_theta]), angular)
    if readings.cells:
        m, n = _missing_stops(artifact, view, readings, min_repeats)
        return Missing(tuple(m.tolist()), tuple(n.tolist()), tuple(lines.tolist()))
    row = artifact.index(readings.m[enough], readings.n[enough])[0]
    number = first_missing(np.sort(of_zero[row] + readings.n[enough]), grid)
    row = np.searchsorted(end, number, "right")
    return Missing(
        tuple(artifact.marks_at(row, row)[0].tolist()),
        tuple((number - of_zero[row]).tolist()),
        tuple(lines.tolist()),
    )


def first_missing(read_numbers: np.ndarray, total: int) -> np.ndarray:
    """Return the first of the numbers 0..total-1 not in `read_numbers` (rising, each once)."""
    rank = np.arange(min(total - len(read_numbers), NAMED_AT_MOST))
    return rank + np.searchsorted(
        read_numbers - np.arange(len(read_numbers)), rank, "right"
    )


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
        repeats = self.view.repeats
        have = 0
        tried = [
            pair for cell in self.readings.parts for pair in _tried(cell.view, cell)
        ]
        for count, tries in tried:
            more = repeats - count
            if self.min_repeats:
                more = np.minimum(
                    more, np.maximum(repeats - tries, self.min_repeats - count)
                )
            have += int((repeats - np.maximum(more, 0)).sum())
        return (
            repeats * (self.grid_expected + self.angular_expected)
            - have
            + self.check_expected
            - self.check_done
        )

    @property
    def complete(self) -> bool:
        """Whether every expected mark has been read often enough, and checked."""
        return (
            self.grid_done >= self.grid_expected
            and self.angular_done >= self.angular_expected
            and self.check_done >= self.check_expected
        )

    @property
    def coverage(self) -> float:
        """Fraction of the readings and checks to be made that is there, 0..1.

        Marks that are complete would be none until the last pass over the plate.
        """
        planned = (
            self.view.repeats * (self.grid_expected + self.angular_expected)
            + self.check_expected
        )
        return 1 - self.needed / planned if planned else 1.0
