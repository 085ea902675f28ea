# SPDX-License-Identifier: Apache-2.0
"""The joint least squares of one set of readings (method eq. 4.1)."""

import math
from dataclasses import dataclass, replace

import numpy as np

from selfcal_ros.estimation.datum.covariance import scale_of, scale_of_plate
from selfcal_ros.estimation.joint.problem import (
    FLOOR,
    AngularPart,
    FreeNetworkSolution,
    NoiseEstimate,
    Problem,
    grid_noise,
    noise_estimate,
    sigma_of,
    weight_ratio,
)
from selfcal_ros.estimation.terms.visits import TermInputs, squares_within


@dataclass(frozen=True, eq=False)
class JointFit:
    """A solution in its datum, in the frame of the equations (H for ``plate_moves``).

    Attributes
    ----------
    field, plate : complex array (nx, ny)
        G and A, m.
    residuals : complex array (views, nx, ny)
        Grid residuals in the plate frame, m; 0 where not read.
    parameters : float array (size,)
        Misalignments as in `NormalEquations`: phi times the half width, tau; m.
    g_theta, a_theta : float array (K,)
        Angular maps, rad.
    residuals_theta : float array (views, K)
        Angular residuals, rad; without axis conditions that the stage violates.
    misclosure : float array (conditions,)
        Slopes minus Gtheta before the angular datum was applied, rad.
    xy, theta : NoiseEstimate
        Noise of the grid and of the angular readings.
    inverse : float array (size, size)
        Covariance of the misalignments for unit grid noise.
    ratio : float
        Weight of an angular reading (times the half width) relative to a grid reading; 0 = none.
    """

    field: np.ndarray
    plate: np.ndarray
    residuals: np.ndarray
    parameters: np.ndarray
    g_theta: np.ndarray
    a_theta: np.ndarray
    residuals_theta: np.ndarray
    misclosure: np.ndarray
    xy: NoiseEstimate
    theta: NoiseEstimate
    inverse: np.ndarray
    ratio: float = 0.0

    @property
    def both_residuals(self) -> tuple[np.ndarray, np.ndarray]:
        """Residuals of the marks and of the lines."""
        return self.residuals, self.residuals_theta


def fit(problem: Problem, y: np.ndarray, theta: AngularPart | None = None) -> JointFit:
    """Return the joint least-squares solution.

    Each kind of reading is first fitted alone for its noise; the noises then determine their
    relative weights in the views' rotations, which they share.

    Parameters
    ----------
    problem : Problem
        The plan and its readings.
    y : complex array (views, nx, ny)
        Grid deviations in the plate frame, m.
    theta : AngularPart, optional
        `angular_part` of the problem, if several grid deviations are solved with it.
    """
    system, grid, angular = problem.system, problem.system.grid, problem.system.angular
    n, length = 3 * grid.n_views, problem.half_width_m
    theta = theta or angular_part(problem)
    raw = _solve_free(problem, y, theta)
    field, parameters = raw.field, raw.parameters

    parts = system.gauge.parts(field)
    field = system.gauge.remove(field, parts)
    parameters = parameters - parts @ system.rigid[:4]
    plate, residuals = grid.plate(y, field, parameters[:n])
    plate_parts = system.plate_gauge.parts(plate)
    plate = system.plate_gauge.remove(plate, plate_parts)
    parameters = parameters - plate_parts @ system.rigid[4:]
    if problem.reference is not None:
        grown = scale_of(system, problem.reference, field=field, plate=plate,
                         half_width_m=length)
        if problem.reference.marks is not None:  # across, a distance changes by the square
            across = np.vdot(scale_of_plate(system, problem.reference), plate).imag
            true = length * (1 + problem.reference.relative_error)
            grown += true - np.sqrt(max(true**2 - across**2, 0.0))
        field, plate = field + grown * grid.views.z_sites, plate - grown * grid.views.z
        parameters = parameters + grown * system.rigid[3]
    field, plate = grid.free_parts_small(field, plate)
    xy = raw.xy or grid_noise(problem, residuals)

    conditions = problem.conditions
    phi = parameters[system.phi_at] / length
    g_theta = theta.free - angular.response @ phi
    slopes = np.einsum("cij,ij->c", conditions.slopes.conj(), field).real
    misclosure = slopes - conditions.rows @ g_theta
    residuals_theta = angular.plate(problem.angular.y, g_theta, phi)[1]
    g_theta = g_theta + conditions.gain @ misclosure
    phi = phi + conditions.phi_gain @ misclosure
    parameters[system.phi_at] = phi * length
    a_theta = angular.plate(problem.angular.y, g_theta, phi)[0]
    return JointFit(field, plate, residuals, parameters, g_theta, a_theta, residuals_theta,
                    misclosure, xy, theta.noise, raw.inverse, raw.ratio)


def _solve_free(problem: Problem, y: np.ndarray, theta: AngularPart) -> FreeNetworkSolution:
    system, grid = problem.system, problem.system.grid
    n = 3 * grid.n_views
    free, d = grid.reduced(y)
    alone = system.grid_inverse @ d
    field = (free - grid.response @ alone).reshape(grid.views.shape)
    if not system.angular.n_views:
        return FreeNetworkSolution(field, alone, None, system.grid_inverse)
    xy = grid_noise(problem, grid.plate(y, field, alone)[1])
    ratio = weight_ratio(problem, xy.sigma, theta.noise.sigma, y)
    right = np.zeros(system.size)
    right[:n] = d
    right[system.phi_at] += ratio * problem.half_width_m * theta.d
    inverse = system.inverse(ratio)
    parameters = inverse @ right
    field = (free - grid.response @ parameters[:n]).reshape(grid.views.shape)
    return FreeNetworkSolution(field, parameters, xy, inverse, ratio)


