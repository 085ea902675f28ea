# SPDX-License-Identifier: Apache-2.0
"""Calibration by joint least squares: readings to result.

RESULT.json keeps parts of a fit. Residuals, so that a report can show them without the bag; and the
part of the map's covariance that terms of the model make. With factors L (r, 2, nx, ny), cov(G) =
sigma^2 (S + sum_r L_r L_r'), where S follows from the weights of the readings, so that saved maps
are compared exactly. Each factor belongs to a term with a size, being what the map would gain if
that term were known, or to the free terms together.
"""

import math
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from selfcal_ros.errors import NoDataError, NotIdentifiableError, NotSettledError
from selfcal_ros.estimation.checks.wiring import LEAST_NOISE_M
from selfcal_ros.estimation.datum.covariance import (
    NO_NOISE,
    LinesCovariance,
    MapsCovariance,
    misclosure_test,
    scale_of,
)
from selfcal_ros.estimation.joint.images import image_noise
from selfcal_ros.estimation.joint.model_fit import ModelFit, fit_model, placed
from selfcal_ros.estimation.joint.noise_effects import image_variances, structured
from selfcal_ros.estimation.joint.problem import (
    NEGLIGIBLE,
    NoiseEstimate,
    Problem,
    noise_gain,
    problem_of,
)
from selfcal_ros.estimation.joint.slow_motion import slow_motion
from selfcal_ros.estimation.lattice.readings import angular_data, grid_data
from selfcal_ros.estimation.multifrontal.factor import one_thread
from selfcal_ros.estimation.normal.angular import MAX_FULL
from selfcal_ros.estimation.normal.equations import (
    MAX_NODES,
    UNASKED_SITES,
    NormalEquations,
    angular_residuals,
    system_of,
)
from selfcal_ros.estimation.observability.plan_check import with_unseen_modes
from selfcal_ros.estimation.observability.rank import identifies, measured_observability
from selfcal_ros.estimation.options import Options
from selfcal_ros.estimation.terms.equations import (
    FREE,
    require_terms_determined,
    roots_by_term,
)
from selfcal_ros.estimation.terms.visits import check_visits, term_inputs
from selfcal_ros.model.error_map import ErrorMap, ThetaDatum, rms
from selfcal_ros.model.findings import (
    Finding,
    Magnification,
    NoUncertainty,
    ReferenceOff,
    Unchecked,
)
from selfcal_ros.model.kept import Factors, ImagesKept, Kept, SlowKept, rounded
from selfcal_ros.model.parts import Parts, ResidualsOfViews, ViewCourse, ViewResiduals
from selfcal_ros.model.readings import (
    GridVisits,
    Measurements,
    Sense,
    lines_turned_over,
    turned_over,
)
from selfcal_ros.model.reference import ReferenceKind, ReferenceLength
from selfcal_ros.model.result import (
    ArtifactMap,
    CalibrationResult,
    Noise,
    Observability,
    ViewResult,
)
from selfcal_ros.model.terms import block_of_offsets
from selfcal_ros.model.verdict import ModelResult, TermEstimate, TermResult
from selfcal_ros.model.view import Plan, cells_seen
from selfcal_ros.units import NS_PER_S


@dataclass(frozen=True, eq=False)
class Solved:
    """A solution before any test.

    Attributes
    ----------
    result : CalibrationResult
        Maps with their uncertainties.
    xy, theta : NoiseEstimate
        Noise of the grid and of the angular readings.
    model : ModelFit, optional
        The joint fit; None if the map was made by other steps.
    axes : tuple of float
        Probability and size (rad) of the misclosure of the axis conditions; 1 and 0 if not
        used.
    converged : bool
        Whether the estimate converged with the assumed terms.
    """

    result: CalibrationResult
    xy: NoiseEstimate
    theta: NoiseEstimate
    model: ModelFit | None = None
    axes: tuple[float, float] = (1.0, 0.0)
    converged: bool = True

    @property
    def joint(self) -> ModelFit:
        """The joint fit, of a solution that has one.

        Raises
        ------
        ValueError
            For a map that was made by other steps.
        """
        if self.model is None:
            raise ValueError("the solution has no joint fit")
        return self.model


