# SPDX-License-Identifier: Apache-2.0
"""How SIGINT and SIGTERM end a node, once or again and again."""

import ctypes
import faulthandler
import signal
import socket
import threading
import time

from rclpy.task import Future

STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM)
ENDS_S = 60.0
"""Time after a stop signal at which a node that has not ended is ended; it says where it hung."""


def complete_on_signal(stop: Future) -> None:
    """Complete `stop` on the first of the stop signals, in a thread of its own.

    Python calls signal handlers in the main thread between two lines of Python: while that thread
    waits in the executor none is called, and in the midst of a future's methods one would wait
    for their lock for ever. The wake-up descriptor is written to at once, whatever runs.
    """
    reader, writer = socket.socketpair()
    writer.setblocking(False)
    signal.set_wakeup_fd(writer.detach(), warn_on_full_buffer=False)
    for number in STOP_SIGNALS:
        signal.signal(number, lambda *_: None)

    def wait() -> None:
        reader.recv(1)
        try:  # a thread of C, whatever hangs
            faulthandler.dump_traceback_later(ENDS_S, exit=True)
        finally:  # also where there is no stderr to say it on
            stop.set_result(None)
        while True:  # the descriptor stays open, or later signals would find a broken pipe
            reader.recv(4096)

    threading.Thread(target=wait, name="stop signals", daemon=True).start()
    signal.pthread_sigmask(signal.SIG_UNBLOCK, STOP_SIGNALS)  # blocked while modules are imported


def ignore_signals() -> None:
    """Let no repeated signal (a launcher passes Ctrl-C on) disturb the exit.

    First for the system alone, then in Python's own table: a signal that a thread still handles
    while the table changes would be reported as a race.
    """
    for number in STOP_SIGNALS:
        ctypes.pythonapi.PyOS_setsig(int(number), ctypes.c_void_p(int(signal.SIG_IGN)))
    time.sleep(1e-3)
    for number in STOP_SIGNALS:
        signal.signal(number, signal.SIG_IGN)
