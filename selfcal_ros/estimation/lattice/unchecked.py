# SPDX-License-Identifier: Apache-2.0
"""Sites that depend on readings which no other reading checks."""

import numpy as np


def rest_on_one(site: np.ndarray, mark: np.ndarray, *, n_sites: int, n_marks: int) -> np.ndarray:
    """Return the sites whose error is known from single readings only, bool (sites,).

    A reading that is the only one of a site gives the site's error, and the only one of a mark
    gives the mark's: the fit follows it fully (1 - h = 0, method eq. 4.10), and no residual shows
    its error. Such readings carry no information on other sites and are removed, after which
    others may be the last of a site or mark; this is repeated until each remaining site and mark
    has two or more. Sites without remaining readings depend on single readings.

    Parameters
    ----------
    site, mark : int arrays (readings,)
        Site and mark joined by each reading: one per mark and view, whatever its repeats.
    n_sites, n_marks : int
        Number of sites and marks.
    """
    ends = np.stack([site, mark + n_sites])
    number = np.broadcast_to(np.arange(len(site)), ends.shape)
    left = np.bincount(ends.ravel(), minlength=n_sites + n_marks)
    # for a node with one reading left this sum is the index of that reading
    total = np.bincount(ends.ravel(), number.ravel(), n_sites + n_marks).astype(np.int64)
    read = left[:n_sites] > 0
    last = np.flatnonzero(left == 1)
    while len(last):
        off = np.unique(total[last])
        at = ends[:, off].ravel()
        np.subtract.at(left, at, 1)
        np.subtract.at(total, at, np.tile(off, 2))
        last = np.unique(at[left[at] == 1])
    return read & (left[:n_sites] == 0)
