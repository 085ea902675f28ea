# SPDX-License-Identifier: Apache-2.0
"""Calibration by joint least squares: readings to result."""

import math
from collections.abc import Collection
from dataclasses import replace
from functools import partial
from typing import Any, cast

import numpy as np

from selfcal_ros.blocks import block_of
from selfcal_ros.errors import (
    NoDataError,
    NotIdentifiableError,
    NotSettledError,
)
from selfcal_ros.estimation.datum.angular import (
    LinesCovariance,
    conditions_for,
    misclosure_test,
)
from selfcal_ros.estimation.datum.covariance import NO_NOISE_M, MapsCovariance, scale_of
from selfcal_ros.estimation.joint.finer import fit_model
from selfcal_ros.estimation.joint.fit import noise_gain
from selfcal_ros.estimation.joint.images import IMAGES, image_noise
from selfcal_ros.estimation.joint.model_fit import ModelFit
from selfcal_ros.estimation.joint.noise_effects import (
    ADDED,
    MAX_STRUCTURED,
    image_variances,
    structured,
)
from selfcal_ros.estimation.joint.problem import Problem, problem_of
from selfcal_ros.estimation.joint.solved import (
    MAX_FULL,
    MICROSCOPE_PARTS,
    OF_OFFSETS,
    Solved,
    angular_terms,
    kept_residuals,
    noise_of,
    saved_terms,
)
from selfcal_ros.estimation.lattice.readings import angular_data, grid_data
from selfcal_ros.estimation.multifrontal.factor import one_thread
from selfcal_ros.estimation.normal.equations import NormalEquations
from selfcal_ros.estimation.normal.placed import PlacedEquations
from selfcal_ros.estimation.normal.systems import system_for
from selfcal_ros.estimation.observability.plan_check import with_unseen_modes
from selfcal_ros.estimation.observability.rank import identifies, measured_observability, refusal
from selfcal_ros.estimation.options import Options, ReferenceKind, ReferenceLength
from selfcal_ros.estimation.terms.equations import LEAST_NOISE_M, TermEquations
from selfcal_ros.estimation.terms.sizes import require_terms_told
from selfcal_ros.estimation.terms.visits import check_visits, ground_of
from selfcal_ros.model.error_map import ErrorMap, ThetaDatum, rms
from selfcal_ros.model.readings import Measurements, Sense
from selfcal_ros.model.result import (
    ArtifactMap,
    CalibrationResult,
    Observability,
    ViewResult,
)
from selfcal_ros.model.verdict import Finding, ModelResult, TermEstimate, TermResult
from selfcal_ros.model.view import Plan, cells_seen

UNASKED_SITES = 201 * 201
"""Largest field of which the uncertainty is given unasked: a second, beyond it takes many."""


def solve_joint(measurements: Measurements, options: Options) -> Solved:
    """Calibrate by joint least squares; see `selfcal_ros.estimation.api.calibrate`.

    Readings so far from what is assumed of them that the estimate does not converge are solved
    without the assumptions, and cannot be qualified. Where nothing but rounding is left no
    assumption can be weighed against it: what the views determine by themselves is enough.
    """
    with one_thread():
        model, seen, whole = _fitted(measurements, options)
        return replace(_solved(measurements, options, model=model, seen=seen),
                       converged=whole or model.found.xy.sigma < LEAST_NOISE_M)


def fit_joint(measurements: Measurements, options: Options) -> ModelFit:
    """Return the fit behind `solve_joint` alone."""
    with one_thread():
        return _fitted(measurements, options)[0]


def _fitted(measurements: Measurements,
            options: Options) -> tuple[ModelFit, Observability, bool]:
    """Return the fit, what the readings determine, and if it has all that is assumed.

    Where that does not converge with the places of the stage readings count for their sites, and
    then less is assumed.
    """
    of_visits = tuple(term for term in options.assumed if term.block.needs_visits)
    failed: NotSettledError | None = None
    for assumed in dict.fromkeys((options.assumed, of_visits, ())):
        problem, seen = prepare(measurements, replace(options, assumed=assumed))
        for at_places in ((True, False) if problem.moves else (False,)):
            try:
                model = fit_model(replace(problem, at_places=at_places),
                                  partial(require_terms_told, seen=seen))
            except NotSettledError as error:
                failed = error
                continue
            return model, seen, assumed == options.assumed and at_places == problem.moves
    raise failed or AssertionError("something was tried")


