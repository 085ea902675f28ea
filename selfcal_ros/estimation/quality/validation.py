# SPDX-License-Identifier: Apache-2.0
"""Held-out validation: how well a calibration predicts readings that it has not seen.

Small residuals prove nothing; a prediction can fail. A tenth of the readings, or a whole view, is
held out, the rest is calibrated, and the readings held out are predicted. The three misalignments
of a whole view are fitted to its readings first, as no calibration can know them.

The error comes from the noise of the reading, from the error of the fit, and in a view that was
held out as a whole from its own terms within their sizes. Its sum of squares over the noise is a
weighted sum of chi^2; seeded draws of unit noise through the same fit give mean and variance, and
with these a scaled chi^2 (Satterthwaite), or F, as the noise is estimated.

Microscope and direction of approach are shared by all views. Drift, plate and circle of lines have
coefficients for each view, which are estimated only if some of its readings were fitted; for a view
that was held out as a whole they are known within their sizes.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import fdtri

from selfcal_ros.blocks import block_of
from selfcal_ros.errors import NoDataError, NotIdentifiableError, NotSettledError
from selfcal_ros.estimation.joint.model_fit import ModelFit
from selfcal_ros.estimation.joint.problem import F_LEVEL
from selfcal_ros.estimation.joint.solve import Solved, fit_joint, solve_joint
from selfcal_ros.estimation.lattice.maps import maps_of, rotation_excess
from selfcal_ros.estimation.lattice.readings import (
    AngularData,
    GridData,
    angular_data,
    grid_data,
    pose_of,
)
from selfcal_ros.estimation.multifrontal.factor import one_thread
from selfcal_ros.estimation.normal.angular import FLOOR, MAX_STEPS
from selfcal_ros.estimation.normal.equations import (
    FULL_SIZE,
    N_DRAWS,
    lines_of,
    noise_of,
)
from selfcal_ros.estimation.observability.plan_check import SEARCH_SIZE, candidate_views
from selfcal_ros.estimation.observability.rank import identifies, smaller
from selfcal_ros.estimation.options import Options
from selfcal_ros.estimation.terms.columns import term_columns
from selfcal_ros.estimation.terms.places import places_of
from selfcal_ros.estimation.terms.visits import (
    TermInputs,
    ViewVisits,
    term_inputs,
    time_ranges,
    view_time,
)
from selfcal_ros.estimation.verdict.leverage import FEW_DRAWS
from selfcal_ros.model.error_map import MANY_DOF, ThetaDatum, rms
from selfcal_ros.model.findings import (
    Finding,
    NothingToPredict,
    OwnTermsUnknown,
    PredictionFailed,
    RestNotConverged,
    RestNotIdentified,
)
from selfcal_ros.model.readings import Measurements, subset
from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.model.verdict import Grade
from selfcal_ros.model.view import Plan

READINGS_DRAWN = 2_000_000
"""Largest number of readings in all draws together, 200 MB: larger fields vary less."""


@dataclass(frozen=True, eq=False)
class HeldReadings:
    """Grid readings that were held out, and the columns of the fitted terms at them.

    Attributes
    ----------
    grid : GridData
        The readings; `index` are positions in the whole measurement.
    columns : complex array (p, views, nx, ny)
        Effect of a unit of each fitted coefficient on them, plate frame.
    rows : tuple of int
        Row of each of their views in the fit; -1 if it was not fitted.
    own_columns : complex array (q, views, nx, ny)
        Effect on them of one standard deviation of each coefficient with a size that belongs to a
        view that was not fitted, plate frame, m.
    place_change : complex array (views, nx, ny)
        Effect on them of the stage's distance from the sites, plate frame, m.
    """

    grid: GridData
    columns: np.ndarray
    rows: tuple[int, ...]
    own_columns: np.ndarray
    place_change: np.ndarray


def held_readings(
    model: ModelFit, fitted: Measurements, held_out: Measurements
) -> HeldReadings:
    """Return the grid readings `held_out` with the columns of the terms of the fit of `fitted`."""
    problem = model.problem
    grid = grid_data(held_out)
    rows = tuple(
        problem.grid.index.index(i) if i in problem.grid.index else -1
        for i in grid.index
    )
    inputs = term_inputs(held_out, grid)
    places = places_of(held_out, grid, inputs, problem.system.known_sites)
    place_change: np.ndarray = np.zeros(grid.y.shape, dtype=complex)
    if problem.moves and places is not None:
        place_change = places.changes(
            places.differences(model.fitted.field), np.zeros(len(grid.index))
        )
    equations = model.equations
    of_terms: np.ndarray = np.zeros((equations.n, *grid.y.shape), dtype=complex)
    own_columns = [of_terms[:0]]
    inputs = _in_time_of(inputs, grid, fitted, held_out)
    columns = term_columns(inputs, problem.terms)
    row_of_column = {
        (c.term, c.view, c.component): k
        for k, c in enumerate(equations.columns.columns)
    }
    for column, block in zip(columns.columns, columns.grid, strict=True):
        if block_of(column.term).of_lines:
            continue  # its views are those with lines, and no mark has a part of it
        shared = column.view == -1
        row = -1 if shared else _fitted_row(problem.inputs, inputs, rows, column.view)
        if row < 0 and not shared:
            own_columns.append(
                np.where(np.isfinite(column.size), column.size, 0.0) * block[None]
            )
        elif (key := (column.term, row, column.component)) in row_of_column:
            of_terms[row_of_column[key]] += block
    return HeldReadings(grid, of_terms, rows, np.concatenate(own_columns), place_change)


def _fitted_row(
    fitted: TermInputs, held_out: TermInputs, rows: tuple[int, ...], first: int
) -> int:
    """Return the first view of a placing in the fit; -1 if no view of it was fitted."""
    fitted_rows = [rows[view] for view in held_out.members[first] if rows[view] >= 0]
    return (
        next(
            first
            for first, members in fitted.members.items()
            if fitted_rows[0] in members
        )
        if fitted_rows
        else -1
    )


def _in_time_of(
    inputs: TermInputs, grid: GridData, fitted: Measurements, held_out: Measurements
) -> TermInputs:
    """Return the inputs with times of visits relative to those of the fitted views, -1 to 1."""
    visits: list[ViewVisits | None] = []
    ranges = time_ranges([fitted.views[index] for index in grid.index], inputs.placings)
    for index, placing, view in zip(
        grid.index, inputs.placings, inputs.visits, strict=True
    ):
        own_visits = held_out.views[index].visits
        if view is None or own_visits is None or placing not in ranges:
            visits.append(view)
            continue
        time = view_time(own_visits.stamp_ns, *ranges[placing])
        visits.append(replace(view, time=time))
    return replace(inputs, visits=tuple(visits))


def prediction_errors(solved: Solved, held_out: HeldReadings) -> np.ndarray:
    """Return the errors of prediction of held grid readings, complex (views, nx, ny), m.

    Plate frame; NaN where a mark was not held, or cannot be predicted. A misalignment that the
    solution does not know is that which fits the errors best.
    """
    model, result = solved.joint, solved.result
    problem = model.problem
    system = model.problem.system
    views = maps_of(held_out.grid)
    predictable = (
        (held_out.grid.weight > 0) & views.near(system.known_sites) & system.known_marks
    )
    plate = model.fitted.plate
    marks = views.z * problem.half_width_m
    error = (
        held_out.grid.y
        - held_out.place_change
        - np.tensordot(model.coefficients, held_out.columns, axes=1)
    )
    error = np.where(
        predictable, error - views.gather(model.fitted.field) - plate, complex(np.nan)
    )
    for error_of_view, predictable_marks, index, pose in zip(
        error, predictable, held_out.grid.index, held_out.grid.poses, strict=True
    ):
        view = result.views[index]
        phi = view.phi
        tau = complex(view.tx, view.ty) * pose.phase.conjugate()
        if not np.isfinite([phi, view.tx, view.ty]).all():
            phi, tau = _fitted_placing(
                error_of_view[predictable_marks],
                marks[predictable_marks],
                plate[predictable_marks],
                rigid=problem.rigid,
            )
        if problem.rigid:
            error_of_view -= rotation_excess(phi, marks, plate)
        error_of_view -= 1j * phi * marks + tau
    return error


def _fitted_placing(
    errors: np.ndarray, marks: np.ndarray, plate: np.ndarray, *, rigid: bool
) -> tuple[float, complex]:
    """Return rotation, rad, and offset, plate frame, m, that fit errors; NaN of too few, (P,)."""
    if len(errors) < 3:
        return np.nan, complex(np.nan)
    excess: np.ndarray | float = 0.0
    for _ in range(MAX_STEPS):  # each gains a factor of the rotation
        phi, tau = fitted_misalignment(marks, errors - excess)
        before = excess
        excess = rotation_excess(phi, marks, plate) * rigid
        if np.abs(excess - before).max() <= FLOOR:
            break
    return phi, tau


def line_errors(solved: Solved, held_out: AngularData) -> np.ndarray:
    """Return the errors of prediction of held readings of lines, (views, K), rad.

    As of `prediction_errors`; of terms of the lines where any line of their view was fitted.
    """
    model = solved.joint
    system = model.problem.system
    joint_fit = model.fitted
    fitted = model.problem.angular.index
    field = np.where(system.known_lines, joint_fit.g_theta, np.nan)
    plate = np.where(
        (held_out.weight > 0) & system.known_plate_lines, joint_fit.a_theta, np.nan
    )
    lines = lines_of(held_out)
    error = held_out.y - lines.gather(field) - plate
    terms = model.equations.columns.lines
    for error_of_view, index in zip(error, held_out.index, strict=True):
        if index in fitted and len(terms.at):
            error_of_view -= (
                model.coefficients[terms.at] @ terms.values[:, fitted.index(index)]
            )
        phi = solved.result.views[index].phi
        if not np.isfinite(phi) and np.isfinite(error_of_view).any():
            phi = np.nanmean(error_of_view)
        error_of_view -= phi
    return error


@dataclass(frozen=True)
class PredictionLimit:
    """Distribution of the mean square of scaled prediction errors for unit noise.

    `mean` and `dof` are those of the scaled chi^2 with the same mean and variance.
    """

    mean: float
    dof: float

    def ratio(self, noise_dof: float) -> float:
        """Return the ratio of error to noise that is exceeded with probability F_LEVEL."""
        dof = min(noise_dof, MANY_DOF)
        return float(np.sqrt(self.mean * fdtri(self.dof, dof, 1 - F_LEVEL)))


def prediction_limit(
    model: ModelFit, held_out: HeldReadings, predictable: np.ndarray, weight: np.ndarray
) -> PredictionLimit:
    """Return the distribution of the prediction error of held-out grid readings.

    Parameters
    ----------
    model : ModelFit
        The fit without them.
    held_out : HeldReadings
        The readings that are predicted.
    predictable : bool array (views, nx, ny)
        Which of them can be predicted.
    weight : float array (views, nx, ny)
        Their weights.
    """
    grid = model.problem.system.grid
    rng = np.random.default_rng(0)
    n = int(np.clip(READINGS_DRAWN // grid.weight.size, FEW_DRAWS, N_DRAWS))
    noise = noise_of(rng, (n, *grid.weight.shape), grid.weight)
    fields, parameters, coefficients = _fitted(model, noise, rng)
    own_noise = noise_of(rng, (n, *weight.shape), weight)
    own_terms = rng.standard_normal((len(held_out.own_columns), n)) / max(
        model.fitted.xy.sigma, FLOOR
    )
    views = maps_of(held_out.grid)
    columns = model.equations.columns.grid
    squares = np.zeros(n)
    for draw in range(n):
        field = fields[:, draw].reshape(grid.views.shape)
        readings = noise[draw] - np.tensordot(coefficients[:, draw], columns, axes=1)
        plate = grid.plate(readings, field, parameters[:, draw])[0]
        error = own_noise[draw] - views.gather(field) - plate
        error -= np.tensordot(coefficients[:, draw], held_out.columns, axes=1)
        error += np.tensordot(own_terms[:, draw], held_out.own_columns, axes=1)
        misaligned = grid.misaligned(parameters[:, draw])
        for error_of_view, predictable_marks, fitted in zip(
            error, predictable, held_out.rows, strict=True
        ):
            if fitted >= 0:
                error_of_view -= misaligned[fitted]
            elif predictable_marks.any():
                phi, tau = fitted_misalignment(
                    views.z[predictable_marks], error_of_view[predictable_marks]
                )
                error_of_view -= 1j * phi * views.z + tau
        squares[draw] = (weight * abs(error) ** 2)[predictable].sum() / (
            2 * predictable.sum()
        )
    mean = float(squares.mean())
    return PredictionLimit(mean, 2 * mean**2 / float(squares.var(ddof=1)))


def _fitted(
    model: ModelFit, noise: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fit k draws of unit noise: maps (sites, k), misalignments (3 views, k), terms (p, k)."""
    problem = model.problem
    grid = problem.system.grid
    n = 3 * problem.system.grid.n_views
    joint_fit = model.fitted
    drawn = [grid.fitted(draw, joint_fit.inverse[:n, :n]) for draw in noise]
    fields, parameters = (
        np.stack(solutions_of, axis=1) for solutions_of in zip(*drawn, strict=True)
    )
    equations = model.equations
    shapes = equations.columns.shapes
    right = np.stack(
        [
            shapes.against(shapes.sums(grid.weight * grid.plate(draw, *fitted)[1]))
            for draw, fitted in zip(noise, drawn, strict=True)
        ],
        axis=1,
    )
    values, vectors = np.linalg.eigh(equations.columns.within.gram)
    within = vectors * np.sqrt(np.maximum(values, 0.0))
    right += within @ rng.standard_normal((equations.n, len(noise)))
    feigned = np.sqrt(equations.position_noise)[:, None]
    right = equations.unbiased_sums(
        right + feigned * rng.standard_normal((equations.n, len(noise)))
    )
    # a term with a size is not 0: its estimate minus its value is drawn
    prior = np.where(equations.free, 0.0, joint_fit.xy.sigma / equations.columns.size)
    right -= prior[:, None] * rng.standard_normal((equations.n, len(noise)))
    coefficients = equations.inverse(joint_fit.xy.sigma) @ right
    return (
        fields - equations.projected.fields @ coefficients,
        parameters - equations.projected.parameters[:n] @ coefficients,
        coefficients,
    )


