# SPDX-License-Identifier: Apache-2.0
"""What is to be fitted, and how its two kinds of readings weigh against each other."""

from dataclasses import dataclass

import numpy as np

from selfcal_ros.estimation.datum.angular import Conditions
from selfcal_ros.estimation.joint.noise import (
    MIN_REPEAT_DOF,
    NoiseEstimate,
    noise_estimate,
    pooled,
)
from selfcal_ros.estimation.lattice.readings import AngularData, GridData
from selfcal_ros.estimation.normal.equations import NormalEquations
from selfcal_ros.estimation.options import ReferenceLength
from selfcal_ros.estimation.terms.ground import Ground
from selfcal_ros.estimation.terms.visits import between_visits
from selfcal_ros.model.readings import Measurements
from selfcal_ros.model.terms import DRIFT_DEGREE, ModelTerm

ROUNDING = 16 * np.finfo(float).eps
"""Noise below this part of the largest deviation is rounding."""

FLOOR = 1e-13
"""Noise, m or rad, that is rounding and not tested."""

NO_NOISE = float(np.sqrt(np.finfo(float).tiny))
"""Noise that stands for none: its square is still a number."""

MAX_WEIGHT = 1e8
"""Largest weight of one kind of readings against the other, all together: beyond, the lighter one
would be lost in the rounding of the heavier, and with it the rotations that only it determines."""


@dataclass(frozen=True, eq=False)
class Problem:
    """What is to be fitted.

    Attributes
    ----------
    system : NormalEquations
        The measured plan.
    grid, angular : GridData, AngularData
        The readings.
    repeats_xy, repeats_theta : tuple
        (sigma, degrees of freedom) from the scatter of repeats.
    half_width_m : float
        Unit of the system's positions, m.
    conditions : Conditions
        Angular datum.
    direct : bool
        Whether the sites are factorised rather than iterated.
    reference : ReferenceLength, optional
        What sets the scale.
    rigid : bool
        Whether the plate turns by finite angles, or as in the papers' linear form.
    terms : tuple of ModelTerm
        Terms of the model beside stage, plate and misalignments.
    drift_degree : int
        Degree of a drift's polynomial.
    residuals_xy : tuple, optional
        (sigma, degrees of freedom) of the residuals where they are not those of the grid alone:
        after terms were taken off.
    """

    system: NormalEquations
    grid: GridData
    angular: AngularData
    repeats_xy: tuple[float, float]
    repeats_theta: tuple[float, int]
    half_width_m: float
    conditions: Conditions
    direct: bool
    ground: Ground
    reference: ReferenceLength | None = None
    rigid: bool = True
    terms: tuple[ModelTerm, ...] = ()
    drift_degree: int = DRIFT_DEGREE
    residuals_xy: tuple[float, float] | None = None


@dataclass(frozen=True, eq=False)
class AngularPart:
    """Angular equations with stage lines eliminated: M^-1 b, right side of phi, noise."""

    free: np.ndarray
    d: np.ndarray
    noise: NoiseEstimate


@dataclass(frozen=True, eq=False)
class FreeNetworkSolution:
    """A solution in no particular datum; `xy` is None where it is yet to be taken from it.

    `ratio` is the weight of an angular reading against a grid reading, 0 without angular ones.
    """

    field: np.ndarray
    parameters: np.ndarray
    xy: NoiseEstimate | None
    inverse: np.ndarray
    solver: dict
    ratio: float = 0.0


def repeats_of(measurements: Measurements) -> tuple[tuple[float, int], tuple[float, int]]:
    """Return pooled (sigma, degrees of freedom) of the repeats, grid and angular."""
    views = measurements.views
    return (between_visits(measurements, MIN_REPEAT_DOF) or pooled(
                (v.sigma_xy, v.dof_xy) for v in views if len(v.m)),
            pooled((v.sigma_theta, v.dof_theta) for v in views if len(v.k)))


def grid_noise(problem: Problem, residual: np.ndarray) -> NoiseEstimate:
    """Return the noise of the grid readings, given their residuals (views, nx, ny)."""
    if problem.residuals_xy is not None:
        return noise_estimate(problem.repeats_xy, problem.residuals_xy, problem.grid.sigma_declared,
                     floor=FLOOR)
    grid = problem.system.grid
    dof = grid_dof(problem)
    total = float((grid.weight * (residual.real**2 + residual.imag**2)).sum())
    return noise_estimate(problem.repeats_xy, sigma_of(total, dof), problem.grid.sigma_declared,
                 floor=FLOOR)


def grid_dof(problem: Problem) -> int:
    """Return the degrees of freedom of the grid residuals without terms."""
    return 2 * problem.system.grid.n_readings - problem.system.rank_grid


def sigma_of(total: float, dof: float) -> tuple[float, float]:
    """Return (sigma, dof) of a weighted sum of squares (method eq. 4.7)."""
    return (float(np.sqrt(total / dof)), dof) if dof > 0 else (float("nan"), 0)


def weight_ratio(problem: Problem, sigma_xy: float, sigma_theta: float, y: np.ndarray) -> float:
    """Return the weight of an angular reading against a grid reading, in misalignment units.

    Without both noises, an angular reading counts like a grid reading at the half width.
    """
    if not (np.isfinite(sigma_xy) and np.isfinite(sigma_theta)):
        return 1.0
    sigma_xy = max(sigma_xy, ROUNDING * float(np.abs(y).max()))
    peak = float(np.abs(problem.angular.y).max())
    sigma_theta = max(sigma_theta, ROUNDING * peak)
    return bounded_ratio(problem.system, sigma_xy, sigma_theta, problem.half_width_m)


def bounded_ratio(system: NormalEquations, sigma_xy: float, sigma_theta: float,
                  half_width_m: float) -> float:
    """Return the weight of an angular reading against a grid reading, within what rounding bears.

    Parameters
    ----------
    system : NormalEquations
        With angular views.
    sigma_xy, sigma_theta : float
        Noise of one reading, m and rad; 1 where either is not known.
    half_width_m : float
        Unit of the system's positions, m.
    """
    if not (np.isfinite(sigma_xy) and np.isfinite(sigma_theta)):
        return 1.0
    sigma_xy, sigma_theta = max(sigma_xy, NO_NOISE), max(sigma_theta, NO_NOISE)
    ratio = (sigma_xy / (sigma_theta * half_width_m)) ** 2  # method eq. 4.2
    equal = system.grid_scale / system.angular_scale
    return float(np.clip(ratio, equal / MAX_WEIGHT, equal * MAX_WEIGHT))
