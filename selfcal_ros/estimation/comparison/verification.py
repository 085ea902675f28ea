# SPDX-License-Identifier: Apache-2.0
"""What a correction does in the machine: the error before and after it, and what acts instead.

With the correction on, a stage with the error G shows G - f T G, where T is what happens to the
table on its way into the machine, and f a factor. The difference of the map before and the map
after is therefore the correction that acts. It is compared with the map itself, with its columns
exchanged, with its places exchanged or mirrored, and with nothing. The uncertainty of the
difference is that of both maps, whatever acts.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np

from selfcal_ros.errors import InputError
from selfcal_ros.estimation.comparison.covariance import theta_covariance, xy_covariance
from selfcal_ros.estimation.comparison.maps import (
    Spread,
    joint_dof,
    of_one_kind,
    require_same_lattice,
    significance,
    without,
)
from selfcal_ros.estimation.multifrontal.factor import one_thread
from selfcal_ros.model.error_map import datum_modes, rms
from selfcal_ros.model.recheck import Significance
from selfcal_ros.model.result import CalibrationResult

REMAINS_LEVEL = 0.0005
"""Probability of a test below which an error remains: a verdict on wiring, not on drift."""

EXPLAINED = 0.1
"""Part of the square of the larger of map and correction that a fault leaves unexplained."""

CLEARLY_LESS = 0.3
"""Part of what the map itself leaves unexplained, that an exchanged or mirrored map leaves."""

NEAR, NEAR_ZERO = 0.1, 0.05
"""Distances of a factor from 1 or -1, and from 0, that are not told from them."""

VAGUE = 0.3
"""Standard uncertainty of a factor beyond which nothing is said of its axis."""

CHANGED = 0.5
"""Distance of the factors of x and y from 1 that a change of the stage may cause."""

ALIKE = 0.7
"""Correlation from which on another map counts as an older one of the same stage."""


class Fault(StrEnum):
    """What is wrong with the correction that acts."""

    NONE = "none"
    OFF = "off"
    SIGN = "sign"
    FACTOR = "factor"
    AXES_DIFFER = "axes_differ"
    COMPONENTS = "components_exchanged"
    PLACES = "places_exchanged"
    TRANSPOSED = "transposed"
    MIRRORED_X = "mirrored_x"
    MIRRORED_Y = "mirrored_y"
    MIRRORED = "mirrored"
    OLDER = "older_map"
    OTHER = "other_map"
    TOO_SMALL = "too_small"


@dataclass(frozen=True)
class AxisError:
    """Error of one axis, m or rad: rms and largest over the nodes, U (k u, rms) of a node.

    `factor` is the part of the correction that acts, 1 as it should, `u_factor` its standard
    uncertainty; NaN where the map does not show it.
    """

    rms_before: float
    rms_after: float
    largest_before: float
    largest_after: float
    U_before: float
    U_after: float
    factor: float
    u_factor: float


@dataclass(frozen=True, eq=False)
class Verification:
    """What a correction does.

    Attributes
    ----------
    better : bool
        Whether the error with the correction is less, beyond the uncertainty of both.
    fault : Fault
        What is wrong with the correction that acts on x and y.
    theta_fault : Fault
        The same for the angle: NONE, OFF, SIGN, FACTOR or OTHER.
    remains : bool
        Whether x, y have an error with the correction beyond both uncertainties.
    axes : mapping
        ``x``, ``y`` and, with lines, ``theta`` -> error before and after.
    alike : float
        Correlation of the correction that acts and the map, -1 to 1.
    remaining : Significance or None
        Test of the error that remains in x and y.
    gx, gy, g_theta : float array
        Map with the correction on, in the datum of the map before, m and rad.
    """

    better: bool
    fault: Fault
    theta_fault: Fault
    remains: bool
    axes: Mapping[str, AxisError]
    alike: float
    remaining: Significance | None
    gx: np.ndarray
    gy: np.ndarray
    g_theta: np.ndarray = field(default_factory=lambda: np.zeros(0))

    @property
    def passed(self) -> bool:
        """Whether the error is less and no fault of the wiring is found.

        A correction of x and y alone passes.
        """
        wrong_angle = self.theta_fault in (Fault.SIGN, Fault.FACTOR)
        return self.better and self.fault in (Fault.NONE, Fault.OLDER) and not wrong_angle


@dataclass(frozen=True, eq=False)
class _Maps:
    """Errors before and after (n,), their covariances, (n, n) or (n,), and the datum's columns."""

    before: np.ndarray
    after: np.ndarray
    cover_before: np.ndarray
    cover_after: np.ndarray
    datum: np.ndarray

    @property
    def cover(self) -> np.ndarray:
        """Covariance of the correction that acts."""
        return self.cover_before + self.cover_after

    def free(self, values: np.ndarray) -> np.ndarray:
        """Return values (n, ...) without their part in the datum."""
        return values - self.datum @ (self.datum.T @ values)


