# SPDX-License-Identifier: Apache-2.0
"""From an error map, a precision square or measured errors to calibration tables.

The correction that makes a commanded position true is c = +G = indicated - true (method,
section 1). Columns of the 2D table run along x, rows along y.
"""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from selfcal_ros.applications.aerotech.header import ArgumentFault
from selfcal_ros.applications.aerotech.header import number as plain_number
from selfcal_ros.applications.aerotech.model import Table1D, Table2D, Unit, UnitWord
from selfcal_ros.compensation.export import tidy
from selfcal_ros.compensation.frame import MachineFrame
from selfcal_ros.compensation.residual import require_known
from selfcal_ros.errors import InputError
from selfcal_ros.files import csv_rows
from selfcal_ros.model.error_map import ErrorMap
from selfcal_ros.plain_numbers import quantity_of
from selfcal_ros.units import ARCSEC_PER_DEG, M_PER, M_PER_UM, RAD_PER_ARCSEC

DECIMALS = 5
"""Digits of a correction in um: rounding stays below 0.005 nm."""
MAX_THETA_ROUNDING_M = 0.01e-9
"""Largest motion of a point on the field's edge by rounding of an angular correction."""
PRIMARY = Unit(UnitWord.PRIMARY)


def micrometres(unit_m: float) -> Unit:
    """Return the correction unit for micrometres with a primary unit of `unit_m` m."""
    return Unit(UnitWord.PRIMARY, tidy(unit_m / M_PER_UM))


def table_xy(error_map: ErrorMap, frame: MachineFrame) -> Table2D:
    """Return the 2D table that corrects x and y.

    A reversed encoder gives a negative sample distance and corrections of opposite sign, so
    that the table follows the sign of the encoder.

    Raises
    ------
    InputError
        If a site is unknown: a table has no holes.
    """
    require_known(error_map)
    artifact, unit_m = error_map.artifact, frame.unit_m
    hx, hy = (half * artifact.grid_pitch_m for half in artifact.half)
    pitch = artifact.grid_pitch_m / unit_m
    corrections = np.stack(
        [frame.sign_x * error_map.gx.T, frame.sign_y * error_map.gy.T], axis=-1
    )
    return Table2D(
        frame.y_axis,
        frame.x_axis,
        (frame.x_axis, frame.y_axis),
        sample_row=tidy(frame.sign_y * pitch),
        sample_col=tidy(frame.sign_x * pitch),
        values=np.round(corrections / M_PER_UM, DECIMALS),
        pos_unit=PRIMARY,
        cor_unit=micrometres(unit_m),
        offset_row=tidy(frame.sign_y * (hy + frame.home_y_m) / unit_m),
        offset_col=tidy(frame.sign_x * (hx + frame.home_x_m) / unit_m),
    )


def theta_decimals(error_map: ErrorMap) -> int:
    """Return the digits of an angular correction in arcsec required by the field's size."""
    artifact = error_map.artifact
    radius = np.hypot(*artifact.half) * artifact.grid_pitch_m
    digits = int(
        np.ceil(np.log10(0.5 * RAD_PER_ARCSEC * radius / MAX_THETA_ROUNDING_M))
    )
    return max(DECIMALS, digits + 1)


