# SPDX-License-Identifier: Apache-2.0
"""The joint least squares of one set of readings (method eq. 4.1).

What is to be fitted, the noise of a reading, how the two kinds of readings weigh, and the fit.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import fdtrc, stdtrit

from selfcal_ros.estimation.checks.wiring import F_LEVEL, LEAST_NOISE_M
from selfcal_ros.estimation.datum.covariance import (
    NO_NOISE,
    Conditions,
    conditions_for,
    scale_of,
    scale_of_plate,
)
from selfcal_ros.estimation.joint.images import ImageNoise
from selfcal_ros.estimation.lattice.maps import rotation_excess
from selfcal_ros.estimation.lattice.readings import AngularData, GridData
from selfcal_ros.estimation.normal.angular import FLOOR, MAX_STEPS
from selfcal_ros.estimation.normal.equations import (
    ENOUGH_DOF,
    NormalEquations,
    angular_residuals,
    noise_of,
)
from selfcal_ros.estimation.normal.grid import GridSystem
from selfcal_ros.estimation.options import Options
from selfcal_ros.estimation.terms.places import StagePlaces, places_of
from selfcal_ros.estimation.terms.visits import (
    TermInputs,
    between_visits,
    squares_within,
)
from selfcal_ros.model.error_map import COVERAGE, MANY_DOF
from selfcal_ros.model.readings import Measurements
from selfcal_ros.model.reference import ReferenceLength
from selfcal_ros.model.terms import ModelTerm

DECLARED_DOF = 8.0
"""Degrees of freedom of a declared noise: it is known to a quarter (GUM G.4.2)."""

NEGLIGIBLE = 1e-3
"""Part of an uncertainty, or of what makes it, that changes no stated figure."""

SAME = 1.1
"""Ratio of two noises up to which they count as equal, however significant the difference."""


@dataclass(frozen=True)
class NoiseEstimate:
    """Noise of one kind of readings.

    Attributes
    ----------
    sigma : float
        Standard deviation of one reading behind the uncertainties; NaN if unknown. If repeats
        (or the declaration) and residuals contradict each other it is the larger one. A declared
        noise is that of declaration and residuals together, if that is larger.
    dof : float
        Its degrees of freedom.
    repeats, residuals : float
        The two estimates, NaN if none.
    dof_repeats, dof_residuals : float
        Their degrees of freedom.
    declared : float
        As declared by the detections, NaN if not declared.
    p : float
        Two-sided probability of such a difference of residuals and repeats (or declaration) if
        both have the same noise; NaN if there is nothing to compare.
    """

    sigma: float
    dof: float
    repeats: float
    residuals: float
    dof_repeats: float
    dof_residuals: float
    declared: float
    p: float

    @property
    def stated(self) -> float:
        """Noise compared with the residuals: the declared one, or that of repeats."""
        return self.declared if np.isfinite(self.declared) else self.repeats

    @property
    def exceeded(self) -> bool:
        """Whether many repeats show more noise than is declared, as of a stage that vibrates."""
        return self.dof_repeats >= ENOUGH_DOF and self.repeats > self.stated

    @property
    def known(self) -> float:
        """Noise that is known without the residuals: `stated`, or that of repeats; 0 if none."""
        return float(np.nan_to_num(self.repeats if self.exceeded else self.stated))

    @property
    def p_of_known(self) -> float:
        """Two-sided probability that the residuals have the noise that is `known`."""
        if not self.exceeded:
            return self.p
        return _same_noise(
            (self.repeats, self.dof_repeats),
            (self.residuals, self.dof_residuals),
            FLOOR,
        )

    @property
    def contradicted(self) -> bool:
        """Whether residuals and repeats (or declaration) contradict each other."""
        if not self.p < F_LEVEL:
            return False
        small, large = sorted((self.stated, self.residuals))
        return large > SAME * small

    @property
    def k(self) -> float:
        """Coverage factor for 95.45 % (Student's t); NaN if the noise is unknown."""
        return coverage_factor(self.dof) if self.dof > 0 else float("nan")


def coverage_factor(dof: float) -> float:
    """Return k such that value +- k u covers the truth with `COVERAGE` (Student's t)."""
    return float(stdtrit(min(dof, MANY_DOF), (1 + COVERAGE) / 2))


def pooled(noises: Iterable[tuple[float, float]]) -> tuple[float, float]:
    """Return the pooled standard deviation and degrees of freedom of (sigma, dof) pairs."""
    good = [(sigma, dof) for sigma, dof in noises if dof > 0 and np.isfinite(sigma)]
    total = float(sum(dof for _, dof in good))
    if not total:
        return float("nan"), 0.0
    return float(np.sqrt(sum(dof * sigma**2 for sigma, dof in good) / total)), total


def noise_estimate(
    repeats: tuple[float, float],
    residuals: tuple[float, float],
    declared: float,
    *,
    floor: float = 0.0,
) -> NoiseEstimate:
    """Return the noise to use: declared, else repeats, else residuals.

    Repeats have `ENOUGH_DOF` degrees of freedom, or as many as the residuals have.
    If a test contradicts this choice, or both are too small to be tested, the larger one is used.
    Repeats that are identical, but for rounding, show the resolution of the sensor, not the noise,
    and are ignored.

    Parameters
    ----------
    repeats, residuals : tuple
        (sigma, degrees of freedom) of each; dof 0 = none.
    declared : float
        As declared by the detections; NaN = not declared.
    floor : float
        Noise up to which nothing is tested: of rounding, or that counts nowhere.
    """
    if residuals[1] < 1:  # terms with sizes leave fractions of rounding
        residuals = (float("nan"), 0.0)
    identical = (
        repeats[1] > 0 and repeats[0] <= floor < residuals[0] and residuals[1] > 0
    )
    base = (
        (declared, float("inf"))
        if np.isfinite(declared)
        else ((float("nan"), 0.0) if identical else repeats)
    )
    p = _same_noise(base, residuals, floor)
    few = base[1] < min(ENOUGH_DOF, residuals[1])
    chosen = residuals if few else base
    estimate = NoiseEstimate(
        sigma=chosen[0],
        dof=chosen[1],
        repeats=repeats[0],
        residuals=residuals[0],
        dof_repeats=repeats[1],
        dof_residuals=residuals[1],
        declared=declared,
        p=p,
    )
    both = base[1] > 0 and residuals[1] > 0
    untested = both and max(base[0], residuals[0]) <= floor
    if estimate.contradicted or untested:
        sigma, dof = max(base, residuals)
        return replace(estimate, sigma=sigma, dof=dof)
    if np.isfinite(declared):
        pooled_sigma, dof = pooled(((declared, DECLARED_DOF), residuals))
        return replace(estimate, sigma=max(declared, pooled_sigma), dof=dof)
    return estimate


def _same_noise(
    base: tuple[float, float], residuals: tuple[float, float], floor: float
) -> float:
    """Return the two-sided probability that both are estimates of the same noise (F-test)."""
    if not (base[1] > 0 and residuals[1] > 0) or not max(base[0], residuals[0]) > floor:
        return float("nan")
    ratio = np.square(min(residuals[0] / max(base[0], np.finfo(float).tiny), 1e100))
    upper = float(fdtrc(residuals[1], min(base[1], MANY_DOF), ratio))
    return 2 * min(upper, 1 - upper)


ROUNDING = 16 * np.finfo(float).eps
"""Noise below this part of the largest deviation is rounding."""

LEAST_NOISE_RAD = 1e-9
"""Noise of lines that counts at least, 0.05 nm at 50 mm: exact lines would outweigh all that is
assumed, and contradict what a stage beside its targets changes."""

LEAST_OF_MARKS = 0.01
"""The same as a part of the noise of marks at the half width: a hundred marks show the turn of a
view to a tenth of that noise, and lines with a hundredth determine it alone."""

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
    reference : ReferenceLength, optional
        What sets the scale.
    rigid : bool
        Whether the plate turns by finite angles, or as in the papers' linear form.
    terms : tuple of ModelTerm
        Terms of the model beside stage, plate and misalignments.
    turn_rad : float array (grid views,)
        Angle by which the frame of each view's readings is turned, see `turned`.
    places : StagePlaces, optional
        Where the stage stood; None where that is not known.
    at_places : bool
        Whether readings have the stage error of that place, or that of the site of their mark.
    images : ImageNoise, optional
        Images behind the readings, whose marks share noise; None without images.
    residuals_xy : tuple, optional
        (sigma, degrees of freedom) of the residuals where they are not those of the grid alone:
        after terms were taken off.
    dof_lines : float
        Degrees of freedom that terms take from the readings of lines.
    """

    system: NormalEquations
    grid: GridData
    angular: AngularData
    repeats_xy: tuple[float, float]
    repeats_theta: tuple[float, float]
    half_width_m: float
    conditions: Conditions
    inputs: TermInputs
    reference: ReferenceLength | None
    rigid: bool
    terms: tuple[ModelTerm, ...]
    turn_rad: np.ndarray
    places: StagePlaces | None
    at_places: bool
    images: ImageNoise | None
    residuals_xy: tuple[float, float] | None = None
    dof_lines: float = 0.0

    @property
    def moves(self) -> bool:
        """Whether readings have the stage error of places other than the sites."""
        return self.at_places and self.places is not None and self.places.beside

    @property
    def to_stage(self) -> np.ndarray:
        """Factor from the turned plate frame of each view's readings to the stage frame."""
        return self.system.grid.views.phases * np.exp(1j * self.turn_rad)

    def excess(
        self, parameters: np.ndarray, plate: np.ndarray, stage: np.ndarray
    ) -> np.ndarray | float:
        """Return what finite rotations add to the linear model, frame of the plate as it lies, m.

        What is left of the rotation there turns the plate; the rotation of the frame turns what the
        stage adds.

        Parameters
        ----------
        parameters : float array (size,)
            Misalignments as in `NormalEquations`, m.
        plate, stage : complex array (nx, ny) or (views, nx, ny)
            Error of the marks, and of the stage at them in the nominal frame of the plate, m.
        """
        if not self.rigid:
            return 0.0
        grid = self.system.grid
        length = self.half_width_m
        phi = parameters[: 3 * grid.n_views : 3, None, None] / length
        frame = np.expm1(-1j * self.turn_rad)[:, None, None]
        return rotation_excess(phi, grid.views.z * length, plate) + frame * stage


@dataclass(frozen=True, eq=False)
class AngularPart:
    """Angular equations with stage lines eliminated: M^-1 b, right side of phi, noise."""

    free: np.ndarray
    d: np.ndarray
    noise: NoiseEstimate


def repeats_of(
    measurements: Measurements,
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return pooled (sigma, degrees of freedom) of the repeats, grid and angular."""
    views = measurements.views
    return (
        between_visits(measurements, ENOUGH_DOF)
        or pooled((v.sigma_xy, v.dof_xy) for v in views if len(v.m)),
        pooled((v.sigma_theta, v.dof_theta) for v in views if len(v.k)),
    )


def grid_noise(problem: Problem, residual: np.ndarray) -> NoiseEstimate:
    """Return the noise of the grid readings, given their residuals (views, nx, ny)."""
    grid = problem.system.grid
    total = float((grid.weight * (residual.real**2 + residual.imag**2)).sum())
    dof = problem.system.dof_grid
    residuals = problem.residuals_xy or sigma_of(total, dof)
    repeats = problem.repeats_xy
    if problem.images is not None and total > 0:  # of which residuals show only part
        n_taken = problem.images.dof_of_terms if problem.residuals_xy else 0
        without_images = sigma_of(total, dof - n_taken)
        noises = problem.images.noises(residual)
        residuals = (
            residuals[0] * noises.sigma / without_images[0],
            min(noises.dof, residuals[1]),
        )
        repeats = repeats[0], repeats[1] / noises.excess(problem.images.marks)
    return noise_estimate(repeats, residuals, problem.grid.sigma_declared, floor=FLOOR)


def noise_excess(problem: Problem, residual: np.ndarray) -> float:
    """Return the largest variance of effects on all marks of an image, over that of a reading.

    1 without images. `residual` as in `grid_noise`.
    """
    images = problem.images
    return 1.0 if images is None else images.noises(residual).excess(images.marks)


def sigma_of(total: float, dof: float) -> tuple[float, float]:
    """Return (sigma, dof) of a weighted sum of squares (method eq. 4.7)."""
    return (float(np.sqrt(total / dof)), dof) if dof > 0 else (float("nan"), 0)


def weight_ratio(
    problem: Problem, sigma_xy: float, sigma_theta: float, y: np.ndarray
) -> float:
    """Return the weight of an angular reading against a grid reading, in misalignment units.

    Without both noises, an angular reading counts like a grid reading at the half width.
    """
    sigma_xy = max(sigma_xy, LEAST_NOISE_M, ROUNDING * float(np.abs(y).max()))
    peak = float(np.abs(problem.angular.y).max())
    sigma_theta = max(sigma_theta, ROUNDING * peak, least_noise_rad(problem, sigma_xy))
    return bounded_ratio(problem.system, sigma_xy, sigma_theta, problem.half_width_m)


def least_noise_rad(problem: Problem, sigma_xy: float) -> float:
    """Return the noise of lines that counts at least beside such a noise of marks, rad."""
    return max(LEAST_NOISE_RAD, LEAST_OF_MARKS * sigma_xy / problem.half_width_m)


def bounded_ratio(
    system: NormalEquations, sigma_xy: float, sigma_theta: float, half_width_m: float
) -> float:
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


def own_rotations(grid: GridSystem, y: np.ndarray) -> np.ndarray:
    """Return the rotation of each view that its own readings show, times the half width, m.

    The weighted least-squares fit of offset, rotation and magnification to each view alone; of
    views that share a rotation, of one rotation and magnification to all.

    Parameters
    ----------
    grid : GridSystem
        The measured plan.
    y : complex array (views, nx, ny)
        Deviations in the plate frame, m.
    """
    marks = grid.views.z.reshape(-1)
    weight, values = (array.reshape(grid.n_views, -1) for array in (grid.weight, y))
    total = weight.sum(axis=1)
    z = marks - (weight @ marks / total)[:, None]
    moment = (weight * (z.real**2 + z.imag**2)).sum(axis=1)
    turned = (weight * z.conj() * values).sum(axis=1).imag
    if grid.differences.shape[1]:
        together = np.equal.outer(grid.rotations, grid.rotations)
        moment, turned = together @ moment, together @ turned
    return turned / np.where(moment > 0, moment, 1.0)


def problem_of(
    measurements: Measurements,
    options: Options,
    system: NormalEquations,
    inputs: TermInputs,
    *,
    readings: tuple[GridData, AngularData],
    terms: tuple[ModelTerm, ...],
    images: ImageNoise | None = None,
) -> Problem:
    """Return the problem that readings pose, in the frame of the plate as it lies.

    Parameters
    ----------
    measurements, options
        The readings and how they are solved.
    system, inputs, readings
        What is made of the readings.
    terms, images
        As in `Problem`.
    """
    rigid = options.finite_rotations
    conditions = conditions_for(
        system, options.datum_theta, measurements.sense, inputs.half_width_m
    )
    problem = Problem(
        system,
        *readings,
        *repeats_of(measurements),
        inputs.half_width_m,
        conditions,
        inputs,
        reference=options.reference,
        rigid=rigid,
        terms=terms,
        turn_rad=np.zeros(len(readings[0].index)),
        places=places_of(measurements, readings[0], inputs, system.known_sites),
        at_places=options.at_places,
        images=images,
    )
    return turned(problem) if rigid else problem


def turned(problem: Problem) -> Problem:
    """Return the problem with the readings of each view in the frame of the plate as placed.

    With the rotation phi0 that a view shows by itself, y' = e^(-i phi0) (y + m) - m. Without it the
    linear model would have the columns of the terms and that of the rotation apart by phi0, and
    what only phi0^2 determines, the scale of a microscope, with the wrong sign.
    """
    grid = problem.system.grid
    length = problem.half_width_m
    phi = own_rotations(grid, problem.grid.y) / length
    frame, bent = np.exp(-1j * phi), np.expm1(-1j * phi)
    marks = grid.views.z * length
    y = np.where(
        grid.read,
        frame[:, None, None] * problem.grid.y + bent[:, None, None] * marks,
        0,
    )
    visits = tuple(
        None
        if v is None
        else replace(
            v,
            y=f * v.y + e * marks.reshape(-1)[v.mark],
            phase=v.phase * complex(f),
            frame=v.frame * complex(f),
        )
        for v, f, e in zip(problem.inputs.visits, frame, bent, strict=True)
    )
    lines = problem.angular.y.copy()
    for row, index in enumerate(problem.angular.index):
        if index in problem.grid.index:
            read = problem.angular.weight[row] > 0
            lines[row] -= np.where(read, phi[problem.grid.index.index(index)], 0.0)
    return replace(
        problem,
        grid=replace(problem.grid, y=y),
        turn_rad=phi,
        angular=replace(problem.angular, y=lines),
        inputs=replace(problem.inputs, visits=visits),
    )


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
    ratio: float

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
    system = problem.system
    grid = problem.system.grid
    angular = problem.system.angular
    n = 3 * grid.n_views
    length = problem.half_width_m
    theta = theta or angular_part(problem)
    free, d = grid.reduced(y)
    xy = None
    inverse = system.grid_inverse
    ratio = 0.0
    parameters = inverse @ d
    field = (free - grid.response @ parameters).reshape(grid.views.shape)
    if system.angular.n_views:
        xy = grid_noise(problem, grid.plate(y, field, parameters)[1])
        ratio = weight_ratio(problem, xy.sigma, theta.noise.sigma, y)
        right = np.zeros(system.size)
        right[:n] = d
        right[system.phi_at] += ratio * length * theta.d
        inverse = system.inverse(ratio)
        parameters = inverse @ right
        field = (free - grid.response @ parameters[:n]).reshape(grid.views.shape)

    field, parameters, plate, residuals = system.in_datum(y, field, parameters)
    if problem.reference is not None:
        grown = _grown(problem, problem.reference, field=field, plate=plate)
        field = field + grown * grid.views.z_sites
        plate = plate - grown * grid.views.z
        parameters = parameters + grown * system.rigid[3]
    field, plate = grid.free_parts_small(field, plate)
    xy = xy or grid_noise(problem, residuals)

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
    return JointFit(
        field=field,
        plate=plate,
        residuals=residuals,
        parameters=parameters,
        g_theta=g_theta,
        a_theta=a_theta,
        residuals_theta=residuals_theta,
        misclosure=misclosure,
        xy=xy,
        theta=theta.noise,
        inverse=inverse,
        ratio=ratio,
    )


def _grown(
    problem: Problem,
    reference: ReferenceLength,
    *,
    field: np.ndarray,
    plate: np.ndarray,
) -> float:
    """Return the scale that a reference length gives maps in their datum, m at the half width.

    Across the distance of two marks it changes by the square.
    """
    system, length = problem.system, problem.half_width_m
    grown = scale_of(system, reference, field=field, plate=plate, half_width_m=length)
    if reference.marks is not None:
        across = np.vdot(scale_of_plate(system, reference), plate).imag
        true = length * (1 + reference.relative_error)
        grown += true - np.sqrt(max(true**2 - across**2, 0.0))
    return grown


def angular_part(problem: Problem) -> AngularPart:
    """Return the angular readings fitted alone, independently of the grid."""
    angular, y = problem.system.angular, problem.angular.y
    if not angular.n_views:
        nothing = noise_estimate((float("nan"), 0), (float("nan"), 0), float("nan"))
        return AngularPart(np.full(angular.n_lines, np.nan), np.zeros(0), nothing)
    residual = angular_residuals(problem.system, y)
    dof = problem.system.dof_angular - problem.dof_lines
    total = angular.squares(residual)
    noise = noise_estimate(
        problem.repeats_theta,
        sigma_of(total, dof),
        problem.angular.sigma_declared,
        floor=LEAST_NOISE_RAD,
    )
    return AngularPart(*angular.reduced(y), noise)


FAR = 0.02
"""Distance from the sites, in pitches (rms), up to which the noise of the map is unaffected."""

SAMPLES = 1000
"""Fewest sites of all draws of noise together: enough for a ratio of sums of squares."""


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

    def change_of_readings(self, field: np.ndarray) -> np.ndarray | float:
        """Return that contribution, (views, nx, ny), m, and store its change."""
        if self.places is None:
            return 0.0
        before: np.ndarray | float = 0.0 if self.moved is None else self.moved
        near = None if self.moved is None else self.places.errors(field, self.moved)
        self.moved = self.places.differences(field, near)
        self.change = float(np.abs(self.moved - before).max())
        return self.places.changes(self.moved, self.problem.turn_rad)

    def inputs(self, fitted: JointFit) -> TermInputs:
        """Return the inputs with visits corrected for differences of the stage error."""
        inputs = self.problem.inputs
        if self.places is None or self.moved is None:
            return inputs
        about = self.places.about(
            fitted.field,
            self.places.errors(fitted.field, self.moved),
            self.problem.turn_rad,
        )
        return replace(
            inputs,
            visits=tuple(
                None if view is None else replace(view, y=view.y - more)
                for view, more in zip(inputs.visits, about, strict=True)
            ),
        )

    def repeats(self, fitted: JointFit) -> tuple[float, float]:
        """Return (sigma, dof) of the repeats, corrected for differences of the stage error."""
        sigma, dof = self.problem.repeats_xy
        less = squares_within(self.problem.inputs.visits) - squares_within(
            self.inputs(fitted).visits
        )
        return sigma_of(max(sigma**2 * dof - less, 0.0), dof)


def noise_gain(problem: Problem, fitted: JointFit) -> np.ndarray:
    """Return the standard uncertainty of each node over that without places, (nx, ny).

    Between its nodes a spline is smoother than the nodes, so that readings there tell less of each
    node; the equations that are solved, and so their covariance, are those of the sites. Draws of
    noise are solved with the places of the stage and without, and compared node by node together
    with its neighbours, both coordinates alike.

    Parameters
    ----------
    problem, fitted : Problem, JointFit
        A solution.
    """
    places = problem.places
    grid = problem.system.grid
    if places is None or not problem.moves or places.distance < FAR:
        return np.ones(grid.views.shape)
    rng = np.random.default_rng(0)
    sigma_m = max(fitted.xy.sigma, np.finfo(float).tiny)
    lines = angular_part(problem)
    still = replace(lines, free=0 * lines.free, d=0 * lines.d)
    error_there = places.errors(fitted.field)
    sums = np.zeros((2, *grid.views.shape))
    for _ in range(math.ceil(SAMPLES / grid.n_sites)):
        y = sigma_m * noise_of(rng, grid.weight.shape, grid.weight)
        plain = now = fit(problem, y, still).field
        for _ in range(MAX_STEPS):
            changes = places.changes(
                places.differences(now, error_there), problem.turn_rad
            )
            before = now
            now = fit(problem, y - changes, still).field
            if np.abs(now - before).max() <= NEGLIGIBLE * np.abs(now).max():
                break
        sums += np.stack([np.abs(now) ** 2, np.abs(plain) ** 2])
    ratio = _with_neighbours(np.where(problem.system.known_sites, sums, 0.0))
    return np.sqrt(ratio[0] / np.where(ratio[1] > 0, ratio[1], 1.0))


def _with_neighbours(values: np.ndarray) -> np.ndarray:
    """Return the sums of fields (k, nx, ny) over each node and those around it."""
    padded = np.pad(values, ((0, 0), (1, 1), (1, 1)))
    nx, ny = values.shape[1:]
    return np.sum(
        [padded[:, i : i + nx, j : j + ny] for i in range(3) for j in range(3)], axis=0
    )
