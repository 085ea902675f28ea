# SPDX-License-Identifier: Apache-2.0
"""Interface between a session and its node, and diagnoses."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any

DIGITS = 20
"""Smallest whole number that does not fit into an int64."""


class Level(IntEnum):
    """Levels of diagnostic_msgs/DiagnosticStatus, and of log lines."""

    OK = 0
    WARN = 1
    ERROR = 2


@dataclass(frozen=True)
class Diagnosis:
    """One diagnostic status: level, one line, and values by name."""

    level: Level
    message: str
    values: dict[str, Any] = field(default_factory=dict)

    def number(self, key: str) -> int | None:
        """Return a value that is a non-negative int64; else None."""
        text = str(self.values.get(key, ""))
        is_whole = text.isascii() and text.isdecimal() and len(text) < DIGITS
        return int(text) if is_whole else None


@dataclass(frozen=True)
class Ports:
    """Functions of the node for a session.

    Attributes
    ----------
    publish : callable (output, fields)
        Publish the fields of a message on a named output of the node.
    say : callable (level, line)
        Write one line to the log.
    now_s : callable
        Monotonic seconds, for time-outs.
    now_ns : callable
        The clock that stamps messages, integer ns.
    cpu_s : callable
        CPU seconds of this thread.
    wall_ns : callable
        The clock of the middleware's reception times, integer ns.
    """

    publish: Callable[[str, dict[str, Any]], None]
    say: Callable[[Level, str], None]
    now_s: Callable[[], float]
    now_ns: Callable[[], int]
    cpu_s: Callable[[], float] = time.thread_time
    wall_ns: Callable[[], int] = time.time_ns
