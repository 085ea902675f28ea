# SPDX-License-Identifier: Apache-2.0
"""Robust calibration: find, remove and list readings that contradict the others.

The noise is estimated robustly, from the median of the standardised squares. In each round the
largest outliers are removed, at most one for each mark and site, and the fit is repeated; if
readings contradict each other so that the largest is not unique, all of them are removed. At the
end each removed reading is restored if it agrees with the others after all (F-test of its
contribution to the sum of squares, at a level that n good readings, marks and lines together, fail
with probability OUTLIER_LEVEL). Before that a view in which the plate slipped is split, unless a
term of the model explains the readings better.
"""

from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from scipy.special import chdtri, gammaincinv

from selfcal_ros.errors import InputError, NotIdentifiableError
from selfcal_ros.estimation.joint.problem import FLOOR
from selfcal_ros.estimation.joint.solve import fit_joint
from selfcal_ros.estimation.multifrontal.factor import one_thread
from selfcal_ros.estimation.options import Options
from selfcal_ros.estimation.quality.residuals import Residuals, noisy_views, residuals_of
from selfcal_ros.estimation.quality.slip import Slip, find_slip, likelier_term, split_view
from selfcal_ros.model.error_map import ThetaDatum
from selfcal_ros.model.readings import Key, Measurements, left_out, without
from selfcal_ros.model.terms import ModelTerm
from selfcal_ros.model.verdict import Finding

OUTLIER_LEVEL = 0.01
"""Probability that a measurement without outliers loses a reading."""

MAX_ROUNDS = 60
NEAR_LARGEST = 0.5
"""Share of the largest ratio above which a reading is removed in the same round: an outlier
increases the residuals of its neighbours."""

MAX_REMOVED = 0.1
"""Largest share of the readings that is removed; if it is more, the fault is another one."""

TIED = 1e-6
"""Relative difference of ratios up to which both readings are removed."""

NAMED = 5
"""Number of outliers listed in their finding; ``extra["outliers"]`` has all."""

LEFT = {"noisy_view", "too_many_outliers", "outliers_kept", "outliers_given_up", "slips_given_up"}
"""Findings of faults that could not be corrected."""

MAX_SLIPS = 3
MAX_TERMS = 3
"""Largest number of terms subtracted from the readings before the search for outliers."""


@dataclass(frozen=True)
class Removed:
    """A reading that was removed.

    Attributes
    ----------
    view, kind : str
        Name of the view; ``grid`` or ``angular``.
    mark : tuple of int
        (m, n), or (k,).
    standardised : float
        Residual over its standard deviation when it was removed.
    leverage : float
        Part of the reading that the fit followed.
    residual : float
        Length of the residual, m, or its size, rad.
    """

    view: str
    kind: str
    mark: tuple[int, ...]
    standardised: float
    leverage: float
    residual: float


@dataclass(frozen=True, eq=False)
class OutlierScreening:
    """A measurement without its outliers, and the findings."""

    measurements: Measurements
    removed: tuple[Removed, ...]
    slips: tuple[Slip, ...]
    noisy: tuple[tuple[str, float], ...]
    unchecked: int
    findings: tuple[Finding, ...]


@one_thread()
def clean(measurements: Measurements, options: Options) -> OutlierScreening:
    """Return the measurement split at slips and without outliers, and the findings."""
    # a pure datum: the redundant axis conditions of xy_axes would show in the angular residuals
    linear = replace(options, misalignment_model="linear", reference=None, terms=(), assumed=(),
                     datum_theta=ThetaDatum.ZERO_MEAN)
    screened = _without_slips(measurements, options, linear)
    gone, residuals, stopped = _reject(screened.flattened, linear, screened.residuals)
    removed = tuple(sorted(gone.values(), key=lambda item: (item.kind, item.view, item.mark)))
    noisy = noisy_views(residuals, screened.measurements)
    findings = [*screened.notes, *_findings(removed, noisy, stopped)]
    unchecked = int((np.isnan(residuals.squares) & (residuals.problem.grid.weight > 0)).sum())
    return OutlierScreening(without(screened.measurements, gone, mark=True), removed,
                            screened.slips, noisy, unchecked, tuple(findings))


@dataclass(frozen=True, eq=False)
class _Screened:
    """Readings split at slips, the same minus terms of the model, and the findings."""

    measurements: Measurements
    flattened: Measurements
    residuals: Residuals
    slips: tuple[Slip, ...] = ()
    notes: tuple[Finding, ...] = ()


