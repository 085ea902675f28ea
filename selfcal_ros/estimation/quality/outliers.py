# SPDX-License-Identifier: Apache-2.0
"""Robust calibration: find, remove and list readings that contradict the others.

The noise is estimated robustly, from the median of the standardised squares. In each round the
largest outliers are removed, at most one for each mark and site, and the fit is repeated; if
readings contradict each other so that the largest is not unique, all of them are removed. At the
end each removed reading is restored if it agrees with the others after all (F-test of its
contribution to the sum of squares, at a level that n good readings, marks and lines together, fail
with probability OUTLIER_LEVEL). Before that a view in which the plate slipped is split, unless a
term of the model explains the readings better.

Grid and angular readings are fitted separately here, so that the sums of squares of each kind have
exactly known distributions. Views noisier than the others are found by their own repeats and by
their residuals.

A view is read line by line. If the plate slips on the way, the rest of the view has another
misalignment. For each view and each line the gain of a second misalignment is tested: the sum of
squares that it explains, from the projection of its three columns on the residuals.

A turned microscope, a drift or a plate that grew leaves residuals that a second misalignment
removes in part. Before a view is split, its slip therefore competes with every term that the model
does not hold.
"""

from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from scipy.special import chdtri, fdtrc, gammaincinv

from selfcal_ros.errors import InputError, NotIdentifiableError
from selfcal_ros.estimation.joint.problem import FLOOR, JointFit, Problem, fit
from selfcal_ros.estimation.joint.solve import fit_joint, prepare
from selfcal_ros.estimation.multifrontal.factor import one_thread
from selfcal_ros.estimation.normal.equations import (
    Memo,
    NormalEquations,
    angular_residuals,
    grid_residuals,
)
from selfcal_ros.estimation.options import Options
from selfcal_ros.estimation.verdict.causes import (
    SLIP,
    PlacedSlip,
    cause_of,
    find_explanations,
    noisier_views,
)
from selfcal_ros.estimation.verdict.leverage import (
    CHECKED,
    EXACT_SITES,
    angular_redundancy,
    drawn_redundancy,
    exact_leverage,
    noise_of,
)
from selfcal_ros.model.error_map import ThetaDatum
from selfcal_ros.model.readings import Key, Measurements, ViewReadings, left_out, without
from selfcal_ros.model.terms import ModelTerm
from selfcal_ros.model.verdict import Cause, Finding

