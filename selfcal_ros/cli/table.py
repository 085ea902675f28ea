# SPDX-License-Identifier: Apache-2.0
"""``selfcal table``: the maps of a result as a CSV table or as numpy arrays."""

import argparse
import io
import math
from pathlib import Path

import numpy as np

from selfcal_ros.cli.arguments import STDOUT
from selfcal_ros.cli.deliver import csv_text, deliver
from selfcal_ros.cli.terminal import add_json, add_result, file_of
from selfcal_ros.errors import InputError
from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.outputs import check_outputs
from selfcal_ros.results import read_result

COLUMNS = (
    "m",
    "n",
    "x_m",
    "y_m",
    "gx_m",
    "gy_m",
    "u_gx_m",
    "u_gy_m",
    "k",
    "angle_rad",
    "g_theta_rad",
    "u_g_theta_rad",
)
KINDS = (".csv", ".npz")


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    add_result(parser)
    parser.add_argument(
        "-o",
        "--output",
        metavar="FILE.csv|.npz",
        required=True,
        help="table to write: a line for each site, then one for each angular "
        "line (csv, SI units, empty = unknown), or arrays (npz); - = csv to stdout",
    )
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Read the result, write the table to a file or to stdout.

    A result that is not qualified ends with code 5 and the reason on stderr, as in `solve`.
    """
    kind = ".csv" if args.output == STDOUT else Path(args.output).suffix.lower()
    if kind not in KINDS:
        raise InputError(
            args.output,
            "its suffix is not that of a table",
            "name a file that ends in " + " or ".join(KINDS) + ", or - for stdout",
        )
    check_outputs([args.result], [file_of(args)])
    result = read_result(args.result)
    content = csv_of(result) if kind == ".csv" else npz_bytes(result)
    return deliver(args, result, content, "csv", kind=kind.lstrip("."))


def csv_of(result: CalibrationResult) -> str:
    """Return the maps as CSV: nominal positions of sites and lines, errors, uncertainties."""
    emap, plate = result.error_map, result.artifact
    nx, ny = plate.shape
    parts = plate.x_m, plate.y_m, emap.gx, emap.gy, emap.u_gx, emap.u_gy
    rows: list[list[float | None]] = [
        [
            i - plate.middle[0],
            j - plate.middle[1],
            *(float(part[i, j]) for part in parts),
            *[None] * 4,
        ]
        for i in range(nx)
        for j in range(ny)
    ]
    for k in range(plate.angular_count):
        angle = 2 * math.pi * k / plate.angular_count
        errors = float(emap.g_theta[k]), float(emap.u_g_theta[k])
        rows.append([*[None] * 8, k, angle, *errors])
    return csv_text(COLUMNS, rows)


def npz_bytes(result: CalibrationResult) -> bytes:
    """Return the maps as arrays by the names of RESULT.json, [i, j] = site i - Nx//2, j - Ny//2."""
    emap, plate = result.error_map, result.artifact
    out = io.BytesIO()
    plate_marks = result.plate.marks
    marks = (
        {}
        if plate_marks is None
        else {
            "mark_id": plate_marks.id_array,
            "mark_x": plate_marks.places_m[0],
            "mark_y": plate_marks.places_m[1],
        }
    )
    np.savez(
        out,
        gx=emap.gx,
        gy=emap.gy,
        u_gx=emap.u_gx,
        u_gy=emap.u_gy,
        g_theta=emap.g_theta,
        u_g_theta=emap.u_g_theta,
        ax=result.artifact_map.ax,
        ay=result.artifact_map.ay,
        result=np.str_(" sha256:".join(result.read_from or ())),
        a_theta=result.artifact_map.a_theta,
        grid_pitch=np.float64(plate.grid_pitch_m),
        nonorthogonality=np.float64(emap.nonorthogonality),
        scale_difference=np.float64(emap.scale_difference),
        **marks,
    )
    return out.getvalue()
