# SPDX-License-Identifier: Apache-2.0
"""``selfcal cal check`` and ``selfcal cal eval``."""

import argparse
import json
import math
from typing import TYPE_CHECKING, Any

from selfcal_ros.cli.aerotech.options import in_unit, numbers, pairs
from selfcal_ros.errors import ExitCode, InputError

if TYPE_CHECKING:
    from selfcal_ros.aerotech.evaluate import MachineSetup
    from selfcal_ros.aerotech.model import Table1D, Table2D

SCANNER_BITS = 16


def add_to(group: argparse._SubParsersAction) -> None:
    """Add the sub-verbs."""
    check = group.add_parser("check", help="check a file against every rule of the format")
    check.add_argument("file", metavar="FILE.cal")
    check.add_argument("--gi4", action="store_true",
                       help="check galvo tables against the restrictions of the GI4 too")
    check.add_argument("--scanner-bits", type=int, metavar="N",
                       help=f"bits of the scanner protocol behind --gi4 (default {SCANNER_BITS})")
    check.add_argument("--strict", action="store_true",
                       help="also refuse tolerated and doubtful content")
    check.add_argument("--json", action="store_true", help="print the findings as JSON")
    check.set_defaults(run_sub_verb=_check)
    evaluate = group.add_parser("eval", help="print the corrections at a position as JSON, "
                                             "in primary units by axis")
    evaluate.add_argument("file", metavar="FILE.cal")
    add = evaluate.add_argument
    add("--position", action="append", metavar="AXIS=P", help="position: primary units, or a "
        "length as in 1=10.5mm")
    add("--unit", choices=("m", "mm", "um"), help="primary unit of the linear axes, for positions "
        "with a unit (default: from the comments of FILE.cal, else mm)")
    add("--counts-per-unit", action="append", metavar="AXIS=C",
        help="encoder counts per primary unit")
    add("--counts-per-secondary", action="append", metavar="AXIS=C",
        help="encoder counts per secondary unit")
    add("--temperature", type=float, metavar="T", help="temperature of the scales, degC")
    add("--home-direction", action="append", metavar="AXIS=CW|CCW",
        help="home direction now, if it has changed since the table was made")
    add("--home-offset", action="append", metavar="AXIS=P",
        help="home offset now, primary units, if it has changed")
    add("--absolute-feedback-offset", action="append", metavar="AXIS=C",
        help="absolute feedback offset now, counts, if it has changed")
    add("--json", action="store_true", help="print JSON (the default)")
    evaluate.set_defaults(run_sub_verb=_evaluate)


def _check(args: argparse.Namespace) -> int:
    from selfcal_ros.aerotech.model import Severity
    from selfcal_ros.aerotech.read import read_cal, refuse_errors
    from selfcal_ros.aerotech.rules import Gi4

    if args.scanner_bits is not None and not args.gi4:
        raise InputError("--scanner-bits", "it belongs to a GI4", "add --gi4")
    bits = SCANNER_BITS if args.scanner_bits is None else args.scanner_bits
    if not 6 <= bits <= 48:
        raise InputError("--scanner-bits", f"{bits} bits", "give 16, 18 or 20")
    cal = read_cal(args.file, gi4=Gi4(bits) if args.gi4 else None)
    counts = {severity: len(cal.of(severity)) for severity in Severity}
    if args.json:
        print(json.dumps({
            "file": args.file, "tables": [_described(table) for table in cal.tables],
            **{f"{severity}s" if severity is not Severity.TOLERATED else "tolerated": number
               for severity, number in counts.items()},
            "findings": [{"line": f.line, "severity": f.severity, "what": f.what, "mend": f.remedy}
                         for f in cal.findings]}, indent=1))
    else:
        for finding in cal.findings:
            print(finding.text(args.file))
        for table in cal.tables:
            print(f"{args.file}:{table.line}: {_described(table)['text']}")
        print(f"{args.file}: {len(cal.tables)} tables, {counts[Severity.ERROR]} errors, "
              f"{counts[Severity.WARNING]} warnings, {counts[Severity.TOLERATED]} tolerated")
    refuse_errors(cal)
    if args.strict and cal.findings:
        first = cal.findings[0]
        raise InputError(f"{args.file}:{first.line}", first.what, first.remedy)
    return int(ExitCode.DONE)


def _described(table: "Table1D | Table2D") -> dict:
    shape = " x ".join(map(str, table.values.shape[:2]))
    outputs = ", ".join(map(str, table.outputs))
    inputs = " and ".join(map(str, table.inputs))
    return {"line": table.line, "kind": table.kind, "inputs": list(table.inputs),
            "outputs": list(table.outputs), "shape": list(table.values.shape),
            "text": f"{table.kind} table, {shape} entries, corrects axis {outputs} from the "
                    f"position of axis {inputs}"}


def _evaluate(args: argparse.Namespace) -> int:
    from selfcal_ros.aerotech.evaluate import CalEvaluator
    from selfcal_ros.aerotech.machine import frame_from_comments
    from selfcal_ros.aerotech.read import load_cal

    cal = load_cal(args.file)
    frame = frame_from_comments(cal.comments)
    unit = args.unit or (frame.unit if frame else "mm")
    rotary = {axis for table in cal.tables if getattr(table, "rollover", None)
              for axis in table.inputs}
    if frame is not None and frame.theta_axis is not None:
        rotary.add(frame.theta_axis)
    positions = numbers(in_unit(args.position, unit, rotary=rotary), "--position")
    if not positions:
        raise InputError("--position", "no position given", "write --position 1=10.5")
    corrections = CalEvaluator(cal.tables, _setup(args)).corrections(positions)
    print(json.dumps({str(axis): float(value) for axis, value in corrections.items()}))
    return int(ExitCode.DONE)


def _setup(args: argparse.Namespace) -> "MachineSetup":
    from selfcal_ros.aerotech.evaluate import AxisSetup, MachineSetup

    if args.temperature is not None and not math.isfinite(args.temperature):
        raise InputError("--temperature", f"{args.temperature} is not a temperature", "give degC")
    directions = pairs(args.home_direction, "--home-direction")
    for axis, word in directions.items():
        if word not in ("CW", "CCW"):
            raise InputError("--home-direction", f"'{word}' is not a home direction",
                             f"write {axis}=CW or {axis}=CCW")
    found: dict[str, dict[int, Any]] = {
        "counts_per_unit": numbers(args.counts_per_unit, "--counts-per-unit", positive=True),
        "counts_per_secondary": numbers(args.counts_per_secondary, "--counts-per-secondary",
                                        positive=True),
        "home_direction": directions,
        "home_offset": numbers(args.home_offset, "--home-offset"),
        "absolute_feedback_offset": numbers(args.absolute_feedback_offset,
                                            "--absolute-feedback-offset"),
    }
    axes: set[int] = set().union(*found.values())
    return MachineSetup({axis: AxisSetup(**{name: values.get(axis)
                                            for name, values in found.items()})
                         for axis in axes}, args.temperature)