VIEW_DRAWS = 16
"""Draws of unit noise in each view, to separate the noises of the views."""


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residuals of all readings.

    Attributes
    ----------
    problem : Problem
        The plan and its readings.
    found : JointFit
        Joint fit of the readings.
    redundancy, redundancy_theta : float array (views, nx, ny), (views, K)
        1 - h; 0 where not read.
    skew : complex array (views, nx, ny)
        Difference of h between the coordinates, see above.
    """

    problem: Problem
    found: JointFit
    redundancy: np.ndarray
    redundancy_theta: np.ndarray
    skew: np.ndarray

    @property
    def squares(self) -> np.ndarray:
        """Residual' (1 - h)^-1 residual weight, m^2, (views, nx, ny): 2 sigma^2 on average.

        Reduction of the sum of squares without the reading; NaN where it cannot be checked.
        """
        residual, skew = self.found.residuals, abs(self.skew)
        good = self.redundancy - skew > CHECKED
        both = np.where(good, self.redundancy**2 - skew**2, 1.0)
        form = (self.redundancy * abs(residual) ** 2
                + np.real(np.conj(self.skew) * residual**2))
        return np.where(good, form / both * self.problem.grid.weight, np.nan)

    @property
    def squares_theta(self) -> np.ndarray:
        """The same for angular readings, rad^2, (views, K); sigma^2 on average."""
        return _scaled(self.found.residuals_theta**2, self.problem.angular.weight,
                       self.redundancy_theta)

    def p_outlier(self, kind: str, at: tuple[int, ...]) -> float:
        """Return the probability that a good reading fits the others as badly; NaN if unknown.

        F-test of the reading's contribution to the sum of squares against the remainder.
        """
        if kind == "grid":
            system, squares, weight, residual, columns = (
                self.problem.system, self.squares, self.problem.grid.weight,
                abs(self.found.residuals), 2)
            dof = 2 * system.grid.n_readings - system.rank_grid
        else:
            system, squares, weight, residual, columns = (
                self.problem.system, self.squares_theta, self.problem.angular.weight,
                self.found.residuals_theta, 1)
            dof = system.angular.n_readings - system.rank_angular
        rest = float((weight * residual**2).sum()) - float(squares[at])
        if not np.isfinite(rest) or dof <= columns:
            return float("nan")
        noise = max(rest / (dof - columns), FLOOR**2)
        return float(fdtrc(columns, dof - columns, squares[at] / columns / noise))


def _scaled(squares: np.ndarray, weight: np.ndarray, redundancy: np.ndarray) -> np.ndarray:
    good = redundancy > CHECKED
    return np.where(good, squares * weight / np.where(good, redundancy, 1.0), np.nan)


def residuals_of(measurements: Measurements, options: Options) -> Residuals:
    """Fit the readings jointly and return their residuals with redundancies."""
    problem, _ = prepare(measurements, options)
    system = problem.system
    found = replace(fit(problem, problem.grid.y), residuals=grid_residuals(system, problem.grid.y),
                    residuals_theta=angular_residuals(system, problem.angular.y))
    if system.grid.n_sites <= EXACT_SITES and measurements.artifact.map_grid is None:
        redundancy, skew = exact_leverage(system)
    else:
        redundancy = drawn_redundancy(system)
        skew = np.zeros(redundancy.shape, dtype=complex)
    return Residuals(problem, found, redundancy, angular_redundancy(system), skew)


def view_noise(residuals: Residuals) -> np.ndarray:
    """Return the noise of each grid view and of the others, m, and its degrees of freedom.

    The residuals of one view contain the noise of all. Their sums of squares are separated with
    those that seeded unit noise of each view leaves in each (Helmert's variance components, two at
    a time). Twice the inverse of that mixing is the covariance of two variances that are 1.

    Returns
    -------
    float array (views, 3)
    """
    from scipy.optimize import nnls  # a tenth of a second, for this alone

    system, grid = residuals.problem.system, residuals.problem.system.grid
    mixing = _mixings.get(system, None, lambda: _mixing(system))
    sums = (abs(residuals.found.residuals) ** 2 * grid.weight).sum(axis=(1, 2))
    out = np.empty((grid.n_views, 3))
    for v in range(grid.n_views):
        group = np.zeros((grid.n_views, 2))
        group[:, 1], group[v] = 1.0, (1.0, 0.0)
        normal = group.T @ mixing @ group
        out[v, :2] = np.sqrt(nnls(normal, group.T @ sums)[0])
        out[v, 2] = normal[0, 0] - normal[0, 1] ** 2 / max(normal[1, 1], 1e-300)
    return out


_mixings: Memo[None, np.ndarray] = Memo()


def _mixing(system: NormalEquations) -> np.ndarray:
    """Return the sum of squares that unit noise of each view leaves in each, (views, views)."""
    grid, rng = system.grid, np.random.default_rng(0)
    mixing = np.zeros((grid.n_views, grid.n_views))
    for u in range(grid.n_views):
        for _ in range(VIEW_DRAWS):
            noise = np.zeros(grid.weight.shape, dtype=complex)
            noise[u] = noise_of(rng, noise[u].shape, grid.weight[u])
            rest = grid_residuals(system, noise)
            mixing[:, u] += (abs(rest) ** 2 * grid.weight).sum(axis=(1, 2)) / VIEW_DRAWS
    return (mixing + mixing.T) / 2


NOISY_RESIDUALS = 3.0
"""Ratio of a view's noise to that of the others, by residuals, above which it is noisy."""

MIN_VIEW_DOF = 5.0
"""Smallest degrees of freedom of a view's own noise for the test by residuals."""

MAX_RATIO = 20.0
"""Largest ratio of noises that residuals can show: a noisy view hides the noise of the others."""


def noisy_views(residuals: Residuals, measurements: Measurements
                ) -> tuple[tuple[str, float], ...]:
    """Return the noisy views, each with the ratio of its noise to that of the others."""
    found = by_repeats(measurements)
    for name, ratio in _by_residuals(residuals, measurements).items():
        found[name] = max(ratio, found.get(name, 0.0))
    return tuple((view.view.name, found[view.view.name]) for view in measurements.views
                 if view.view.name in found)


def by_repeats(measurements: Measurements) -> dict[str, float]:
    """Return the views whose repeats scatter more than those of the others (F-test)."""
    return {cause.view: cause.size for cause in noisier_views([
        (v.view.name, v.sigma_xy, v.dof_xy) for v in measurements.views
        if len(v.m) and v.dof_xy > 0 and np.isfinite(v.sigma_xy)])}


def _by_residuals(residuals: Residuals, measurements: Measurements) -> dict[str, float]:
    if residuals.problem.system.grid.n_views < 2:
        return {}
    out = {}
    for index, (own, others, dof) in zip(residuals.problem.grid.index, view_noise(residuals),
                                         strict=True):
        ratio = float(own / max(others, own / MAX_RATIO, FLOOR))
        if ratio > NOISY_RESIDUALS and dof >= MIN_VIEW_DOF:
            out[measurements.views[index].view.name] = ratio
    return out