def angular_part(problem: Problem) -> AngularPart:
    """Return the angular readings fitted alone, independently of the grid."""
    angular, y = problem.system.angular, problem.angular.y
    if not angular.n_views:
        nothing = noise_estimate((float("nan"), 0), (float("nan"), 0), float("nan"))
        return AngularPart(np.full(angular.n_lines, np.nan), np.zeros(0), nothing)
    free, d = angular.reduced(y)
    phi = problem.system.angular_inverse @ d
    _, residual = angular.plate(y, free - angular.response @ phi, phi)
    dof = angular.n_readings - problem.system.rank_angular - problem.dof_lines
    total = float((angular.weight * residual**2).sum())
    found = noise_estimate(problem.repeats_theta, sigma_of(total, dof),
                           problem.angular.sigma_declared, floor=FLOOR)
    return AngularPart(free, d, found)


FAR = 0.02
"""Distance from the sites, in pitches (rms), up to which the noise of the map is unaffected."""

SAMPLES = 1000
"""Fewest sites of all draws of noise together: enough for a ratio of sums of squares."""

STEPS = 30
"""Largest number of iterations for the map of a draw."""

SETTLED = 1e-2
"""Relative change of the map of a draw below which it has converged."""


class Moving:
    """Contribution of stops off the sites to the readings, updated at each iteration.

    Parameters
    ----------
    problem : Problem
        Readings and model; nothing is taken off where it takes the sites for the places.
    """

    def __init__(self, problem: Problem) -> None:
        self.problem, self.change = problem, 0.0
        self.places = problem.places if problem.moves else None
        self.moved: np.ndarray | None = None
        """Stage error where the stage stood less that at the site, at each reading, m."""

    def taken(self, field: np.ndarray) -> np.ndarray | float:
        """Return that contribution, (views, nx, ny), m, and store its change."""
        if self.places is None:
            return 0.0
        before: np.ndarray | float = 0.0 if self.moved is None else self.moved
        near = None if self.moved is None else self.places.errors(field, self.moved)
        self.moved = self.places.moved(field, near)
        self.change = float(np.abs(self.moved - before).max())
        return self.places.changes(self.moved, self.problem.turn_rad)

    def ground(self, found: JointFit) -> TermInputs:
        """Return the inputs with visits corrected for differences of the stage error."""
        ground = self.problem.ground
        if self.places is None or self.moved is None:
            return ground
        about = self.places.about(found.field, self.places.errors(found.field, self.moved),
                                  self.problem.turn_rad)
        return replace(ground, visits=tuple(
            None if view is None else replace(view, y=view.y - more)
            for view, more in zip(ground.visits, about, strict=True)))

    def repeats(self, found: JointFit) -> tuple[float, float]:
        """Return (sigma, dof) of the repeats, corrected for differences of the stage error."""
        sigma, dof = self.problem.repeats_xy
        less = (squares_within(self.problem.ground.visits)
                - squares_within(self.ground(found).visits))
        return sigma_of(max(sigma**2 * dof - less, 0.0), dof)


def noise_gain(problem: Problem, found: JointFit) -> np.ndarray:
    """Return the standard uncertainty of each node over that without places, (nx, ny).

    Between its nodes a spline is smoother than the nodes, so that readings there tell less of each
    node; the equations that are solved, and so their covariance, are those of the sites. Draws of
    noise are solved with the places of the stage and without, and compared node by node together
    with its neighbours, both coordinates alike.

    Parameters
    ----------
    problem, found : Problem, JointFit
        A solution.
    """
    places, grid = problem.places, problem.system.grid
    if places is None or not problem.moves or places.distance < FAR:
        return np.ones(grid.views.shape)
    rng, spread = np.random.default_rng(0), np.zeros(grid.weight.shape)
    spread[grid.read] = max(found.xy.sigma, np.finfo(float).tiny) / np.sqrt(grid.weight[grid.read])
    lines = angular_part(problem)
    still = replace(lines, free=0 * lines.free, d=0 * lines.d)
    there, sums = places.errors(found.field), np.zeros((2, *grid.views.shape))
    for _ in range(math.ceil(SAMPLES / grid.n_sites)):
        y = spread * (rng.normal(size=spread.shape) + 1j * rng.normal(size=spread.shape))
        plain = now = fit(problem, y, still).field
        for _ in range(STEPS):
            changes = places.changes(places.moved(now, there), problem.turn_rad)
            before, now = now, fit(problem, y - changes, still).field
            if np.abs(now - before).max() <= SETTLED * np.abs(now).max():
                break
        sums += np.stack([np.abs(now) ** 2, np.abs(plain) ** 2])
    ratio = _with_neighbours(np.where(problem.system.known_sites, sums, 0.0))
    return np.sqrt(ratio[0] / np.where(ratio[1] > 0, ratio[1], 1.0))


def _with_neighbours(values: np.ndarray) -> np.ndarray:
    """Return the sums of fields (k, nx, ny) over each node and those around it."""
    padded = np.pad(values, ((0, 0), (1, 1), (1, 1)))
    nx, ny = values.shape[1:]
    return np.sum([padded[:, i:i + nx, j:j + ny] for i in range(3) for j in range(3)], axis=0)
