# SPDX-License-Identifier: Apache-2.0
"""The joint least squares of one set of readings (method, sections 2-4)."""

from dataclasses import dataclass

import numpy as np

from selfcal_ros.estimation.noise import Level, level, pooled
from selfcal_ros.estimation.readings_data import AngularData, GridData
from selfcal_ros.estimation.system import JointSystem
from selfcal_ros.estimation.theta import Conditions
from selfcal_ros.model.readings import Measurements

ROUNDING = 16 * np.finfo(float).eps
"""Noise below this part of the largest deviation is rounding."""


@dataclass(frozen=True, eq=False)
class Fit:
    """A solution in its datum, in the frame of the equations (H for ``plate_moves``).

    Attributes
    ----------
    field, plate : complex array (nx, ny)
        G and A, m.
    residuals : complex array (views, nx, ny)
        Grid residuals in the plate frame, m; 0 where not read.
    parameters : float array (size,)
        Misalignments as in `JointSystem`: phi times the half width, tau; m.
    g_theta, a_theta : float array (K,)
        Angular maps, rad.
    residuals_theta : float array (views, K)
        Angular residuals, rad.
    misclosure : float array (conditions,)
        Slopes less Gtheta before the angular datum was applied, rad.
    xy, theta : Level
        Noise of the grid and of the angular readings.
    inverse : float array (size, size)
        Covariance of the misalignments for unit grid noise.
    """

    field: np.ndarray
    plate: np.ndarray
    residuals: np.ndarray
    parameters: np.ndarray
    g_theta: np.ndarray
    a_theta: np.ndarray
    residuals_theta: np.ndarray
    misclosure: np.ndarray
    xy: Level
    theta: Level
    inverse: np.ndarray


@dataclass(frozen=True, eq=False)
class Problem:
    """What is to be fitted.

    Attributes
    ----------
    system : JointSystem
        The measured plan.
    grid, angular : GridData, AngularData
        The readings.
    repeats_xy, repeats_theta : tuple
        (sigma, degrees of freedom) from the scatter of repeats.
    half_width_m : float
        Unit of the system's positions, m.
    conditions : Conditions
        Angular datum.
    """

    system: JointSystem
    grid: GridData
    angular: AngularData
    repeats_xy: tuple[float, int]
    repeats_theta: tuple[float, int]
    half_width_m: float
    conditions: Conditions


def repeats_of(measurements: Measurements) -> tuple[tuple[float, int], tuple[float, int]]:
    """Return pooled (sigma, degrees of freedom) of the repeats, grid and angular."""
    views = measurements.views
    return (pooled((v.sigma_xy, v.dof_xy) for v in views if len(v.m)),
            pooled((v.sigma_theta, v.dof_theta) for v in views if len(v.k)))


def fit(problem: Problem, y: np.ndarray) -> Fit:
    """Return the joint least-squares solution.

    Each kind of readings is first fitted alone, for its noise; the two noises then weigh them
    against each other in the views' rotations, which both see.

    Parameters
    ----------
    problem : Problem
        The plan and its readings.
    y : complex array (views, nx, ny)
        Grid deviations in the plate frame, m.
    """
    system, grid, angular = problem.system, problem.system.grid, problem.system.angular
    n, length = 3 * grid.n_views, problem.half_width_m
    free, d = grid.reduced(y)
    xy = _grid_level(problem, y, free=free, d=d)
    theta_free, theta_d, theta = _angular_level(problem)
    ratio = weight_ratio(problem, xy.sigma, theta.sigma, y)
    right = np.zeros(system.size)
    right[:n] = d
    right[system.phi_at] += ratio * length * theta_d
    inverse = system.inverse(ratio)
    parameters = inverse @ right
    field = (free - grid.response @ parameters[:n]).reshape(grid.views.shape)

    parts = system.gauge.parts(field)
    field = system.gauge.remove(field, parts)
    parameters = parameters - parts @ system.rigid[:4]
    plate, residuals = grid.plate(y, field, parameters[:n])
    plate_parts = system.plate_gauge.parts(plate)
    plate = system.plate_gauge.remove(plate, plate_parts)
    parameters = parameters - plate_parts @ system.rigid[4:]

    conditions = problem.conditions
    phi = parameters[system.phi_at] / length
    g_theta = theta_free - angular.response @ phi
    slopes = np.einsum("cij,ij->c", conditions.slopes.conj(), field).real
    misclosure = slopes - conditions.rows @ g_theta
    g_theta = g_theta + conditions.gain @ misclosure
    phi = phi + conditions.phi_gain @ misclosure
    parameters[system.phi_at] = phi * length
    a_theta, residuals_theta = angular.plate(problem.angular.y, g_theta, phi)
    return Fit(field, plate, residuals, parameters, g_theta, a_theta, residuals_theta,
               misclosure, xy, theta, inverse)


def _grid_level(problem: Problem, y: np.ndarray, *, free: np.ndarray, d: np.ndarray) -> Level:
    grid = problem.system.grid
    alone = problem.system.grid_inverse @ d
    field = (free - grid.response @ alone).reshape(grid.views.shape)
    _, left = grid.plate(y, field, alone)
    dof = 2 * grid.n_readings - problem.system.rank_grid
    total = float((grid.weight * (left.real**2 + left.imag**2)).sum())
    return level(problem.repeats_xy, _sigma(total, dof), problem.grid.sigma_declared)


def _angular_level(problem: Problem) -> tuple[np.ndarray, np.ndarray, Level]:
    angular, y = problem.system.angular, problem.angular.y
    if not angular.n_views:
        nothing = level((float("nan"), 0), (float("nan"), 0), float("nan"))
        return np.full(angular.n_lines, np.nan), np.zeros(0), nothing
    free, d = angular.reduced(y)
    phi = problem.system.angular_inverse @ d
    _, left = angular.plate(y, free - angular.response @ phi, phi)
    dof = angular.n_readings - problem.system.rank_angular
    found = level(problem.repeats_theta, _sigma(float((angular.weight * left**2).sum()), dof),
                  problem.angular.sigma_declared)
    return free, d, found


def _sigma(total: float, dof: int) -> tuple[float, int]:
    return (float(np.sqrt(total / dof)), dof) if dof > 0 else (float("nan"), 0)


def weight_ratio(problem: Problem, sigma_xy: float, sigma_theta: float, y: np.ndarray) -> float:
    """Return the weight of an angular reading against a grid reading, in misalignment units.

    Without both noises, an angular reading counts like a grid reading at the half width.
    """
    if not (np.isfinite(sigma_xy) and np.isfinite(sigma_theta)):
        return 1.0
    sigma_xy = max(sigma_xy, ROUNDING * float(np.abs(y).max()), 1e-300)
    peak = float(np.abs(problem.angular.y).max())
    sigma_theta = max(sigma_theta, ROUNDING * peak, 1e-300)
    return (sigma_xy / (sigma_theta * problem.half_width_m)) ** 2
