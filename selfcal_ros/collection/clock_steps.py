# SPDX-License-Identifier: Apache-2.0
"""Detection of clock steps during a run, from the difference of stamps and reception.

Readings depend on stamps alone and never on the order of arrival; this changes no number.
It names a clock that has stepped, which stamps alone cannot show.
"""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from selfcal_ros.collection.inputs import MAX_AHEAD_NS
from selfcal_ros.collection.timeline import Timeline
from selfcal_ros.units import NS_PER_S, S_PER_NS

GROUP, BESIDE = 3, 5
"""Messages per group, and groups compared on either side of a step. The marks of an image, which
share a stamp and its delay, are in one."""
MOST_ALIKE = 1000
"""Messages of one stamp in a group, for a clock that stands still."""
REMEMBERED = 10_000
"""Messages within which one that is sent again is known by its stamp."""
SLEW = 2000
"""Largest drift of a disciplined clock: one part in this many."""
REMEDY = (
    "let clocks slew, not step, while a run is measured (chrony, ptp4l: no step after "
    "the start)"
)
Span = tuple[np.ndarray, np.ndarray]
"""Lowest and highest of offset, stamp, reception and whether sent again, each (4, n)."""


@dataclass(frozen=True)
class ClockStep:
    """A step of a clock.

    Attributes
    ----------
    before_ns : int
        A stamp before the step, at most a few messages old.
    by_ns : int
        Change of the stamps, later (+) or earlier (-).
    """

    before_ns: int
    by_ns: int


