# SPDX-License-Identifier: Apache-2.0
"""Where the stage was at each exposure, whether it rested, and from where it had come.

Each instant of exposure is looked up once the samples beside it have come, and again only if a
sample or an exposure comes that could change what was found: late ones cost, new ones do not.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from selfcal_ros.collection.reasons import Reason, reason_where
from selfcal_ros.collection.stage.encoder import (
    EVER,
    LOOK_BACK_NS,
    NEVER,
    JointTrack,
    Series,
    filled,
)
from selfcal_ros.collection.stage.growing import GrowingTable
from selfcal_ros.collection.stage.samples import NO_STAMPS

REASONS = np.array([None, Reason.NO_ENCODER, Reason.MOVING, Reason.CONTRADICTION], dtype=object)
"""Reasons that the encoder gives, by the code that is kept of them."""
MOST_SAMPLES = 300_000
"""Samples of a joint that are looked at together."""
ROW = np.dtype([
    ("stamp", "i8"), ("position", "f8", 3), ("reason", "i1", 3), ("moving", "?", 3),
    ("approach", "i1", 2), ("first", "i8", 3), ("last", "i8", 3)])
"""One instant: what is known of x, y, theta, and between which stamps samples of each decide it."""


@dataclass(frozen=True)
class Tracks:
    """Encoder samples of the three joints."""

    x: JointTrack
    y: JointTrack
    theta: JointTrack

    def __iter__(self) -> Iterator[JointTrack]:
        """Yield the joints in their order."""
        return iter((self.x, self.y, self.theta))


@dataclass(frozen=True)
class JointAt:
    """One joint at each exposure: arrays (Q,).

    Attributes
    ----------
    position : float array
        Indicated position, m or rad; NaN where there is none.
    reason : object array
        Why the position cannot be used; None where it can.
    moving : object array
        `Reason.MOVING` where the joint is known to move, for readings that do not need it.
    """

    position: np.ndarray
    reason: np.ndarray
    moving: np.ndarray


@dataclass(frozen=True)
class StageAt:
    """The stage at instants of exposure; `approach` (2, Q) are signs of the last motions."""

    x: JointAt
    y: JointAt
    theta: JointAt
    approach: np.ndarray


class Exposures:
    """The stage at all instants of exposure of a session.

    Parameters
    ----------
    tracks : Tracks
        Encoder samples; they may grow.
    approach_threshold_m : float
        Smallest displacement that counts as a motion of x or y.
    """

    def __init__(self, tracks: Tracks, *, approach_threshold_m: float) -> None:
        self._tracks, self._threshold_m = tracks, approach_threshold_m
        self._table = GrowingTable(ROW)
        self._approach = np.zeros((2, 0), dtype=np.int8)

    def __len__(self) -> int:
        """Return the number of instants."""
        return len(self._table)

    def at(self, stamps_ns: np.ndarray) -> StageAt:
        """Return the stage at some of the instants, in the order that is asked for."""
        index = _as_slice(np.searchsorted(self._table.rows["stamp"], stamps_ns))
        rows = self._table.rows[index]
        x, y, theta = (JointAt(rows["position"][:, j], REASONS[rows["reason"][:, j]],
                               reason_where(rows["moving"][:, j], Reason.MOVING))
                       for j in range(3))
        return StageAt(x, y, theta, self._approach[:, index])

    def update(self, stamps_ns: np.ndarray) -> np.ndarray:
        """Take further instants of exposure and what came of the encoder since the last time.

        Parameters
        ----------
        stamps_ns : int64 array (n,)
            Instants in any order, known ones among them or not.

        Returns
        -------
        int64 array (c,)
            Instants, known before, of which something else is known now.
        """
        due = self._due_to_samples()
        if not (stamps_ns[1:] > stamps_ns[:-1]).all():
            stamps_ns = np.unique(stamps_ns)
        due = self._insert(stamps_ns, due)
        known = due & (self._approach != NEW).all(axis=0)
        before = self._table.rows[known]
        for group in self._groups(np.flatnonzero(due)):
            self._look_up(group)
        changed = np.zeros(len(due), dtype=bool)
        changed[known] = _differ(before, self._table.rows[known])
        return self._fill(due, changed)

    def _due_to_samples(self) -> np.ndarray:
        """Return which instants may depend on samples that came since the last time."""
        rows = self._table.rows
        due = np.zeros(len(rows), dtype=bool)
        for joint, track in enumerate(self._tracks):  # one without samples waits for its own
            new = track.store.new_stamps()
            first, last = rows["first"][:, joint], rows["last"][:, joint]
            if len(new) and len(rows):
                near = np.flatnonzero((last >= new[0]) & (first <= new[-1]))
                due[near] |= (np.searchsorted(new, first[near], "left")
                              < np.searchsorted(new, last[near], "right"))
        return due

    def _insert(self, stamps_ns: np.ndarray, due: np.ndarray) -> np.ndarray:
        """Add the instants that are new; return `due` with them and with those behind them."""
        known = self._table.rows["stamp"]
        at = np.searchsorted(known, stamps_ns)
        fresh = np.ones(len(stamps_ns), dtype=bool)
        inside = at < len(known)
        fresh[inside] = known[at[inside]] != stamps_ns[inside]
        at, stamps_ns = at[fresh], stamps_ns[fresh]
        behind = at[at < len(known)]
        due[behind] = True  # the time since the exposure before is another one
        rows = np.zeros(len(at), dtype=ROW)
        rows["stamp"] = stamps_ns
        rows["first"], rows["last"] = NEVER, EVER
        self._table.insert(at, rows)
        if not len(behind):  # as a rule, and faster
            self._approach = np.append(self._approach, np.full((2, len(at)), NEW, np.int8), axis=1)
            return np.append(due, np.ones(len(at), dtype=bool))
        self._approach = np.insert(self._approach, at, NEW, axis=1)
        return np.insert(due, at, True)

    def _groups(self, due: np.ndarray) -> list[np.ndarray]:
        """Return the instants that are due in groups with few enough samples each, (n,) each.

        Where halves have as many samples beside them as the whole, as in a session that came
        shuffled from end to end, a group stays whole.
        """
        groups, waiting = [], [(due, np.inf)] if len(due) else []
        while waiting:
            group, before = waiting.pop()
            start, end = self._window(group)
            count = max(track.store.count_between(start, end) for track in self._tracks)
            if len(group) > 1 and MOST_SAMPLES < count < 0.9 * before:
                half = len(group) // 2
                waiting += [(group[half:], count), (group[:half], count)]
            else:
                groups.append(group)
        return groups

    def _since(self, index: np.ndarray) -> np.ndarray:
        """Return from when on a motion before each instant is looked for."""
        stamps = self._table.rows["stamp"]
        earliest = np.maximum(stamps[index], NEVER + LOOK_BACK_NS) - LOOK_BACK_NS
        before = np.where(index > 0, stamps[np.maximum(index - 1, 0)], NEVER)
        return np.maximum(before, earliest)

    def _window(self, group: np.ndarray) -> tuple[int, int]:
        return int(self._since(group[:1])[0]), int(self._table.rows["stamp"][group[-1]])

    def _look_up(self, group: np.ndarray) -> None:
        """Look up a group of instants, all that lie between its ends."""
        start, end = self._window(group)
        index = np.arange(group[0], group[-1] + 1)
        rows, since = self._table.rows[group[0]:group[-1] + 1], self._since(index)
        for joint, track in enumerate(self._tracks):
            series = track.between(start, end)
            position, reason = series.query(rows["stamp"])
            rows["position"][:, joint] = position
            rows["reason"][:, joint] = _codes(reason)
            rows["moving"][:, joint] = series.moving(
                rows["stamp"], reason) == Reason.MOVING
            linear = joint < 2
            if linear:
                rows["approach"][:, joint] = self._approach_of(series, index, position)
            first, last = series.decided_by(rows["stamp"], since if linear else None)
            rows["first"][:, joint], rows["last"][:, joint] = first, last

    def _approach_of(self, series: Series, index: np.ndarray, position: np.ndarray) -> np.ndarray:
        stamps, first = self._table.rows["stamp"], index[0]
        if first == 0:
            return series.approach(stamps[index], position, threshold=self._threshold_m)
        # behind the exposure before, whose own samples may not all be here
        both = np.concatenate([stamps[first - 1:first], stamps[index]])
        return series.approach(both, np.concatenate([[np.nan], position]),
                               threshold=self._threshold_m)[1:]

    def _fill(self, due: np.ndarray, changed: np.ndarray) -> np.ndarray:
        """Work out the directions of approach; return the stamps of what has changed."""
        if not due.any():
            return NO_STAMPS
        start = int(due.argmax())  # what is before the first that was looked up stays as it is
        old = self._approach[:, start:]
        column = self._table.rows["approach"][start:].T
        before = self._approach[:, start - 1:start] if start else np.zeros((2, 1), dtype=np.int8)
        found = np.stack([filled(row)[1:] for row in np.concatenate([before, column], axis=1)])
        changed = changed[start:] | ((found != old) & (old != NEW)).any(axis=0)
        changed &= (old != NEW).all(axis=0)
        self._approach[:, start:] = found
        return self._table.rows["stamp"][start:][changed]


NEW = 9
"""Direction of approach of an instant that has not been looked up yet."""


def _as_slice(index: np.ndarray) -> np.ndarray | slice:
    """Return an index of rows one behind the other as a slice, which copies nothing."""
    if len(index) and (np.diff(index) == 1).all():
        return slice(int(index[0]), int(index[-1]) + 1)
    return index


def _codes(reasons: np.ndarray) -> np.ndarray:
    out = np.zeros(len(reasons), dtype=np.int8)
    told = np.flatnonzero(reasons != None)  # noqa: E711
    for code, reason in enumerate(REASONS[1:], 1):
        out[told[reasons[told] == reason]] = code
    return out


def _differ(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return in which rows positions, reasons or motions are not the same."""
    same = (a["position"] == b["position"]) | (np.isnan(a["position"]) & np.isnan(b["position"]))
    same &= (a["reason"] == b["reason"]) & (a["moving"] == b["moving"])
    return ~same.all(axis=1)
