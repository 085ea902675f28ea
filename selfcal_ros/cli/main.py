# SPDX-License-Identifier: Apache-2.0
"""The ``selfcal`` command: find the verbs, run one, turn errors into exit codes.

A verb is a module with ``configure(parser)`` and ``run(args) -> int``, of this package or of
another one (`selfcal_ros.cli.verbs`). It is imported when it is asked for, so that
``selfcal --help`` does not load numpy.
"""

import argparse
import importlib
import os
import re
import shutil
import signal
import sys
import textwrap
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NoReturn, TextIO

from selfcal_ros import __version__
from selfcal_ros.cli.arguments import (
    add_force,
    check_existing,
    check_given,
    misplaced,
)
from selfcal_ros.cli.verbs import (
    EXAMPLES,
    GROUPS,
    MORE,
    START_HERE,
    VERBS,
    module_of,
    summary_of,
    verbs_of_others,
)
from selfcal_ros.errors import (
    ExitCode,
    InputError,
    NotIdentifiableError,
    SelfcalError,
    did_you_mean,
    printable,
)
from selfcal_ros.plain_numbers import number_of, whole_number_of
from selfcal_ros.portable import fitted, say_no_more
from selfcal_ros.start import hold_interrupts

NOT_A_NUMBER = re.compile(r"argument (\S+): invalid (float|int) value: (.*)")
NEGATIVE = re.compile(r"-\.?\d")
"""Begins a negative value, with or without a unit: no option of a verb does."""
NUMBERS = {
    "float": "a number; give it{unit} without a unit, with a decimal point",
    "int": "a whole number",
}
UNITS = {"M": "m", "MM": "mm", "PX": "pixels", "S": "s", "UM": "µm"}
"""What stands for a value in the help -> its unit."""
EXTRAS = {
    "cv2": "camera",
    "distributed": "dask",
    "ezdxf": "plate",
    "gdstk": "plate",
    "ophyd": "ophyd",
    "pymmcore": "micromanager",
    "serial": "gcode",
    "weasyprint": "pdf",
}
"""Modules that are imported where they are used, and the extra that installs each."""
PACKAGES = {"PIL": "pillow", "yaml": "pyyaml"}
"""Modules whose package has another name."""
COMPLETE = "_ARGCOMPLETE"
"""Set in the environment by a shell that asks for completions."""


def build_parser(only: str | None = None) -> "Parser":
    """Return the parser of all verbs, or of `only` alone if it is a verb.

    If it is not one, no verb is imported: their names and help are known without.
    """
    parser = AllVerbs(
        prog="selfcal",
        description="Calibrates XY-theta stages from readings of a "
        "plate in several views, and states the uncertainty of every number.",
        epilog="exit codes: 0 done, 2 bad usage or input, 3 the measured plan does "
        "not identify the stage, 4 no usable data, 5 written but not qualified, 1 "
        "internal error",
    )
    parser.add_argument("--version", action="version", version=f"selfcal {__version__}")
    group = parser.add_subparsers(
        dest="verb", metavar="VERB", required=True, parser_class=Parser
    )
    for name in [only] if only in VERBS else VERBS:
        sub = group.add_parser(
            name, help=VERBS[name].what, description=VERBS[name].what
        )
        if only in (None, name):
            _configure(sub, importlib.import_module(module_of(name)))
            examples = []
            for words, what, leaf in _leaves(sub, name, VERBS[name].what):
                leaf.description = leaf.description or what
                leaf.example = EXAMPLES.get(words, "")
                examples.append(leaf.example)
                add_force(leaf)
            sub.example = "\n  ".join(filter(None, examples))
    if only not in VERBS:
        for name, point in verbs_of_others().items():
            sub = group.add_parser(
                name, help=summary_of(point), description=summary_of(point)
            )
            if only == name:
                _configure(sub, point.load())
    return parser


def _configure(parser: argparse.ArgumentParser, module: Any) -> None:
    """Add the arguments of a verb."""
    module.configure(parser)
    parser.set_defaults(run=module.run)


def _leaves(
    parser: "Parser", words: str, what: str
) -> Iterator[tuple[str, str, "Parser"]]:
    """Yield words, what they do and parser of a verb, or of each of its second words."""
    groups = [
        action
        for action in parser._actions
        if isinstance(action, argparse._SubParsersAction)
    ]
    if not groups:
        yield words, what, parser
    for group in groups:
        helps = {action.dest: str(action.help) for action in group._choices_actions}
        for word, sub in group.choices.items():
            yield from _leaves(sub, f"{words} {word}", helps[word])


