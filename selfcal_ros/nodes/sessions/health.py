# SPDX-License-Identifier: Apache-2.0
"""Health of a node, published once a second, and the functions that its session needs."""

import time
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any

import numpy as np

from selfcal_ros.errors import SelfcalError, first_line, printable, some_of
from selfcal_ros.estimation.checks.placing import misplaced, placing_error
from selfcal_ros.estimation.checks.wiring import wiring_error, wiring_faults
from selfcal_ros.model.readings import Measurements
from selfcal_ros.units import NS_PER_S

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

    @classmethod
    def of(
        cls,
        wrong: Collection[str],
        values: dict[str, Any] | None = None,
        *,
        level: Level = Level.WARN,
    ) -> "Diagnosis":
        """Return lines on what is wrong, at `level`; OK if there are none."""
        return cls(level if wrong else Level.OK, "; ".join(wrong), values or {})

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


FIRST_LINES = 5
"""Refusals of one kind that are all logged; then only the 10th, 100th, ..."""
MEMORY_S = 10.0
"""Time for which a refusal or a loss keeps the state at WARN."""
LEAST_STEPS, MOST_STEPS = 40, 20_000
"""Smallest number of intervals for a jitter, and number kept for it."""
MORE = 1.25
"""Ratio of marks to those at the last check at which the pose is checked again."""
NAMED = 6
"""Missing marks and lines named in a line; the rest is counted."""


def merged(main: Diagnosis, others: Iterable[Diagnosis]) -> Diagnosis:
    """Return one combined diagnosis: the worst level, problems first, all values."""
    others = list(others)
    wrong = [item.message for item in others if item.level > Level.OK and item.message]
    values = dict(main.values)
    for item in others:
        values |= item.values
    return Diagnosis(
        max([main.level, *(item.level for item in others)]),
        "; ".join(dict.fromkeys(filter(None, [*wrong, main.message]))),
        values,
    )


class Tally:
    """Count faults by place; the newest line of each place is reported for some time.

    Parameters
    ----------
    say : callable (level, line)
        Writes to the log.
    now_s : callable
        Monotonic seconds.
    """

    word = ""
    """Prefix of a place in the diagnostics."""

    def __init__(
        self, say: Callable[[Level, str], None], now_s: Callable[[], float]
    ) -> None:
        self._say, self._now_s = say, now_s
        self.counts: Counter = Counter()
        self._last: dict[str, tuple[float, str]] = {}

    def _is_recent(self, place: str) -> bool:
        return place in self._last and self._now_s() - self._last[place][0] < MEMORY_S

    def diagnosis(self) -> Diagnosis:
        """Return WARN and the newest lines for some time after a fault."""
        recent = [
            line for place, (_, line) in self._last.items() if self._is_recent(place)
        ]
        return Diagnosis.of(
            recent,
            {f"{self.word} {place}": n for place, n in sorted(self.counts.items())},
        )


class Refusals(Tally):
    """Messages that callbacks could not use, with reasons, without flooding the log."""

    word = "refused"

    def add(self, place: str, error: Exception) -> None:
        """Count an error of the callback at `place`; a foreign one shows its type."""
        line = (
            str(error)
            if isinstance(error, SelfcalError)
            else (
                f"{place}: cannot be used ({type(error).__name__}: {printable(first_line(error))})"
            )
        )
        self.counts[place] += 1
        self._last[place] = (self._now_s(), line)
        count = self.counts[place]
        if count <= FIRST_LINES or str(count).rstrip("0") == "1":
            self._say(
                Level.ERROR, line + (f" (refused {count} times)" if count > 1 else "")
            )


