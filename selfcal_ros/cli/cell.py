# SPDX-License-Identifier: Apache-2.0
"""``selfcal cell``: try a machine without ROS; check the messages of a cell under ROS."""

import argparse
import json
import os
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path

from selfcal_ros.cli.camera import pose_text, require_pixels
from selfcal_ros.cli.processes import need_ros, process, ros_arguments
from selfcal_ros.cli.terminal import (
    add_json,
    add_namespace,
    aside,
    is_yes,
    put,
    require_person,
    say,
    tell,
)
from selfcal_ros.errors import ExitCode, InputError, NoDataError
from selfcal_ros.machine.cell import Cell, connected, read_cell, with_values
from selfcal_ros.machine.trying import Findings, Trial, values_of
from selfcal_ros.outputs import check_outputs, write_bytes
from selfcal_ros.portable import ended_by_signals
from selfcal_ros.reporting.summary.numbers import counted, with_u
from selfcal_ros.settings.estimator import read_plan
from selfcal_ros.units import M_PER_UM
from selfcal_ros.vision.drawing import circled


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    verbs = parser.add_subparsers(dest="cell_verb", metavar="try|check", required=True)
    attempt = verbs.add_parser(
        "try",
        help="connect a machine, look, make small moves, complete its CELL.yaml",
        description="Connects, writes a picture of what it sees, and after a yes moves by the size "
        "of a mark around the present position: pixel size, turn, mirror, backlash and settling "
        "time, written into CELL.yaml with their standard uncertainties. Needs no ROS.",
    )
    attempt.add_argument(
        "cell",
        metavar="CELL.yaml",
        help="machine, limits, detector with mark and mark_size (docs/start/machines.md)",
    )
    attempt.add_argument(
        "--mark-pixels",
        metavar="PX",
        type=float,
        help="size of a mark in the image, pixels; default: it is searched for",
    )
    attempt.add_argument("--yes", action="store_true", help="move without asking")
    attempt.add_argument(
        "-o",
        "--output",
        metavar="SEEN.png",
        help="picture of what is seen, with circles around the marks (default: beside CELL.yaml)",
    )
    add_json(attempt)
    check = verbs.add_parser(
        "check",
        help="drive the cell through a short run and check its messages",
        description="Measures the 3 x 3 marks (4 along even sides) in the middle of the plate, "
        "turned by some 1 mrad, and reports joints, rates, clocks, commands, rest, ids, loss, "
        "check stops, signs. Exit code 0 if all checks pass, else 5.",
    )
    check.add_argument(
        "--plan", metavar="PLAN.yaml", required=True, help="plan with the plate"
    )
    check.add_argument(
        "--params",
        metavar="NODES.yaml",
        help="ROS parameter file; the section of measurement_collector is used",
    )
    add_namespace(check)
    check.add_argument(
        "--settle",
        metavar="S",
        type=float,
        default=1.0,
        help="time to place the plate, from PLACE to MEASURE, s (default 1)",
    )
    check.add_argument(
        "--patience",
        metavar="S",
        type=float,
        default=30.0,
        help="longest wait for the first message, s (default 30)",
    )
    add_json(check)


def run(args: argparse.Namespace) -> int:
    """Try or check the cell."""
    return _try(args) if args.cell_verb == "try" else _check(args)


def _try(args: argparse.Namespace) -> int:
    """Look, move after a yes, write what was found into CELL.yaml."""
    if args.mark_pixels is not None:
        require_pixels(args.mark_pixels)
    cell = read_cell(args.cell)
    output = args.output or f"{Path(args.cell).with_suffix('')}.seen.png"
    check_outputs([args.cell], [output])
    with (
        ended_by_signals(),
        connected(cell, lambda line: tell(line, aside(args))) as machine,
    ):
        trial = Trial(cell, machine, mark_pixels=args.mark_pixels or 0.0)
        marks = _look(args, trial, output)
        if not args.yes and not _agrees(args, trial.step_m):
            say(args, "nothing was moved or written", {"marks": marks})
            return ExitCode.DONE
        findings = trial.move()
    values = _keep(cell, findings)
    backlash = {axis: asdict(reversal) for axis, reversal in findings.reversal.items()}
    say(
        args,
        "\n".join(_found_text(args.cell, findings)),
        {
            "file": args.cell,
            "seen": output if trial.seen is not None else "",
            "marks": marks,
            **values,
            "backlash": backlash,
            "settling_time": findings.settling_s,
            "noise": findings.noise_m,
            "notes": list(findings.notes),
        },
    )
    return ExitCode.DONE


