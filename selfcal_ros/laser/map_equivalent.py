# SPDX-License-Identifier: Apache-2.0
"""What a step-diagonal measurement tells the rest of the package: scale, O and R, corrections.

An error here is E = actual - nominal; an error map's is G = indicated - true = -E. Positions count
from the start of the first block.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from selfcal_ros.compensation.aerotech.lines import AxisCorrection, line_table
from selfcal_ros.compensation.aerotech.model import Table1D
from selfcal_ros.compensation.machine import MachineFrame
from selfcal_ros.errors import InputError
from selfcal_ros.laser.data import Method, StepDiagonalResult
from selfcal_ros.laser.profiles import (
    positions_m,
    profile_m,
    slope,
    squareness,
    squareness_rad,
    u_slope,
)

Axis = Literal["x", "y"]


@dataclass(frozen=True)
class MapEquivalent:
    """First-order parts of an error map (Hu eq. 6) as the laser sees them.

    Attributes
    ----------
    nonorthogonality, u_nonorthogonality : float, float or None
        O and its standard uncertainty: Gx = O y, Gy = O x, so that the squareness is -2 O.
    scale_difference, u_scale_difference : float or None
        R: Gx = R x, Gy = -R y, half the difference of the slopes of -Ey(y) and -Ex(x); None where
        the linear errors are not measured but guessed from the diagonals.
    """

    nonorthogonality: float
    u_nonorthogonality: float | None
    scale_difference: float | None = None
    u_scale_difference: float | None = None


def map_equivalent(found: StepDiagonalResult) -> MapEquivalent:
    """Return O and R of an error map that has this squareness and these linear errors."""
    u = squareness(found).u
    span = found.steps_m[1] * found.n_blocks
    o = -squareness_rad(found) / 2
    u_o = None if u is None else u / span / 2
    if found.method != Method.NEW:
        return MapEquivalent(o, u_o)
    u_x, u_y = (u_slope(found, axis, axis) for axis in (0, 1))
    u_r = None if u_x is None or u_y is None else float(np.hypot(u_x, u_y) / 2)
    return MapEquivalent(o, u_o, (slope(found, 1, 1) - slope(found, 0, 0)) / 2, u_r)


def axis_corrections(found: StepDiagonalResult) -> dict[tuple[Axis, Axis], AxisCorrection]:
    """Return (along, corrected) -> correction -E, m, of every profile of X and Y.

    The datum is turned from the first X step to the line of the X axis: the correction of Y along x
    is the straightness of X alone, and that of X along y holds straightness and squareness. Linear
    errors are corrected only where they were measured (new formulation).

    Raises
    ------
    InputError
        For a 3D measurement, whose Z axis the tables of the package do not know.
    """
    if found.dim != 2:
        raise InputError("calibration table", "body diagonals measure three axes, the tables hold "
                         "x and y", "export a measurement of face diagonals")
    x, y = (positions_m(found, axis) for axis in (0, 1))
    turn = slope(found, 0, 1)
    lines: dict[tuple[Axis, Axis], AxisCorrection] = {
        ("x", "y"): AxisCorrection(x, turn * x - profile_m(found, 0, 1)),
        ("y", "x"): AxisCorrection(y, -turn * y - profile_m(found, 1, 0))}
    if found.method == Method.NEW:
        lines[("x", "x")] = AxisCorrection(x, -profile_m(found, 0, 0))
        lines[("y", "y")] = AxisCorrection(y, -profile_m(found, 1, 1))
    return lines


def correction_tables(found: StepDiagonalResult, frame: MachineFrame) -> list[Table1D]:
    """Return the 1D tables of all corrections, in the controller's coordinates.

    Parameters
    ----------
    found : StepDiagonalResult
        Result of a 2D measurement.
    frame : MachineFrame
        The machine's axes; its home is counted from the start of the first block.
    """
    return [line_table(line, frame, along=along, corrected=corrected)
            for (along, corrected), line in sorted(axis_corrections(found).items())]
