# SPDX-License-Identifier: Apache-2.0
"""``selfcal step-diagonal``: straightness and squareness from laser step-diagonals, CSV or bag."""

import argparse
import math
from collections.abc import Sequence
from pathlib import Path

from selfcal_ros import __version__
from selfcal_ros.applications.aerotech.export import (
    DECIMALS,
    AxisCorrection,
    line_table,
)
from selfcal_ros.applications.aerotech.model import Table1D
from selfcal_ros.applications.aerotech.write import cal_text, write_cals
from selfcal_ros.applications.laser.bag import SeriesTopics, read_series
from selfcal_ros.applications.laser.data import (
    DIAGONALS,
    Form,
    Method,
    StepDiagonal,
    StepDiagonalResult,
)
from selfcal_ros.applications.laser.identify import (
    EQUAL_READINGS,
    Choice,
    identify,
    readings_are_equal,
)
from selfcal_ros.applications.laser.profiles import ReferenceLine, axis_corrections
from selfcal_ros.applications.laser.report import (
    outcome,
    profiles_figure,
    summary,
    truth_of,
)
from selfcal_ros.applications.laser.simulation import (
    simulate_step_diagonal,
    simulation_from_dict,
)
from selfcal_ros.applications.laser.table import (
    RequiredColumns,
    dimension_of,
    read_table,
    table_text,
    write_table,
)
from selfcal_ros.applications.laser.zigzag import CutRule, cut_zigzag
from selfcal_ros.bagio.reader import BagReader
from selfcal_ros.cli.cal_lines import add_frame, frame_of, refuse_idle_force
from selfcal_ros.cli.terminal import (
    add_json,
    busy,
    option_of,
    put,
    save_drawing,
    say,
    tell,
    warn,
)
from selfcal_ros.compensation.frame import MachineFrame
from selfcal_ros.errors import ExitCode, InputError
from selfcal_ros.files import read_yaml, sha256_of
from selfcal_ros.outputs import check_outputs, refuse_existing, write_json, write_text
from selfcal_ros.units import M_PER, M_PER_MM, M_PER_UM

STEP_MM = 10.0
SHORTEST_MM = 1e-6
"""Shorter steps, below 1 nm, are refused."""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    parser.add_argument(
        "data",
        metavar="DATA.csv|BAG",
        nargs="?",
        help="columns block, rx_pp, ry_pp, rx_np, ry_np [, ex_x, ey_y], mm; "
        "several rows of a block are repeats; 3D: rx_ppp, ry_ppp, rz_ppp, rx_npp, ... "
        "[, ez_z]",
    )
    parser.add_argument(
        "--method",
        choices=("conventional", "new"),
        help="conventional: nominal laser directions (Wang); new: measured linear "
        "errors, unknown set-up (Ibaraki)",
    )
    parser.add_argument(
        "--form",
        default="exact",
        choices=("exact", "stepwise", "printed"),
        help="new formulation: exact geometry by least squares (default), the "
        "paper's equations with the exact form of eq. 5, or as printed",
    )
    for axis in "xyz":
        parser.add_argument(
            f"--step-{axis}",
            type=float,
            default=STEP_MM,
            metavar="MM",
            help=f"nominal step of {axis.upper()} in a block, mm (default {STEP_MM:g})",
        )
    parser.add_argument(
        "--line",
        default="lsq",
        choices=("lsq", "end"),
        help="reference line: least squares (default) or through the end points",
    )
    parser.add_argument(
        "--diagonals",
        metavar="LIST",
        help="diagonals to use, separated by commas (default: all)",
    )
    parser.add_argument(
        "--allow-equal",
        action="store_true",
        help="accept X and Y readings that are equal in every block",
    )
    parser.add_argument(
        "--plot", metavar="FILE", help="draw the profiles (png, svg or pdf)"
    )
    parser.add_argument(
        "--simulate",
        metavar="SIM.yaml",
        help="without DATA.csv: write the readings of a simulated measurement to "
        "-o (or print them); see config/step_diagonal/case_study.yaml",
    )
    parser.add_argument(
        "--truth",
        metavar="TRUTH.json",
        help="with --simulate: write the errors of the machine",
    )
    parser.add_argument(
        "--cal",
        metavar="FILE.cal",
        help="write straightness, squareness and measured linear errors as 1D "
        "tables; positions count from the start of the first block",
    )
    parser.add_argument(
        "--force",
        action="store_true",
        help="replace files that exist; an old FILE.cal is kept with its date",
    )
    add_frame(parser, theta=False, origin="the start of the first block")
    add_bag_options(parser)
    parser.add_argument(
        "-o",
        "--output",
        metavar="OUT.json|.csv",
        help="file for the result, or the readings; default: print it",
    )
    add_json(parser, "the result, even if it is written to a file")


