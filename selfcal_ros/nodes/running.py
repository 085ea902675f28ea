# SPDX-License-Identifier: Apache-2.0
"""Run a node as a process, and stop it."""

import gc
import re
import sys
from collections.abc import Callable

import rclpy
from rclpy._rclpy_pybind11 import RCLError, UnknownROSArgsError
from rclpy.executors import Executor, ExternalShutdownException
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future

from selfcal_ros.errors import ExitCode, InputError, SelfcalError
from selfcal_ros.nodes.callbacks import Guarded
from selfcal_ros.nodes.stopping import complete_on_signal, ignore_signals

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


def _init(argv: list[str] | None) -> None:
    try:
        rclpy.init(args=argv, signal_handler_options=SignalHandlerOptions.NO)
    except (RCLError, UnknownROSArgsError) as error:
        what = re.sub(r",? at /\S+", "", " ".join(str(error).split()))
        raise InputError("arguments after --ros-args", what, "correct them") from error


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
    node, code = None, int(ExitCode.DONE)
    try:
        _init(argv)
        node = make_node()
        getattr(node, "autostart", lambda: None)()
        finished = getattr(node, "finished", None)
        if finished is not None:
            finished.add_done_callback(lambda _: stop.set_result(None))
        _keep_what_is_loaded()
        spin(node, stop)
        code = int(getattr(node, "exit_code", ExitCode.DONE))
    except SelfcalError as error:
        print(f"selfcal: {error}", file=sys.stderr)
        code = int(error.exit_code)
    finally:
        if node is not None:
            getattr(node, "close", lambda: None)()
            node.destroy_node()
        rclpy.try_shutdown()
        ignore_signals()
    return code
