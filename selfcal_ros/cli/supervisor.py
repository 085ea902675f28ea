# SPDX-License-Identifier: Apache-2.0
"""Nodes as processes that are looked after: restarted when they die, reported when they may not."""

import contextlib
import subprocess
import threading
import time
from collections.abc import Callable
from typing import Self

from selfcal_ros.cli.processes import process

MOST_RESTARTS = 5
"""Restarts of a node within `WINDOW_S`; more is no accident."""
WINDOW_S = 60.0
NEVER_AGAIN = (2,)
"""Exit codes after which a restart would only repeat them: bad input."""
ONCE = ("bag_recorder",)
"""Nodes that cannot go on where they were: their folder exists."""
KEPT_LINES = 200


class Supervisor:
    """Runs nodes and looks after them; a context manager that stops them all at its end.

    Parameters
    ----------
    commands : dict
        Node -> its arguments.
    environment : dict
        Environment of the nodes.
    now_s : callable
        Monotonic seconds.
    """

    def __init__(self, commands: dict[str, list[str]], environment: dict,
                 now_s: Callable[[], float] = time.monotonic) -> None:
        self._commands, self._environment, self._now_s = commands, environment, now_s
        self._stack = contextlib.ExitStack()
        self._running: dict[str, subprocess.Popen] = {}
        self._restarts: dict[str, list[float]] = {node: [] for node in commands}
        self.log: list[str] = []

    def __enter__(self) -> Self:
        """Start all nodes."""
        try:
            for node in self._commands:
                self._start(node)
        except BaseException:
            self._stack.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        """Stop all nodes, together."""
        for child in self._running.values():
            if child.poll() is None:
                child.terminate()
        self._stack.close()

    def step(self) -> None:
        """Restart what has died, or say why it is not restarted."""
        for node, child in list(self._running.items()):
            code = child.poll()
            if code is None:
                continue
            del self._running[node]
            how = f"signal {-code}" if code < 0 else f"code {code}"
            recent = [when for when in self._restarts[node] if self._now_s() - when < WINDOW_S]
            if code in NEVER_AGAIN or node in ONCE:
                self._say(f"{node} has ended with {how} and is not started again")
            elif len(recent) >= MOST_RESTARTS:
                self._say(f"{node} has ended with {how}, for the {len(recent) + 1}th time within "
                          f"{WINDOW_S:.0f} s: not started again")
            else:
                self._restarts[node] = [*recent, self._now_s()]
                self._say(f"{node} has ended with {how}: started again")
                self._start(node)

    def _start(self, node: str) -> None:
        child = self._stack.enter_context(process(
            f"selfcal_ros.nodes.{node}", self._commands[node], self._environment,
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
            text=True, errors="replace"))
        self._running[node] = child
        threading.Thread(target=self._read, args=(child,), name=node, daemon=True).start()

    def _read(self, child: subprocess.Popen) -> None:
        with contextlib.suppress(ValueError):  # closed while it is read
            for line in child.stderr or ():
                self._say(line.rstrip("\n"))

    def _say(self, line: str) -> None:
        self.log.append(line)
        del self.log[:-KEPT_LINES]
