# SPDX-License-Identifier: Apache-2.0
"""``selfcal up``: the supervised nodes of a cell, and one screen to run a calibration."""

import argparse
import contextlib
import os
import re
from pathlib import Path

from selfcal_ros.cli.monitor import watch
from selfcal_ros.cli.processes import Supervisor, eyes, need_ros, ros_arguments
from selfcal_ros.cli.terminal import add_json, add_namespace
from selfcal_ros.errors import InputError
from selfcal_ros.machine.cell import read_cell
from selfcal_ros.portable import ended_by_signals
from selfcal_ros.settings.estimator import read_plan

MOST_OF_A_NAME = 200
"""Characters of the name of a folder, below the limit of file systems."""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    parser.add_argument(
        "--plan", metavar="PLAN.yaml", required=True, help="plate and views"
    )
    parser.add_argument(
        "--params", metavar="NODES.yaml", help="ROS parameter file for the nodes"
    )
    add_namespace(parser)
    parser.add_argument(
        "--bag", metavar="FOLDER", help="record the session to this new folder"
    )
    parser.add_argument(
        "--results",
        metavar="FOLDER",
        default=".",
        help="folder for the map of each run, PLAN_RUN.json, and for those of "
        "save_map (default: the working directory)",
    )
    add_json(
        parser, "one JSON object per line: pictures as they change, answers to requests"
    )
    parser.add_argument(
        "--journal",
        metavar="FOLDER",
        help="folder for journals, from which a "
        "restarted collector continues (default: one for each folder of results, "
        "in selfcal of the user's folder for states, ~/.local/state)",
    )
    parser.add_argument(
        "--compensate",
        action="store_true",
        help="publish corrected joint states as well",
    )
    parser.add_argument(
        "--detect",
        action="store_true",
        help="find marks in stage/image as well (mark_detector in NODES.yaml)",
    )
    parser.add_argument(
        "--cell",
        metavar="CELL.yaml",
        help="machine to be driven by cell_driver (docs/start/machines.md)",
    )
    parser.add_argument(
        "--simulate",
        action="store_true",
        help="also run a simulated cell, to try it out",
    )


def run(args: argparse.Namespace) -> int:
    """Start and supervise the nodes, show the screen, stop the nodes at the end."""
    need_ros("")
    read_plan(args.plan)
    nodes = commands(args)
    if args.bag and Path(args.bag).exists():
        raise InputError(args.bag, "exists already", "remove it or name another folder")
    if not Path(args.results).is_dir():
        raise InputError(args.results, "is not a folder", "name one that exists")
    with ended_by_signals(), contextlib.ExitStack() as stack:
        supervisor = stack.enter_context(Supervisor(nodes, dict(os.environ)))
        monitor = stack.enter_context(eyes(args.namespace))
        return watch(monitor, supervisor.log, supervisor.step, as_json=args.json)


def state_folder(results: str) -> Path:
    """Return the folder for the journals of runs whose maps go to `results`.

    Raises
    ------
    InputError
        If the user has no folder for states.
    """
    state, home = os.environ.get("XDG_STATE_HOME"), os.environ.get("HOME")
    if not state and not home:
        raise InputError(
            "HOME",
            "is not set, and journals are kept there",
            "set it, or give --journal FOLDER",
        )
    name = re.sub(r"[^\w.-]", "_", str(Path(results).absolute()).strip("/")) or "root"
    return Path(
        state or Path(home or "", ".local/state"), "selfcal", name[-MOST_OF_A_NAME:]
    )


def commands(args: argparse.Namespace) -> dict[str, list[str]]:
    """Return node -> its arguments."""
    common = ros_arguments(args)

    def with_parameters(**values: str) -> list[str]:
        return common + [
            word
            for name, value in values.items()
            for word in ("-p", f"{name}:={value}")
        ]

    # separate: an interrupted simulated run must never continue with real readings
    folder = "journals_simulated" if args.simulate else "journals"
    journal = args.journal or str(state_folder(args.results) / folder)
    name_suffix = "_simulated" if args.simulate else ""
    # first, so that a parameter file can override it
    saved = Path(args.results, f"{Path(args.plan).stem}{name_suffix}_{{run_id}}.json")
    nodes = {
        "measurement_collector": with_parameters(journal=str(Path(journal).absolute())),
        "solver": [
            "--ros-args",
            "-p",
            f"save_path:={saved.absolute()}",
            *common[1:],
            "-p",
            f"result_folder:={Path(args.results).absolute()}",
        ],
        "pose_sequencer": with_parameters(plan=str(Path(args.plan).absolute())),
    }
    if args.compensate:
        nodes["compensator"] = with_parameters()
    if args.detect:
        nodes["mark_detector"] = with_parameters()
    if args.bag:
        nodes["bag_recorder"] = with_parameters(bag=str(Path(args.bag).absolute()))
    if args.cell:
        cell = read_cell(args.cell)
        nodes["cell_driver"] = with_parameters(cell=str(cell.path.absolute()))
        nodes["measurement_collector"] += ["-p", f"measurement_sense:={cell.sense}"]
        if cell.placing == "robot":
            nodes["pose_sequencer"] += ["-p", "auto_confirm:=true"]
    if args.simulate:
        nodes["stage_simulator"] = with_parameters()
    return nodes
