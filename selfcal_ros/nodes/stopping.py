# SPDX-License-Identifier: Apache-2.0
"""SIGINT and SIGTERM end a node, once or repeatedly."""

import ctypes
import faulthandler
import signal
import socket
import threading
import time

from rclpy.task import Future

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
        while True:  # keep the descriptor open: later signals would otherwise find a broken pipe
            reader.recv(4096)

    threading.Thread(target=wait, name="stop signals", daemon=True).start()
    signal.pthread_sigmask(signal.SIG_UNBLOCK, STOP_SIGNALS)  # blocked while modules are imported


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
