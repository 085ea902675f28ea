# SPDX-License-Identifier: Apache-2.0
"""Nodes as processes of a command: they end with it, however it ends."""

import contextlib
import ctypes
import fcntl
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from selfcal_ros.errors import InputError
from selfcal_ros.start import missing_ros

PR_SET_PDEATHSIG = 1
"""Option of prctl(2): the signal sent to a process when its parent dies, also by SIGKILL."""


def need_ros(alternative: str) -> None:
    """Raise InputError if there is no ROS in this environment."""
    missing = missing_ros()
    if missing:
        raise InputError("environment", missing + alternative)


@contextlib.contextmanager
def process(module: str, arguments: list[str], environment: dict, **kwargs: Any,
            ) -> Iterator[subprocess.Popen]:
    """Run a module as a process that is stopped, at worst killed, at the end of the block.

    Ctrl-C reaches the process from the terminal, too. It is blocked from the start, and unblocked
    by `nodes.running.run` after the imports, when it can be handled.
    """
    child, before = None, signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        child = subprocess.Popen([sys.executable, "-m", module, *arguments], env=environment,
                                 preexec_fn=_die_with_parent(os.getpid()), **kwargs)
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


@contextlib.contextmanager
def ended_by_signals() -> Iterator[None]:
    """Let SIGTERM and SIGHUP end the block like an exception, so that it cleans up."""
    def end(number: int, _: object) -> None:
        raise SystemExit(128 + number)
    before = {number: signal.signal(number, end) for number in (signal.SIGTERM, signal.SIGHUP)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def domain() -> Iterator[dict]:
    """Yield an environment with its own ROS domain on this machine.

    An existing ROS_DOMAIN_ID is kept, so that `ros2 topic echo` can be used.
    """
    environment = dict(os.environ)
    environment.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    if environment.get("ROS_DOMAIN_ID"):
        yield environment
        return
    for number in range(50, 100):
        with Path(tempfile.gettempdir(), f"selfcal_domain_{number}.lock").open("w") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                continue
            yield environment | {"ROS_DOMAIN_ID": str(number)}
            return
    raise RuntimeError("fifty replays at once")