def run(args: argparse.Namespace) -> int:
    """Identify the errors, write the result, and print a summary."""
    _check_outputs(args)
    if args.simulate:
        return _simulate(args)
    if args.data is None or args.method is None:
        raise InputError(
            "arguments",
            "DATA.csv and --method are required",
            "give both, or --simulate alone",
        )
    data, warnings, source = _measurement(args)
    choice = Choice(Method(args.method), Form(args.form), args.allow_equal)
    with busy("identifying"):
        identified = identify(data, choice)
    if readings_are_equal(data):
        warnings = [*warnings, EQUAL_READINGS]
    result = outcome(identified, data, line=ReferenceLine(args.line), warnings=warnings)
    result["input"] = source
    for warning in result["warnings"]:
        warn(args, f"warning: {warning}")
    if args.plot:
        save_drawing(profiles_figure(identified, data), args.plot)
    if args.cal:
        _write_cal(args, identified)
    if args.output:
        write_json(args.output, result)
    if args.output and not args.json:
        tell(summary(result))
    else:
        put(result)
    return ExitCode.DONE


def _check_outputs(args: argparse.Namespace) -> None:
    """Refuse outputs that would not be written."""
    measured = not args.simulate
    for option, path, installed, remedy in (
        ("--truth", args.truth, args.simulate, "it belongs to --simulate"),
        ("--plot", args.plot, measured, "omit it with --simulate"),
        ("--cal", args.cal, measured, "it belongs to a measurement"),
        (
            "--save-csv",
            args.save_csv,
            measured and args.data and is_bag(args.data),
            "it belongs to a bag",
        ),
    ):
        if path and not installed:
            raise InputError(option, "nothing would be written", remedy)
    files = (args.output, args.plot, args.cal, args.truth, args.save_csv)
    check_outputs([args.data, args.simulate], files)
    refuse_existing(filter(None, [args.cal, args.truth]), force=args.force)
    refuse_idle_force(args, *files)
    if not args.cal:
        refuse_given(
            args,
            (
                "x_axis",
                "y_axis",
                "unit",
                "home_x",
                "home_y",
                "reverse_x",
                "reverse_y",
            ),
            "it belongs to a calibration file",
            "name one with --cal, or omit it",
        )


def _write_cal(args: argparse.Namespace, identified: StepDiagonalResult) -> None:
    """Write the corrections as 1D tables."""
    frame = frame_of(args)
    comments = [
        f"written by selfcal {__version__} from the step-diagonal measurement {args.data}",
        f"{identified.method} formulation; correction = -(actual - commanded)",
        "positions count from the start of the first block; the x axis is the reference",
        frame.comment(),
    ]
    text = cal_text(
        correction_tables(identified, frame), comments=comments, decimals=DECIMALS
    )
    backup = write_cals({args.cal: text}, force=args.force)[args.cal]
    if backup:
        warn(args, f"the old {args.cal} is {backup}")


