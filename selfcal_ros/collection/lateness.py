# SPDX-License-Identifier: Apache-2.0
"""Whether the stage rests at the marks some time before or after their detections are stamped.

A cell that stamps a detection on its arrival, or by another clock, is one reason of this; one that
exposes before the stage rests is another.
"""

from dataclasses import dataclass

import numpy as np

from selfcal_ros.collection.exposures import Exposures
from selfcal_ros.collection.inputs import MAX_AHEAD_NS
from selfcal_ros.units import S_PER_NS

AT_LEAST = 5
"""Smallest number of detections, of a stage that is elsewhere or moves, that show a lag."""
NEARLY_ALL = 0.9
"""Fraction of them that a lag explains."""
LATE = 200
"""Largest lag, in usual times between two exposures; nor is it above `MAX_AHEAD_NS`."""
FINE = 10
"""Lags tried in a usual time between two exposures."""


@dataclass(frozen=True)
class Lag:
    """Time in s by which detections are stamped after the stage has rested at their marks.

    `explained` is the part of the detections that it explains; `varies`: it is not the same for
    all of them.
    """

    seconds: float
    explained: float
    varies: bool = False

    def __str__(self) -> str:
        """Return what is wrong, and the remedy."""
        side = "before" if self.seconds > 0 else "after"
        varies = ", by times that vary" if self.varies else ""
        return (
            f"the stage rests at the marks about {abs(self.seconds):.2g} s {side} their "
            f"detections are stamped{varies}; stamp detections with the instant of the "
            "exposure, not of their arrival, and encoder samples with that of the reading, by "
            "one clock; if they are, expose while the stage rests"
        )


def lag_of(
    views: list[tuple[np.ndarray, np.ndarray]], exposures: Exposures, limit_m: float
) -> Lag | None:
    """Return the lag that explains nearly all detections of a stage not at rest at their marks.

    Parameters
    ----------
    views : list of (int64 array (n,), complex array (n,))
        Of each view: stamps of detections of grid marks, ns, and the indicated positions of the
        stage that sees each where the plan places it, m; NaN without an id.
    exposures : Exposures
        The stage.
    limit_m : float
        Largest distance of the stage from the site of a mark.
    """
    times = [np.diff(np.unique(stamps)) for stamps, _ in views]
    if not any(map(len, times)):
        return None
    step = max(int(np.median(np.concatenate(times))) // FINE, 1)
    most = min(LATE * FINE, MAX_AHEAD_NS // step)
    lags = step * np.arange(-most, most + 1)
    sites = np.concatenate([view_sites for _, view_sites in views])
    known, fits = (
        np.concatenate(each, axis=1)
        for each in zip(
            *(_at_lags(*view, lags, exposures, limit_m) for view in views), strict=True
        )
    )
    middle = len(lags) // 2
    off = known[middle] & ~fits[middle]
    for width, looked_at in ((0, off), (FINE, off & np.isfinite(sites))):
        if looked_at.sum() < AT_LEAST:
            return None
        here = known[:, looked_at]
        fit = _widened(fits[:, looked_at], width) & here
        part = _explained(here, fit)
        good = np.flatnonzero(part >= NEARLY_ALL)
        if len(good):
            # off by a pass, those of one pass do not fit: the stage was not there yet
            number = fit.sum(axis=1)[good]
            most_fit = good[number == number.max()]
            nearest = most_fit[np.abs(most_fit - middle).argmin()]
            run = _run(part >= NEARLY_ALL, nearest)
            return Lag(
                float(lags[run].mean() * S_PER_NS),
                float(part[run].max()),
                varies=width > 0,
            )
    return None


def _at_lags(
    stamps_ns: np.ndarray,
    sites: np.ndarray,
    lags_ns: np.ndarray,
    exposures: Exposures,
    limit_m: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Return for each lag and detection of a view if the stage is known, and rests at its site."""
    if not len(sites):
        none = np.zeros((len(lags_ns), 0), dtype=bool)
        return none, none
    place, rests = exposures.rests(stamps_ns, lags_ns)
    known = np.isfinite(place)
    return known, known & rests & ~(np.abs(place - sites) > limit_m)


def _widened(fit: np.ndarray, width: int) -> np.ndarray:
    """Return which detections fit at a lag, or at one up to `width` rows from it."""
    wide = fit.copy()
    for by in range(1, width + 1):
        wide[by:] |= fit[:-by]
        wide[:-by] |= fit[by:]
    return wide


def _explained(here: np.ndarray, fit: np.ndarray) -> np.ndarray:
    """Return the part of the detections that fit at each lag; 0 where most have no samples."""
    count = here.sum(axis=1)
    enough = count > here.shape[1] / 2
    return np.where(enough, fit.sum(axis=1) / np.maximum(count, 1), 0.0)


def _run(good: np.ndarray, at: int) -> slice:
    """Return the rows around `at` in which `good` holds throughout."""
    bad = np.flatnonzero(~good)
    before, after = bad[bad < at], bad[bad > at]
    return slice(
        before[-1] + 1 if len(before) else 0, after[0] if len(after) else len(good)
    )
