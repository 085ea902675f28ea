# SPDX-License-Identifier: Apache-2.0
"""``selfcal plot``: the maps of a result as one picture."""

import argparse
from pathlib import Path

from selfcal_ros.cli.report import read_truth
from selfcal_ros.cli.terminal import (
    add_json,
    add_result,
    add_truth,
    busy,
    save_drawing,
    say,
)
from selfcal_ros.errors import ExitCode
from selfcal_ros.outputs import check_outputs
from selfcal_ros.reporting.figures.maps import map_picture
from selfcal_ros.results import read_result


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    add_result(parser)
    parser.add_argument(
        "-o",
        "--output",
        metavar="FILE.png|.svg|.pdf",
        required=True,
        help="picture to write; its suffix sets the format",
    )
    add_truth(parser)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Read the result, draw the picture, print its path."""
    check_outputs([args.result, args.truth], [args.output])
    result = read_result(args.result)
    truth = read_truth(args.truth) if args.truth else None
    with busy("drawing"):
        save_drawing(map_picture(result, truth), args.output)
    say(
        args,
        f"written: {args.output}",
        {"written": args.output, "kind": Path(args.output).suffix.lower().lstrip(".")},
    )
    return ExitCode.DONE