def _verb_in(words: Iterable[str]) -> str:
    """Return the first word that is not an option, empty if there is none."""
    return next((word for word in words if not word.startswith("-")), "")


def _complete() -> None:
    """Answer a shell's request for completions and end; see docs/index.md."""
    import argcomplete  # for completion only

    # without the word at the cursor
    words = os.environ.get("COMP_LINE", "").split(" ")[1:-1]
    argcomplete.autocomplete(build_parser(_verb_in(word for word in words if word)))


def main(argv: list[str] | None = None) -> int:
    """Run one verb and return its exit code."""
    try:
        if COMPLETE in os.environ:
            _complete()
        return _run(sys.argv[1:] if argv is None else argv)
    except BrokenPipeError:  # whoever read has enough
        say_no_more(sys.stdout, sys.stderr)
        return int(ExitCode.DONE)


def _run(words: list[str]) -> int:
    """Run one verb; an error is one line on stderr."""
    prefix, args = "selfcal", None
    try:
        hold_interrupts(held=False)  # by `start`
        if words[:1] == ["help"]:
            words = [*words[1:], "--help"]
        parser = build_parser(_verb_in(words))
        if not words:
            parser.print_help()
            return int(ExitCode.DONE)
        args = parser.parse_args(words)
        args.words = words
        prefix = args.leaf.prog
        check_given(args)
        check_existing(args)
        code = int(args.run(args))
        sys.stdout.flush()  # here a full disk is still an error with a line
        return code
    except SelfcalError as error:
        fault = (misplaced(args) if args is not None else None) or error
        if isinstance(fault, NotIdentifiableError):
            from selfcal_ros.reporting.words.observability import (
                with_advice,
            )  # slow: numpy

            fault = with_advice(fault)
        return _refused(f"{prefix}: {fault}", fault.exit_code)
    except KeyboardInterrupt:
        return _refused(f"{prefix}: interrupted", 128 + signal.SIGINT)
    except ModuleNotFoundError as error:
        return _refused(
            f"{prefix}: there is no module {error.name} in this environment; {_remedy(error.name)}",
            ExitCode.BAD_INPUT,
        )
    except BrokenPipeError:
        raise
    except OSError as error:  # a name too long, a disk that fails
        if error.errno is None:
            raise
        fault = InputError(
            str(error.filename or "system"),
            str(error.strerror),
            "check path, disk and permissions",
        )
        return _refused(f"{prefix}: {fault}", fault.exit_code)


def _refused(line: str, code: int) -> int:
    """Print a line on stderr, if somebody reads it, and return the exit code."""
    for stream, text in (
        (sys.stdout, ""),
        (sys.stderr, fitted(_shown(line, sys.stderr), sys.stderr) + "\n"),
    ):
        try:
            stream.write(text)
            stream.flush()
        except OSError:  # nobody reads it, or it fills a disk
            say_no_more(stream)
    return int(code)


def _shown(text: str, stream: TextIO) -> str:
    """Return `text`, with µ, ° and the like spelled out if the stream cannot encode it."""
    try:
        text.encode(stream.encoding or "utf-8")
    except UnicodeEncodeError:
        from selfcal_ros.outputs import spelled_out  # slow: numpy

        return spelled_out(text)
    return text


def _remedy(module: str | None) -> str:
    """Return what to do about a module that is missing."""
    if module in sys.stdlib_module_names:
        return "this needs Linux: verbs that work on bags and results run everywhere"
    from selfcal_ros.start import NEEDED  # reads the definitions of the messages

    extra = EXTRAS.get(module or "")
    return NEEDED.get(module or "") or (
        f"pip install 'selfcal_ros[{extra}]'"
        if extra
        else f"pip install {PACKAGES.get(module or '', module)}"
    )


