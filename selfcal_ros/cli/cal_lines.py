# SPDX-License-Identifier: Apache-2.0
"""What the sub-verbs of ``selfcal cal`` share, and those that write 1D tables.

The latter are ``orthogonality``, ``accuracy`` and ``straightness``.
"""

import argparse
import math
import re
from collections.abc import Container
from dataclasses import replace
from datetime import UTC, datetime
from fractions import Fraction
from pathlib import Path
from typing import Any, Literal

from selfcal_ros import __version__
from selfcal_ros.applications.aerotech import export as cal_lines
from selfcal_ros.applications.aerotech.export import (
    DECIMALS,
    AxisCorrection,
    line_table,
)
from selfcal_ros.applications.aerotech.header import SMALLEST, ArgumentFault, number
from selfcal_ros.applications.aerotech.write import cal_text
from selfcal_ros.cli.deliver import command, replace_files, replaced
from selfcal_ros.cli.terminal import add_json, exit_code, option_of, say
from selfcal_ros.compensation.export import origin_lines, verdict_lines
from selfcal_ros.compensation.frame import LENGTHS_M, UNITS_M, MachineFrame
from selfcal_ros.compensation.plausible import (
    require_plausible,
    require_plausible_line,
)
from selfcal_ros.errors import ExitCode, InputError
from selfcal_ros.files import read_text
from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.results import read_result
from selfcal_ros.units import M_PER, M_PER_UM, UM_PER_M

Axis = Literal["x", "y"]
ACROSS: dict[Axis, Axis] = {"x": "y", "y": "x"}
_HOMES: dict[Literal["end", "middle", "middle-balanced"], str] = {
    "end": "home at one end of travel",
    "middle": "home in the middle of travel",
    "middle-balanced": "home in the middle of travel, balanced",
}


def pairs(texts: list[str] | None, option: str) -> dict[int, str]:
    """Return axis -> value of options AXIS=VALUE; InputError for anything else."""
    values: dict[int, str] = {}
    for text in texts or []:
        axis, equals, value = text.partition("=")
        if not (
            equals and axis.isascii() and axis.isdigit() and 1 <= int(axis[:9]) <= 32
        ):
            raise InputError(
                option,
                f"'{text}' is not AXIS=VALUE with an axis from 1 to 32",
                f"write {option} 1=10.5",
            )
        if int(axis) in values:
            raise InputError(
                option, f"axis {int(axis)} is given twice", "keep one of them"
            )
        values[int(axis)] = value
    return values


def numbers(
    texts: list[str] | None, option: str, *, positive: bool = False
) -> dict[int, float]:
    """Return axis -> number of options AXIS=NUMBER; InputError for anything else."""
    numbers_of = {}
    for axis, text in pairs(texts, option).items():
        try:
            value = number(text)
        except ArgumentFault:
            value = math.nan
        if not value >= (SMALLEST if positive else -math.inf):
            raise InputError(
                option,
                f"'{text}' is not a {'positive ' * positive}number",
                f"write {option} {axis}={1000 if positive else 10.5}",
            )
        numbers_of[axis] = value
    return numbers_of


def in_unit(
    texts: list[str] | None, unit: str, *, rotary: Container[int] = ()
) -> list[str]:
    """Return options AXIS=LENGTH with the length as a number in `unit`; others unchanged.

    Raises
    ------
    InputError
        For a length of an axis in `rotary`.
    """
    converted = []
    for text in texts or []:
        match = re.fullmatch(
            r"(\d+)=([-+]?[\d.]+(?:[eE][-+]?\d{1,3})?) ?(m|mm|um|µm|nm)", text
        )
        if match is None:
            converted.append(text)
            continue
        if int(match[1]) in rotary:
            raise InputError(
                "--position",
                f"'{text}' is a length, and axis {match[1]} is rotary",
                f"write {match[1]}=10.5, in its primary unit (deg)",
            )
        factor = Fraction(str(M_PER[match[3].replace("µ", "u")])) / Fraction(
            str(M_PER[unit])
        )
        try:
            converted.append(f"{match[1]}={float(Fraction(match[2]) * factor)!r}")
        except (ValueError, OverflowError):
            converted.append(text)
    return converted


