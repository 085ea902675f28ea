# SPDX-License-Identifier: Apache-2.0
"""Visits of grid marks: what terms of the model need and a mean over all repeats hides."""

import numpy as np

from selfcal_ros.collection.marks.repeats import Means, average
from selfcal_ros.model.readings import GridVisits


def grid_visits(means: Means, key: np.ndarray, sigma: np.ndarray, *, stamps_ns: np.ndarray,
                deviation: np.ndarray, offset: np.ndarray, approach: np.ndarray,
                ) -> GridVisits | None:
    """Return the visits behind the means of a view's grid marks; None without any.

    A visit is a run of successive exposures of one mark: any other mark that was exposed in
    between ends it, also one whose reading is an outlier. Outliers are in no visit. Deviations,
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
    """
    kept = ~means.outlier
    if not kept.any():
        return None
    number = np.cumsum(np.diff(key, prepend=key[:1]) != 0)[kept]
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
