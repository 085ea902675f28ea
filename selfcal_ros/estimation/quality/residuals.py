# SPDX-License-Identifier: Apache-2.0
"""Residuals with their leverage, the share of a reading that the fit follows; noisy views.

The leverage h of a reading is the share of it that the fit follows; its residual has the standard
deviation sigma sqrt((1 - h) / weight). For a grid reading of weight w in a mark of total weight W,
h = w (1/W + var(x - mean x)), with x the part of the model other than the plate's error. Its two
coordinates share a 2 x 2 matrix h + (a, b; b, -a): `skew` is a + ib, which rotations make.

Grid and angular readings are fitted separately here, so that the sums of squares of each kind have
exactly known distributions. Views noisier than the others are found by their own repeats and by
their residuals.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import nnls
from scipy.special import fdtrc

from selfcal_ros.estimation.joint.fit import JointFit, fit
from selfcal_ros.estimation.joint.problem import FLOOR, Problem
from selfcal_ros.estimation.joint.solve import prepare
from selfcal_ros.estimation.normal.angular import AngularSystem
from selfcal_ros.estimation.normal.equations import (
    NormalEquations,
    angular_residuals,
    grid_residuals,
)
from selfcal_ros.estimation.normal.grid import GridSystem
from selfcal_ros.estimation.normal.systems import Memo
from selfcal_ros.estimation.options import Options
from selfcal_ros.estimation.quality.prediction import noise_of
from selfcal_ros.estimation.verdict.causes import noisier_views
from selfcal_ros.model.readings import Measurements

EXACT_SITES = 31 * 31
"""Largest field whose leverages are computed exactly; in larger ones from seeded draws."""

EXACT_LINES = 2048
"""Largest number of lines whose leverages are computed exactly; otherwise all have their mean."""

N_DRAWS = 64
"""Draws of unit noise for a larger field: 9 % standard error of a residual's variance."""

VIEW_DRAWS = 16
"""Draws of unit noise in each view, to separate the noises of the views."""

