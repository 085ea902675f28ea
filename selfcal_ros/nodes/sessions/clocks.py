# SPDX-License-Identifier: Apache-2.0
"""Clocks: offsets, source of ROS time, and order of runs."""

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from selfcal_ros.collection.clock_steps import ClockStep, StepWatch
from selfcal_ros.collection.diagnosis import UNSTAMPED
from selfcal_ros.collection.inputs import MAX_AHEAD_NS, Command, begun_ns
from selfcal_ros.collection.timeline import begins_run
from selfcal_ros.nodes.sessions.health import Diagnosis, Level
from selfcal_ros.topics import DETECTION_TOPIC
from selfcal_ros.units import NS_PER_S, S_PER_NS

LIVE_NS = NS_PER_S
"""A command received later than this after its stamp is recorded or latched, not live."""
WINDOW_S = 2.0
BIN_S = 0.1


class ClockWatch:
    """Compare the stamps of the cell with the reception of its messages.

    A message arrives after its stamp, by an unknown delay; the smallest delay of the last seconds
    is the offset of the cell's clock, to within the transport delay. A detection comes later by the
    time that its image took, so that detections alone show no clock that is behind. There is no
    report while recorded messages are played: the commands then have stamps of the past as well.

    Steps are detected with a steady clock, including those of this machine's own clock.

    Parameters
    ----------
    limit_s : float
        Largest offset, and largest step, that is ignored.

    Attributes
    ----------
    steps : dict
        Topic -> steps of the clock that stamps it, since the run began.
    """

    def __init__(self, limit_s: float) -> None:
        self._limit_s, self._limit_ns = limit_s, round(limit_s * NS_PER_S)
        self._live, self._live_run = False, ""
        self._bins: deque[tuple[float, int]] = deque()
        self._unstamped: set[str] = set()  # topics whose newest messages are stamped 0
        self._watches: dict[str, StepWatch] = {}
        self.steps: dict[str, list[ClockStep]] = {}

    def command(
        self, stamp_ns: int, now_ns: int, *, is_older: bool, run_id: str = ""
    ) -> None:
        """Determine from a command whether the session is live; a latched one is ignored.

        A live run remains live: after a clock step its stamps look like recorded
        ones.
        """
        if is_older:
            return
        same_run = bool(run_id) and run_id == self._live_run
        self._live = same_run or abs(now_ns - stamp_ns) <= LIVE_NS
        if self._live and run_id != self._live_run:
            self._live_run, self._watches, self.steps = run_id, {}, {}

    def adopt(self, run_id: str, steps: Mapping[str, list[ClockStep]]) -> None:
        """Continue a run in which clocks have stepped before."""
        self._live_run, self._watches = run_id, {}
        self.steps = {topic: list(mine) for topic, mine in steps.items()}

    def data(
        self,
        topic: str,
        stamps_ns: np.ndarray,
        now_ns: np.ndarray,
        steady_ns: np.ndarray,
    ) -> None:
        """Take the stamps and the reception, by both clocks, of messages of the cell; n > 0."""
        self._unstamped.discard(topic)
        if not stamps_ns.any():
            self._unstamped.add(topic)
            return
        if self._live:
            watch = self._watches.setdefault(topic, StepWatch(self._limit_s))
            self.steps.setdefault(topic, []).extend(watch.add(stamps_ns, steady_ns))
        offset = int((stamps_ns - now_ns).max())
        now_s = float(steady_ns[-1]) * S_PER_NS
        if topic == DETECTION_TOPIC and offset < 0:
            return
        if self._bins and now_s - self._bins[-1][0] < BIN_S:
            when, largest = self._bins[-1]
            self._bins[-1] = (when, max(largest, offset))
        else:
            self._bins.append((now_s, offset))
            while now_s - self._bins[0][0] > WINDOW_S:
                self._bins.popleft()

    @property
    def offset_ns(self) -> int | None:
        """Lead of the cell's clock, ns; None without live messages."""
        return (
            max(offset for _, offset in self._bins)
            if self._live and self._bins
            else None
        )

    @property
    def ahead(self) -> bool:
        """Whether stamps are in the future by more than the limit."""
        return self.offset_ns is not None and self.offset_ns > self._limit_ns

    def diagnosis(self) -> Diagnosis:
        """Return WARN with the offset if beyond the limit, or without stamps."""
        if self._live and self._unstamped:
            return Diagnosis(
                Level.WARN, f"{', '.join(sorted(self._unstamped))}: {UNSTAMPED}"
            )
        offset = self.offset_ns
        if offset is None:
            return Diagnosis(Level.OK, "")
        values = {"clock_offset_s": f"{offset * S_PER_NS:.3f}"}
        if abs(offset) <= self._limit_ns:
            return Diagnosis(Level.OK, "", values)
        side = "ahead of" if offset > 0 else "behind"
        return Diagnosis(
            Level.WARN,
            f"the cell's clock is {abs(offset) * S_PER_NS:.3g} s {side} this "
            "machine's: detections fall into wrong views; synchronise the clocks "
            "(PTP, NTP)",
            values,
        )


