# SPDX-License-Identifier: Apache-2.0
"""Nodes as processes of a command: they end with it, however it ends.

Nodes are supervised, the monitor process is read and asked.
"""

import argparse
import contextlib
import ctypes
import json
import os
import queue
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Self

from selfcal_ros import portable
from selfcal_ros.errors import InputError
from selfcal_ros.files import read_yaml
from selfcal_ros.settings.nodes import check_parameters
from selfcal_ros.start import missing_ros

PR_SET_PDEATHSIG = 1
"""Option of prctl(2): the signal sent to a process when its parent dies, also by SIGKILL."""
MOST_RESTARTS = 5
"""Largest number of restarts of a node within `WINDOW_S`."""
WINDOW_S = 60.0
NEVER_AGAIN = (2,)
"""Exit codes after which a restart would fail again: bad input."""
ONCE = ("bag_recorder",)
"""Nodes that cannot be restarted: their folder exists."""
KEPT_LINES = 200
FIRST_PORT, PORTS_OF_DOMAIN = 7410, 250
"""UDP port of the first participant of domain 0, and distance to that of the next (DDSI-RTPS)."""


def need_ros(alternative: str) -> None:
    """Raise InputError if there is no ROS in this environment."""
    missing = missing_ros()
    if missing:
        raise InputError("environment", missing + alternative)


def ros_arguments(args: argparse.Namespace) -> list[str]:
    """Return the ROS arguments for the options ``--namespace`` and ``--params``.

    Raises
    ------
    InputError
        If the parameter file cannot be read, or no node takes what it sets.
    """
    words = ["--ros-args"]
    if args.namespace.strip("/"):
        words += ["-r", f"__ns:=/{args.namespace.strip('/')}"]
    if args.params:
        check_parameters(read_yaml(args.params), args.params)
        words += ["--params-file", str(Path(args.params).absolute())]
    return words


@contextlib.contextmanager
def process(
    module: str, arguments: list[str], environment: dict, **kwargs: Any
) -> Iterator[subprocess.Popen]:
    """Run a module as a process that is stopped, at worst killed, at the end of the block.

    Ctrl-C reaches the process from the terminal, too. It is blocked from the start, and unblocked
    by `nodes.running.run` after the imports, when it can be handled.
    """
    child = None
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        child = subprocess.Popen(
            [sys.executable, "-m", module, *arguments],
            env=environment,
            preexec_fn=_die_with_parent(os.getpid()),
            **kwargs,
        )
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        yield child
    finally:
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        if child is not None:
            stop(child)
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _die_with_parent(parent: int) -> Callable[[], None] | None:
    """Return a function for the child before exec: request SIGTERM when `parent` dies."""
    if not sys.platform.startswith("linux"):
        return None
    prctl = ctypes.CDLL(None, use_errno=True).prctl

    def ask() -> None:
        prctl(PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)
        if os.getppid() != parent:  # it died in between
            os._exit(128 + signal.SIGTERM)

    return ask


def stop(child: subprocess.Popen) -> None:
    """End a process: terminate it, kill it if it has not ended within ten seconds."""
    for end in (child.terminate, child.kill):
        if child.poll() is None:
            end()
            with contextlib.suppress(subprocess.TimeoutExpired):
                child.wait(10)
    for stream in (child.stdin, child.stdout, child.stderr):
        if stream:
            with contextlib.suppress(BrokenPipeError):
                stream.close()


REACHES_OTHERS = (
    "ROS_STATIC_PEERS",
    "ROS_DISCOVERY_SERVER",
    "FASTRTPS_DEFAULT_PROFILES_FILE",
    "FASTDDS_DEFAULT_PROFILES_FILE",
    "CYCLONEDDS_URI",
)
"""Variables of the environment that can lead nodes beyond this machine."""


@contextlib.contextmanager
def domain(chosen: int | None = None) -> Iterator[dict]:
    """Yield an environment with its own ROS domain, or the one chosen, on this machine alone.

    The domain of the environment may be that of a real cell.
    """
    environment = {
        name: value for name, value in os.environ.items() if name not in REACHES_OTHERS
    }
    environment["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    if chosen is not None:
        yield environment | {"ROS_DOMAIN_ID": str(chosen)}
        return
    for number in range(50, 100):
        with Path(tempfile.gettempdir(), f"selfcal_domain_{number}.lock").open(
            "w"
        ) as lock:
            try:
                portable.lock(lock.fileno())
            except OSError:
                continue
            if _is_used(number):
                continue
            yield environment | {"ROS_DOMAIN_ID": str(number)}
            return
    raise InputError(
        "ROS domains 50 to 99",
        "all are in use on this machine",
        "end other replays, or choose one with --domain",
    )


def _is_used(number: int) -> bool:
    """Return whether the port of the first participant of a domain on this machine is taken."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(("", FIRST_PORT + PORTS_OF_DOMAIN * number))
        except OSError:
            return True
    return False


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

    def __init__(
        self,
        commands: dict[str, list[str]],
        environment: dict,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
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
            recent = [
                when for when in self._restarts[node] if self._now_s() - when < WINDOW_S
            ]
            if code in NEVER_AGAIN or node in ONCE:
                self._say(f"{node} ended with {how} and is not restarted")
            elif len(recent) >= MOST_RESTARTS:
                self._say(
                    f"{node} ended with {how}, {len(recent) + 1} times within {WINDOW_S:.0f} "
                    "s: not restarted"
                )
            else:
                self._restarts[node] = [*recent, self._now_s()]
                self._say(f"{node} ended with {how}: restarted")
                self._start(node)

    def _start(self, node: str) -> None:
        child = self._stack.enter_context(
            process(
                f"selfcal_ros.nodes.{node}",
                self._commands[node],
                self._environment,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                text=True,
                errors="replace",
            )
        )
        self._running[node] = child
        threading.Thread(
            target=self._read, args=(child,), name=node, daemon=True
        ).start()

    def _read(self, child: subprocess.Popen) -> None:
        with contextlib.suppress(ValueError):  # closed during reading
            for line in child.stderr or ():
                self._say(line.rstrip("\n"))

    def _say(self, line: str) -> None:
        self.log.append(line)
        del self.log[:-KEPT_LINES]


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
def eyes(namespace: str) -> Iterator[Eyes]:
    """Yield a monitor process of the cell in `namespace`."""
    need_ros("")
    with process(
        "selfcal_ros.nodes.monitor_session",
        [
            f"/{namespace.strip('/')}" if namespace.strip("/") else "",
            "--ros-args",
            "--log-level",
            "error",
        ],
        dict(os.environ),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as child:
        yield Eyes(child)
