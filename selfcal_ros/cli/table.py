# SPDX-License-Identifier: Apache-2.0
"""``selfcal table``: the maps of a result as a CSV table or as numpy arrays."""

import argparse
import io
import math
from pathlib import Path

import numpy as np

from selfcal_ros.cli.arguments import STDOUT
from selfcal_ros.cli.deliver import deliver
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
    content = csv_bytes(result) if kind == ".csv" else npz_bytes(result)
    return deliver(args, result, content, "csv", kind=kind.lstrip("."))


def csv_bytes(result: CalibrationResult) -> bytes:
    """Return the maps as CSV: nominal positions of sites and lines, errors, uncertainties."""
    emap, plate = result.error_map, result.artifact
    rows = [",".join(COLUMNS)]
    x_m = plate.x_m
    y_m = plate.y_m
    for i, j in ((i, j) for i in range(plate.shape[0]) for j in range(plate.shape[1])):
        m, n = i - plate.middle[0], j - plate.middle[1]
        cells = [
            m,
            n,
            *(
                float(part[i, j])
                for part in (x_m, y_m, emap.gx, emap.gy, emap.u_gx, emap.u_gy)
            ),
        ]
        rows.append(",".join([*map(_cell, cells), "", "", "", ""]))
    for k in range(plate.angular_count):
        cells = [
            k,
            2 * math.pi * k / plate.angular_count,
            emap.g_theta[k],
            emap.u_g_theta[k],
        ]
        rows.append("," * 8 + ",".join(map(_cell, cells)))
    return ("\n".join(rows) + "\n").encode()


def _cell(value: float) -> str:
    return (
        str(value)
        if isinstance(value, int)
        else ""
        if value != value
        else repr(float(value))
    )


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
