# SPDX-License-Identifier: Apache-2.0
"""Views of a known plate to a result: the map of the stage, its uncertainty, what has changed."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.special import chdtrc, fdtrc

from selfcal_ros.errors import InputError, NoDataError
from selfcal_ros.estimation.comparison.covariance import dof_of_marks, kept_covariance, share_of
from selfcal_ros.estimation.comparison.maps import joint_dof
from selfcal_ros.estimation.datum.angular import Conditions
from selfcal_ros.estimation.joint.images import stops_of
from selfcal_ros.estimation.joint.problem import (
    F_LEVEL,
    MIN_REPEAT_DOF,
    SAME,
    NoiseEstimate,
    Problem,
    coverage_factor,
    noise_estimate,
    repeats_of,
    turned,
)
from selfcal_ros.estimation.joint.solve import views_of
from selfcal_ros.estimation.joint.solved import noise_of
from selfcal_ros.estimation.lattice.connectivity import first_order
from selfcal_ros.estimation.lattice.maps import LatticeViews
from selfcal_ros.estimation.lattice.readings import angular_data, grid_data
from selfcal_ros.estimation.multifrontal.factor import one_thread
from selfcal_ros.estimation.normal.systems import system_for
from selfcal_ros.estimation.options import Options
from selfcal_ros.estimation.recheck.change import NewLines, NewMap, line_change, map_change, record
from selfcal_ros.estimation.recheck.plate import KnownPlate, on_plate
from selfcal_ros.estimation.recheck.same_plate import check_plate
from selfcal_ros.estimation.recheck.views import (
    Gain,
    PlateReadings,
    Seen,
    line_gain,
    seen_field,
    stacked,
)
from selfcal_ros.estimation.terms.columns import term_columns
from selfcal_ros.estimation.terms.places import places_of
from selfcal_ros.estimation.terms.visits import ground_of, without_noise
from selfcal_ros.estimation.verdict.judge import provenance_of
from selfcal_ros.estimation.verdict.uncertainty import INTERPOLATION, budget_lines
from selfcal_ros.model.error_map import MANY_DOF, ErrorMap, ThetaDatum, rms
from selfcal_ros.model.readings import Measurements, Sense
from selfcal_ros.model.result import CalibrationResult, Noise, Observability
from selfcal_ros.model.terms import ModelTerm
from selfcal_ros.model.verdict import BudgetLine, Finding, Grade, ModelResult, TermResult, Verdict
from selfcal_ros.model.view import cells_seen

KEY = "recheck"
"""Key of what a recheck found among the extras of a result."""

MOST_OF_IMAGES = 3200
"""Largest number of readings of images: their covariance is dense, 8 bytes (2 n)^2."""

LEAST_PART = 1e-6
"""Least part of the variance of a reading that is a mark's own."""


@dataclass(frozen=True, eq=False)
class Rechecked:
    """Results from views of a known plate.

    Attributes
    ----------
    readings : PlateReadings
        The readings.
    new, lines : NewMap, NewLines
        Both maps, stage frame.
    seen : Seen
        The solution of the marks, frame of the equations.
    xy, theta : NoiseEstimate
        Noise of one reading of each kind.
    """

    readings: PlateReadings
    new: NewMap
    lines: NewLines
    seen: Seen
    xy: NoiseEstimate
    theta: NoiseEstimate

    def error_map(self, plate: KnownPlate) -> ErrorMap:
        """Return the map with its uncertainty, without scale unless a reference length sets it."""
        new, artifact, known = self.new, self.new.artifact, self.new.known
        xy = new.xy if plate.reference else new.without_scale(
            new.xy.reshape(-1)).reshape(new.xy.shape)
        variance = np.sum(list(new.variances(plate).values()), axis=0).reshape(xy.shape)
        (gx, gy), (u_x, u_y) = (np.where(known, values, np.nan)
                                for values in (xy, np.sqrt(variance)))
        o, r = first_order(artifact, gx + 1j * gy)
        theta = self.lines.values
        u_theta = np.where(np.isfinite(theta), np.sqrt(np.diag(self.lines.covariance(plate))),
                           np.nan)
        return ErrorMap(artifact, gx, gy, u_x, u_y, theta, u_theta, o, r,
                        ThetaDatum.ZERO_MEAN)


def recheck_of(measurements: Measurements, options: Options, plate: KnownPlate) -> Rechecked:
    """Return the parts from which `recheck` assembles its result."""
    if options.method != "joint" or options.reference is not None:
        raise InputError("options", "a recheck always uses the method joint and the reference "
                         "length of the plate's calibration", "leave both out")
    readings = plate_readings(on_plate(measurements, plate), options, plate)
    xy, theta = _noise(readings, plate)
    new, seen = _new_map(readings, plate, xy, options)
    return Rechecked(readings, new, _new_lines(readings, plate, theta), seen, xy, theta)