def _without_slips(measurements: Measurements, options: Options, linear: Options) -> _Screened:
    """Return the readings split at slips, minus terms that explain them better than a slip."""
    flattened = _flattened(measurements, options)
    at = _Screened(measurements, flattened, residuals_of(flattened, linear))
    for _ in range(MAX_SLIPS + MAX_TERMS + 1):
        sigma = max(robust_sigma(at.residuals.squares, 2), FLOOR)
        slip = find_slip(at.residuals, sigma, at.flattened, linear)
        if slip is None:
            return at
        if len(at.slips) == MAX_SLIPS:
            break
        cause = likelier_term(at.measurements, options, slip)
        if cause is None:
            at, done = _split(at, slip, linear)
            if not done:
                return at
            continue
        at = replace(at, notes=(*at.notes, Finding(
            "taken_for_slip", cause.size, cause.u, cause.unit, cause.p, cause.view, cause.axis,
            cause.mark, {**cause.details, "cause": cause.name, "told": cause.told,
                         "slip_in": slip.view})))
        options = replace(options, terms=(*options.terms, ModelTerm(cause.name)))
        try:
            flattened = _flattened(at.measurements, options)
        except (NotIdentifiableError, InputError):
            return at
        at = replace(at, flattened=flattened, residuals=residuals_of(flattened, linear))
    return replace(at, notes=(*at.notes, Finding(
        "slips_given_up", details={"slips": len(at.slips)})))


def _split(at: _Screened, slip: Slip, linear: Options) -> tuple[_Screened, bool]:
    """Return the readings split at a slip, or without its view, and whether that was possible."""
    def split(readings: Measurements) -> Measurements:
        return left_out(readings, slip.index) if slip.alternatives else split_view(readings, slip)

    flattened = split(at.flattened)
    try:
        residuals = residuals_of(flattened, linear)
    except NotIdentifiableError:
        return replace(at, slips=(*at.slips, slip),
                       notes=(*at.notes, slip.finding(spoils=True))), False
    return _Screened(split(at.measurements), flattened, residuals, (*at.slips, slip),
                     (*at.notes, slip.finding(spoils=False))), True


def robust_sigma(squares: np.ndarray, dof: int) -> float:
    """Return the noise from the median of standardised squares; NaN if there are none."""
    known = squares[np.isfinite(squares)]
    if not len(known):
        return float("nan")
    median = 2 * gammaincinv(dof / 2, 0.5)  # of chi^2
    return float(np.sqrt(np.median(known) / median))


def _reject(measurements: Measurements, options: Options, residuals: Residuals
            ) -> tuple[dict[Key, Removed], Residuals, Finding | None]:
    """Remove outliers round by round; return them, the last residuals, and why it stopped early."""
    gone: dict[Key, Removed] = {}
    n_readings = sum(len(view.m) + len(view.k) for view in measurements.views)
    for _ in range(MAX_ROUNDS):
        found = _worst(residuals, measurements)
        if not found:
            break
        if len(gone) + len(found) > MAX_REMOVED * n_readings:
            return {}, residuals_of(measurements, options), Finding(
                "too_many_outliers", details={"limit": MAX_REMOVED})
        try:
            residuals = residuals_of(without(measurements, gone | found), options)
        except NotIdentifiableError:
            return gone, residuals, Finding("outliers_kept")
        gone |= found
    else:
        return (*_restored(measurements, options, gone, residuals),
                Finding("outliers_given_up", details={"rounds": MAX_ROUNDS}))
    return (*_restored(measurements, options, gone, residuals), None)


def _worst(residuals: Residuals, measurements: Measurements) -> dict[Key, Removed]:
    """Return the outliers of one round: the largest, one for each mark and site."""
    found: dict[Key, Removed] = {}
    grid, problem = residuals.problem.system.grid, residuals.problem
    sigma = robust_sigma(residuals.squares, 2)
    ratio = _ratio(residuals.squares, sigma)
    taken: dict[tuple[str, int], float] = {}
    # by rounded ratios, so that equal ones keep the order of the readings
    order = np.argsort(-np.round(ratio.ravel(), 6), kind="stable")
    floor = max(chdtri(2, _level(residuals)), NEAR_LARGEST * float(ratio.max()))
    for at in order[:int((ratio > floor).sum())]:
        v, i, j = np.unravel_index(at, ratio.shape)
        nodes = (("mark", int(i * ratio.shape[2] + j)),
                 ("site", int(grid.views.site_index[v, i, j])))
        above = max((taken[node] for node in nodes if node in taken), default=0.0)
        if above > (1 + TIED) * ratio[v, i, j]:
            continue
        taken |= {node: float(ratio[v, i, j]) for node in nodes if node not in taken}
        index, mark = problem.grid.index[v], grid.views.mark_at(i, j)
        found[index, "grid", mark] = Removed(
            measurements.views[index].view.name, "grid", mark, float(np.sqrt(ratio[v, i, j])),
            float(1 - residuals.redundancy[v, i, j]),
            float(abs(residuals.found.residuals[v, i, j])))
    return found | _worst_theta(residuals, measurements)


