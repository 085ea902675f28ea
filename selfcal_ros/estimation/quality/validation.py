# SPDX-License-Identifier: Apache-2.0
"""Held-out validation: how well a calibration predicts readings that it has not seen.

Small residuals prove nothing; a prediction can fail. A tenth of the readings, or a whole view, is
held out, the rest is calibrated, and the readings held out are predicted. The three misalignments
of a whole view are fitted to its readings first, as no calibration can know them.
"""

from dataclasses import dataclass, replace

import numpy as np

from selfcal_ros.compensation.circle import Circle
from selfcal_ros.errors import (
    InputError,
    NoDataError,
    NotIdentifiableError,
    NotSettledError,
)
from selfcal_ros.estimation.joint.model_fit import ModelFit
from selfcal_ros.estimation.joint.problem import FLOOR
from selfcal_ros.estimation.joint.solve import fit_joint, solve_joint
from selfcal_ros.estimation.joint.solved import Solved
from selfcal_ros.estimation.lattice.maps import rotation_excess, turned_marks, turned_plate
from selfcal_ros.estimation.lattice.placed import maps_of
from selfcal_ros.estimation.lattice.readings import pose_of
from selfcal_ros.estimation.multifrontal.factor import one_thread
from selfcal_ros.estimation.observability.plan_check import (
    candidate_views,
    smaller,
)
from selfcal_ros.estimation.observability.rank import identifies
from selfcal_ros.estimation.observability.suggest import FULL_SIZE, SEARCH_SIZE
from selfcal_ros.estimation.options import Options
from selfcal_ros.estimation.quality.prediction import (
    HeldReadings,
    fitted_misalignment,
    held_readings,
    of_line_terms,
    of_terms,
    prediction_limit,
)
from selfcal_ros.model.error_map import ThetaDatum, rms
from selfcal_ros.model.readings import Measurements, Sense, ViewReadings, subset
from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.model.verdict import Finding, Grade
from selfcal_ros.model.view import Plan

MAX_FOLDS = 10

NOTHING = float("nan")

RIGID_STEPS = 8
"""Iterations for the finite rotation of a held-out view; each gains a factor of its size."""


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
def validate(measurements: Measurements, options: Options | None = None, *, seed: int = 0,
             folds: int = 3) -> list[HeldOut]:
    """Hold out random tenths and whole views in turn, and predict them.

    Parameters
    ----------
    measurements : Measurements
        All readings.
    options : Options, optional
        As for `calibrate`; uncertainties are not computed, the method is ``joint``.
    seed : int
        Seed of the random tenths.
    folds : int
        Number of random tenths, 1 to 10; they do not overlap.

    Raises
    ------
    InputError
        If `folds` is out of range.
    NoDataError, NotIdentifiableError
        As `calibrate`, for all readings.
    """
    if not 1 <= folds <= MAX_FOLDS:
        raise InputError("folds", f"{folds} is not a number from 1 to {MAX_FOLDS}",
                         "give a number of tenths")
    # a pure datum: half axes that lose a mark would not do for xy_axes
    options = replace(options or Options(), method="joint", uncertainty=False, causes=False,
                      datum_theta=ThetaDatum.ZERO_MEAN)
    fit_joint(measurements, options)  # refuses what cannot be solved as a whole
    rng = np.random.default_rng(seed)
    group = []
    for view in measurements.views:
        # drawn in the order of the lattice: the order of the readings changes nothing
        ranks = (np.lexsort((view.n, view.m)).argsort(), np.argsort(view.k).argsort())
        group.append(tuple((rng.permutation(len(rank)) % MAX_FOLDS)[rank] for rank in ranks))
    out = []
    for fold in range(folds):
        chosen = [(grid == fold, lines == fold) for grid, lines in group]
        out.append(replace(_held_out(measurements, options, chosen), tenth=fold + 1))
    for index, view in enumerate(measurements.views):
        chosen = [(np.full(len(v.m), i == index), np.full(len(v.k), i == index))
                  for i, v in enumerate(measurements.views)]
        out.append(replace(_held_out(measurements, options, chosen), view=view.view.name))
    return out