def fitted_misalignment(marks: np.ndarray, errors: np.ndarray) -> tuple[float, complex]:
    """Return phi and tau that fit errors, complex (P,), at marks (P,) best."""
    columns = np.stack(
        [1j * marks, np.ones_like(marks), np.full_like(marks, 1j)], axis=1
    )
    rows = np.concatenate([columns.real, columns.imag])
    scale = np.linalg.norm(rows, axis=0)
    values = np.concatenate([errors.real, errors.imag])
    phi, x, y = np.linalg.lstsq(rows / scale, values, rcond=None)[0] / scale
    return float(phi), complex(x, y)


TENTHS = 10
"""Parts of the readings, of which one is held out: the rest keep nearly all their precision."""

NOTHING = float("nan")


@dataclass(frozen=True)
class HeldOut:
    """Prediction error of one set of held-out readings.

    Attributes
    ----------
    view, tenth : str, int
        The set: a whole view, by its name, or a random tenth, by its number from 1.
    n_grid, n_angular : int
        Numbers of predicted readings.
    rms_m, max_m : float
        Error of a coordinate, m; NaN if no grid reading was predicted.
    rms_rad : float
        Error of an angular reading, rad; NaN if none was predicted.
    ratio : float
        rms over the noise of one reading: 1 by noise alone, more with the map's uncertainty.
    why : Finding, optional
        Why nothing could be predicted, or why there is no limit; otherwise None.
    limit : float
        Ratio that one of a thousand good sets exceeds; NaN if there is none.
    """

    view: str = ""
    tenth: int = 0
    n_grid: int = 0
    n_angular: int = 0
    rms_m: float = float("nan")
    max_m: float = float("nan")
    rms_rad: float = float("nan")
    ratio: float = float("nan")
    why: Finding | None = None
    limit: float = NOTHING

    @property
    def exceeds(self) -> bool:
        """Whether the error is larger than noise and the map's uncertainty explain."""
        return self.ratio > self.limit


