# SPDX-License-Identifier: Apache-2.0
"""The eliminated normal matrix as a real matrix: the field folded into its four quadrants.

With G(X) = i^k h(X), k the quadrant of X, and likewise for marks, a reading whose mark and site
are as many quadrants apart as the view turns them joins h and A by the real number 1. Only a
shift across an axis leaves a factor i^g. The few sites of such readings are the cut:
each gets one real copy for every g, and copies are joined by i^g h(X) at the very end. The
rest of the elimination is real (method eq. 8.1).
"""

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from selfcal_ros.estimation.lattice.maps import PHASES, LatticeViews


@dataclass(frozen=True, eq=False)
class RealSymmetricForm:
    """The matrix M = P^H R P over the sites, with R real.

    Attributes
    ----------
    rows, columns : int array (entries,)
        Variables joined by an entry of R: the free sites, then the copies of the cut sites. R is
        symmetric, an entry may be in either triangle; duplicate entries are summed.
    values : float array (entries,)
        The entries.
    size : int
        Number of variables.
    free, cut : int array
        Sites without and with copies.
    copy_of : int array (copies,)
        Index of each copy's site in `cut`.
    copy_phase : complex array (copies,)
        i^g: copy = i^g h.
    phase : complex array (sites,)
        i^k: G = i^k h.
    pins : float array (cut,)
        Values added to the diagonal of the cut sites.
    """

    rows: np.ndarray
    columns: np.ndarray
    values: np.ndarray
    size: int
    free: np.ndarray
    cut: np.ndarray
    copy_of: np.ndarray
    copy_phase: np.ndarray
    phase: np.ndarray
    pins: np.ndarray


def fold(views: LatticeViews, weight: np.ndarray, relative_weight: np.ndarray,
         pins: np.ndarray) -> RealSymmetricForm:
    """Return the folded matrix of weighted readings.

    Parameters
    ----------
    views : LatticeViews
        Maps between sites and marks.
    weight, relative_weight : float array (views, nx, ny)
        Weight of each reading, and its share in the mean of its mark.
    pins : int array
        Sites whose diagonal is raised by the mean weight, because they are otherwise undetermined.
    """
    n_sites, read = weight[0].size, (weight > 0).reshape(len(weight), -1)
    quadrant = _quadrants(views.shape)
    index = views.site_index.reshape(len(weight), -1)
    turns = np.array([pose.q for pose in views.poses])[:, None]
    gain = (quadrant[index] - quadrant - turns) % 4
    is_cut = np.zeros(n_sites, dtype=bool)
    is_cut[index[read & (gain != 0)]] = True
    free, cut = np.flatnonzero(~is_cut), np.flatnonzero(is_cut)
    cut = cut[np.argsort(np.abs(views.z.ravel()[cut]), kind="stable")]
    place = np.empty(n_sites, dtype=np.int64)
    place[free], place[cut] = np.arange(len(free)), np.arange(len(cut))

    on_cut = read & is_cut[index]
    keys, copies = np.unique(place[index[on_cut]] * 4 + gain[on_cut], return_inverse=True)
    variable = place[index]
    variable[on_cut] = len(free) + copies
    mean = weight.sum() / max(np.count_nonzero(read), 1)
    size = len(free) + len(keys)
    diagonal = np.bincount(variable.ravel(), (weight * (1 - relative_weight)).ravel(),
                           minlength=size)
    diagonal[place[pins[~is_cut[pins]]]] += mean
    entries = _entries(variable, diagonal, weight.reshape(read.shape),
                       relative_weight.reshape(read.shape))
    cut_pins = np.zeros(len(cut))
    cut_pins[place[pins[is_cut[pins]]]] = mean
    return RealSymmetricForm(*entries, size, free, cut, keys // 4, PHASES[keys % 4],
                             PHASES[quadrant], cut_pins)


def _quadrants(shape: tuple[int, int]) -> np.ndarray:
    """Return k of every site, X = R^k o with o in the quadrant m > 0, n >= 0; the centre has 0."""
    hx, hy = (size // 2 for size in shape)
    m = np.repeat(np.arange(-hx, hx + 1), shape[1])
    n = np.tile(np.arange(-hy, hy + 1), shape[0])
    out = np.where((m <= 0) & (n > 0), 1, 0)
    out[(m < 0) & (n <= 0)] = 2
    out[(m >= 0) & (n < 0)] = 3
    return out


def _entries(variable: np.ndarray, diagonal: np.ndarray, weight: np.ndarray,
             relative_weight: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return rows, columns and values of one triangle of R."""
    rows, values = [np.arange(len(diagonal))], [diagonal]
    columns = rows.copy()
    for i, j in combinations(range(len(weight)), 2):
        both = np.flatnonzero((weight[i] > 0) & (weight[j] > 0))
        a, b = variable[i][both], variable[j][both]
        value = -weight[i][both] * relative_weight[j][both]
        rows.append(a)
        columns.append(b)
        # an entry and its mirror image may coincide on the diagonal
        values.append(np.where(a == b, 2 * value, value))
    return np.concatenate(rows), np.concatenate(columns), np.concatenate(values)
