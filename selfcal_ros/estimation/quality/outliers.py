# SPDX-License-Identifier: Apache-2.0
"""Calibration that finds, removes and lists readings that contradict the others.

The rule. The noise is the median of the standardised squares over that of chi^2. A grid reading is
an outlier if its squared standardised residual (leverage included) exceeds the level that one of n
good readings exceeds with probability LEVEL; an angular one likewise. The largest are removed
first, at most one for each mark and site in a round, then the fit is repeated; readings that
contradict each other so that the largest is not unique all go. At the end a removed reading is
taken back if it can be checked and agrees after all. A slipped view is split before that.
"""

from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from scipy.stats import chi2

from selfcal_ros.errors import InputError, NotIdentifiableError
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.blas_threads import one_thread
from selfcal_ros.estimation.lattice.finite_rotation import (
    rotation_excess,
    turned_marks,
    turned_plate,
)
from selfcal_ros.estimation.options import Options
from selfcal_ros.estimation.quality.leverage import Residuals, residuals_of, view_noise
from selfcal_ros.estimation.quality.slip import Slip, find_slip, split_view
from selfcal_ros.model.error_map import ThetaDatum
from selfcal_ros.model.readings import Measurements, ViewReadings
from selfcal_ros.model.result import CalibrationResult

LEVEL = 0.01
"""Probability that a measurement without outliers loses a reading."""

MAX_ROUNDS = 60
NEAR_LARGEST = 0.5
"""Part of the largest ratio that a reading needs to go in the same round: an outlier makes its
neighbours look bad."""

MAX_REMOVED = 0.1
"""Largest part of the readings that is removed; beyond, the fault is not in single readings."""

TIED = 1e-6
"""Readings whose ratios differ by less contradict each other, no one knows which is wrong."""

MAX_SLIPS = 3
NOISY_VIEW = 3.0
"""A view is named if its noise is this many times that of the others together."""
MIN_VIEW_DOF = 5.0
"""Degrees of freedom of a view's own noise below which it is not judged: chance does as much."""

MAX_RATIO = 20.0
"""Largest ratio of noises that residuals can tell: a noisy view hides the noise of the others."""

ROUNDING = 1e-13
"""Noise below this, m or rad, is rounding, against which nothing is an outlier."""

REASON = "outlier_among_views"