def correction_tables(
    identified: StepDiagonalResult, frame: MachineFrame
) -> list[Table1D]:
    """Return the 1D tables of all corrections, in the controller's coordinates.

    The machine's home is counted from the start of the first block.
    """
    lines = axis_corrections(identified)
    return [
        line_table(
            AxisCorrection(*lines[pair]), frame, along=pair[0], corrected=pair[1]
        )
        for pair in sorted(lines)
    ]


def _simulate(args: argparse.Namespace) -> int:
    """Write the readings of a simulated measurement as a table."""
    if args.data is not None:
        raise InputError(
            "arguments", "--simulate writes data and reads none", "omit DATA.csv"
        )
    simulation = simulation_from_dict(read_yaml(args.simulate), args.simulate)
    data = simulate_step_diagonal(
        simulation.machine, simulation.measurement, simulation.rng
    )
    text = table_text(
        data,
        [
            f"simulated from {args.simulate}; mm; several rows of a block are repeats",
            "readings are positive on every diagonal (np: rx = -l.dx); a block is a "
            "position on the axis",
            "ex_x, ey_y: directly measured linear errors, actual - nominal of each step",
        ],
    )
    if args.truth:
        write_json(args.truth, truth_of(simulation.machine))
    if args.output:
        write_text(args.output, text)
    shown = f"written: {args.output}" if args.output else text.removesuffix("\n")
    say(args, shown, {"csv": text, "file": args.output})
    return ExitCode.DONE


def _measurement(args: argparse.Namespace) -> tuple:
    """Return the measurement, its warnings, and its source."""
    if is_bag(args.data):
        data, warnings = measurement_from_bag(args, _steps(args, len(joints_of(args))))
        if args.diagonals is not None:
            data = data.pick(_diagonals(args, data.dim))
    else:
        refuse_given(
            args,
            (
                "laser_topic",
                "laser_field",
                "laser_unit",
                "laser_sign",
                "position_topic",
                "joints",
                "rest_tolerance",
                "min_rest",
                "settle",
            ),
            f"it is for bags, and {args.data} is not one",
            "name a bag, or omit it",
        )
        dim = dimension_of(args.data)
        columns = RequiredColumns(
            _steps(args, dim), _diagonals(args, dim), args.method == "new"
        )
        data, warnings = read_table(args.data, columns)
    return data, warnings, {"file": args.data, "sha256": sha256_of(args.data)}


def _steps(args: argparse.Namespace, dim: int) -> tuple[float, ...]:
    if dim < 3 and args.step_z != STEP_MM:
        raise InputError("--step-z", "the measurement has no Z", "omit it")
    for axis in "xyz"[:dim]:
        step = getattr(args, f"step_{axis}")
        if not SHORTEST_MM <= step < math.inf:
            raise InputError(
                f"--step-{axis}",
                f"{step:g} mm is not a length",
                "give the nominal step in mm, greater than 0",
            )
    return tuple(getattr(args, f"step_{axis}") * M_PER_MM for axis in "xyz"[:dim])


def _diagonals(args: argparse.Namespace, dim: int) -> tuple[str, ...]:
    if args.diagonals is None:
        return DIAGONALS[dim]
    names = tuple(name.strip() for name in args.diagonals.split(","))
    for name in names:
        if name not in DIAGONALS[dim] or names.count(name) > 1:
            raise InputError(
                "--diagonals",
                f"'{name}' is unknown or named twice",
                "choose from " + ", ".join(DIAGONALS[dim]),
            )
    return names


