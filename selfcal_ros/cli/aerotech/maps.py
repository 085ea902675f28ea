# SPDX-License-Identifier: Apache-2.0
"""``selfcal cal export`` and ``selfcal cal verify``: between error maps and tables."""

import argparse
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from selfcal_ros.cli.aerotech.options import add_frame, frame_of, read_result
from selfcal_ros.cli.terminal.output import add_json, say
from selfcal_ros.cli.terminal.progress import busy
from selfcal_ros.errors import ExitCode, InputError, NotIdentifiableError
from selfcal_ros.units import M_PER_UM, RAD_PER_ARCSEC

if TYPE_CHECKING:
    from selfcal_ros.aerotech.verify import Verification


def add_to(group: argparse._SubParsersAction) -> None:
    """Add the sub-verbs."""
    export = group.add_parser("export", help="write the tables of an error map")
    export.add_argument("result", metavar="RESULT.json")
    export.add_argument("-o", "--output", metavar="FILE.cal", required=True,
                        help="2D table for x and y")
    export.add_argument("--theta-output", metavar="FILE.cal",
                        help="1D table for theta, which cannot share a file with a 2D table "
                             "(default: FILE_theta.cal)")
    export.add_argument("--fill", action="store_true",
                        help="set unknown sites to the mean of their neighbours")
    export.add_argument("--force", action="store_true",
                        help="replace existing files; the old ones are kept with their date")
    add_json(export)
    add_frame(export, theta=True)
    export.set_defaults(run_sub_verb=_export)
    verify = group.add_parser("verify", help="print the residual of a simulated controller before "
                                             "and after a file is loaded, um")
    verify.add_argument("result", metavar="RESULT.json")
    verify.add_argument("file", metavar="FILE.cal")
    verify.add_argument("--plot", metavar="F.png", help="draw it (png, svg or pdf)")
    verify.add_argument("--json", action="store_true", help="print as JSON, m and rad")
    add_frame(verify, theta=True, default=False)
    verify.set_defaults(run_sub_verb=_verify)


def _export(args: argparse.Namespace) -> int:
    from dataclasses import replace

    from selfcal_ros.aerotech import export
    from selfcal_ros.aerotech.write import cal_text, refuse_existing, write_cal
    from selfcal_ros.cli.terminal.print_result import exit_code
    from selfcal_ros.files import check_outputs

    result, frame = read_result(args.result), frame_of(args)
    if args.theta_output and frame.theta_axis is None:
        raise InputError("--theta-output", "no theta table is written", "name --theta-axis")
    if not result.observability.identifiable:
        raise NotIdentifiableError(f"{args.result}: the measured plan does not identify the stage; "
                                   "measure the missing views",
                                   result.observability)
    filled = 0
    if args.fill:
        error_map, filled = export.fill_unknown(result.error_map)
        result = replace(result, error_map=error_map)
    comments = export.provenance(result, frame, filled=filled)
    texts = {args.output: cal_text([export.table_xy(result.error_map, frame)],
                                   comments=comments, decimals=export.DECIMALS)}
    if frame.theta_axis is not None:
        target = Path(args.output)
        beside = args.theta_output or str(target.with_name(f"{target.stem}_theta{target.suffix}"))
        if os.path.realpath(beside) == os.path.realpath(target):
            raise InputError(beside, "a 1D and a 2D table cannot share a file", "name another file")
        table = export.table_theta(result.error_map, frame)
        texts[beside] = cal_text([table], comments=comments,
                                 decimals=export.theta_decimals(result.error_map))
    check_outputs([args.result], texts)
    refuse_existing(list(texts), force=args.force)
    lines, files = [], []
    for path, text in texts.items():
        backup = write_cal(path, text, force=args.force)
        kind = "1D table for theta" if path != args.output else "2D table for x and y"
        lines.append(f"{path}: {kind}" + (f"; the old file is {backup}" if backup else ""))
        files.append({"file": path, "kind": kind, "old_file": backup and str(backup)})
    say(args, "\n".join(lines), {"files": files, "filled": filled})
    if filled:
        print(f"selfcal cal: {filled} unknown sites filled from their neighbours", file=sys.stderr)
    if frame.theta_axis is not None and frame.theta_counts_per_unit is None:
        print("selfcal cal: the theta table covers one turn either way and does not roll over;"
              f" --counts-per-unit {frame.theta_axis}=COUNTS makes it roll over", file=sys.stderr)
    return exit_code(result)


def _verify(args: argparse.Namespace) -> int:
    from selfcal_ros.aerotech.machine import MachineFrame, frame_from_comments
    from selfcal_ros.aerotech.model import Table2D
    from selfcal_ros.aerotech.read import load_cal
    from selfcal_ros.aerotech.verify import verify_tables

    result, cal = read_result(args.result), load_cal(args.file)
    base = frame_from_comments(cal.comments)
    if base is None and isinstance(cal.tables[0], Table2D):
        base = MachineFrame(cal.tables[0].column_axis, cal.tables[0].row_axis)
    frame = frame_of(args, base)
    with busy("simulating the controller"):
        found = verify_tables(result.error_map, cal.tables, frame)
    say(args, _text(found), _numbers(found))
    if args.plot:
        from selfcal_ros.aerotech.report import controller_figure
        from selfcal_ros.reporting.figures.paper import save_picture
        save_picture(controller_figure(found), args.plot)
    if found.worse:
        raise InputError(args.file, "the tables make the machine worse",
                         "check signs, axes, unit, home position and encoder directions")
    return int(ExitCode.DONE)


def _numbers(found: "Verification") -> dict:
    from selfcal_ros.model.result import plain

    return plain({r.place: {"points": r.position.shape[1],
                            "before": {"rms": r.rms("before"), "max": r.largest("before")},
                            "after": {"rms": r.rms("after"), "max": r.largest("after")},
                            "shift_after": r.shift_after} for r in found.residuals})


def _text(found: "Verification") -> str:
    """Return the residuals as a small table: µm, and arcsec for angular lines."""
    lines = ["residual true - commanded, without its constant shift         before          after"]
    names = {"sites": "sites", "between": "cell centres (cubic stage)", "lines": "angular lines"}
    for r in found.residuals:
        unit, scale = ("arcsec", RAD_PER_ARCSEC) if r.place == "lines" else ("µm", M_PER_UM)
        for what, value in (("rms", r.rms), ("max", r.largest)):
            name = f"{r.position.shape[1]} {names[r.place]}, {what}, {unit}"
            lines.append(f"{name:<48}{value('before') / scale:>16.6f}"
                         f"{value('after') / scale:>15.6f}")
        shift = ", ".join(f"{s / scale:.6f}" for s in r.shift_after)
        lines.append(f"  constant shift after: {shift} {unit} (the controller is zero at home)")
    return "\n".join(lines)
