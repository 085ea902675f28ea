# SPDX-License-Identifier: Apache-2.0
"""The files among the arguments of all verbs: outputs that exist, inputs of another kind.

What an argument stands for is its name in the help: BAG, RESULT.json, PLAN.yaml, ...
"""

import argparse
import os
import re
import shlex
from collections.abc import Iterator
from typing import NamedTuple

from selfcal_ros.errors import InputError

STDOUT = "-"
"""Name of an output file: the result goes to stdout, everything else to stderr."""
OUTPUTS = {"--output", "--report", "--plot", "--theta-output", "--cal", "--save-csv"}
"""Options that name a file to write."""
FOLDERS = ("BAG", "FOLDER", "DIR")
"""Names of outputs that are folders: they are never replaced."""
FORMATS = {".json": (), ".yaml": (".yml",), ".csv": (".txt",), ".xml": ()}
"""Ending of a file to write, as in the name of its argument -> others that it may have."""
OTHERS = (
    ".html",
    ".pdf",
    ".png",
    ".svg",
    ".txt",
    ".mcap",
    ".cal",
    *FORMATS,
)
"""Endings that say of a file that it is of another kind."""
TEXTS = ("NAME", "NS", "TEXT", "VALUE")
"""Names of arguments that may be empty; the others name a file, a number or a choice."""
SEEN = 1 << 14
"""Bytes at the beginning of a file by which its kind is recognised."""

BAG, RESULT, PLAN, SIMULATION = "a bag", "a result", "a plan", "a simulation"
PARAMETERS = "a parameter file of nodes"
CAL = "a calibration file"
TABLE = "a table of numbers"
PROGRAM = "a G-code program"
CELL = "a cell"
WANTED = {
    "BAG": BAG,
    "A.json": RESULT,
    "B.json": RESULT,
    "RESULT.json": RESULT,
    "PLAN.yaml": PLAN,
    "CELL.yaml": CELL,
    "SIM.yaml": SIMULATION,
    "NODES.yaml": PARAMETERS,
    "FILE.cal": CAL,
    "ACTIVE.cal": CAL,
    "POINTS.csv": TABLE,
    "MAP.csv": TABLE,
    "DATA.csv": TABLE,
    "FILE.csv": TABLE,
    "READINGS.csv": TABLE,
    "IN": PROGRAM,
}
"""Name of an argument -> kind of file that it stands for."""
USES = {
    BAG: "a map is computed from it with `selfcal solve {} -o RESULT.json`",
    RESULT: "`selfcal report {}` shows it",
    PLAN: "`selfcal plan check {}` says what it determines",
    SIMULATION: "`selfcal simulate {} -o BAG` writes its bag",
    CELL: "`selfcal cell try {}` shows what its machine sees",
    PARAMETERS: "give it with --params",
    CAL: "`selfcal cal check {}` reads it",
    TABLE: "`selfcal apply RESULT.json {0} -o OUT.csv` corrects points; "
    "`selfcal detect {0} --plan PLAN.yaml -o BAG` makes a bag of readings",
    PROGRAM: "`selfcal gcode {} RESULT.json -o OUT` corrects it",
}
"""Kind of file -> what it is good for, with its name."""
BEGINNINGS = (
    (BAG, re.compile(rb"\x89MCAP0\r\n")),
    (RESULT, re.compile(rb'\s*\{\s*"schema": "selfcal\.result/')),
    (CAL, re.compile(rb"(?:.*\n)*?:(?:START|GALVO2D)")),
    (PARAMETERS, re.compile(rb"(?:.*\n)*?\s+ros__parameters\s*:")),
    (PLAN, re.compile(rb"(?:.*\n)*?plan_id\s*:")),
    (CELL, re.compile(rb"(?:.*\n)*?limits[ \t]*:")),
    (SIMULATION, re.compile(rb"(?:.*\n)*?(?:plan|truth|noise)\s*:")),
)
ENDINGS = {".csv": TABLE, ".nc": PROGRAM, ".ngc": PROGRAM, ".gcode": PROGRAM}


class File(NamedTuple):
    """An input among the arguments: its name, the kinds it may be of, and the one it is of."""

    path: str
    wanted: tuple[str, ...]
    kind: str

    @property
    def misplaced(self) -> bool:
        """Whether it is known to be of another kind."""
        return bool(self.kind) and self.kind not in self.wanted


def add_force(parser: argparse.ArgumentParser) -> None:
    """Add the option ``--force`` to a verb that writes files and has none yet."""
    if "--force" not in parser._option_string_actions and any(_outputs(parser)):
        parser.add_argument(
            "--force", action="store_true", help="replace files that exist"
        )


def _outputs(parser: argparse.ArgumentParser) -> Iterator[argparse.Action]:
    """Yield the arguments that name files to write."""
    for action in parser._actions:
        if (
            OUTPUTS.intersection(action.option_strings)
            and action.metavar not in FOLDERS
        ):
            yield action


