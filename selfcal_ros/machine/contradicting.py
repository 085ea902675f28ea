# SPDX-License-Identifier: Apache-2.0
"""Why visits of the same marks contradict each other: backlash, lost steps, a plate that slips."""

from dataclasses import dataclass

import numpy as np

from selfcal_ros.model.readings import GridVisits
from selfcal_ros.units import UM_PER_M

EXPLAINED = 0.8
"""Part of the variance about the marks' means that a cause has to explain to be named."""
LEAST_VISITS = 6
"""Visits beyond the first one of each mark, below which nothing is named."""


@dataclass(frozen=True, order=True)
class Contradiction:
    """A cause, the part of the variance that it explains, and a remedy."""

    explained: float
    what: str
    remedy: str


def contradiction(visits: GridVisits) -> Contradiction | None:
    """Return why visits of a mark differ; None if no cause explains them.

    Parameters
    ----------
    visits : GridVisits
        All visits of a view, outliers included.
    """
    _, mark = np.unique(visits.mark, return_inverse=True)
    if len(mark) < mark.max(initial=0) + 1 + LEAST_VISITS:
        return None
    order = np.argsort(visits.stamp_ns)
    deviations_m = _about_means(np.stack([visits.dx, visits.dy]), mark)
    likeliest = max(
        _reversal(visits, deviations_m, mark),
        _jump(order, deviations_m, mark),
        _running(visits, deviations_m, mark),
    )
    return likeliest if likeliest.explained > EXPLAINED else None


def _about_means(values: np.ndarray, mark: np.ndarray) -> np.ndarray:
    """Return values (..., V) less the mean of their mark."""
    sums = np.stack([np.bincount(mark, row) for row in np.atleast_2d(values)])
    return values - (sums / np.bincount(mark))[:, mark].reshape(values.shape)


def _fitted(cause: np.ndarray, deviations_m: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the slopes (2,) of x and y on a cause (2, V), and the part that they explain."""
    weight = (cause**2).sum(axis=1)
    product = (cause * deviations_m).sum(axis=1)
    slope = np.divide(product, weight, out=np.zeros(2), where=weight > 0)
    total = (deviations_m**2).sum()
    return slope, float((slope * product).sum() / total) if total else 0.0


def _reversal(
    visits: GridVisits, deviations_m: np.ndarray, mark: np.ndarray
) -> Contradiction:
    signs = np.stack([visits.approach_x, visits.approach_y]).astype(float)
    slope, explained = _fitted(_about_means(signs, mark), deviations_m)
    x, y = np.abs(2 * slope) * UM_PER_M
    return Contradiction(
        explained,
        f"marks approached from + and from - lie {x:.3g} µm apart in x and {y:.3g} µm "
        "in y: backlash",
        "take up the play, or have all marks approached from one side",
    )


def _jump(
    order: np.ndarray, deviations_m: np.ndarray, mark: np.ndarray
) -> Contradiction:
    """Return the best single jump between two visits."""
    best = Contradiction(0.0, "", "")
    later = np.ones(len(order))
    for number, row in enumerate(order[:-1]):
        later[row] = 0.0
        slope, explained = _fitted(
            np.tile(_about_means(later, mark), (2, 1)), deviations_m
        )
        if explained > best.explained:
            x, y = slope * UM_PER_M
            best = Contradiction(
                explained,
                f"from visit {number + 2} on all marks lie {x:+.3g} µm in x and "
                f"{y:+.3g} µm in y from where they were: steps were lost, or the plate or the "
                "camera has slipped",
                "fasten plate and camera, move more slowly, home the stage",
            )
    return best


def _running(
    visits: GridVisits, deviations_m: np.ndarray, mark: np.ndarray
) -> Contradiction:
    time_ns = visits.stamp_ns - visits.stamp_ns.min()
    time = time_ns / max(int(time_ns.max()), 1)
    slope, explained = _fitted(np.tile(_about_means(time, mark), (2, 1)), deviations_m)
    x, y = slope * UM_PER_M
    return Contradiction(
        explained,
        f"the marks run away by {x:+.3g} µm in x and {y:+.3g} µm in y over the view",
        "see whether the stage loses steps, or plate, camera or temperature drift",
    )