def noise_of(xy: NoiseEstimate, theta: NoiseEstimate) -> Noise:
    """Return the noises of a result."""
    return Noise(
        sigma_xy=xy.sigma,
        sigma_theta=theta.sigma,
        sigma_xy_repeats=xy.repeats,
        sigma_theta_repeats=theta.repeats,
        sigma_xy_residuals=xy.residuals,
        sigma_theta_residuals=theta.residuals,
        dof_xy_repeats=xy.dof_repeats,
        dof_theta_repeats=theta.dof_repeats,
        dof_xy_residuals=xy.dof_residuals,
        dof_theta_residuals=theta.dof_residuals,
        sigma_xy_declared=xy.declared,
        sigma_theta_declared=theta.declared,
        dof_xy=xy.dof,
        dof_theta=theta.dof,
        k_xy=xy.k,
        k_theta=theta.k,
        p_xy=xy.p,
        p_theta=theta.p,
    )


MAX_READINGS = 60_000
"""Largest number of grid readings with stored residuals: 121 x 121 marks in four views."""

MAX_PARTS = 60
"""Number of intervals of a view's time with a stored mean residual."""

DECIMALS_M, DECIMALS_RAD, DECIMALS_S = 13, 12, 3
"""Decimals stored: 0.1 pm, 1 prad, 1 ms."""


def kept_residuals(
    measurements: Measurements, model: ModelFit
) -> ResidualsOfViews | None:
    """Return the residuals of all readings; None for large fields.

    Parameters
    ----------
    measurements : Measurements
        The readings.
    model : ModelFit
        The solution, with its residuals in the plate frame.
    """
    problem, fitted = model.problem, model.fitted
    if problem.system.grid.n_readings > MAX_READINGS:
        return None
    starts = [
        int(v.visits.stamp_ns.min())
        for v in measurements.views
        if v.visits is not None and len(v.visits.stamp_ns)
    ]
    views = []
    at_visits = {
        row: (residuals + fitted.residuals[row].reshape(-1)[visits.mark])
        * problem.to_stage[row]
        for row, visits, residuals in model.visits_about_means()
    }
    for index, view in enumerate(measurements.views):
        entry = ViewResiduals(view.view.name)
        if index in problem.grid.index:
            row = problem.grid.index.index(index)
            read = problem.grid.weight[row] > 0
            residuals = (
                np.where(read, fitted.residuals[row], np.nan) * problem.to_stage[row]
            )
            course = None
            if starts and view.visits is not None and len(view.visits.mark):
                course = _course(view.visits, at_visits[row], min(starts))
            entry = replace(
                entry,
                dx=np.round(residuals.real, DECIMALS_M),
                dy=np.round(residuals.imag, DECIMALS_M),
                course=course,
            )
        if index in problem.angular.index:
            row = problem.angular.index.index(index)
            residuals = np.where(
                problem.angular.weight[row] > 0, fitted.residuals_theta[row], np.nan
            )
            entry = replace(entry, dtheta=np.round(residuals, DECIMALS_RAD))
        views.append(entry)
    return ResidualsOfViews(tuple(views))


def _course(visits: GridVisits, residuals: np.ndarray, start_ns: int) -> ViewCourse:
    """Return the mean residual in each of `MAX_PARTS` intervals of the view's time.

    Or of each visit, if there are fewer.
    """
    order = np.argsort(visits.stamp_ns, kind="stable")
    intervals = np.array_split(np.arange(len(order)), min(len(order), MAX_PARTS))
    starts = np.array([interval[0] for interval in intervals])
    counts = visits.count[order]
    count = np.add.reduceat(counts, starts)
    since_s = (visits.stamp_ns - start_ns) / NS_PER_S
    columns = {
        name: np.add.reduceat(values[order] * counts, starts) / count
        for name, values in (
            ("time_s", since_s),
            ("dx", residuals.real),
            ("dy", residuals.imag),
        )
    }
    return ViewCourse(
        time_s=np.round(columns["time_s"], DECIMALS_S),
        dx=np.round(columns["dx"], DECIMALS_M),
        dy=np.round(columns["dy"], DECIMALS_M),
        count=tuple(count.tolist()),
    )