class RosTime:
    """Report the source of ROS time; work and health always use a steady clock.

    Parameters
    ----------
    say : callable (level, line)
        Writes to the log: one line for each change.
    """

    NOTHING = (
        "use_sim_time is set but nothing is received on /clock: this node stamps "
        "everything 0; play the bag with --clock, or start the node without use_sim_time"
    )

    def __init__(self, say: Callable[[Level, str], None]) -> None:
        self._say = say
        self._last_ns, self._state = 0, "system"

    def look(self, *, simulated: bool, now_ns: int) -> Diagnosis:
        """Return the state of ROS time at `now_ns`; called once a second."""
        if not simulated:
            return Diagnosis(Level.OK, "")
        moves = now_ns != self._last_ns
        self._last_ns = now_ns
        state = "not heard" if now_ns == 0 else "moves" if moves else "stands"
        if state != self._state:
            self._state = state
            self._say(*self._line(state))
        return Diagnosis(
            Level.WARN if now_ns == 0 else Level.OK,
            self.NOTHING if now_ns == 0 else "",
            {"/clock": state},
        )

    def _line(self, state: str) -> tuple[Level, str]:
        if state == "not heard":
            return Level.WARN, self.NOTHING
        if state == "moves":
            return (
                Level.OK,
                "stamps follow /clock (use_sim_time); work and health do not",
            )
        return Level.OK, (
            f"/clock has stopped at {self._last_ns * S_PER_NS:.3f} s; work and "
            "health continue, stamps do not"
        )


@dataclass(frozen=True)
class PlanRun:
    """One run of a plan; `run_id` is the stamp of its first command, ns, as text.

    `run_id` is empty if a publisher or a recording does not provide it.
    """

    plan_id: str = ""
    run_id: str = ""


def supersedes(new: PlanRun, current: PlanRun) -> bool:
    """Return whether messages of run `new` replace those of `current`.

    The later run wins. One whose beginning is unknown never replaces one whose beginning is known.
    """
    begun, before = begun_ns(new.run_id), begun_ns(current.run_id)
    return before is None or (begun is not None and begun > before)


def is_future(stamp_ns: int, now_ns: int) -> bool:
    """Return whether a stamp is implausibly far ahead of a node's clock.

    A clock at 0 is a /clock without publisher and is ignored.
    """
    return now_ns > 0 and stamp_ns > now_ns + MAX_AHEAD_NS


def begins_in_future(run: PlanRun, now_ns: int) -> bool:
    """Return whether a run begins far ahead of a node's clock."""
    return is_future(begun_ns(run.run_id) or 0, now_ns)


class RunWatch:
    """Find why a run is not shown: its stamps, a clock that was set back, strays."""

    def __init__(self) -> None:
        self._hidden: Command | None = None

    def command(self, command: Command, newest: Command | None, now_ns: int) -> None:
        """Take a command on reception; an old one, such as a recorded one, hides nothing."""
        if newest is None or _run_of(command) == _run_of(newest):
            self._hidden = None
        elif (
            begins_run(command)
            and abs(command.stamp_ns - now_ns) <= MAX_AHEAD_NS
            and (command.stamp_ns < newest.stamp_ns)
        ):
            self._hidden = command

    def lines(
        self, newest: Command | None, strays: tuple[Command, ...], now_ns: int
    ) -> dict[str, str]:
        """Return a line for each problem, with its remedy, by the kind of problem."""
        problems = {}
        if newest is not None and is_future(newest.stamp_ns, now_ns):
            problems["set back"] = (
                f"the newest view command is stamped {(newest.stamp_ns - now_ns) * S_PER_NS:.0f} s "
                "ahead of this machine's clock, which was set back: no later run is shown; restart "
                "measurement_collector, which ignores such a run, and start the plan again"
            )
        elif newest is not None and 0 < now_ns < newest.stamp_ns - NS_PER_S:
            problems["ahead"] = (
                f"the newest view command is stamped {(newest.stamp_ns - now_ns) * S_PER_NS:.1f} s "
                "ahead of this machine's clock: detections until then count before it; synchronise "
                "the clocks"
            )
        if self._hidden is not None and newest is not None:
            behind = (newest.stamp_ns - self._hidden.stamp_ns) * S_PER_NS
            problems[f"hidden {self._hidden.run_id} {newest.run_id}"] = (
                f"run {self._hidden.run_id} is not shown: it began {behind:.3g} s before the last "
                f"view command of run {newest.run_id}, by its stamps; abort it, synchronise the "
                "clocks, and start it again"
            )
        if strays:
            problems["strays"] = (
                f"{len(strays)} view command{'s' * (len(strays) > 1)} of plan "
                f"'{strays[-1].plan_id}' arrived during a run, belonging to no run that has begun, "
                "and changed nothing: find their publisher"
            )
        return problems


def _run_of(command: Command) -> PlanRun:
    return PlanRun(command.plan_id, command.run_id)