AMBIGUOUS = 16.0
"""Difference of chi^2 up to which two places explain the readings equally well."""

TRIED = 12
"""Number of places at which the view is split on trial."""

TINY_M2 = 1e-30
"""Square of a noise that is rounding error."""

SLIP_LEVEL = 1e-9
"""Level of the test of each place where the plate may have slipped."""

MAX_PLACES = 20
"""Largest number of places tested along each axis of a view."""

CLIP = 4.0
"""Standard deviations to which residuals are clipped: one outlier is not a slip."""


@dataclass(frozen=True)
class SlipPlace:
    """Where in a view the plate may have slipped.

    Attributes
    ----------
    view : str
        Name of the view.
    index : int
        Its position in the measurement.
    axis : str
        ``m`` or ``n``: index of the marks along which the view was read.
    first : int
        First value of that index after the slip.
    chi2 : float
        Explained sum of squares over the noise variance; 3 on average without a slip.
    """

    view: str
    index: int
    axis: str
    first: int
    chi2: float

    @property
    def place(self) -> dict[str, str | int]:
        """View, axis and first line of marks after the slip."""
        return {"view": self.view, "axis": self.axis, "first": self.first}


@dataclass(frozen=True)
class Slip(SlipPlace):
    """A slip of the plate within a view, at a place.

    Attributes
    ----------
    tx_m, ty_m, phi_rad : float
        Change of offset and rotation, stage frame.
    alternatives : tuple of SlipPlace
        Other places that explain the readings equally well: few views do not always determine it.
    """

    tx_m: float
    ty_m: float
    phi_rad: float
    alternatives: tuple[SlipPlace, ...] = ()

    def finding(self, *, spoils: bool) -> Finding:
        """Return the slip as a finding; `spoils` if the view had to be kept unsplit."""
        return Finding(
            "slip_found", float(np.hypot(self.tx_m, self.ty_m)), unit="m", view=self.view, details={
                "places": [place.place for place in (self, *self.alternatives)], "x": self.tx_m,
                "y": self.ty_m, "phi": self.phi_rad, "spoils": spoils})


def find_slip(residuals: Residuals, sigma_m: float, measurements: Measurements,
              options: Options) -> Slip | None:
    """Return the slip that explains the residuals best; None if no place passes the test.

    The view is split on trial at the places that explain most; the best split is the slip.

    Parameters
    ----------
    residuals : Residuals
        Residuals of the fit.
    sigma_m : float
        Noise of one reading, m.
    measurements, options : Measurements, Options
        The readings and how they were fitted.
    """
    grid = residuals.problem.system.grid
    found: list[SlipPlace] = []
    limit = CLIP * sigma_m / np.sqrt(np.where(grid.read, grid.weight, 1.0))
    size = abs(residuals.found.residuals)
    clipped = residuals.found.residuals * np.minimum(1.0, limit / np.maximum(size, 1e-300))
    for v, i in enumerate(residuals.problem.grid.index):
        for axis in (0, 1) if measurements.artifact.marks is None else ():
            for place in _places(grid.read[v], axis):
                gain = _explained(residuals, clipped, v, axis, place)
                if gain is not None and gain / sigma_m**2 >= chdtri(3, SLIP_LEVEL):
                    found.append(SlipPlace(measurements.views[i].view.name, i, "mn"[axis],
                                           grid.views.mark_at(place, place)[axis],
                                           gain / sigma_m**2))
    found.sort(key=lambda slip: -slip.chi2)
    return _best(found[:TRIED], measurements, options)


def _best(found: list[SlipPlace], measurements: Measurements, options: Options) -> Slip | None:
    """Return the slip whose split leaves the smallest clipped sum of squares."""
    fits = []
    for slip in found:
        try:
            problem, _ = prepare(split_view(measurements, slip), options)
        except NotIdentifiableError:
            continue
        fitted = fit(problem, problem.grid.y)
        weight = problem.grid.weight
        squares = (abs(fitted.residuals) ** 2 * weight)[weight > 0]
        fits.append((slip, squares, _size(slip, fitted, problem)))
    if not fits:
        return None
    limit = CLIP**2 * max(min(float(np.median(squares)) for _, squares, _ in fits), TINY_M2)
    losses = [float(np.minimum(squares, limit).sum()) for _, squares, _ in fits]
    order = np.argsort(losses, kind="stable")
    slip, squares, size = fits[order[0]]
    # the loss counts residuals, which are smaller than the noise by the part that the fit follows
    system = prepare(split_view(measurements, slip), options)[0].system
    dof_part = 1 - system.rank_grid / (2 * system.grid.n_readings)
    near = losses[order[0]] + AMBIGUOUS * float(np.median(squares)) / chdtri(2, 0.5) / dof_part
    others = tuple(fits[i][0] for i in order[1:] if losses[i] < near)
    tx_m, ty_m, phi_rad = size
    return Slip(slip.view, slip.index, slip.axis, slip.first, slip.chi2, tx_m, ty_m, phi_rad,
                others)


