# SPDX-License-Identifier: Apache-2.0
"""The terminal as all verbs use it: arguments, output, the result, progress."""

import argparse
import contextlib
import re
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, TextIO

from selfcal_ros.cli.arguments import STDOUT
from selfcal_ros.errors import ExitCode, InputError, printable, visible
from selfcal_ros.files import read_yaml
from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.model.verdict import Grade
from selfcal_ros.outputs import can_print_symbols, json_text, to_ascii
from selfcal_ros.portable import fitted
from selfcal_ros.reporting.figures.drawing import Drawing
from selfcal_ros.settings.nodes import overrides_in
from selfcal_ros.settings.parameter import TYPED, Settings

NAMESPACE = re.compile(r"/?(?:[A-Za-z_]\w*(?:/[A-Za-z_]\w*)*/?)?", re.ASCII)
"""Namespaces of ROS, with or without the leading slash."""


class Once(argparse.Action):
    """Stores what is known of a measurement, once: of two values one would be lost unsaid."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,
        option_string: str | None = None,
    ) -> None:
        """Store the value, or end with a line if another one was given before."""
        before = getattr(namespace, self.dest, None)
        if before not in (None, values):
            parser.error(
                f"argument {option_string}: given as {before} and as {values}; keep one of them"
            )
        setattr(namespace, self.dest, values)


def add_result(parser: argparse.ArgumentParser) -> None:
    """Add the argument of a result that is read."""
    parser.add_argument(
        "result", metavar="RESULT.json", help="result that `selfcal solve` wrote"
    )


def add_truth(parser: argparse.ArgumentParser) -> None:
    """Add the option ``--truth``."""
    parser.add_argument(
        "--truth",
        metavar="TRUTH.json",
        help="known truth to compare with: gx, gy in m, g_theta in rad",
    )


def add_fill(parser: argparse.ArgumentParser) -> None:
    """Add the option ``--fill`` of what needs an error at every site."""
    parser.add_argument(
        "--fill",
        action="store_true",
        help="set unknown sites to the mean of their neighbours",
    )


def add_namespace(parser: argparse.ArgumentParser) -> None:
    """Add the option ``--namespace`` of a cell that runs."""
    parser.add_argument(
        "--namespace",
        metavar="NS",
        type=_namespace,
        default="",
        help="namespace of the cell",
    )


def _namespace(text: str) -> str:
    """Return the namespace in an argument.

    Raises
    ------
    InputError
        If ROS has no such names.
    """
    if not NAMESPACE.fullmatch(text):
        raise InputError(
            "--namespace",
            f"{printable(text)!r} is not a name of ROS",
            "write letters, digits and _, no digit first, as in cell_1 or line/cell_1",
        )
    return text


def add_recorded_namespace(parser: argparse.ArgumentParser) -> None:
    """Add the option ``--namespace`` of a cell that was recorded."""
    parser.add_argument(
        "--namespace",
        metavar="NAME",
        help="namespace of the cell's topics, for bags with several cells; / is the root",
    )


def add_solved(parser: argparse.ArgumentParser) -> None:
    """Add the options for where a result goes."""
    parser.add_argument(
        "-o",
        "--output",
        metavar="RESULT.json",
        help="file for the result; - is stdout, and other output goes to stderr",
    )
    add_json(parser, "RESULT.json, and the summary on stderr")


def add_json(parser: argparse.ArgumentParser, what: str = "one JSON object") -> None:
    """Add the option ``--json``."""
    parser.add_argument(
        "--json", action="store_true", help=f"print {what} (docs/reference/json.md)"
    )


def add_parameters(
    parser: argparse._ActionsContainer, kind: type[Settings], options: Mapping[str, str]
) -> None:
    """Add options for parameters of a node, None if not given.

    Parameters
    ----------
    parser : argparse.ArgumentParser or group of arguments
        The parser of the verb, or a part of it.
    kind : type of Settings
        The parameters of the node.
    options : mapping
        Name of the option without dashes -> name of the parameter.
    """
    parameter_of = {parameter.name: parameter for parameter in kind.parameters()}
    for option, name in options.items():
        parameter = parameter_of[name]
        default = parameter.default
        suffix = f" (default: {default})" if default else ""
        what, semicolon, more = parameter.description.partition(";")
        unit = f", {parameter.unit}" if parameter.unit else ""
        how: dict[str, Any] = (
            {"action": "store_true", "default": None}
            if default is False
            else {
                "action": Once if name.startswith("reference_") else "store",
                "type": type(default),
                "choices": parameter.choices or None,
                "metavar": None
                if parameter.choices
                else (parameter.unit or "value").upper(),
            }
        )
        parser.add_argument(
            option_of(option),
            **how,
            help=f"{what}{unit}{semicolon}{more}{suffix}".replace("%", "%%"),
        )


def option_of(name: str) -> str:
    """Return the option of an argument by its name in Python."""
    return f"--{name.replace('_', '-')}"


def node_settings[S: Settings](params: str | None, kind: type[S], **given: Any) -> S:
    """Return the settings of a node from a parameter file, if any, and arguments, which win."""
    where = params or TYPED
    of_file = overrides_in(read_yaml(params) if params else {}, kind.NODE, where)
    kind.checked(of_file, where)
    typed = {name: value for name, value in given.items() if value is not None}
    return kind.checked(of_file | typed, TYPED)


def given(args: argparse.Namespace, options: Mapping[str, str]) -> dict[str, Any]:
    """Return parameter -> value of the options of `add_parameters`, None if not given."""
    return {name: getattr(args, option) for option, name in options.items()}


def say(args: argparse.Namespace, text: str, data: dict[str, Any]) -> None:
    """Print `data` as JSON if requested, else `text`."""
    if args.json:
        put(data)
    else:
        tell(text)


def tell(text: str, stream: TextIO | None = None) -> None:
    """Print text, on stdout unless said, without control characters, as of names of files.

    If the stream cannot encode µ, ° and the like, they are spelled out. A terminal gets lines that
    fit.
    """
    stream = stream or sys.stdout
    lines = "\n".join(visible(line) for line in text.split("\n"))
    put_text(fitted(lines, stream), stream)


def require_person(remedy: str) -> None:
    """Refuse to ask where stdin is not a terminal."""
    if not sys.stdin.isatty():
        raise InputError(
            "stdin", "there is nobody to ask: it is not a terminal", remedy
        )


def is_yes(answer: str) -> bool:
    """Return whether a person agrees."""
    return answer.strip().lower() in ("y", "yes")


def warn(args: argparse.Namespace, text: str) -> None:
    """Print a line on stderr, after the name of the verb."""
    tell(f"{args.leaf.prog}: {text}", sys.stderr)


def put_text(text: str, stream: TextIO) -> None:
    """Print text as it is, if the stream can encode it."""
    print(text if can_print_symbols(stream) else to_ascii(text), file=stream)


def put(data: Any) -> None:
    """Print strict JSON (no NaN) on stdout."""
    print(json_text(data))


def save_drawing(drawing: Drawing, path: str | Path) -> None:
    """Write a picture."""
    from selfcal_ros.reporting.figures.paper import save_picture  # loads matplotlib

    save_picture(drawing, path)


def file_of(args: argparse.Namespace) -> str | None:
    """Return the file that ``--output`` names; None for stdout."""
    return None if args.output == STDOUT else args.output


def on_stdout(args: argparse.Namespace) -> bool:
    """Return whether the result itself goes to stdout."""
    return bool(args.json or args.output == STDOUT)


def aside(args: argparse.Namespace) -> TextIO:
    """Return the stream for other text: stderr if the result is on stdout."""
    return sys.stderr if on_stdout(args) else sys.stdout


def show(
    result: CalibrationResult, bag: str, output: str | None, stream: TextIO
) -> None:
    """Print the summary, compared with the truth if the bag folder has one."""
    from selfcal_ros.bagio.offline import (
        read_truth,
    )  # with mcap, which not every verb needs
    from selfcal_ros.reporting.summary.sections import (
        summary_text,
    )  # with scipy, likewise

    tell(
        summary_text(
            result, truth=read_truth(bag), ascii_only=not can_print_symbols(stream)
        ),
        stream,
    )
    if output:
        tell(f"result: {output}", stream)
    elif stream is sys.stdout:
        tell("result: not kept; -o RESULT.json writes it", stream)


def exit_code(result: CalibrationResult) -> int:
    """Return the exit code of a result that was computed: 0, or 5 if it is not qualified.

    The reason is printed in one line on stderr in any case.
    """
    unqualified = say_unless_qualified(result, "selfcal")
    return ExitCode.NOT_QUALIFIED if unqualified else ExitCode.DONE


def say_unless_qualified(result: CalibrationResult, who: str) -> bool:
    """Print the verdict on stderr, and return whether a result is not qualified."""
    if result.verdict.grade is Grade.GOOD:
        return False
    tell(f"{who}: {result.verdict.sentence}", sys.stderr)
    return not result.verdict.qualified


@contextlib.contextmanager
def progress_bar(label: str) -> Iterator[Callable[[int, int | None], None]]:
    """Yield a function (done, total) that draws on stderr if that is a terminal."""
    if not sys.stderr.isatty():
        yield _nothing
        return
    from rich.console import Console  # for a terminal only
    from rich.progress import Progress  # for a terminal only

    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(label, total=None)

        def draw(done: int, total: int | None = None) -> None:
            bar.update(task, completed=done, total=total)

        yield draw


def _nothing(done: int, total: int | None = None) -> None:
    """Draw nothing."""


@contextlib.contextmanager
def late_progress(
    label: str, after_s: float = 2.0
) -> Iterator[Callable[[int, int | None], None]]:
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
    from rich.console import Console  # for a terminal only
    from rich.progress import (  # for a terminal only
        Progress,
        SpinnerColumn,
        TextColumn,
        TimeElapsedColumn,
    )

    with Progress(
        SpinnerColumn(),
        TextColumn("{task.description}"),
        TimeElapsedColumn(),
        console=Console(stderr=True),
        transient=True,
    ) as bar:
        bar.add_task(label, total=None)
        ended.wait()