def add_bag_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of a bag."""
    group = parser.add_argument_group(
        "bag",
        "with an MCAP file or a rosbag2 folder in place of DATA.csv; the zig-zag is cut "
        "into blocks at the rests of the axes",
    )
    group.add_argument(
        "--laser-topic",
        metavar="TOPIC",
        help="laser distance: Float64, Float32, Range, or any type with --laser-field",
    )
    group.add_argument(
        "--laser-field",
        metavar="FIELD",
        default="",
        help="field of the distance, or its joint in a JointState",
    )
    group.add_argument(
        "--laser-unit",
        choices=tuple(M_PER),
        default="m",
        help="unit of the distance (default m)",
    )
    group.add_argument(
        "--laser-sign",
        type=int,
        choices=(1, -1),
        default=1,
        help="-1 if the distance decreases along the diagonals (default 1)",
    )
    group.add_argument(
        "--position-topic",
        metavar="TOPIC",
        help="axis positions: JointState, PointStamped or PoseStamped, m",
    )
    group.add_argument(
        "--joints",
        metavar="LIST",
        default="x,y",
        help="joints of X, Y[, Z] (default x,y; three names mean 3D)",
    )
    group.add_argument(
        "--rest-tolerance",
        type=float,
        default=2.0,
        metavar="UM",
        help="largest motion of an axis at rest, µm (default 2)",
    )
    group.add_argument(
        "--min-rest",
        type=float,
        default=0.5,
        metavar="S",
        help="shortest rest, s (default 0.5)",
    )
    group.add_argument(
        "--settle",
        type=float,
        default=0.1,
        metavar="S",
        help="time ignored at both ends of a rest, s (default 0.1)",
    )
    group.add_argument(
        "--save-csv", metavar="FILE", help="write the blocks as a CSV table"
    )


def refuse_given(
    args: argparse.Namespace, names: Sequence[str], why: str, remedy: str
) -> None:
    """Refuse options that differ from their defaults, with the reason."""
    for name in names:
        if getattr(args, name) != args.leaf.get_default(name):
            raise InputError(option_of(name), why, remedy)


def is_bag(path: str) -> bool:
    """Return whether a path is a bag rather than a table."""
    return Path(path).is_dir() or Path(path).suffix == ".mcap"


def joints_of(args: argparse.Namespace) -> tuple[str, ...]:
    """Return the joints named; two for face, three for body diagonals."""
    joints = tuple(name.strip() for name in args.joints.split(","))
    if len(joints) not in (2, 3) or len(set(joints)) < len(joints) or "" in joints:
        raise InputError(
            "--joints",
            f"'{args.joints}' is not two or three names",
            "write --joints x,y",
        )
    return joints


def measurement_from_bag(
    args: argparse.Namespace, steps_m: tuple[float, ...]
) -> tuple[StepDiagonal, list[str]]:
    """Return the measurement in a bag, and warnings.

    Raises
    ------
    InputError
        If a topic is missing, an option is not a valid number, or the bag cannot be used.
    """
    BagReader(Path(args.data))  # says first what is not a bag
    for option, value in (
        ("--laser-topic", args.laser_topic),
        ("--position-topic", args.position_topic),
    ):
        if not value:
            raise InputError(option, "a bag needs it", "name the topic")
    for option, value in (
        ("--rest-tolerance", args.rest_tolerance),
        ("--min-rest", args.min_rest),
        ("--settle", args.settle),
    ):
        if not (math.isfinite(value) and value >= 0):
            raise InputError(option, f"{value:g} is not a positive number", "give one")
    topics = SeriesTopics(
        args.laser_topic,
        args.position_topic,
        joints_of(args),
        args.laser_field,
        M_PER[args.laser_unit],
    )
    series, notes = read_series(Path(args.data), topics)
    rule = CutRule(
        steps_m,
        args.rest_tolerance * M_PER_UM,
        args.min_rest,
        args.settle,
        laser_sign=args.laser_sign,
    )
    cut = cut_zigzag(series, rule)
    if args.save_csv:
        write_table(args.save_csv, cut.data, [f"blocks of {args.data}"])
    runs = ", ".join(f"{name} {count}" for name, count in cut.runs.items())
    return cut.data, [
        *notes,
        f"{args.data}: complete runs: {runs}",
        *(f"{args.data}: {note}" for note in cut.notes),
    ]
