# SPDX-License-Identifier: Apache-2.0
"""What a mean over all repeats of a mark hides: its visits, and how offsets follow the stage."""

import numpy as np

from selfcal_ros.collection.marks.repeats import Means, average
from selfcal_ros.model.readings import GridVisits, RepeatMotion

SLOW = 5
"""Degree of the polynomial of the order of the readings that is taken out of their changes."""
FOLLOWS = 3.0
"""Change of the deviation over that of the stage's position up to which an outlier among repeats
may come of the microscope's wiring: reversed offsets make 2 of it, doubled ones 1."""


def grid_visits(means: Means, key: np.ndarray, sigma: np.ndarray, *, stamps_ns: np.ndarray,
                deviation: np.ndarray, offset: np.ndarray, approach: np.ndarray,
                step_m: float = np.inf) -> GridVisits | None:
    """Return the visits behind the means of a view's grid marks; None without any.

    A visit is a run of successive exposures of one mark: any other mark that was exposed in
    between ends it, also one whose reading is an outlier, and so does a motion of the stage beyond
    `step_m`, as from one check stop to the next. Outliers are in no visit. Deviations,
    offsets and instants of a visit are averaged with the weights of `reduce_repeats`. The approach
    is the one that all its exposures have in common, 0 where they differ.

    Parameters
    ----------
    means : Means
        What `reduce_repeats` made of the same readings.
    key : int array (n,)
        Number of the mark of each reading, in the order of the stamps.
    sigma : float array (n,)
        Declared standard uncertainties, m; 0 = not declared.
    stamps_ns : int64 array (n,)
        Instants of exposure.
    deviation, offset : float array (2, n)
        Deviation and offset as seen, stage axes, m.
    approach : int8 array (2, n)
        Signs of the last motions of x and y.
    step_m : float
        Motion of the stage along an axis that ends a visit, m.
    """
    kept = ~means.outlier
    if not kept.any():
        return None
    moved = np.abs(np.diff(deviation - offset, prepend=(deviation - offset)[:, :1])) > step_m
    number = np.cumsum((np.diff(key, prepend=key[:1]) != 0) | moved.any(axis=0))[kept]
    key, stamps_ns = key[kept], stamps_ns[kept]
    begins = np.diff(number, prepend=-1) != 0
    first, visit = np.flatnonzero(begins), np.cumsum(begins) - 1
    since = (stamps_ns - stamps_ns[first][visit]).astype(float)
    found = average(visit, deviation[:, kept], sigma[kept], np.vstack([offset[:, kept], since]))
    mark = np.searchsorted(means.key, key[first])
    order = np.argsort(mark, kind="stable")  # the numbers of visits rise with their stamps
    offset_x, offset_y, since = found.companions[:, order]
    came_x, came_y = (
        np.where(_differs(row[kept], visit, first), 0, row[kept][first]).astype(np.int8)[order]
        for row in approach)
    return GridVisits(
        mark[order], found.mean[0, order], found.mean[1, order], found.count[order],
        stamps_ns[first][order] + np.rint(since).astype(np.int64), offset_x, offset_y, came_x,
        came_y, u=found.u[order] if len(found.u) else found.u, sigma_m=found.sigma, dof=found.dof)


def _differs(values: np.ndarray, visit: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Return which visits hold more than one value, bool array (visits,)."""
    return np.bincount(visit, values != values[first][visit], len(first)) > 0


def repeat_motion(key: np.ndarray, place: np.ndarray, offset: np.ndarray,
                  outlier: np.ndarray) -> RepeatMotion | None:
    """Return how the offsets of the marks follow the stage; None without repeats.

    Outliers are left out unless the stage stood elsewhere too: offsets of the wrong sign or scale
    make an outlier of every stop beside a mark. What changes slowly, as a drift that the stage
    follows, is no response of the microscope: a polynomial is taken out, then neighbours are
    subtracted.

    Parameters
    ----------
    key : int array (n,)
        Number of the mark of each reading, in the order of the stamps.
    place, offset : float array (c, n)
        Place of the optical axis over the plate, and offset of the mark from it, m or rad.
    outlier : bool array (n,)
        Outliers among the repeats.
    """
    if outlier.any():
        there, seen = _about_means(key, place), _about_means(key, offset)
        follows = ((there + seen) ** 2).sum(axis=0) <= FOLLOWS**2 * (there**2).sum(axis=0)
        keep = ~outlier | follows
        key, place, offset = key[keep], place[:, keep], offset[:, keep]
    free = len(key) - int(np.count_nonzero(np.bincount(key))) - SLOW
    if free <= 0:
        return None
    about = np.concatenate([_about_means(key, place), _about_means(key, offset)])
    slow = _about_means(key, np.polynomial.legendre.legvander(
        np.linspace(-1, 1, len(key)), SLOW)[:, 1:].T)
    change = np.diff(about - np.linalg.lstsq(slow @ slow.T, slow @ about.T)[0].T @ slow)
    return RepeatMotion(change @ change.T / 2, 2 * free // 3)  # neighbours share a reading


def _about_means(key: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return values (c, n) less the mean of their mark."""
    first, count = np.zeros(key.max() + 1, dtype=int), np.bincount(key)
    first[key[::-1]] = np.arange(len(key))[::-1]  # of equal ones the last that is set stays
    values = values - values[:, first[key]]  # exact where repeats are equal
    return values - np.stack([np.bincount(key, row) for row in values])[:, key] / count[key]