CHECKED = 0.05
"""Smallest 1 - h of a reading that the others can check."""


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residuals of all readings.

    Attributes
    ----------
    problem : Problem
        The plan and its readings.
    found : JointFit
        Joint fit of the readings.
    redundancy, redundancy_theta : float array (views, nx, ny), (views, K)
        1 - h; 0 where not read.
    skew : complex array (views, nx, ny)
        Difference of h between the coordinates, see above.
    """

    problem: Problem
    found: JointFit
    redundancy: np.ndarray
    redundancy_theta: np.ndarray
    skew: np.ndarray

    @property
    def squares(self) -> np.ndarray:
        """Residual' (1 - h)^-1 residual weight, m^2, (views, nx, ny): 2 sigma^2 on average.

        Reduction of the sum of squares without the reading; NaN where it cannot be checked.
        """
        residual, skew = self.found.residuals, abs(self.skew)
        good = self.redundancy - skew > CHECKED
        both = np.where(good, self.redundancy**2 - skew**2, 1.0)
        form = (self.redundancy * abs(residual) ** 2
                + np.real(np.conj(self.skew) * residual**2))
        return np.where(good, form / both * self.problem.grid.weight, np.nan)

    @property
    def squares_theta(self) -> np.ndarray:
        """The same for angular readings, rad^2, (views, K); sigma^2 on average."""
        return _scaled(self.found.residuals_theta**2, self.problem.angular.weight,
                       self.redundancy_theta)

    def p_outlier(self, kind: str, at: tuple[int, ...]) -> float:
        """Return the probability that a good reading fits the others as badly; NaN if unknown.

        F-test of the reading's contribution to the sum of squares against the remainder.
        """
        if kind == "grid":
            system, squares, weight, residual, columns = (
                self.problem.system, self.squares, self.problem.grid.weight,
                abs(self.found.residuals), 2)
            dof = 2 * system.grid.n_readings - system.rank_grid
        else:
            system, squares, weight, residual, columns = (
                self.problem.system, self.squares_theta, self.problem.angular.weight,
                self.found.residuals_theta, 1)
            dof = system.angular.n_readings - system.rank_angular
        rest = float((weight * residual**2).sum()) - float(squares[at])
        if not np.isfinite(rest) or dof <= columns:
            return float("nan")
        noise = max(rest / (dof - columns), FLOOR**2)
        return float(fdtrc(columns, dof - columns, squares[at] / columns / noise))


def _scaled(squares: np.ndarray, weight: np.ndarray, redundancy: np.ndarray) -> np.ndarray:
    good = redundancy > CHECKED
    return np.where(good, squares * weight / np.where(good, redundancy, 1.0), np.nan)


def residuals_of(measurements: Measurements, options: Options) -> Residuals:
    """Fit the readings jointly and return their residuals with redundancies."""
    problem, _ = prepare(measurements, options)
    system = problem.system
    found = replace(fit(problem, problem.grid.y), residuals=grid_residuals(system, problem.grid.y),
                    residuals_theta=angular_residuals(system, problem.angular.y))
    if system.grid.n_sites <= EXACT_SITES and measurements.artifact.map_grid is None:
        redundancy, skew = exact_leverage(system)
    else:
        redundancy = drawn_redundancy(system)
        skew = np.zeros(redundancy.shape, dtype=complex)
    return Residuals(problem, found, redundancy, angular_redundancy(system), skew)


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


def view_noise(residuals: Residuals) -> np.ndarray:
    """Return the noise of each grid view and of the others, m, and its degrees of freedom.

    The residuals of one view contain the noise of all. Their sums of squares are separated with
    those that seeded unit noise of each view leaves in each (Helmert's variance components, two at
    a time). Twice the inverse of that mixing is the covariance of two variances that are 1.

    Returns
    -------
    float array (views, 3)
    """
    system, grid = residuals.problem.system, residuals.problem.system.grid
    mixing = _mixings.get(system, None, lambda: _mixing(system))
    sums = (abs(residuals.found.residuals) ** 2 * grid.weight).sum(axis=(1, 2))
    out = np.empty((grid.n_views, 3))
    for v in range(grid.n_views):
        group = np.zeros((grid.n_views, 2))
        group[:, 1], group[v] = 1.0, (1.0, 0.0)
        normal = group.T @ mixing @ group
        out[v, :2] = np.sqrt(nnls(normal, group.T @ sums)[0])
        out[v, 2] = normal[0, 0] - normal[0, 1] ** 2 / max(normal[1, 1], 1e-300)
    return out


_mixings: Memo[None, np.ndarray] = Memo()


def _mixing(system: NormalEquations) -> np.ndarray:
    """Return the sum of squares that unit noise of each view leaves in each, (views, views)."""
    grid, rng = system.grid, np.random.default_rng(0)
    mixing = np.zeros((grid.n_views, grid.n_views))
    for u in range(grid.n_views):
        for _ in range(VIEW_DRAWS):
            noise = np.zeros(grid.weight.shape, dtype=complex)
            noise[u] = noise_of(rng, noise[u].shape, grid.weight[u])
            rest = grid_residuals(system, noise)
            mixing[:, u] += (abs(rest) ** 2 * grid.weight).sum(axis=(1, 2)) / VIEW_DRAWS
    return (mixing + mixing.T) / 2


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


NOISY_RESIDUALS = 3.0
"""Ratio of a view's noise to that of the others, by residuals, above which it is noisy."""

MIN_VIEW_DOF = 5.0
"""Smallest degrees of freedom of a view's own noise for the test by residuals."""

MAX_RATIO = 20.0
"""Largest ratio of noises that residuals can show: a noisy view hides the noise of the others."""


def noisy_views(residuals: Residuals, measurements: Measurements
                ) -> tuple[tuple[str, float], ...]:
    """Return the noisy views, each with the ratio of its noise to that of the others."""
    found = by_repeats(measurements)
    for name, ratio in _by_residuals(residuals, measurements).items():
        found[name] = max(ratio, found.get(name, 0.0))
    return tuple((view.view.name, found[view.view.name]) for view in measurements.views
                 if view.view.name in found)


def by_repeats(measurements: Measurements) -> dict[str, float]:
    """Return the views whose repeats scatter more than those of the others (F-test)."""
    return {cause.view: cause.size for cause in noisier_views([
        (v.view.name, v.sigma_xy, v.dof_xy) for v in measurements.views
        if len(v.m) and v.dof_xy > 0 and np.isfinite(v.sigma_xy)])}


def _by_residuals(residuals: Residuals, measurements: Measurements) -> dict[str, float]:
    if residuals.problem.system.grid.n_views < 2:
        return {}
    out = {}
    for index, (own, others, dof) in zip(residuals.problem.grid.index, view_noise(residuals),
                                         strict=True):
        ratio = float(own / max(others, own / MAX_RATIO, FLOOR))
        if ratio > NOISY_RESIDUALS and dof >= MIN_VIEW_DOF:
            out[measurements.views[index].view.name] = ratio
    return out
