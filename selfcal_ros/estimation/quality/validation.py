# SPDX-License-Identifier: Apache-2.0
"""Held-out validation: how well a calibration predicts readings that it has not seen.

Small residuals prove nothing; a prediction can fail. A tenth of the readings, or a whole view, is
held out, the rest is calibrated, and the readings held out are predicted. The three misalignments
of a whole view are fitted to its readings first, as no calibration can know them.
"""

from dataclasses import dataclass, replace

import numpy as np

from selfcal_ros.errors import (
    InputError,
    NoDataError,
    NotIdentifiableError,
    NotSettledError,
)
from selfcal_ros.estimation.joint.problem import FLOOR
from selfcal_ros.estimation.joint.solve import fit_joint, solve_joint
from selfcal_ros.estimation.joint.solved import Solved
from selfcal_ros.estimation.lattice.readings import angular_data, pose_of
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
    held_readings,
    line_errors,
    prediction_errors,
    prediction_limit,
)
from selfcal_ros.model.error_map import ThetaDatum, rms
from selfcal_ros.model.readings import Measurements, subset
from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.model.verdict import Finding, Grade
from selfcal_ros.model.view import Plan

MAX_FOLDS = 10

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
    of = held_readings(solved.joint, kept, held)
    error, angles = prediction_errors(solved, of), line_errors(solved, angular_data(held))
    known = np.isfinite(error)
    both = np.stack([error[known].real, error[known].imag])
    lines_off = angles[np.isfinite(angles)]
    if not both.size and not lines_off.size:
        return HeldOut(why=Finding("nothing_to_predict"))
    ratio, limit, why = _judged(solved, of, known=known, error=error)
    return HeldOut("", 0, both.shape[1], len(lines_off), rms(both) if both.size else NOTHING,
                   float(abs(both).max()) if both.size else NOTHING,
                   rms(lines_off) if lines_off.size else NOTHING, ratio, why, limit)


def _judged(solved: Solved, held: HeldReadings, *, known: np.ndarray,
            error: np.ndarray) -> tuple[float, float, Finding | None]:
    """Return error over noise, its limit, and why there is no limit."""
    noise, model = solved.result.noise, solved.joint
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