def _held_out(measurements: Measurements, options: Options,
              chosen: list[tuple[np.ndarray, np.ndarray]]) -> HeldOut:
    """Calibrate without the chosen readings, and predict them."""
    kept, held = (replace(measurements, views=tuple(
        subset(view, grid ^ flip, lines ^ flip)
        for view, (grid, lines) in zip(measurements.views, chosen, strict=True)))
        for flip in (True, False))
    try:
        solved = solve_joint(kept, options)
    except (NotIdentifiableError, NoDataError):
        return HeldOut(why=_rest_not_identified(kept, held))
    except NotSettledError:
        return HeldOut(why=Finding("rest_not_converged"))
    model = solved.model
    if model is None:
        raise AssertionError("the joint solution always has its model")
    of = held_readings(model, kept, held)
    rigid = options.misalignment_model == "rigid"
    errors, angles = [], []
    known_at, error_at = np.zeros(of.grid.weight.shape, dtype=bool), np.zeros_like(of.grid.y)
    for index, view in enumerate(held.views):
        at = measurements.artifact.index(view.m, view.n)
        more = of_terms(model, of, index, at)
        less = replace(view, dx=view.dx - more.real, dy=view.dy - more.imag,
                       dtheta=view.dtheta - of_line_terms(model, index, view.k))
        residual, residual_theta = prediction_errors(measurements, solved.result, index, less,
                                                     rigid=rigid)
        errors.append(residual)
        angles.append(residual_theta)
        if index in of.grid.index:
            row, good = of.grid.index.index(index), np.isfinite(residual).all(axis=0)
            known_at[row][at] = good
            error_at[row][at] = np.where(good, residual[0] + 1j * residual[1], 0.0)
    both, lines_off = np.concatenate(errors, axis=1), np.concatenate(angles)
    both = both[:, np.isfinite(both).all(axis=0)]
    lines_off = lines_off[np.isfinite(lines_off)]
    if not both.size and not lines_off.size:
        return HeldOut(why=Finding("nothing_to_predict"))
    ratio, limit, why = _judged(solved, model, of, known=known_at, error=error_at)
    return HeldOut("", 0, both.shape[1], len(lines_off), rms(both) if both.size else NOTHING,
                   float(abs(both).max()) if both.size else NOTHING,
                   rms(lines_off) if lines_off.size else NOTHING, ratio, why, limit)


def _judged(solved: Solved, model: ModelFit, held: HeldReadings, *, known: np.ndarray,
            error: np.ndarray) -> tuple[float, float, Finding | None]:
    """Return error over noise, its limit, and why there is no limit."""
    noise = solved.result.noise
    if not known.any():
        return NOTHING, NOTHING, None
    weight = held.grid.weight
    if np.isfinite(held.grid.sigma_declared) and np.isfinite(noise.sigma_xy_declared):
        # each is relative to what its own detections declare on average
        weight = weight * (noise.sigma_xy_declared / held.grid.sigma_declared) ** 2
    square = float((weight * abs(error) ** 2)[known].sum()) / (2 * int(known.sum()))
    ratio = float(np.sqrt(square)) / max(noise.sigma_xy, 1e-300)
    own = [str(term.name) for term in model.problem.terms
           if term.free and term.block.by_placing]
    if own and -1 in held.rows:
        return ratio, NOTHING, Finding("own_terms_unknown", details={"terms": own})
    if not (noise.sigma_xy > FLOOR and noise.dof_xy > 0):
        return ratio, NOTHING, None
    return ratio, prediction_limit(model, held, known, weight).ratio(noise.dof_xy), None


def _rest_not_identified(kept: Measurements, held: Measurements) -> Finding:
    """Return the finding that the rest does not identify the stage, with a view to be added."""
    views = tuple(replace(v.view, grid=bool(len(v.m)), angular=bool(len(v.k)))
                  for v in kept.views if len(v.m) or len(v.k))
    gone = {pose_of(v.view, held.artifact) for v in held.views if len(v.m) or len(v.k)}
    plan = Plan("", kept.artifact, views)
    if max(kept.artifact.shape) > FULL_SIZE and views:
        plan = smaller(plan, SEARCH_SIZE)
    for more in candidate_views(plan.artifact, angular=any(view.angular for view in views)):
        if pose_of(more, plan.artifact) not in gone and identifies(
                plan.artifact, (*plan.views, more)):
            return Finding("rest_not_identified", details={"add": {
                "rotation": more.rotation_rad, "translation_x": more.translation_m[0],
                "translation_y": more.translation_m[1], "grid": more.grid,
                "angular": more.angular}})
    return Finding("rest_not_identified")


