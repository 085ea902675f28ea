# SPDX-License-Identifier: Apache-2.0
"""``selfcal gcode``: a program for a controller without tables, corrected."""

import argparse
import math
from dataclasses import replace

import numpy as np

from selfcal_ros.applications.controllers.gcode import (
    OF_SAMPLES,
    Rewriter,
    commented,
    corrected_program,
)
from selfcal_ros.applications.controllers.gcode_codes import DIALECTS
from selfcal_ros.applications.controllers.grid import ROUNDING_M, Wiring, nodes, wanted
from selfcal_ros.apply import StageMap
from selfcal_ros.cli.cal import ready
from selfcal_ros.cli.cal_lines import add_frame, frame_of
from selfcal_ros.cli.deliver import command, deliver
from selfcal_ros.cli.terminal import add_fill, add_json, add_result, file_of, warn
from selfcal_ros.compensation.export import origin_lines
from selfcal_ros.errors import InputError
from selfcal_ros.files import read_text
from selfcal_ros.model.error_map import ErrorMap
from selfcal_ros.outputs import check_outputs
from selfcal_ros.units import M_PER_UM, MM_PER_M


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    add = parser.add_argument
    add("program", metavar="IN", help="G-code")
    add_result(parser)
    add(
        "-o",
        "--output",
        metavar="OUT",
        required=True,
        help="program to write; - = stdout",
    )
    add(
        "--dialect",
        required=True,
        choices=DIALECTS,
        help="whose list of codes the program keeps",
    )
    add(
        "--tolerance",
        type=float,
        default=1.0,
        metavar="UM",
        help="largest distance of the corrected path from the programmed one, µm (default 1)",
    )
    add(
        "--decimals",
        type=int,
        default=5,
        metavar="N",
        help="decimals of coordinates in mm, one more in inches (default 5)",
    )
    add_fill(parser)
    add_json(parser)
    add_frame(parser, theta=False, units=("mm", "in"))


def step_of(error_map: ErrorMap, tolerance_m: float) -> float:
    """Return the distance of points between which the map bends by OF_SAMPLES of a tolerance.

    Where cells meet, the slope of the interpolated map changes by its second difference over the
    pitch. A line between points h apart is off that bend by at most a quarter of the change times
    h, for two components and two bends together.
    """
    bend_m = max(
        float(np.nanmax(np.abs(np.diff(part, 2, axis)), initial=0.0))
        for part in (error_map.gx, error_map.gy)
        for axis in (0, 1)
    )
    pitch_m = error_map.artifact.grid_pitch_m
    share = OF_SAMPLES * tolerance_m * 4 / (2 * math.sqrt(2) * max(bend_m, 1e-12))
    return pitch_m * min(1 / 32, share)


def run(args: argparse.Namespace) -> int:
    """Read program and result, write the program; code 5 and the reason if not qualified."""
    if not 0.001 <= args.tolerance <= 1e4 or not 1 <= args.decimals <= 9:
        raise InputError(
            "--tolerance, --decimals",
            f"{args.tolerance} µm, {args.decimals}",
            "give 0.001 to 10000 µm and 1 to 9 decimals",
        )
    if 10.0**-args.decimals * 1e3 > 2 * args.tolerance:
        raise InputError(
            "--decimals",
            f"{args.decimals} round by more than {args.tolerance:g} µm",
            "give more, or a larger --tolerance",
        )
    args.unit = args.unit or "mm"
    frame = replace(frame_of(args), unit="m")
    check_outputs([args.program, args.result], [file_of(args)])
    result, filled = ready(args)
    method = "bilinear" if filled else StageMap(result).method
    rewriter = Rewriter(
        wanted(result.error_map, Wiring(frame), method=method),
        dialect=args.dialect,
        tolerance_m=args.tolerance * M_PER_UM,
        step_m=step_of(result.error_map, args.tolerance * M_PER_UM),
        decimals=args.decimals,
    )
    text = read_text(args.program)
    if not text.strip():
        raise InputError(args.program, "the file is empty", "name a G-code program")
    program = corrected_program(text, args.program, rewriter)
    (x0, *_, x1), (y0, *_, y1) = nodes(result.error_map, frame)
    lowest, highest = rewriter.reach_m
    if rewriter.moves and (np.any(lowest > (x1, y1)) or np.any(highest < (x0, y0))):
        raise InputError(
            args.program,
            f"all moves lie outside the field ({_span(np.array([x0, y0]), np.array([x1, y1]))}): "
            f"{_span(lowest, highest)}",
            "give the program's zero with --home-x and --home-y; check its unit (G20, G21)",
        )
    warnings = [
        "moves leave the field, beyond which the correction at its edge is used, without U"
    ]
    if np.all(lowest >= (x0 - ROUNDING_M, y0 - ROUNDING_M)) and np.all(
        highest <= (x1 + ROUNDING_M, y1 + ROUNDING_M)
    ):
        warnings = []
    for line in warnings:
        warn(args, f"{args.program}: {line}")
    comments = [*origin_lines(result, command(args)), *warnings]
    return deliver(
        args,
        result,
        commented(program, comments),
        "program",
        filled=filled,
        moves=rewriter.moves,
        pieces=rewriter.pieces,
        note=f", {rewriter.moves} moves as {rewriter.pieces}",
    )


def _span(lowest_m: np.ndarray, highest_m: np.ndarray) -> str:
    """Return the extent of a field along x and y as text."""
    ends_mm = MM_PER_M * np.stack([lowest_m, highest_m], axis=1)
    return ", ".join(
        f"{axis} from {low:.6g} to {high:.6g} mm"
        for axis, (low, high) in zip("xy", ends_mm, strict=True)
    )