MICROSCOPE_PARTS = ("scale", "turn", "stretch", "shear")
"""Coefficients of a microscope in their order."""


def saved_terms(
    cover: MapsCovariance,
    roots: Iterable[tuple[str, np.ndarray]],
    sense: Sense,
    other_effects: dict[str, np.ndarray],
) -> Factors | None:
    """Return the factors of the terms; None for large fields.

    Parameters
    ----------
    cover : MapsCovariance
        Of the map, in the frame of the equations, terms included.
    roots : sequence of str and float array (p, k)
        Names of the terms and roots of their parts of the coefficients' covariance.
    sense : Sense
        What moved: the factors are in the stage frame.
    other_effects : dict of float array (p, ...)
        What a unit of each coefficient makes of other quantities, see `Factors`.
    """
    shape = cover.system.grid.views.shape
    if cover.system.grid.n_sites > MAX_FULL:
        return None
    maps = cover.maps_of_terms()[0]
    maps = turned_over(sense, maps.reshape(*shape, maps.shape[1]), axes=(0, 1))
    coordinates = np.concatenate(
        [maps.real.reshape(-1, maps.shape[2]), maps.imag.reshape(-1, maps.shape[2])]
    )
    other_quantities = np.concatenate(
        [values.reshape(len(values), -1).T for values in other_effects.values()]
    )
    factors, names, beside_map, beside_alone, names_alone = [], [], [], [], []
    for name, root in roots:
        directions, size, right = np.linalg.svd(coordinates @ root, full_matrices=False)
        significant = size > NEGLIGIBLE
        factors += list(
            (directions[:, significant] * size[significant]).T.reshape(-1, 2, *shape)
        )
        names += [name] * int(significant.sum())
        projector = right[significant].T @ right[significant]
        beside_map += list((other_quantities @ root @ right[significant].T).T)
        directions, size, _ = np.linalg.svd(
            other_quantities @ (root - root @ projector), full_matrices=False
        )
        alone = (directions * size).T[size > NEGLIGIBLE]
        beside_alone += list(alone)
        names_alone += [name] * len(alone)
    all_of = np.array([*beside_map, *beside_alone]).reshape(-1, len(other_quantities))
    ends = np.cumsum([values[0].size for values in other_effects.values()])[:-1]
    return Factors(
        tuple(names),
        rounded(np.array(factors).reshape(-1, 2, *shape)),
        with_map=len(names),
        beside={
            name: rounded(values_of.reshape(len(values_of), *values.shape[1:]))
            for (name, values), values_of in zip(
                other_effects.items(), np.split(all_of, ends, axis=1), strict=True
            )
        },
        beside_terms=tuple(names_alone),
    )


def factors_of(result: CalibrationResult) -> Factors:
    """Return the factors of a result; none without terms."""
    return result.kept.factors or Factors.none(result.artifact.shape)


def angular_terms(
    turned: np.ndarray, roots: Iterable[tuple[str, np.ndarray]], *, least: float
) -> dict[str, np.ndarray]:
    """Return the contributions of terms with a size to u of the angular map, rad, (K,).

    Parameters
    ----------
    turned : float array (K, p)
        Angular map for a unit of each coefficient, rad, by the noise of one grid reading.
    roots : sequence of str and float array (p, k)
        As in `saved_terms`.
    least : float
        Contribution that counts, rms, rad.
    """
    u_of_terms = (
        (name, rounded(np.linalg.norm(turned @ root, axis=1)))
        for name, root in roots
        if name != FREE
    )
    return {name: u for name, u in u_of_terms if rms(u) > least}


def variance_of_terms(result: CalibrationResult) -> dict[str, np.ndarray]:
    """Return the variance of the map from each term with a size, (2, nx, ny), m^2."""
    factors = factors_of(result)
    names = np.array(factors.terms, dtype=str)
    return {
        str(name): (factors.of_map[names == name] ** 2).sum(axis=0)
        * result.noise.sigma_xy**2
        for name in dict.fromkeys(names.tolist())
        if name != FREE
    }