def check_given(args: argparse.Namespace) -> None:
    """Refuse an empty file name, number or choice, as of a shell's variable that is not set.

    Raises
    ------
    InputError
        For the first of them.
    """
    for action in args.leaf._actions:
        values = getattr(args, action.dest, None)
        empty = values == "" or (isinstance(values, list) and "" in values)
        if empty and action.default != "" and action.metavar not in TEXTS:
            raise InputError(
                action.option_strings[-1]
                if action.option_strings
                else str(action.metavar),
                "is empty",
                "give a value"
                + ", or leave the option out" * bool(action.option_strings),
            )


def check_existing(args: argparse.Namespace) -> None:
    """Refuse to replace a file without ``--force``.

    An input, or a file in a bag, that is named as an output is left to the verb, which never writes
    it; an empty file has nothing to lose.

    Raises
    ------
    InputError
        If the file of an output exists, or its name is that of another kind of file.
    """
    from selfcal_ros.outputs import refuse_existing  # with numpy

    inputs = {os.path.realpath(item.path) for item in _files(args)}
    for action in args.leaf._actions:
        if OUTPUTS.intersection(action.option_strings):
            _refuse_stdout(getattr(args, action.dest), action)
    for action in _outputs(args.leaf):
        name = getattr(args, action.dest)
        if name == STDOUT:
            continue
        place = os.path.realpath(name or "")
        if name and place not in inputs and os.path.dirname(place) not in inputs:
            _refuse_ending(name, str(action.metavar))
            refuse_existing([name], force=args.force)


def _refuse_stdout(name: str | None, action: argparse.Action) -> None:
    """Raise InputError for ``-`` if it does not stand for stdout: it would be a file's name."""
    if name == STDOUT and "stdout" not in str(action.help):
        raise InputError(
            f"{action.option_strings[-1]} {STDOUT}",
            "this cannot be written to stdout",
            f"name a {'folder' if action.metavar in FOLDERS else 'file'}",
        )


def _refuse_ending(path: str, metavar: str) -> None:
    """Raise InputError if the name of an output ends as that of a file of another kind."""
    ending = os.path.splitext(path)[1].lower()
    expected = [os.path.splitext(name)[1] or name for name in metavar.split("|")]
    if any(name not in FORMATS for name in expected) or ending not in OTHERS:
        return
    if not any(ending in (name, *FORMATS[name]) for name in expected):
        raise InputError(
            path,
            f"{metavar} is written here, which is not {ending}",
            f"end the name in {' or '.join(expected)}",
        )


def misplaced(args: argparse.Namespace) -> InputError | None:
    """Return the error of inputs that are of another kind than their places ask for; or None."""
    files = list(_files(args))
    wrong = [item for item in files if item.misplaced]
    for first in wrong:
        for swapped in wrong:
            if first.kind in swapped.wanted and swapped.kind in first.wanted:
                words = [
                    {first.path: swapped.path, swapped.path: first.path}.get(word, word)
                    for word in args.words
                ]
                return InputError(
                    first.path,
                    f"is {first.kind}, and {swapped.path} is {swapped.kind}: they are swapped",
                    f"write `selfcal {shlex.join(words)}`",
                )
    for item in wrong:
        return InputError(
            item.path,
            f"is {item.kind}, and {' or '.join(item.wanted)} is needed here",
            USES[item.kind].format(shlex.quote(item.path)),
        )
    return None


def _files(args: argparse.Namespace) -> Iterator[File]:
    """Yield the inputs among the arguments that are files or folders."""
    for action in args.leaf._actions:
        kinds_wanted = tuple(
            WANTED[name] for name in str(action.metavar).split("|") if name in WANTED
        )
        values = getattr(args, action.dest, None)
        for value in values if isinstance(values, list) else [values]:
            if (
                kinds_wanted
                and isinstance(value, str)
                and not OUTPUTS.intersection(action.option_strings)
            ):
                yield File(value, kinds_wanted, kind_of(value))


def kind_of(path: str) -> str:
    """Return the kind of a file or folder; "" if it is not one that verbs read."""
    try:
        if os.path.isdir(path):
            names = os.listdir(path)
            return (
                BAG
                if any(
                    name == "metadata.yaml" or name.endswith(".mcap") for name in names
                )
                else ""
            )
        if not os.path.isfile(path):
            return ""
        with open(path, "rb") as file:
            beginning = file.read(SEEN)
    except (OSError, ValueError):
        return ""  # whoever reads it says why not
    ending = ENDINGS.get(os.path.splitext(path)[1].lower(), "")
    return next(
        (kind for kind, pattern in BEGINNINGS if pattern.match(beginning)), ending
    )