@one_thread()
def recheck(measurements: Measurements, options: Options, plate: KnownPlate) -> CalibrationResult:
    """Return the map of the stage from views of a known plate, and what has changed.

    Parameters
    ----------
    measurements : Measurements
        Views of the plate, one or more.
    options : Options
        Terms of the model, with sizes.
    plate : KnownPlate
        The plate.

    Raises
    ------
    NoDataError, NotIdentifiableError, InputError
        If no known mark was read, too little is known, or the plate lies otherwise than planned
        (`PlacingError`).
    """
    solved = recheck_of(measurements, options, plate)
    readings, seen, new, lines = solved.readings, solved.seen, solved.new, solved.lines
    known = np.tile(new.known.ravel(), 2)
    parts = {name: variance[known] for name, variance in new.variances(plate).items()}
    of_lines = np.isfinite(lines.values)
    covers = {"xy": new.covariance(plate),
              "theta": lines.covariance(plate)[np.ix_(of_lines, of_lines)]}
    found = record(map_change(new, plate), line_change(lines, plate), new.artifact, plate)
    noise = _with_coverage(noise_of(solved.xy, solved.theta), parts, plate)
    other = check_plate(readings.measurements, plate, solved.xy.sigma)
    failed = (other,) if other is not None else _misfit(
        seen, dof_of_marks(plate.result) if len(readings.stop) else solved.xy.dof)
    found["passes"] = min(view.view.repeats for view in measurements.views)
    before, problem = plate.result.verdict, readings.problem
    unknowns = 2 * int(seen.known.sum()) + problem.system.grid.n_misalignments
    declared = {term.name for term in options.terms}
    terms = tuple(TermResult(
        str(term.name), term.size, (), None, "declared" if term.name in declared else "default")
        for term in problem.terms)
    of_views = np.pad(seen.parameters, (0, problem.system.size - len(seen.parameters)),
                      constant_values=np.nan)
    result = CalibrationResult(
        measurements.plan_id, solved.error_map(plate), plate.result.artifact_map,
        views_of(measurements, problem, of_views), Observability(unknowns, unknowns, 0, True),
        noise, measurements.all_rejected(),
        findings=() if failed else _findings(found),
        sense=str(measurements.sense), extra={KEY: found, **kept_covariance(covers)},
        run_id=measurements.run_id,
        verdict=Verdict(Grade.NOT_QUALIFIED if failed else Grade.GOOD, failed,
                        enlarged_by=before.enlarged_by),
        model=ModelResult("rigid" if options.finite_rotations else "linear", terms),
        reference=plate.reference, provenance=provenance_of(measurements, options),
        placed_plate=readings.measurements.artifact if readings.measurements.artifact.map_grid
        else None)
    return replace(result, budget=tuple(_budget(result, parts, plate)))


def _findings(found: dict[str, Any]) -> tuple[Finding, ...]:
    """Return what has changed: the map, and the scale that is no part of it."""
    largest, scale, of = found["largest"], found["scale"], {"of": found["of"]}
    where = {"x": largest["x"], "y": largest["y"], "passes": found["passes"], **of}
    both = (Finding("changed", largest["change"], largest["u"], "m", found["p"],
                    axis=largest["axis"], details=where),
            Finding("scale_changed", scale["change"], scale["u"], "m/m", scale["p"], details=of))
    return tuple(one for one, told in zip(both, (found["changed"], scale["changed"]), strict=True)
                 if told)


def plate_readings(measurements: Measurements, options: Options,
                   plate: KnownPlate) -> PlateReadings:
    """Return the readings of known marks, and the terms of the model."""
    grid, angular = grid_data(measurements), angular_data(measurements)
    grid = replace(grid, weight=np.where(plate.kept.marks, grid.weight, 0.0))
    if not grid.weight.any():
        raise NoDataError(f"plan '{measurements.plan_id}'", "no known mark was read",
                          "record detections of the marks of the plate")
    artifact, system = measurements.artifact, system_for(grid, angular)
    views, length = system.grid.views, artifact.grid_pitch_m * max(artifact.reach)
    ground = ground_of(measurements, grid, length, drift_degree=options.drift_degree)
    terms = _terms(options, visits=all(v is not None for v in ground.visits))
    lines, shape = artifact.angular_count, views.z_sites.shape
    nothing = Conditions(ThetaDatum.ZERO_MEAN, np.zeros((0, lines)), np.zeros((0, *shape)),
                         np.zeros((lines, 0)), np.zeros((len(angular.index), 0)))
    read = np.zeros(views.z_sites.size, dtype=bool)
    read[views.site_index[grid.weight > 0]] = True
    problem = Problem(
        system, grid, angular, *repeats_of(measurements), length, nothing, ground,
        rigid=options.finite_rotations, terms=terms,
        places=places_of(measurements, grid, ground, read.reshape(shape) if isinstance(
            views, LatticeViews) else np.ones(shape, dtype=bool)),
        at_places=options.at_places, turn_rad=np.zeros(len(grid.index)))
    problem = turned(problem) if problem.rigid else problem
    quiet = without_noise(problem.ground, np.zeros(grid.y.shape))
    cells = cells_seen(artifact, [measurements.views[index].view for index in grid.index])
    if cells is not None and (count := np.count_nonzero(grid.weight)) > MOST_OF_IMAGES:
        raise InputError(f"plan '{measurements.plan_id}'", f"{count} readings of marks in images "
                         f"are beyond the limit of {MOST_OF_IMAGES} of a recheck",
                         "state fewer marks in an image (image in PLAN.yaml)")
    return PlateReadings(measurements, problem, term_columns(quiet, terms),
                         np.nonzero(grid.weight), np.zeros(0, dtype=int) if cells is None
                         else stops_of(cells, grid.weight > 0))


