# SPDX-License-Identifier: Apache-2.0
"""Run a node as a process, and stop it: SIGINT and SIGTERM end it, once or repeatedly."""

import contextlib
import ctypes
import faulthandler
import gc
import os
import re
import signal
import socket
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator

import rclpy
from rclpy._rclpy_pybind11 import RCLError, UnknownROSArgsError
from rclpy.executors import Executor, ExternalShutdownException
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future

from selfcal_ros.errors import ExitCode, InputError, SelfcalError
from selfcal_ros.nodes.callbacks import Guarded
from selfcal_ros.topics import LARGEST_DOMAIN

SPIN_SECONDS = 86400.0
"""An infinite time-out overflows in the executor of the wheels; loop with a day instead."""

_raised: list[Executor] = []
"""Executors that raised an error, kept alive: the future still has a callback into them."""


def spin(node: Guarded, until: Future) -> None:
    """Spin a node with the events executor until `until` is done or the context is shut down.

    Errors raised by the executor in spite of `Guarded` are counted as refusals.
    """
    executor = EventsExecutor()
    executor.add_node(node)
    try:
        while rclpy.ok() and not until.done():
            try:
                executor.spin_until_future_complete(until, timeout_sec=SPIN_SECONDS)
            except ExternalShutdownException:
                break
            except Exception as error:
                _raised[:] = [executor]
                node.refusals.add("executor", error)
    finally:
        executor.remove_node(node)
        executor.shutdown()


LOG_FOLDERS = ("HOME", "ROS_HOME", "ROS_LOG_DIR")
"""Variables of the environment of which one must name where ROS keeps its log."""
ARGUMENTS = "arguments after --ros-args"
ENVIRONMENT = "variables HOME and ROS_* of the environment"


def _init(argv: list[str] | None) -> None:
    if not any(map(os.environ.get, LOG_FOLDERS)):
        raise InputError(
            "HOME", "is not set, and ROS keeps its log there", "set it, or ROS_LOG_DIR"
        )
    domain = os.environ.get("ROS_DOMAIN_ID") or "0"
    if not (domain.isdecimal() and int(domain) <= LARGEST_DOMAIN):  # ends the process
        raise InputError(
            "ROS_DOMAIN_ID",
            f"{domain!r} is not a ROS domain",
            f"give a number from 0 to {LARGEST_DOMAIN}",
        )
    try:
        rclpy.init(args=argv, signal_handler_options=SignalHandlerOptions.NO)
    except UnknownROSArgsError as error:
        raise _refused(error, ARGUMENTS) from error
    except RCLError as error:
        of_arguments = "arse" in str(error)  # Couldn't parse, failed to parse
        raise _refused(error, ARGUMENTS if of_arguments else ENVIRONMENT) from error


def _refused(error: Exception, where: str) -> InputError:
    """Return what ROS says as one line."""
    reason = re.sub(r",? at /\S+", "", " ".join(str(error).split()))
    return InputError(where, reason, "correct them")


def _keep_what_is_loaded() -> None:
    """Exempt present objects from garbage collection, which would stop a node for 50 ms.

    They contain no garbage, so none is collected first.
    """
    gc.freeze()


def run(make_node: Callable[[], Guarded], argv: list[str] | None = None) -> int:
    """Run one node as a process; SIGINT and SIGTERM end it cleanly. Return the exit code.

    A signal completes the future that the executor spins on, between two callbacks, so that no
    callback is interrupted and `close` can finish its work.
    """
    stop = Future()
    complete_on_signal(stop)
    node = None
    code = int(ExitCode.DONE)
    try:
        _init(argv)
        try:
            node = make_node()
        except RCLError as error:
            raise _refused(error, ENVIRONMENT) from error
        getattr(node, "autostart", lambda: None)()
        finished = getattr(node, "finished", None)
        if finished is not None:
            finished.add_done_callback(lambda _: stop.set_result(None))
        _keep_what_is_loaded()
        spin(node, stop)
    except SelfcalError as error:
        print(f"selfcal: {error}", file=sys.stderr)
        code = int(error.exit_code)
    except Exception:  # told before the middleware can hang
        traceback.print_exc()
        code = int(ExitCode.INTERNAL)
    finally:
        if node is not None:
            getattr(node, "close", lambda: None)()
            # `close` may set it
            code = code or int(getattr(node, "exit_code", ExitCode.DONE))
        with ended_at_the_latest(code):
            if node is not None:
                node.destroy_node()
            rclpy.try_shutdown()
        ignore_signals()
    return code


