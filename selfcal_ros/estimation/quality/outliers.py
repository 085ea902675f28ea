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

import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace

import numpy as np
from scipy.special import chdtri

from selfcal_ros.errors import InputError, NotIdentifiableError
from selfcal_ros.estimation.checks.wiring import BEYOND_DOUBT, MAX_REMOVED
from selfcal_ros.estimation.joint.problem import Problem
from selfcal_ros.estimation.joint.solve import fit_joint, prepare
from selfcal_ros.estimation.multifrontal.factor import one_thread
from selfcal_ros.estimation.normal.angular import FLOOR, MAX_FULL, MAX_STEPS
from selfcal_ros.estimation.normal.equations import (
    TRACE,
    NormalEquations,
    grid_residuals,
    noise_of,
)
from selfcal_ros.estimation.options import Options
from selfcal_ros.estimation.verdict.causes import (
    MAX_CAUSES,
    PLACES,
    SLIP,
    PlacedSlip,
    cause_of,
    find_explanations,
    noisier_views,
    scatter_of_views,
)
from selfcal_ros.estimation.verdict.leverage import (
    FEW_DRAWS,
    FEW_OUTLIERS,
    FitOfKind,
    lines_alone,
    marks_alone,
)
from selfcal_ros.model.error_map import ThetaDatum
from selfcal_ros.model.findings import (
    Cause,
    Finding,
    NoisyView,
    OutlierRemoved,
    OutliersGivenUp,
    OutliersKept,
    OutliersRemoved,
    SlipsGivenUp,
    TakenForSlip,
    TooManyOutliers,
)
from selfcal_ros.model.parts import (
    Outliers,
    Parts,
    Removed,
    Slip,
    SlipPlace,
    ViewNoise,
)
from selfcal_ros.model.readings import (
    AFTER_SLIP,
    Key,
    Measurements,
    ViewReadings,
    left_out,
    subset,
    without,
)
from selfcal_ros.model.terms import ModelTerm


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residuals of all readings: the problem that they pose, marks and lines by themselves."""

    problem: Problem
    marks: FitOfKind
    lines: FitOfKind

    @property
    def level(self) -> float:
        """Level of the test of one reading, so that all checked ones have OUTLIER_LEVEL."""
        checked = sum(
            np.isfinite(kind.squares).sum() for kind in (self.marks, self.lines)
        )
        return OUTLIER_LEVEL / max(checked, 1)


def residuals_of(measurements: Measurements, options: Options) -> Residuals:
    """Fit marks and lines, each by themselves, and return their residuals."""
    problem, _ = prepare(measurements, options)
    exact = measurements.artifact.map_grid is None and (
        problem.system.grid.n_sites <= MAX_FULL
    )
    return Residuals(
        problem,
        marks_alone(problem.system, problem.grid.y, exact=exact),
        lines_alone(problem.system, problem.angular.y),
    )


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

    system = residuals.problem.system
    grid = residuals.problem.system.grid
    mixing = _mixing(system)
    sums = (abs(residuals.marks.residual) ** 2 * grid.weight).sum(axis=(1, 2))
    out = np.empty((grid.n_views, 3))
    for v in range(grid.n_views):
        group = np.zeros((grid.n_views, 2))
        group[:, 1], group[v] = 1.0, (1.0, 0.0)
        normal = group.T @ mixing @ group
        out[v, :2] = np.sqrt(nnls(normal, group.T @ sums)[0])
        out[v, 2] = normal[0, 0] - normal[0, 1] ** 2 / max(normal[1, 1], 1e-300)
    return out


def _mixing(system: NormalEquations) -> np.ndarray:
    """Return the sum of squares that unit noise of each view leaves in each, (views, views)."""
    grid = system.grid
    rng = np.random.default_rng(0)
    mixing = np.zeros((grid.n_views, grid.n_views))
    for u in range(grid.n_views):
        for _ in range(FEW_DRAWS):
            noise = np.zeros(grid.weight.shape, dtype=complex)
            noise[u] = noise_of(rng, noise[u].shape, grid.weight[u])
            residuals = grid_residuals(system, noise)
            mixing[:, u] += (abs(residuals) ** 2 * grid.weight).sum(
                axis=(1, 2)
            ) / FEW_DRAWS
    return (mixing + mixing.T) / 2


NOISY_RESIDUALS = 3.0
"""Ratio of a view's noise to that of the others, by residuals, above which it is noisy."""

