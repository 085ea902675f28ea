# SPDX-License-Identifier: Apache-2.0
"""``selfcal measure``: a plan measured by a machine without ROS, from the plate to the report."""

import argparse
import contextlib
import math
import signal
import sys
from pathlib import Path
from types import ModuleType
from typing import TextIO

from selfcal_ros.cli import solve, verify
from selfcal_ros.cli.terminal import (
    add_json,
    aside,
    is_yes,
    require_person,
    save_drawing,
    tell,
)
from selfcal_ros.collection.expected import ViewProgress
from selfcal_ros.collection.inputs import Command
from selfcal_ros.errors import InputError, NoDataError
from selfcal_ros.machine.cell import connected, read_cell
from selfcal_ros.machine.interface import MachineError
from selfcal_ros.machine.measuring import Run
from selfcal_ros.outputs import can_print_symbols, to_ascii
from selfcal_ros.portable import columns_of, ended_by_signals, fitted, say_no_more
from selfcal_ros.reporting.summary.numbers import um
from selfcal_ros.settings.estimator import read_plan
from selfcal_ros.units import MM_PER_M

LINE = 80
"""Columns of the line of progress where those of the terminal are not known."""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    parser.description = (
        "Leads through the views of a plan: says how the plate is to be placed, moves the stage "
        "after a yes, shows coverage, noise and rejections, saves every exposure at once, and "
        "solves at the end. Ctrl-C stops the stage; --resume continues."
    )
    parser.add_argument("plan", metavar="PLAN.yaml", help="plan with plate and views")
    parser.add_argument(
        "cell",
        metavar="CELL.yaml",
        help="machine, limits, detector (docs/start/machines.md)",
    )
    parser.add_argument(
        "-o",
        "--output",
        metavar="BAG",
        required=True,
        help="bag folder to create; the result is written beside it, BAG.json and BAG.html",
    )
    parser.add_argument(
        "--yes",
        action="store_true",
        help="ask nothing: the plate is placed by a robot or a simulation, and the stage may move",
    )
    parser.add_argument(
        "--resume",
        action="store_true",
        help="continue the bag of a run that was interrupted",
    )
    add_json(parser, "RESULT.json, and all else on stderr")


def run(args: argparse.Namespace) -> int:
    """Measure, solve, report."""
    plan, cell = read_plan(args.plan), read_cell(args.cell)
    bag = Path(args.output)
    resume_hint = f"{bag} is kept, --resume continues"
    result, report = f"{bag}.json", f"{bag}.html"
    if not (args.resume or plan.verify or bag.exists()):
        _refuse_files(result, report)
    desk = Terminal(args.yes, bag, aside(args))
    if not args.yes:
        require_person("give --yes where a robot or a simulation places the plate")
    if args.yes and cell.placing == "person":
        raise InputError(
            f"{cell.path}: placing",
            "--yes, but a person places the plate",
            "write placing: robot, or leave out --yes",
        )
    work = None
    try:
        with ended_by_signals(), connected(cell, desk.say) as machine:
            work = Run(plan, cell, machine, bag, desk)
            work.require()
            work.measure(resume=args.resume)
    except InputError as error:
        desk.end()
        kind = NoDataError if isinstance(error, NoDataError) else InputError
        of_cell = isinstance(error, MachineError | NoDataError)
        is_kept = bag.exists() if of_cell else work is not None and work.begun
        remedies = filter(None, [error.remedy, resume_hint if is_kept else ""])
        raise kind(error.where, error.what, "; ".join(remedies)) from error
    except (KeyboardInterrupt, SystemExit) as ended:
        desk.end()
        bag_state = resume_hint if bag.exists() else "nothing was measured yet"
        with contextlib.suppress(OSError):  # of a terminal that is closed
            tell(f"selfcal measure: stopped; {bag_state}", sys.stderr)
        if isinstance(ended, SystemExit):
            raise
        return 128 + signal.SIGINT
    desk.end()
    sense = ["--sense", str(cell.sense)]
    if plan.verify:
        return _followed_by(verify, args, [plan.verify, str(bag), *sense])
    outputs = ["-o", result, "--report", report]
    return _followed_by(solve, args, [str(bag), *outputs, *sense])


