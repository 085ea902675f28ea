# SPDX-License-Identifier: Apache-2.0
"""``selfcal simulate``: a bag of a simulated cell with known truth."""

import argparse

from selfcal_ros.cli.terminal import add_json, progress_bar, say
from selfcal_ros.simulation.bag import write_files, write_simulation
from selfcal_ros.simulation.spec import read_simulation


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    parser.add_argument(
        "sim", metavar="SIM.yaml", help="what to simulate (docs/guides/simulate.md)"
    )
    parser.add_argument(
        "-o",
        "--output",
        metavar="BAG",
        required=True,
        help="bag folder to create; truth.json is written into it",
    )
    parser.add_argument(
        "--png",
        action="store_true",
        help="of a cell with a camera: write a "
        "folder of PNG files with positions.csv instead of a bag",
    )
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Simulate and print what was written."""
    simulation = read_simulation(args.sim)
    write = write_files if args.png else write_simulation
    with progress_bar("simulating") as bar:
        counts = write(simulation, args.output, progress=bar)
    say(
        args,
        f"{args.output}: "
        + ", ".join(
            f"{count} {topic}" if args.png else f"{count} x {topic}"
            for topic, count in counts.items()
        ),
        {"bag": args.output, "messages": dict(counts)},
    )
    return 0
