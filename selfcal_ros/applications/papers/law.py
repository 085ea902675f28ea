# SPDX-License-Identifier: Apache-2.0
"""Hu's self-calibration law, for comparison with the joint solution (method eqs. 5.1-5.10).

Its steps are linear maps on arrays (Hu eqs. 16-28). Every array has a last axis of columns, so that
the same code solves the readings (one column) and propagates the noise of each reading (one column
per reading).
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from selfcal_ros.errors import InputError
from selfcal_ros.estimation.joint.problem import NoiseEstimate, noise_estimate, pooled
from selfcal_ros.estimation.joint.solve import Solved, noise_of
from selfcal_ros.estimation.normal.angular import FLOOR
from selfcal_ros.estimation.options import Options
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.error_map import ErrorMap, ThetaDatum, half_axis_slopes
from selfcal_ros.model.findings import DrawnUncertainty, Finding
from selfcal_ros.model.readings import (
    Measurements,
    Sense,
    ViewReadings,
    lines_turned_over,
    turned_over,
)
from selfcal_ros.model.result import (
    ArtifactMap,
    CalibrationResult,
    Noise,
    Observability,
    ViewResult,
)


@dataclass(frozen=True, eq=False)
class HuReadings:
    """Deviations of Hu's four views: v0, v1 (2, N, N, C), v3 (2, N-1, N, C), vt (4, K, C)."""

    v0: np.ndarray
    v1: np.ndarray
    v3: np.ndarray
    vt: np.ndarray


@dataclass(frozen=True, eq=False)
class HuSolution:
    """Solution of the law, one column for each column of readings.

    `g`, `a` (2, N, N, C) in m; `g_theta`, `a_theta` (K, C) in rad; `phi` (4, C); `t` (4, 2, C),
    NaN for view 2; `o`, `r` (C,); `rest_xy`, `rest_theta`: residuals of eqs. 23, 25 and 28.
    """

    g: np.ndarray
    a: np.ndarray
    g_theta: np.ndarray
    a_theta: np.ndarray
    phi: np.ndarray
    t: np.ndarray
    o: np.ndarray
    r: np.ndarray
    rest_xy: np.ndarray
    rest_theta: np.ndarray