class Parser(argparse.ArgumentParser):
    """An ArgumentParser whose errors are one line on stderr, exit code 2.

    An unknown verb, choice or option is answered with similar ones.
    Sub-parsers are of this class, too. ``leaf`` of the arguments is the innermost parser.
    Its help ends with an example.
    """

    example = ""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.set_defaults(leaf=self)
        # float() reads 1_0 as 10, and other digits
        self.register("type", float, number_of)
        self.register("type", int, whole_number_of)
        # argparse takes -20e-6 and -5um for options
        self._negative_number_matcher = NEGATIVE

    def _print_message(self, message: str, file: Any = None) -> None:
        """Print help or version; argparse passes over a disk that is full."""
        message = _shown(message, file or sys.stderr)
        if file is not sys.stdout:
            super()._print_message(message, file)
            return
        file.write(message)
        file.flush()

    def format_help(self) -> str:
        """Return the help, with the example as it is typed, or those of its second words."""
        text = super().format_help()
        title = "examples" if "\n" in self.example else "example"
        return f"{text}\n{title}:\n  {self.example}\n" if self.example else text

    def parse_args(  # type: ignore[override]
        self,
        args: Sequence[str] | None = None,
        namespace: argparse.Namespace | None = None,
    ) -> argparse.Namespace:
        """Return the arguments; an unknown option ends with a line that names it."""
        parsed, unknown = self.parse_known_args(args, namespace)
        if unknown:
            parsed.leaf.refuse(unknown)
        return parsed

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
        wrong = NOT_A_NUMBER.fullmatch(message)
        if wrong:
            option = self._option_string_actions.get(wrong[1].rpartition("/")[2])
            unit = UNITS.get(str(option.metavar)) if option else None
            number = NUMBERS[wrong[2]].format(unit=f" in {unit}," if unit else "")
            message = f"{wrong[1]}: {wrong[3]} is not {number}"
        required = "the following arguments are required: "
        if message.startswith(required):
            names = message.removeprefix(required).replace("/--", " or --")
            verbs = [
                verb
                for action in self._actions
                if str(action.metavar) == names and isinstance(action.choices, dict)
                for verb in action.choices
                if verb not in names
            ]
            message = f"{names} {'are' if ', ' in names else 'is'} missing" + (
                f": one of {', '.join(verbs)}" if verbs else ""
            )
        line = printable(f"{self.prog}: {message}; see {self.prog} --help")
        self.exit(int(ExitCode.BAD_INPUT), fitted(line, sys.stderr) + "\n")

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        """Refuse a value that is not among the choices, with similar ones."""
        if action.choices is None or value in action.choices:
            return
        if not action.option_strings and os.path.exists(str(value)):
            raise argparse.ArgumentError(
                None, f"'{value}' is a file, and {_name_of(action)} comes first"
            )
        choices: Iterable[str] = map(str, action.choices)
        choice_names = list(choices)
        hint = (
            did_you_mean(str(value), choice_names)
            or f"known are {', '.join(choice_names)}"
        )
        raise argparse.ArgumentError(
            None, f"{_name_of(action)} '{value}' is unknown; {hint}"
        )


class AllVerbs(Parser):
    """The parser of all verbs: its help has them in groups."""

    def format_help(self) -> str:
        """Return the help: where to start, then the verbs in groups."""
        width = shutil.get_terminal_size().columns - 2
        lines = [
            "usage: selfcal VERB ...",
            "",
            *textwrap.wrap(str(self.description), width),
            "",
            "start here",
            *_columns(
                {f"selfcal {command}": what for command, what in START_HERE.items()},
                width,
            ),
        ]
        offered = {action.dest: str(action.help) for action in self._verbs()}
        longest = max(map(len, offered))
        for group in GROUPS:
            rows = {
                name.ljust(longest): text
                for name, text in offered.items()
                if (VERBS[name].group if name in VERBS else MORE) == group
            }
            lines += ["", group, *_columns(rows, width)]
        lines += [
            "",
            *textwrap.wrap(str(self.epilog), width),
            "selfcal --version shows the version",
        ]
        return "\n".join(lines) + "\n"

    def _verbs(self) -> list[argparse.Action]:
        return [
            action
            for group in self._actions
            if isinstance(group, argparse._SubParsersAction)
            for action in group._choices_actions
        ]


def _columns(rows: dict[str, str], width: int) -> list[str]:
    """Return names and texts in two columns."""
    name_width = max(map(len, rows)) + 4
    lines = []
    for name, text in rows.items():
        first, *continued = textwrap.wrap(text, max(width - name_width, 20)) or [""]
        lines.append(f"  {name:{name_width - 4}}  {first}")
        lines += [" " * name_width + line for line in continued]
    return lines


def _name_of(action: argparse.Action) -> str:
    if action.option_strings:
        return f"{action.option_strings[-1]}:"
    return str(action.metavar or action.dest)
