# SPDX-License-Identifier: Apache-2.0
"""``selfcal cal``: read, check, evaluate, write and verify files of Aerotech controllers."""

import argparse
import json
import os
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from selfcal_ros.applications.aerotech import export
from selfcal_ros.applications.aerotech.evaluate import (
    AxisSetup,
    CalEvaluator,
    MachineSetup,
)
from selfcal_ros.applications.aerotech.model import CalFile, Severity, Table1D, Table2D
from selfcal_ros.applications.aerotech.one_axis import OneAxisFit, OneAxisPart
from selfcal_ros.applications.aerotech.read import (
    load_cal,
    load_cals,
    parse_cal,
    read_cal,
    refuse_errors,
)
from selfcal_ros.applications.aerotech.rules import Gi4
from selfcal_ros.applications.aerotech.verify import (
    controller_figure,
    frame_of_file,
    plane_correction,
    setup_of,
    verify_tables,
)
from selfcal_ros.applications.aerotech.write import cal_text
from selfcal_ros.applications.controllers.export import WRITTEN_SO, place_to_look
from selfcal_ros.cli import cal_lines
from selfcal_ros.cli.deliver import command, replace_files, replaced
from selfcal_ros.cli.terminal import (
    add_fill,
    add_json,
    busy,
    exit_code,
    option_of,
    save_drawing,
    say,
    warn,
)
from selfcal_ros.compensation.export import fill_unknown, provenance
from selfcal_ros.compensation.frame import MARK, MachineFrame, frame_from_comments
from selfcal_ros.compensation.plausible import require_plausible
from selfcal_ros.compensation.residual import (
    Correction,
    Residual,
    bends_between,
    combined,
)
from selfcal_ros.errors import ExitCode, InputError, NotIdentifiableError
from selfcal_ros.model.reference import check_celsius
from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.outputs import plain
from selfcal_ros.reporting.summary.numbers import counted
from selfcal_ros.results import read_result
from selfcal_ros.units import M_PER_UM, RAD_PER_ARCSEC, URAD_PER_RAD