class Losses(Tally):
    """Published messages that were not received.

    The middleware's events and the sequence numbers report the same losses, at different times or
    not at all: the larger of the two counts is used.
    """

    word = "lost"

    def __init__(
        self, say: Callable[[Level, str], None], now_s: Callable[[], float]
    ) -> None:
        super().__init__(say, now_s)
        self._told: dict[str, Counter] = {}

    def add(self, topic: str, number: int, told_by: str = "events") -> None:
        """Count `number` messages of `topic` as lost, unless reported by the other source."""
        counts = self._told.setdefault(topic, Counter())
        counts[told_by] += number
        total = max(counts.values())
        new = total - self.counts[topic]
        if new > 0:
            self._tell(
                topic,
                total,
                f"{topic}: {new} messages were lost in transport; the machine or the "
                "network is too slow for them",
                f"{topic}: {total} messages lost",
            )

    def add_unheard(self, topic: str, number: int) -> None:
        """Count messages published while this node had no subscription."""
        line = f"{topic}: {number} messages were published while this node was not listening"
        place = f"{topic}, not listening"
        self._tell(place, self.counts[place] + number, line, line)

    def _tell(self, place: str, total: int, warning: str, line: str) -> None:
        if not self._is_recent(place):
            self._say(Level.WARN, warning)
        self.counts[place] = total
        self._last[place] = (self._now_s(), line)


class Presence:
    """Other nodes that are alive, by the health that each publishes once a second.

    Parameters
    ----------
    now_s : callable
        Monotonic seconds.
    patience_s : float
        A node silent for longer is absent.
    """

    def __init__(self, now_s: Callable[[], float], patience_s: float) -> None:
        self._now_s, self._patience_s = now_s, patience_s
        self._heard: dict[str, tuple[float, Diagnosis]] = {}

    def take(self, node: str, diagnosis: Diagnosis) -> None:
        """Take the health of a node."""
        self._heard[node] = (self._now_s(), diagnosis)

    def of(self, node: str) -> Diagnosis | None:
        """Return the last health of `node`; None if too old."""
        when, diagnosis = self._heard.get(node, (float("-inf"), None))
        return diagnosis if self._now_s() - when <= self._patience_s else None

    def silent(self) -> list[str]:
        """Return the names of nodes heard before, but not recently."""
        return sorted(node for node in self._heard if self.of(node) is None)


class Rate:
    """Rate, longest gap and jitter of a stream over the last seconds.

    A gap is relative to the newest stamp of these seconds: a stamp in the future hides no later
    gap.

    Parameters
    ----------
    now_s : callable
        Monotonic seconds.
    """

    WINDOW_S = 2.0

    def __init__(self, now_s: Callable[[], float]) -> None:
        self._now_s = now_s
        # begin, messages, newest stamp
        self._bins: deque[tuple[float, int, int]] = deque()
        self.longest_gap_ns = 0
        self._steps: list[
            np.ndarray
        ] = []  # between stamps, since the last query of the jitter
        self._n_steps = 0

    def add(self, stamps_ns: np.ndarray) -> None:
        """Take messages by their stamps, int64 array (n,) in the order of arrival, n > 0."""
        now = self._now_s()
        count = len(stamps_ns)
        latest_ns = int(stamps_ns.max())
        while len(self._bins) > 1 and now - self._bins[0][0] > self.WINDOW_S:
            self._bins.popleft()
        before_ns = max((newest for _, _, newest in self._bins), default=stamps_ns[0])
        newest = np.maximum.accumulate(np.append(before_ns, stamps_ns))
        steps = np.diff(newest)
        self.longest_gap_ns = max(self.longest_gap_ns, int(steps.max()))
        if self._n_steps < MOST_STEPS:
            self._steps.append(steps[steps > 0])
            self._n_steps += len(self._steps[-1])
        if self._bins and now - self._bins[-1][0] < 0.1:
            began, before, known_ns = self._bins.pop()
            self._bins.append((began, before + count, max(known_ns, latest_ns)))
        else:
            self._bins.append((now, count, latest_ns))

    @property
    def per_second(self) -> float:
        """Messages a second by reception."""
        now = self._now_s()
        return (
            sum(count for began, count, _ in self._bins if now - began <= self.WINDOW_S)
            / self.WINDOW_S
        )

    def take_gap_ns(self) -> int:
        """Return the longest gap between stamps since the last call."""
        gap = self.longest_gap_ns
        self.longest_gap_ns = 0
        return gap

    def take_jitter_s(self) -> float:
        """Return half of the range of 95 % of the intervals since the last call, s.

        A single gap is not jitter. NaN for fewer than `LEAST_STEPS` intervals.
        """
        steps = np.concatenate([np.zeros(0), *self._steps])
        self._steps, self._n_steps = [], 0
        if len(steps) < LEAST_STEPS:
            return float("nan")
        low, high = np.percentile(steps, [2.5, 97.5])
        return float(high - low) / 2 / NS_PER_S


