# SPDX-License-Identifier: Apache-2.0
"""How far the readings of one kind check each other (leverage), each kind fitted by itself.

The leverage h of a reading is the share of it that the fit follows; its residual has the standard
deviation sigma sqrt((1 - h) / weight). For a grid reading of weight w in a mark of total weight W,
h = w (1/W + var(x - mean x)), with x the part of the model other than the plate's error. Its two
coordinates share a 2 x 2 matrix h + (a, b; b, -a): `skew` is a + ib, which rotations make.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import fdtrc

from selfcal_ros.estimation.normal.angular import FLOOR, MAX_FULL, AngularSystem
from selfcal_ros.estimation.normal.equations import (
    N_DRAWS,
    NormalEquations,
    angular_residuals,
    grid_residuals,
    noise_of,
)
from selfcal_ros.estimation.normal.grid import GridSystem

FEW_DRAWS = 16
"""Draws of noise where a sum over many readings is wanted: one draw tells it to a few per cent."""

FEW_OUTLIERS = 5
"""Outliers that are few: among repeats of a view no more may be chance, and a finding names as
many."""

CHECKED = 0.05
"""Smallest 1 - h of a reading that the others can check."""


@dataclass(frozen=True, eq=False)
class FitOfKind:
    """Readings of one kind, marks or lines, fitted by themselves.

    Attributes
    ----------
    kind : str
        ``grid`` or ``angular``.
    residual : complex array (views, nx, ny), float array (views, K)
        Residuals, plate frame, m; or those of lines, rad. 0 where not read.
    weight, redundancy : float array, of the same shape
        Weights, and 1 - h; 0 where not read.
    dof : float
        Degrees of freedom of the residuals.
    skew : complex array, of the same shape
        Difference of h between the coordinates of a mark, see above.
    """

    kind: str
    residual: np.ndarray
    weight: np.ndarray
    redundancy: np.ndarray
    dof: float
    skew: np.ndarray

    @property
    def coordinates(self) -> int:
        """Number of coordinates of a reading."""
        return 2 if self.kind == "grid" else 1

    @property
    def squares(self) -> np.ndarray:
        """Residual' (1 - h)^-1 residual weight, m^2 or rad^2: sigma^2 a coordinate on average.

        Reduction of the sum of squares without the reading; NaN where it cannot be checked.
        """
        skew = abs(self.skew)
        good = self.redundancy - skew > CHECKED
        determinant = np.where(good, self.redundancy**2 - skew**2, 1.0)
        numerator = self.redundancy * abs(self.residual) ** 2 + np.real(
            np.conj(self.skew) * self.residual**2
        )
        return np.where(good, numerator / determinant * self.weight, np.nan)

    def noise_without(self, at: tuple[int, ...], least: float = FLOOR) -> float:
        """Return the noise that the residuals show without one reading, at least `least`.

        NaN where the others do not check the reading, or have no noise to compare it with.
        """
        dof = self.dof - self.coordinates
        squares_of_others = float(
            (self.weight * abs(self.residual) ** 2).sum()
        ) - float(self.squares[at])
        is_checked = dof > 0 and np.isfinite(squares_of_others)
        return (
            max(float(np.sqrt(max(squares_of_others, 0.0) / dof)), least)
            if is_checked
            else float("nan")
        )

    def p_outlier(self, at: tuple[int, ...], least: float = FLOOR) -> float:
        """Return the probability that a good reading fits the others as badly; NaN if unknown.

        F-test of the reading's contribution to the sum of squares against the remainder.
        """
        n = self.coordinates
        noise = self.noise_without(at, least)
        return float(fdtrc(n, self.dof - n, self.squares[at] / n / noise**2))


def marks_alone(system: NormalEquations, y: np.ndarray, *, exact: bool) -> FitOfKind:
    """Return the grid readings y, complex (views, nx, ny), m, fitted by themselves."""
    redundancy, skew = (
        exact_leverage(system.grid, system.grid_inverse)
        if exact
        else (drawn_redundancy(system), np.zeros(y.shape))
    )
    return FitOfKind(
        kind="grid",
        residual=grid_residuals(system, y),
        weight=system.grid.weight,
        redundancy=redundancy,
        dof=system.dof_grid,
        skew=skew,
    )


def lines_alone(system: NormalEquations, y: np.ndarray) -> FitOfKind:
    """Return the readings of lines y, (views, K), rad, fitted by themselves."""
    return FitOfKind(
        kind="angular",
        residual=angular_residuals(system, y),
        weight=system.angular.weight,
        redundancy=angular_redundancy(system),
        dof=system.dof_angular,
        skew=np.zeros(y.shape),
    )


def exact_leverage(
    system: GridSystem | AngularSystem, misaligned: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return 1 - h and the skew of every reading of one kind, (views, *marks).

    `misaligned` is the covariance of the misalignments for unit noise of these readings alone.
    """
    weight = system.weight
    total = system.weight.sum(axis=0)
    inverse = system.solve(np.eye(system.n_sites))
    variance = np.zeros(weight.shape)
    for v in range(system.n_views):
        own_weight = -system.relative_weight
        own_weight[v] += 1
        for i in range(system.n_views):
            for j in range(system.n_views):
                variance[v] += np.real(
                    own_weight[i] * system.covariance(inverse, i, j) * own_weight[j]
                )
    maps = system.response.T.reshape(len(misaligned), *system.shape)
    basis = system.centred(
        system.misaligned(np.eye(len(misaligned))) - system.gather(maps)
    )
    answer = np.tensordot(misaligned, basis, axes=1)
    spread = (np.conj(basis) * answer).real.sum(axis=0) / system.coordinates
    h = weight * (1 / np.where(total > 0, total, 1.0) + (variance + spread))
    return (
        np.where(weight > 0, np.clip(1 - h, 0.0, 1.0), 0.0),
        weight * (basis * answer).sum(axis=0) / system.coordinates,
    )


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
    if angular.n_lines > MAX_FULL:
        mean = 1 - system.rank_angular / max(angular.n_readings, 1)
        return np.where(angular.read, mean, 0.0)
    return exact_leverage(angular, system.angular_inverse)[0]
