# SPDX-License-Identifier: Apache-2.0
"""Calibration by joint least squares: readings to result."""

import numpy as np

from selfcal_ros.errors import InputError, NoDataError, NotIdentifiableError
from selfcal_ros.estimation.blas_threads import one_thread
from selfcal_ros.estimation.datum.angular import conditions_for, misclosure_warning
from selfcal_ros.estimation.datum.covariance import FieldCovariance, angular_variance
from selfcal_ros.estimation.datum.scale import scale_datum
from selfcal_ros.estimation.joint.fit import JointFit
from selfcal_ros.estimation.joint.model_fit import ModelFit, fit_model
from selfcal_ros.estimation.joint.noise import disagreement
from selfcal_ros.estimation.joint.problem import Problem, repeats_of
from selfcal_ros.estimation.lattice.maps import PHASES
from selfcal_ros.estimation.lattice.readings import angular_data, grid_data
from selfcal_ros.estimation.normal.cache import system_for
from selfcal_ros.estimation.normal.equations import MAX_DIRECT_SITES
from selfcal_ros.estimation.observability.plan_check import with_unseen_modes
from selfcal_ros.estimation.observability.rank import (
    measured_observability,
    plan_observability,
    refusal,
)
from selfcal_ros.estimation.options import Options
from selfcal_ros.estimation.terms.ground import ground_of
from selfcal_ros.model.error_map import ErrorMap, ThetaDatum
from selfcal_ros.model.readings import Measurements, Sense
from selfcal_ros.model.result import (
    ArtifactMap,
    CalibrationResult,
    Noise,
    Observability,
    ViewResult,
)
from selfcal_ros.model.view import Plan


def solve_joint(measurements: Measurements, options: Options) -> CalibrationResult:
    """Calibrate by joint least squares; see `selfcal_ros.estimation.api.calibrate`."""
    with one_thread():
        problem, seen = prepare(measurements, options)
        return _result(measurements, options, model=fit_model(problem), seen=seen)


def prepare(measurements: Measurements, options: Options) -> tuple[Problem, Observability]:
    """Return the problem that the readings pose and what it determines.

    Raises
    ------
    NoDataError, NotIdentifiableError, InputError
        As `selfcal_ros.estimation.api.calibrate`.
    """
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
        if not plan_observability(plan).identifiable:
            seen = with_unseen_modes(seen, system, plan).observability
        raise NotIdentifiableError(refusal(seen), seen)
    half_width_m = measurements.artifact.grid_pitch_m * max(measurements.artifact.half)
    conditions = conditions_for(system, options.datum_theta, measurements.sense, half_width_m)
    direct = system.direct or bool(options.uncertainty) or bool(options.terms)
    if direct and system.grid.n_sites > MAX_DIRECT_SITES:
        raise InputError("options", f"the uncertainty of {system.grid.n_sites} sites is beyond "
                         f"the limit of {MAX_DIRECT_SITES}", "solve without the uncertainty")
    return Problem(
        system, grid, angular, *repeats_of(measurements), half_width_m, conditions, direct,
        options.reference, options.misalignment_model == "rigid", options.terms,
        options.drift_degree, ground_of(measurements, grid, half_width_m)), seen


def _result(measurements: Measurements, options: Options, *, model: ModelFit,
            seen: Observability) -> CalibrationResult:
    problem, found = model.problem, model.found
    error_map, closure = _error_map(measurements, options, model=model)
    xy, theta = found.xy, found.theta
    noise = Noise(xy.sigma, theta.sigma, xy.repeats, theta.repeats, xy.residuals,
                  theta.residuals, xy.dof_repeats, theta.dof_repeats, xy.dof_residuals,
                  theta.dof_residuals)
    warnings = (
        disagreement(xy, "grid readings", (1e6, "µm"), 1e-13),
        disagreement(theta, "angular readings", (np.degrees(3600), "arcsec"), 1e-13),
        *_datum_warnings(options, problem, found, closure=closure),
        "" if problem.direct or options.uncertainty is not None else
        "no uncertainty map, because of the size of the field: ask for it (--uncertainty always)")
    return CalibrationResult(
        measurements.plan_id, error_map, _artifact_map(problem, found),
        _views(measurements, problem, found), seen, noise, measurements.all_rejected(),
        warnings=tuple(text for text in warnings if text), method="joint",
        sense=str(measurements.sense), extra={"solver": found.solver})


