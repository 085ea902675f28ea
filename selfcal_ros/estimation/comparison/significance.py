# SPDX-License-Identifier: Apache-2.0
"""Whether two maps differ by more than their uncertainties: two tests, one verdict.

With d the difference without the datum, and C its covariance (both projected):

    Mahalanobis    d' C^+ d / rank, as F with the degrees of freedom of the noise; chi^2 if known
    largest |z|    max |d_i| / sqrt(C_ii), its distribution from seeded draws of C

The first detects a difference of any shape, the second one bad node in a large field. The verdict
is significant if either probability is below LEVEL / 2 (Bonferroni).
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc, fdtrc, stdtr, stdtrit

from selfcal_ros.model.statistics import MANY_DOF

LEVEL = 0.05
"""Probability that maps of the same stage differ significantly, both tests together."""

DRAWS = 2000
"""Draws of the largest |z|: fifty of them exceed its limit."""

NO_VARIANCE = 1e-9
"""Relative variance of a value or combination that the datum removes."""


@dataclass(frozen=True)
class Significance:
    """Test of a difference with the uncertainties of both maps.

    Attributes
    ----------
    chi2_ratio : float
        Square of the Mahalanobis distance over its degrees of freedom: 1 on average if the maps
        agree.
    dof : float
        Its degrees of freedom: combinations of nodes that are independent of the datum.
    p : float
        Probability of such a ratio if the maps agree.
    correlated : bool
        Whether the correlations between nodes are known; without them nodes are treated as
        independent, and p is approximate.
    largest_z : float
        Largest difference of a node on an axis (of a line) in standard uncertainties.
    z_limit : float
        Limit exceeded with the probability LEVEL / 2 if the maps agree.
    p_z : float
        Probability of such a `largest_z` if the maps agree.
    noise_dof : float
        Degrees of freedom of the noise behind both uncertainties; infinite if known.
    significant : bool
        The verdict of both tests.
    """

    chi2_ratio: float
    dof: float
    p: float
    correlated: bool
    largest_z: float = float("nan")
    z_limit: float = float("nan")
    p_z: float = float("nan")
    noise_dof: float = float("inf")
    significant: bool = False


def significance(values: np.ndarray, covariances: list[tuple[np.ndarray, bool]],
                 removed: np.ndarray, noise_dof: float) -> Significance | None:
    """Test values from which the columns `removed` were removed by least squares.

    Parameters
    ----------
    values : float array (n,)
        The difference.
    covariances : list
        For both maps: covariance (n, n), or variances (n,), and whether it is a full matrix.
    removed : float array (n, k)
        Columns that were fitted and subtracted.
    noise_dof : float
        Degrees of freedom of the noise.

    Returns
    -------
    Significance or None
        None without uncertainties to test against.
    """
    correlated = all(flag for _, flag in covariances)
    total = np.sum([covariance if correlated or covariance.ndim == 1 else np.diag(covariance)
                    for covariance, _ in covariances], axis=0)
    if not np.isfinite(total).all() or not total.any():
        return None
    q = np.linalg.qr(removed)[0]
    if correlated:
        total = total - q @ (q.T @ total)
        total = total - (total @ q) @ q.T
        variance = np.diag(total).copy()
    else:
        variance = total * (1 - (q**2).sum(axis=1))
    good = variance > NO_VARIANCE * variance.max()
    z = values[good] / np.sqrt(variance[good])
    if correlated:
        scale = np.sqrt(variance[good])
        square, dof, root = _mahalanobis(z, total[np.ix_(good, good)] / np.outer(scale, scale))
    else:
        square, dof, root = float(z @ z), float(max(len(z) - q.shape[1], 1)), None
    p = float(fdtrc(dof, noise_dof, square / dof) if noise_dof <= MANY_DOF
              else chdtrc(dof, square))
    largest = float(abs(z).max())
    p_z, limit = _of_largest(largest, len(z), root, noise_dof)
    return Significance(square / dof, dof, p, correlated, largest, limit, p_z, noise_dof,
                        min(p, p_z) < LEVEL / 2)


def _mahalanobis(z: np.ndarray, correlation: np.ndarray) -> tuple[float, float, np.ndarray]:
    """Return the squared distance, its degrees of freedom, and a root of the correlation."""
    values, vectors = np.linalg.eigh(correlation)
    told = values > NO_VARIANCE * values[-1]
    part = vectors[:, told].T @ z / np.sqrt(values[told])
    return float(part @ part), float(told.sum()), vectors[:, told] * np.sqrt(values[told])


def _of_largest(largest: float, n: int, root: np.ndarray | None,
                noise_dof: float) -> tuple[float, float]:
    """Return the probability of such a |z| among n values, and the limit of LEVEL / 2.

    The number of values bounds it (Bonferroni); draws give it for correlated nodes, except
    in the far tail, where the bound is close.
    """
    dof = min(noise_dof, MANY_DOF)
    bound = min(float(2 * n * stdtr(dof, -largest)), 1.0)
    limit = -float(stdtrit(dof, LEVEL / 4 / n))
    if root is None:
        return bound, limit
    rng = np.random.default_rng(0)
    drawn = abs(root @ rng.standard_normal((root.shape[1], DRAWS))).max(axis=0)
    if noise_dof <= MANY_DOF:
        drawn = drawn / np.sqrt(rng.chisquare(noise_dof, DRAWS) / noise_dof)
    above = int(LEVEL / 2 * (DRAWS + 1))
    p = (1 + np.count_nonzero(drawn >= largest)) / (1 + DRAWS)
    return min(bound, float(p)), min(limit, float(np.sort(drawn)[-above]))