def _look(args: argparse.Namespace, trial: Trial, output: str) -> int:
    """Tell and draw what the cell sees where it stands; return the number of marks."""
    try:
        pixels, marks = trial.look()
    except NoDataError:
        if trial.seen is not None:
            size_px = trial.mark_pixels or min(trial.seen.shape) / 10
            write_bytes(output, circled(trial.seen, trial.judged, size_px))
            tell(f"{output}: what is seen", aside(args))
        raise
    at = zip(trial.position.names, trial.position.positions, strict=True)
    print(
        "position: "
        + ", ".join(
            f"{axis} {value + 0.0:.6g} {'rad' if axis == 'theta' else 'm'}"
            for axis, value in at
        ),
        file=aside(args),
    )
    if pixels is not None:
        write_bytes(output, circled(pixels, trial.judged, trial.mark_pixels))
        tell(
            f"{output}: {counted(len(marks), 'mark')} of {trial.mark_pixels:.3g} pixels in "
            f"an image of {pixels.shape[1]} x {pixels.shape[0]}",
            aside(args),
        )
    return len(marks)


def _keep(cell: Cell, findings: Findings) -> dict[str, object]:
    """Write what was found into the file of the cell; return the detector's part of it."""
    values, notes = values_of(findings)
    if values:
        with_values(cell.path, "detector", values, notes)
    if findings.settling_s > cell.settle.time:
        settle = {"time": float(f"{findings.settling_s:.2g}")}
        with_values(cell.path, "settle", settle, {})
    found: dict[str, object] = {
        f"backlash_{axis}": asdict(reversal)
        for axis, reversal in findings.reversal.items()
    }
    found |= {"settling_time": findings.settling_s, "noise": findings.noise_m}
    with_values(cell.path, "found", found, {})
    return values


def _found_text(path: str, findings: Findings) -> list[str]:
    lines = [] if findings.camera is None else [pose_text(findings.camera, path)]
    lines += [
        f"backlash of {axis}: {with_u(reversal.value / M_PER_UM, reversal.u / M_PER_UM)} µm (k=1)"
        for axis, reversal in findings.reversal.items()
    ]
    lines.append(
        f"at rest {findings.settling_s:.2g} s after a move; noise of a mark "
        f"{findings.noise_m / M_PER_UM:.2g} µm"
    )
    return [*lines, *(f"note: {note}" for note in findings.notes)]


def _agrees(args: argparse.Namespace, step_m: float) -> bool:
    """Ask whether the stage may move."""
    require_person("give --yes")
    tell(f"the stage moves by up to {step_m / M_PER_UM:.4g} µm in x and y", aside(args))
    print("may it? [y/N] ", end="", file=aside(args), flush=True)
    return is_yes(input())


def _check(args: argparse.Namespace) -> int:
    """Check the cell, print the results; exit code 5 if a check fails."""
    need_ros("")
    read_plan(args.plan)
    for option in ("settle", "patience"):
        if not 0 <= getattr(args, option) < 1e6:
            raise InputError(
                f"--{option}",
                f"{getattr(args, option):g} s is not a waiting time",
                "give 0 or more",
            )
    words = [*ros_arguments(args), "--log-level", "warn"]
    items = []
    with (
        ended_by_signals(),
        process(
            "selfcal_ros.nodes.cell_checker",
            [args.plan, str(args.settle), str(args.patience), *words],
            dict(os.environ),
            stdout=subprocess.PIPE,
            text=True,
        ) as child,
    ):
        for line in child.stdout or ():
            try:
                items.append(json.loads(line))
            except ValueError:  # of the middleware
                tell(line.rstrip("\n"), sys.stderr)
                continue
            if not args.json:
                tell(_line(items[-1]))
        code = child.wait()
    if args.json:
        put({"passed": code == ExitCode.DONE, "items": items})
    elif code in (ExitCode.DONE, ExitCode.NOT_QUALIFIED):
        wrong = sum(not item["passed"] for item in items)
        following = sum(bool(item["follows"]) for item in items)
        tell(
            f"{wrong} of {len(items)} checks failed"
            + (f", {following} of them because of others" if following else "")
            if wrong
            else f"all {len(items)} checks passed: the cell is ready for a calibration"
        )
    return code


def _line(item: dict) -> str:
    if item["follows"]:
        return f"      so fails {item['name']}: {item['figure']}"
    remedy = f"\n      {item['remedy']}" if item["remedy"] else ""
    return f"{'pass' if item['passed'] else 'FAIL'}  {item['name']}: {item['figure']}{remedy}"
