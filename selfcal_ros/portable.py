# SPDX-License-Identifier: Apache-2.0
"""Files, signals and streams as each system has them: locks, interrupts, readers that are gone.

On Windows nothing is locked and no interrupt is held back; bags and results are worked on all the
same.
"""

import contextlib
import os
import signal
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


def hold_interrupts(*, held: bool) -> None:
    """Block Ctrl-C in this thread, or let it through, at once if it came meanwhile."""
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_BLOCK if held else signal.SIG_UNBLOCK, {signal.SIGINT})


@contextlib.contextmanager
def ended_by_signals() -> Iterator[None]:
    """Let SIGTERM and SIGHUP end the block like an exception, so that it cleans up.

    One that is ignored stays so: `nohup` lets a command outlive its terminal.
    """
    def end(number: int, _: object) -> None:
        raise SystemExit(128 + number)
    ends = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
    before = {number: signal.signal(number, end) for number in ends
              if signal.getsignal(number) is not signal.SIG_IGN}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def say_no_more(*streams: TextIO) -> None:
    """Let everything that is still printed go nowhere, also at the end of the process."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in streams:
        os.dup2(nowhere, stream.fileno())
    os.close(nowhere)