@dataclass(frozen=True)
class Removed:
    """A reading that was removed.

    Attributes
    ----------
    view : str
        Name of the view.
    kind : str
        ``grid`` or ``angular``.
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
    """A measurement without its outliers, and what was found."""

    measurements: Measurements
    removed: tuple[Removed, ...]
    slips: tuple[Slip, ...]
    noisy: tuple[tuple[str, float], ...]
    unchecked: int
    warnings: tuple[str, ...]


def robust_calibrate(measurements: Measurements,
                     options: Options | None = None) -> CalibrationResult:
    """Calibrate without the readings that contradict the others.

    Parameters
    ----------
    measurements : Measurements
        All readings.
    options : Options, optional
        As for `selfcal_ros.estimation.api.calibrate`; the method must be ``joint``.

    Returns
    -------
    CalibrationResult
        `warnings` says in words what was found, ``extra["outliers"]`` lists with view and mark
        what was removed, ``extra["slips"]`` and ``extra["noisy_views"]`` the bad views;
        `rejected` counts the removed detections under ``outlier_among_views``.

    Raises
    ------
    InputError
        For Hu's law, which needs every reading.
    NotIdentifiableError
        As `calibrate`.
    """
    options = options or Options()
    if options.method != "joint":
        raise InputError("--robust", "Hu's law needs every reading and cannot leave any out",
                         "solve with --method joint")
    cleaned = clean(measurements, options)
    result = calibrate(cleaned.measurements, options)
    return replace(result, warnings=(*result.warnings, *cleaned.warnings),
                   extra={**result.extra, **_listed(cleaned)})


def _listed(cleaned: OutlierScreening) -> dict[str, Any]:
    """Return what was found in the form of a RESULT.json: tables of plain values, SI units."""
    removed = [{
        "view": item.view, "kind": item.kind, "mark": ", ".join(map(str, item.mark)),
        "standardised": item.standardised, "leverage": item.leverage,
        "residual_m": item.residual if item.kind == "grid" else None,
        "residual_rad": item.residual if item.kind == "angular" else None,
    } for item in cleaned.removed]
    outliers = {"rule": f"removed if the squared standardised residual is above chi2 (2 degrees of "
                        f"freedom for a mark, 1 for a line) at level {LEVEL}/n",
                "unchecked": cleaned.unchecked, "removed": removed}
    return {"outliers": outliers, "slips": [
        asdict(item) | {"alternatives": "; ".join(item.alternatives)} for item in cleaned.slips],
            "noisy_views": [{"view": name, "ratio": ratio} for name, ratio in cleaned.noisy]}


@one_thread()
def clean(measurements: Measurements, options: Options) -> OutlierScreening:
    """Return the measurement split at slips and without outliers, and what was found."""
    # a pure datum: the redundant axis conditions of xy_axes would show in the angular residuals
    linear = replace(options, misalignment_model="linear", reference=None,
                     datum_theta=ThetaDatum.ZERO_MEAN)
    flattened = measurements
    if options.misalignment_model != "linear":
        flattened = _flattened(measurements, options)
    slips: list[Slip] = []
    notes: list[str] = []
    residuals = residuals_of(flattened, linear)
    while len(slips) < MAX_SLIPS:
        sigma = max(robust_sigma(residuals.squares, 2), ROUNDING)
        slip = find_slip(residuals, sigma, flattened, linear)
        if slip is None:
            break
        slips.append(slip)
        notes.append(slip.text())
        try:
            mend = _left_out if slip.alternatives else split_view
            residuals = residuals_of(mend(flattened, slip), linear)
        except NotIdentifiableError:
            notes[-1] += "; the map is spoiled by it: measure the view again"
            break
        flattened, measurements = mend(flattened, slip), mend(measurements, slip)
        notes[-1] += "; the view is left out" if slip.alternatives else ""
    gone, residuals, stopped = _reject(flattened, linear, residuals)
    removed = tuple(sorted(gone.values(), key=lambda item: (item.kind, item.view, item.mark)))
    noisy = _noisy_views(residuals, flattened)
    warnings = notes + _warnings(removed, noisy, stopped)
    unchecked = int((np.isnan(residuals.squares) & (residuals.problem.grid.weight > 0)).sum())
    return OutlierScreening(_without(measurements, gone, mark=True), removed, tuple(slips), noisy,
                            unchecked, tuple(warnings))


def _left_out(measurements: Measurements, slip: Slip) -> Measurements:
    """Return the measurement without the readings of the slipped view."""
    view = measurements.views[slip.index]
    lost = int(view.count.sum() + view.count_theta.sum())
    empty = subset(view, np.zeros(len(view.m), dtype=bool), np.zeros(len(view.k), dtype=bool))
    empty = replace(empty, used=view.used - lost,
                    rejected={**view.rejected, REASON: view.rejected.get(REASON, 0) + lost})
    views = (*measurements.views[:slip.index], empty, *measurements.views[slip.index + 1:])
    return replace(measurements, views=views)


def robust_sigma(squares: np.ndarray, dof: int) -> float:
    """Return the noise whose chi^2 has the median of the standardised squares; NaN if none."""
    known = squares[np.isfinite(squares)]
    return float(np.sqrt(np.median(known) / chi2.median(dof))) if len(known) else float("nan")


Key = tuple[int, str, tuple[int, ...]]


def _reject(measurements: Measurements, options: Options, residuals: Residuals
            ) -> tuple[dict[Key, Removed], Residuals, str]:
    """Remove outliers round by round; return them, the last residuals, why it stopped early."""
    gone: dict[Key, Removed] = {}
    n_readings = sum(len(view.m) + len(view.k) for view in measurements.views)
    for _ in range(MAX_ROUNDS):
        found = _worst(residuals, measurements)
        if not found:
            break
        if len(gone) + len(found) > MAX_REMOVED * n_readings:
            return {}, residuals_of(measurements, options), (
                f"more than {MAX_REMOVED:.0%} of the readings contradict the others: none was "
                "removed; look for a wrong plan or a faulty view")
        try:
            residuals = residuals_of(_without(measurements, gone | found), options)
        except NotIdentifiableError:
            return gone, residuals, "removing more outliers would leave the stage undetermined"
        gone |= found
    return _taken_back(measurements, options, gone, residuals)


def _worst(residuals: Residuals, measurements: Measurements) -> dict[Key, Removed]:
    """Return the outliers of one round: the largest first, one for each mark and site."""
    found: dict[Key, Removed] = {}
    grid, problem = residuals.problem.system.grid, residuals.problem
    sigma, n = robust_sigma(residuals.squares, 2), np.isfinite(residuals.squares).sum()
    ratio = _ratio(residuals.squares, sigma)
    taken: dict[tuple[str, int], float] = {}
    # in the order of ratios rounded, so that ties have the order of the readings
    order = np.argsort(-np.round(ratio.ravel(), 6), kind="stable")
    floor = max(chi2.isf(LEVEL / n, 2), NEAR_LARGEST * float(ratio.max()))
    for at in order[:int((ratio > floor).sum())]:
        v, i, j = np.unravel_index(at, ratio.shape)
        nodes = (("mark", int(i * ratio.shape[2] + j)),
                 ("site", int(grid.views.site_index[v, i, j])))
        above = max((taken[node] for node in nodes if node in taken), default=0.0)
        if above > (1 + TIED) * ratio[v, i, j]:
            continue
        taken |= {node: float(ratio[v, i, j]) for node in nodes if node not in taken}
        index, (hx, hy) = problem.grid.index[v], grid.views.half
        mark = (int(i) - hx, int(j) - hy)
        found[index, "grid", mark] = Removed(
            measurements.views[index].view.name, "grid", mark, float(np.sqrt(ratio[v, i, j])),
            float(1 - residuals.redundancy[v, i, j]),
            float(abs(residuals.found.residuals[v, i, j])))
    return found | _worst_theta(residuals, measurements)


def _worst_theta(residuals: Residuals, measurements: Measurements) -> dict[Key, Removed]:
    """Return the largest angular outlier of a round, if there is one."""
    squares = residuals.squares_theta
    n = np.isfinite(squares).sum()
    if not n:
        return {}
    ratio = _ratio(squares, robust_sigma(squares, 1))
    v, k = np.unravel_index(int(np.argmax(ratio)), ratio.shape)
    if ratio[v, k] <= chi2.isf(LEVEL / n, 1):
        return {}
    index = residuals.problem.angular.index[v]
    return {(index, "angular", (int(k),)): Removed(
        measurements.views[index].view.name, "angular", (int(k),), float(np.sqrt(ratio[v, k])),
        float(1 - residuals.redundancy_theta[v, k]),
        float(abs(residuals.found.residuals_theta[v, k])))}


def _ratio(squares: np.ndarray, sigma: float) -> np.ndarray:
    return np.nan_to_num(squares, nan=0.0) / max(sigma, ROUNDING) ** 2


def _taken_back(measurements: Measurements, options: Options, gone: dict[Key, Removed],
                residuals: Residuals) -> tuple[dict[Key, Removed], Residuals, str]:
    """Take back, one by one, what is no outlier in the company of the good readings."""
    for key in sorted(gone, key=lambda k: gone[k].standardised):
        rest = {k: v for k, v in gone.items() if k != key}
        again = residuals_of(_without(measurements, rest), options)
        if _agrees(again, key):
            gone, residuals = rest, again
    return gone, residuals, ""


def _agrees(residuals: Residuals, key: Key) -> bool:
    """Return whether a reading can be checked against the others and agrees with them."""
    index, kind, mark = key
    at: tuple[int, ...]
    if kind == "grid":
        hx, hy = residuals.problem.system.grid.views.half
        squares, dof = residuals.squares, 2
        at = (residuals.problem.grid.index.index(index), mark[0] + hx, mark[1] + hy)
    else:
        squares, dof = residuals.squares_theta, 1
        at = (residuals.problem.angular.index.index(index), *mark)
    limit = chi2.isf(LEVEL / np.isfinite(squares).sum(), dof)
    # NaN: a reading that cannot be checked does not agree
    return bool(_ratio(squares, robust_sigma(squares, dof))[at] <= limit
                and np.isfinite(squares[at]))


def _without(measurements: Measurements, gone: dict[Key, Removed], *,
             mark: bool = False) -> Measurements:
    """Return the measurement without some readings; `mark` counts them as rejected."""
    views = []
    for index, view in enumerate(measurements.views):
        grid = {key[2] for key in gone if key[0] == index and key[1] == "grid"}
        lines = {key[2][0] for key in gone if key[0] == index and key[1] == "angular"}
        views.append(_thinned(view, grid, lines, mark=mark) if grid or lines else view)
    return replace(measurements, views=tuple(views))


def _thinned(view: ViewReadings, marks: set[tuple[int, ...]], lines: set[int], *,
             mark: bool) -> ViewReadings:
    keep = np.array([(int(m), int(n)) not in marks for m, n in zip(view.m, view.n, strict=True)],
                    dtype=bool)
    stay = np.array([int(k) not in lines for k in view.k], dtype=bool)
    lost = int(view.count[~keep].sum() + view.count_theta[~stay].sum())
    thinned = subset(view, keep, stay)
    if not mark:
        return thinned
    rejected = {**view.rejected, REASON: view.rejected.get(REASON, 0) + lost}
    return replace(thinned, rejected=rejected, used=view.used - lost)


def subset(view: ViewReadings, grid: np.ndarray, lines: np.ndarray) -> ViewReadings:
    """Return the readings of a view where the masks over its marks and lines are true."""
    return replace(
        view, **{name: getattr(view, name)[grid] for name in ("m", "n", "dx", "dy", "count")},
        **{name: getattr(view, name)[lines] for name in ("k", "dtheta", "count_theta")},
        u=view.u[grid] if len(view.u) else view.u,
        u_theta=view.u_theta[lines] if len(view.u_theta) else view.u_theta,
        visits=view.visits.of_marks(grid) if view.visits is not None else None)


def _noisy_views(residuals: Residuals, measurements: Measurements) -> tuple[tuple[str, float], ...]:
    """Return the views whose noise stands out, with its ratio to that of the others."""
    if residuals.problem.system.grid.n_views < 2:
        return ()
    out = []
    for index, (own, others, dof) in zip(residuals.problem.grid.index, view_noise(residuals),
                                         strict=True):
        ratio = float(own / max(others, own / MAX_RATIO, ROUNDING))
        if ratio > NOISY_VIEW and dof >= MIN_VIEW_DOF:
            out.append((measurements.views[index].view.name, ratio))
    return tuple(out)


def _warnings(removed: tuple[Removed, ...], noisy: tuple[tuple[str, float], ...],
              stopped: str) -> list[str]:
    out = []
    if removed:
        names = [f"'{item.view}' {item.kind} {item.mark if len(item.mark) > 1 else item.mark[0]} "
                 f"({item.standardised:.1f} sigma)" for item in removed[:5]]
        more = f" and {len(removed) - 5} more" if len(removed) > 5 else ""
        out.append(f"removed {len(removed)} outliers: " + ", ".join(names) + more)
    out += [f"view '{name}' is {ratio:.1f} times as noisy as the others: measure it again"
            for name, ratio in noisy]
    return out + ([stopped] if stopped else [])


def _flattened(measurements: Measurements, options: Options) -> Measurements:
    """Return the readings less what finite rotations add to the linear model."""
    found = calibrate(measurements, replace(options, uncertainty=False))
    artifact, views = measurements.artifact, []
    for view, result in zip(measurements.views, found.views, strict=True):
        if len(view.m) and np.isfinite(result.phi):
            plate = np.nan_to_num(turned_plate(view, artifact, found.artifact_map))
            more = rotation_excess(result.phi, turned_marks(view, artifact), plate)
            view = replace(view, dx=view.dx - more.real, dy=view.dy - more.imag)
        views.append(view)
    return replace(measurements, views=tuple(views))