def solve_joint(
    measurements: Measurements, options: Options, *, whole_only: bool = False
) -> Solved:
    """Calibrate by joint least squares; see `selfcal_ros.estimation.api.calibrate`.

    Readings so far from what is assumed of them that the estimate does not converge are solved
    without the assumptions, and cannot be qualified. Where nothing but rounding is left no
    assumption can be weighed against it: what the views determine by themselves is enough.

    Raises
    ------
    NotSettledError
        If the estimate does not converge; with `whole_only` as soon as it does not with all that is
        assumed.
    """
    with one_thread():
        model, observability, as_assumed = _fitted(
            measurements, options, whole_only=whole_only
        )
        return replace(
            _solved(measurements, options, model=model, observability=observability),
            converged=as_assumed or model.fitted.xy.sigma < LEAST_NOISE_M,
        )


def fit_joint(measurements: Measurements, options: Options) -> ModelFit:
    """Return the fit behind `solve_joint` alone."""
    with one_thread():
        return _fitted(measurements, options)[0]


NEARLY_EXACT_M = 1e-10
"""Noise of a reading, m, below which it may be what the sizes of assumed terms leave of exact
readings: no sensor is so good."""


def _fitted(
    measurements: Measurements, options: Options, *, whole_only: bool = False
) -> tuple[ModelFit, Observability, bool]:
    """Return the fit, what the readings determine, and if it has all that is assumed.

    Where that does not converge with the places of the stage readings count for their sites, and
    then less is assumed, unless it is `whole_only` that counts. Less is assumed as well where it
    leaves nothing of the residuals: then the readings are exact.
    """
    of_visits = tuple(term for term in options.assumed if term.block.needs_visits)
    failed: NotSettledError | None = None
    nearly_exact: tuple[ModelFit, Observability, bool] | None = None
    for assumed in dict.fromkeys((options.assumed, of_visits, ())):
        problem, observability = prepare(
            measurements, replace(options, assumed=assumed)
        )
        try:
            model = _fitted_at_places(problem, observability, or_sites=not whole_only)
        except NotSettledError as error:
            if whole_only:
                raise
            failed = error
            continue
        at_places = model.problem.moves == problem.moves
        solution = model, observability, assumed == options.assumed and at_places
        sigma_m = model.fitted.xy.sigma
        if whole_only or sigma_m < LEAST_NOISE_M:
            return solution
        if nearly_exact is None and not sigma_m < NEARLY_EXACT_M:
            return solution
        nearly_exact = nearly_exact or solution
    if nearly_exact is not None:
        return nearly_exact
    raise failed or AssertionError("something was tried")


def _fitted_at_places(
    problem: Problem, observability: Observability, *, or_sites: bool
) -> ModelFit:
    """Return the fit with the places of the stage, else with readings at their sites.

    Raises
    ------
    NotSettledError
        If neither converges; without `or_sites` if that with the places does not.
    """
    check = partial(require_terms_determined, observability=observability)
    try:
        return fit_model(problem, check)
    except NotSettledError:
        if not (or_sites and problem.moves):
            raise
    return fit_model(replace(problem, at_places=False), check)