class StepWatch:
    """Find the steps of the clock that stamps a stream of messages.

    A step changes the difference of stamps and reception at once and permanently: the values before
    and after do not overlap. Late, bundled or lost messages look different: when a delay ends, and
    delayed messages were lost, stamps get closer to their reception again, but no closer
    than before. Messages that are sent again at once are no step either, nor images of which some
    take a detector longer. If the clock of reception steps as well, only a step back can be
    distinguished from a pause. A step is seen 15 messages, or six images, later.

    Parameters
    ----------
    limit_s : float
        Smaller steps are ignored.
    """

    def __init__(self, limit_s: float) -> None:
        self._limit_ns = round(limit_s * NS_PER_S)
        self._remembered_ns = np.zeros(0, dtype=np.int64)
        self._rest = np.zeros((3, 0), dtype=np.int64)  # an incomplete group
        self._n_grouped = 0  # messages before it
        self._groups = np.zeros((8, 0), dtype=np.int64)
        self._nearest: tuple[int, int] | None = None  # largest offset, and its time
        self._quiet = 0  # groups still affected by a reported step

    def add(self, stamps_ns: np.ndarray, received_ns: np.ndarray) -> list[ClockStep]:
        """Take messages in the order of reception; return the steps found.

        Parameters
        ----------
        stamps_ns, received_ns : int64 array (n,)
            Stamps, and instants of reception.
        """
        if not len(stamps_ns):
            return []
        new = np.stack([stamps_ns, received_ns, self._sent_again(stamps_ns)])
        messages = np.concatenate([self._rest, new], axis=1)
        starts = self._starts(messages[0])
        if len(starts) == 1:
            self._rest = messages
            return []
        self._rest = messages[:, starts[-1] :]
        self._n_grouped += int(starts[-1])
        stamps, received, again = messages[:, : starts[-1]]
        columns = (stamps - received, stamps, received, again)
        self._groups = np.concatenate(
            [
                self._groups,
                np.stack(
                    [
                        ends.reduceat(column, starts[:-1])
                        for column in columns
                        for ends in (np.minimum, np.maximum)
                    ]
                ),
            ],
            axis=1,
        )
        steps = self._look()
        self._groups = self._groups[:, -2 * BESIDE :]
        return steps

    def _starts(self, stamps_ns: np.ndarray) -> np.ndarray:
        """Return where groups begin in the messages that are not grouped yet; the last is open."""
        alike = np.arange(len(stamps_ns)) - _first_alike(stamps_ns)
        first = np.flatnonzero(alike % MOST_ALIKE == 0)
        group = (first + self._n_grouped) // GROUP
        return first[np.r_[True, np.diff(group) != 0]]

    def _sent_again(self, stamps_ns: np.ndarray) -> np.ndarray:
        """Return which messages bear a stamp from before the last change of stamps, (n,).

        The answer does not depend on the pieces in which messages come.
        """
        known = np.concatenate([self._remembered_ns, stamps_ns])
        self._remembered_ns = known[-2 * REMEMBERED :]
        if not (np.diff(known) < 0).any():
            return np.zeros(len(stamps_ns), dtype=bool)
        order = np.argsort(known, kind="stable")
        alike = known[order[1:]] == known[order[:-1]]
        ago = np.full(len(known), REMEMBERED + 1)
        ago[order[1:][alike]] = np.diff(order)[alike]
        return (ago[_first_alike(known)] <= REMEMBERED)[-len(stamps_ns) :]

    def _look(self) -> list[ClockStep]:
        """Return the steps within a group with neighbours on both sides."""
        count = self._groups.shape[1] - 2 * BESIDE
        if count <= 0:
            return []
        low = np.stack(
            [self._groups[0::2, k : k + count + BESIDE + 1] for k in range(BESIDE)]
        ).min(0)
        high = np.stack(
            [self._groups[1::2, k : k + count + BESIDE + 1] for k in range(BESIDE)]
        ).max(0)
        before = (low[:, :count], high[:, :count])
        after = (low[:, BESIDE + 1 :][:, :count], high[:, BESIDE + 1 :][:, :count])
        between = self._groups[2:4, BESIDE : BESIDE + count]
        size = _parted(before, between, after, self._limit_ns)
        offset = (after[0][0] + after[1][0]) // 2
        out = []
        for number in range(count):
            if self._quiet:
                self._quiet -= 1
                continue
            nearest, when = self._nearest_so_far(before[1][:, number])
            # by at least half of it: the rest may be a delay that ended
            ahead = offset[number] - nearest > max(self._limit_ns, size[number]) // 2
            if size[number] < 0 or (size[number] and ahead):
                out.append(ClockStep(int(before[1][1, number]), int(size[number])))
                self._quiet = 2 * BESIDE
                self._nearest = nearest + int(size[number]), when
        return out

    def _nearest_so_far(self, before: np.ndarray) -> tuple[int, int]:
        """Return the smallest difference of stamps and reception so far, and the last reception.

        Corrected for steps since then.

        Parameters
        ----------
        before : int array (4,)
            Highest offset, stamp and reception of the next messages, ns, and whether one was sent
            again.
        """
        offset_ns, _, received_ns, _ = before.tolist()
        if self._nearest is not None:
            nearest_ns, when = self._nearest
            offset_ns = max(offset_ns, nearest_ns - max(received_ns - when, 0) // SLEW)
        self._nearest = offset_ns, received_ns
        return self._nearest


def _first_alike(stamps_ns: np.ndarray) -> np.ndarray:
    """Return the first of the messages in a row that share the stamp of each, (n,)."""
    number = np.arange(len(stamps_ns))
    begins = np.r_[True, np.diff(stamps_ns) != 0]
    return np.maximum.accumulate(np.where(begins, number, 0))


def _parted(
    before: Span, between: np.ndarray, after: Span, limit_ns: int
) -> np.ndarray:
    """Return the step of the clock between two spans of messages; 0 if none.

    `between` are the lowest and highest stamp of the group with the step. The centres of the spans
    are compared, and the step must exceed the scatter of both. A reception that stands still, as
    where a converter writes none, tells nothing.
    """
    (low, high), (next_low, next_high) = before, after
    scatter = np.maximum(high[0] - low[0], next_high[0] - next_low[0])
    by = (next_low[0] + next_high[0]) // 2 - (low[0] + high[0]) // 2
    stamps, received = next_low[1] - high[1], next_low[2] - high[2]
    clear = np.abs(by) > np.maximum(limit_ns, 2 * scatter)
    ahead = clear & (by > 0) & (stamps > limit_ns) & (stamps > received + limit_ns)
    # messages sent again at once, as after a lost connection, go back but outrun their reception
    outrun, next_outrun = (
        (highest[1] - lowest[1]) - (highest[2] - lowest[2]) > limit_ns // 2
        for lowest, highest in (before, after)
    )
    sent_again = next_outrun & ~outrun & (next_high[3] > 0)
    goes_back = np.maximum(
        np.maximum(high[1], between[1]) - next_low[1], high[1] - between[0]
    )
    # one late message among others is not enough
    again_there = (goes_back > limit_ns // 2) & (next_low[1] <= high[1])
    back = clear & (by < 0) & again_there & ~sent_again
    # both clocks went back, with the messages otherwise in order
    length = np.maximum(high[2] - low[2], next_high[2] - next_low[2])
    together = (
        (~clear)
        & (stamps < -limit_ns)
        & (received < -limit_ns)
        & (np.minimum(-stamps, -received) > 2 * length)
    )
    moves = np.maximum(high[2], next_high[2]) > np.minimum(low[2], next_low[2])
    return moves * np.where(ahead | back, by, np.where(together, stamps, 0))


def step_lines(
    steps: Mapping[str, Iterable[ClockStep]], timeline: Timeline
) -> list[str]:
    """Return one line for each step: clock, amount, location, consequence.

    Parameters
    ----------
    steps : dict
        Topic -> its steps. Equal steps of two topics are one.
    timeline : Timeline
        Commands of the session.
    """
    remaining = sorted(
        ((step, topic) for topic, mine in steps.items() for step in mine),
        key=lambda item: (item[0].before_ns, item[1]),
    )
    lines = []
    while remaining:
        step, _ = remaining[0]
        alike = [item for item in remaining if _alike(item[0], step)]
        remaining = [item for item in remaining if item not in alike]
        topics = " and ".join(sorted({topic for _, topic in alike}))
        lines.append(_line(topics, step, timeline))
    return lines


def future_lines(topics: Collection[str]) -> list[str]:
    """Return a line for topics with messages refused as stamped in the future, if any."""
    return (
        [
            f"{', '.join(sorted(topics))}: what was stamped more than {MAX_AHEAD_NS // NS_PER_S} s "
            "ahead of its reception was not used; set the clock that stamps it"
        ]
        if topics
        else []
    )


def _alike(step: ClockStep, other: ClockStep) -> bool:
    return (
        abs(step.by_ns - other.by_ns) < 0.1 * abs(other.by_ns)
        and abs(step.before_ns - other.before_ns) < abs(other.by_ns) + 10_000_000_000
    )


def _line(topics: str, step: ClockStep, timeline: Timeline) -> str:
    index = int(timeline.assign(np.array([step.before_ns]))[0])
    view = timeline.intervals[index].view_index if index >= 0 else None
    where = (
        "between views" if view is None else f"in view '{timeline.views[view].name}'"
    )
    way, wrong = ("back", "an earlier") if step.by_ns < 0 else ("ahead", "a later")
    # what was late from the begin on looks alike
    or_late = (
        " (unless messages were that late until then, and nothing is wrong)"
        if step.by_ns > 0
        else ""
    )
    return (
        f"the clock that stamps {topics} stepped {way} by {abs(step.by_ns) * S_PER_NS:.3g} s "
        f"{where}, at {step.before_ns * S_PER_NS:.3f} s: what was stamped since may be missing "
        f"or counted in {wrong} view{or_late}; {REMEDY}, and measure again from that view on"
    )