MIN_VIEW_DOF = 5.0
"""Smallest degrees of freedom of a view's own noise for the test by residuals."""

MAX_RATIO = 20.0
"""Largest ratio of noises that residuals can show: a noisy view hides the noise of the others."""


def noisy_views(
    residuals: Residuals, measurements: Measurements
) -> tuple[ViewNoise, ...]:
    """Return the noisy views, each with the ratio of its noise to that of the others.

    By their own repeats, and by residuals.
    """
    ratios = {
        cause.view: cause.size
        for cause in noisier_views(scatter_of_views(measurements))
    }
    names = [
        measurements.views[index].view.name for index in residuals.problem.grid.index
    ]
    for name, (own_noise, noise_of_others, dof) in zip(
        names, view_noise(residuals), strict=True
    ):
        ratio = float(own_noise / max(noise_of_others, own_noise / MAX_RATIO, FLOOR))
        if ratio > NOISY_RESIDUALS and dof >= MIN_VIEW_DOF:
            ratios[name] = max(ratio, ratios.get(name, 0.0))
    return tuple(ViewNoise(name, ratios[name]) for name in names if name in ratios)


MAX_PLACES = 20
"""Largest number of places tested along each axis of a view."""

CLIP = 4.0
"""Standard deviations to which residuals are clipped: one outlier is not a slip."""

AMBIGUOUS = CLIP**2
"""Difference of chi^2 up to which two places explain the readings equally well: one outlier."""


def find_slip(
    residuals: Residuals, sigma_m: float, measurements: Measurements
) -> Slip | None:
    """Return the slip that explains the residuals best; None if no place passes the test.

    Of the places that explain most of the clipped residuals, the one where a second misalignment
    leaves the smallest clipped sum of squares.

    Parameters
    ----------
    residuals : Residuals
        Residuals of the fit.
    sigma_m : float
        Noise of one reading, m.
    measurements : Measurements
        The readings, for the names of the views.
    """
    problem, marks = residuals.problem, residuals.marks
    limit = CLIP * sigma_m / np.sqrt(np.where(marks.weight > 0, marks.weight, 1.0))
    clipped = marks.residual * np.minimum(
        1.0, limit / np.maximum(abs(marks.residual), 1e-300)
    )
    gains = [
        (_second_misalignment(problem, place, clipped)[1], place)
        for place in _places(problem, measurements)
    ]
    sizes, squares_left, places = [], [], []
    for gain, place in sorted(gains, key=lambda tried: -tried[0])[:PLACES]:
        if gain >= sigma_m**2 * chdtri(3, BEYOND_DOUBT / len(gains)):
            size, _ = _second_misalignment(problem, place, marks.residual)
            after = grid_residuals(problem.system, _slipped(problem, place, size))
            places.append(replace(place, chi2=gain / sigma_m**2))
            sizes.append(size)
            squares_left.append(
                (abs(marks.residual - after) ** 2 * marks.weight)[marks.weight > 0]
            )
    if not places:
        return None
    # residuals are smaller than the noise by the part that the fit follows
    dof_part = (marks.dof - 3) / (2 * len(squares_left[0]))
    variance = np.maximum(
        np.median(squares_left, axis=1) / chdtri(2, 0.5) / dof_part, FLOOR**2
    )
    losses = np.minimum(squares_left, CLIP**2 * variance.min()).sum(axis=1)
    order = np.argsort(losses, kind="stable")
    best, (phi, x, y) = places[order[0]], sizes[order[0]]
    shift = (
        complex(x, y) * problem.grid.poses[problem.grid.index.index(best.index)].phase
    )
    near = losses < losses.min() + AMBIGUOUS * variance[order[0]]
    return Slip(
        **asdict(best),
        tx_m=shift.real,
        ty_m=shift.imag,
        phi_rad=float(phi) / problem.half_width_m,
        alternatives=tuple(places[at] for at in order[1:] if near[at]),
    )