def prepare(
    measurements: Measurements, options: Options
) -> tuple[Problem, Observability]:
    """Return the problem that the readings pose and what it determines.

    Raises
    ------
    NoDataError, NotIdentifiableError, InputError
        As `selfcal_ros.estimation.api.calibrate`.
    """
    check_visits(measurements)
    grid, angular = grid_data(measurements), angular_data(measurements)
    if not grid.index:
        raise NoDataError(
            f"plan '{measurements.plan_id}'",
            "no grid mark was read",
            "record detections of the plate's marks in at least three views",
        )
    system = system_of(grid, angular)
    observability = measured_observability(
        system, measurements.artifact, tuple(v.view for v in measurements.views)
    )
    if not observability.identifiable:
        plan = Plan(
            measurements.plan_id,
            measurements.artifact,
            tuple(v.view for v in measurements.views),
        )
        if not identifies(plan.artifact, plan.views):
            observability = with_unseen_modes(observability, system, plan)
        raise NotIdentifiableError(
            "the marks that were read do not identify the stage "
            f"({observability.deficiency} mode{'s' * (observability.deficiency != 1)} "
            "undetermined)",
            observability,
        )
    inputs = term_inputs(measurements, grid, drift_degree=options.drift_degree)
    # as a column, offsets would explain the noise that they hold
    inputs = replace(
        inputs, line_offsets=inputs.line_offsets - angular_residuals(system, angular.y)
    )
    terms = tuple(
        term
        for term in options.model_terms(
            visits=all(v is not None for v in inputs.visits),
            assumed=options.finite_rotations,
        )
        if inputs.has(term.name)
    )
    images = image_noise(
        measurements.artifact,
        [v.view for v in measurements.views],
        system,
        inputs=inputs,
        terms=[term for term in terms if term.block.of_images],
    )
    return problem_of(
        measurements,
        options,
        system,
        inputs,
        readings=(grid, angular),
        terms=terms,
        images=images,
    ), observability


def _solved(
    measurements: Measurements,
    options: Options,
    *,
    model: ModelFit,
    observability: Observability,
) -> Solved:
    problem, fitted = model.problem, model.fitted
    asked_for = options.uncertainty
    with_uncertainty = (
        problem.system.grid.n_sites <= UNASKED_SITES if asked_for is None else asked_for
    )
    exact = options.reference is not None and fitted.xy.sigma == 0
    # 0 would hide the u of the reference
    least = NO_NOISE if exact else fitted.xy.sigma
    sigma = np.full(problem.system.known_sites.shape, least)
    if with_uncertainty:
        sigma = sigma * noise_gain(problem, fitted)
    cover = None
    # the datum of the axes is tested in any case
    if with_uncertainty or problem.conditions.datum is ThetaDatum.XY_AXES:
        cover = MapsCovariance(
            problem.system,
            fitted.inverse,
            options.reference,
            terms=model.equations if problem.terms else None,
            half_width_m=problem.half_width_m,
            sigma_m=least,
        )
    error_map, closure, kept_parts = _error_map(
        measurements, model, cover, sigma, with_uncertainty=with_uncertainty
    )
    # without a reference length the datum leaves the map no scale
    of_map = 0.0
    if options.reference is not None:
        scale = problem.system.gauge.coefficients(fitted.field)[3]
        of_map = float(scale) / problem.half_width_m
    artifact_map = _artifact_map(
        model, cover if with_uncertainty else None, rms(sigma), of_map
    )
    findings: tuple[Finding, ...] = (
        *_unchecked(problem.system, measurements.sense),
        *_magnification(artifact_map, of_map, options),
    )
    if not with_uncertainty and asked_for is None:
        findings = (NoUncertainty(), *findings)
    axes = (1.0, 0.0)
    if problem.conditions.datum is ThetaDatum.XY_AXES and closure is not None:
        axes = misclosure_test(fitted.misclosure, closure)
    result = CalibrationResult(
        plan_id=measurements.plan_id,
        error_map=error_map,
        artifact_map=artifact_map,
        views=views_of(
            measurements,
            problem,
            np.where(problem.system.known_views, fitted.parameters, np.nan),
        ),
        observability=observability,
        noise=noise_of(fitted.xy, fitted.theta),
        rejected=measurements.all_rejected(),
        findings=findings,
        sense=str(measurements.sense),
        parts=Parts(residuals=kept_residuals(measurements, model)),
        kept=replace(kept_parts, images=_kept_images(measurements, model)),
        run_id=measurements.run_id,
        model=ModelResult(
            "rigid" if problem.rigid else "linear",
            term_results(model, {term.name for term in options.terms}),
        ),
        placed_plate=measurements.artifact.placed,
    )
    return Solved(result, fitted.xy, fitted.theta, model, axes)