@one_thread()
def validate(
    measurements: Measurements, options: Options, *, folds: int = 3
) -> list[HeldOut]:
    """Hold out random tenths and whole views in turn, and predict them.

    Parameters
    ----------
    measurements : Measurements
        All readings.
    options : Options
        As for `calibrate`; uncertainties are not computed.
    folds : int
        Number of random tenths, at most 10; they do not overlap.

    Raises
    ------
    NoDataError, NotIdentifiableError
        As `calibrate`, for all readings.
    """
    # a pure datum: half axes that lose a mark would not do for xy_axes
    options = replace(
        options, uncertainty=False, causes=False, datum_theta=ThetaDatum.ZERO_MEAN
    )
    fit_joint(measurements, options)  # refuses what cannot be solved as a whole
    rng = np.random.default_rng(0)
    group = []
    for view in measurements.views:
        # drawn in the order of the lattice: the order of the readings changes nothing
        ranks = (np.lexsort((view.n, view.m)).argsort(), np.argsort(view.k).argsort())
        group.append(
            tuple((rng.permutation(len(rank)) % TENTHS)[rank] for rank in ranks)
        )
    out = []
    for fold in range(folds):
        chosen = [(grid == fold, lines == fold) for grid, lines in group]
        out.append(replace(_held_out(measurements, options, chosen), tenth=fold + 1))
    for index, view in enumerate(measurements.views):
        chosen = [
            (np.full(len(v.m), i == index), np.full(len(v.k), i == index))
            for i, v in enumerate(measurements.views)
        ]
        out.append(
            replace(_held_out(measurements, options, chosen), view=view.view.name)
        )
    return out