class HuLaw:
    """The law for one artifact, with its two least-squares problems factorised once.

    Parameters
    ----------
    artifact : Artifact
        Square plate with angular lines.
    datum : ThetaDatum
        `xy_axes` uses Hu eq. 27; `zero_mean` replaces it by a zero sum.
    axis_lines : int array (4,)
        Lines whose angular error eq. 27 gives; -1 times the slope for the second sense.
    axis_sign : int
        +1, or -1 for the second sense.
    """

    def __init__(
        self,
        artifact: Artifact,
        datum: ThetaDatum,
        axis_lines: np.ndarray,
        axis_sign: int,
    ) -> None:
        self.artifact, self.datum, self.axis_sign = artifact, datum, axis_sign
        self.x, self.y = artifact.x_m[..., None], artifact.y_m[..., None]
        self.sum_r2 = float((artifact.x_m**2 + artifact.y_m**2).sum())
        self.rows_xy = _rows_xy(artifact.grid_size)
        self.solve_xy = _bordered(self.rows_xy, _first_order_rows(artifact))
        self.rows_theta, ties = _rows_theta(artifact.angular_count, datum, axis_lines)
        self.solve_theta = _bordered(self.rows_theta, ties)
        self.phi3_rest = self._left_by_phi3()

    def solve(self, readings: HuReadings) -> HuSolution:
        """Return the solution for every column of `readings`."""
        x, y, d = self.x, self.y, self.sum_r2
        v0, v1, v3, vt = readings.v0, readings.v1, readings.v3, readings.vt
        t0, t1 = v0.mean(axis=(1, 2)), v1.mean(axis=(1, 2))  # eq. 16
        phi0 = (v0[1] * x - v0[0] * y).sum(axis=(0, 1)) / d  # eq. 16
        phi1 = -(v1[0] * x + v1[1] * y).sum(axis=(0, 1)) / d  # eq. 16
        phi2 = vt[2].mean(axis=0) - vt[0].mean(axis=0) + phi0  # eq. 17
        # Printed with the sum over the lines of view 0 over n, not k.
        phi3 = vt[3].mean(axis=0) - vt[0].mean(axis=0) + phi0  # eq. 17
        u0x, u0y = v0[0] - t0[0] + phi0 * y, v0[1] - t0[1] - phi0 * x  # eq. 18
        u1x, u1y = v1[0] - t1[0] + phi1 * x, v1[1] - t1[1] + phi1 * y  # eq. 19
        u3x, u3y = v3[0] + phi3 * y[:-1], v3[1] - phi3 * x[:-1]  # eq. 21
        # eq. 22
        o = ((u0x * y + u0y * x) + (u1x * x - u1y * y)).sum(axis=(0, 1)) / (2 * d)
        # eq. 22
        r = ((u0x * x - u0y * y) - (u1x * y + u1y * x)).sum(axis=(0, 1)) / (2 * d)
        # eq. 23
        quarter = (u0x - u1y - 2 * o * y - 2 * r * x, u0y + u1x - 2 * o * x + 2 * r * y)
        step = (u3x - u0x[:-1], u3y - u0y[:-1])  # eq. 24
        # eq. 25
        right = np.concatenate(
            [
                _columns(part)
                for part in (
                    *quarter,
                    *(np.diff(part, axis=axis) for part in step for axis in (0, 1)),
                )
            ]
        )
        f, rest_xy = self.solve_xy(right, np.zeros((6, right.shape[1])))  # eq. 26
        rest_xy -= self.phi3_rest[:, None] * (self.phi3_rest @ rest_xy)
        f = f.reshape(v0.shape)
        g = np.stack([o * y + r * x + f[0], o * x - r * y + f[1]])  # eq. 6
        phi = np.stack([phi0, phi1, phi2, phi3])
        # Eqs. 18-21; the last is printed with V3y in place of V3theta.
        g_theta, rest_theta = self._theta(vt - phi[:, None], g)
        a = np.stack([u0x, u0y]) - g  # eq. 18
        t3 = v3 - g[:, 1:] - a[:, :-1] - phi3 * np.stack([-y, x])[:, :-1]  # eq. 15
        t = np.stack([t0, t1, np.full_like(t0, np.nan), t3.mean(axis=(1, 2))])
        return HuSolution(
            g,
            a,
            g_theta,
            a_theta=vt[0] - phi0 - g_theta,
            phi=phi,
            t=t,
            o=o,
            r=r,
            rest_xy=rest_xy,
            rest_theta=rest_theta,
        )

    def _left_by_phi3(self) -> np.ndarray:
        """Return the residual of eq. 25 caused by an error of phi3, of unit length.

        phi3 comes from the angular lines alone (eq. 17), so its error is angular noise: it is
        removed from the residuals before the noise of the grid readings is estimated from them.
        """
        step = np.stack(
            [
                np.broadcast_to(self.y, (*self.artifact.shape, 1)),
                np.broadcast_to(-self.x, (*self.artifact.shape, 1)),
            ]
        )[:, :-1]
        quarter = np.zeros((2 * self.x.size, 1))
        right = np.concatenate(
            [
                quarter,
                *(
                    _columns(np.diff(part, axis=axis))
                    for part in step
                    for axis in (0, 1)
                ),
            ]
        )
        residual = self.solve_xy(right, np.zeros((6, 1)))[1][:, 0]
        return residual / np.linalg.norm(residual)

    def _theta(self, u: np.ndarray, g: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return Gtheta from the axis slopes (eq. 27) and the circle's differences (eq. 28)."""
        right = np.concatenate([u[1] - u[0], u[2] - u[0]])
        if self.datum is ThetaDatum.ZERO_MEAN:
            return self.solve_theta(right, np.zeros((1, right.shape[1])))
        slopes = self.axis_sign * half_axis_slopes(self.artifact, g)
        return self.solve_theta(right, slopes)


def _columns(part: np.ndarray) -> np.ndarray:
    return part.reshape(-1, part.shape[-1])


def _diagonals(values: tuple[float, ...], shape: tuple[int, int]) -> sparse.csr_array:
    """Return a matrix of constant diagonals, the main one first; SciPy 1.11 lacks diags_array."""
    return sparse.dia_array(
        (np.outer(values, np.ones(shape[1])), range(len(values))), shape=shape
    ).tocsr()


def _identity(size: int) -> sparse.csr_array:
    return _diagonals((1.0,), (size, size))


def _rows_xy(size: int) -> sparse.csr_array:
    """Return the left-hand sides of eqs. 23 and 25 for F as (2, N, N) flattened."""
    identity = _identity(size)
    first = _diagonals((-1.0, 1.0), (size - 1, size))
    second = first[:-1, :-1] @ first
    curve = sparse.kron(second, identity)  # F(m+2,n) - 2 F(m+1,n) + F(m,n)
    twist = sparse.kron(first, first)  # the mixed difference
    full = _identity(size * size)
    i, j = (index.ravel() for index in np.indices((size, size)))
    turned = full[(size - 1 - j) * size + i]  # value at (-n, m)
    return sparse.csr_array(
        sparse.bmat(
            [
                [full, -turned],
                [turned, full],
                [curve, None],
                [twist, None],
                [None, curve],
                [None, twist],
            ]
        )
    )


def _first_order_rows(artifact: Artifact) -> np.ndarray:
    """Return the six sums of eq. 7 over F, in lattice units."""
    ones = np.ones(artifact.shape)
    rows = np.zeros((6, 2, *artifact.shape))
    for index, weight in enumerate((ones, *artifact.places(artifact.m, artifact.n))):
        rows[index, 0] = rows[index + 3, 1] = weight / np.linalg.norm(weight)
    return rows.reshape(6, -1)


def _rows_theta(
    count: int, datum: ThetaDatum, axis_lines: np.ndarray
) -> tuple[sparse.csr_array, np.ndarray]:
    identity = _identity(count)
    k = np.arange(count)
    rows = sparse.csr_array(
        sparse.vstack(
            [
                identity[(k + count // 4) % count] - identity,
                identity[(k + 1) % count] - identity,
            ]
        )
    )
    if datum is ThetaDatum.ZERO_MEAN:
        return rows, np.full((1, count), 1 / np.sqrt(count))
    return rows, identity[axis_lines].toarray()


def _bordered(
    rows: sparse.csr_array, ties: np.ndarray
) -> Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """Return a least-squares solver for `rows` together with the few dense rows `ties`.

    The dense rows border the normal matrix, so that it stays sparse. The solver takes the
    right-hand sides of both and returns the solution and the residuals of `rows`.
    """
    unknowns = rows.shape[1]
    bordered = sparse.csc_array(
        sparse.bmat(
            [
                [rows.T @ rows, sparse.csr_array(ties).T],
                [sparse.csr_array(ties), -_identity(len(ties))],
            ]
        )
    )
    factor = splu(
        bordered,
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.01,
        options={"SymmetricMode": True},
    )

    def solve(right: np.ndarray, tied: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        solution = factor.solve(np.concatenate([rows.T @ right, tied]))[:unknowns]
        residual, slack = right - rows @ solution, tied - ties @ solution
        refinement = factor.solve(np.concatenate([rows.T @ residual, slack]))[:unknowns]
        # one refinement: to rounding
        return (solution + refinement, residual - rows @ refinement)

    return solve


EXACT_SIZE = 21
"""Largest N for which the noise is propagated reading by reading."""

N_DRAWS = 400
"""Unit-noise draws for the uncertainties of a larger plate: standard error 3.5 % each."""

JOINTLY = "solve with --method joint"
"""Remedy for what the law cannot use."""

_REMEDY = f"measure Hu's four views in full, or {JOINTLY}"
_NAMES = (
    "0° with grid and lines",
    "90° with grid and lines",
    "one line, lines only",
    "one pitch along +X with grid and lines",
)


def solve_law(measurements: Measurements, options: Options) -> Solved:
    """Calibrate by Hu's law from exactly Hu's four views, all complete.

    Parameters
    ----------
    measurements : Measurements
        Readings; repeats are averaged without weights, as published.
    options : Options
        Only `datum_theta` and `uncertainty` are used.

    Returns
    -------
    Solved
        Its result has the `method` "law". Uncertainties are propagated linearly through every step;
        correlations are not kept.

    Raises
    ------
    InputError
        If a view is missing, surplus or incomplete, or the datum does not exist.
    """
    views = hu_views(measurements)
    order = [
        next(i for i, v in enumerate(measurements.views) if v is view) for view in views
    ]
    law = law_for(
        measurements.artifact, ThetaDatum(options.datum_theta), measurements.sense
    )
    solution = law.solve(hu_readings(measurements.artifact, views))
    spread = _propagate(law, views)
    xy, theta = _noise(solution, spread, measurements.views)
    noise = noise_of(xy, theta)
    sense = measurements.sense
    u_g, u_theta = spread.uncertainty(noise)
    if options.uncertainty is False:
        u_g, u_theta = np.full_like(u_g, np.nan), np.full_like(u_theta, np.nan)
    (gx, gy), g_theta = _to_stage(sense, solution.g[..., 0], solution.g_theta[:, 0])
    (u_gx, u_gy), u_theta = _to_stage(sense, u_g, u_theta, sign=1)
    artifact = measurements.artifact
    sites = artifact.shape[0] * artifact.shape[1]
    result = CalibrationResult(
        plan_id=measurements.plan_id,
        error_map=ErrorMap(
            artifact,
            gx,
            gy,
            u_gx=u_gx,
            u_gy=u_gy,
            g_theta=g_theta,
            u_g_theta=u_theta,
            nonorthogonality=float(solution.o[0]),
            scale_difference=float(solution.r[0]),
            datum_theta=law.datum,
        ),
        artifact_map=ArtifactMap(
            solution.a[0, ..., 0], solution.a[1, ..., 0], solution.a_theta[:, 0]
        ),
        views=tuple(
            ViewResult(
                view.view.name,
                view.view.rotation_rad,
                *view.view.translation_m,
                phi=float(solution.phi[order.index(i), 0]),
                tx=float(solution.t[order.index(i), 0, 0]),
                ty=float(solution.t[order.index(i), 1, 0]),
                used=view.used,
                rejected=sum(view.rejected.values()),
            )
            for i, view in enumerate(measurements.views)
        ),
        # complete views: each site and each line has two readings or more
        observability=Observability(
            4 * sites + 9, 4 * sites + 9, 0, True, unchecked_sites=0, unchecked_lines=0
        ),
        noise=noise,
        rejected=measurements.all_rejected(),
        findings=_findings(artifact, options),
        method="law",
        sense=str(sense),
        run_id=measurements.run_id,
    )
    return Solved(result, xy, theta)


@lru_cache(4)
def law_for(artifact: Artifact, datum: ThetaDatum, sense: Sense) -> HuLaw:
    """Return the cached, factorised law for a plate and a sense of measurement.

    With the plate on the stage the law solves for H(X) = -G(-X): the slopes of G along +X, +Y,
    -X, -Y are those of H along -X, -Y, +X, +Y, and Htheta(-k) = -Gtheta(k).

    Raises
    ------
    InputError
        If the half axes are too short for the slopes of eq. 27, or have no sites.
    """
    if datum is ThetaDatum.XY_AXES and artifact.grid_size % 2 == 0:
        raise InputError(
            "method law",
            f"no marks of {artifact.grid_size} rows lie on the axes, which have no "
            "slope (Hu eq. 27)",
            "use the theta datum zero_mean",
        )
    if datum is ThetaDatum.XY_AXES and artifact.grid_size < 5:
        raise InputError(
            "method law",
            "a half axis of one mark has no slope (Hu eq. 27)",
            "use the theta datum zero_mean",
        )
    quarter = artifact.angular_count // 4
    if sense is Sense.PLATE_MOVES:
        return HuLaw(artifact, datum, np.array([2, 1, 0, 3]) * quarter, -1)
    return HuLaw(artifact, datum, np.arange(4) * quarter, 1)


def hu_views(measurements: Measurements) -> list[ViewReadings]:
    """Return the readings of Hu's views 0, 1, 2, 3, found by their pose.

    Raises
    ------
    InputError
        If the plate or the views are not Hu's, or marks are missing.
    """
    artifact = measurements.artifact
    if (
        artifact.shape[0] != artifact.shape[1]
        or not artifact.angular_count
        or (artifact.angular_count % 4 or artifact.harmonics)
    ):
        raise InputError(
            "method law",
            "Hu's law needs a square plate with 4, 8, 12, ... lines and a value at each line",
            JOINTLY,
        )
    wanted: dict[tuple, int] = {
        (0, (0, 0), 0): 0,
        (1, (0, 0), artifact.angular_count // 4): 1,
        (0, (1, 0), 0): 3,
    }
    view_of_index: dict[int, ViewReadings] = {}
    for view in measurements.views:
        pose = view.view.lattice_pose(artifact)
        grid, lines = len(view.m) > 0, len(view.k) > 0
        index = (
            wanted.get((pose.quarter_turns, pose.shift, pose.turn_lines))
            if grid
            else None
        )
        if not grid and lines and (pose.shift, pose.turn_lines) == ((0, 0), 1):
            index = 2
        if index is None or index in view_of_index:
            raise InputError(
                f"method law: view '{view.view.name}'",
                "is not one of Hu's four views, each once",
                _REMEDY,
            )
        view_of_index[index] = view
    for index, name in enumerate(_NAMES):
        if index not in view_of_index:
            raise InputError(
                "method law", f"Hu's view {index} ({name}) is missing", _REMEDY
            )
        _require_complete(view_of_index[index], index, artifact)
    return [view_of_index[index] for index in range(4)]


def _require_complete(view: ViewReadings, index: int, artifact: Artifact) -> None:
    size, lines = artifact.grid_size, artifact.angular_count
    n_marks = {2: 0, 3: size * (size - 1)}.get(index, size * size)
    for what, have, want in (
        ("grid marks", len(view.m), n_marks),
        ("angular lines", len(view.k), lines),
    ):
        if have != want:
            raise InputError(
                f"method law: view '{view.view.name}'",
                f"{have} of {want} {what} were read",
                _REMEDY,
            )


def hu_readings(artifact: Artifact, views: list[ViewReadings]) -> HuReadings:
    """Return the deviations of Hu's four views from `hu_views` as arrays."""
    v0, v1, v3 = (_grid(views[index], artifact) for index in (0, 1, 3))
    vt = np.zeros((4, artifact.angular_count, 1))
    for index, view in enumerate(views):
        vt[index, view.k, 0] = view.dtheta
    return HuReadings(v0[..., None], v1[..., None], v3[:, :-1, :, None], vt)


def _grid(view: ViewReadings, artifact: Artifact) -> np.ndarray:
    values = np.full((2, *artifact.shape), np.nan)
    index = artifact.index(view.m, view.n)
    values[0][index], values[1][index] = view.dx, view.dy
    return values


@dataclass(frozen=True, eq=False)
class _Spread:
    """Effect of unit noise of every reading, of grid and of angular readings.

    `var_g` (2, 2, N, N), `var_theta` (2, K): variances that noise of one kind and the other makes;
    `rest`, `rest_dof` (2,): the expected sums of squared residuals, of grid readings in XY and
    angular ones in theta, and their effective degrees of freedom.
    """

    var_g: np.ndarray
    var_theta: np.ndarray
    rest: np.ndarray
    rest_dof: np.ndarray

    def uncertainty(self, noise: Noise) -> tuple[np.ndarray, np.ndarray]:
        """Return the standard uncertainties of g (2, N, N) and g_theta (K,)."""
        power = np.array([noise.sigma_xy, noise.sigma_theta]) ** 2
        return (
            np.sqrt(np.tensordot(power, self.var_g, axes=1)),
            np.sqrt(np.tensordot(power, self.var_theta, axes=1)),
        )


def _propagate(law: HuLaw, views: list[ViewReadings]) -> _Spread:
    """Propagate the noise of each reading: exactly up to EXACT_SIZE, else by draws."""
    exact = law.artifact.grid_size <= EXACT_SIZE
    grid, lines = (
        law.solve(_unit_noise(law.artifact, views, kind=kind, exact=exact))
        for kind in range(2)
    )
    expected_squares, dof = np.transpose(
        [
            _quadratic_form(of_kind, exact=exact)
            for of_kind in (grid.rest_xy, lines.rest_theta)
        ]
    )
    columns = 1 if exact else N_DRAWS
    var_g, var_theta = (
        np.stack([(values**2).sum(axis=-1) / columns for values in of_kind])
        for of_kind in ((grid.g, lines.g), (grid.g_theta, lines.g_theta))
    )
    return _Spread(var_g, var_theta, expected_squares, dof)


def _quadratic_form(residuals: np.ndarray, *, exact: bool) -> tuple[float, float]:
    """Return mean and effective degrees of freedom (Satterthwaite) of the sum of squares."""
    if exact:
        gram = residuals.T @ residuals
        mean = float(np.trace(gram))
        twice_squares = 2 * float((gram**2).sum())
    else:
        sums = (residuals**2).sum(axis=0)
        mean = float(sums.mean())
        twice_squares = float(sums.var(ddof=1))
    return mean, 2 * mean**2 / twice_squares


def _unit_noise(
    artifact: Artifact, views: list[ViewReadings], *, kind: int, exact: bool
) -> HuReadings:
    """Return unit noise of all readings of one kind: one column per reading, or random columns."""
    size, lines = artifact.grid_size, artifact.angular_count
    shapes = [(2, size, size), (2, size, size), (2, size - 1, size), (4, lines)]
    weights = [
        _per_mean(views[index], artifact, shape)
        for index, shape in zip((0, 1, 3), shapes, strict=False)
    ]
    weights.append(np.array([1 / np.sqrt(view.count_theta) for view in views]))
    slots = np.concatenate(
        [
            w.ravel() if (i == 3) == bool(kind) else np.zeros(w.size)
            for i, w in enumerate(weights)
        ]
    )
    active = np.flatnonzero(slots)
    if exact:
        columns = np.zeros((len(slots), len(active)))
        columns[active, np.arange(len(active))] = slots[active]
    else:
        rng = np.random.default_rng(kind)
        columns = slots[:, None] * rng.standard_normal((len(slots), N_DRAWS))
    edges = np.cumsum([w.size for w in weights])[:-1]
    return HuReadings(
        *(
            part.reshape(*shape, -1)
            for part, shape in zip(np.split(columns, edges), shapes, strict=True)
        )
    )


def _per_mean(
    view: ViewReadings, artifact: Artifact, shape: tuple[int, ...]
) -> np.ndarray:
    counts = np.full(artifact.shape, np.nan)
    counts[artifact.index(view.m, view.n)] = view.count
    return np.broadcast_to(1 / np.sqrt(counts[: shape[1]]), shape)


def _noise(
    solution: HuSolution, spread: _Spread, views: tuple[ViewReadings, ...]
) -> tuple[NoiseEstimate, NoiseEstimate]:
    """Estimate the noise of one reading from repeats, and from the residuals."""
    from_residuals = np.sqrt(
        [
            (solution.rest_xy**2).sum() / spread.rest[0],
            (solution.rest_theta**2).sum() / spread.rest[1],
        ]
    )
    dof = np.maximum(np.round(spread.rest_dof), 1).astype(int)
    declared = float("nan")
    xy = noise_estimate(
        pooled((v.sigma_xy, v.dof_xy) for v in views if len(v.m)),
        (float(from_residuals[0]), int(dof[0])),
        declared,
        floor=FLOOR,
    )
    theta = noise_estimate(
        pooled((v.sigma_theta, v.dof_theta) for v in views if len(v.k)),
        (float(from_residuals[1]), int(dof[1])),
        declared,
        floor=FLOOR,
    )
    return xy, theta


def _to_stage(
    sense: Sense, field: np.ndarray, theta: np.ndarray, *, sign: int = -1
) -> tuple[np.ndarray, np.ndarray]:
    """Return maps (2, N, N, ...) and (K, ...) of the equations as those of the stage."""
    return (
        turned_over(sense, field, sign=sign, axes=(1, 2)),
        lines_turned_over(sense, theta, sign=sign),
    )


def _findings(artifact: Artifact, options: Options) -> tuple[Finding, ...]:
    if artifact.grid_size <= EXACT_SIZE or options.uncertainty is False:
        return ()
    return (DrawnUncertainty(draws=N_DRAWS),)
