# SPDX-License-Identifier: Apache-2.0
"""Views of a known plate to a result: the map of the stage, its uncertainty, what has changed.

Before any is measured, readings that are all 0 predict its uncertainty.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import fdtrc

from selfcal_ros.blocks import AXES, SHARED
from selfcal_ros.errors import InputError, NoDataError
from selfcal_ros.estimation.checks.wiring import BEYOND
from selfcal_ros.estimation.comparison.covariance import (
    kept_covariances,
    share_of,
)
from selfcal_ros.estimation.comparison.maps import USUAL_LEVEL, joint_dof, of_square
from selfcal_ros.estimation.joint.images import marks_of_image, stops_of
from selfcal_ros.estimation.joint.problem import (
    F_LEVEL,
    SAME,
    NoiseEstimate,
    Problem,
    coverage_factor,
    noise_estimate,
    problem_of,
)
from selfcal_ros.estimation.joint.slow_motion import MotionOfStops
from selfcal_ros.estimation.joint.solve import MICROSCOPE_PARTS, noise_of, views_of
from selfcal_ros.estimation.lattice.readings import (
    Marks,
    angular_data,
    grid_data,
    planned_readings,
)
from selfcal_ros.estimation.multifrontal.factor import one_thread
from selfcal_ros.estimation.normal.angular import FLOOR, MAX_STEPS
from selfcal_ros.estimation.normal.equations import (
    ENOUGH_DOF,
    TRACE,
    lines_of,
    system_of,
)
from selfcal_ros.estimation.observability.plan_check import Prediction
from selfcal_ros.estimation.options import Options
from selfcal_ros.estimation.recheck.change import (
    change_by_effects,
    line_change,
    map_change,
    recheck_found,
)
from selfcal_ros.estimation.recheck.plate import (
    KnownPlate,
    check_plate,
    lone_marks,
    on_plate,
)
from selfcal_ros.estimation.recheck.views import (
    NOISE,
    PLATE,
    TEMPERATURE,
    TERMS,
    Effects,
    Estimate,
    NewMap,
    dof_of_residuals,
    estimate_of_marks,
    known_nodes,
    map_of_lines,
    map_of_marks,
    solve_marks,
)
from selfcal_ros.estimation.terms.columns import (
    Column,
    ColumnBuilder,
    LineColumns,
    TermColumns,
)
from selfcal_ros.estimation.terms.visits import term_inputs, without_noise
from selfcal_ros.estimation.verdict.judge import provenance_of, views_findings
from selfcal_ros.estimation.verdict.uncertainty import (
    INTERPOLATION,
    budget_lines,
    noise_line,
)
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.budget import BudgetLine, OfPlate
from selfcal_ros.model.error_map import MANY_DOF, ErrorMap, datum_modes, rms
from selfcal_ros.model.findings import (
    Changed,
    ChangedOrDrifted,
    ChangedOrMarks,
    ChangedOrMicroscope,
    Finding,
    MicroscopeOff,
    PlateMisfit,
    ScaleChanged,
    ScaleNotCompared,
)
from selfcal_ros.model.kept import SlowKept
from selfcal_ros.model.readings import Measurements, Sense, ViewReadings
from selfcal_ros.model.recheck import Recheck
from selfcal_ros.model.result import CalibrationResult, Noise, Observability
from selfcal_ros.model.terms import ModelTerm, block_of_offsets
from selfcal_ros.model.verdict import Grade, ModelResult, TermResult, Verdict
from selfcal_ros.model.view import Plan, cells_seen


@dataclass(frozen=True, eq=False)
class Rechecked:
    """Results from views of a known plate.

    Attributes
    ----------
    measurements : Measurements
        Views of the plate, with the nodes of its map.
    plate : KnownPlate
        The plate.
    problem : Problem
        The readings in the frame of the plate as placed.
    columns : TermColumns
        Effects on those of marks, and terms of lines.
    parameters : float array (size,)
        Misalignments as in `NormalEquations`, m.
    square : float
        Sum of squares of the residuals of marks, in units of their covariance.
    new, lines : NewMap
        Both maps.
    xy, theta : NoiseEstimate
        Noise of one reading of each kind.
    microscope : SeenMicroscope or None
        The microscope, if visits show it; the measurements are then corrected by it.
    """

    measurements: Measurements
    plate: KnownPlate
    problem: Problem
    columns: TermColumns
    parameters: np.ndarray
    square: float
    new: NewMap
    lines: NewMap
    xy: NoiseEstimate
    theta: NoiseEstimate
    microscope: "SeenMicroscope | None"

    @property
    def artifact(self) -> Artifact:
        """Nodes of the map."""
        return self.measurements.artifact.field

    @cached_property
    def in_datum(self) -> NewMap:
        """The XY map, without scale unless a reference length sets it."""
        if self.plate.reference is not None:
            return self.new
        return self.new.without(datum_modes(self.artifact, scale=True).reshape(4, -1).T)

    @cached_property
    def covariances(self) -> dict[str, np.ndarray]:
        """Covariances of this map by their sources, (q, q) each, m^2."""
        return self.in_datum.covariances(self.plate.variance_of_length)

    @cached_property
    def variances(self) -> dict[str, np.ndarray]:
        """Variances of this map by their sources, (q,) each, m^2."""
        return {
            name: np.maximum(cover.diagonal(), 0.0)
            for name, cover in self.covariances.items()
        }

    @property
    def of_lines(self) -> np.ndarray:
        """Covariance of the angular map, rad^2."""
        return np.sum(list(self.lines.covariances(0.0).values()), axis=0)

    def error_map(self) -> ErrorMap:
        """Return the map with its uncertainty."""
        artifact, xy, lines = self.artifact, self.in_datum, self.lines
        u_xy = np.sqrt(np.sum(list(self.variances.values()), axis=0))
        u_theta = np.sqrt(np.diag(self.of_lines))
        values, u = (
            xy.on_whole_map(of_nodes).reshape(2, *artifact.shape)
            for of_nodes in (xy.values, u_xy)
        )
        return ErrorMap.of_maps(
            artifact,
            (values, u),
            (lines.on_whole_map(lines.values), lines.on_whole_map(u_theta)),
        )


def recheck_of(
    measurements: Measurements, options: Options, plate: KnownPlate
) -> Rechecked:
    """Return the parts from which `recheck` assembles its result."""
    if options.reference is not None:
        raise InputError(
            "options",
            "a recheck always uses the reference length of the plate's calibration",
            "leave it out",
        )
    measurements = on_plate(measurements, plate)
    problem = _problem(measurements, options, plate)
    microscope = None if measurements.has_images else _seen_by_visits(problem)
    if microscope is not None:
        sigma, dof = problem.repeats_xy
        measurements = replace(
            measurements, views=tuple(map(microscope.corrected, measurements.views))
        )
        problem = replace(
            _problem(measurements, options, plate),
            repeats_xy=(min(sigma, microscope.sigma), dof),
        )
    images = _images(measurements, problem, plate)
    xy, theta = _noise(images, problem, plate)
    columns, estimate = _estimate(
        problem, options, plate, sigma=xy.sigma, images=images, microscope=microscope
    )
    field, parameters, square = solve_marks(problem, columns, estimate)
    return Rechecked(
        measurements=measurements,
        plate=plate,
        problem=problem,
        columns=columns,
        parameters=parameters,
        square=square,
        new=map_of_marks(problem, estimate, field, measurements.sense, xy.dof),
        lines=_new_lines(problem, columns, plate, measurements.sense, theta),
        xy=xy,
        theta=theta,
        microscope=microscope,
    )


@one_thread()
def recheck(
    measurements: Measurements, options: Options, plate: KnownPlate
) -> CalibrationResult:
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
    problem = solved.problem
    outcome = recheck_found(
        map_change(solved.new, solved.artifact, plate),
        line_change(solved.lines, plate),
        solved.artifact,
        plate,
        passes=min(view.view.repeats for view in measurements.views),
    )
    declared = {term.name for term in options.terms}
    changes = tuple(_changes(outcome))
    failed = _failed(solved, outcome, changes, drift_declared="drift" in declared)
    covers = {
        "xy": np.sum(list(solved.covariances.values()), axis=0),
        "theta": solved.of_lines,
    }
    unknowns = 2 * int(known_nodes(problem).sum()) + problem.system.grid.n_misalignments
    terms = tuple(
        TermResult(
            str(term.name),
            term.size,
            (),
            None,
            "declared" if term.name in declared else "default",
        )
        for term in problem.terms
    )
    result = CalibrationResult(
        plan_id=measurements.plan_id,
        error_map=solved.error_map(),
        artifact_map=plate.result.artifact_map,
        views=views_of(measurements, problem, solved.parameters),
        observability=Observability(unknowns, unknowns, 0, True),
        noise=_with_coverage(
            noise_of(solved.xy, solved.theta), solved.variances, plate
        ),
        rejected=measurements.all_rejected(),
        findings=(
            *(
                ()
                if failed
                else (
                    *changes,
                    *_scale_changes(outcome),
                    *_scale_not_compared(plate),
                    *_off(solved),
                )
            ),
            *views_findings(measurements),
        ),
        sense=str(measurements.sense),
        kept=kept_covariances(covers),
        run_id=measurements.run_id,
        verdict=Verdict(
            Grade.NOT_QUALIFIED if failed else Grade.GOOD,
            failed,
            enlarged_by=plate.result.verdict.enlarged_by,
        ),
        model=ModelResult("rigid" if options.finite_rotations else "linear", terms),
        reference=plate.reference,
        provenance=provenance_of(measurements, options),
        placed_plate=solved.measurements.artifact.placed,
        recheck=outcome,
    )
    return replace(result, budget=tuple(_budget(result, solved, plate)))


def _failed(
    solved: Rechecked,
    outcome: Recheck,
    changes: tuple[Changed, ...],
    *,
    drift_declared: bool,
) -> tuple[Finding, ...]:
    """Return why the map is not qualified: the plate, the residuals, or what a change may be.

    A change that one pass shows may be drift, unless that is declared; one that another microscope
    explains may be that.
    """
    other_plate = check_plate(solved.measurements, solved.plate, solved.xy.sigma)
    if other_plate is not None:
        failed: tuple[Finding, ...] = (other_plate,)
    else:
        dof_noise = solved.xy.dof
        images = solved.plate.result.kept.images
        if images is not None and solved.measurements.has_images:
            dof_noise = images.dof_mark
        failed = _misfit(solved.square, dof_of_residuals(solved.problem), dof_noise)
    if not changes:
        return failed
    if not failed:
        failed = _by_marks(solved, changes[0])
    if not failed and outcome.passes == 1 and not drift_declared:
        failed = (ChangedOrDrifted(**vars(changes[0])),)
    return (*failed, *_by_microscope(solved, outcome, changes[0]))


def _by_marks(solved: Rechecked, changed: Changed) -> tuple[Finding, ...]:
    """Return a finding if single marks show the change, each by itself."""
    lone = lone_marks(solved.measurements, solved.plate, solved.xy.sigma)
    if not lone:
        return ()
    first = lone[0]
    others = len({one.mark for one in lone} - {first.mark})
    data = vars(changed) | {"mark": first.mark, "away": first.away, "others": others}
    return (ChangedOrMarks(**data),)


def _changes(outcome: Recheck) -> Iterator[Changed]:
    """Yield the change of the map, if there is one."""
    largest = outcome.largest
    if outcome.changed:
        yield Changed(
            size=largest.change,
            u=largest.u,
            unit="m",
            p=outcome.p,
            axis=largest.axis,
            x=largest.x,
            y=largest.y,
            of=outcome.of,
        )


def _scale_changes(outcome: Recheck) -> Iterator[ScaleChanged]:
    """Yield the change of the scale, which is not part of the map, if there is one."""
    scale = outcome.scale
    if scale.changed:
        yield ScaleChanged(
            size=scale.change,
            u=scale.u,
            unit="m/m",
            p=scale.p,
            passes=outcome.passes,
            of=outcome.of,
        )


def _scale_not_compared(plate: KnownPlate) -> Iterator[ScaleNotCompared]:
    """Yield a finding if the map before has a scale, and this one has none."""
    before = plate.result.reference
    if before is not None and plate.reference is None:
        certified = before.kind.of_plate and before.certified is not None
        yield ScaleNotCompared(of=plate.where, certified=certified)


def _off(solved: Rechecked) -> Iterator[Finding]:
    """Yield a finding if visits show another microscope than is assumed."""
    term = next(
        (term for term in solved.problem.terms if term.block.of_microscope),
        None,
    )
    if solved.microscope is None or term is None:
        return
    values = solved.microscope.values
    u = np.sqrt(solved.microscope.covariance.diagonal())
    sizes = [term.size_of(component) for component in SIMILAR]
    if (np.abs(values[:2]) > BEYOND * np.array(sizes)).any():
        yield MicroscopeOff(
            size=float(values[0]),
            u=float(u[0]),
            unit="m/m",
            turn=float(values[1]),
            u_turn=float(u[1]),
        )


SIMILAR = ("scale", "turn")
"""Coefficients of a microscope that may be any once it has been touched."""


def _by_microscope(
    solved: Rechecked, outcome: Recheck, changed: Changed
) -> Iterator[Finding]:
    """Yield a finding if another microscope explains a change as well as a changed stage does.

    Its scale and its turn may be any, if neither visits of one mark at several places nor the model
    tells them: then nothing of the change of XY is left beyond its uncertainty, and they differ
    from what was assumed. Lines have not changed.
    """
    block = block_of_offsets()
    rows = [
        row
        for row, column in enumerate(solved.columns.columns)
        if column.term == block.name and column.component in SIMILAR
    ]
    of_lines = outcome.p_theta is not None and 2 * outcome.p_theta < USUAL_LEVEL
    if not rows or of_lines or solved.microscope is not None:
        return
    explained_by = change_by_effects(solved.new, solved.artifact, solved.plate, rows)
    if (
        min(explained_by.p_left, 1.0) < USUAL_LEVEL
        or explained_by.p_none >= USUAL_LEVEL
    ):
        return
    scale, turn = solved.new.effects.mean[rows] + explained_by.values
    u_scale, u_turn = explained_by.u
    yield ChangedOrMicroscope(
        **vars(changed),
        scale=float(scale),
        u_scale=float(u_scale),
        turn=float(turn),
        u_turn=float(u_turn),
    )


def _problem(
    measurements: Measurements, options: Options, plate: KnownPlate
) -> Problem:
    """Return the problem that the readings of known marks pose."""
    grid, angular = grid_data(measurements), angular_data(measurements)
    grid = replace(grid, weight=np.where(plate.together.marks, grid.weight, 0.0))
    if not grid.weight.any():
        raise NoDataError(
            f"plan '{measurements.plan_id}'",
            "no known mark was read",
            "record detections of the marks of the plate",
        )
    system = system_of(
        replace(grid, known_plate=True), Marks((), angular.weight[:0], ())
    )
    inputs = term_inputs(measurements, grid, drift_degree=options.drift_degree)
    terms = _terms(options, visits=all(v is not None for v in inputs.visits))
    return problem_of(
        measurements, options, system, inputs, readings=(grid, angular), terms=terms
    )


@dataclass(frozen=True, eq=False)
class StopsOfImages:
    """Stops at which images were taken, with their noise as the calibration knows it.

    Attributes
    ----------
    stop : int array (views, nx, ny)
        At which each mark was read; -1 = not read.
    mark, motion : float
        Variances of the noise of a mark, and of what the marks of an image share, m^2.
    of_stops : MotionOfStops
        What that makes of the means of the stops.
    """

    stop: np.ndarray
    mark: float
    motion: float
    of_stops: MotionOfStops

    def repeats(self, sigma: float, dof: float) -> tuple[float, float]:
        """Return the noise of a reading, m, and its dof, given those of repeats of marks."""
        hidden = max(sigma**2 - self.mark, 0.0) * (1 / self.of_stops.shown - 1)
        shown = self.of_stops.shown * self.motion
        share = shown / (self.mark + shown) if shown else 0.0
        shared = 1 + (marks_of_image(self.stop[self.stop >= 0]) - 1) * share
        return float(np.sqrt(sigma**2 + hidden)), dof * self.of_stops.dof / shared


def _images(
    measurements: Measurements, problem: Problem, plate: KnownPlate
) -> StopsOfImages | None:
    """Return the stops at which images were taken; None without images.

    What of their motion is slow is the calibration's: in a single pass it looks like a change of
    the stage.
    """
    if not measurements.has_images:
        return None
    kept, of_reading = plate.result.kept.images, plate.result.noise.sigma_xy**2
    share = share_of(plate.result)
    motion = (kept and kept.motion) or SlowKept(1 - share, share, 0.0)
    total = motion.white + motion.slow
    read = problem.system.grid.read
    seen = [measurements.views[index].view for index in problem.grid.index]
    cells = cells_seen(measurements.artifact, seen)
    stop = np.full(read.shape, -1)
    if cells is not None:
        stop[read] = stops_of(cells, read)
    slow = motion.slow / total if total else 0.0
    of_reading *= _identical(problem.repeats_xy, problem.grid.weight)
    return StopsOfImages(
        stop,
        motion.mark * of_reading,
        total * of_reading,
        MotionOfStops.of(problem.inputs, stop, slow),
    )


def _estimate(
    problem: Problem,
    options: Options,
    plate: KnownPlate,
    *,
    sigma: float,
    images: StopsOfImages | None,
    microscope: "SeenMicroscope | None",
) -> tuple[TermColumns, Estimate]:
    """Return the effects on marks with a noise of one reading, m, and the least squares with them.

    The noise of a mark in images is the calibration's, and not none: the readings have to be
    weighted.
    """
    _require_noise(sigma)
    variance = sigma**2
    read = problem.system.grid.read
    marks = read.any(axis=0)
    of_each = np.eye(marks.size)[marks.ravel()].reshape(-1, 1, *marks.shape)
    shapes = {PLATE: of_each * read}
    if images is not None:
        variance = float(np.clip(images.mark, TRACE * sigma**2, sigma**2))
        weight = np.where(read, problem.grid.weight, 1.0)
        stops = np.arange(images.stop.max() + 1)[:, None, None, None]
        shapes[NOISE] = (images.stop == stops) * np.sqrt((sigma**2 - variance) / weight)
    columns = _columns(problem, shapes)
    effects = _effects(
        columns, marks, options, plate, images=images, microscope=microscope
    )
    return columns, estimate_of_marks(problem, columns.shapes, effects, variance)


def _columns(problem: Problem, shapes: dict[str, np.ndarray]) -> TermColumns:
    """Return the columns of shapes, (n, views, nx, ny), along x, then y, and of terms.

    The latter for offsets as they were seen.
    """
    builder = ColumnBuilder(
        without_noise(problem.inputs, np.zeros(problem.grid.y.shape))
    )
    for name, values in shapes.items():
        numbers = [
            builder.add(dict(enumerate(shape.reshape(len(shape), -1))))
            for shape in values
        ]
        for axis, unit in AXES:
            for number in numbers:
                builder.column(Column(name, SHARED, axis, 1.0), number, unit)
    builder.add_terms(problem.terms)
    return builder.build()


def _effects(
    columns: TermColumns,
    marks: np.ndarray,
    options: Options,
    plate: KnownPlate,
    *,
    images: StopsOfImages | None,
    microscope: "SeenMicroscope | None",
) -> Effects:
    """Return what is known of the effects on marks, bool (nx, ny), that were read.

    By the calibration, of images, and of the microscope by visits.
    """
    noise = columns.rows([NOISE])
    of_microscope = columns.having(lambda block: block.of_microscope)
    others = []
    if images is not None:
        others.append((noise, np.kron(np.eye(2), images.of_stops.covariance)))
    if microscope is not None:
        others.append((of_microscope, microscope.covariance))
    at = np.where(columns.rows([PLATE]), np.arange(len(noise)), -1)
    declared = any(term.block.of_microscope for term in options.terms)
    if microscope is None and not declared and np.isfinite(plate.of_offsets).all():
        at[of_microscope] = [
            2 * marks.sum() + MICROSCOPE_PARTS.index(columns.columns[row].component)
            for row in np.flatnonzero(of_microscope)
        ]
    now = plate.field[marks]
    return Effects.of(
        columns.size,
        at,
        plate=np.concatenate([now.real, now.imag, plate.of_offsets]),
        before=plate.together.cover(plate.together.sites, marks),
        length=plate.length_at(marks),
        noise=noise,
        others=others,
    )


ANY = 1.0
"""Size of a scale and a turn of the microscope of which nothing is assumed."""


@dataclass(frozen=True, eq=False)
class SeenMicroscope:
    """A microscope as the visits of each mark show it by themselves.

    Attributes
    ----------
    values, covariance : float array (4,), (4, 4)
        Its coefficients.
    sigma : float
        Noise of one reading that it leaves between the visits, m.
    """

    values: np.ndarray
    covariance: np.ndarray
    sigma: float

    def corrected(self, view: ViewReadings) -> ViewReadings:
        """Return the readings of a view as a right microscope would have given them."""
        visits = view.visits
        if visits is None or not len(visits.mark):
            return view
        scale, turn, stretch, shear = self.values
        offset = visits.offset_x + 1j * visits.offset_y
        missing = (
            complex(scale, turn) * offset + complex(stretch, shear) * offset.conj()
        )
        of_mean = visits.means(missing, len(view.m))
        return replace(
            view,
            dx=view.dx + of_mean.real,
            dy=view.dy + of_mean.imag,
            visits=replace(
                visits, dx=visits.dx + missing.real, dy=visits.dy + missing.imag
            ),
        )


def _seen_by_visits(problem: Problem) -> SeenMicroscope | None:
    """Return the microscope that visits of one mark at several places show, as check stops do.

    The motion of the stage has no noise of the detections: a reading changes with it by E / (1 + E)
    of the motion. What other terms make of the visits is fitted beside it. None if the visits do
    not tell its scale and turn well.
    """
    builder = ColumnBuilder(
        without_noise(problem.inputs, np.zeros(problem.grid.y.shape))
    )
    builder.add_terms(problem.terms)
    columns = builder.build()
    of_offsets = columns.having(lambda block: block.of_microscope)
    within = columns.within
    if not of_offsets.any() or not within.dof:
        return None
    free = (
        np.array([column.component in SIMILAR for column in columns.columns])
        & of_offsets
    )
    size = np.where(free, ANY, columns.size)

    fitted_values = np.zeros(len(size))
    covariance = np.diag(size**2)
    variance = within.total / within.dof
    # the scatter that is left weighs the visits against the sizes
    for _ in range(MAX_STEPS):
        if not variance > FLOOR**2:
            return None
        covariance = np.linalg.inv(np.diag(size**-2) + within.gram / variance)
        fitted_values = covariance @ within.right / variance
        remaining = (
            within.total
            - 2 * fitted_values @ within.right
            + fitted_values @ within.gram @ fitted_values
        )
        before = variance
        variance = float(remaining) / within.dof
        if abs(variance - before) <= TRACE * before:
            break
    slope = complex(*fitted_values[free])  # E / (1 + E)
    coefficients = fitted_values[of_offsets] / abs(1 - slope) ** 2
    exact = slope / (1 - slope)
    coefficients[free[of_offsets]] = exact.real, exact.imag
    covariance = covariance[np.ix_(of_offsets, of_offsets)] / abs(1 - slope) ** 4
    u = np.sqrt(covariance.diagonal()[free[of_offsets]])
    if (BEYOND * u > columns.size[free]).any():
        return None
    return SeenMicroscope(coefficients, covariance, float(np.sqrt(variance)))


def _require_noise(sigma: float) -> None:
    """Raise InputError if the noise of a reading, m or rad, is none."""
    if not sigma > FLOOR:
        raise InputError(
            "readings",
            "they or those of the calibration have no noise against which to judge a change",
            "use measured readings",
        )


def _terms(options: Options, *, visits: bool) -> tuple[ModelTerm, ...]:
    """Return the terms; views of a known plate do not determine those without a size."""
    terms = tuple(
        term
        for term in options.model_terms(visits=visits, assumed=options.finite_rotations)
        if not term.block.between
    )
    for term in terms:
        if term.free:
            raise InputError(
                "model_terms",
                f"views of a known plate cannot determine the term '{term.name}'",
                f"give it a size, {term.name}:SIZE",
            )
    return terms


def _identical(repeats: tuple[float, float], weight: np.ndarray) -> float:
    """Return the weight of means of identical repeats, which average nothing; otherwise 1.

    `repeats` is their scatter and its degrees of freedom.
    """
    sigma, dof = repeats
    return float(weight.max()) if dof > 0 and not sigma > FLOOR else 1.0


def _noise(
    images: StopsOfImages | None, problem: Problem, plate: KnownPlate
) -> tuple[NoiseEstimate, NoiseEstimate]:
    """Return the noise of the readings: of many repeats, else that of the calibration.

    Few repeats count if they show more. It is what detections declare if that is larger: no
    residual tests whether they declare too little. What detections of images declare is the noise
    of a mark, without that of its image.
    """
    before = plate.result.noise
    nan = float("nan")
    of_marks = problem.repeats_xy
    of_mark = problem.grid.sigma_declared
    out = []
    if images is not None:
        before = replace(before, sigma_xy=float(np.sqrt(images.mark + images.motion)))
        of_marks, of_mark = images.repeats(*of_marks), nan
    lines = problem.angular
    for kind, repeats, declared, weight in (
        ("xy", of_marks, of_mark, problem.grid.weight),
        ("theta", problem.repeats_theta, lines.sigma_declared, lines.weight),
    ):
        noise = noise_estimate(repeats, (nan, 0), nan)
        sigma, dof = getattr(before, f"sigma_{kind}"), getattr(before, f"dof_{kind}")
        if kind == "theta" or images is None:
            sigma *= np.sqrt(_identical(repeats, weight))
        many = noise.sigma > FLOOR and noise.dof >= ENOUGH_DOF
        dofs = (min(noise.dof, MANY_DOF), min(dof, MANY_DOF))
        more = noise.sigma > sigma > FLOOR and (
            fdtrc(*dofs, (noise.sigma / sigma) ** 2) < USUAL_LEVEL
        )
        if not (many or more):
            noise = replace(noise, sigma=sigma, dof=dof)
        larger = max(noise.sigma, np.nan_to_num(declared))
        out.append(replace(noise, sigma=larger, declared=declared))
    return out[0], out[1]


def _new_lines(
    problem: Problem,
    columns: TermColumns,
    plate: KnownPlate,
    sense: Sense,
    theta: NoiseEstimate,
) -> NewMap:
    """Return the angular map, stage frame; nothing is known where no known line was read."""
    angular, of_terms = problem.angular, columns.lines
    (_, known_lines), before = plate.together.lines()
    count = len(known_lines)
    lines = lines_of(
        replace(
            angular, weight=np.where(known_lines, angular.weight, 0.0), known_plate=True
        )
    )
    if lines.n_readings:
        _require_noise(theta.sigma)
    of_plate = np.broadcast_to(np.eye(count)[:, None], (count, *angular.weight.shape))
    values = np.concatenate([of_plate, *of_terms.values[:, None]])
    size = np.append(np.ones(count), columns.size[of_terms.at])
    effects = Effects.of(
        size,
        np.where(np.arange(len(size)) < count, np.arange(len(size)), -1),
        plate=np.nan_to_num(plate.result.artifact_map.a_theta),
        before=before,
        length=np.zeros(count),
    )
    return map_of_lines(
        lines,
        angular.y,
        LineColumns(np.arange(len(size)), values),
        effects,
        sense=sense,
        noise=theta,
    )


def _misfit(square: float, dof: int, dof_noise: float) -> tuple[Finding, ...]:
    """Return whether the residuals are larger than noise and plate allow, if there are any.

    Their sum of squares in units of their covariance, and their degrees of freedom.
    """
    if dof <= 0:
        return ()
    p = of_square(square, dof, dof_noise)
    ratio = float(np.sqrt(square / dof))
    if not (p < F_LEVEL and ratio > SAME):
        return ()
    return (PlateMisfit(size=ratio, unit="m/m", p=p),)


def _with_coverage(
    noise: Noise, variances: dict[str, np.ndarray], plate: KnownPlate
) -> Noise:
    """Return the noise with degrees of freedom and k of the map's uncertainty."""
    before = plate.result.noise
    dof = joint_dof(
        (variances[NOISE].mean(), noise.dof_xy),
        (variances[PLATE].mean(), before.dof_of("xy")),
        (variances[TEMPERATURE].mean() + variances[TERMS].mean(), np.inf),
    )
    dof_theta = min(noise.dof_theta, before.dof_of("theta"))
    return replace(
        noise,
        dof_map_xy=dof,
        k_xy=coverage_factor(dof),
        dof_map_theta=dof_theta,
        k_theta=coverage_factor(dof_theta) if dof_theta > 0 else noise.k_theta,
    )