def _places(problem: Problem, measurements: Measurements) -> Iterator[SlipPlace]:
    """Yield the lines of marks before which a slip is tested: three readings on either side."""
    for row, index in enumerate(problem.grid.index):
        read = problem.grid.weight[row] > 0
        for axis in (0, 1) if measurements.artifact.marks is None else ():
            lines = np.flatnonzero(read.any(axis=1 - axis))[1:] - read.shape[axis] // 2
            for at in np.linspace(
                0, len(lines) - 1, min(len(lines), MAX_PLACES)
            ).round():
                place = SlipPlace(
                    measurements.views[index].view.name,
                    index,
                    "mn"[axis],
                    int(lines[int(at)]),
                )
                if 3 <= after_slip(problem, place).sum() <= read.sum() - 3:
                    yield place


def after_slip(problem: Problem, place: SlipPlace) -> np.ndarray:
    """Return the marks of the view that were read after a slip, bool (nx, ny)."""
    read = problem.grid.weight[problem.grid.index.index(place.index)] > 0
    axis = "mn".index(place.axis)
    return read & (np.indices(read.shape)[axis] - read.shape[axis] // 2 >= place.first)


def _slipped(problem: Problem, place: SlipPlace, size: np.ndarray) -> np.ndarray:
    """Return what a slip by phi and offset (3,), as in `JointFit`, makes of the readings, m."""
    phi, x, y = size
    out = np.zeros(problem.grid.weight.shape, dtype=complex)
    z = problem.system.grid.views.z
    out[problem.grid.index.index(place.index)] = after_slip(problem, place) * (
        1j * phi * z + complex(x, y)
    )
    return out


def _second_misalignment(
    problem: Problem, place: SlipPlace, residual: np.ndarray
) -> tuple[np.ndarray, float]:
    """Return the misalignment after a slip less that before, (3,), and the squares it explains.

    By the projection of its three columns on the residuals (views, nx, ny); 0 where the readings
    do not determine it.
    """
    columns = [
        grid_residuals(problem.system, _slipped(problem, place, unit))
        for unit in np.eye(3)
    ]
    weighted = np.conj(columns) * problem.grid.weight
    normal = np.tensordot(weighted, columns, axes=([1, 2, 3], [1, 2, 3])).real
    if np.linalg.matrix_rank(normal, tol=1e-9 * max(np.trace(normal), 1e-300)) < 3:
        return np.zeros(3), 0.0
    right = np.tensordot(weighted, residual, axes=3).real
    fitted = np.linalg.solve(normal, right)
    return fitted, float(right @ fitted)


def split_view(measurements: Measurements, slip: SlipPlace) -> Measurements:
    """Return the measurement with the view as two placements, before and after the slip.

    Its angular lines become a third placement: the time of their reading is unknown.
    """
    view = measurements.views[slip.index]
    after = getattr(view, slip.axis) >= slip.first
    placements = [
        _placement_of(view, ~after, ""),
        _placement_of(view, after, AFTER_SLIP),
    ]
    if len(view.k):
        placements.append(
            _placement_of(view, np.zeros(len(view.m), dtype=bool), " lines")
        )
    views = (
        *measurements.views[: slip.index],
        *placements,
        *measurements.views[slip.index + 1 :],
    )
    return replace(measurements, views=views)


def _placement_of(view: ViewReadings, marks: np.ndarray, suffix: str) -> ViewReadings:
    """Return some marks of a view, or its lines if there are none, as a placement of their own."""
    lines = not marks.any()
    named = replace(
        view.view, name=view.view.name + suffix, grid=not lines, angular=lines
    )
    return replace(
        subset(view, marks, np.full(len(view.k), lines)),
        view=named,
        dof_xy=int(view.dof_xy * marks.mean()),
        dof_theta=view.dof_theta * lines,
        used=int(view.count[marks].sum()),
        rejected={} if suffix else view.rejected,
        motion=None,
        motion_theta=None,
    )


def likelier_term(
    measurements: Measurements, options: Options, slip: Slip
) -> Cause | None:
    """Return the term that explains the residuals better than a slip; None if the slip does.

    Raises
    ------
    NotIdentifiableError, InputError
        As `selfcal_ros.estimation.api.calibrate`.
    """
    model = fit_joint(measurements, options)
    row = model.problem.grid.index.index(slip.index)
    explanations = find_explanations(
        model,
        slips=True,
        readings=False,
        placed=PlacedSlip(row, after_slip(model.problem, slip), 2 * MAX_PLACES),
    )
    if not explanations or explanations[0].name == SLIP:
        return None
    return cause_of(explanations[0], model.problem.inputs)


OUTLIER_LEVEL = 0.01
"""Probability that a measurement without outliers loses a reading."""

NEAR_LARGEST = 0.5
"""Share of the largest ratio above which a reading is removed in the same round: an outlier
increases the residuals of its neighbours."""

LEFT = (
    NoisyView,
    TooManyOutliers,
    OutliersKept,
    OutliersGivenUp,
    SlipsGivenUp,
)
"""Findings of faults that could not be corrected."""


@dataclass(frozen=True, eq=False)
class OutlierScreening:
    """A measurement without its outliers, and the findings."""

    measurements: Measurements
    removed: tuple[Removed, ...]
    slips: tuple[Slip, ...]
    noisy: tuple[ViewNoise, ...]
    unchecked: int
    findings: tuple[Finding, ...]

    def with_tables(self, parts: Parts) -> Parts:
        """Return parts of a result with the tables of outliers, slips and noisy views."""
        rule = (
            "removed if its squared standardised residual fails an F-test at level "
            f"{OUTLIER_LEVEL}/n, for marks and lines together"
        )
        return replace(
            parts,
            outliers=Outliers(rule, self.unchecked, self.removed),
            slips=self.slips,
            noisy_views=self.noisy,
        )


@one_thread()
def clean(measurements: Measurements, options: Options) -> OutlierScreening:
    """Return the measurement split at slips and without outliers, and the findings."""
    # a pure datum: the redundant axis conditions of xy_axes would show in the angular residuals
    linear = replace(
        options,
        misalignment_model="linear",
        reference=None,
        terms=(),
        assumed=(),
        datum_theta=ThetaDatum.ZERO_MEAN,
    )
    screened = _without_slips(measurements, options, linear)
    outliers, residuals, stopped = _reject(
        screened.flattened, linear, screened.residuals
    )
    removed = tuple(
        sorted(outliers.values(), key=lambda item: (item.kind, item.view, item.mark))
    )
    noisy = noisy_views(residuals, screened.measurements)
    findings = [*screened.notes, *_findings(removed, noisy, stopped)]
    unchecked = int(
        (np.isnan(residuals.marks.squares) & (residuals.marks.weight > 0)).sum()
    )
    return OutlierScreening(
        measurements=without(screened.measurements, outliers, mark=True),
        removed=removed,
        slips=screened.slips,
        noisy=noisy,
        unchecked=unchecked,
        findings=tuple(findings),
    )


@dataclass(frozen=True, eq=False)
class _Screened:
    """Readings split at slips, the same minus terms of the model, and the findings."""

    measurements: Measurements
    flattened: Measurements
    residuals: Residuals
    slips: tuple[Slip, ...] = ()
    notes: tuple[Finding, ...] = ()


def _without_slips(
    measurements: Measurements, options: Options, linear: Options
) -> _Screened:
    """Return the readings split at slips, minus terms that explain them better than a slip."""
    flattened = _flattened(measurements, options)
    screened = _Screened(measurements, flattened, residuals_of(flattened, linear))
    for _ in range(2 * MAX_CAUSES + 1):
        slip = find_slip(
            screened.residuals,
            robust_sigma(screened.residuals.marks),
            screened.flattened,
        )
        if slip is None:
            return screened
        if len(screened.slips) == MAX_CAUSES:
            break
        cause = likelier_term(screened.measurements, options, slip)
        if cause is None:
            screened, could_split = _split(screened, slip, linear)
            if not could_split:
                return screened
            continue
        screened = replace(
            screened,
            notes=(
                *screened.notes,
                TakenForSlip(
                    size=cause.size,
                    u=cause.u,
                    unit=cause.unit,
                    p=cause.p,
                    view=cause.view,
                    axis=cause.axis,
                    mark=cause.mark,
                    cause=cause.name,
                    slip_in=slip.view,
                    told=cause.told,
                    of_cause=cause.details,
                ),
            ),
        )
        options = replace(options, terms=(*options.terms, ModelTerm(cause.name)))
        try:
            flattened = _flattened(screened.measurements, options)
        except (NotIdentifiableError, InputError):
            return screened
        screened = replace(
            screened, flattened=flattened, residuals=residuals_of(flattened, linear)
        )
    return replace(
        screened, notes=(*screened.notes, SlipsGivenUp(slips=len(screened.slips)))
    )


def _split(at: _Screened, slip: Slip, linear: Options) -> tuple[_Screened, bool]:
    """Return the readings split at a slip, or without its view, and whether that was possible."""

    def split(readings: Measurements) -> Measurements:
        return (
            left_out(readings, slip.index)
            if slip.alternatives
            else split_view(readings, slip)
        )

    flattened = split(at.flattened)
    try:
        residuals = residuals_of(flattened, linear)
    except NotIdentifiableError:
        return replace(
            at, slips=(*at.slips, slip), notes=(*at.notes, slip.finding(spoils=True))
        ), False
    return _Screened(
        split(at.measurements),
        flattened,
        residuals,
        (*at.slips, slip),
        (*at.notes, slip.finding(spoils=False)),
    ), True


def robust_sigma(readings: FitOfKind) -> float:
    """Return the noise from the median of standardised squares, at least FLOOR."""
    squares = readings.squares[np.isfinite(readings.squares)]
    if not len(squares):
        return FLOOR
    return max(
        float(np.sqrt(np.median(squares) / chdtri(readings.coordinates, 0.5))), FLOOR
    )


def _reject(
    measurements: Measurements, options: Options, residuals: Residuals
) -> tuple[dict[Key, Removed], Residuals, Finding | None]:
    """Remove outliers round by round; return them, the last residuals, and why it stopped early."""
    outliers: dict[Key, Removed] = {}
    stopped: Finding | None = OutliersGivenUp(rounds=MAX_STEPS)
    n_readings = sum(len(view.m) + len(view.k) for view in measurements.views)
    for _ in range(MAX_STEPS):
        worst = _worst(residuals, measurements)
        if not worst:
            stopped = None
            break
        if len(outliers) + len(worst) > MAX_REMOVED * n_readings:
            return (
                {},
                residuals_of(measurements, options),
                TooManyOutliers(limit=MAX_REMOVED),
            )
        try:
            residuals = residuals_of(without(measurements, outliers | worst), options)
        except NotIdentifiableError:
            return outliers, residuals, OutliersKept()
        outliers |= worst
    return (*_restored(measurements, options, outliers, residuals), stopped)


def _worst(residuals: Residuals, measurements: Measurements) -> dict[Key, Removed]:
    """Return the outliers of one round: the largest, one for each mark and site, and one line."""
    problem = residuals.problem
    sites = problem.system.grid.views.site_index
    outliers: dict[Key, Removed] = {}
    for readings, of_views in (
        (residuals.marks, problem.grid),
        (residuals.lines, problem.angular),
    ):
        ratio = np.nan_to_num(readings.squares, nan=0.0) / robust_sigma(readings) ** 2
        # by rounded ratios, so that equal ones keep the order of the readings
        order = np.argsort(-np.round(ratio.ravel(), 6), kind="stable")
        floor = max(
            chdtri(readings.coordinates, residuals.level),
            NEAR_LARGEST * float(ratio.max(initial=0.0)),
        )
        largest_of_node: dict[object, float] = {}
        for number in order[: int((ratio > floor).sum())]:
            at = tuple(int(i) for i in np.unravel_index(number, ratio.shape))
            grid = readings.kind == "grid"
            nodes = (("mark", at[1:]), ("site", int(sites[at]))) if grid else ("lines",)
            above = max(
                (largest_of_node[node] for node in nodes if node in largest_of_node),
                default=0.0,
            )
            if above > (1 + TRACE) * ratio[at]:
                continue
            largest_of_node |= {
                node: float(ratio[at]) for node in nodes if node not in largest_of_node
            }
            index = of_views.index[at[0]]
            mark = problem.system.grid.views.mark_at(*at[1:]) if grid else at[1:]
            residual = float(abs(readings.residual[at]))
            outliers[index, readings.kind, mark] = Removed(
                view=measurements.views[index].view.name,
                kind=readings.kind,
                mark=mark,
                standardised=float(np.sqrt(ratio[at])),
                leverage=float(1 - readings.redundancy[at]),
                residual_m=residual if grid else math.nan,
                residual_rad=math.nan if grid else residual,
            )
    return outliers


def _restored(
    measurements: Measurements,
    options: Options,
    outliers: dict[Key, Removed],
    residuals: Residuals,
) -> tuple[dict[Key, Removed], Residuals]:
    """Restore readings, one by one, that agree with the good ones.

    Readings that were removed together, each the only check of the other, are restored together.
    """
    for key in sorted(outliers, key=lambda k: outliers[k].standardised):
        if key not in outliers:
            continue
        mates = {
            k
            for k in outliers
            if k[1] == key[1]
            and abs(outliers[k].standardised - outliers[key].standardised)
            <= TRACE * outliers[key].standardised
        }
        for restored in dict.fromkeys((frozenset([key]), frozenset(mates))):
            still_out = {k: v for k, v in outliers.items() if k not in restored}
            residuals_without = residuals_of(without(measurements, still_out), options)
            if all(
                _agrees(residuals_without, restored_key) for restored_key in restored
            ):
                outliers, residuals = still_out, residuals_without
                break
    return outliers, residuals


def _agrees(residuals: Residuals, key: Key) -> bool:
    """Return whether a reading can be checked against the others, and agrees with them."""
    index, kind, mark = key
    problem = residuals.problem
    # NaN: a reading that cannot be checked does not agree
    if kind == "grid":
        at = (
            problem.grid.index.index(index),
            *problem.system.grid.views.index_of(*mark),
        )
        return residuals.marks.p_outlier(at) >= residuals.level
    return (
        residuals.lines.p_outlier((problem.angular.index.index(index), *mark))
        >= residuals.level
    )


def _findings(
    removed: tuple[Removed, ...],
    noisy: tuple[ViewNoise, ...],
    stopped: Finding | None,
) -> list[Finding]:
    findings: list[Finding] = []
    if removed:
        first = tuple(
            OutlierRemoved(item.view, item.kind, item.mark, item.standardised)
            for item in removed[:FEW_OUTLIERS]
        )
        findings.append(OutliersRemoved(number=len(removed), first=first))
    findings += [
        NoisyView(size=noisy_view.ratio, unit="m/m", view=noisy_view.view)
        for noisy_view in noisy
    ]
    return findings if stopped is None else [*findings, stopped]


def _flattened(measurements: Measurements, options: Options) -> Measurements:
    """Return the readings minus the effects of finite rotations, terms and stage positions."""
    with_visits = any(view.visits is not None for view in measurements.views)
    if options.misalignment_model == "linear" and not (options.terms or with_visits):
        return measurements
    model = fit_joint(measurements, options)
    problem = model.problem
    views = list(measurements.views)
    for row, index in enumerate(problem.grid.index):
        view = views[index]
        marks = problem.system.grid.views.z * problem.half_width_m
        flat = model.y[row] + 1j * problem.turn_rad[row] * marks
        marks_read = measurements.artifact.index(view.m, view.n)
        linear = flat[marks_read] * problem.grid.poses[row].phase
        views[index] = replace(view, dx=linear.real, dy=linear.imag, visits=None)
    return replace(measurements, views=tuple(views))
