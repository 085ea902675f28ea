# SPDX-License-Identifier: Apache-2.0
"""``selfcal monitor``: one screen of a running cell, and keys for its sequencer."""

import argparse
import contextlib
import errno
import json
import os
import queue
import select
import sys
import termios
import threading
import tty
from collections.abc import Callable, Iterator
from typing import Any

from selfcal_ros.cli.processes import Eyes, eyes
from selfcal_ros.cli.screen import KEYS, saved_as, screen, what_now
from selfcal_ros.cli.terminal import add_json, add_namespace
from selfcal_ros.errors import printable
from selfcal_ros.portable import ended_by_signals


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    add_namespace(parser)
    add_json(
        parser, "one JSON object per line: pictures as they change, answers to requests"
    )


def run(args: argparse.Namespace) -> int:
    """Show the screen until q, Ctrl-C or the end of the input."""
    with ended_by_signals(), eyes(args.namespace) as monitor:
        return watch(monitor, [], lambda: None, as_json=args.json)


def watch(
    monitor: Eyes, log: list[str], step: Callable[[], None], *, as_json: bool = False
) -> int:
    """Draw the monitor's pictures and forward keys; call `step` several times a second.

    Without a terminal every change of state is a line on stdout instead, and requests are read
    as words from stdin. `as_json` prints the monitor's messages as JSON, one object per line.
    """
    show = _json_lines if as_json else _live if sys.stdout.isatty() else _lines
    try:
        with _keys() as pressed, show(log) as draw:
            return _watched(monitor, log, step, pressed, draw)
    except OSError as error:
        if error.errno == errno.EIO:  # the terminal is gone
            return 0
        raise


def _watched(
    monitor: Eyes,
    log: list[str],
    step: Callable[[], None],
    pressed: Callable[[], list[str]],
    draw: Callable[[Any], None],
) -> int:
    while True:
        step()
        message = monitor.next(0.1)
        if message is None:
            return 1
        if "answer" in message or "said" in message:
            log.append(message.get("answer") or message["said"])
        draw(message.get("picture"))
        for word in pressed():
            if word == "quit":
                return 0
            monitor.ask(word)


@contextlib.contextmanager
def _live(log: list[str]) -> Iterator[Callable[[Any], None]]:
    """Draw on the whole terminal, which is restored at the end."""
    from rich.console import Console  # for a terminal only
    from rich.live import Live  # for a terminal only
    from rich.text import Text  # for a terminal only

    newest: dict[str, Any] = {}
    console = Console()
    drawn: list[Any] = []  # size and log shown on the screen
    with Live(
        Text("Looking for the nodes ..."),
        console=console,
        screen=True,
        auto_refresh=False,
    ) as live:

        def draw(picture: Any) -> None:
            now = [console.size, list(log)]
            newest.update(picture or {})
            if newest and (picture is not None or now != drawn):
                drawn[:] = now
                size = (console.width, console.height)
                live.update(screen(newest, log, size), refresh=True)

        yield draw


@contextlib.contextmanager
def _lines(log: list[str]) -> Iterator[Callable[[Any], None]]:
    """Print a line for each change that a script may wait for."""
    printed: dict[str, str] = {}
    heard_nodes: set[str] = set()

    def draw(picture: Any) -> None:
        while log:
            print(printable(log.pop(0)), flush=True)
        if picture is None:
            return
        for key, line in _state_lines(picture, heard_nodes, set(printed)):
            if printed.get(key) != line:
                printed[key] = line
                print(printable(f"{key}: {line}"), flush=True)

    yield draw


def _state_lines(
    picture: Any, heard_nodes: set[str], printed: set[str]
) -> Iterator[tuple[str, str]]:
    """Yield changes that a script may wait for; `heard_nodes` collects the nodes heard so far."""
    yield "now", what_now(picture)
    if picture["summary"]:
        yield "map", picture["summary"]["state"]
    if saved_as(picture):
        yield "saved", saved_as(picture)
    for node, health in picture["health"].items():
        if health is None and node in heard_nodes:
            yield node, "gone: no sign of life"
        elif health is not None:
            heard_nodes.add(node)
            if health["level"]:
                yield node, health["message"]
            elif node in printed:
                yield node, "well again"


@contextlib.contextmanager
def _json_lines(log: list[str]) -> Iterator[Callable[[Any], None]]:
    """Print each picture that differs from the previous one, and each line of the log."""
    newest: list[Any] = [None]

    def draw(picture: Any) -> None:
        while log:
            print(json.dumps({"log": log.pop(0)}), flush=True)
        if picture is not None and picture != newest[0]:
            newest[0] = picture
            print(json.dumps({"picture": picture}), flush=True)

    yield draw


@contextlib.contextmanager
def _keys() -> Iterator[Callable[[], list[str]]]:
    """Yield a function that returns the keys or words entered since the last call."""
    if not sys.stdin.isatty():
        yield _words()
        return

    before = termios.tcgetattr(sys.stdin)
    try:
        tty.setcbreak(sys.stdin)

        def pressed() -> list[str]:
            commands = []
            while select.select([sys.stdin], [], [], 0)[0]:
                keys = _read_keys(sys.stdin.fileno())
                commands += [
                    KEYS.get(key, "quit") for key in keys if key in KEYS or key == "q"
                ]
                if not keys:  # the terminal is gone
                    return [*commands, "quit"]
            return commands

        yield pressed
    finally:
        with contextlib.suppress(termios.error):  # gone
            termios.tcsetattr(sys.stdin, termios.TCSADRAIN, before)


def _read_keys(descriptor: int) -> str:
    """Return the characters typed on a terminal, empty at its end; nothing stays buffered."""
    try:
        return os.read(descriptor, 1024).decode(errors="replace")
    except OSError:  # hung up
        return ""


def _words() -> Callable[[], list[str]]:
    """Return a function that gives the lines of stdin since the last call, also after its end."""
    lines: queue.SimpleQueue = queue.SimpleQueue()

    def read() -> None:
        for line in sys.stdin:
            lines.put(line.strip())

    threading.Thread(target=read, name="stdin", daemon=True).start()

    def taken() -> list[str]:
        words = []
        while not lines.empty():
            words.append(lines.get())
        return [word for word in words if word]

    return taken