def _kept_images(measurements: Measurements, model: ModelFit) -> ImagesKept | None:
    """Return what a result keeps of the noise of images in its grid views; None without."""
    views = [measurements.views[index].view for index in model.problem.grid.index]
    cells_of_views = cells_seen(measurements.artifact, views)
    if model.problem.images is None or cells_of_views is None:
        return None
    noises = model.problem.images.noises(model.fitted.residuals)
    motion = slow_motion(model)
    of_reading = model.fitted.xy.sigma**2
    names = list(dict.fromkeys(name for name, _ in cells_of_views))
    return ImagesKept(
        noises.share,
        noises.dof_mark,
        tuple(names.index(name) for name, _ in cells_of_views),
        tuple(step for _, step in cells_of_views),
        None
        if motion is None
        else SlowKept(
            noises.mark**2 / of_reading,
            max(motion.white + noises.image**2 / of_reading, 0.0),
            max(motion.slow, 0.0),
        ),
    )


def _magnification(
    plate_map: ArtifactMap, of_map: float, options: Options
) -> Iterator[Finding]:
    """Yield a finding if plate or reference and encoders differ in scale by more than is plausible.

    `of_map` is the scale that a reference length gives the map, m/m.
    """
    limit = options.magnification_limit
    if options.reference is None:
        scale, u = plate_map.magnification, plate_map.u_magnification
        if abs(scale) > limit:
            yield Magnification(size=scale, u=u, unit="m/m")
    elif not abs(of_map) <= limit:
        u = options.reference.u_relative
        yield ReferenceOff(size=of_map, u=u, unit="m/m")


def _unchecked(system: NormalEquations, sense: Sense) -> Iterator[Finding]:
    """Yield the sites and lines of the map, stage frame, that only single readings determine."""
    unchecked = turned_over(sense, system.unchecked_sites, sign=1)
    sites = np.argwhere(unchecked) - np.array(unchecked.shape) // 2
    lines = np.argwhere(lines_turned_over(sense, system.unchecked_lines, sign=1))
    if len(sites) or len(lines):
        yield Unchecked(
            sites=tuple(map(tuple, sites.tolist())), lines=tuple(lines[:, 0].tolist())
        )


def weights_read(problem: Problem, index: int) -> dict[str, Any]:
    """Return the weights of what was read in a view, for `ViewResult`."""
    out: dict[str, Any] = {"read_grid": 0, "read_angular": 0}
    if index in problem.grid.index:
        row = problem.grid.index.index(index)
        weight = problem.grid.weight[row]
        field = problem.system.grid.views.in_field[row]
        out["read_grid"] = _compact(weight, weight[field])
    if index in problem.angular.index:
        weight = problem.angular.weight[problem.angular.index.index(index)]
        out["read_angular"] = _compact(weight, weight)
    return out


def _compact(weight: np.ndarray, expected: np.ndarray) -> Any:
    """Return one number where all expected readings have it, else a number a reading."""
    if len(expected) and (expected == expected.flat[0]).all():
        return _short(float(expected.flat[0]))
    return (
        [[_short(w) for w in row] for row in weight.tolist()]
        if weight.ndim == 2
        else [_short(w) for w in weight.tolist()]
    )


def _short(weight: float) -> float | int:
    """Return a weight as an integer where it is one, else with nine digits."""
    return int(weight) if weight == int(weight) else float(f"{weight:.9g}")


def term_results(model: ModelFit, declared: Collection[str]) -> tuple[TermResult, ...]:
    """Return the estimates of each term of the model; those not `declared` are assumed."""
    if not model.problem.terms:
        return ()
    columns = model.equations.columns.columns
    covariance = model.covariance
    determined = (
        np.abs(model.equations.undetermined(model.equations.free)).max(
            axis=1, initial=0.0
        )
        < 1e-6
    )
    size_before = {term.name: term.size for term in model.given}
    out = []
    for term in model.problem.terms:
        estimates = tuple(
            TermEstimate(
                model.problem.inputs.name_of(c.term, c.view),
                c.component,
                float(model.coefficients[i]) if determined[i] else float("nan"),
                float(np.sqrt(max(covariance[i, i], 0.0)) * model.fitted.xy.sigma)
                if determined[i]
                else float("nan"),
                c.unit,
            )
            for i, c in enumerate(columns)
            if c.term == term.name
        )
        size = None if term.free else term.size
        size_given = None if term.free else size_before.get(term.name, term.size)
        out.append(
            TermResult(
                str(term.name),
                size_given,
                estimates,
                size if size != size_given else None,
                "declared" if term.name in declared else "default",
            )
        )
    return tuple(out)