def _held_out(
    measurements: Measurements,
    options: Options,
    chosen: list[tuple[np.ndarray, np.ndarray]],
) -> HeldOut:
    """Calibrate without the chosen readings, and predict them."""
    fitted, held_out = (
        replace(
            measurements,
            views=tuple(
                subset(view, grid ^ flip, lines ^ flip)
                for view, (grid, lines) in zip(measurements.views, chosen, strict=True)
            ),
        )
        for flip in (True, False)
    )
    try:
        solved = solve_joint(fitted, options)
    except (NotIdentifiableError, NoDataError):
        return HeldOut(why=_rest_not_identified(fitted, held_out))
    except NotSettledError:
        return HeldOut(why=RestNotConverged())
    predicted = held_readings(solved.joint, fitted, held_out)
    error = prediction_errors(solved, predicted)
    angles = line_errors(solved, angular_data(held_out))
    predictable = np.isfinite(error)
    coordinates = np.stack([error[predictable].real, error[predictable].imag])
    lines_off = angles[np.isfinite(angles)]
    if not coordinates.size and not lines_off.size:
        return HeldOut(why=NothingToPredict())
    ratio, limit, why = _ratio_and_limit(
        solved, predicted, predictable=predictable, error=error
    )
    return HeldOut(
        n_grid=coordinates.shape[1],
        n_angular=len(lines_off),
        rms_m=rms(coordinates),
        max_m=float(abs(coordinates).max()) if coordinates.size else NOTHING,
        rms_rad=rms(lines_off),
        ratio=ratio,
        why=why,
        limit=limit,
    )


