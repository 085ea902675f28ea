# SPDX-License-Identifier: Apache-2.0
"""The ``selfcal`` command: find the verbs, run one, turn errors into exit codes.

A verb is a module of this package with ``configure(parser)`` and ``run(args) -> int``. It is
imported when it is asked for, so that ``selfcal --help`` does not load numpy.
"""

import argparse
import importlib
import os
import signal
import sys
from collections.abc import Iterable, Sequence
from typing import Any, NoReturn

from selfcal_ros import __version__, cli
from selfcal_ros.errors import ExitCode, InputError, SelfcalError, did_you_mean, printable

VERBS = {
    "apply": "correct a table of positions: commands for true positions, or the inverse",
    "batch": "calibrate from many bags on all cores: one table, trends and changes over time",
    "cal": "read, check, evaluate, write and verify calibration files for Aerotech controllers",
    "call": "ask the sequencer of a running cell: start, confirm, redo, skip or abort",
    "camera": "find the pixel size, rotation and mirroring of a camera",
    "cell": "check a machine cell before its first calibration",
    "certificate": "write a digital calibration certificate: DCC 3.3.0 (XML)",
    "combine": "combine several calibrations of a stage into one map",
    "detect": "find the marks in the images of a bag",
    "diff": "compare two results after removing the datum difference",
    "embed": "keep result, plan and exports in the bag, as MCAP attachments",
    "export": "write the map of a result as a table for a controller",
    "gcode": "correct a G-code program: for controllers without tables",
    "iso230": "figures of ISO 230: accuracy and repeatability of axes, circularity, diagonals",
    "monitor": "show a running cell on one screen, and operate its sequencer by keys",
    "plan": "check a plan of views before it is measured, or suggest views",
    "plot": "draw the maps of a result: png, svg or pdf",
    "recheck": "check whether a calibrated stage has changed, from one view of the same plate",
    "replay": "play a bag into the live nodes and take the map from them",
    "report": "write a calibration report: one self-contained HTML or PDF file",
    "reproduce": "repeat the published simulations of Hu or Qiao, next to the published figures",
    "simulate": "write a bag of a simulated cell, with its known truth",
    "solve": "calibrate from a bag: MCAP file or rosbag2 folder",
    "step-diagonal": "identify linear, straightness and squareness errors from a laser "
                     "step-diagonal measurement",
    "table": "write the maps of a result as a table: csv or npz",
    "trace": "show which result a table was exported from, and whether both are unchanged",
    "up": "start and supervise the nodes of a cell, and run a calibration on one screen"}
"""Verbs and what they do; `step-diagonal` is the module ``step_diagonal.py`` of this package."""

COMPLETE = "_ARGCOMPLETE"
"""Set in the environment by a shell that asks for completions."""


def build_parser(only: str | None = None) -> argparse.ArgumentParser:
    """Return the parser of all verbs, or of `only` alone if it is a verb.

    If it is none, no verb is imported: their names and help are known without.
    """
    parser = Parser(
        prog="selfcal", description="Self-calibration of XY-theta stages.",
        epilog="exit codes: 0 done, 2 bad usage or input, 3 the measured plan does not identify "
               "the stage, 4 no usable data, 5 not qualified, 1 internal error")
    parser.add_argument("--version", action="version", version=f"selfcal {__version__}")
    group = parser.add_subparsers(dest="verb", metavar="VERB", required=True)
    for name in [only] if only in VERBS else VERBS:
        sub = group.add_parser(name, help=VERBS[name], description=VERBS[name])
        if only in (None, name):
            module = importlib.import_module(f"{cli.__name__}.{name.replace('-', '_')}")
            module.configure(sub)
            sub.set_defaults(run=module.run)
    return parser


def _verb_in(words: Iterable[str]) -> str:
    """Return the first word that is no option, empty if there is none."""
    return next((word for word in words if not word.startswith("-")), "")


