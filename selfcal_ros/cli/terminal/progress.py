# SPDX-License-Identifier: Apache-2.0
"""A progress bar on a terminal, nothing in a script."""

import contextlib
import sys
import threading
import time
from collections.abc import Callable, Iterator


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