def _budget(
    result: CalibrationResult, solved: Rechecked, plate: KnownPlate
) -> Iterator[BudgetLine]:
    """Yield the lines of the budget: noise, known plate, its temperature, terms; interpolation."""
    of_plate, of_lines = plate.result.artifact_map, solved.lines
    yield from _sources(
        "xy",
        solved.variances,
        np.stack([of_plate.u_ax, of_plate.u_ay]),
        result,
        plate,
    )
    if len(of_lines.values):
        variances = {
            name: np.maximum(cover.diagonal(), 0.0)
            for name, cover in of_lines.covariances(0.0).items()
            if name != TEMPERATURE  # which turns no line
        }
        yield from _sources("theta", variances, of_plate.u_a_theta, result, plate)
    yield from (
        line for line in budget_lines(result) if line.component == INTERPOLATION
    )


def _sources(
    quantity: str,
    variances: dict[str, np.ndarray],
    u_of_plate: np.ndarray,
    result: CalibrationResult,
    plate: KnownPlate,
) -> Iterator[BudgetLine]:
    """Yield a line of the budget for each source of the variances of a map."""
    unit = {"xy": "m", "theta": "rad"}[quantity]
    u_of_length = float(np.sqrt(plate.variance_of_length))
    dof_of_plate = plate.result.noise.dof_of(quantity)
    rows = {
        # a combined value, of both types, from a certificate (GUM 4.3.1)
        PLATE: (rms(u_of_plate), unit, dof_of_plate, "declared"),
        TEMPERATURE: (u_of_length, "m/m", np.inf, "declared"),
        TERMS: (float("nan"), unit, np.inf, "default"),
    }
    for name, variance in variances.items():
        if name == TEMPERATURE and plate.reference is None:
            continue
        u_map = np.sqrt(variance)
        if name == NOISE:
            yield noise_line(quantity, u_map, result.noise, otherwise="residuals")
            continue
        u, unit_of_u, dof, source = rows[name]
        yield BudgetLine(
            quantity=quantity,
            component=name,
            kind="B",
            u=u,
            unit=unit_of_u,
            effect_rms=rms(u_map),
            effect_max=float(u_map.max()),
            dof=dof,
            source=source,
            details=OfPlate(plate.where),
        )


