# SPDX-License-Identifier: Apache-2.0
"""``selfcal plate``: artwork of the plate of a plan, true to size."""

import argparse

from selfcal_ros.cli.terminal import add_json, say
from selfcal_ros.errors import ExitCode
from selfcal_ros.outputs import check_outputs
from selfcal_ros.reporting.artwork import PAPERS_MM, artwork_of, save_artwork
from selfcal_ros.settings.detector import MARKS
from selfcal_ros.settings.estimator import read_plan
from selfcal_ros.units import MM_PER_M

ON_PAPER = (
    "paper and a printer are true to about 0.1 mm: enough to try a camera or a printer's "
    "bed, not to calibrate a stage; measure the scale bar, and print at 100 %"
)


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    parser.add_argument("plan", metavar="PLAN.yaml", help="plan whose plate is drawn")
    parser.add_argument(
        "-o",
        "--output",
        metavar="FILE.svg|.pdf|.dxf|.gds",
        required=True,
        help="artwork; .dxf needs the package ezdxf, .gds the package gdstk",
    )
    parser.add_argument(
        "--mark",
        choices=MARKS,
        default="disc",
        help="kind of mark, as for `selfcal detect` (default: disc)",
    )
    parser.add_argument(
        "--mark-size",
        type=float,
        metavar="M",
        help="diameter of a disc or ring, "
        "length of the bars of a cross, side of the squares that meet in a corner, "
        "m (default: a fifth of the pitch)",
    )
    parser.add_argument(
        "--mark-width",
        type=float,
        metavar="M",
        default=0.0,
        help="width of the line of a ring or cross, m (default: a fifth of its size)",
    )
    parser.add_argument(
        "--aruco",
        action="store_true",
        help="ArUco markers around the marks, from "
        "which `selfcal detect --aruco` knows the marks (needs OpenCV)",
    )
    parser.add_argument(
        "--paper",
        choices=tuple(PAPERS_MM),
        help="sheet of paper to print it on, for trying",
    )
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Draw the plate, and print what was written."""
    check_outputs([args.plan], [args.output])
    plan = read_plan(args.plan)
    size = plan.artifact.grid_pitch_m / 5 if args.mark_size is None else args.mark_size
    art = artwork_of(
        plan, mark=args.mark, size_m=size, width_m=args.mark_width, aruco=args.aruco
    )
    save_artwork(art, args.output, args.paper or "")
    left, low, right, high = art.box
    lines = [
        f"{args.output}: {plan.artifact.m.size} marks ({args.mark}, {size * MM_PER_M:.4g} mm), "
        f"{plan.artifact.angular_count} lines, {right - left:.4g} x {high - low:.4g} mm; the "
        "dot beyond a corner is beside mark (h, h), the numbers are m and n",
        *([ON_PAPER] if args.paper else []),
    ]
    say(
        args,
        "\n".join(lines),
        {"written": args.output, "marks": plan.artifact.m.size, "mark_size": size},
    )
    return ExitCode.DONE