SCANNER_BITS = 16
LEAST_BEND_M = 1e-9
STEPS = (
    "Studio, workspace Configure, Controller, Calibration: name the file; or load it without a "
    "reset by CalibrationLoad()",
    "home the axes: they are corrected only once they are homed",
    "see it act: the data signal Position Calibration All of each axis shows its correction",
)
"""How a file is put into use (Automation1, Axis Calibration)."""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the sub-verbs."""
    group = parser.add_subparsers(dest="sub_verb", metavar="WHAT", required=True)
    for add in (add_files, add_maps, cal_lines.add_line_tables):
        add(group)


def run(args: argparse.Namespace) -> int:
    """Run the sub-verb."""
    return args.run_sub_verb(args)


def add_files(group: argparse._SubParsersAction) -> None:
    """Add the sub-verbs."""
    check = group.add_parser(
        "check", help="check a file against every rule of the format"
    )
    check.add_argument("file", metavar="FILE.cal")
    check.add_argument(
        "--gi4",
        action="store_true",
        help="check galvo tables against the restrictions of the GI4 too",
    )
    check.add_argument(
        "--scanner-bits",
        type=int,
        metavar="N",
        help=f"bits of the scanner protocol behind --gi4 (default {SCANNER_BITS})",
    )
    check.add_argument(
        "--strict",
        action="store_true",
        help="also refuse tolerated and doubtful content",
    )
    check.add_argument("--json", action="store_true", help="print the findings as JSON")
    check.set_defaults(run_sub_verb=_check)
    evaluate = group.add_parser(
        "eval",
        help="print the corrections at a position as JSON, in primary units by axis",
    )
    evaluate.add_argument(
        "files",
        metavar="FILE.cal",
        nargs="+",
        help="file, or several that are loaded together: their corrections are added",
    )
    add = evaluate.add_argument
    add(
        "--position",
        action="append",
        metavar="AXIS=P",
        help="position: primary units, or a length as in 1=10.5mm",
    )
    add(
        "--unit",
        choices=("m", "mm", "um"),
        help="primary unit of the linear axes, for positions "
        "with a unit (default: from the comments of FILE.cal, else mm)",
    )
    add(
        "--counts-per-unit",
        action="append",
        metavar="AXIS=C",
        help="encoder counts per primary unit",
    )
    add(
        "--counts-per-secondary",
        action="append",
        metavar="AXIS=C",
        help="encoder counts per secondary unit",
    )
    add(
        "--temperature", type=float, metavar="T", help="temperature of the scales, degC"
    )
    add(
        "--home-direction",
        action="append",
        metavar="AXIS=CW|CCW",
        help="home direction now, if it has changed since the table was made",
    )
    add(
        "--home-offset",
        action="append",
        metavar="AXIS=P",
        help="home offset now, primary units, if it has changed",
    )
    add(
        "--absolute-feedback-offset",
        action="append",
        metavar="AXIS=C",
        help="absolute feedback offset now, counts, if it has changed",
    )
    add("--json", action="store_true", help="print JSON (the default)")
    evaluate.set_defaults(run_sub_verb=_evaluate)


def _check(args: argparse.Namespace) -> int:
    cal = read_cal(args.file, gi4=_gi4(args))
    errors, warnings, tolerated = (len(cal.of(severity)) for severity in Severity)
    tables = [_described(table) for table in cal.tables]
    lines = [finding.text(args.file) for finding in cal.findings]
    lines += [f"{args.file}:{table['line']}: {table['text']}" for table in tables]
    lines.append(
        f"{args.file}: {counted(len(tables), 'table')}, {counted(errors, 'error')}, "
        f"{counted(warnings, 'warning')}, {tolerated} tolerated"
    )
    findings = [
        {"line": f.line, "severity": f.severity, "what": f.what, "mend": f.remedy}
        for f in cal.findings
    ]
    say(
        args,
        "\n".join(lines),
        {
            "file": args.file,
            "tables": tables,
            "errors": errors,
            "warnings": warnings,
            "tolerated": tolerated,
            "findings": findings,
        },
    )
    _refuse_faults(args, cal)
    return ExitCode.DONE


def _gi4(args: argparse.Namespace) -> Gi4 | None:
    """Return the scanner against whose restrictions a file is checked."""
    if args.scanner_bits is not None and not args.gi4:
        raise InputError("--scanner-bits", "it belongs to a GI4", "add --gi4")
    bits = SCANNER_BITS if args.scanner_bits is None else args.scanner_bits
    if not 6 <= bits <= 48:
        raise InputError("--scanner-bits", f"{bits} bits", "give 16, 18 or 20")
    return Gi4(bits) if args.gi4 else None


def _refuse_faults(args: argparse.Namespace, cal: CalFile) -> None:
    """Refuse a file whose faults were told."""
    refuse_errors(cal)
    if args.gi4 and not any(isinstance(t, Table2D) and t.galvo for t in cal.tables):
        raise InputError(
            args.file, "it has no galvo table, which --gi4 is about", "leave --gi4 out"
        )
    if args.strict and cal.findings:
        first = cal.findings[0]
        raise InputError(f"{args.file}:{first.line}", first.what, first.remedy)


def _described(table: Table1D | Table2D) -> dict:
    shape = " x ".join(map(str, table.values.shape[:2]))
    outputs = ", ".join(map(str, table.outputs))
    inputs = " and ".join(map(str, table.inputs))
    return {
        "line": table.line,
        "kind": table.kind,
        "inputs": list(table.inputs),
        "outputs": list(table.outputs),
        "shape": list(table.values.shape),
        "text": f"{table.kind} table, {shape} entries, corrects axis {outputs} from the "
        f"position of axis {inputs}",
    }


def _evaluate(args: argparse.Namespace) -> int:
    cal = load_cals(args.files)
    frame = frame_from_comments(cal.comments)
    unit = args.unit or (frame.unit if frame else "mm")
    rotary = {
        axis
        for table in cal.tables
        if getattr(table, "rollover", None)
        for axis in table.inputs
    }
    if frame is not None and frame.theta_axis is not None:
        rotary.add(frame.theta_axis)
    positions_in_unit = cal_lines.in_unit(args.position, unit, rotary=rotary)
    positions = cal_lines.numbers(positions_in_unit, "--position")
    if not positions:
        raise InputError("--position", "no position given", "write --position 1=10.5")
    corrections = CalEvaluator(cal.tables, _setup(args)).corrections(positions)
    print(json.dumps({str(axis): float(value) for axis, value in corrections.items()}))
    return ExitCode.DONE


def _setup(args: argparse.Namespace) -> MachineSetup:
    if args.temperature is not None:
        check_celsius(args.temperature, "--temperature")
    directions = cal_lines.pairs(args.home_direction, "--home-direction")
    for axis, word in directions.items():
        if word not in ("CW", "CCW"):
            raise InputError(
                "--home-direction",
                f"'{word}' is not a home direction",
                f"write {axis}=CW or {axis}=CCW",
            )
    values_of: dict[str, dict[int, Any]] = {
        name: cal_lines.numbers(
            getattr(args, name),
            option_of(name),
            positive=name.startswith("counts"),
        )
        for name in (
            "counts_per_unit",
            "counts_per_secondary",
            "home_offset",
            "absolute_feedback_offset",
        )
    }
    values_of["home_direction"] = directions
    axes: set[int] = set().union(*values_of.values())
    return MachineSetup(
        {
            axis: AxisSetup(
                **{name: values.get(axis) for name, values in values_of.items()}
            )
            for axis in axes
        },
        args.temperature,
    )


def add_maps(group: argparse._SubParsersAction) -> None:
    """Add the sub-verbs."""
    export = group.add_parser("export", help="write the tables of an error map")
    export.add_argument("result", metavar="RESULT.json")
    export.add_argument(
        "-o", "--output", metavar="FILE.cal", required=True, help="2D table for x and y"
    )
    export.add_argument(
        "--theta-output",
        metavar="FILE.cal",
        help="1D table for theta, which cannot share a file with a 2D table "
        "(default: FILE_theta.cal)",
    )
    add_fill(export)
    export.add_argument(
        "--onto",
        metavar="ACTIVE.cal",
        help="table of x and y that was loaded during the calibration: the new one replaces it",
    )
    export.add_argument(
        "--force",
        action="store_true",
        help="replace existing files; the old ones are kept with their date",
    )
    add_json(export)
    cal_lines.add_frame(export, theta=True)
    export.set_defaults(run_sub_verb=_export)
    verify = group.add_parser(
        "verify",
        help="print the residual of a simulated controller before and after a file is loaded, µm",
    )
    verify.add_argument("result", metavar="RESULT.json")
    verify.add_argument(
        "files",
        metavar="FILE.cal",
        nargs="+",
        help="file, or several that are loaded together",
    )
    verify.add_argument(
        "--onto",
        metavar="ACTIVE.cal",
        help="table that was loaded during the calibration",
    )
    verify.add_argument("--plot", metavar="F.png", help="draw it (png, svg or pdf)")
    verify.add_argument("--json", action="store_true", help="print as JSON, m and rad")
    cal_lines.add_frame(verify, theta=True, default=False)
    verify.set_defaults(run_sub_verb=_verify)


def _export(args: argparse.Namespace) -> int:
    frame = cal_lines.frame_of(args)
    if args.theta_output and frame.theta_axis is None:
        raise InputError(
            "--theta-output", "no theta table is written", "name --theta-axis"
        )
    result, filled = ready(args)
    comments = [
        *provenance(result, frame, filled=filled, command=command(args)),
        "zero at home by the controller",
    ]
    error_map = result.error_map
    active = _active(args, frame)
    if active is not None:
        error_map = combined(error_map, frame, active)
        say_bent(args, bends_between(error_map, frame, active))
        comments.append("replaces the table that was loaded during the calibration")
    texts = {
        args.output: cal_text(
            [export.table_xy(error_map, frame)],
            comments=comments,
            decimals=export.DECIMALS,
        )
    }
    if frame.theta_axis is not None:
        theta_path = _theta_path(args)
        texts[theta_path] = cal_text(
            [export.table_theta(result.error_map, frame)],
            comments=comments,
            decimals=export.theta_decimals(result.error_map),
        )
    lines, files = [], []
    tables = parse_cal(texts[args.output].encode(), args.output).tables
    loaded = plane_correction(CalEvaluator(tables, setup_of(frame)), frame)
    steps = (*STEPS, place_to_look(frame, loaded, error_map))
    for path, backup in replace_files(args, texts, [args.result, args.onto]).items():
        kind = "1D table for theta" if path != args.output else "2D table for x and y"
        lines.append(f"{path}: {kind}{replaced(backup)}")
        files.append({"file": path, "kind": kind, "old_file": backup})
    say(
        args,
        "\n".join([*lines, *numbered(steps)]),
        {"files": files, "filled": filled, "checklist": list(steps)},
    )
    if frame.theta_axis is not None and frame.theta_counts_per_unit is None:
        warn(
            args,
            "the theta table covers one turn either way and does not roll over; "
            f"--counts-per-unit {frame.theta_axis}=COUNTS makes it roll over",
        )
    return exit_code(result)


def _theta_path(args: argparse.Namespace) -> str:
    """Return the file of the theta table, which is not that of x and y."""
    target = Path(args.output)
    path = args.theta_output or str(
        target.with_name(f"{target.stem}_theta{target.suffix}")
    )
    if os.path.realpath(path) == os.path.realpath(target):
        raise InputError(
            path, "a 1D and a 2D table cannot share a file", "name another file"
        )
    return path


def numbered(steps: Sequence[str]) -> list[str]:
    """Return the lines of a checklist."""
    return [
        "to put it into use:",
        *(f"  {number}. {step}" for number, step in enumerate(steps, 1)),
    ]


def ready(args: argparse.Namespace) -> tuple[CalibrationResult, int]:
    """Return the result to export, its gaps filled if requested, and their number.

    Raises
    ------
    NotIdentifiableError
        If the measured plan does not identify the stage.
    InputError
        As `require_plausible`, unless the map was accepted as steep.
    """
    result = read_result(args.result)
    filled = 0
    if not result.observability.identifiable:
        raise NotIdentifiableError(
            f"{args.result}: the measured plan does not identify the stage; measure "
            "the missing views",
            result.observability,
        )
    if not args.steep:
        require_plausible(result.error_map, args.result)
    if args.fill:
        error_map, filled = fill_unknown(result.error_map)
        result = replace(result, error_map=error_map)
        if filled:
            warn(args, f"{filled} unknown sites filled from their neighbours")
    return result, filled


def say_bent(args: argparse.Namespace, bent_m: float) -> None:
    """Say on stderr how far an active table bends between the nodes of the map, from 1 nm on."""
    if bent_m >= LEAST_BEND_M:
        warn(
            args,
            "--onto: the active table is curved between the nodes of the map by up to "
            f"{bent_m / M_PER_UM:.3g} µm, which the new table does not reproduce; "
            "calibrate with the nodes of that table, or without it",
        )


def require_same_axes(
    args: argparse.Namespace, where: str, comments: Sequence[str], frame: MachineFrame
) -> None:
    """Refuse an active table that says it is for other axes; say if its zero lies elsewhere.

    Zero may do so: the stage frame is that of the field, and two calibrations may have two.
    """
    stated = frame_from_comments(comments, frame)
    if stated is None:
        return
    said = next(line for line in comments if line.startswith(MARK))
    if not stated.same_axes(frame):
        raise InputError(
            where,
            f"it says '{said}', and the options '{frame.comment()}'",
            WRITTEN_SO,
        )
    if (stated.home_x_m, stated.home_y_m) != (frame.home_x_m, frame.home_y_m):
        warn(
            args,
            f"--onto: {where} says '{said}', and the options '{frame.comment()}': right only if "
            "the fields of both calibrations are offset by this difference",
        )


def _active(args: argparse.Namespace, frame: MachineFrame) -> Correction | None:
    """Return the correction by the file of ``--onto``."""
    if args.onto is None:
        return None
    cal = load_cal(args.onto)
    tables = CalEvaluator(cal.tables, setup_of(frame))
    if not {*tables.inputs, *tables.outputs} <= {frame.x_axis, frame.y_axis}:
        raise InputError(
            args.onto,
            f"it is for axes {[*tables.inputs, *tables.outputs]}",
            "name its axes with --x-axis and --y-axis; theta is not combined",
        )
    require_same_axes(args, args.onto, cal.comments, frame)
    return plane_correction(tables, frame)


def _verify(args: argparse.Namespace) -> int:
    result, cal = read_result(args.result), load_cals(args.files)
    frame = cal_lines.frame_of(args, frame_of_file(cal))
    with busy("simulating the controller"):
        verification = verify_tables(
            result.error_map, cal.tables, frame, _active(args, frame)
        )
    one_axis = verification.one_axis
    text, figures = (
        residual_text(verification.residuals),
        figures_of(verification.residuals),
    )
    if one_axis is not None:
        text = f"{text}\n{one_axis_text(one_axis)}"
        figures |= {"one_axis": plain(asdict(one_axis))}
    say(args, text, figures)
    if args.plot:
        save_drawing(controller_figure(verification), args.plot)
    unfit_parts = (
        [part for part in one_axis.parts if part.unfit] if one_axis is not None else []
    )
    if verification.worse and one_axis is not None and not unfit_parts:
        raise InputError(
            cal.where,
            "the tables make the middle line better and the field worse: most of the "
            "error depends on both positions",
            "write a 2D table (selfcal cal export)",
        )
    if verification.worse:
        raise InputError(
            cal.where,
            "the tables make the machine worse",
            "check signs, axes, unit, home position and encoder directions",
        )
    unfit = verification.unfit(result.error_map)
    _warn_of_unfit(args, cal.where, unfit_parts, unfit)
    return ExitCode.NOT_QUALIFIED if unfit or unfit_parts else ExitCode.DONE


def _warn_of_unfit(
    args: argparse.Namespace,
    where: str,
    parts: Sequence[OneAxisPart],
    residuals: Sequence[Residual],
) -> None:
    """Say what the tables leave that those of this map would not."""
    for part in parts:
        warn(
            args,
            f"{where}: of {part.name}, which 1D tables can correct, the "
            f"tables leave {part.rms_left / M_PER_UM:.4g} of {part.rms / M_PER_UM:.4g} µm rms, "
            f"{part.largest_left / M_PER_UM:.4g} of {part.largest / M_PER_UM:.4g} µm at most, "
            "more than the U of the map: they are not those of this map; check sign, offset, "
            "unit and number of entries, or write them again",
        )
    for residual in residuals:
        rms_left, peak_left = (
            size("after") / size("before") for size in (residual.rms, residual.largest)
        )
        warn(
            args,
            f"{where}: the tables leave {100 * rms_left:.0f} % of the "
            f"error at the {residual.place}, {100 * peak_left:.0f} % of the largest, more than the "
            "U of the map: they are not those of this map; check offset, unit and number of rows, "
            "or export them again",
        )


def one_axis_text(fit: OneAxisFit) -> str:
    """Return what 1D tables leave of the parts that they can correct, and what none can correct."""
    title = "what 1D tables can correct of it, rms, µm"
    lines = [f"{title:<48}{'part':>16}{'left':>15}"]
    lines += [
        f"{part.name:<48}{part.rms / M_PER_UM:>16.6f}{part.rms_left / M_PER_UM:>15.6f}"
        for part in fit.parts
    ]
    lines.append(
        f"{'no 1D table of these axes corrects':<64}{fit.beyond / M_PER_UM:>15.6f}"
    )
    if fit.squareness_left:
        lines.append(
            "  straightness leaves the squareness, "
            f"{fit.squareness_left * URAD_PER_RAD:.4g} µrad: selfcal cal orthogonality"
        )
    return "\n".join(lines)


def figures_of(residuals: list[Residual]) -> dict:
    """Return the residuals as data, m and rad."""
    return plain(
        {
            r.place: {
                "points": r.position.shape[1],
                "before": {"rms": r.rms("before"), "max": r.largest("before")},
                "after": {"rms": r.rms("after"), "max": r.largest("after")},
                "shift_after": r.shift_after,
            }
            for r in residuals
        }
    )


def residual_text(residuals: list[Residual]) -> str:
    """Return the residuals as a small table: µm, and arcsec for angular lines."""
    lines = [
        f"{'true - commanded, without its constant shift':<48}{'before':>16}{'after':>15}"
    ]
    names = {
        "sites": "sites",
        "between": "cell centres (cubic stage)",
        "lines": "angular lines",
    }
    for r in residuals:
        unit, scale = (
            ("arcsec", RAD_PER_ARCSEC) if r.place == "lines" else ("µm", M_PER_UM)
        )
        for what, value in (("rms", r.rms), ("max", r.largest)):
            name = f"{r.position.shape[1]} {names[r.place]}, {what}, {unit}"
            lines.append(
                f"{name:<48}{value('before') / scale:>16.6f}{value('after') / scale:>15.6f}"
            )
        shift = ", ".join(f"{s / scale:.6f}" for s in r.shift_after)
        lines.append(
            f"  constant shift after: {shift} {unit} (the controller is zero at home)"
        )
    return "\n".join(lines)
