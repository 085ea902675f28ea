# SPDX-License-Identifier: Apache-2.0
"""The exceptions of the package and the exit code that each one stands for.

A message is one line that names the place, what is wrong, and how to correct it.
The same codes are the ``error_code`` of services and actions.
"""

import re
from collections.abc import Iterable
from difflib import get_close_matches
from enum import IntEnum
from typing import Any

SHOWN = (3000, 1000)
"""Characters of the beginning and of the end of a text that is longer."""


class ExitCode(IntEnum):
    """Exit codes of ``selfcal`` and error codes of services and actions."""

    DONE = 0
    INTERNAL = 1
    BAD_INPUT = 2
    NOT_IDENTIFIABLE = 3
    NO_DATA = 4
    NOT_QUALIFIED = 5


class SelfcalError(Exception):
    """Base of every error that the package raises on purpose."""

    exit_code = ExitCode.INTERNAL


class InputError(SelfcalError):
    """Raised for a file, message, parameter or argument that cannot be used as it is.

    Parameters
    ----------
    where : str
        File, topic, view or parameter, with line or index where there is one.
    what : str
        What is wrong.
    remedy : str, optional
        What the user can do about it.
    """

    exit_code = ExitCode.BAD_INPUT

    def __init__(self, where: str, what: str, remedy: str = "") -> None:
        self.where, self.what, self.remedy = where, what, remedy
        super().__init__(printable(f"{where}: {what}" + (f"; {remedy}" if remedy else "")))


class NotIdentifiableError(SelfcalError):
    """Raised when the marks that were read do not identify the stage error.

    Parameters
    ----------
    message : str
        One line: what is missing and which view would cure it.
    observability : object, optional
        The `selfcal_ros.model.result.Observability` found, with its unseen modes.
    """

    exit_code = ExitCode.NOT_IDENTIFIABLE

    def __init__(self, message: str, observability: Any = None) -> None:
        self.observability = observability
        super().__init__(message)


class NotSettledError(InputError):
    """Raised when an estimate does not settle on the readings that it was given."""


class NoDataError(InputError):
    """Raised when the input is well formed but holds nothing to calibrate from."""

    exit_code = ExitCode.NO_DATA


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """Return ``did you mean 'x'?`` with the names most like `word`, at most two; "" if none is.

    The same words in another order are most like it.
    """
    names = {str(name).lower(): str(name) for name in known}
    words = sorted(re.split("[-_/]+", word.lower()))
    found = [name for name in names if sorted(re.split("[-_/]+", name)) == words][:2] or (
        get_close_matches(word.lower(), names, n=2, cutoff=0.7))
    return f"did you mean {' or '.join(repr(names[name]) for name in found)}?" if found else ""


def known_are(word: str, known: Iterable[str]) -> str:
    """Return the remedy for a name that is not known: what is like it, then all that are."""
    names = [str(name) for name in known]
    hint = did_you_mean(word, names)
    return f"{hint} known are {', '.join(names)}".strip()


def first_line(error: BaseException) -> str:
    """Return the first line of another library's error text, or its type if it has none."""
    return (str(error).splitlines() or [type(error).__name__])[0]


def as_answer(error: Exception) -> tuple[ExitCode, str]:
    """Return code and message of an answer that an error ends, whoever made the error."""
    if isinstance(error, SelfcalError):
        return error.exit_code, printable(str(error))
    return ExitCode.INTERNAL, printable(f"{type(error).__name__}: {error}")


def printable(text: str) -> str:
    r"""Return `text` as one line without anything that a terminal acts on.

    Names in bags, plans and messages are other people's: an escape sequence, a line break or a
    change of the direction of writing in them is shown as ``\x1b``, ``\n``, ``\u202e``. Of what
    is too long for a line there are beginning, length and end.
    """
    if len(text) > sum(SHOWN):
        text = f"{text[:SHOWN[0]]} ... ({len(text)} characters) ... {text[-SHOWN[1]:]}"
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape", "surrogatepass").decode()
                   for c in text)