def _terms(options: Options, *, visits: bool) -> tuple[ModelTerm, ...]:
    """Return the terms; views of a known plate do not determine those without a size."""
    terms = tuple(term for term in options.model_terms(
        visits=visits, assumed=options.finite_rotations) if not term.block.between)
    for term in terms:
        if term.free:
            raise InputError("model_terms", f"views of a known plate cannot determine the term "
                             f"'{term.name}'", f"give it a size, {term.name}:SIZE")
    return terms


def _noise(readings: PlateReadings, plate: KnownPlate) -> tuple[NoiseEstimate, NoiseEstimate]:
    """Return the noise of the readings: declared, of many repeats, or that of the calibration.

    What detections of images declare is the noise of a mark, without that of its image.
    """
    problem, before, nan = readings.problem, plate.result.noise, float("nan")
    of_marks, of_mark, out = problem.repeats_xy, problem.grid.sigma_declared, []
    if len(readings.stop):
        fewer = 1 + (readings.marks_of_image - 1) * share_of(plate.result)
        of_marks, of_mark = (of_marks[0], of_marks[1] / fewer), nan
    for kind, repeats, declared in (
            ("xy", of_marks, of_mark),
            ("theta", problem.repeats_theta, problem.angular.sigma_declared)):
        found = noise_estimate(repeats, (nan, 0), declared)
        if not (found.sigma > 0 and found.dof >= MIN_REPEAT_DOF):
            found = replace(found, sigma=getattr(before, f"sigma_{kind}"),
                            dof=getattr(before, f"dof_{kind}"))
        out.append(found)
    return out[0], out[1]


def _new_map(readings: PlateReadings, plate: KnownPlate, xy: NoiseEstimate,
             options: Options) -> tuple[NewMap, Seen]:
    """Return the map of the stage, stage frame, and as it was solved."""
    values, size = readings.of_terms()
    terms, (mark, image) = stacked(values) * size, _two_noises(readings, plate, xy)
    white, images = np.tile(mark / readings.weight, 2), np.sqrt(image) * readings.of_images()
    noise = np.diag(white) + images @ images.T + terms @ terms.T
    matrix, size = readings.of_offsets()
    found = plate.of_offsets
    if found is None or any(term.block.of_offsets for term in options.terms):
        own, found = stacked(matrix) * size, np.zeros(4)
        noise, matrix = noise + own @ own.T, 0 * matrix
    marks, of_marks = readings.of_marks()
    of_plate = np.hstack([of_marks, stacked(matrix)])
    nowhere = np.zeros(plate.kept.sites.shape, dtype=bool)
    whole = noise + of_plate @ plate.kept.cover(nowhere, marks) @ of_plate.T
    seen = seen_field(readings, whole, plate.field[readings.at[1:]], matrix @ found)
    n, field, known = seen.known.size, seen.field, seen.known
    rows = seen.gain.rows[:2 * n].reshape(2, *known.shape, -1)
    if readings.measurements.sense is Sense.PLATE_MOVES:  # G(X) = -H(-X)
        field, known, rows = -field[::-1, ::-1], known[::-1, ::-1], -rows[:, ::-1, ::-1]
    return NewMap(readings.measurements.artifact.field, known, np.stack([field.real, field.imag]),
                  Gain(rows.reshape(2 * n, -1), noise), white, images, of_plate, marks,
                  xy.dof), seen