def _error_map(
    measurements: Measurements,
    model: ModelFit,
    cover: MapsCovariance | None,
    sigma: np.ndarray,
    *,
    with_uncertainty: bool,
) -> tuple[ErrorMap, np.ndarray | None, Kept]:
    """Return the map in the stage frame, the covariance of the angular misclosure, factors.

    `sigma` is the noise of a reading as it counts at each site, m; what is kept has
    no images yet. The uncertainty is given if it is `with_uncertainty`.
    """
    fitted, sense = model.fitted, measurements.sense
    system = model.problem.system
    u_xy = np.full((2, *system.grid.views.shape), np.nan)
    u_theta = np.full(system.angular.n_lines, np.nan)
    closure = None
    kept_parts = Kept()
    if cover is not None:
        lines = LinesCovariance(cover, (fitted.xy.sigma, fitted.theta.sigma))
        if with_uncertainty:
            u_xy, added = _u_of_marks(model, cover, sigma)
            kept_parts = Kept(added=added)
        if system.angular.n_views:
            variance, closure = lines.of_stage(model.problem.conditions)
            u_theta = np.sqrt(variance) if with_uncertainty else u_theta
        if with_uncertainty and model.problem.terms:
            factors, angular = _kept_terms(model, lines, sense, rms(u_theta))
            kept_parts = replace(kept_parts, factors=factors, angular=angular)
    field = np.where(system.known_sites, fitted.field, complex(np.nan, np.nan))
    g_theta = np.where(system.known_lines, fitted.g_theta, np.nan)
    field = turned_over(sense, field)
    emap = ErrorMap.of_maps(
        measurements.artifact.field,
        (
            np.stack([field.real, field.imag]),
            np.stack([turned_over(sense, u, sign=1) for u in u_xy]),
        ),
        (
            lines_turned_over(sense, g_theta),
            lines_turned_over(sense, u_theta, sign=1),
        ),
    )
    datum = model.problem.conditions.datum
    return replace(emap, datum_theta=datum), closure, kept_parts


def _u_of_marks(
    model: ModelFit, cover: MapsCovariance, sigma: np.ndarray
) -> tuple[np.ndarray, np.ndarray | None]:
    """Return u of the XY map, (2, nx, ny), m, and what unequal noise adds to O and R, if it does.

    The latter as `Kept.added`: they are combinations of nodes, whose noises are correlated.
    """
    system = model.problem.system
    variance = cover.of_stage
    added = None
    if system.grid.n_sites <= MAX_NODES:
        more = structured(model, cover)
        variance = variance + more
        if np.any(more):
            added = np.asarray(structured(model, cover, system.gauge.shear))
    return np.sqrt(np.maximum(variance, 0.0)) * sigma, added


def _kept_terms(
    model: ModelFit, lines: LinesCovariance, sense: Sense, u_theta: float
) -> tuple[Factors | None, dict[str, np.ndarray]]:
    """Return the factors of the terms, and what they contribute to u of lines, rad, (K,) each.

    `u_theta` is that of the lines, rms, rad.
    """
    columns, sigma_m = model.equations.columns, model.fitted.xy.sigma
    roots = roots_by_term(lines.cover.covariance_of_terms, columns)
    beside_map = _beside_map(model, lines, sense)
    factors = saved_terms(lines.cover, roots, sense, beside_map)
    if not lines.angular.n_views:
        return factors, {}
    turned = lines.stage_of_terms(model.problem.conditions) * sigma_m
    of_lines = angular_terms(turned, roots, least=NEGLIGIBLE * u_theta)
    return factors, {
        name: lines_turned_over(sense, u, sign=1) for name, u in of_lines.items()
    }