class CellChecks:
    """Check the readings so far; log each fault once, and keep it for the diagnosis.

    Parameters
    ----------
    say : callable (level, line)
        Writes to the log.
    """

    def __init__(self, say: Callable[[Level, str], None]) -> None:
        self._say = say
        self._miswired: dict[
            str, str
        ] = {}  # view and kind of marks -> fault of the offsets
        self._misplaced = ""
        self._marks = 0  # marks read at the last check of the pose

    def take(self, measurements: Measurements) -> None:
        """Check the readings of all views so far."""
        faults = {
            f"{fault.view} {fault.kind}": str(wiring_error(fault))
            for fault in wiring_faults(measurements)
        }
        for place in faults.keys() - self._miswired.keys():
            self._say(Level.ERROR, faults[place])
        self._miswired = faults
        self._check_placing(measurements)

    def _check_placing(self, measurements: Measurements) -> None:
        """Check the pose of the plate when there are more marks.

        While it is wrong, also whenever the marks have changed, so that a repeated view ends the
        fault.
        """
        marks = sum(len(view.m) for view in measurements.views)
        if marks == self._marks or (
            not self._misplaced and self._marks < marks < MORE * self._marks
        ):
            return
        self._marks, misplacement = marks, misplaced(measurements)
        line = str(placing_error(misplacement)) if misplacement else ""
        if line and line != self._misplaced:
            self._say(Level.ERROR, line)
        self._misplaced = line

    def diagnosis(self) -> Diagnosis:
        """Return the faults, ERROR if any."""
        wrong = [line for line in (*self._miswired.values(), self._misplaced) if line]
        return Diagnosis.of(wrong, level=Level.ERROR)


class StallWatch:
    """Detect a pause of the detections of the current view.

    Parameters
    ----------
    stall_s : float
        Shortest pause that counts; a slow cell gets three times its longest pause so far.
    now_s : callable
        Monotonic seconds.
    """

    def __init__(self, stall_s: float, now_s: Callable[[], float]) -> None:
        self._stall_s, self._now_s = stall_s, now_s
        self.restart()

    def restart(self) -> None:
        """Restart: a command has been sent."""
        self._since, self._longest_s = self._now_s(), 0.0
        self._seen: int | None = None

    def take(self, detections: int) -> None:
        """Take the number of detections of the view so far."""
        if detections != self._seen:
            now = self._now_s()
            if self._seen is not None:
                self._longest_s = max(self._longest_s, now - self._since)
            self._seen, self._since = detections, now

    @property
    def stalled(self) -> bool:
        """Whether the pause is longer than that of a slow cell."""
        return self._now_s() - self._since >= max(self._stall_s, 3 * self._longest_s)


def missing_marks(status: Any) -> str:
    """Return the missing marks, lines and check stops of a ViewStatus as text, "" if none."""
    marks = [
        f"({m}, {n})" for m, n in zip(status.missing_m, status.missing_n, strict=False)
    ]
    grid = status.grid_expected - status.grid_done
    lines = [str(k) for k in status.missing_k]
    angular = status.angular_expected - status.angular_done
    checks = status.check_expected - status.check_done
    parts = [
        _named(words, count, what)
        for words, count, what in ((marks, grid, "mark"), (lines, angular, "line"))
        if count > 0
    ]
    parts += (
        [
            f"check stops of {checks} mark{'s' * (checks != 1)} (see check_marks of "
            "the view command)"
        ]
        if checks > 0
        else []
    )
    return " and ".join(parts)


def _named(words: list[str], count: int, what: str) -> str:
    text = f"{count} {what}{'s' * (count != 1)}"
    return f"{text}: {some_of(words, NAMED, count)}" if words else text
