# SPDX-License-Identifier: Apache-2.0
"""``selfcal export``: the map of a result as the table of a controller."""

import argparse

from selfcal_ros.applications.controllers.export import (
    FORMATS,
    comments_of,
    export,
    loaded,
    require_written_so,
)
from selfcal_ros.applications.controllers.grid import Source, Wiring
from selfcal_ros.cli.cal import (
    figures_of,
    numbered,
    ready,
    require_same_axes,
    residual_text,
    say_bent,
)
from selfcal_ros.cli.cal_lines import add_frame, frame_of, numbers
from selfcal_ros.cli.deliver import command, replace_files, replaced
from selfcal_ros.cli.terminal import (
    add_fill,
    add_json,
    add_result,
    exit_code,
    say,
    warn,
)
from selfcal_ros.errors import InputError
from selfcal_ros.files import read_text


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    add = parser.add_argument
    add("format", choices=FORMATS, metavar="|".join(FORMATS), help="the controller")
    add_result(parser)
    add(
        "-o",
        "--output",
        metavar="FILE",
        required=True,
        help="table to write; beckhoff and linuxcnc: FILE_x and FILE_y, same suffix",
    )
    add(
        "--verify",
        action="store_true",
        help="print the residual of a simulated controller before and after",
    )
    add(
        "--onto",
        metavar="ACTIVE",
        nargs="+",
        action="extend",
        help="table that was loaded during the calibration (of x and y where there are two): "
        "the new one replaces it",
    )
    add(
        "--negate",
        action="store_true",
        help="the controller subtracts the table (beckhoff, siemens: not documented)",
    )
    add("--integers", action="store_true", help="beckhoff before V3.1.3132 / V4.29")
    add_fill(parser)
    add(
        "--force",
        action="store_true",
        help="replace existing files; the old ones are kept with their date",
    )
    add_json(parser)
    add_frame(parser, theta=False, units=("m", "mm", "um", "in"))
    add(
        "--counts-per-unit",
        action="append",
        metavar="AXIS=COUNTS",
        help="pmac: encoder counts per unit, for both motors",
    )


def run(args: argparse.Namespace) -> int:
    """Read the result, write the files; code 5 and the reason if it is not qualified."""
    wiring = _wiring(args)
    result, filled = ready(args)
    active = None
    if args.onto:
        sources = [Source(read_text(path), path) for path in args.onto]
        for source in sources:
            comments = comments_of(source.text)
            require_same_axes(args, source.where, comments, wiring.frame)
        require_written_so(args.format, sources, wiring)
        active = loaded(args.format, sources, wiring)
    exported = export(
        args.format,
        result,
        wiring,
        args.output,
        active=active,
        filled=filled,
        command=command(args),
    )
    say_bent(args, exported.bent_m)
    if exported.remains:
        warn(args, f"{args.format} cannot hold the whole map: {exported.remains}")
    backups = replace_files(args, exported.files, [args.result, *(args.onto or ())])
    lines = [path + replaced(backup) for path, backup in backups.items()]
    if args.verify:
        lines.append(residual_text(exported.residuals))
    lines += numbered(exported.checklist)
    say(
        args,
        "\n".join(lines),
        {
            "files": [
                {"file": path, "old_file": backup} for path, backup in backups.items()
            ],
            "filled": filled,
            "residuals": figures_of(exported.residuals),
            "checklist": list(exported.checklist),
        },
    )
    return exit_code(result)


def _wiring(args: argparse.Namespace) -> Wiring:
    count_options = args.counts_per_unit
    args.counts_per_unit = None
    args.unit = args.unit or FORMATS[args.format].unit
    frame = frame_of(args)
    counts = numbers(count_options, "--counts-per-unit", positive=True)
    axes = (frame.x_axis, frame.y_axis)
    if counts and set(counts) != set(axes):
        raise InputError(
            "--counts-per-unit",
            f"it is given for {sorted(counts)}",
            f"give it for {axes[0]} and {axes[1]}",
        )
    return Wiring(
        frame,
        (counts[axes[0]], counts[axes[1]]) if counts else None,
        args.negate,
        args.integers,
    )