def _worst_theta(residuals: Residuals, measurements: Measurements) -> dict[Key, Removed]:
    """Return the largest outlier of the lines in a round, if there is one."""
    squares = residuals.squares_theta
    if not np.isfinite(squares).any():
        return {}
    ratio = _ratio(squares, robust_sigma(squares, 1))
    v, k = np.unravel_index(int(np.argmax(ratio)), ratio.shape)
    if ratio[v, k] <= chdtri(1, _level(residuals)):
        return {}
    index = residuals.problem.angular.index[v]
    return {(index, "angular", (int(k),)): Removed(
        measurements.views[index].view.name, "angular", (int(k),), float(np.sqrt(ratio[v, k])),
        float(1 - residuals.redundancy_theta[v, k]),
        float(abs(residuals.found.residuals_theta[v, k])))}


def _ratio(squares: np.ndarray, sigma: float) -> np.ndarray:
    return np.nan_to_num(squares, nan=0.0) / max(sigma, FLOOR) ** 2


def _level(residuals: Residuals) -> float:
    """Return the level of the test of one reading, so that all checked ones have OUTLIER_LEVEL."""
    return OUTLIER_LEVEL / max(np.isfinite(residuals.squares).sum()
                               + np.isfinite(residuals.squares_theta).sum(), 1)


def _restored(measurements: Measurements, options: Options, gone: dict[Key, Removed],
                residuals: Residuals) -> tuple[dict[Key, Removed], Residuals]:
    """Restore readings, one by one, that agree with the good ones.

    Readings that were removed together, each the only check of the other, are restored together.
    """
    for key in sorted(gone, key=lambda k: gone[k].standardised):
        if key not in gone:
            continue
        mates = {k for k in gone if k[1] == key[1] and abs(
            gone[k].standardised - gone[key].standardised) <= TIED * gone[key].standardised}
        for back in dict.fromkeys((frozenset([key]), frozenset(mates))):
            rest = {k: v for k, v in gone.items() if k not in back}
            again = residuals_of(without(measurements, rest), options)
            if all(_agrees(again, one) for one in back):
                gone, residuals = rest, again
                break
    return gone, residuals


def _agrees(residuals: Residuals, key: Key) -> bool:
    """Return whether a reading can be checked against the others, and agrees with them."""
    index, kind, mark = key
    at: tuple[int, ...]
    if kind == "grid":
        views = residuals.problem.system.grid.views
        at = (residuals.problem.grid.index.index(index), *views.index_of(*mark))
    else:
        at = (residuals.problem.angular.index.index(index), *mark)
    # NaN: a reading that cannot be checked does not agree
    return residuals.p_outlier(kind, at) >= _level(residuals)


def _findings(removed: tuple[Removed, ...], noisy: tuple[tuple[str, float], ...],
              stopped: Finding | None) -> list[Finding]:
    out = [Finding("outliers_removed", details={"number": len(removed), "first": [
        {"view": item.view, "kind": item.kind, "mark": list(item.mark),
         "standardised": item.standardised} for item in removed[:NAMED]]})] if removed else []
    out += [Finding("noisy_view", ratio, unit="m/m", view=name) for name, ratio in noisy]
    return out + ([stopped] if stopped else [])


def _flattened(measurements: Measurements, options: Options) -> Measurements:
    """Return the readings minus the effects of finite rotations, terms and stage positions."""
    seen = any(view.visits is not None for view in measurements.views)
    if options.misalignment_model == "linear" and not (options.terms or seen):
        return measurements
    model = fit_joint(measurements, options)
    problem = model.problem
    views = list(measurements.views)
    for row, index in enumerate(problem.grid.index):
        view = views[index]
        marks = problem.system.grid.views.z * problem.half_width_m
        flat = model.y[row] + 1j * problem.turn_rad[row] * marks
        at = measurements.artifact.index(view.m, view.n)
        linear = flat[at] * problem.grid.poses[row].phase
        views[index] = replace(view, dx=linear.real, dy=linear.imag, visits=None)
    return replace(measurements, views=tuple(views))


def listed(cleaned: OutlierScreening) -> dict[str, Any]:
    """Return the tables of outliers, slips and noisy views for RESULT.json, SI units."""
    removed = [{
        "view": item.view, "kind": item.kind, "mark": list(item.mark),
        "standardised": item.standardised, "leverage": item.leverage,
        "residual_m": item.residual if item.kind == "grid" else None,
        "residual_rad": item.residual if item.kind == "angular" else None,
    } for item in cleaned.removed]
    outliers = {"rule": f"removed if its squared standardised residual fails an F-test at level "
                        f"{OUTLIER_LEVEL}/n, for marks and lines together",
                "unchecked": cleaned.unchecked, "removed": removed}
    return {"outliers": outliers, "slips": [asdict(item) for item in cleaned.slips],
            "noisy_views": [{"view": name, "ratio": ratio} for name, ratio in cleaned.noisy]}