def _refuse_files(*paths: str) -> None:
    """Refuse to replace files of somebody else, before hours of measurement."""
    for path in paths:
        if Path(path).exists():
            raise InputError(
                path,
                "it exists, and the measurement would be written over it",
                "name another BAG, or move it elsewhere",
            )


def _followed_by(verb: ModuleType, args: argparse.Namespace, words: list[str]) -> int:
    """Run another verb with `words`, in the name of this one."""
    parser = argparse.ArgumentParser()
    verb.configure(parser)
    followed = parser.parse_args(words, argparse.Namespace(leaf=args.leaf))
    followed.json = args.json
    return verb.run(followed)


class Terminal:
    """The person at the terminal; with `is_silent` everything is answered with yes.

    Parameters
    ----------
    is_silent : bool
        Ask nothing.
    bag : Path
        The bag; pictures of the placements are written beside it.
    stream : TextIO
        Where everything is printed.
    """

    def __init__(self, is_silent: bool, bag: Path, stream: TextIO) -> None:
        self._is_silent, self._bag, self._stream = is_silent, bag, stream
        self._is_open = False  # a line is drawn that the next one overwrites

    def place(self, command: Command) -> None:
        """Say how the plate is to lie, with a picture, and wait."""
        from selfcal_ros.reporting.figures.places import (
            plan_figure,
        )  # with numbers of results

        view = command.placed()
        x, y = (value * MM_PER_M for value in view.translation_m)
        picture = f"{self._bag}.placing.png"
        save_drawing(plan_figure(command.plate(), [view]), picture)
        turn = math.degrees(view.rotation_rad)
        self.say(
            f"place the plate: turned by {turn:g}° counter-clockwise, its centre at "
            f"({x:g}, {y:g}) mm from the centre of the field ({picture})"
        )
        self._ask("Enter when it lies there: ")

    def may_move(self, text: str) -> bool:
        """Ask."""
        return self._is_silent or is_yes(self._ask(f"{text} [y/N] "))

    def lies_still(self, view: str) -> bool:
        """Ask."""
        return self.may_move(
            f"view '{view}' was interrupted: does the plate lie as it did?"
        )

    def _ask(self, text: str) -> str:
        self.end()
        if self._is_silent:
            return ""
        try:
            self._print(text, end="")
            return input().strip()
        except EOFError:
            raise KeyboardInterrupt from None

    def show(self, progress: ViewProgress) -> None:
        """Show coverage, noise and rejections in one line."""
        line = progress_line(progress)
        if self._stream.isatty():
            width = columns_of(self._stream) or LINE
            self._print(f"\r\x1b[2K{line[: width - 1]}", end="")
            self._is_open = True
        elif progress.complete:
            self.say(line)

    def say(self, line: str) -> None:
        """Show a line."""
        self.end()
        self._print(fitted(line, self._stream))

    def end(self) -> None:
        """Leave the line that is overwritten."""
        if self._is_open:
            self._print("")
        self._is_open = False

    def _print(self, text: str, end: str = "\n") -> None:
        """Print; where nobody reads it any longer, the measurement goes on."""
        try:
            print(
                text if can_print_symbols(self._stream) else to_ascii(text),
                end=end,
                file=self._stream,
                flush=True,
            )
        except OSError:
            say_no_more(self._stream)


def progress_line(progress: ViewProgress) -> str:
    """Return how far a view is, in one line."""
    readings = progress.readings
    parts = [
        f"{done} of {expected} {what}"
        for done, expected, what in (
            (progress.grid_done, progress.grid_expected, "marks"),
            (progress.angular_done, progress.angular_expected, "lines"),
        )
        if expected
    ]
    rejected = sum(readings.rejected.values())
    if rejected:
        reasons = sorted(readings.rejected.items(), key=lambda item: -item[1])
        parts.append(
            f"{rejected} rejected ({', '.join(f'{name} {n}' for name, n in reasons)})"
        )
    if math.isfinite(readings.sigma_xy):
        parts.append(f"noise {um(readings.sigma_xy)}")
    return f"  {100 * progress.coverage:3.0f} %  " + ", ".join(parts)