def table_theta(error_map: ErrorMap, frame: MachineFrame) -> Table1D:
    """Return the 1D table that corrects theta.

    With known counts per degree it covers one turn and rolls over; without them the
    format cannot express the roll-over, and the table covers a turn in either direction.

    Raises
    ------
    InputError
        If the frame has no theta axis, or the map has unknown angular lines or none.
    """
    count = error_map.artifact.angular_count
    g = error_map.g_theta
    if frame.theta_axis is None:
        raise InputError("theta axis", "it is not named", "give its index")
    if not count:
        raise InputError(
            "error map", "it has no angular lines", "leave out --theta-axis"
        )
    if not np.isfinite(g).all():
        raise InputError(
            "error map",
            f"{int(np.isnan(g).sum())} angular lines are unknown, and a table has no holes",
            "measure them or leave out --theta-axis",
        )
    counts = frame.theta_counts_per_unit
    lines = np.arange(0 if counts else -count, count + 1)
    sign = frame.sign_theta
    first = float(lines[0]) * 360 / count
    return Table1D(
        frame.theta_axis,
        tidy(sign * 360 / count),
        np.round(
            sign * np.rad2deg(g[lines % count]) * ARCSEC_PER_DEG,
            theta_decimals(error_map),
        ),
        pos_unit=PRIMARY,
        cor_unit=Unit(UnitWord.PRIMARY, ARCSEC_PER_DEG),
        offset=tidy(sign * (np.rad2deg(frame.home_theta_rad) - first)),
        rollover=tidy(360 * counts) if counts else None,
    )


UNIFORM = 1e-6
"""Largest deviation of measured positions from equal distances, in distances."""

Home = Literal["end", "middle", "middle-balanced"]


@dataclass(frozen=True, eq=False)
class AxisCorrection:
    """A correction along one axis: positions ascending, both in m."""

    positions_m: np.ndarray
    corrections_m: np.ndarray


def length_m(text: str, where: str) -> float:
    """Return a length such as 5um or 200mm in m; InputError without number or unit."""
    try:
        value, unit = quantity_of(text, M_PER)
    except ValueError:
        value, unit = math.nan, ""
    if not unit or not math.isfinite(value):
        raise InputError(
            where, f"'{text}' is not a length", "write a number with m, mm, um or nm"
        )
    return value


def orthogonality(
    measured_m: float, over_m: float, travel_m: float, home: Home = "end"
) -> AxisCorrection:
    """Return the two-point correction for axes that are not perpendicular.

    Parameters
    ----------
    measured_m : float
        Error shown by the indicator, m, with its sign.
    over_m : float
        Length of the square over which it was measured, m.
    travel_m : float
        Full travel of the reference axis, m.
    home : {"end", "middle", "middle-balanced"}
        Its home position; balanced means opposite corrections at both ends.

    Raises
    ------
    InputError
        If a length is not positive.
    """
    for name, value in (("--over", over_m), ("--travel", travel_m)):
        if not value > 0:
            raise InputError(
                name, f"{value:g} m is not a positive length", "give its amount"
            )
    full = -measured_m / over_m * travel_m
    begin = 0.0 if home == "end" else -travel_m / 2
    first = -full / 2 if home == "middle-balanced" else 0.0
    return AxisCorrection(
        np.array([begin, begin + travel_m]), np.array([first, first + full])
    )


def measured_line(text: str, where: str, unit_m: float) -> AxisCorrection:
    """Return the correction for errors measured along an axis.

    Parameters
    ----------
    text : str
        CSV with the header ``position,error``: position in primary units of `unit_m` m,
        error = actual - commanded in um.
    where : str
        File name, for messages.
    unit_m : float
        Metres in a primary unit.

    Raises
    ------
    InputError
        For another header, a value that is not a number, or positions that are not equidistant.
    """
    rows = csv_rows(text, where)
    if not rows or [cell.lower() for cell in rows[0][1]] != ["position", "error"]:
        raise InputError(
            rows[0][0] if rows else f"{where}:1",
            "the header is not position,error",
            "begin with it: position in primary units, error in um",
        )
    values = []
    for place, row in rows[1:]:
        try:
            position, error = (plain_number(cell) for cell in row)
        except (ArgumentFault, ValueError):
            raise InputError(place, "not two numbers", "give position,error") from None
        values.append((position * unit_m, -error * M_PER_UM))
    if len(values) < 2:
        raise InputError(
            where, f"{len(values)} measured positions", "give at least two"
        )
    order = sorted(values)
    positions, corrections = np.array(order).T
    steps = np.diff(positions)
    if (
        np.any(np.abs(steps - steps.mean()) > UNIFORM * steps.mean())
        or steps.mean() <= 0
    ):
        worst = int(np.argmax(np.abs(steps - steps.mean())))
        raise InputError(
            where,
            "the positions are not equidistant between "
            f"{positions[worst] / unit_m:.9g} and {positions[worst + 1] / unit_m:.9g}",
            "a table has one sample distance: measure at equal distances",
        )
    return AxisCorrection(positions, corrections)