@dataclass(frozen=True, eq=False)
class PlannedRecheck:
    """Predicted uncertainties, in units of the noise of one averaged reading.

    Attributes
    ----------
    map : Prediction
        Of the new map.
    change : float
        Of the change of a coordinate, rms over the nodes.
    """

    map: Prediction
    change: float


@one_thread()
def predict_recheck(plan: Plan, plate: KnownPlate) -> PlannedRecheck:
    """Return the predictions for views of a known plate, with the noise of its calibration.

    Raises
    ------
    NotIdentifiableError, InputError
        As `selfcal_ros.estimation.recheck.solve.recheck`.
    """
    readings = replace(
        planned_readings(plan.artifact, plan.views), plan_id=plan.plan_id
    )
    solved: Rechecked = recheck_of(
        readings, Options(assumed=(), misalignment_model="linear"), plate
    )
    noise = plate.result.noise
    root = np.sqrt(min(view.repeats for view in plan.views))
    unit = noise.sigma_xy / root
    emap = solved.error_map()
    u_theta = emap.u_g_theta[np.isfinite(emap.u_g_theta)] * root / noise.sigma_theta
    return PlannedRecheck(
        Prediction(emap.u_xy / unit, u_theta),
        rms(map_change(solved.new, solved.artifact, plate).u) / unit,
    )
