# SPDX-License-Identifier: Apache-2.0
"""The terminal as all verbs use it: arguments, output, the result, progress."""

import argparse
import contextlib
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, NoReturn, TextIO

from selfcal_ros.errors import ExitCode, did_you_mean, printable

if TYPE_CHECKING:
    from selfcal_ros.model.result import CalibrationResult

STDOUT = "-"
"""Name of an output file: the result goes to stdout, everything else to stderr."""


def add_json(parser: argparse.ArgumentParser, what: str = "one JSON object") -> None:
    """Add the option ``--json``."""
    parser.add_argument("--json", action="store_true", help=f"print {what} (docs/json.md)")


def say(args: argparse.Namespace, text: str, data: dict[str, Any]) -> None:
    """Print `data` as JSON if requested, else `text`."""
    if args.json:
        put(data)
    else:
        tell(text)


def tell(text: str) -> None:
    """Print text; if stdout cannot encode µ, ° and the like, they are spelled out."""
    from selfcal_ros.reporting.summary.numbers import can_print_symbols, to_ascii

    print(text if can_print_symbols(sys.stdout) else to_ascii(text))


def put(data: Any) -> None:
    """Print strict JSON (no NaN) on stdout."""
    from selfcal_ros.outputs import json_text

    print(json_text(data))


def file_of(args: argparse.Namespace) -> str | None:
    """Return the file that ``--output`` names; None for stdout."""
    return None if args.output == STDOUT else args.output


def on_stdout(args: argparse.Namespace) -> bool:
    """Return whether the result itself goes to stdout."""
    return bool(args.json or args.output == STDOUT)


def aside(args: argparse.Namespace) -> TextIO:
    """Return the stream for other text: stderr if the result is on stdout."""
    return sys.stderr if on_stdout(args) else sys.stdout


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


def show(result: "CalibrationResult", bag: str, output: str | None, stream: TextIO) -> None:
    """Print the summary, compared with the truth if the bag folder has one."""
    from selfcal_ros.bagio.offline import read_truth
    from selfcal_ros.reporting.summary.numbers import can_print_symbols
    from selfcal_ros.reporting.summary.sections import summary_text

    print(summary_text(result, truth=read_truth(bag), ascii_only=not can_print_symbols(stream)),
          file=stream)
    if output:
        print(f"result: {output}", file=stream)


def exit_code(result: "CalibrationResult") -> int:
    """Return the exit code of a result that was computed: 0, or 5 if it is not qualified.

    The reason is printed in one line on stderr in any case.
    """
    from selfcal_ros.errors import ExitCode

    said = say_unless_qualified(result, "selfcal")
    return int(ExitCode.NOT_QUALIFIED if said else ExitCode.DONE)


def say_unless_qualified(result: "CalibrationResult", who: str) -> bool:
    """Print the verdict on stderr, and return whether a result is not qualified."""
    from selfcal_ros.model.verdict import Grade
    from selfcal_ros.reporting.summary.numbers import can_print_symbols, printable, to_ascii

    if result.verdict.grade is Grade.GOOD:
        return False
    line = printable(f"{who}: {result.verdict.sentence}")
    print(line if can_print_symbols(sys.stderr) else to_ascii(line), file=sys.stderr)
    return not result.verdict.qualified


@contextlib.contextmanager
def progress_bar(label: str) -> Iterator[Callable[[int, int | None], None]]:
    """Yield a function (done, total) that draws on stderr if that is a terminal."""
    if not sys.stderr.isatty():
        yield _nothing
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(label, total=None)

        def draw(done: int, total: int | None = None) -> None:
            bar.update(task, completed=done, total=total)

        yield draw


def _nothing(done: int, total: int | None = None) -> None:
    """Draw nothing."""


@contextlib.contextmanager
def late_progress(label: str, after_s: float = 2.0) -> Iterator[Callable[[int, int | None], None]]:
    """Yield the function of `progress_bar`; its bar appears only after `after_s`."""
    began = time.monotonic()
    draw: Callable[[int, int | None], None] | None = None
    with contextlib.ExitStack() as stack:

        def advance(done: int, total: int | None = None) -> None:
            nonlocal draw
            if draw is None and time.monotonic() - began >= after_s:
                draw = stack.enter_context(progress_bar(label))
            if draw is not None:
                draw(done, total)

        yield advance


@contextlib.contextmanager
def busy(label: str, after_s: float = 2.0) -> Iterator[None]:
    """Show that the block is running, and for how long, after `after_s`.

    For work of unknown progress; drawn by a thread on stderr if that is a terminal.
    Nothing may be printed in the block.
    """
    if not sys.stderr.isatty():
        yield
        return
    ended = threading.Event()
    watcher = threading.Thread(target=_watch, args=(label, after_s, ended), daemon=True)
    watcher.start()
    try:
        yield
    finally:
        ended.set()
        watcher.join()


def _watch(label: str, after_s: float, ended: threading.Event) -> None:
    """Draw from `after_s` on until `ended` is set."""
    if ended.wait(after_s):
        return
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    with Progress(SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn(),
                  console=Console(stderr=True), transient=True) as bar:
        bar.add_task(label, total=None)
        ended.wait()
