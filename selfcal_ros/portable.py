# SPDX-License-Identifier: Apache-2.0
"""Files, signals and streams as each system has them: locks, alarms, readers that are gone.

On Windows nothing is locked; bags and results are worked on all the same.
"""

import contextlib
import os
import re
import signal
import textwrap
import threading
from collections.abc import Iterator
from typing import TextIO

try:
    import fcntl  # not on Windows
except ModuleNotFoundError:
    LOCKS = False
else:
    LOCKS = True

AT_ONCE = getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
"""Flags for opening a file as it is, without waiting for who writes into a pipe."""
NO_LINK = getattr(os, "O_NOFOLLOW", 0)
"""Flag for opening a file, but not what a link leads to."""


def lock(descriptor: int, *, wait: bool = False) -> None:
    """Lock a file until it is closed, if this system has locks.

    Raises
    ------
    OSError
        If another process holds the lock and `wait` is false, or the file system has no locks.
    """
    if LOCKS:
        fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))


def columns_of(stream: TextIO) -> int:
    """Return the columns of a terminal; 0 of a file, a pipe or an unknown width."""
    try:
        if not stream.isatty():
            return 0
        said = os.environ.get("COLUMNS", "")
        return (
            int(said) if said.isdecimal() else os.get_terminal_size(stream.fileno())[0]
        )
    except (OSError, ValueError):
        return 0


def fitted(text: str, stream: TextIO) -> str:
    """Return text broken between words for a terminal, which would break numbers.

    A line goes on below its second column, or below its beginning.
    """
    width = columns_of(stream)
    if not width:
        return text
    return "\n".join(
        piece for line in text.split("\n") for piece in _broken(line, width)
    )


def _broken(line: str, width: int) -> list[str]:
    if len(line) <= width:
        return [line]
    begins = [match.end() for match in re.finditer(r"^ *|(?<=\S) {2,}", line)][:2]
    below = begins[-1] if begins[-1] <= width // 2 else begins[0]
    return textwrap.wrap(
        line,
        width,
        subsequent_indent=" " * below,
        break_long_words=False,
        break_on_hyphens=False,
    )


class Ended(SystemExit):
    """Raised where a signal ends the program."""


@contextlib.contextmanager
def ended_by_signals() -> Iterator[None]:
    """Let SIGTERM and SIGHUP end the block like an exception, so that it cleans up.

    One that is ignored stays so: `nohup` lets a command outlive its terminal.
    """

    def end(number: int, _: object) -> None:
        raise Ended(128 + number)

    ends = [
        getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)
    ]
    before = {
        number: signal.signal(number, end)
        for number in ends
        if signal.getsignal(number) is not signal.SIG_IGN
    }
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class Overdue(BaseException):
    """Raised where a block takes longer than it may; no handler of errors catches it."""


@contextlib.contextmanager
def interrupted_after(seconds: float) -> Iterator[None]:
    """Interrupt the block if it takes longer, also where it waits for a system call.

    In the main thread only, where the system has such an alarm and no library has taken it: else
    it waits for good.

    Raises
    ------
    Overdue
        After so many seconds.
    """

    def ring(*_: object) -> None:
        raise Overdue("no answer")

    is_main = threading.current_thread() is threading.main_thread()
    if not (
        is_main
        and hasattr(signal, "setitimer")
        and signal.getsignal(signal.SIGALRM) is signal.SIG_DFL
    ):
        yield
        return
    signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, signal.SIG_DFL)


def say_no_more(*streams: TextIO) -> None:
    """Let everything that is still printed go nowhere, also at the end of the process."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in streams:
        os.dup2(nowhere, stream.fileno())
    os.close(nowhere)
