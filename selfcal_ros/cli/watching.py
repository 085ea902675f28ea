# SPDX-License-Identifier: Apache-2.0
"""The monitor process of a cell, as used by commands: pictures in, requests out."""

import contextlib
import json
import os
import queue
import subprocess
import threading
from collections.abc import Iterator
from typing import Any

from selfcal_ros.cli.processes import need_ros, process


class Eyes:
    """Messages of a monitor process, and requests to it.

    Parameters
    ----------
    child : subprocess.Popen
        The process, with pipes as stdin and stdout.
    """

    def __init__(self, child: subprocess.Popen) -> None:
        self._child = child
        self._queue: queue.Queue = queue.Queue()
        threading.Thread(target=self._read, name="monitor", daemon=True).start()

    def _read(self) -> None:
        for line in self._child.stdout or ():
            with contextlib.suppress(ValueError):
                self._queue.put(json.loads(line))
        self._queue.put(None)

    def ask(self, request: str) -> None:
        """Send a request to the sequencer."""
        if self._child.stdin is None:
            return
        with contextlib.suppress(BrokenPipeError):
            self._child.stdin.write(f"{request}\n")
            self._child.stdin.flush()

    def next(self, timeout_s: float) -> dict[str, Any] | None:
        """Return the next message; empty after `timeout_s`, None when the process has ended."""
        try:
            return self._queue.get(timeout=timeout_s)
        except queue.Empty:
            return {}

    def messages(self) -> Iterator[dict[str, Any]]:
        """Yield messages until the process ends."""
        while (message := self.next(0.1)) is not None:
            yield message


@contextlib.contextmanager
def eyes(namespace: str, environment: dict | None = None) -> Iterator[Eyes]:
    """Yield a monitor process of the cell in `namespace`."""
    need_ros("")
    with process("selfcal_ros.nodes.monitor_session",
                 [f"/{namespace.strip('/')}" if namespace.strip("/") else "", "--ros-args",
                  "--log-level", "error"], environment or dict(os.environ),
                 stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as child:
        yield Eyes(child)