def _two_noises(readings: PlateReadings, plate: KnownPlate,
                xy: NoiseEstimate) -> tuple[float, float]:
    """Return the variances of the noise of a mark, and of that which an image's marks share, m^2.

    That of a mark is the calibration's, and not none: the readings have to be weighted.
    """
    if not len(readings.stop):
        return xy.sigma**2, 0.0
    mark = (1 - share_of(plate.result)) * plate.result.noise.sigma_xy**2
    mark = float(np.clip(mark, LEAST_PART * xy.sigma**2, xy.sigma**2))
    return mark, xy.sigma**2 - mark


def _new_lines(readings: PlateReadings, plate: KnownPlate, theta: NoiseEstimate) -> NewLines:
    """Return the angular map, stage frame; nothing is known where no known line was read."""
    angular, count = readings.problem.angular, readings.measurements.artifact.angular_count
    known = plate.kept.lines()[0][1]
    weight = np.where(known, angular.weight, 0.0)
    view, line = np.nonzero(weight)
    if not len(view):
        return NewLines(np.full(count, np.nan), Gain(np.zeros((count, 0)), np.zeros((0, 0))),
                        np.zeros((0, count)), theta.dof)
    own = np.zeros((len(view), count))
    own[np.arange(len(view)), line] = 1.0
    columns, noise = readings.columns, np.diag(theta.sigma**2 / weight[view, line])
    for at, values in zip(columns.lines.at, columns.lines.values, strict=True):
        here = columns.size[at] * values[view, line]
        noise += np.outer(here, here)
    whole = noise + plate.kept.lines()[1][count:, count:][np.ix_(line, line)]
    gain = line_gain(angular.turns, weight, whole, angular.harmonics)
    found = gain.rows @ (angular.y[view, line] - plate.result.artifact_map.a_theta[line])
    found[~gain.rows.any(axis=1)] = np.nan
    rows = gain.rows
    if readings.measurements.sense is Sense.PLATE_MOVES:
        back = -np.arange(count) % count
        found, rows = -found[back], -rows[back]
    return NewLines(found, Gain(rows, noise), own, theta.dof)


def _misfit(seen: Seen, dof_noise: float) -> tuple[Finding, ...]:
    """Return whether the residuals are larger than noise and plate allow, if there are any."""
    dof = seen.dof
    if dof <= 0:
        return ()
    square = float(seen.rest @ np.linalg.solve(seen.gain.noise, seen.rest))
    p = float(chdtrc(dof, square) if dof_noise >= MANY_DOF else fdtrc(dof, dof_noise, square / dof))
    more = float(np.sqrt(square / dof))
    return (Finding("plate_misfit", more, unit="m/m", p=p),) if p < F_LEVEL and more > SAME else ()


def _with_coverage(noise: Noise, parts: dict[str, np.ndarray], plate: KnownPlate) -> Noise:
    """Return the noise with degrees of freedom and k of the map's uncertainty."""
    before = plate.result.noise
    dof = joint_dof((parts["reading noise"].mean(), noise.dof_xy),
                    (parts["known plate"].mean(), before.dof_of("xy")),
                    (parts["plate temperature"].mean() + parts["terms"].mean(), np.inf))
    dof_theta = min(noise.dof_theta, before.dof_of("theta"))
    return replace(noise, dof_map_xy=dof, k_xy=coverage_factor(dof), dof_map_theta=dof_theta,
                   k_theta=coverage_factor(dof_theta) if dof_theta > 0 else noise.k_theta)


def _budget(result: CalibrationResult, parts: dict[str, np.ndarray],
            plate: KnownPlate) -> Iterator[BudgetLine]:
    """Yield the lines of the budget: noise, known plate, its temperature, terms; interpolation."""
    noise, of_plate = result.noise, plate.result.artifact_map
    u = {"reading noise": noise.sigma_xy, "terms": float("nan"),
         "known plate": rms(np.stack([of_plate.u_ax, of_plate.u_ay])),
         "plate temperature": float(np.sqrt(plate.variance_of_length))}
    kinds = {"reading noise": ("A", noise.dof_xy, "readings"), "terms": ("B", np.inf, "default"),
             "known plate": ("A", plate.result.noise.dof_of("xy"), "declared"),
             "plate temperature": ("B", np.inf, "declared")}
    by = next((way for way in ("declared", "repeats")
               if getattr(noise, f"sigma_xy_{way}") == noise.sigma_xy), "residuals")
    for name, variance in parts.items():
        if name == "plate temperature" and plate.reference is None:
            continue
        (kind, dof, source), each = kinds[name], np.sqrt(variance)
        details: dict[str, object] = {"plate": plate.where} if name != "reading noise" else {
            "by": by, "contradicted": False}
        unit = "m/m" if name == "plate temperature" else "m"
        yield BudgetLine("xy", name, kind, 0.0, u[name], unit, rms(each), float(each.max()), dof,
                         source, details)
    yield from (line for line in budget_lines(result)
                if (line.quantity, line.component) == ("xy", INTERPOLATION))
