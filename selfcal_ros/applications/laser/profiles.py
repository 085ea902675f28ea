# SPDX-License-Identifier: Apache-2.0
"""Profiles, straightness and squareness from the errors of the blocks (method eq. 9.8).

Definitions
-----------
Profile P[j, c]: error in direction c at the end of every block of axis j, from 0 at the start,
over the nominal positions 0, step, ..., n step. Straightness: peak to valley of a transverse
profile about its line. Squareness of axes j < c: (slope of P[c, j] over axis c + slope of P[j, c]
over axis j) times the range of axis c; it is the inclination of axis c towards +j relative to a
perfect square on axis j, so positive means an angle below 90°. It does not depend on the
orientation of the machine.
The line is the least-squares line (default) or the line through both ends.

An error here is E = actual - nominal; that of an error map is G = indicated - true = -E. Positions
are relative to the start of the first block.
"""

from dataclasses import dataclass
from enum import StrEnum
from typing import Literal

import numpy as np

from selfcal_ros.applications.laser.data import AXES, Method, StepDiagonalResult
from selfcal_ros.errors import InputError


class ReferenceLine(StrEnum):
    """Reference line of a profile."""

    LEAST_SQUARES = "lsq"
    END_POINTS = "end"


@dataclass(frozen=True)
class Value:
    """A quantity with its standard uncertainty (k=1), in the same unit; None if unknown."""

    value: float
    u: float | None = None


def positions_m(result: StepDiagonalResult, axis: int) -> np.ndarray:
    """Return the nominal positions of the ends of the blocks, (n+1,), m, from 0."""
    return np.arange(result.n_blocks + 1) * result.steps_m[axis]


def profile_m(result: StepDiagonalResult, axis: int, direction: int) -> np.ndarray:
    """Return the accumulated error in `direction` along `axis`, (n+1,), m, 0 at the start."""
    return np.concatenate([[0.0], np.cumsum(result.errors_m[axis, :, direction])])


def has_u(result: StepDiagonalResult, axis: int, direction: int) -> bool:
    """Return whether the uncertainty of an error is known.

    The conventional formulation takes the mirror's angle for a linear error, whatever the scatter.
    """
    derived = result.method == Method.CONVENTIONAL and axis == direction
    return result.covariance is not None and not derived


def u_profile_m(
    result: StepDiagonalResult, axis: int, direction: int
) -> np.ndarray | None:
    """Return the standard uncertainty of the profile, (n+1,), m; None if unknown."""
    if not has_u(result, axis, direction):
        return None
    rows = _accumulate(result.n_blocks)
    block = _block(result, (axis, direction), (axis, direction))
    return np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", rows, block, rows), 0.0))


def straightness(
    result: StepDiagonalResult,
    axis: int,
    direction: int,
    line: ReferenceLine = ReferenceLine.LEAST_SQUARES,
) -> Value:
    """Return the straightness of `axis` in `direction`, m.

    Its uncertainty is that of the distance between the two extreme points; as a peak-to-valley
    value it is biased upwards unless the noise is much smaller.
    """
    rows = _accumulate(result.n_blocks) - np.outer(
        np.arange(result.n_blocks + 1), _slope_row(result.n_blocks, line)
    )
    residual = rows @ result.errors_m[axis, :, direction]
    row = rows[np.argmax(residual)] - rows[np.argmin(residual)]
    value = float(np.ptp(residual))
    if result.covariance is None:
        return Value(value)
    block = _block(result, (axis, direction), (axis, direction))
    return Value(value, float(np.sqrt(max(row @ block @ row, 0.0))))


def slope(
    result: StepDiagonalResult,
    axis: int,
    direction: int,
    line: ReferenceLine = ReferenceLine.LEAST_SQUARES,
) -> float:
    """Return the slope of a profile: rad for a transverse one, relative for a linear one."""
    row = _slope_row(result.n_blocks, line) / result.steps_m[axis]
    return float(row @ result.errors_m[axis, :, direction])


def u_slope(result: StepDiagonalResult, axis: int, direction: int) -> float | None:
    """Return the standard uncertainty of a least-squares `slope`; None if unknown."""
    if result.covariance is None:
        return None
    row = _slope_row(result.n_blocks, ReferenceLine.LEAST_SQUARES)
    row = row / result.steps_m[axis]
    block = _block(result, (axis, direction), (axis, direction))
    return float(np.sqrt(max(row @ block @ row, 0.0)))


def squareness(
    result: StepDiagonalResult,
    first: int = 0,
    second: int = 1,
    line: ReferenceLine = ReferenceLine.LEAST_SQUARES,
) -> Value:
    """Return the squareness of two axes over the range of the second, m (sign: see above)."""
    row = _slope_row(result.n_blocks, line)
    of_first = row * result.steps_m[second] / result.steps_m[first] * result.n_blocks
    of_second = row * result.n_blocks
    value = float(
        of_second @ result.errors_m[second, :, first]
        + of_first @ result.errors_m[first, :, second]
    )
    if result.covariance is None:
        return Value(value)
    a, b = (second, first), (first, second)
    variance = (
        of_second @ _block(result, a, a) @ of_second
        + of_first @ _block(result, b, b) @ of_first
        + 2 * of_second @ _block(result, a, b) @ of_first
    )
    return Value(value, float(np.sqrt(max(variance, 0.0))))