LEAVES_S = 5.0
"""Time that a node, its work done, may take to leave the graph; `ros2 launch` waits as long."""
SIGEV_THREAD = 2
"""Of POSIX: a timer calls a function in a thread of its own."""


class Notice(ctypes.Structure):
    """What a timer does when it expires (struct sigevent)."""

    _fields_ = (
        ("value", ctypes.c_void_p),
        ("signal", ctypes.c_int),
        ("kind", ctypes.c_int),
        ("function", ctypes.c_void_p),
        ("attributes", ctypes.c_void_p),
        ("unused", ctypes.c_char * 32),
    )


@contextlib.contextmanager
def ended_at_the_latest(code: int) -> Iterator[None]:
    """End this process with `code` if the block takes longer than `LEAVES_S`.

    Where many nodes end at once, Fast DDS 2.14 with an older libstdc++ (as in the wheels) can wait
    for a minute for a callback that it keeps from ending (eProsima/Fast-DDS 6513). rclpy holds the
    lock of the interpreter meanwhile: no thread of Python could end the process. By then other
    nodes no longer see this one. Where there is no such timer, `ENDS_S` is left.
    """
    libc = ctypes.CDLL(None)
    notice = Notice(
        value=code,
        kind=SIGEV_THREAD,
        function=ctypes.cast(libc._exit, ctypes.c_void_p),
    )
    timer = ctypes.c_void_p()
    make = getattr(libc, "timer_create", None)  # not on macOS
    if make is None or make(
        time.CLOCK_MONOTONIC, ctypes.byref(notice), ctypes.byref(timer)
    ):
        yield
        return
    # seconds and nanoseconds: of the period (once only), of the delay
    delay = (ctypes.c_long * 4)(0, 0, *divmod(int(LEAVES_S * 1e9), 10**9))
    libc.timer_settime(timer, 0, ctypes.byref(delay), None)
    try:
        yield
    finally:
        libc.timer_delete(timer)


STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM)
ENDS_S = 60.0
"""Time after a stop signal at which a hanging node is ended, with stack traces."""


def complete_on_signal(stop: Future) -> None:
    """Complete `stop` on the first of the stop signals, in a separate thread.

    Python calls signal handlers in the main thread between two lines of Python: while that thread
    waits in the executor none is called, and inside a future's methods one would wait
    for their lock forever. The wake-up descriptor is always written to at once.
    """
    reader, writer = socket.socketpair()
    writer.setblocking(False)
    signal.set_wakeup_fd(writer.detach(), warn_on_full_buffer=False)
    for number in STOP_SIGNALS:
        signal.signal(number, lambda *_: None)

    def wait() -> None:
        reader.recv(1)
        try:  # a C thread, independent of Python
            faulthandler.dump_traceback_later(ENDS_S, exit=True)
        finally:  # also without stderr
            stop.set_result(None)
        # keep the descriptor open: later signals would otherwise find a broken pipe
        while True:
            reader.recv(4096)

    threading.Thread(target=wait, name="stop signals", daemon=True).start()
    # blocked while modules are imported
    signal.pthread_sigmask(signal.SIG_UNBLOCK, STOP_SIGNALS)


def ignore_signals() -> None:
    """Ignore repeated signals (a launcher forwards Ctrl-C) during the exit.

    First in the system, then in Python's own table: a signal still being handled by a thread
    while the table changes would be reported as a race.
    """
    for number in STOP_SIGNALS:
        ctypes.pythonapi.PyOS_setsig(int(number), ctypes.c_void_p(int(signal.SIG_IGN)))
    time.sleep(1e-3)
    for number in STOP_SIGNALS:
        signal.signal(number, signal.SIG_IGN)
