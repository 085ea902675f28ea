# SPDX-License-Identifier: Apache-2.0
"""Check stops: readings of a mark with the stage deliberately off it.

The position of the stage relative to the site of a mark is deviation minus offset, in either
sense. Check stops are recognised by the position of the stage: about a check offset
from its usual position at that mark, along one axis.
"""

import numpy as np

from selfcal_ros.collection.marks.repeats import groups_of, pairs_of
from selfcal_ros.model.readings import ViewReadings
from selfcal_ros.model.view import View

SCATTER = 1 / 12
"""Scatter of the ordinary stops, in check offsets, above which check stops are not recognised."""
QUARTILE = 0.4506241100243562
"""Lower quartile of the difference of two normal variables of standard deviation 1."""
LOOKED_AT = 2000
"""Largest number of marks per number of readings used for the scatter."""


def stage_aside(key: np.ndarray, place_m: np.ndarray, offset_m: float) -> np.ndarray | None:
    """Return the distance of the stage from its usual position at the mark, for check stops.

    Parameters
    ----------
    key : int array (n,)
        Index of the mark of each reading.
    place_m : float array (2, n)
        Position of the stage, m, along x and y.
    offset_m : float
        Distance of check stops, m.

    Returns
    -------
    float array (2, n) or None
        Along the axis of the check stop, m; 0 along the other and for ordinary stops. None if
        ordinary stops scatter too much to be distinguished from check stops.
    """
    if _scatter(key, place_m) > SCATTER * offset_m:
        return None
    away = np.stack([row - _medians(key, row) for row in place_m])
    off = (np.abs(away) > offset_m / 2) & (np.abs(away) < 1.5 * offset_m)
    return np.where(off & ~off[::-1], away, 0.0)


def _scatter(key: np.ndarray, place_m: np.ndarray) -> float:
    """Return the standard deviation of the stops along the axis where it is smaller, m.

    Two of the four check stops coincide along each axis, so the lower quartile of the
    differences of readings of a mark, and the better axis, represent ordinary stops.
    """
    apart = [np.zeros((2, 0))]
    for group in groups_of(key):
        some = group[::-(-len(group) // LOOKED_AT)]
        i, j = pairs_of(some.shape[1])
        apart.append(np.abs(place_m[:, some[:, i]] - place_m[:, some[:, j]]).reshape(2, -1))
    every = np.concatenate(apart, axis=1)
    return float(np.quantile(every, 0.25, axis=1).min()) / QUARTILE if every.size else 0.0


def _medians(key: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the (lower) median of the values of each key, for each element (n,)."""
    order = np.lexsort((values, key))
    _, first, inverse, count = np.unique(key[order], return_index=True, return_inverse=True,
                                         return_counts=True)
    out = np.empty(len(values))
    out[order] = values[order][first + (count - 1) // 2][inverse]
    return out


def without_aside(key: np.ndarray, deviation_m: np.ndarray, offset_m: np.ndarray,
                  check_offset_m: float) -> tuple[np.ndarray, int]:
    """Return deviations minus the microscope's error from check stops, and its parameter count.

    A microscope with a wrong scale, turn or sign reads a mark differently from a check stop. This
    is neither an outlier nor noise: the part proportional to the stage position is removed, from
    the median over the check stops along each axis.

    Parameters
    ----------
    key : int array (n,)
        Number of the mark of each reading.
    deviation_m, offset_m : float array (2, n)
        Deviation, and measured offset, m.
    check_offset_m : float
        Distance of check stops, m; 0 = none.
    """
    aside = stage_aside(key, deviation_m - offset_m, check_offset_m) if check_offset_m else None
    if aside is None or not aside.any():
        return deviation_m, 0
    about = np.stack([row - _medians(key, row) for row in deviation_m])
    out, fitted = deviation_m.copy(), 0
    for along in aside:
        here = along != 0
        if here.any():
            slope = np.median(about[:, here] / along[here], axis=1)
            out[:, here] -= slope[:, None] * along[here]
            fitted += 2
    return out, fitted


def count_stops(view: View, readings: ViewReadings) -> tuple[np.ndarray, int]:
    """Return the readings of each grid mark without check stops, (P,), and the number checked.

    A mark is checked if it was measured from all four sides; a stop on one side only counts
    as a repeat. If ordinary stops scatter like check stops, they show the microscope's error
    themselves: all requested marks count as checked.
    """
    visits = readings.visits
    if not view.check_marks or visits is None:
        return readings.count, 0
    aside = stage_aside(visits.mark, np.stack([visits.dx - visits.offset_x,
                                               visits.dy - visits.offset_y]), view.check_offset_m)
    if aside is None:
        return readings.count, view.check_marks
    sides = [np.bincount(visits.mark, sign * row > 0, len(readings.m)) > 0
             for row in aside for sign in (1, -1)]
    n_sides = np.sum(sides, axis=0)
    off = aside.any(axis=0) & (n_sides[visits.mark] > 1)
    extra = np.bincount(visits.mark, visits.count * off, len(readings.m)).astype(np.int64)
    return readings.count - extra, int((n_sides == 4).sum())
