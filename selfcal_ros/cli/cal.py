# SPDX-License-Identifier: Apache-2.0
"""``selfcal cal``: calibration files of Aerotech controllers."""

import argparse

from selfcal_ros.cli.aerotech import files, lines, maps

HELP = "read, check, evaluate, write and verify calibration files of Aerotech controllers"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the sub-verbs."""
    group = parser.add_subparsers(dest="sub_verb", metavar="WHAT", required=True)
    for module in (files, maps, lines):
        module.add_to(group)


def run(args: argparse.Namespace) -> int:
    """Run the sub-verb."""
    return args.run_sub_verb(args)