def _complete() -> None:
    """Answer a shell's request for completions and end; see README."""
    import argcomplete  # for completion only

    whole = os.environ.get("COMP_LINE", "").split(" ")[1:-1]  # without the word at the cursor
    argcomplete.autocomplete(build_parser(_verb_in(word for word in whole if word)))


def main(argv: list[str] | None = None) -> int:
    """Run one verb and return its exit code."""
    prefix = "selfcal"
    try:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})  # blocked by `start`
        if COMPLETE in os.environ:
            _complete()
        words = sys.argv[1:] if argv is None else argv
        parser = build_parser(_verb_in(words))
        args = parser.parse_args(argv)
        args.words = words
        prefix = f"selfcal {args.verb}"
        code = int(args.run(args))
        sys.stdout.flush()
        return code
    except SelfcalError as error:
        print(f"{prefix}: {error}", file=sys.stderr)
        return int(error.exit_code)
    except KeyboardInterrupt:
        print(f"{prefix}: interrupted", file=sys.stderr)
        return 128 + signal.SIGINT
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return int(ExitCode.DONE)
    except ModuleNotFoundError as error:
        print(f"{prefix}: there is no module {error.name} in this environment; install it, see "
              "README", file=sys.stderr)
        return int(ExitCode.BAD_INPUT)
    except OSError as error:  # a name too long, a disk that fails
        if error.errno is None:
            raise
        fault = InputError(error.filename or "system", str(error.strerror),
                           "check path, disk and permissions")
        print(f"{prefix}: {fault}", file=sys.stderr)
        return int(fault.exit_code)


class Parser(argparse.ArgumentParser):
    """An ArgumentParser whose errors are one line on stderr, exit code 2.

    An unknown verb, choice or option is answered with similar ones.
    Sub-parsers are of this class, too. ``leaf`` of the arguments is the innermost parser.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.set_defaults(leaf=self)

    def parse_args(self, args: Sequence[str] | None = None,  # type: ignore[override]
                   namespace: argparse.Namespace | None = None) -> argparse.Namespace:
        """Return the arguments; an unknown option ends with a line that names it."""
        found, unknown = self.parse_known_args(args, namespace)
        if unknown:
            found.leaf.refuse(unknown)
        return found

    def refuse(self, unknown: Sequence[str]) -> NoReturn:
        """End with a line on the first argument that is not recognised."""
        word = next((word for word in unknown if word.startswith("-")), unknown[0])
        name = word.partition("=")[0]
        if not word.startswith("-"):
            self.error(f"'{word}' is one argument too many")
        hint = did_you_mean(name, self._option_string_actions)
        self.error(f"the option {name} is unknown{hint and '; ' + hint}")

    def error(self, message: str) -> NoReturn:
        """End with one line and exit code 2."""
        required = "the following arguments are required: "
        if message.startswith(required):
            names = message.removeprefix(required).replace("/--", " or --")
            verbs = [verb for action in self._actions if str(action.metavar) == names
                     and isinstance(action.choices, dict) for verb in action.choices
                     if verb not in names]
            message = f"{names} {'are' if ', ' in names else 'is'} missing" + (
                f": one of {', '.join(verbs)}" if verbs else "")
        self.exit(int(ExitCode.BAD_INPUT),
                  printable(f"{self.prog}: {message}; see {self.prog} --help") + "\n")

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        """Refuse a value that is not among the choices, with similar ones."""
        if action.choices is None or value in action.choices:
            return
        choices: Iterable[str] = map(str, action.choices)
        known = list(choices)
        hint = did_you_mean(str(value), known) or f"known are {', '.join(known)}"
        raise argparse.ArgumentError(None, f"{_name_of(action)} '{value}' is unknown; {hint}")


def _name_of(action: argparse.Action) -> str:
    if action.option_strings:
        return f"{action.option_strings[-1]}:"
    return str(action.metavar or action.dest)