def add_frame(
    parser: argparse.ArgumentParser,
    *,
    theta: bool,
    default: bool = True,
    units: tuple[str, ...] = ("m", "mm", "um"),
    origin: str = "the centre of the field",
) -> None:
    """Add the options that relate the controller's axes to the stage frame at `origin`."""
    group = parser.add_argument_group(
        "machine",
        None
        if default
        else "default: from the comments of FILE.cal, else columns are x and rows are y",
    )
    group.add_argument(
        "--x-axis",
        type=int,
        metavar="N",
        default=1 if default else None,
        help="index of the x axis, from 1",
    )
    group.add_argument(
        "--y-axis",
        type=int,
        metavar="N",
        default=2 if default else None,
        help="index of the y axis",
    )
    group.add_argument(
        "--unit",
        choices=units,
        default="mm" if default and "in" not in units else None,
        help="unit of the linear axes (default mm"
        + (", kmotion in)" if {"m", "in"} <= set(units) else ")"),
    )
    if default:
        group.add_argument(
            "--steep",
            action="store_true",
            help="accept errors that change by more "
            "than 1 %% of the distance between neighbouring positions",
        )
    for axis, unit in (("x", "primary unit"), ("y", "primary unit"), ("theta", "deg")):
        if axis == "theta" and not theta:
            continue
        group.add_argument(
            f"--home-{axis}",
            type=float,
            metavar="P",
            default=None,
            help=f"position of the controller's zero in the stage frame, {unit} "
            f"(default 0, {origin})",
        )
        group.add_argument(
            f"--reverse-{axis}",
            action="store_true",
            help=f"the encoder counts opposite to the stage frame's {axis}",
        )
    if theta:
        group.add_argument(
            "--theta-axis", type=int, metavar="N", help="index of the theta axis"
        )
        group.add_argument(
            "--counts-per-unit",
            action="append",
            metavar="AXIS=COUNTS",
            help="encoder counts per degree of the theta axis",
        )


def frame_of(
    args: argparse.Namespace, base: MachineFrame | None = None
) -> MachineFrame:
    """Return the frame described by the options, with `base` as default."""
    base = base or MachineFrame()
    changes: dict[str, Any] = {
        name: getattr(args, name)
        for name in ("x_axis", "y_axis", "theta_axis", "unit")
        if getattr(args, name, None) is not None
    }
    changes |= _homes(args, LENGTHS_M[changes.get("unit", base.unit)])
    for name in ("x_axis", "y_axis", "theta_axis"):
        if not 1 <= changes.get(name, 1) <= 32:
            raise InputError(
                option_of(name),
                f"{changes[name]} is not in 1..32",
                "indices in calibration files count from 1",
            )
    changes |= _counts(args, changes, changes.get("theta_axis", base.theta_axis))
    return replace(base, **changes)


def _homes(args: argparse.Namespace, unit_m: float) -> dict[str, Any]:
    """Return where the controller's zeros lie, and which encoders count backwards."""
    changes: dict[str, Any] = {}
    for name in ("x", "y", "theta"):
        home = getattr(args, f"home_{name}", None)
        if home is not None and not math.isfinite(home):
            raise InputError(
                f"--home-{name}", f"{home} is not a position", "give a number"
            )
        if home is not None and name == "theta":
            changes["home_theta_rad"] = math.radians(home)
        elif home is not None:
            changes[f"home_{name}_m"] = home * unit_m
        if getattr(args, f"reverse_{name}", False):
            changes[f"reverse_{name}"] = True
    return changes


def _counts(
    args: argparse.Namespace, changes: dict[str, Any], theta_axis: int | None
) -> dict[str, float]:
    """Return the counts of the theta axis; refuse options of an axis that there is not."""
    counts = numbers(
        getattr(args, "counts_per_unit", None), "--counts-per-unit", positive=True
    )
    for name in ("home_theta_rad", "reverse_theta"):
        if name in changes and theta_axis is None:
            raise InputError(
                option_of(name.removesuffix("_rad")),
                "there is no theta axis",
                "name --theta-axis",
            )
    of_theta: dict[str, float] = {}
    for axis, count in counts.items():
        if axis != theta_axis:
            raise InputError(
                "--counts-per-unit",
                f"axis {axis} is not the theta axis",
                f"write {theta_axis}={count:g}" if theta_axis else "name --theta-axis",
            )
        of_theta["theta_counts_per_unit"] = count
    return of_theta


