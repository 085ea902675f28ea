# SPDX-License-Identifier: Apache-2.0
"""Columns of faults: single grid readings that are off, and plates that slip within a view.

A faulty reading is of a mark misread, or moved, in one view; a slip is a second misalignment from
an instant on.
"""

from typing import NamedTuple

import numpy as np

from selfcal_ros.estimation.terms.columns import (
    AXES,
    Column,
    TermColumns,
    WithinMarks,
    columns_from,
)
from selfcal_ros.estimation.terms.ground import Ground
from selfcal_ros.estimation.terms.shapes import shapes_of
from selfcal_ros.estimation.terms.visits import ViewVisits

READING = "reading"

MOST = 6
"""Number of readings that are tested: those with the largest residuals."""


class Suspect(NamedTuple):
    """A reading that may be faulty: its grid view, its mark (m, n), and a mask of its columns."""

    view: int
    mark: tuple[int, int]
    rows: np.ndarray


def reading_columns(ground: Ground, residuals: np.ndarray,
                    phases: np.ndarray) -> tuple[TermColumns, list[Suspect]]:
    """Return the columns of the readings with the largest residuals, and these readings.

    Two for each reading: its errors along x and y, stage axes, m.

    Parameters
    ----------
    ground : Ground
        Inputs of the columns.
    residuals : complex array (views, nx, ny)
        Residuals of the means of the marks, plate frame, m.
    phases : complex array (views,)
        From the stage frame to the plate frame in each view.
    """
    squares = np.where(ground.weight > 0, ground.weight * abs(residuals) ** 2, -1.0)
    largest = np.argsort(squares, axis=None, kind="stable")[::-1][:MOST]
    at = [place for place in zip(*np.unravel_index(largest, squares.shape), strict=True)
          if squares[place] >= 0]
    half = ((squares.shape[1] - 1) // 2, (squares.shape[2] - 1) // 2)
    means, columns, found = [], [], []
    for number, (view, i, j) in enumerate(at):
        mean = np.zeros(squares.shape[1:], dtype=complex)
        mean[i, j] = phases[view]
        means.append({int(view): mean.reshape(-1)})
        columns += [Column(READING, int(view), axis, np.inf) for axis, _ in AXES]
        rows = np.arange(2 * len(at)) // 2 == number
        found.append(Suspect(int(view), (int(i) - half[0], int(j) - half[1]), rows))
    n, units = 2 * len(at), [unit for _, unit in AXES]
    shapes = shapes_of(means, [column // 2 for column in range(n)], units * len(at), ground.weight)
    nothing = WithinMarks(np.zeros((n, n)), np.zeros(n), 0.0, 0)
    return TermColumns(tuple(columns), shapes, nothing, [[None] * len(ground.names)] * len(at)
                       ), found


SLIP = "slip"

PLACES = 12
"""Number of instants in each view at which a slip is tested."""


def slip_columns(ground: Ground) -> tuple[TermColumns, dict[tuple[int, float], np.ndarray]]:
    """Return the columns of slips, and a mask of those of each view and instant.

    Three for each slip: offset along x and y (stage axes, m), and rotation (m at the half width).
    Views whose visits are unknown have none. An instant is a part of the view's visits, 0..1.
    """
    columns: list[Column] = []
    shapes: list[tuple[np.ndarray, tuple[complex, ...]]] = []
    groups: dict[tuple[int, float], list[int]] = {}
    for view, visits in enumerate(ground.visits):
        if visits is None:
            continue
        for part in np.arange(1, PLACES + 1) / (PLACES + 1):
            after = _after(visits, float(part))
            if not 3 <= after.sum() <= len(after) - 3:
                continue
            at = ground.z.reshape(-1)[visits.mark]
            groups[view, float(part)] = list(range(len(columns), len(columns) + 3))
            columns += [Column(SLIP, view, text, np.inf) for text in ("x", "y", "phi")]
            shapes += [(after * visits.phase, (1, 1j)), (after * at, (1j,))]
    made = columns_from(ground, columns, shapes)
    rows = {key: np.isin(np.arange(len(columns)), at) for key, at in groups.items()}
    return made, rows


def _after(visits: ViewVisits, part: float) -> np.ndarray:
    """Return a mask of the visits after the first `part` of them in time, bool (V,)."""
    rank = np.argsort(np.argsort(visits.time, kind="stable"), kind="stable")
    return rank >= round(part * len(rank))
