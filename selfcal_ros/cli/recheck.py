# SPDX-License-Identifier: Apache-2.0
"""``selfcal recheck``: one view of a calibrated plate, and whether the stage is as it was."""

import argparse

from selfcal_ros.cli import solve

HELP = "whether a stage is as its calibration found it, from one view of the same plate"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    parser.add_argument("plate_from", metavar="RESULT.json",
                        help="calibration that made the plate known")
    solve.configure(parser)


def run(args: argparse.Namespace) -> int:
    """Collect, find the map and its change, print both and write the result."""
    return solve.run(args)