def prediction_errors(measurements: Measurements, result: CalibrationResult, index: int,
                      view: ViewReadings, *, rigid: bool = False
                      ) -> tuple[np.ndarray, np.ndarray]:
    """Return the prediction errors of the readings `view`, (2, P) in m and (Q,) in rad.

    Parameters
    ----------
    measurements : Measurements
        For the plate and the sense.
    result : CalibrationResult
        Calibration without these readings.
    index : int
        Position of the view in the calibration, for its misalignment; a misalignment that is
        not known there is fitted to the readings.
    view : ViewReadings
        Readings that are predicted.
    rigid : bool
        Whether the calibration took finite rotations of the plate.
    """
    known = result.views[index]
    grid = _aligned(_grid_errors(measurements, result, view), measurements, result, view,
                    known=(known.phi, known.tx, known.ty), rigid=rigid)
    theta = np.zeros(0)
    if len(view.k):
        sign = -1 if measurements.sense is Sense.PLATE_MOVES else 1
        count = measurements.artifact.angular_count
        turn = pose_of(view.view, measurements.artifact).turn_lines or 0
        site, g = sign * (view.k + turn) % count, result.error_map.g_theta
        if harmonics := measurements.artifact.harmonics:
            g_theta = Circle(g, cubic=False, harmonics=harmonics).at(
                site * (2 * np.pi / count) + sign * view.axis_theta)
        else:
            g_theta = g[site]
        theta = (view.dtheta - sign * g_theta
                 - result.artifact_map.a_theta[view.k])
        phi = known.phi
        if not np.isfinite(phi):
            phi = np.nanmean(theta) if np.isfinite(theta).any() else np.nan
        theta = theta - phi
    return grid, theta


def _grid_errors(measurements: Measurements, result: CalibrationResult,
                 view: ViewReadings) -> np.ndarray:
    """Return the readings minus stage and plate error, complex (P,); NaN where one is unknown."""
    if not len(view.m):
        return np.zeros(0, dtype=complex)
    artifact, emap = measurements.artifact, result.error_map
    field = emap.gx + 1j * emap.gy
    if measurements.sense is Sense.PLATE_MOVES:
        field = -field[::-1, ::-1]
    pose = pose_of(view.view, artifact)
    at_marks = pose.phase * maps_of(artifact.shape, (pose,)).gather(field)[0]
    at = artifact.index(view.m, view.n)
    return (view.dx + 1j * view.dy - at_marks[at]
            - turned_plate(view, artifact, result.artifact_map))


def _aligned(residual: np.ndarray, measurements: Measurements, result: CalibrationResult,
             view: ViewReadings, *, known: tuple[float, float, float], rigid: bool) -> np.ndarray:
    """Return `residual` minus the misalignment, known or fitted to `residual` itself, (2, P)."""
    if not residual.size:
        return np.zeros((2, 0))
    artifact = measurements.artifact
    marks = turned_marks(view, artifact)
    plate = turned_plate(view, artifact, result.artifact_map)
    if np.isfinite(known).all():
        phi, tx, ty = known
    else:
        phi, tx, ty = _misalignment(residual, marks)
        for _ in range(RIGID_STEPS if rigid else 0):
            phi, tx, ty = _misalignment(residual - rotation_excess(phi, marks, plate), marks)
    if rigid:
        residual = residual - rotation_excess(phi, marks, plate)
    rest = residual - 1j * phi * marks - complex(tx, ty)
    return np.stack([rest.real, rest.imag])


def _misalignment(residual: np.ndarray, marks: np.ndarray) -> tuple[float, float, float]:
    """Fit (phi, tx, ty) to `residual`; NaN if fewer than three marks are known."""
    good = np.isfinite(residual)
    if good.sum() < 3:
        return (float("nan"),) * 3
    phi, tx, ty = fitted_misalignment(marks[good], residual[good, None])[:, 0]
    return float(phi), float(tx), float(ty)


def judged_by(result: CalibrationResult, found: list[HeldOut]) -> CalibrationResult:
    """Return the result, disqualified if a prediction error exceeds its limit."""
    failed = tuple(Finding("prediction_failed", item.ratio, unit="m/m", view=item.view,
                           details={"tenth": item.tenth, "limit": item.limit})
                   for item in found if item.exceeds)
    if not failed:
        return result
    verdict = result.verdict
    return replace(result, verdict=replace(verdict, grade=Grade.NOT_QUALIFIED,
                                           failed=(*verdict.failed, *failed)))
