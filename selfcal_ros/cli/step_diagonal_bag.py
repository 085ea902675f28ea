# SPDX-License-Identifier: Apache-2.0
"""``selfcal step-diagonal`` from a bag."""

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from selfcal_ros.errors import InputError
from selfcal_ros.units import M_PER, M_PER_UM

if TYPE_CHECKING:
    from selfcal_ros.laser.data import StepDiagonal


JOINTS = "x,y"
REST_TOLERANCE_UM = 2.0
MIN_REST_S = 0.5
SETTLE_S = 0.1


def add_bag_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of a bag."""
    group = parser.add_argument_group(
        "bag", "with an MCAP file or a rosbag2 folder in place of DATA.csv; the zig-zag is cut "
        "into blocks at the rests of the axes")
    group.add_argument("--laser-topic", metavar="TOPIC",
                       help="laser distance: Float64, Float32, Range, or any type with "
                            "--laser-field")
    group.add_argument("--laser-field", metavar="FIELD", default="",
                       help="field of the distance, or its joint in a JointState")
    group.add_argument("--laser-unit", choices=tuple(M_PER), default="m",
                       help="unit of the distance (default m)")
    group.add_argument("--laser-sign", type=int, choices=(1, -1), default=1,
                       help="-1 if the distance decreases along the diagonals (default 1)")
    group.add_argument("--position-topic", metavar="TOPIC",
                       help="axis positions: JointState, PointStamped or PoseStamped, m")
    group.add_argument("--joints", metavar="LIST", default=JOINTS,
                       help="joints of X, Y[, Z] (default x,y; three names mean 3D)")
    group.add_argument("--rest-tolerance", type=float, default=REST_TOLERANCE_UM, metavar="UM",
                       help="largest motion of an axis at rest, um (default 2)")
    group.add_argument("--min-rest", type=float, default=MIN_REST_S, metavar="S",
                       help="shortest rest, s (default 0.5)")
    group.add_argument("--settle", type=float, default=SETTLE_S, metavar="S",
                       help="time ignored at both ends of a rest, s (default 0.1)")
    group.add_argument("--save-csv", metavar="FILE", help="write the blocks as a CSV table")


def refuse_for_table(args: argparse.Namespace) -> None:
    """Refuse options of a bag if the readings come from a table."""
    given = {"laser_topic": None, "laser_field": "", "laser_unit": "m", "laser_sign": 1,
             "position_topic": None, "joints": JOINTS, "rest_tolerance": REST_TOLERANCE_UM,
             "min_rest": MIN_REST_S, "settle": SETTLE_S}
    refuse_given(args, given, f"it is for bags, and {args.data} is a table", "omit it")


def refuse_given(args: argparse.Namespace, defaults: dict[str, Any], why: str,
                 remedy: str) -> None:
    """Refuse options that differ from their defaults, with the reason."""
    for name, default in defaults.items():
        if getattr(args, name) != default:
            raise InputError(f"--{name.replace('_', '-')}", why, remedy)


def is_bag(path: str) -> bool:
    """Return whether a path is a bag rather than a table."""
    return Path(path).is_dir() or Path(path).suffix == ".mcap"


def joints_of(args: argparse.Namespace) -> tuple[str, ...]:
    """Return the joints named; two for face, three for body diagonals."""
    joints = tuple(name.strip() for name in args.joints.split(","))
    if len(joints) not in (2, 3) or len(set(joints)) < len(joints) or "" in joints:
        raise InputError("--joints", f"'{args.joints}' is not two or three names",
                         "write --joints x,y")
    return joints


def measurement_from_bag(args: argparse.Namespace,
                         steps_m: tuple[float, ...]) -> tuple["StepDiagonal", list[str]]:
    """Return the measurement in a bag, and warnings.

    Raises
    ------
    InputError
        If a topic is missing, an option is not a valid number, or the bag cannot be used.
    """
    from selfcal_ros.laser.bag import SeriesTopics, read_series
    from selfcal_ros.laser.table import write_table
    from selfcal_ros.laser.zigzag import CutRule, cut_zigzag

    for option, value in (("--laser-topic", args.laser_topic),
                          ("--position-topic", args.position_topic)):
        if not value:
            raise InputError(option, "a bag needs it", "name the topic")
    for option, value in (("--rest-tolerance", args.rest_tolerance), ("--min-rest", args.min_rest),
                          ("--settle", args.settle)):
        if not (math.isfinite(value) and value >= 0):
            raise InputError(option, f"{value:g} is not a positive number", "give one")
    topics = SeriesTopics(args.laser_topic, args.position_topic, joints_of(args),
                          args.laser_field, M_PER[args.laser_unit])
    series, notes = read_series(Path(args.data), topics)
    rule = CutRule(steps_m, args.rest_tolerance * M_PER_UM, args.min_rest, args.settle,
                   laser_sign=args.laser_sign)
    cut = cut_zigzag(series, rule)
    if args.save_csv:
        write_table(args.save_csv, cut.data, [f"blocks of {args.data}"])
    runs = ", ".join(f"{name} {count}" for name, count in cut.runs.items())
    return cut.data, [*notes, f"{args.data}: complete runs: {runs}",
                      *(f"{args.data}: {note}" for note in cut.notes)]