def prepare(measurements: Measurements, options: Options) -> tuple[Problem, Observability]:
    """Return the problem that the readings pose and what it determines.

    Raises
    ------
    NoDataError, NotIdentifiableError, InputError
        As `selfcal_ros.estimation.api.calibrate`.
    """
    check_visits(measurements)
    grid, angular = grid_data(measurements), angular_data(measurements)
    if not grid.index:
        raise NoDataError(f"plan '{measurements.plan_id}'", "no grid mark was read",
                          "record detections of the plate's marks in at least three views")
    system = system_for(grid, angular)
    seen = measured_observability(system, measurements.artifact,
                                  tuple(v.view for v in measurements.views))
    if not seen.identifiable:
        plan = Plan(measurements.plan_id, measurements.artifact,
                    tuple(v.view for v in measurements.views))
        if not identifies(plan.artifact, plan.views):
            seen = with_unseen_modes(seen, system, plan).observability
        raise NotIdentifiableError(refusal(seen), seen)
    half_width_m = measurements.artifact.grid_pitch_m * max(measurements.artifact.reach)
    conditions = conditions_for(system, options.datum_theta, measurements.sense, half_width_m)
    ground = ground_of(measurements, grid, half_width_m, drift_degree=options.drift_degree)
    terms = tuple(
        term for term in options.model_terms(
            visits=all(v is not None for v in ground.visits), assumed=options.finite_rotations)
        if ground.has(term.name))
    images = image_noise(
        measurements.artifact, [v.view for v in measurements.views], system,
        ground.yaw if any(term.block.of_images for term in terms) else None,
    ) if measurements.has_images else None
    return problem_of(measurements, options, system, ground, readings=(grid, angular),
                      conditions=conditions, terms=terms, known=system.known_sites,
                      images=images), seen


def _solved(measurements: Measurements, options: Options, *, model: ModelFit,
            seen: Observability) -> Solved:
    problem, found = model.problem, model.found
    asked = options.uncertainty
    wanted = problem.system.grid.n_sites <= UNASKED_SITES if asked is None else asked
    exact = options.reference is not None and found.xy.sigma == 0
    least = NO_NOISE_M if exact else found.xy.sigma  # 0 would hide the u of the reference
    sigma = np.full(problem.system.known_sites.shape, least)
    if wanted:
        sigma = sigma * noise_gain(problem, found)
    cover = None
    # the datum of the axes is tested in any case
    if wanted or problem.conditions.datum is ThetaDatum.XY_AXES:
        cover = MapsCovariance(problem.system, found.inverse, options.reference, terms=model.spread,
                               half_width_m=problem.half_width_m, sigma_m=least)
    error_map, closure, kept = _error_map(measurements, model, cover, sigma, wanted=wanted)
    artifact_map = _artifact_map(model, cover if wanted else None, rms(sigma))
    findings = (*_unchecked(problem.system, measurements.sense),
                *_magnification(artifact_map, options))
    if not wanted and asked is None:
        findings = (Finding("no_uncertainty"), *findings)
    axes = (1.0, 0.0)
    if problem.conditions.datum is ThetaDatum.XY_AXES and closure is not None:
        axes = misclosure_test(found.misclosure, closure)
    result = CalibrationResult(
        measurements.plan_id, error_map, artifact_map,
        views_of(measurements, problem, np.where(
            problem.system.known_views, found.parameters, np.nan)), seen,
        noise_of(found.xy, found.theta),
        measurements.all_rejected(), findings=findings, method="joint",
        sense=str(measurements.sense),
        extra={**kept, **_kept_images(measurements, model),
               **kept_residuals(measurements, model)},
        run_id=measurements.run_id,
        model=ModelResult("rigid" if problem.rigid else "linear", term_results(
            model, {term.name for term in options.terms})),
        placed_plate=measurements.artifact if measurements.artifact.map_grid else None)
    return Solved(result, found.xy, found.theta, model, axes)


def _kept_images(measurements: Measurements, model: ModelFit) -> dict[str, Any]:
    """Return what a result keeps of the noise of images in its grid views, see `IMAGES`."""
    views = [measurements.views[index].view for index in model.problem.grid.index]
    seen = cells_seen(measurements.artifact, views)
    if model.problem.images is None or seen is None:
        return {}
    noises = model.problem.images.noises(model.found.residuals)
    names = list(dict.fromkeys(name for name, _ in seen))
    return {IMAGES: {"share": noises.share, "dof_mark": noises.dof_mark,
                  "placing": [names.index(name) for name, _ in seen],
                  "step": [list(step) for _, step in seen]}}


def _magnification(found: ArtifactMap, options: Options) -> tuple[Finding, ...]:
    """Return whether plate and encoders differ in scale by more than is plausible."""
    if options.reference is not None or not (
            abs(found.magnification) > options.magnification_limit):
        return ()
    return (Finding("magnification", found.magnification, found.u_magnification, "m/m"),)


