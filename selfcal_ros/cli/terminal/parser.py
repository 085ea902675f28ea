# SPDX-License-Identifier: Apache-2.0
"""Command line parser: errors are one line, with a suggestion."""

import argparse
from collections.abc import Iterable, Sequence
from typing import Any, NoReturn

from selfcal_ros.errors import ExitCode, did_you_mean, printable


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
