# SPDX-License-Identifier: Apache-2.0
"""The exceptions of the package and their exit codes.

A message is one line: where, what is wrong, and how to correct it.
The same codes are the ``error_code`` of services and actions.
"""

import re
from collections.abc import Iterable, Sequence
from difflib import get_close_matches
from enum import IntEnum
from typing import Any

SHOWN = (3000, 1000)
"""Characters kept of the beginning and of the end of a longer text."""


class ExitCode(IntEnum):
    """Exit codes of ``selfcal`` and error codes of services and actions."""

    DONE = 0
    INTERNAL = 1
    BAD_INPUT = 2
    NOT_IDENTIFIABLE = 3
    NO_DATA = 4
    NOT_QUALIFIED = 5


class SelfcalError(Exception):
    """Base of all errors of the package."""

    exit_code = ExitCode.INTERNAL


class InputError(SelfcalError):
    """Raised for a file, message, parameter or argument that cannot be used.

    Parameters
    ----------
    where : str
        File, topic, view or parameter, with line or index if there is one.
    what : str
        What is wrong.
    remedy : str, optional
        What the user can do about it.
    """

    exit_code = ExitCode.BAD_INPUT

    def __init__(self, where: str, what: str, remedy: str = "") -> None:
        self.where, self.what, self.remedy = where, what, remedy
        super().__init__(
            printable(f"{where}: {what}" + (f"; {remedy}" if remedy else ""))
        )

    def __reduce__(self) -> tuple[Any, ...]:
        """Return how another process makes it again, without the parameters of its class."""
        return Exception.__new__, (type(self), *self.args), vars(self)


class NotIdentifiableError(SelfcalError):
    """Raised when the marks that were read do not identify the stage error.

    Parameters
    ----------
    message : str
        One line: what is missing and which view would identify the stage.
    observability : object, optional
        The `selfcal_ros.model.result.Observability` found, with its unseen modes.
    """

    exit_code = ExitCode.NOT_IDENTIFIABLE

    def __init__(self, message: str, observability: Any = None) -> None:
        self.observability = observability
        super().__init__(message)


class NotSettledError(InputError):
    """Raised when an estimate does not converge on the given readings."""


class NoDataError(InputError):
    """Raised when the input is well formed but contains nothing to calibrate from."""

    exit_code = ExitCode.NO_DATA


def did_you_mean(word: str, known_names: Iterable[str]) -> str:
    """Return ``did you mean 'x'?`` with the names most similar to `word`, at most two; or "".

    The same words in another order count as most similar.
    """
    names = {str(name).lower(): str(name) for name in known_names}
    words = sorted(re.split("[-_/]+", word.lower()))
    similar = [name for name in names if sorted(re.split("[-_/]+", name)) == words][
        :2
    ] or (get_close_matches(word.lower(), names, n=2, cutoff=0.7))
    return (
        f"did you mean {' or '.join(repr(names[name]) for name in similar)}?"
        if similar
        else ""
    )


def some_of(words: Sequence[object], most: int, number: int = 0) -> str:
    """Return the first words, and how many more there are.

    `number` is how many there are if `words` are not all of them.
    """
    first = words[:most]
    n_more = (number or len(words)) - len(first)
    return ", ".join(map(str, first)) + (f" and {n_more} more" if n_more > 0 else "")


def known_are(word: str, known_names: Iterable[str]) -> str:
    """Return the remedy for an unknown name: similar names, then all known ones."""
    names = [str(name) for name in known_names]
    hint = did_you_mean(word, names)
    return f"{hint} known are {', '.join(names)}".strip()


def mend_of(value: object, kind: type) -> str:
    """Return the remedy for a value that is not of the type `kind`."""
    if kind is list and isinstance(value, str):
        return f"write [{value}]"
    if not isinstance(value, str) or kind not in (int, float):
        return "correct the value"
    if re.fullmatch(r"[-+\d]*,\d+([eE][-+]?\d+)?", value.strip()):
        return f"write {value.replace(',', '.')}, with a decimal point"
    return "give a number in SI units, without a unit and without quotes"


def first_line(error: BaseException) -> str:
    """Return the first line of another library's error text, or its type if it has none."""
    return (str(error).splitlines() or [type(error).__name__])[0]


def as_answer(error: Exception) -> tuple[ExitCode, str]:
    """Return code and message of the answer to a request that failed with an error."""
    if isinstance(error, SelfcalError):
        return error.exit_code, printable(str(error))
    return ExitCode.INTERNAL, printable(f"{type(error).__name__}: {error}")


def printable(text: object) -> str:
    """Return `text` as `visible`; one that is too long as its beginning, length and end."""
    text = str(text)
    if len(text) > sum(SHOWN):
        text = (
            f"{text[: SHOWN[0]]} ... ({len(text)} characters) ... {text[-SHOWN[1] :]}"
        )
    return visible(text)


def visible(text: str) -> str:
    r"""Return `text` as one line without control characters.

    Names in bags, plans and messages come from outside: an escape sequence, a line break or a
    change of the writing direction in them is shown as ``\x1b``, ``\n``, ``\u202e``.
    """
    if text.isprintable():
        return text
    return "".join(
        c if c.isprintable() else c.encode("unicode_escape", "surrogatepass").decode()
        for c in text
    )