def _unchecked(system: NormalEquations, sense: Sense) -> tuple[Finding, ...]:
    """Return the sites and lines of the map, stage frame, that only single readings determine."""
    flipped = sense is Sense.PLATE_MOVES  # as the map itself: G(X) = -H(-X)
    unchecked = system.unchecked_sites[::-1, ::-1] if flipped else system.unchecked_sites
    sites = np.argwhere(unchecked) - np.array(unchecked.shape) // 2
    lines = np.argwhere(system.unchecked_lines)
    if not len(sites) and not len(lines):
        return ()
    if flipped:
        lines = np.sort(-lines % max(system.angular.n_lines, 1), axis=0)
    return (Finding("unchecked", details={"sites": sites.tolist(), "lines": lines[:, 0].tolist()}),)


def weights_read(problem: Problem, index: int) -> dict[str, Any]:
    """Return the weights of what was read in a view, for `ViewResult`."""
    out: dict[str, Any] = {"read_grid": 0, "read_angular": 0}
    if index in problem.grid.index:
        row = problem.grid.index.index(index)
        weight, field = problem.grid.weight[row], problem.system.grid.views.in_field[row]
        out["read_grid"] = _compact(weight, weight[field])
    if index in problem.angular.index:
        weight = problem.angular.weight[problem.angular.index.index(index)]
        out["read_angular"] = _compact(weight, weight)
    return out


def _compact(weight: np.ndarray, expected: np.ndarray) -> Any:
    """Return one number where all expected readings have it, else a number a reading."""
    if len(expected) and (expected == expected.flat[0]).all():
        return _short(float(expected.flat[0]))
    return [[_short(w) for w in row] for row in weight.tolist()] if weight.ndim == 2 else [
        _short(w) for w in weight.tolist()]


def _short(weight: float) -> float | int:
    """Return a weight as an integer where it is one, else with nine digits."""
    return int(weight) if weight == int(weight) else float(f"{weight:.9g}")


def term_results(model: ModelFit, declared: Collection[str]) -> tuple[TermResult, ...]:
    """Return the estimates of each term of the model; those not `declared` are assumed."""
    if model.equations is None:
        return ()
    columns, covariance = model.equations.columns.columns, model.covariance
    told = np.abs(model.equations.untold(model.equations.free)).max(axis=1, initial=0.0) < 1e-6
    given = {test.name: test.given for test in model.sizes if test.raised}
    out = []
    for term in model.problem.terms:
        estimates = tuple(
            TermEstimate(model.problem.ground.name_of(c.term, c.view), c.component,
                         float(model.coefficients[i]) if told[i] else float("nan"),
                         float(np.sqrt(max(covariance[i, i], 0.0)) * model.found.xy.sigma)
                         if told[i] else float("nan"), c.unit)
            for i, c in enumerate(columns) if c.term == term.name)
        size = None if term.free else term.size
        out.append(TermResult(str(term.name), given.get(term.name, size), estimates,
                              size if term.name in given else None,
                              "declared" if term.name in declared else "default"))
    return tuple(out)


def _error_map(measurements: Measurements, model: ModelFit, cover: MapsCovariance | None,
               sigma: np.ndarray, *, wanted: bool
               ) -> tuple[ErrorMap, np.ndarray | None, dict[str, Any]]:
    """Return the map in the stage frame, the covariance of the angular misclosure, factors.

    `sigma` is the noise of a reading as it counts at each site, m; the factors are those of
    `selfcal_ros.estimation.joint.solved`. The uncertainty is given if it is `wanted`.
    """
    problem, found = model.problem, model.found
    system, length = problem.system, problem.half_width_m
    u_x = u_y = np.full(system.grid.views.shape, np.nan)
    u_theta, closure = np.full(system.angular.n_lines, np.nan), None
    kept: dict[str, Any] = {}
    if cover is not None:
        lines = LinesCovariance(cover, (found.xy.sigma, found.theta.sigma))
        if wanted:
            variance = cover.of_stage
            if system.grid.n_sites <= MAX_STRUCTURED:
                more = structured(model, cover)
                variance = variance + more
                if np.any(more):  # O and R are combinations of nodes, whose noises are correlated
                    kept[ADDED] = structured(model, cover, system.gauge.shear)
            u_x, u_y = np.sqrt(np.maximum(variance, 0.0)) * sigma
        if wanted and model.equations is not None:
            kept |= saved_terms(cover, model.equations.columns, measurements.sense,
                                _beside_map(model, lines, measurements.sense))
            kept |= angular_terms(cover, model.equations.columns, found.xy.sigma,
                                  system.known_lines)
        if system.angular.n_views:
            variance, closure = lines.of_stage(problem.conditions)
            u_theta = np.sqrt(variance) if wanted else u_theta
    known = system.known_sites
    field = np.where(known, found.field, complex(np.nan, np.nan))
    g_theta = np.where(system.known_lines, found.g_theta, np.nan)
    o, r = system.gauge.first_order(found.field)
    if measurements.sense is Sense.PLATE_MOVES:
        field, u_x, u_y = -field[::-1, ::-1], u_x[::-1, ::-1], u_y[::-1, ::-1]
        back = -np.arange(len(g_theta)) % max(len(g_theta), 1)
        g_theta, u_theta = -g_theta[back], u_theta[back]
    return ErrorMap(measurements.artifact.field, field.real.copy(), field.imag.copy(), u_x, u_y,
                    g_theta, u_theta, o / length, r / length,
                    problem.conditions.datum), closure, kept