def _ratio_and_limit(
    solved: Solved,
    held_out: HeldReadings,
    *,
    predictable: np.ndarray,
    error: np.ndarray,
) -> tuple[float, float, Finding | None]:
    """Return error over noise, its limit, and why there is no limit."""
    noise = solved.result.noise
    model = solved.joint
    if not predictable.any():
        return NOTHING, NOTHING, None
    weight = held_out.grid.weight
    if np.isfinite(held_out.grid.sigma_declared) and np.isfinite(
        noise.sigma_xy_declared
    ):
        # each is relative to what its own detections declare on average
        weight = weight * (noise.sigma_xy_declared / held_out.grid.sigma_declared) ** 2
    square = float((weight * abs(error) ** 2)[predictable].sum()) / (
        2 * int(predictable.sum())
    )
    ratio = float(np.sqrt(square)) / max(noise.sigma_xy, 1e-300)
    own_terms = [
        str(term.name)
        for term in model.problem.terms
        if term.free and term.block.by_placing
    ]
    if own_terms and -1 in held_out.rows:
        return (ratio, NOTHING, OwnTermsUnknown(terms=tuple(own_terms)))
    if not (noise.sigma_xy > FLOOR and noise.dof_xy > 0):
        return ratio, NOTHING, None
    return (
        ratio,
        prediction_limit(model, held_out, predictable, weight).ratio(noise.dof_xy),
        None,
    )


def _rest_not_identified(fitted: Measurements, held_out: Measurements) -> Finding:
    """Return the finding that the rest does not identify the stage, with a view to be added."""
    views = tuple(
        replace(v.view, grid=bool(len(v.m)), angular=bool(len(v.k)))
        for v in fitted.views
        if len(v.m) or len(v.k)
    )
    poses_held_out = {
        pose_of(v.view, held_out.artifact)
        for v in held_out.views
        if len(v.m) or len(v.k)
    }
    plan = Plan("", fitted.artifact, views)
    if max(fitted.artifact.shape) > FULL_SIZE and views:
        plan = smaller(plan, SEARCH_SIZE)
    for more in candidate_views(
        plan.artifact, angular=any(view.angular for view in views)
    ):
        if pose_of(more, plan.artifact) not in poses_held_out and identifies(
            plan.artifact, (*plan.views, more)
        ):
            return RestNotIdentified(add=more)
    return RestNotIdentified()


def judged_by(
    result: CalibrationResult, predictions: list[HeldOut]
) -> CalibrationResult:
    """Return the result, disqualified if a prediction error exceeds its limit."""
    failed = tuple(
        PredictionFailed(
            size=item.ratio,
            unit="m/m",
            view=item.view,
            tenth=item.tenth,
            limit=item.limit,
        )
        for item in predictions
        if item.exceeds
    )
    if not failed:
        return result
    verdict = result.verdict
    return replace(
        result,
        verdict=replace(
            verdict, grade=Grade.NOT_QUALIFIED, failed=(*verdict.failed, *failed)
        ),
    )