def add_line_tables(group: argparse._SubParsersAction) -> None:
    """Add the sub-verbs."""
    square = group.add_parser(
        "orthogonality",
        help="the two-point table for axes that are not perpendicular",
        description="From a precision square: --measured, --over, --travel (lengths such as 5um). "
        "Or from a calibration: RESULT.json. "
        "The y axis is corrected from the position of the x axis; --along y exchanges "
        "them.",
    )
    square.add_argument("source", nargs="?", metavar="RESULT.json")
    square.add_argument(
        "--measured", metavar="LENGTH", help="error shown by the indicator"
    )
    square.add_argument("--over", metavar="LENGTH", help="length of the square")
    square.add_argument(
        "--travel", metavar="LENGTH", help="full travel of the reference axis"
    )
    square.add_argument(
        "--home",
        choices=tuple(_HOMES),
        help="home position of the reference axis (default: show all; required with -o)",
    )
    _common(square, _orthogonality)
    for name, what in (
        ("accuracy", "an axis from its own position"),
        ("straightness", "the other axis from the position of an axis"),
    ):
        sub = group.add_parser(
            name,
            help=f"the table that corrects {what}",
            description=f"Write the 1D table that corrects {what}, from a calibration or from "
            "measured errors: a CSV with the header position,error (primary units; "
            "µm, actual - commanded).",
        )
        sub.add_argument("source", metavar="RESULT.json|DATA.csv")
        _common(sub, _line)


def _common(parser: argparse.ArgumentParser, run: object) -> None:
    parser.add_argument(
        "--along", choices=("x", "y"), default="x", help="reference axis (default x)"
    )
    parser.add_argument(
        "-o", "--output", metavar="FILE.cal", help="write a calibration file"
    )
    parser.add_argument(
        "--force",
        action="store_true",
        help="replace an existing file; the old one is kept with its date",
    )
    add_json(parser)
    add_frame(parser, theta=False)
    parser.set_defaults(run_sub_verb=run)


def refuse_idle_force(args: argparse.Namespace, *files: str | None) -> None:
    """Refuse ``--force`` where no file is written."""
    if args.force and not any(files):
        raise InputError(
            "--force",
            "it replaces a file, and none is named",
            "name one with -o, or omit it",
        )


def _orthogonality(args: argparse.Namespace) -> int:
    refuse_idle_force(args, args.output)
    frame = frame_of(args)
    measured = (args.measured, args.over, args.travel)
    if args.source is not None:
        if any(measured) or args.home:
            raise InputError(
                "arguments",
                "RESULT.json and a measured square exclude each other",
                "give one of them; --home-x and --home-y place the home position",
            )
        result = _result(args)
        line = cal_lines.map_orthogonality(result.error_map, args.along)
        return _deliver(args, line, frame, ACROSS[args.along], result)
    if None in measured:
        raise InputError(
            "arguments",
            "the measurement is not complete",
            "give --measured, --over and --travel, or a RESULT.json",
        )
    _refuse_frame(args, "a measured square", "use --home")
    return _square(args, frame, measured)


def _result(args: argparse.Namespace) -> CalibrationResult:
    """Return the calibration; refuse a map that is steep, unless it is accepted so."""
    result = read_result(args.source)
    if not args.steep:
        require_plausible(result.error_map, args.source)
    return result


