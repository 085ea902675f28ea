# SPDX-License-Identifier: Apache-2.0
"""Whose time it is: whether the cell's clock is this machine's, and what ROS time follows."""

from collections import deque
from collections.abc import Callable, Mapping

import numpy as np

from selfcal_ros.collection.clock_steps import Step, StepWatch
from selfcal_ros.sessions.ports import Diagnosis, Level
from selfcal_ros.units import NS_PER_S, S_PER_NS

LIVE_NS = NS_PER_S
"""A command received later than this after its stamp is recorded or latched, not live."""
WINDOW_S = 2.0
BIN_S = 0.1


class ClockWatch:
    """Compares the stamps of the cell with the instants at which its messages arrive.

    A message arrives after its stamp, by an unknown delay; the smallest delay of the last seconds
    is the offset of the cell's clock, to within the transport. Nothing is said while recorded
    messages are played: the commands then have stamps of the past as well.

    Steps are looked for by a steady clock: those of this machine's own clock are found as well.

    Parameters
    ----------
    limit_s : float
        Largest offset, and largest step, that is no matter.

    Attributes
    ----------
    steps : dict
        Topic -> steps of the clock that stamps it, since the run began.
    """

    def __init__(self, limit_s: float) -> None:
        self._limit_s, self._limit_ns = limit_s, round(limit_s * NS_PER_S)
        self._live, self._live_run = False, ""
        self._bins: deque[tuple[float, int]] = deque()
        self._watches: dict[str, StepWatch] = {}
        self.steps: dict[str, list[Step]] = {}

    def command(self, stamp_ns: int, now_ns: int, *, is_older: bool, run_id: str = "") -> None:
        """Learn from a command whether the session is live; a latched one tells nothing.

        A run that was live remains so: when a clock has stepped, its stamps look like recorded
        ones.
        """
        if is_older:
            return
        known = bool(run_id) and run_id == self._live_run
        self._live = known or abs(now_ns - stamp_ns) <= LIVE_NS
        if self._live and run_id != self._live_run:
            self._live_run, self._watches, self.steps = run_id, {}, {}

    def adopt(self, run_id: str, steps: Mapping[str, list[Step]]) -> None:
        """Go on with a run in which clocks have stepped before."""
        self._live_run, self._watches = run_id, {}
        self.steps = {topic: list(mine) for topic, mine in steps.items()}

    def data(self, topic: str, stamps_ns: np.ndarray, now_ns: np.ndarray,
             steady_ns: np.ndarray) -> None:
        """Take the stamps and the reception of messages of the cell, by both clocks; n > 0."""
        if self._live:
            watch = self._watches.setdefault(topic, StepWatch(self._limit_s))
            self.steps.setdefault(topic, []).extend(watch.add(stamps_ns, steady_ns))
        offset, now_s = int((stamps_ns - now_ns).max()), float(steady_ns[-1]) * S_PER_NS
        if self._bins and now_s - self._bins[-1][0] < BIN_S:
            when, largest = self._bins[-1]
            self._bins[-1] = (when, max(largest, offset))
        else:
            self._bins.append((now_s, offset))
            while now_s - self._bins[0][0] > WINDOW_S:
                self._bins.popleft()

    @property
    def offset_ns(self) -> int | None:
        """How much the cell's clock is ahead, ns; None while nothing live is heard."""
        return max(offset for _, offset in self._bins) if self._live and self._bins else None

    @property
    def ahead(self) -> bool:
        """Whether stamps come from the future, by more than the limit."""
        return self.offset_ns is not None and self.offset_ns > self._limit_ns

    def diagnosis(self) -> Diagnosis:
        """Return WARN with the offset where it is beyond the limit."""
        offset = self.offset_ns
        if offset is None:
            return Diagnosis(Level.OK, "")
        values = {"clock_offset_s": f"{offset * S_PER_NS:.3f}"}
        if abs(offset) <= self._limit_ns:
            return Diagnosis(Level.OK, "", values)
        side = "ahead of" if offset > 0 else "behind"
        return Diagnosis(Level.WARN, f"the cell's clock is {abs(offset) * S_PER_NS:.3g} s {side} "
                         "this machine's: detections fall into wrong views; synchronise the clocks "
                         "(PTP, NTP)", values)


class RosTime:
    """Says what ROS time follows; work and health go by a steady clock whatever it does.

    Parameters
    ----------
    say : callable (level, line)
        Writes to the log: one line when what ROS time does changes.
    """

    NOTHING = ("use_sim_time is set and nothing is heard on /clock: what this node stamps is "
               "stamped 0; play the bag with --clock, or set use_sim_time to false")

    def __init__(self, say: Callable[[Level, str], None]) -> None:
        self._say = say
        self._last_ns, self._state = 0, "system"

    def look(self, *, simulated: bool, now_ns: int) -> Diagnosis:
        """Return what ROS time does, now that it is `now_ns`; called once a second."""
        if not simulated:
            return Diagnosis(Level.OK, "")
        moves, self._last_ns = now_ns != self._last_ns, now_ns
        state = "not heard" if now_ns == 0 else "moves" if moves else "stands"
        if state != self._state:
            self._state = state
            self._say(*self._line(state))
        return Diagnosis(Level.WARN if now_ns == 0 else Level.OK,
                         self.NOTHING if now_ns == 0 else "", {"/clock": state})

    def _line(self, state: str) -> tuple[Level, str]:
        if state == "not heard":
            return Level.WARN, self.NOTHING
        if state == "moves":
            return Level.OK, "stamps follow /clock (use_sim_time); work and health do not"
        return Level.OK, (f"/clock stands at {self._last_ns * S_PER_NS:.3f} s; work and health go "
                          "on, stamps do not")