def require_correctable(result: CalibrationResult, where: str) -> None:
    """Raise InputError unless the map of a result may be corrected."""
    if not result.observability.identifiable or not result.verdict.qualified:
        raise InputError(where, "is not qualified, so it is not a map to correct with",
                         "calibrate again")


def is_believed(after: CalibrationResult, found: "Verification") -> bool:
    """Return whether the readings with the correction on may be believed.

    Against a known plate, a stage that is corrected wrongly looks like another plate.
    """
    named = found.fault not in (Fault.NONE, Fault.OTHER, Fault.OLDER)
    other_plate = {cause.name for cause in after.verdict.failed} == {"other_plate"}
    return after.verdict.qualified or (named and other_plate)


def corrected(result: CalibrationResult) -> CalibrationResult:
    """Return a calibration of a plate whose stage is expected without error, as if corrected."""
    emap = result.error_map
    return replace(result, error_map=replace(
        emap, gx=0 * emap.gx, gy=0 * emap.gy, g_theta=0 * emap.g_theta))


@one_thread()
def verify(before: CalibrationResult, after: CalibrationResult, *,
           names: tuple[str, str] = ("before", "after")) -> Verification:
    """Compare the map that is corrected with the map of the stage while it is corrected.

    Parameters
    ----------
    before, after : CalibrationResult
        Maps on the same nodes, of the same plate or of another one.
    names : tuple of str
        For messages.

    Raises
    ------
    InputError
        If the nodes differ, fewer than three are known in both, or there is no uncertainty.
    """
    require_same_lattice(before.artifact, after.artifact, names)
    first, second = before.error_map, after.error_map
    known = np.isfinite(first.gx + first.gy + second.gx + second.gy)
    if known.sum() < 3:
        raise InputError(names[1], f"{int(known.sum())} nodes are known in both maps",
                         "measure where the map is known")
    maps = _xy_maps(before, after, known)
    if not np.isfinite(maps.cover).all():
        raise InputError(names[0] if np.isfinite(second.u_gx[known]).all() else names[1],
                         "has no uncertainty, so nothing can be verified",
                         "solve it again with --uncertainty always")
    remaining = _remaining(maps, before.noise.dof_xy, after.noise.dof_xy)
    remains = _is_clear(remaining)
    action = maps.free(maps.before - maps.after)
    size = float(np.linalg.norm(action) * np.linalg.norm(maps.before))
    alike = float(action @ maps.before) / size if size else 0.0
    gain, u_gain = _gain(maps)
    factors = _straight_factors(maps)
    fault = _fault(maps, (first.gx, first.gy), known, factors)
    if not remains and gain > 2 * u_gain:
        fault = Fault.NONE
    elif fault is Fault.OTHER and (gain > 2 * u_gain or alike > ALIKE):
        fault = Fault.OLDER
    spread = np.full((2, *known.shape), np.nan)
    spread[:, known] = maps.after.reshape(2, -1)
    axes = {name: AxisError(
        *_sizes(maps.before, maps.after, part),
        before.noise.k_xy * rms(getattr(first, f"u_g{name}")[known]),
        after.noise.k_xy * rms(getattr(second, f"u_g{name}")[known]), *factors[index])
        for index, (name, part) in enumerate(zip("xy", np.split(
            np.arange(len(maps.before)), 2), strict=True))}
    theta_fault, worse = Fault.NONE, False
    lines = np.isfinite(first.g_theta + second.g_theta)
    g_theta = np.full(lines.shape, np.nan)
    if lines.sum() > 2:
        circle = _theta_maps(before, after, lines)
        theta_gain, u_theta_gain = _gain(circle)
        worse = theta_gain < -2 * u_theta_gain
        theta_fault, factor = _theta_fault(circle)
        if not _is_clear(_remaining(circle, before.noise.dof_theta, after.noise.dof_theta)):
            theta_fault = Fault.NONE
        g_theta[lines] = circle.after
        axes["theta"] = AxisError(
            *_sizes(circle.before, circle.after, np.arange(int(lines.sum()))),
            before.noise.k_theta * rms(first.u_g_theta[lines]),
            after.noise.k_theta * rms(second.u_g_theta[lines]), *factor)
    return Verification(gain > 2 * u_gain and not worse, fault, theta_fault, remains, axes, alike,
                        remaining, spread[0], spread[1], g_theta)


