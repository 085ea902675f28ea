# SPDX-License-Identifier: Apache-2.0
"""1D tables for accuracy, orthogonality and straightness.

An error is actual - commanded here, as shown by an interferometer or a dial indicator; the
correction is its opposite (Aerotech, 1D Axis Calibration). For an error map, whose
G = indicated - true already is the opposite, the correction is +G.
"""

import re
from dataclasses import dataclass
from typing import Literal

import numpy as np

from selfcal_ros.aerotech.export import DECIMALS, PRIMARY, micrometres, tidy
from selfcal_ros.aerotech.header import ArgumentFault
from selfcal_ros.aerotech.header import number as plain_number
from selfcal_ros.aerotech.model import Table1D
from selfcal_ros.compensation.frame import UNITS_M, MachineFrame
from selfcal_ros.errors import InputError
from selfcal_ros.files import csv_cells
from selfcal_ros.model.error_map import ErrorMap
from selfcal_ros.units import M_PER_NM, M_PER_UM

UNIFORM = 1e-6
"""Largest deviation of measured positions from equal distances, in distances."""
_LENGTH = re.compile(r"([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*(m|mm|um|µm|μm|nm)",
                     re.ASCII)
_LENGTH_UNITS_M = {**UNITS_M, "µm": M_PER_UM, "μm": M_PER_UM, "nm": M_PER_NM}

Home = Literal["end", "middle", "middle-balanced"]


@dataclass(frozen=True, eq=False)
class AxisCorrection:
    """A correction along one axis: positions ascending, both in m."""

    positions_m: np.ndarray
    corrections_m: np.ndarray


def length_m(text: str, what: str) -> float:
    """Return a length such as 5um or 200mm in m; InputError without number or unit."""
    match = _LENGTH.fullmatch(text.strip())
    if match is None or not np.isfinite(float(match[1])):
        raise InputError(what, f"'{text}' is not a length", "write a number with m, mm, um or nm")
    return float(match[1]) * _LENGTH_UNITS_M[match[2]]


def orthogonality(measured_m: float, over_m: float, travel_m: float,
                  home: Home = "end") -> AxisCorrection:
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
            raise InputError(name, f"{value:g} m is not a positive length", "give its amount")
    full = -measured_m / over_m * travel_m
    begin = 0.0 if home == "end" else -travel_m / 2
    first = -full / 2 if home == "middle-balanced" else 0.0
    return AxisCorrection(np.array([begin, begin + travel_m]), np.array([first, first + full]))


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
    lines = enumerate(text.splitlines(), 1)
    rows = [(number, csv_cells(line, f"{where}:{number}")) for number, line in lines
            if line.strip(", ")]
    if not rows or [cell.lower() for cell in rows[0][1]] != ["position", "error"]:
        raise InputError(f"{where}:1", "the header is not position,error",
                         "name the columns: position in primary units, error in um")
    values = []
    for number, row in rows[1:]:
        try:
            position, error = (plain_number(cell) for cell in row)
        except (ArgumentFault, ValueError):
            raise InputError(f"{where}:{number}", "not two numbers",
                             "give position,error") from None
        values.append((position * unit_m, -error * M_PER_UM))
    if len(values) < 2:
        raise InputError(where, f"{len(values)} measured positions", "give at least two")
    order = sorted(values)
    positions, corrections = np.array(order).T
    steps = np.diff(positions)
    if np.any(np.abs(steps - steps.mean()) > UNIFORM * steps.mean()) or steps.mean() <= 0:
        worst = int(np.argmax(np.abs(steps - steps.mean())))
        raise InputError(where, "the positions are not equidistant between "
                         f"{positions[worst] / unit_m:.9g} and {positions[worst + 1] / unit_m:.9g}",
                         "a table has one sample distance: measure at equal distances")
    return AxisCorrection(positions, corrections)


def map_line(error_map: ErrorMap, along: Literal["x", "y"],
             corrected: Literal["x", "y"]) -> AxisCorrection:
    """Return the correction +G of `corrected` along the middle line of an error map.

    `along` equal to `corrected` is accuracy, else straightness.

    Raises
    ------
    InputError
        If a site on the line is unknown.
    """
    artifact = error_map.artifact
    hx, hy = artifact.half
    line = (slice(None), hy) if along == "x" else (hx, slice(None))
    values = (error_map.gx if corrected == "x" else error_map.gy)[line]
    if not np.isfinite(values).all():
        raise InputError("error map", f"{int(np.isnan(values).sum())} sites on its {along} axis "
                         "are unknown", "measure them")
    return AxisCorrection((artifact.x_m if along == "x" else artifact.y_m)[line], values)


def map_orthogonality(error_map: ErrorMap, along: Literal["x", "y"]) -> AxisCorrection:
    """Return the two-point correction for the non-orthogonality O of an error map.

    Gx = O y and Gy = O x (Hu 6) are, apart from a rotation, an error 2 O x of y alone.

    Raises
    ------
    InputError
        If O is unknown.
    """
    if not np.isfinite(error_map.nonorthogonality):
        raise InputError("error map", "its non-orthogonality is not known",
                         "measure views that identify the stage, see selfcal plan check")
    artifact = error_map.artifact
    half = artifact.half[0 if along == "x" else 1] * artifact.grid_pitch_m
    ends = np.array([-half, half])
    return AxisCorrection(ends, 2 * error_map.nonorthogonality * ends)


def without_slope(line: AxisCorrection) -> AxisCorrection:
    """Return `line` without its least-squares straight line, as for straightness."""
    x, c = line.positions_m - line.positions_m.mean(), line.corrections_m
    return AxisCorrection(line.positions_m, c - c.mean() - x * (x @ c) / (x @ x))


def line_table(line: AxisCorrection, frame: MachineFrame, *, along: Literal["x", "y"],
               corrected: Literal["x", "y"]) -> Table1D:
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
    sign, unit_m = signs[along], frame.unit_m
    return Table1D(
        axes[corrected], tidy(sign * step / unit_m),
        np.round(signs[corrected] * line.corrections_m / M_PER_UM, DECIMALS) + 0.0,
        reference_axis=None if along == corrected else axes[along], pos_unit=PRIMARY,
        cor_unit=micrometres(unit_m), offset=tidy(-sign * first / unit_m))