def _error_map(measurements: Measurements, options: Options, *, model: ModelFit,
               ) -> tuple[ErrorMap, np.ndarray | None]:
    """Return the map in the stage frame, and the covariance of the angular misclosure."""
    problem, found = model.problem, model.found
    system, length = problem.system, problem.half_width_m
    u_x = u_y = np.full(system.grid.views.shape, np.nan)
    u_theta, closure = np.full(system.angular.n_lines, np.nan), None
    if problem.direct and options.uncertainty is not False:
        scale = (scale_datum(system, options.reference, length) if options.reference else None)
        cover = FieldCovariance(system, found.inverse, scale, found.xy.sigma, model.spread)
        u_x, u_y = (np.sqrt(v) * found.xy.sigma for v in cover.diagonal())
    if problem.direct and options.uncertainty is not False and system.angular.n_views:
        variance, closure = angular_variance(
            cover, problem.conditions, sigma=(found.xy.sigma, found.theta.sigma),
            half_width_m=length)
        u_theta = np.sqrt(variance)
    known = system.known_sites
    field = np.where(known, found.field, complex(np.nan, np.nan))
    g_theta = np.where(system.known_lines, found.g_theta, np.nan)
    o, r = system.gauge.first_order(found.field)
    if measurements.sense is Sense.PLATE_MOVES:
        field, u_x, u_y = -field[::-1, ::-1], u_x[::-1, ::-1], u_y[::-1, ::-1]
        back = -np.arange(len(g_theta)) % max(len(g_theta), 1)
        g_theta, u_theta = -g_theta[back], u_theta[back]
    return ErrorMap(measurements.artifact, field.real.copy(), field.imag.copy(), u_x, u_y,
                    g_theta, u_theta, o / length, r / length,
                    problem.conditions.datum), closure


def _artifact_map(problem: Problem, found: JointFit) -> ArtifactMap:
    system = problem.system
    plate = np.where(system.known_marks, found.plate, complex(np.nan, np.nan))
    return ArtifactMap(plate.real.copy(), plate.imag.copy(),
                       np.where(system.known_plate_lines, found.a_theta, np.nan))


def _views(measurements: Measurements, problem: Problem, found: JointFit) -> tuple[ViewResult, ...]:
    system = problem.system
    values = np.where(system.known_views, found.parameters, np.nan)
    phi = dict(zip(system.angular_index, values[system.phi_at], strict=True))
    offset: dict[int, complex] = {}
    for row, i in enumerate(system.grid_index):
        phi[i] = values[3 * row]
        turn = PHASES[problem.grid.poses[row].q]
        offset[i] = turn * complex(*values[3 * row + 1:3 * row + 3])
    nan = complex(np.nan, np.nan)
    return tuple(
        ViewResult(v.view.name, v.view.rotation_rad, *v.view.translation_m,
                   phi=float(phi.get(i, np.nan) / problem.half_width_m),
                   tx=offset.get(i, nan).real, ty=offset.get(i, nan).imag, used=v.used,
                   rejected=sum(v.rejected.values()))
        for i, v in enumerate(measurements.views))


def _datum_warnings(options: Options, problem: Problem, found: JointFit, *,
                    closure: np.ndarray | None) -> list[str]:
    if not problem.system.angular.n_views:
        return []
    if problem.conditions.datum is not options.datum_theta:
        return ["theta: no half axis has two known sites, so the datum is zero_mean"]
    if problem.conditions.datum is ThetaDatum.ZERO_MEAN or closure is None:
        return []
    return [misclosure_warning(found.misclosure, closure)]


