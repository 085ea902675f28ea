# SPDX-License-Identifier: Apache-2.0
"""``selfcal apply``: commands for true positions, or true positions of indicated ones."""

import argparse
import sys

import numpy as np

from selfcal_ros.apply import StageMap, load
from selfcal_ros.cli.deliver import deliver
from selfcal_ros.cli.terminal import add_json, file_of
from selfcal_ros.compensation.compensator import Compensator
from selfcal_ros.errors import InputError
from selfcal_ros.files import csv_cells, read_text
from selfcal_ros.model.error_map import rms
from selfcal_ros.outputs import check_outputs
from selfcal_ros.units import UM_PER_M

AXES = ("x", "y", "theta")
ENDS = ("x1", "y1", "x2", "y2")


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    parser.add_argument("result", metavar="RESULT.json", help="result that `selfcal solve` wrote")
    parser.add_argument("points", metavar="POINTS.csv",
                        help="columns x,y or x,y,theta in m and rad, stage frame; x1,y1,x2,y2: "
                             "the error of the distance between two points")
    parser.add_argument("-o", "--output", metavar="OUT.csv", required=True,
                        help="table to write: the points, the corrected ones, and their standard "
                             "uncertainties (empty = unknown); - = stdout")
    parser.add_argument("--inverse", action="store_true",
                        help="the points are indicated positions: give the true ones")
    parser.add_argument("--method", choices=("bilinear", "bicubic"),
                        help="interpolation between the nodes (default: that of the map; "
                             "bilinear on the plate's lattice, or if nodes are unknown)")
    parser.add_argument("--outside", choices=("clamp", "refuse"), default="clamp",
                        help="outside the field: use the error at its edge, or refuse (default "
                             "clamp)")
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Read result and points, write the corrected points.

    A result that is not qualified ends with code 5 and the reason on stderr, as in `solve`.
    """
    check_outputs([args.result, args.points], [file_of(args)])
    stage = load(args.result, method=args.method, outside=args.outside)
    points = read_points(read_text(args.points), args.points)
    if points.shape[1] == len(ENDS):
        text, unknown, outside = distances(stage, points, inverse=args.inverse)
    else:
        text, unknown, outside = corrected(stage, points, inverse=args.inverse)
    _say_better(stage, points)
    for count, what in ((outside, "outside the field, corrected as the nearest point of its edge"),
                        (unknown, "next to unknown sites or lines, left empty")):
        if count:
            print(f"selfcal apply: points {what}: {count}", file=sys.stderr)
    return deliver(args, stage.result, text, "csv", note=f", {len(points)} points",
                   points=len(points), unknown=unknown, outside=outside)


def _say_better(stage: "StageMap", points: "np.ndarray") -> None:
    """Recommend bicubic interpolation if it at least halves u between the nodes."""
    emap, used = stage.error_map, rms(stage.halfway)
    x, y = points[:, :2].T
    plain = np.array(stage.uncertainty(x, y)) if used else np.zeros(1)
    if stage.method == "bicubic" or not emap.valid.all() \
            or not rms(plain) > 2 * rms(np.stack([emap.u_gx, emap.u_gy])):
        return
    cubic = rms(Compensator(emap, method="bicubic").halfway)
    if cubic < used / 2:
        print("selfcal apply: between the nodes u is mostly that of bilinear interpolation, "
              f"{used * UM_PER_M:.2g} um halfway; with --method bicubic {cubic * UM_PER_M:.2g} um",
              file=sys.stderr)


def read_points(text: str, where: str) -> "np.ndarray":
    """Return the points of a table x,y[,theta] or x1,y1,x2,y2, (P, 2 to 4).

    Raises
    ------
    InputError
        For another header, or a line that is not as many finite numbers.
    """
    rows = [(number, csv_cells(line, f"{where}:{number}"))
            for number, line in enumerate(text.splitlines(), 1) if line.strip(", ")]
    head = [cell.lower() for cell in rows[0][1]] if rows else []
    if tuple(head) not in (AXES, AXES[:2], ENDS):
        raise InputError(f"{where}:1", "the header is not x,y or x,y,theta or x1,y1,x2,y2",
                         "name the columns; positions in m and rad")
    points = np.empty((len(rows) - 1, len(head)))
    for index, (number, cells) in enumerate(rows[1:]):
        try:
            points[index] = list(map(float, cells)) if len(cells) == len(head) else np.nan
        except ValueError:
            points[index] = np.nan
        if not np.abs(points[index]).max() < 1e12:
            raise InputError(f"{where}:{number}", f"not {len(head)} positions",
                             f"give {','.join(head)} in m and rad")
    if not len(points):
        raise InputError(where, "it has no points", "give at least one")
    return points


def corrected(stage: "StageMap", points: "np.ndarray", *, inverse: bool) -> tuple[str, int, int]:
    """Return the table of corrected points, and how many are unknown and outside the field."""
    names, what = AXES[:points.shape[1]], "true" if inverse else "command"
    x, y, *theta = points.T
    found = list(stage.correct(x, y) if inverse else stage.command(x, y))
    at = found if inverse else [x, y]  # u is that of the map at the true position
    u = list(stage.uncertainty(at[0], at[1]))
    if theta:
        found.append((stage.correct_theta if inverse else stage.command_theta)(theta[0]))
        u.append(stage.uncertainty_theta(found[2] if inverse else theta[0]))
    rows = np.column_stack([points, *found, *u])
    head = [*names, *(f"{name}_{what}" for name in names), *(f"u_{name}" for name in names)]
    lines = [",".join("" if cell != cell else repr(cell) for cell in row) for row in rows.tolist()]
    unknown = int(np.isnan(found).any(axis=0).sum())
    return "\n".join([",".join(head), *lines]) + "\n", unknown, int((~stage.inside(x, y)).sum())


def distances(stage: "StageMap", points: "np.ndarray", *, inverse: bool) -> tuple[str, int, int]:
    """Return the table of distances with their errors, as `corrected`; and a line over length."""
    if inverse:
        raise InputError("--inverse", "the ends of distances are true positions", "leave it out")
    x1, y1, x2, y2 = points.T
    error, u = stage.length_error((x1, y1), (x2, y2))
    rows = np.column_stack([points, np.hypot(x2 - x1, y2 - y1), error, u]).tolist()
    for where, anywhere in (("anywhere in the field", True), ("of two nodes", False)):
        a, b = stage.length_uncertainty(anywhere=anywhere)
        print(f"selfcal apply: U of a distance L {where} is at most {a * UM_PER_M:.3g} um + "
              f"{b * UM_PER_M:.3g} um/m L (k = {stage.result.noise.k_xy:.3g}, 95.45 %)",
              file=sys.stderr)
    outside = ~(stage.inside(x1, y1) & stage.inside(x2, y2))
    lines = [",".join(map(repr, row)) for row in rows]
    return ("\n".join([",".join([*ENDS, "length", "error", "u"]), *lines]) + "\n", 0,
            int(outside.sum()))
