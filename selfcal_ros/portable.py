# SPDX-License-Identifier: Apache-2.0
"""Files, signals and streams as each system has them: locks, alarms, readers that are gone.

On Windows nothing is locked; bags and results are worked on all the same.
"""

import contextlib
import os
import signal
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