def _square(
    args: argparse.Namespace, frame: MachineFrame, measured: tuple[str, ...]
) -> int:
    """Write the table of a precision square, or print that of each home position."""
    measured_m, over_m, travel_m = (
        cal_lines.length_m(text, name)
        for text, name in zip(
            measured, ("--measured", "--over", "--travel"), strict=True
        )
    )
    homes = [args.home] if args.home else list(_HOMES)
    line_of = {
        home: cal_lines.orthogonality(measured_m, over_m, travel_m, home)
        for home in homes
    }
    if not args.steep:
        require_plausible_line([0, over_m], [0, measured_m], "--measured")
    if args.output:
        if args.home is None:
            raise InputError(
                "--home",
                "the home position is missing",
                "give end, middle or middle-balanced",
            )
        return _deliver(args, line_of[args.home], frame, ACROSS[args.along])
    unit_m = UNITS_M[args.unit]
    tables = {
        home: [
            [round(p / unit_m, 9), round(c / M_PER_UM, 9)]
            for p, c in zip(line.positions_m, line.corrections_m, strict=True)
        ]
        for home, line in line_of.items()
    }
    lines = [
        f"correction of {ACROSS[args.along]} over the full travel of {args.along}: "
        f"{-measured_m / over_m * travel_m * UM_PER_M:.9g} µm"
    ]
    for home, rows in tables.items():
        lines.append(f"{_HOMES[home]} (--home {home})")
        lines.append(f"  position {args.unit:<5} correction µm")
        lines += [
            f"  {position:<14.9g} {correction:.9g}" for position, correction in rows
        ]
    data = {"unit": args.unit, "correction_unit": "um", "tables": tables}
    say(args, "\n".join(lines), data)
    return ExitCode.DONE


def _line(args: argparse.Namespace) -> int:
    refuse_idle_force(args, args.output)
    frame = frame_of(args)
    result = None
    is_straightness = args.sub_verb == "straightness"
    corrected = ACROSS[args.along] if is_straightness else args.along
    if Path(args.source).suffix.lower() == ".csv":
        _refuse_frame(
            args, "measured errors, whose positions are the controller's own", "omit it"
        )
        line = cal_lines.measured_line(
            read_text(args.source), args.source, frame.unit_m
        )
    else:
        result = _result(args)
        line = cal_lines.map_line(result.error_map, args.along, corrected)
    if is_straightness:
        line = cal_lines.without_slope(line)
    if result is None and not args.steep:
        require_plausible_line(line.positions_m, line.corrections_m, args.source)
    return _deliver(args, line, frame, corrected, result)


def _refuse_frame(args: argparse.Namespace, what: str, remedy: str) -> None:
    """Refuse options of the stage frame: measured values are not in that frame."""
    for axis in "xy":
        if getattr(args, f"home_{axis}") is not None:
            raise InputError(f"--home-{axis}", f"it has no meaning for {what}", remedy)
        if getattr(args, f"reverse_{axis}"):
            raise InputError(
                f"--reverse-{axis}",
                f"it has no meaning for {what}",
                "give positions and errors in the sense of the encoders",
            )


def _deliver(
    args: argparse.Namespace,
    line: AxisCorrection,
    frame: MachineFrame,
    corrected: Axis,
    result: CalibrationResult | None = None,
) -> int:
    """Write the table of a line to a file, or print it; `result` is that of its map."""
    source = args.source or f"{args.measured} over {args.over}, travel {args.travel}"
    comments = [
        f"written by selfcal {__version__} on {datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ}",
        f"{args.sub_verb} of {corrected} along {args.along}, from {source}",
        *(
            []
            if result is None
            else [*origin_lines(result, command(args)), *verdict_lines(result)]
        ),
        frame.comment(axes_alone=result is None),
    ]
    table = line_table(line, frame, along=args.along, corrected=corrected)
    text = cal_text([table], comments=comments, decimals=DECIMALS)
    written = {
        "table": text,
        "corrects": corrected,
        "along": args.along,
        "file": None,
        "old_file": None,
    }
    if args.output:
        backup = replace_files(args, {args.output: text}, [args.source])[args.output]
        say(
            args,
            f"{args.output}: {args.sub_verb} table for {corrected}{replaced(backup)}",
            written | {"file": args.output, "old_file": backup},
        )
    else:
        say(args, text.removesuffix("\n"), written)
    return ExitCode.DONE if result is None else exit_code(result)