def map_line(
    error_map: ErrorMap, along: Literal["x", "y"], corrected: Literal["x", "y"]
) -> AxisCorrection:
    """Return the correction +G of `corrected` along the middle line of an error map.

    Between an even number of lines that is the mean of the two in the middle.
    `along` equal to `corrected` is accuracy, else straightness.

    Raises
    ------
    InputError
        If a site on the line is unknown.
    """
    artifact = error_map.artifact
    across, positions = (
        (1, artifact.x_m[:, 0]) if along == "x" else (0, artifact.y_m[0])
    )
    field = error_map.gx if corrected == "x" else error_map.gy
    size = artifact.shape[across]
    values = (field.take((size - 1) // 2, across) + field.take(size // 2, across)) / 2
    if not np.isfinite(values).all():
        raise InputError(
            "error map",
            f"{int(np.isnan(values).sum())} sites on its {along} axis are unknown",
            "measure them",
        )
    return AxisCorrection(positions, values)


def map_orthogonality(error_map: ErrorMap, along: Literal["x", "y"]) -> AxisCorrection:
    """Return the two-point correction for the non-orthogonality O of an error map.

    Gx = O y and Gy = O x (Hu 6) are, apart from a rotation, an error 2 O x of y alone.

    Raises
    ------
    InputError
        If O is unknown.
    """
    if not np.isfinite(error_map.nonorthogonality):
        raise InputError(
            "error map",
            "its non-orthogonality is not known",
            "measure views that identify the stage, see selfcal plan check",
        )
    artifact = error_map.artifact
    half = artifact.half[0 if along == "x" else 1] * artifact.grid_pitch_m
    ends = np.array([-half, half])
    return AxisCorrection(ends, 2 * error_map.nonorthogonality * ends)


def without_slope(line: AxisCorrection) -> AxisCorrection:
    """Return `line` without its least-squares straight line, as for straightness."""
    x = line.positions_m - line.positions_m.mean()
    c = line.corrections_m
    return AxisCorrection(line.positions_m, c - c.mean() - x * (x @ c) / (x @ x))


def line_table(
    line: AxisCorrection,
    frame: MachineFrame,
    *,
    along: Literal["x", "y"],
    corrected: Literal["x", "y"],
) -> Table1D:
    """Return the 1D table of a line, in the controller's coordinates.

    Parameters
    ----------
    line : AxisCorrection
        Positions and corrections in the stage frame.
    frame : MachineFrame
        The machine's axes.
    along, corrected : {"x", "y"}
        Reference axis and corrected axis.
    """
    axes = {"x": frame.x_axis, "y": frame.y_axis}
    signs = {"x": frame.sign_x, "y": frame.sign_y}
    homes = {"x": frame.home_x_m, "y": frame.home_y_m}
    step = (line.positions_m[-1] - line.positions_m[0]) / (len(line.positions_m) - 1)
    first = line.positions_m[0] - homes[along]
    sign = signs[along]
    unit_m = frame.unit_m
    return Table1D(
        axes[corrected],
        tidy(sign * step / unit_m),
        np.round(signs[corrected] * line.corrections_m / M_PER_UM, DECIMALS) + 0.0,
        reference_axis=None if along == corrected else axes[along],
        pos_unit=PRIMARY,
        cor_unit=micrometres(unit_m),
        offset=tidy(-sign * first / unit_m),
    )
