# SPDX-License-Identifier: Apache-2.0
"""Supervised node processes: restarted when they die, or reported."""

import contextlib
import subprocess
import threading
import time
from collections.abc import Callable
from typing import Self

from selfcal_ros.cli.processes import process

MOST_RESTARTS = 5
"""Largest number of restarts of a node within `WINDOW_S`."""
WINDOW_S = 60.0
NEVER_AGAIN = (2,)
"""Exit codes after which a restart would fail again: bad input."""
ONCE = ("bag_recorder",)
"""Nodes that cannot be restarted: their folder exists."""
KEPT_LINES = 200


class Supervisor:
    """Context manager that runs and supervises nodes, and stops them at its end.

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
        """Restart nodes that have died, or report why not."""
        for node, child in list(self._running.items()):
            code = child.poll()
            if code is None:
                continue
            del self._running[node]
            how = f"signal {-code}" if code < 0 else f"code {code}"
            recent = [when for when in self._restarts[node] if self._now_s() - when < WINDOW_S]
            if code in NEVER_AGAIN or node in ONCE:
                self._say(f"{node} ended with {how} and is not restarted")
            elif len(recent) >= MOST_RESTARTS:
                self._say(f"{node} ended with {how}, {len(recent) + 1} times within {WINDOW_S:.0f} "
                          "s: not restarted")
            else:
                self._restarts[node] = [*recent, self._now_s()]
                self._say(f"{node} ended with {how}: restarted")
                self._start(node)

    def _start(self, node: str) -> None:
        child = self._stack.enter_context(process(
            f"selfcal_ros.nodes.{node}", self._commands[node], self._environment,
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
            text=True, errors="replace"))
        self._running[node] = child
        threading.Thread(target=self._read, args=(child,), name=node, daemon=True).start()

    def _read(self, child: subprocess.Popen) -> None:
        with contextlib.suppress(ValueError):  # closed during reading
            for line in child.stderr or ():
                self._say(line.rstrip("\n"))

    def _say(self, line: str) -> None:
        self.log.append(line)
        del self.log[:-KEPT_LINES]