def _size(slip: SlipPlace, fitted: JointFit, problem: Problem) -> tuple[float, float, float]:
    """Return offset and rotation of the second placement minus those of the first."""
    row = problem.grid.index.index(slip.index)
    before, after = fitted.parameters[:3 * problem.system.grid.n_views].reshape(-1, 3)[row:row + 2]
    phi, re, im = after - before
    t = problem.grid.poses[row].phase * complex(re, im)
    return float(t.real), float(t.imag), float(phi / problem.half_width_m)


def _places(read: np.ndarray, axis: int) -> np.ndarray:
    """Return the lines before which a slip is tested: at least one line was read on either side."""
    lines = np.flatnonzero(read.any(axis=1 - axis))
    inner = lines[1:]
    if len(inner) <= MAX_PLACES:
        return inner
    return inner[np.linspace(0, len(inner) - 1, MAX_PLACES).round().astype(int)]


def _explained(residuals: Residuals, clipped: np.ndarray, v: int, axis: int,
               place: int) -> float | None:
    """Return the sum of squares that a slip explains, m^2; None where it cannot be tested."""
    system = residuals.problem.system
    grid = system.grid
    after = grid.read[v].copy()
    after[(slice(0, place), slice(None))[::1 - 2 * axis]] = False
    if after.sum() < 3 or (grid.read[v] & ~after).sum() < 3:
        return None
    columns = np.zeros((3, *grid.weight.shape), dtype=complex)
    columns[0, v], columns[1, v], columns[2, v] = (
        shape * after for shape in (1j * grid.views.z, np.ones_like(grid.views.z),
                                    np.full_like(grid.views.z, 1j)))
    projected = np.array([grid_residuals(system, column) for column in columns])
    normal = np.einsum("avij,bvij,vij->ab", np.conj(projected), projected, grid.weight).real
    if np.linalg.matrix_rank(normal, tol=1e-9 * max(np.trace(normal), 1e-300)) < 3:
        return None
    right = np.einsum("avij,vij,vij->a", np.conj(projected), clipped, grid.weight).real
    return float(right @ np.linalg.solve(normal, right))


def split_view(measurements: Measurements, slip: SlipPlace) -> Measurements:
    """Return the measurement with the view as two placements, before and after the slip.

    Its angular lines become a third placement: the time of their reading is unknown.
    """
    view = measurements.views[slip.index]
    after = getattr(view, slip.axis) >= slip.first
    parts = [_grid_part(view, ~after, ""), _grid_part(view, after, " after slip")]
    if len(view.k):
        lines = replace(view.view, name=view.view.name + " lines", grid=False)
        parts.append(replace(ViewReadings(lines), k=view.k, dtheta=view.dtheta,
                             count_theta=view.count_theta, u_theta=view.u_theta,
                             sigma_theta=view.sigma_theta, dof_theta=view.dof_theta))
    views = (*measurements.views[:slip.index], *parts, *measurements.views[slip.index + 1:])
    return replace(measurements, views=views)


def _grid_part(view: ViewReadings, keep: np.ndarray, suffix: str) -> ViewReadings:
    named = replace(view.view, name=view.view.name + suffix, angular=False)
    used = int(view.count[keep].sum())
    return ViewReadings(named, view.m[keep], view.n[keep], view.dx[keep], view.dy[keep],
                        view.count[keep], view.u[keep] if len(view.u) else view.u,
                        sigma_xy=view.sigma_xy, dof_xy=int(view.dof_xy * keep.mean()), used=used,
                        rejected={} if suffix else view.rejected,
                        visits=None if view.visits is None else view.visits.of_marks(keep))


def likelier_term(measurements: Measurements, options: Options, slip: Slip) -> Cause | None:
    """Return the term that explains the residuals better than a slip; None if the slip does.

    Raises
    ------
    NotIdentifiableError, InputError
        As `selfcal_ros.estimation.api.calibrate`.
    """
    model = fit_joint(measurements, options)
    problem, axis = model.problem, "mn".index(slip.axis)
    row, shape = problem.grid.index.index(slip.index), problem.ground.z.shape
    after = np.indices(shape)[axis] - shape[axis] // 2 >= slip.first
    found = find_explanations(model, slips=True, readings=False, placed=PlacedSlip(
        row, after & (problem.ground.weight[row] > 0), 2 * MAX_PLACES))
    if not found or found[0].name == SLIP:
        return None
    return cause_of(found[0], problem.ground)


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
