# SPDX-License-Identifier: Apache-2.0
"""What a map does not know between its nodes: the error of interpolation (method eq. 1.7)."""

import numpy as np

_LINEAR = (4, {1: 1.0})
_CUBIC = (16, {1: 9 / 8, 3: -1 / 8})
"""Ratio of the error over a pitch to that over two pitches; weights of the pairs of neighbours at a
distance in pitches, which predict a node."""


def error_halfway(values: np.ndarray, u: np.ndarray, *, cubic: bool = False) -> tuple[float, float]:
    """Return the rms and the largest error of interpolation halfway between nodes.

    A node minus the value interpolated from its neighbours is the error over two pitches; of a
    smooth function that over one pitch is a quarter, with a cubic a sixteenth of it. What the noise
    of the nodes explains is subtracted. Fewer than seven nodes: as linear.

    Parameters
    ----------
    values, u : float array (n, ...)
        Nodes along the first axis and their standard uncertainties; NaN where unknown.
    cubic : bool
        Whether the interpolation is a cubic spline.
    """
    n = len(values)
    order, weights = _CUBIC if cubic and n > 2 * max(_CUBIC[1]) else _LINEAR
    reach = max(weights)
    middle = slice(reach, n - reach)
    error, power = values[middle], u[middle] ** 2
    for step, weight in weights.items():
        low, high = slice(reach - step, n - reach - step), slice(reach + step, n - reach + step)
        error = error - weight * (values[low] + values[high]) / 2
        power = power + weight**2 * (u[low] ** 2 + u[high] ** 2) / 4
    square = error**2 - power
    known = square[np.isfinite(square)]
    if not len(known):
        return 0.0, 0.0
    mean, largest = np.sqrt(np.maximum([known.mean(), known.max()], 0.0)) / order
    return float(mean), float(largest)


def share_between(position: np.ndarray) -> np.ndarray:
    """Return the error of interpolation at positions in pitches, as a share of that halfway.

    The parabola 4 s (1 - s) over a cell: 0 at the nodes.
    """
    part = position - np.floor(position)
    return 4 * part * (1 - part)


def mean_square(along_x: float, along_y: float) -> float:
    """Return the mean square over a cell of the sum of both directions, from those halfway.

    The parabola has the mean 2/3 and the mean square 8/15.
    """
    return 8 / 15 * (along_x**2 + along_y**2) + 8 / 9 * along_x * along_y