def _beside_map(model: ModelFit, cover: LinesCovariance, sense: Sense) -> dict[str, np.ndarray]:
    """Return what a unit of each coefficient makes of the plate, the lines and the microscope."""
    problem, columns = model.problem, cast(TermEquations, model.equations).columns
    system, length = problem.system, problem.half_width_m
    if system.grid.n_sites > MAX_FULL:
        return {}
    plates = cover.cover.maps_of_terms()[1].T
    lines = np.zeros((len(plates), 2, 0))
    if system.angular.n_views:
        stage, of_plate = cover.terms
        of_plate = of_plate + stage[system.known_lines].mean(axis=0)
        lines = np.stack([stage, of_plate]).transpose(2, 0, 1) * length
        if sense is Sense.PLATE_MOVES:
            lines[:, 0] = -lines[:, 0, -np.arange(lines.shape[2]) % lines.shape[2]]
    of_offsets = -length * np.array([[
        block_of(column.term).of_offsets and column.component == part
        for part in MICROSCOPE_PARTS] for column in columns.columns], dtype=float)
    return {"plate": np.stack([plates.real, plates.imag], axis=1).reshape(
                len(plates), 2, *system.grid.views.plate_shape),
            "lines": lines, OF_OFFSETS: of_offsets}


def _artifact_map(model: ModelFit, cover: MapsCovariance | None, sigma_m: float) -> ArtifactMap:
    """Return the plate's map; `sigma_m` is the noise of a reading as it counts there."""
    problem, found = model.problem, model.found
    system, length = problem.system, problem.half_width_m
    plate = np.where(system.known_marks, found.plate, complex(np.nan, np.nan))
    alone = ReferenceLength(ReferenceKind.ARTIFACT, 0.0)
    scale = scale_of(system, alone, field=found.field, plate=found.plate, half_width_m=length)
    u, sigma = float("nan"), found.xy.sigma
    u_x = u_y = np.full(plate.shape, np.nan)
    u_theta = np.full(system.angular.n_lines, np.nan)
    if cover is not None:
        u = float(np.sqrt(cover.variance_of_scale(alone))) * sigma / length
    # the plate's covariance takes a factor of its own, as large as that of the stage
    if cover is not None and math.isfinite(u) and system.grid.n_sites <= UNASKED_SITES:
        variance = cover.of_plate
        if system.grid.n_sites <= MAX_STRUCTURED and not isinstance(system, PlacedEquations):
            variance = variance + image_variances(model, cover, plate=True)
        u_x, u_y = np.sqrt(variance) * sigma_m
        if system.angular.n_views and problem.conditions.datum is ThetaDatum.ZERO_MEAN:
            u_theta = np.sqrt(LinesCovariance(cover, (sigma, found.theta.sigma)).of_plate())
    return ArtifactMap(plate.real.copy(), plate.imag.copy(),
                       np.where(system.known_plate_lines, found.a_theta, np.nan),
                       scale / length, u, u_x, u_y, u_theta)


def views_of(measurements: Measurements, problem: Problem,
             parameters: np.ndarray) -> tuple[ViewResult, ...]:
    """Return the results of the views for all misalignments, m, (size,); NaN where unknown."""
    system = problem.system
    phi = dict(zip(system.angular_index, parameters[system.phi_at], strict=True))
    offset: dict[int, complex] = {}
    for row, i in enumerate(system.grid_index):
        phi[i] = parameters[3 * row] + problem.turn_rad[row] * problem.half_width_m
        turn = problem.grid.poses[row].phase * np.exp(1j * problem.turn_rad[row])
        offset[i] = turn * complex(*parameters[3 * row + 1:3 * row + 3])
    nan = complex(np.nan, np.nan)
    return tuple(
        ViewResult(v.view.name, v.view.rotation_rad, *v.view.translation_m,
                   phi=float(phi.get(i, np.nan) / problem.half_width_m),
                   tx=offset.get(i, nan).real, ty=offset.get(i, nan).imag, used=v.used,
                   rejected=sum(v.rejected.values()), **weights_read(problem, i))
        for i, v in enumerate(measurements.views))