def _xy_maps(before: CalibrationResult, after: CalibrationResult, known: np.ndarray) -> _Maps:
    """Return both maps of x and y over the known nodes; scale is datum unless both have one."""
    keep_scale = before.reference is not None and after.reference is not None
    modes = datum_modes(before.artifact, scale=not keep_scale)
    basis = modes[:, :, known].reshape(len(modes), -1).T
    q = np.linalg.qr(basis / np.linalg.norm(basis, axis=0))[0]
    values, covers = [], []
    for result in (before, after):
        emap = result.error_map
        here = np.concatenate([emap.gx[known], emap.gy[known]])
        values.append(here - q @ (q.T @ here))
        covers.append(xy_covariance(result, known))
    return _Maps(values[0], values[1], *_without_datum(covers, q), q)


def _theta_maps(before: CalibrationResult, after: CalibrationResult, known: np.ndarray) -> _Maps:
    """Return both angular maps over the known lines."""
    q = np.full((int(known.sum()), 1), known.sum() ** -0.5)
    values = [result.error_map.g_theta[known] for result in (before, after)]
    covers = [theta_covariance(result, known) for result in (before, after)]
    one, other = (each - each.mean() for each in values)
    return _Maps(one, other, *_without_datum(covers, q), q)


def _without_datum(covers: list[np.ndarray],
                 q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return two covariances without the datum's part, as matrices, or both as variances."""
    one, other = (without(cover, q) for cover in of_one_kind(covers))
    return one, other


def _remaining(maps: _Maps, *dof: float) -> Significance | None:
    """Return the test of the error with the correction on, with the covariance of both maps."""
    sizes = (_trace(maps.cover_before), _trace(maps.cover_after))
    return significance(maps.after, Spread(maps.cover, maps.datum,
                                           joint_dof(*zip(sizes, dof, strict=True))))


def _is_clear(test: Significance | None) -> bool:
    """Return whether an error remains beyond the uncertainties."""
    return test is not None and min(test.p, test.p_z) < REMAINS_LEVEL


def _trace(cover: np.ndarray) -> float:
    return float(np.trace(cover) if cover.ndim == 2 else cover.sum())


def _square_of(cover: np.ndarray, values: np.ndarray) -> float:
    """Return the variance of a linear function of the values."""
    return float(values @ cover @ values if cover.ndim == 2 else values**2 @ cover)


def _gain(maps: _Maps) -> tuple[float, float]:
    """Return by how much the sum of squares falls, noise taken off, and its u."""
    gain, variance = 0.0, 0.0
    for sign, values, cover in ((1, maps.before, maps.cover_before),
                                (-1, maps.after, maps.cover_after)):
        gain += sign * (float(values @ values) - _trace(cover))
        variance += 4 * _square_of(cover, values) + 2 * float((cover**2).sum())
    return gain, variance ** 0.5


def _sizes(before: np.ndarray, after: np.ndarray,
           part: np.ndarray) -> tuple[float, float, float, float]:
    """Return rms before and after, largest before and after, of a part."""
    return (rms(before[part]), rms(after[part]), float(np.abs(before[part]).max()),
            float(np.abs(after[part]).max()))


def _straight_factors(maps: _Maps) -> list[tuple[float, float]]:
    """Return the factors of the correction in x and y, and their u; NaN where not shown.

    What the map has of noise is in the correction as well: that part of the sum of products is
    taken off.
    """
    n = len(maps.before) // 2
    variances = np.diag(maps.cover_before) if maps.cover_before.ndim == 2 else maps.cover_before
    noise = [float(variances[:n].sum()), float(variances[n:].sum())]
    return _factors(maps, maps.free(_columns(maps.before.reshape(2, n))), noise)


def _columns(field: np.ndarray) -> np.ndarray:
    """Return a field (2, n) as one column for x and one for y, (2 n, 2)."""
    zero = np.zeros(field.shape[1])
    return np.stack([np.concatenate([field[0], zero]), np.concatenate([zero, field[1]])], axis=1)


def _factors(maps: _Maps, columns: np.ndarray,
             noise: list[float]) -> list[tuple[float, float]]:
    """Return the factors of columns (n, c) in the correction that acts, and their u."""
    action = maps.free(maps.before - maps.after)
    products = columns.T @ columns
    if np.linalg.matrix_rank(products) < len(products):
        return [(float("nan"), float("nan"))] * len(products)
    weights = np.linalg.solve(products, columns.T)
    values = np.linalg.solve(products, columns.T @ action - np.array(noise))
    u = [_square_of(maps.cover, row) ** 0.5 for row in weights]
    return [(float(value), float(one)) for value, one in zip(values, u, strict=True)]


def _unexplained(maps: _Maps, explained: np.ndarray) -> float:
    """Return the part of the squares that is unexplained, noise taken off."""
    action = maps.free(maps.before - maps.after)
    rest = action - explained
    size = max(float(action @ action), float(maps.before @ maps.before))
    return max(float(rest @ rest) - _trace(maps.cover), 0.0) / size if size else 0.0


def _fault(maps: _Maps, fields: tuple[np.ndarray, np.ndarray], known: np.ndarray,
           factors: list[tuple[float, float]]) -> Fault:
    """Return what acts on x and y instead of the map."""
    cover, before = maps.cover_before, maps.before
    if float(before @ before) - _trace(cover) <= 2 * (2 * float((cover**2).sum())) ** 0.5:
        return Fault.TOO_SMALL
    columns = maps.free(_columns(before.reshape(2, -1)))
    itself = _unexplained(maps, columns @ np.nan_to_num([value for value, _ in factors]))
    others = {}
    for fault, field_of in _arranged(*fields).items():
        if np.isfinite(np.stack(field_of)[:, known]).all():
            moved = maps.free(_columns(np.stack(field_of)[:, known]))
            weights = np.linalg.lstsq(moved, maps.free(maps.before - maps.after), rcond=None)[0]
            if _kind(weights[0], 0.0) or _kind(weights[1], 0.0):
                others[fault] = _unexplained(maps, moved @ weights)
    likely = min(others, key=lambda name: others[name], default=Fault.OTHER)
    least = others.get(likely, np.inf)
    if least < min(EXPLAINED, CLEARLY_LESS * itself):
        return likely
    return _of_factors(factors) if itself < EXPLAINED else Fault.OTHER


def _arranged(gx: np.ndarray, gy: np.ndarray) -> dict[Fault, tuple[np.ndarray, np.ndarray]]:
    """Return a map (nx, ny) as it acts with each fault of arrangement."""
    found = {Fault.COMPONENTS: (gy, gx), Fault.MIRRORED_X: (gx[::-1], gy[::-1]),
             Fault.MIRRORED_Y: (gx[:, ::-1], gy[:, ::-1]),
             Fault.MIRRORED: (gx[::-1, ::-1], gy[::-1, ::-1])}
    if gx.shape[0] == gx.shape[1]:
        found |= {Fault.PLACES: (gx.T, gy.T), Fault.TRANSPOSED: (gy.T, gx.T)}
    return found


def _kind(factor: float, u: float) -> Fault | None:
    """Return what a factor says: None if it says nothing."""
    if not u < VAGUE * max(1.0, abs(factor)):
        return None
    for value, near, kind in ((1.0, NEAR, Fault.NONE), (-1.0, NEAR, Fault.SIGN),
                              (0.0, NEAR_ZERO, Fault.OFF)):
        if abs(factor - value) <= max(near, 2 * u):
            return kind
    return Fault.FACTOR


def _of_factors(factors: list[tuple[float, float]]) -> Fault:
    """Return what the factors of x and y say together."""
    kinds = {kind for factor in factors if (kind := _kind(*factor)) is not None}
    if not kinds:
        return Fault.OTHER
    if Fault.FACTOR not in kinds:
        return kinds.pop() if len(kinds) == 1 else Fault.AXES_DIFFER
    shown = [(value, u) for value, u in factors if _kind(value, u)]
    values, u = np.transpose(shown)
    apart = float(values.max() - values.min())
    if apart <= max(NEAR * abs(values).max(), 3 * float(np.linalg.norm(u))):
        return Fault.FACTOR
    return Fault.OLDER if abs(values - 1).max() < CHANGED else Fault.AXES_DIFFER


def _theta_fault(maps: _Maps) -> tuple[Fault, tuple[float, float]]:
    """Return what acts on the angle, and its factor with u; NONE if too little is to be seen."""
    cover, before = maps.cover_before, maps.before
    factor, = _factors(maps, before[:, None], [_trace(cover)])
    if float(before @ before) - _trace(cover) <= 2 * (2 * float((cover**2).sum())) ** 0.5:
        return Fault.NONE, factor
    if _unexplained(maps, before * factor[0]) >= EXPLAINED:
        return Fault.OTHER, factor
    return _kind(*factor) or Fault.NONE, factor
