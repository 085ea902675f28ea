# SPDX-License-Identifier: Apache-2.0
"""Which marks a view asks for, and which of them are still missing; room only for what is said."""

from dataclasses import dataclass

import numpy as np

from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.readings import ViewReadings
from selfcal_ros.model.view import View

NAMED_AT_MOST = 200
"""Missing grid marks, and lines, that are named."""


@dataclass(frozen=True)
class Missing:
    """Grid marks (m, n) and lines k that were not read as often as asked, the first of them."""

    m: tuple[int, ...] = ()
    n: tuple[int, ...] = ()
    k: tuple[int, ...] = ()


def mark_range(artifact: Artifact, view: View) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return the smallest and largest m, and n, of the grid marks in the field in a view.

    The field is the lattice of the stage; the range is empty (largest below smallest) where the
    view asks for no grid marks or all lie outside.
    """
    pose = view.lattice_pose(artifact)
    if not view.grid or pose.quarter_turns is None:
        return (0, -1), (0, -1)
    (hx, hy), (a, b) = artifact.half, pose.shift
    x, y = (-hx - a, hx - a), (-hy - b, hy - b)  # of R^q (m, n)
    minus_x, minus_y = (-x[1], -x[0]), (-y[1], -y[0])
    m, n = ((x, y), (y, minus_x), (minus_x, minus_y), (minus_y, x))[pose.quarter_turns]
    return (max(m[0], -hx), min(m[1], hx)), (max(n[0], -hy), min(n[1], hy))


def expected_marks(artifact: Artifact, view: View) -> tuple[int, int]:
    """Return how many grid marks and angular lines are to be read in a view."""
    (m_low, m_high), (n_low, n_high) = mark_range(artifact, view)
    grid = max(m_high - m_low + 1, 0) * max(n_high - n_low + 1, 0)
    return grid, artifact.angular_count if view.angular else 0


def missing_marks(artifact: Artifact, view: View, readings: ViewReadings) -> Missing:
    """Return the first marks, in the order of (m, n) and of k, that were not read often enough."""
    (m_low, _), (n_low, n_high) = mark_range(artifact, view)
    grid, angular = expected_marks(artifact, view)
    width = max(n_high - n_low + 1, 1)
    done = readings.count >= view.repeats
    number = (readings.m[done] - m_low) * width + readings.n[done] - n_low
    number = first_missing(np.sort(number), grid)
    lines = first_missing(np.sort(readings.k[readings.count_theta >= view.repeats]), angular)
    return Missing(tuple((m_low + number // width).tolist()),
                   tuple((n_low + number % width).tolist()), tuple(lines.tolist()))


def first_missing(done: np.ndarray, total: int) -> np.ndarray:
    """Return the first of the numbers 0..total-1 that are not in `done` (rising, each once)."""
    rank = np.arange(min(total - len(done), NAMED_AT_MOST))
    return rank + np.searchsorted(done - np.arange(len(done)), rank, "right")
