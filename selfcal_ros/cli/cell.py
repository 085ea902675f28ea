# SPDX-License-Identifier: Apache-2.0
"""``selfcal cell check``: a short run that shows an integrator the faults of a cell."""

import argparse
import json
import os
import subprocess

from selfcal_ros.cli.processes import ended_by_signals, need_ros, process, ros_arguments
from selfcal_ros.cli.terminal import add_json, put, tell
from selfcal_ros.collection.settings.estimator import read_plan
from selfcal_ros.errors import ExitCode, InputError


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    check = parser.add_subparsers(dest="cell_verb", metavar="check", required=True).add_parser(
        "check", help="drive the cell through a short run and check its messages",
        description="Measures the 3 x 3 marks (4 along even sides) in the middle of the plate, "
        "placed straight, and reports joints, rates, clocks, commands, rest, ids, loss, check "
        "stops, signs. Exit code 0 if all checks pass, else 5.")
    check.add_argument("--plan", metavar="PLAN.yaml", required=True, help="plan with the plate")
    check.add_argument("--params", metavar="NODES.yaml", help="ROS parameter file; the section "
                       "of measurement_collector is used")
    check.add_argument("--namespace", metavar="NS", default="", help="namespace of the cell")
    check.add_argument("--settle", metavar="S", type=float, default=1.0,
                       help="time to place the plate, from PLACE to MEASURE, s (default 1)")
    check.add_argument("--patience", metavar="S", type=float, default=30.0,
                       help="longest wait for the first message, s (default 30)")
    add_json(check)


def run(args: argparse.Namespace) -> int:
    """Check the cell, print the results; exit code 5 if a check fails."""
    need_ros("")
    read_plan(args.plan)
    for option in ("settle", "patience"):
        if not 0 <= getattr(args, option) < 1e6:
            raise InputError(f"--{option}", f"{getattr(args, option):g} s is not a waiting time",
                             "give 0 or more")
    words = [*ros_arguments(args), "--log-level", "warn"]
    items = []
    with ended_by_signals(), process(
            "selfcal_ros.nodes.cell_checker",
            [args.plan, str(args.settle), str(args.patience), *words], dict(os.environ),
            stdout=subprocess.PIPE, text=True) as child:
        for line in child.stdout or ():
            items.append(json.loads(line))
            if not args.json:
                tell(_line(items[-1]))
        code = child.wait()
    if args.json:
        put({"passed": code == ExitCode.DONE, "items": items})
    elif code in (ExitCode.DONE, ExitCode.NOT_QUALIFIED):
        wrong = sum(not item["passed"] for item in items)
        tell(f"{wrong} of {len(items)} checks failed" if wrong else
             f"all {len(items)} checks passed: the cell is ready for a calibration")
    return code


def _line(item: dict) -> str:
    remedy = f"\n      {item['remedy']}" if item["remedy"] else ""
    return f"{'pass' if item['passed'] else 'FAIL'}  {item['name']}: {item['figure']}{remedy}"
