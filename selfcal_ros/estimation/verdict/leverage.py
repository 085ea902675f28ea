# SPDX-License-Identifier: Apache-2.0
"""How far the readings of one kind check each other (leverage), each kind fitted by itself.

The leverage h of a reading is the share of it that the fit follows; its residual has the standard
deviation sigma sqrt((1 - h) / weight). For a grid reading of weight w in a mark of total weight W,
h = w (1/W + var(x - mean x)), with x the part of the model other than the plate's error. Its two
coordinates share a 2 x 2 matrix h + (a, b; b, -a): `skew` is a + ib, which rotations make.
"""

from collections.abc import Callable

import numpy as np

from selfcal_ros.estimation.normal.angular import AngularSystem
from selfcal_ros.estimation.normal.equations import NormalEquations, grid_residuals
from selfcal_ros.estimation.normal.grid import GridSystem

EXACT_SITES = 31 * 31
"""Largest field whose leverages are computed exactly; in larger ones from seeded draws."""

EXACT_LINES = 2048
"""Largest number of lines whose leverages are computed exactly; otherwise all have their mean."""

N_DRAWS = 64
"""Draws of unit noise for a larger field: 9 % standard error of a residual's variance."""

CHECKED = 0.05
"""Smallest 1 - h of a reading that the others can check."""


def exact_leverage(system: NormalEquations) -> tuple[np.ndarray, np.ndarray]:
    """Return 1 - h and the skew of every grid reading, (views, nx, ny)."""
    grid = system.grid
    inverse = grid.factor.solve(np.eye(grid.n_sites, dtype=complex))
    index = np.maximum(grid.views.site_index, 0)
    basis = np.array([grid.centred(grid.views.gather(-column.reshape(grid.views.shape))
                                   + grid.misaligned(unit)) for column, unit in
                      zip(grid.response.T, np.eye(3 * grid.n_views), strict=True)])
    answer = np.einsum("pq,qvij->pvij", system.grid_inverse, basis)
    skew = np.einsum("pvij,pvij->vij", basis, answer) / 2
    return _redundancy(grid, grid.views.phases.conj(), lambda i, j: inverse[index[i], index[j]],
                       np.einsum("pvij,pvij->vij", np.conj(basis), answer).real / 2), (
        grid.weight * skew)


def _redundancy(part: GridSystem | AngularSystem, turns: np.ndarray,
                entry: Callable[[int, int], np.ndarray], spread: np.ndarray) -> np.ndarray:
    """Return 1 - h of every reading of one kind.

    Parameters
    ----------
    part : GridSystem or AngularSystem
        The readings.
    turns : array (views,)
        Factors from the map to the readings of each view.
    entry : callable
        Covariances of the map at the places of each mark in one and another view.
    spread : float array (views, ...)
        Variance of the readings that the misalignments of the views make.
    """
    weight, total = part.weight, part.weight.sum(axis=0)
    variance = np.zeros(weight.shape)
    for v in range(part.n_views):
        own = -part.relative_weight * turns.reshape(-1, *[1] * total.ndim)
        own[v] += turns[v]
        for i in range(part.n_views):
            for j in range(part.n_views):
                variance[v] += np.real(own[i] * entry(i, j) * np.conj(own[j]))
    h = weight * (1 / np.where(total > 0, total, 1.0) + (variance + spread))
    return np.where(weight > 0, np.clip(1 - h, 0.0, 1.0), 0.0)


def drawn_redundancy(system: NormalEquations) -> np.ndarray:
    """Return 1 - h of every grid reading from the residuals of seeded unit noise."""
    grid = system.grid
    rng = np.random.default_rng(0)
    total = np.zeros(grid.weight.shape)
    for _ in range(N_DRAWS):
        residuals = grid_residuals(system, noise_of(rng, total.shape, grid.weight))
        total += abs(residuals) ** 2 * grid.weight
    return np.where(grid.read, np.minimum(total / (2 * N_DRAWS), 1.0), 0.0)


def angular_redundancy(system: NormalEquations) -> np.ndarray:
    """Return 1 - h of every angular reading, (views, K), with rotations from the lines alone."""
    angular = system.angular
    if not angular.n_views:
        return np.zeros(angular.weight.shape)
    if angular.n_lines > EXACT_LINES:
        mean = 1 - system.rank_angular / max(angular.n_readings, 1)
        return np.where(angular.read, mean, 0.0)
    inverse = angular.solve(np.eye(angular.n_lines))
    basis = np.array([angular.centred(unit[:, None] - angular.gather(column)) for column, unit in
                      zip(angular.response.T, np.eye(angular.n_views), strict=True)])
    return _redundancy(angular, np.ones(angular.n_views),
                       lambda i, j: angular.covariance(inverse, i, j),
                       np.einsum("pvk,pq,qvk->vk", basis, system.angular_inverse, basis))


def noise_of(rng: np.random.Generator, shape: tuple[int, ...], weight: np.ndarray) -> np.ndarray:
    """Return noise of variance 1 / weight on each axis, complex `shape`; 0 where weight is 0."""
    root = np.sqrt(np.where(weight > 0, weight, 1.0))
    both = rng.standard_normal((2, *shape)) / root * (weight > 0)
    return both[0] + 1j * both[1]
