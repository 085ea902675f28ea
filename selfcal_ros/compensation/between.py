# SPDX-License-Identifier: Apache-2.0
"""What a map does not know between its nodes: the error of interpolation (method eq. 1.7)."""

import numpy as np

CELL_MEAN = 8 / 15
"""Mean square over a cell of the error of interpolation, as a share of that halfway."""
_LINEAR = {1: 1.0}
_CUBIC = {1: 9 / 8, 3: -1 / 8}
"""Weights of the pairs of neighbours at a distance in pitches, which predict a node."""
_SMOOTH = 1 / 4
"""Error of linear interpolation over a pitch, as a share of that over two, of a smooth function."""


def error_halfway(values: np.ndarray, u: np.ndarray, *, cubic: bool = False) -> tuple[float, float]:
    """Return the rms and the largest error of interpolation halfway between nodes.

    A node minus the value interpolated from its neighbours is the error over two pitches. Over one
    pitch it is taken to shrink as from four to two: by 4 for a smooth function, not at all if
    the nodes are independent; a cubic spline shrinks it by the square of that. What the noise of
    the nodes explains is subtracted. Fewer than seven nodes: as linear.

    Parameters
    ----------
    values, u : float array (n, ...)
        Nodes along the first axis and their standard uncertainties; NaN where unknown.
    cubic : bool
        Whether the interpolation is a cubic spline.
    """
    over_two, over_four = (_squares(values, u, _LINEAR, pitches) for pitches in (1, 2))
    if not len(over_two):
        return 0.0, 0.0
    coarse = float(over_four.mean()) if len(over_four) else 0.0
    shrunk = np.clip(over_two.mean() / coarse, _SMOOTH**2, 1.0) if coarse > 0 else _SMOOTH**2
    if cubic and len(values) > 2 * max(_CUBIC):
        over_two, shrunk = _squares(values, u, _CUBIC, 1), shrunk**2
        if not len(over_two):
            return 0.0, 0.0
    mean, largest = np.sqrt(shrunk * np.maximum([over_two.mean(), over_two.max()], 0.0))
    return float(mean), float(largest)


def _squares(values: np.ndarray, u: np.ndarray, weights: dict[int, float],
             pitches: int) -> np.ndarray:
    """Return the squared errors of known nodes predicted from neighbours, less noise, (k,)."""
    n, reach = len(values), pitches * max(weights)
    middle = slice(reach, max(n - reach, reach))
    error, power = values[middle], u[middle] ** 2
    for distance, weight in weights.items():
        low, high = (slice(reach + step, max(n - reach, reach) + step)
                     for step in (-pitches * distance, pitches * distance))
        error = error - weight * (values[low] + values[high]) / 2
        power = power + weight**2 * (u[low] ** 2 + u[high] ** 2) / 4
    square = error**2 - power
    return square[np.isfinite(square)]


def share_between(position: np.ndarray) -> np.ndarray:
    """Return the error of interpolation at positions in pitches, as a share of that halfway.

    The parabola 4 s (1 - s) over a cell, with the mean square `CELL_MEAN`: 0 at the nodes.
    """
    part = position - np.floor(position)
    return 4 * part * (1 - part)