def _beside_map(
    model: ModelFit, cover: LinesCovariance, sense: Sense
) -> dict[str, np.ndarray]:
    """Return what a unit of each coefficient makes of the plate, the lines and the microscope."""
    problem = model.problem
    system, length = problem.system, problem.half_width_m
    if system.grid.n_sites > MAX_FULL:
        return {}
    plates = cover.cover.maps_of_terms()[1].T
    lines = np.zeros((len(plates), 2, system.angular.n_lines))
    if system.angular.n_views:
        stage, of_plate = cover.terms
        of_plate = of_plate + stage[system.known_lines].mean(axis=0)
        stage = lines_turned_over(sense, stage)
        lines = np.stack([stage, of_plate]).transpose(2, 0, 1) * length
    of_offsets = block_of_offsets()
    measured = -length * np.array(
        [
            [
                column.term == of_offsets.name and column.component == component
                for component in MICROSCOPE_PARTS
            ]
            for column in model.equations.columns.columns
        ],
        dtype=float,
    )
    return {
        "plate": np.stack([plates.real, plates.imag], axis=1).reshape(
            len(plates), 2, *system.grid.views.plate_shape
        ),
        "lines": lines,
        of_offsets.name: measured,
    }


def _artifact_map(
    model: ModelFit, cover: MapsCovariance | None, sigma_m: float, of_map: float
) -> ArtifactMap:
    """Return the plate's map.

    `sigma_m` is the noise of a reading as it counts there, `of_map` the scale of the stage's map.
    """
    problem, fitted = model.problem, model.fitted
    system, length = problem.system, problem.half_width_m
    plate = np.where(system.known_marks, fitted.plate, complex(np.nan, np.nan))
    unscaled = ReferenceLength(ReferenceKind.ARTIFACT, 0.0)
    scale = scale_of(
        system, unscaled, field=fitted.field, plate=fitted.plate, half_width_m=length
    )
    scale += of_map * length  # what a reference took from the plate
    u = float("nan")
    sigma = fitted.xy.sigma
    u_x = u_y = np.full(plate.shape, np.nan)
    u_theta = np.full(system.angular.n_lines, np.nan)
    if cover is not None:
        u = float(np.sqrt(cover.variance_of_scale(unscaled))) * sigma / length
    # the plate's covariance takes a factor of its own, as large as that of the stage
    if cover is not None and math.isfinite(u) and system.grid.n_sites <= UNASKED_SITES:
        variance = cover.of_plate
        if system.grid.n_sites <= MAX_NODES and placed(problem) is None:
            variance = variance + image_variances(model, cover, plate=True)
        u_x, u_y = np.sqrt(variance) * sigma_m
        if system.angular.n_views and problem.conditions.datum is ThetaDatum.ZERO_MEAN:
            u_theta = np.sqrt(
                LinesCovariance(cover, (sigma, fitted.theta.sigma)).of_plate()
            )
    return ArtifactMap(
        ax=plate.real.copy(),
        ay=plate.imag.copy(),
        a_theta=np.where(system.known_plate_lines, fitted.a_theta, np.nan),
        magnification=scale / length,
        u_magnification=u,
        u_ax=u_x,
        u_ay=u_y,
        u_a_theta=u_theta,
    )


def views_of(
    measurements: Measurements, problem: Problem, parameters: np.ndarray
) -> tuple[ViewResult, ...]:
    """Return the results of the views for all misalignments, m, (size,); NaN where unknown."""
    system = problem.system
    phi = dict(zip(system.angular_index, parameters[system.phi_at], strict=True))
    offset: dict[int, complex] = {}
    for row, i in enumerate(system.grid_index):
        phi[i] = parameters[3 * row] + problem.turn_rad[row] * problem.half_width_m
        offset[i] = problem.to_stage[row] * complex(
            *parameters[3 * row + 1 : 3 * row + 3]
        )
    nan = complex(np.nan, np.nan)
    return tuple(
        ViewResult(
            v.view.name,
            v.view.rotation_rad,
            *v.view.translation_m,
            phi=float(phi.get(i, np.nan) / problem.half_width_m),
            tx=offset.get(i, nan).real,
            ty=offset.get(i, nan).imag,
            used=v.used,
            rejected=sum(v.rejected.values()),
            **weights_read(problem, i),
        )
        for i, v in enumerate(measurements.views)
    )
