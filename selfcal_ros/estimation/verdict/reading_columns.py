# SPDX-License-Identifier: Apache-2.0
"""Columns of single grid readings that are off: a mark misread, or moved, in one view."""

from typing import NamedTuple

import numpy as np

from selfcal_ros.estimation.terms.columns import AXES, Column, TermColumns, WithinMarks
from selfcal_ros.estimation.terms.ground import Ground
from selfcal_ros.estimation.terms.shapes import shapes_of

READING = "reading"

MOST = 6
"""Readings that are tried: those with the largest residuals."""


class Suspect(NamedTuple):
    """A reading that may be off: its grid view, its mark (m, n), and which columns are its own."""

    view: int
    mark: tuple[int, int]
    rows: np.ndarray


def reading_columns(ground: Ground, residuals: np.ndarray,
                    phases: np.ndarray) -> tuple[TermColumns, list[Suspect]]:
    """Return the columns of the readings with the largest residuals, and which they are.

    Two a reading: by what it is off along x and along y, stage axes, m.

    Parameters
    ----------
    ground : Ground
        What the columns stand on.
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
