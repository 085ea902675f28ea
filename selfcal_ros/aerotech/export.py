# SPDX-License-Identifier: Apache-2.0
"""From an error map to calibration tables.

The correction that makes a commanded position true is c = +G = indicated - true (method,
section 1). Columns of the 2D table run along x, rows along y.
"""

import numpy as np

from selfcal_ros.aerotech.model import Table1D, Table2D, Unit, UnitWord
from selfcal_ros.compensation.frame import MachineFrame
from selfcal_ros.compensation.residual import require_known
from selfcal_ros.errors import InputError
from selfcal_ros.model.error_map import ErrorMap
from selfcal_ros.units import ARCSEC_PER_DEG, M_PER_UM, RAD_PER_ARCSEC

DECIMALS = 5
"""Digits of a correction in um: rounding stays below 0.005 nm."""
MAX_THETA_ROUNDING_M = 0.01e-9
"""Largest motion of a point on the field's edge by rounding of an angular correction."""
PRIMARY = Unit(UnitWord.PRIMARY)


def micrometres(unit_m: float) -> Unit:
    """Return the correction unit for micrometres with a primary unit of `unit_m` m."""
    return Unit(UnitWord.PRIMARY, tidy(unit_m / M_PER_UM))


def tidy(value: float) -> float:
    """Return `value` without rounding errors from a change of unit."""
    return float(f"{value:.14g}") + 0.0


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
    corrections = np.stack([frame.sign_x * error_map.gx.T, frame.sign_y * error_map.gy.T], axis=-1)
    return Table2D(
        frame.y_axis, frame.x_axis, (frame.x_axis, frame.y_axis), tidy(frame.sign_y * pitch),
        tidy(frame.sign_x * pitch), np.round(corrections / M_PER_UM, DECIMALS), PRIMARY,
        micrometres(unit_m), tidy(frame.sign_y * (hy + frame.home_y_m) / unit_m),
        tidy(frame.sign_x * (hx + frame.home_x_m) / unit_m))


def theta_decimals(error_map: ErrorMap) -> int:
    """Return the digits of an angular correction in arcsec required by the field's size."""
    artifact = error_map.artifact
    radius = np.hypot(*artifact.half) * artifact.grid_pitch_m
    digits = int(np.ceil(np.log10(0.5 * RAD_PER_ARCSEC * radius / MAX_THETA_ROUNDING_M)))
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
    count, g = error_map.artifact.angular_count, error_map.g_theta
    if frame.theta_axis is None:
        raise InputError("theta axis", "it is not named", "give its index")
    if not count:
        raise InputError("error map", "it has no angular lines", "leave out --theta-axis")
    if not np.isfinite(g).all():
        raise InputError("error map", f"{int(np.isnan(g).sum())} angular lines are unknown, and a "
                         "table has no holes", "measure them or leave out --theta-axis")
    counts = frame.theta_counts_per_unit
    lines = np.arange(0 if counts else -count, count + 1)
    sign, first = frame.sign_theta, float(lines[0]) * 360 / count
    return Table1D(
        frame.theta_axis, tidy(sign * 360 / count),
        np.round(sign * np.rad2deg(g[lines % count]) * ARCSEC_PER_DEG, theta_decimals(error_map)),
        pos_unit=PRIMARY, cor_unit=Unit(UnitWord.PRIMARY, ARCSEC_PER_DEG),
        offset=tidy(sign * (np.rad2deg(frame.home_theta_rad) - first)),
        rollover=tidy(360 * counts) if counts else None)