def squareness_rad(
    result: StepDiagonalResult, line: ReferenceLine = ReferenceLine.LEAST_SQUARES
) -> float:
    """Return the squareness of X and Y as an angle, rad: 90° minus that between the axes."""
    return slope(result, 1, 0, line) + slope(result, 0, 1, line)


def axis_pairs(dim: int) -> list[tuple[int, int]]:
    """Return the pairs of axes j < c."""
    return [(j, c) for j in range(dim) for c in range(j + 1, dim)]


def name_of(axis: int, direction: int) -> str:
    """Return the name of an error: ``ey_x`` is the error in Y of the motion along X."""
    return f"e{AXES[direction]}_{AXES[axis]}"


def _accumulate(n: int) -> np.ndarray:
    """Return the matrix from block errors to profile points, (n+1, n)."""
    return np.tri(n + 1, n, -1)


def _slope_row(n: int, line: ReferenceLine) -> np.ndarray:
    """Return the row from block errors to the slope of their profile, per block."""
    if line is ReferenceLine.END_POINTS:
        return np.full(n, 1.0 / n)
    centred = np.arange(n + 1) - n / 2
    return (centred / (centred @ centred)) @ _accumulate(n)


def _block(
    result: StepDiagonalResult, row_kind: tuple[int, int], column_kind: tuple[int, int]
) -> np.ndarray:
    """Return the covariance between two kinds (axis, direction) of errors, (n, n)."""
    assert result.covariance is not None, (
        "asked for where nothing is known of the noise"
    )
    dim, n = result.dim, result.n_blocks
    shaped = result.covariance.reshape(dim, n, dim, dim, n, dim)
    return shaped[row_kind[0], :, row_kind[1], column_kind[0], :, column_kind[1]]


Axis = Literal["x", "y"]


@dataclass(frozen=True)
class MapEquivalent:
    """First-order terms of an error map (Hu eq. 6) from the laser.

    Attributes
    ----------
    nonorthogonality, u_nonorthogonality : float, float or None
        O and its standard uncertainty: Gx = O y, Gy = O x, so that the squareness is -2 O.
    scale_difference, u_scale_difference : float or None
        R: Gx = R x, Gy = -R y, half the difference of the slopes of -Ey(y) and -Ex(x); None if
        the linear errors are not measured but derived from the diagonals.
    """

    nonorthogonality: float
    u_nonorthogonality: float | None
    scale_difference: float | None = None
    u_scale_difference: float | None = None


def map_equivalent(result: StepDiagonalResult) -> MapEquivalent:
    """Return O and R of an error map with this squareness and these linear errors."""
    u = squareness(result).u
    span = result.steps_m[1] * result.n_blocks
    o = -squareness_rad(result) / 2
    u_o = None if u is None else u / span / 2
    if result.method != Method.NEW:
        return MapEquivalent(o, u_o)
    u_x, u_y = (u_slope(result, axis, axis) for axis in (0, 1))
    u_r = None if u_x is None or u_y is None else float(np.hypot(u_x, u_y) / 2)
    return MapEquivalent(o, u_o, (slope(result, 1, 1) - slope(result, 0, 0)) / 2, u_r)


def axis_corrections(
    result: StepDiagonalResult,
) -> dict[tuple[Axis, Axis], tuple[np.ndarray, np.ndarray]]:
    """Return (along, corrected) -> positions and corrections -E, m, of every profile of X and Y.

    The datum is rotated from the first X step to the line of the X axis: the correction of Y along
    x is the straightness of X alone, and that of X along y contains straightness and squareness.
    Linear errors are corrected only if they were measured (new formulation).

    Raises
    ------
    InputError
        For a 3D measurement: the tables of the package have no Z axis.
    """
    if result.dim != 2:
        raise InputError(
            "calibration table",
            "body diagonals measure three axes, the tables hold x and y",
            "export a measurement of face diagonals",
        )
    x, y = (positions_m(result, axis) for axis in (0, 1))
    turn = slope(result, 0, 1)
    lines: dict[tuple[Axis, Axis], tuple[np.ndarray, np.ndarray]] = {
        ("x", "y"): (x, turn * x - profile_m(result, 0, 1)),
        ("y", "x"): (y, -turn * y - profile_m(result, 1, 0)),
    }
    if result.method == Method.NEW:
        lines["x", "x"] = x, -profile_m(result, 0, 0)
        lines["y", "y"] = y, -profile_m(result, 1, 1)
    return lines
