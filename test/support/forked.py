# SPDX-License-Identifier: Apache-2.0
"""Node processes without most of their imports: forks of one that has imported what needs no ROS.

NumPy, SciPy, the sessions and the classes of messages are 0.3 to 0.8 s of CPU of each start. ROS
is loaded by the fork itself: its libraries start threads (of LTTng), which a fork would not have.
What ends or is killed is a process, in a session of its own. Nodes that are started as people start
them are in test_up.py and test_replay.py.

Run as a process, this module is the one that forks: it takes a node a message from its socket.
"""

import contextlib
import ctypes
import gc
import importlib
import json
import os
import pkgutil
import select
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import BinaryIO

from selfcal_ros.cli.processes import PR_SET_PDEATHSIG, stop
from selfcal_ros.nodes import sessions

MESSAGES = (
    "diagnostic_msgs.msg",
    "geometry_msgs.msg",
    "rcl_interfaces.msg",
    "rcl_interfaces.srv",
    "lifecycle_msgs.msg",
    "rosidl_generator_py",
    "selfcal_msgs.msg",
    "selfcal_msgs.srv",
    "sensor_msgs.msg",
    "std_msgs.msg",
    "std_srvs.srv",
    "visualization_msgs.msg",
)

BESIDE_THREADS = "error:This process:DeprecationWarning"
"""Python warns of a fork beside threads: no import may begin one."""
ROOM = 1 << 17
"""Bytes for the arguments and the environment of a node."""
BYTES = 4
"""Bytes of each number that is told of a process."""


class Fork:
    """A process as `subprocess.Popen` shows one; its output goes to files that nobody must read."""

    stdin = None

    def __init__(self, status: int, out: BinaryIO, err: BinaryIO) -> None:
        self.returncode: int | None = None
        self._status, self.stdout, self.stderr = status, out, err
        self._said: tuple[str, str] | None = None
        self.pid = self._next()

    def _next(self) -> int:
        """Return the next number that is told of the process: its id, then its code."""
        told = os.read(self._status, BYTES)
        assert told, "the process that forks nodes has ended"
        return int.from_bytes(told, signed=True)

    def wait(self, timeout: float | None = None) -> int:
        if self.returncode is None:
            if not select.select([self._status], [], [], timeout)[0]:
                raise subprocess.TimeoutExpired(str(self.pid), timeout)
            self.returncode = self._next()
            os.close(self._status)
        return self.returncode

    def poll(self) -> int | None:
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.wait(0.0)
        return self.returncode

    def communicate(self, timeout: float | None = None) -> tuple[str, str]:
        self.wait(timeout)
        if self._said is None:
            self._said = _text_of(self.stdout), _text_of(self.stderr)
        return self._said

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            with contextlib.suppress(ProcessLookupError):  # it has just ended
                os.kill(self.pid, number)

    def terminate(self) -> None:
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)


def _text_of(file: BinaryIO) -> str:
    with file:
        file.seek(0)
        return file.read().decode()


class Forks:
    """Starts nodes as forks; those that are left end with it."""

    def __init__(self) -> None:
        self._open = contextlib.ExitStack()

    @cached_property
    def _requests(self) -> socket.socket:
        """What takes the requests of a process that is started with the first of them."""
        requests, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            process = subprocess.Popen(
                [sys.executable, "-W", BESIDE_THREADS, __file__, str(theirs.fileno())],
                pass_fds=[theirs.fileno()],
                start_new_session=True,
            )
        self._open.callback(process.wait, 60)
        return self._open.enter_context(requests)

    def start(self, node: str, arguments: Sequence[str], environment: dict) -> Fork:
        """Return the process of a node with these arguments."""
        read, write = os.pipe()
        out, err = (os.fdopen(os.memfd_create(name), "w+b") for name in ("out", "err"))
        request = json.dumps([node, list(arguments), environment]).encode()
        socket.send_fds(self._requests, [request], [out.fileno(), err.fileno(), write])
        os.close(write)
        return Fork(read, out, err)

    @contextlib.contextmanager
    def process(
        self, node: str, arguments: Sequence[str], environment: dict
    ) -> Iterator[Fork]:
        """Yield the process of a node; it is stopped, at worst killed, at the end of the block."""
        child = self.start(node, arguments, environment)
        try:
            yield child
        finally:
            stop(child)

    def close(self) -> None:
        self._open.close()


def _serve(requests: socket.socket) -> None:
    """Fork a node for each request until nobody asks any more."""
    _load()
    while True:
        request, files, _, _ = socket.recv_fds(requests, ROOM, 3)
        with contextlib.suppress(ChildProcessError):  # none is left
            while os.waitpid(-1, os.WNOHANG)[0]:
                pass
        if not request:
            return
        node, arguments, environment = json.loads(request)
        if not os.fork():
            requests.close()
            _keep(node, arguments, environment, files)
        for file in files:
            os.close(file)


def _load() -> None:
    """Import what nodes need and what starts no thread."""
    for module in pkgutil.walk_packages(sessions.__path__, f"{sessions.__name__}."):
        importlib.import_module(module.name)
    for name in MESSAGES:
        importlib.import_module(name)
    gc.collect()
    gc.freeze()  # the look for garbage of each node would copy the pages of all that is loaded


def _keep(name: str, arguments: list[str], environment: dict, files: list[int]) -> None:
    """Run a node in a child; tell its id and, when it has ended, its code."""
    *output, status = files
    _end_with_parent()
    if not (node := os.fork()):
        os.close(status)
        _become([name, *arguments], environment, output)
        raise SystemExit(importlib.import_module(f"selfcal_ros.nodes.{name}").main())
    for file in output:
        os.close(file)
    os.write(status, node.to_bytes(BYTES, signed=True))
    code = os.waitstatus_to_exitcode(os.waitpid(node, 0)[1])
    os.write(status, code.to_bytes(BYTES, signed=True))
    os._exit(0)


def _become(argv: list[str], environment: dict, output: list[int]) -> None:
    """Give this process what a new one would be started with."""
    os.setsid()
    _end_with_parent()
    for number, file in enumerate(output, 1):
        os.dup2(file, number)
        os.close(file)
    os.environ.clear()
    os.environ.update(environment)
    sys.argv = argv


def _end_with_parent() -> None:
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)


if __name__ == "__main__":
    with socket.socket(fileno=int(sys.argv[1])) as requests:
        _serve(requests)
