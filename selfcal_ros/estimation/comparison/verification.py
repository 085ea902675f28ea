# SPDX-License-Identifier: Apache-2.0
"""What a correction does in the machine: the error before and after it, and what acts instead.

With the correction on, a stage with the error G shows G - f T G, where T is what happens to the
table on its way into the machine, and f a factor. The difference of the map before and the map
after is therefore the correction that acts. It is compared with the map itself, with its columns
exchanged, with its places exchanged or mirrored, and with nothing. The uncertainty of the
difference is that of both maps, whatever acts.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cached_property

import numpy as np
from scipy.linalg import block_diag

from selfcal_ros.errors import InputError
from selfcal_ros.estimation.checks.wiring import BEYOND
from selfcal_ros.estimation.comparison.covariance import covariance_of
from selfcal_ros.estimation.comparison.maps import (
    ReducedNoise,
    joint_dof,
    of_one_kind,
    require_same_lattice,
    significance,
    variances,
    variances_of,
    without,
)
from selfcal_ros.estimation.multifrontal.factor import one_thread
from selfcal_ros.estimation.terms.equations import CAUSE_LEVEL
from selfcal_ros.model.error_map import ErrorMap, datum_columns, rms
from selfcal_ros.model.findings import ChangedOrMarks, OtherPlate
from selfcal_ros.model.recheck import Significance
from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.model.verified import AxisError

AXES = {"xy": ("x", "y"), "theta": ("theta",)}
"""Axes of each map."""

NEAR = 0.1
"""Part that does not count: of a factor, by which a table may change between two calibrations, and
of the square of the larger of map and correction, which a fault may leave unexplained."""

SHARED = 0.5
"""Part of an older table of the same stage that is in the map, of its size or of its square."""


class TableFault(StrEnum):
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


@dataclass(frozen=True, eq=False)
class Verification:
    """What a correction does.

    Attributes
    ----------
    better : bool
        Whether the error with the correction is less, beyond the uncertainty of both.
    fault : TableFault
        What is wrong with the correction that acts on x and y.
    theta_fault : TableFault
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
    without_scale : bool
        Whether the map before has a scale, which is not in any of these figures.
    """

    better: bool
    fault: TableFault
    theta_fault: TableFault
    remains: bool
    axes: Mapping[str, AxisError]
    alike: float
    remaining: Significance | None
    gx: np.ndarray
    gy: np.ndarray
    g_theta: np.ndarray
    without_scale: bool = False

    @property
    def passed(self) -> bool:
        """Whether the error is less and no fault of the wiring is found.

        A correction of x and y alone passes.
        """
        wrong_angle = self.theta_fault in (TableFault.SIGN, TableFault.FACTOR)
        return (
            self.better
            and self.fault in (TableFault.NONE, TableFault.OLDER)
            and not wrong_angle
        )


@dataclass(frozen=True, eq=False)
class _Maps:
    """Errors before and after, without their datum, in the axes x and y, or of the angle.

    Attributes
    ----------
    kind : str
        ``xy`` or ``theta``.
    known : bool array (nx, ny) or (K,)
        Their places.
    before, after : float array (n,)
        The errors, one axis after the other.
    cover_before, cover_after : float array (n, n) or (n,)
        Their covariances, or variances.
    noise : ReducedNoise
        Noise of the correction that acts, of both maps together.
    """

    kind: str
    known: np.ndarray
    before: np.ndarray
    after: np.ndarray
    cover_before: np.ndarray
    cover_after: np.ndarray
    noise: ReducedNoise

    @property
    def action(self) -> np.ndarray:
        """The correction that acts, without its part in the datum, (n,)."""
        return self.noise.without(self.before - self.after)

    def by_axis(self, values: np.ndarray) -> np.ndarray:
        """Return values (n,) by their axis, (axes, places)."""
        return values.reshape(len(AXES[self.kind]), -1)

    @property
    def columns(self) -> np.ndarray:
        """The error before as a column of each axis, (n, axes)."""
        return self.noise.without(_columns(self.by_axis(self.before)))

    @cached_property
    def remaining(self) -> Significance | None:
        """Test of the error with the correction on, with the covariance of both maps."""
        return significance(self.after, self.noise)

    @property
    def remains(self) -> bool:
        """Whether an error remains beyond the uncertainties."""
        test = self.remaining
        return test is not None and min(test.p, test.p_z) < CAUSE_LEVEL

    @property
    def alike(self) -> float:
        """Correlation of the correction that acts and the map; 0 without one of them."""
        size = float(np.linalg.norm(self.action) * np.linalg.norm(self.before))
        return float(self.action @ self.before) / size if size else 0.0

    @property
    def too_small(self) -> bool:
        """Whether the error before is not larger than its noise."""
        power = _square(self.before) - variances(self.cover_before).sum()
        return power <= 2 * (2 * _square(self.cover_before)) ** 0.5

    @cached_property
    def gain(self) -> tuple[float, float]:
        """By how much the sum of squares falls, noise taken off, and its u."""
        gain, variance = 0.0, 0.0
        for sign, values, cover in (
            (1, self.before, self.cover_before),
            (-1, self.after, self.cover_after),
        ):
            gain += sign * (_square(values) - float(variances(cover).sum()))
            variance += 4 * float(
                variances_of(cover, values[:, None])[0]
            ) + 2 * _square(cover)
        return gain, variance**0.5

    @property
    def better(self) -> bool:
        """Whether the error is less with the correction on, beyond the uncertainty of both."""
        gain, u = self.gain
        return gain > 2 * u

    @property
    def worse(self) -> bool:
        """Whether it is larger."""
        gain, u = self.gain
        return gain < -2 * u

    @cached_property
    def factors(self) -> list[tuple[float, float]]:
        """Factors of the correction in each axis, and their u; NaN where not shown.

        What the map has of noise is in the correction as well: that part of the sum of products is
        taken off.
        """
        columns = self.columns
        noise = self.by_axis(variances(self.cover_before)).sum(axis=1)
        products = columns.T @ columns
        if np.linalg.matrix_rank(products) < len(products):
            return [(float("nan"), float("nan"))] * len(products)
        weights = np.linalg.solve(products, columns.T).T
        values = np.linalg.solve(products, columns.T @ self.action - noise)
        u = np.sqrt(variances_of(self.noise.covariance, weights))
        return list(zip(values.tolist(), u.tolist(), strict=True))

    def unexplained(self, explained: np.ndarray) -> float:
        """Return the part of the squares that is unexplained, noise taken off."""
        size = max(_square(self.action), _square(self.before))
        remaining = _square(self.action - explained) - float(
            variances(self.noise.covariance).sum()
        )
        return max(remaining, 0.0) / size if size else 0.0

    @property
    def explained(self) -> bool:
        """Whether the map with its factors is the correction that acts."""
        factors = np.nan_to_num([value for value, _ in self.factors])
        return self.unexplained(self.columns @ factors) < NEAR


def require_correctable(result: CalibrationResult, where: str) -> None:
    """Raise InputError unless the map of a result may be corrected."""
    if not result.observability.identifiable or not result.verdict.qualified:
        raise InputError(
            where,
            "is not qualified, so it is not a map to correct with",
            "calibrate again",
        )


def is_believed(after: CalibrationResult, verification: "Verification") -> bool:
    """Return whether the readings with the correction on may be believed.

    Against a known plate, a stage that is corrected wrongly looks like another plate, or like one
    of which marks have changed.
    """
    named = verification.fault not in (
        TableFault.NONE,
        TableFault.OTHER,
        TableFault.OLDER,
    )
    of_plate = {type(finding) for finding in after.verdict.failed} <= {
        OtherPlate,
        ChangedOrMarks,
    }
    return after.verdict.qualified or (named and of_plate)


def corrected(result: CalibrationResult) -> CalibrationResult:
    """Return a calibration of a plate whose stage is expected without error, as if corrected."""
    emap = result.error_map
    return replace(
        result,
        error_map=replace(
            emap, gx=0 * emap.gx, gy=0 * emap.gy, g_theta=0 * emap.g_theta
        ),
    )


@one_thread()
def verify(
    before: CalibrationResult,
    after: CalibrationResult,
    *,
    names: tuple[str, str] = ("before", "after"),
) -> Verification:
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
    known_nodes = np.isfinite(first.gx + first.gy + second.gx + second.gy)
    if known_nodes.sum() < 3:
        raise InputError(
            names[1],
            f"{int(known_nodes.sum())} nodes are known in both maps",
            "measure where the map is known",
        )
    maps = _maps(before, after, "xy", known_nodes)
    if not np.isfinite(maps.noise.covariance).all():
        raise InputError(
            names[0] if np.isfinite(second.u_gx[known_nodes]).all() else names[1],
            "has no uncertainty, so nothing can be verified",
            "solve it again with --uncertainty always",
        )
    fault = _fault(maps, first)
    shown = fault in (TableFault.FACTOR, TableFault.AXES_DIFFER)  # beyond 3 u of 1
    if maps.better and not maps.remains and not shown:
        fault = TableFault.NONE
    elif fault is TableFault.OTHER and (
        maps.better or maps.alike * abs(maps.alike) > SHARED
    ):
        fault = TableFault.OLDER
    axes = _axes(maps, (before, after))

    better, theta_fault = maps.better, TableFault.NONE
    lines = np.isfinite(first.g_theta + second.g_theta)
    g_theta = np.full(lines.shape, np.nan)
    if lines.sum() > 2:
        circle = _maps(before, after, "theta", lines)
        better = better and not circle.worse
        if circle.remains:
            theta_fault = _theta_fault(circle)
        g_theta[lines] = circle.after
        axes |= _axes(circle, (before, after))
    gx, gy = np.full((2, *known_nodes.shape), np.nan)
    gx[known_nodes], gy[known_nodes] = maps.by_axis(maps.after)
    return Verification(
        better=better,
        fault=fault,
        theta_fault=theta_fault,
        remains=maps.remains,
        axes=axes,
        alike=maps.alike,
        remaining=maps.remaining,
        gx=gx,
        gy=gy,
        g_theta=g_theta,
        without_scale=before.reference is not None and after.reference is None,
    )


def _maps(
    before: CalibrationResult,
    after: CalibrationResult,
    kind: str,
    known_places: np.ndarray,
) -> _Maps:
    """Return both maps over known places; scale is datum unless both have one."""
    pair = (before, after)
    keep_scale = all(result.reference is not None for result in pair)
    columns = datum_columns(before.artifact, kind, known_places, scale=not keep_scale)
    datum = np.linalg.qr(columns / np.linalg.norm(columns, axis=0))[0]
    values = [result.error_map.of(kind)[0][:, known_places].ravel() for result in pair]
    covers = [
        without(cover, datum)
        for cover in of_one_kind(
            [covariance_of(result, kind, known_places) for result in pair]
        )
    ]
    dof = joint_dof(
        *(
            (float(variances(cover).sum()), getattr(result.noise, f"dof_{kind}"))
            for cover, result in zip(covers, pair, strict=True)
        )
    )
    free = [
        values_of_map - datum @ (datum.T @ values_of_map) for values_of_map in values
    ]
    return _Maps(
        kind=kind,
        known=known_places,
        before=free[0],
        after=free[1],
        cover_before=covers[0],
        cover_after=covers[1],
        noise=ReducedNoise(covers[0] + covers[1], datum, dof),
    )


def _axes(
    maps: _Maps, pair: tuple[CalibrationResult, CalibrationResult]
) -> dict[str, AxisError]:
    """Return the errors of each axis before and after, with U and the factor."""
    u_before, u_after = (
        getattr(result.noise, f"k_{maps.kind}") * result.error_map.of(maps.kind)[1]
        for result in pair
    )
    before, after = maps.by_axis(maps.before), maps.by_axis(maps.after)
    return {
        name: AxisError(
            rms(before[axis]),
            rms(after[axis]),
            float(np.abs(before[axis]).max()),
            float(np.abs(after[axis]).max()),
            rms(u_before[axis, maps.known]),
            rms(u_after[axis, maps.known]),
            *maps.factors[axis],
        )
        for axis, name in enumerate(AXES[maps.kind])
    }


def _square(values: np.ndarray) -> float:
    return float((values**2).sum())


def _columns(field: np.ndarray) -> np.ndarray:
    """Return a field (axes, places) as a column for each axis, (values, axes)."""
    return block_diag(*field[:, :, None])


def _fault(maps: _Maps, emap: ErrorMap) -> TableFault:
    """Return what acts on x and y instead of the map."""
    if maps.too_small:
        return TableFault.TOO_SMALL
    if maps.explained:
        return _of_factors(maps.factors)
    unexplained = {}
    for fault, field_of in _arranged(emap.gx, emap.gy).items():
        arranged = np.stack(field_of)[:, maps.known]
        if np.isfinite(arranged).all():
            action = maps.noise.without(_columns(arranged))
            weights = np.linalg.lstsq(action, maps.action, rcond=None)[0]
            if _kind(weights[0], 0.0) or _kind(weights[1], 0.0):
                unexplained[fault] = maps.unexplained(action @ weights)
    likely = min(
        unexplained, key=lambda name: unexplained[name], default=TableFault.OTHER
    )
    return likely if unexplained.get(likely, np.inf) < NEAR else TableFault.OTHER


def _arranged(
    gx: np.ndarray, gy: np.ndarray
) -> dict[TableFault, tuple[np.ndarray, np.ndarray]]:
    """Return a map (nx, ny) as it acts with each fault of arrangement."""
    arrangements = {
        TableFault.COMPONENTS: (gy, gx),
        TableFault.MIRRORED_X: (gx[::-1], gy[::-1]),
        TableFault.MIRRORED_Y: (gx[:, ::-1], gy[:, ::-1]),
        TableFault.MIRRORED: (gx[::-1, ::-1], gy[::-1, ::-1]),
    }
    if gx.shape[0] == gx.shape[1]:
        arrangements |= {
            TableFault.PLACES: (gx.T, gy.T),
            TableFault.TRANSPOSED: (gy.T, gx.T),
        }
    return arrangements


def _kind(factor: float, u: float) -> TableFault | None:
    """Return what a factor says: None if it does not tell a correction from none."""
    if BEYOND * u >= max(1.0, abs(factor)):
        return None
    for value, kind in (
        (1.0, TableFault.NONE),
        (-1.0, TableFault.SIGN),
        (0.0, TableFault.OFF),
    ):
        if abs(factor - value) <= max(NEAR * abs(value), BEYOND * u):
            return kind
    return TableFault.FACTOR


def _of_factors(factors: list[tuple[float, float]]) -> TableFault:
    """Return what the factors of x and y say together."""
    kinds = {kind for factor in factors if (kind := _kind(*factor)) is not None}
    if not kinds:
        return TableFault.OTHER
    if TableFault.FACTOR not in kinds:
        return kinds.pop() if len(kinds) == 1 else TableFault.AXES_DIFFER
    kind_shown = [(value, u) for value, u in factors if _kind(value, u)]
    values, u = np.transpose(kind_shown)
    spread = float(values.max() - values.min())
    if spread <= max(NEAR * abs(values).max(), BEYOND * float(np.linalg.norm(u))):
        return TableFault.FACTOR
    return (
        TableFault.OLDER if abs(values - 1).max() < SHARED else TableFault.AXES_DIFFER
    )


def _theta_fault(maps: _Maps) -> TableFault:
    """Return what acts on the angle; NONE if too little is to be seen."""
    if maps.too_small:
        return TableFault.NONE
    if not maps.explained:
        return TableFault.OTHER
    return _kind(*maps.factors[0]) or TableFault.NONE
