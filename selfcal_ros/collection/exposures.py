# SPDX-License-Identifier: Apache-2.0
"""Position of the stage at each exposure, whether it was at rest, and direction of approach.

Each instant of exposure is looked up once the samples around it have been received, and again only
if a later sample or exposure could change the result.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from selfcal_ros.collection import encoder
from selfcal_ros.collection.samples import NO_STAMPS, GrowingColumns, GrowingTable

MOST_SAMPLES = 300_000
"""Largest number of samples of a joint processed together."""
FEW = 10
"""Number of exposures whose samples are taken together for other times: a slow stage has many."""
COLUMNS = {"position": "f8", "reason": "i1", "moving": "?", "first": "i8", "last": "i8"}
"""Columns of a joint for each instant: result, and the range of stamps that determines it."""
APPROACH = {"motion": "i1", "approach": "i1"}
"""Columns of a linear joint: the last motion from samples, and with `AS_BEFORE` replaced."""
NEW = 9
"""Direction of approach of an instant that has not been looked up yet."""
N_LINEAR = 2
"""Number of joints with a direction of approach, the first ones."""


@dataclass(frozen=True)
class Tracks:
    """Encoder samples of the three joints."""

    x: encoder.JointTrack
    y: encoder.JointTrack
    theta: encoder.JointTrack

    def __iter__(self) -> Iterator[encoder.JointTrack]:
        """Yield the joints in their order."""
        return iter((self.x, self.y, self.theta))


@dataclass(frozen=True)
class JointAt:
    """One joint at each exposure: arrays (Q,).

    Attributes
    ----------
    position : float array
        Indicated position, m or rad; NaN if none.
    code : int8 array
        Why the position is unusable, see `encoder.REASONS`.
    moving : bool array
        Where the joint is known to move, for readings that do not need it.
    """

    position: np.ndarray
    code: np.ndarray
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
        self._stamps = GrowingTable(np.dtype(np.int64))
        self._joints = [
            GrowingColumns(COLUMNS | (APPROACH if linear else {}))
            for linear in (True, True, False)
        ]

    def __len__(self) -> int:
        """Return the number of instants."""
        return len(self._stamps)

    def at(self, stamps_ns: np.ndarray) -> StageAt:
        """Return the stage at some of the instants, in the given order."""
        index = self._index(stamps_ns)
        x, y, theta = (
            JointAt(
                joint["position"][index], joint["reason"][index], joint["moving"][index]
            )
            for joint in self._joints
        )
        return StageAt(
            x,
            y,
            theta,
            np.stack([joint["approach"][index] for joint in self._joints[:2]]),
        )

    def _index(self, stamps_ns: np.ndarray) -> np.ndarray | slice:
        """Return the indices of some instants; consecutive ones as a slice, to avoid copies."""
        instants = self._stamps.rows
        if len(stamps_ns):
            first = int(np.searchsorted(instants, stamps_ns[0]))
            rows = slice(first, first + len(stamps_ns))
            if np.array_equal(instants[rows], stamps_ns):
                return rows
        return np.searchsorted(instants, stamps_ns)

    def rests(
        self, stamps_ns: np.ndarray, lags_ns: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return where x and y stood at times before stamps, and whether at rest.

        Parameters
        ----------
        stamps_ns : int64 array (Q,)
            Stamps of exposures.
        lags_ns : int64 array (L,)
            Times before them.

        Returns
        -------
        place : complex array (L, Q)
            Indicated position, m; NaN without samples.
        rests : bool array (L, Q)
            Whether it can be used for a reading.
        """
        place = np.zeros((len(lags_ns), len(stamps_ns)), dtype=complex)
        rests = np.zeros(place.shape, dtype=bool)
        for start in range(0, len(stamps_ns), FEW):
            columns = slice(start, start + FEW)
            instants = stamps_ns[columns] - lags_ns[:, None]
            ends = int(instants.min()), int(instants.max())
            (x, x_codes), (y, y_codes) = (
                track.between(*ends).query(instants.ravel())
                for track in (self._tracks.x, self._tracks.y)
            )
            good = (x_codes | y_codes) == encoder.GOOD
            place[:, columns] = (x + 1j * y).reshape(instants.shape)
            rests[:, columns] = good.reshape(instants.shape)
        return place, rests

    def update(self, stamps_ns: np.ndarray) -> np.ndarray:
        """Take further instants of exposure, and the encoder samples since the last call.

        Parameters
        ----------
        stamps_ns : int64 array (n,)
            Instants in any order, including known ones or not.

        Returns
        -------
        int64 array (c,)
            Known instants whose result has changed.
        """
        due = self._due_to_samples()
        if not (stamps_ns[1:] > stamps_ns[:-1]).all():
            stamps_ns = np.unique(stamps_ns)
        due = self._insert(stamps_ns, due)
        looked_up = np.flatnonzero(due & (self._joints[0]["approach"] != NEW))
        before = self._at_instants(looked_up)
        for group in self._groups(np.flatnonzero(due)):
            self._look_up(group)
        changed = np.zeros(len(due), dtype=bool)
        changed[looked_up] = _differ(before, self._at_instants(looked_up))
        return self._fill(due, changed)

    def _due_to_samples(self) -> np.ndarray:
        """Return which instants may depend on samples since the last call."""
        due = np.zeros(len(self), dtype=bool)
        for joint, track in zip(self._joints, self._tracks, strict=True):
            new = track.store.new_stamps()  # a joint without samples waits for its own
            first, last = joint["first"], joint["last"]
            if len(new) and len(due):
                near = np.flatnonzero((last >= new[0]) & (first <= new[-1]))
                due[near] |= np.searchsorted(
                    new, first[near], "left"
                ) < np.searchsorted(new, last[near], "right")
        return due

    def _insert(self, stamps_ns: np.ndarray, due: np.ndarray) -> np.ndarray:
        """Add new instants; return `due` with them and the following ones."""
        instants = self._stamps.rows
        at = np.searchsorted(instants, stamps_ns)
        fresh = np.ones(len(stamps_ns), dtype=bool)
        inside = at < len(instants)
        fresh[inside] = instants[at[inside]] != stamps_ns[inside]
        at, stamps_ns = at[fresh], stamps_ns[fresh]
        behind = at[at < len(instants)]
        due[behind] = True  # the time since the previous exposure has changed
        self._stamps.insert(at, stamps_ns)
        for joint in self._joints:
            joint.insert(
                at, {"first": encoder.NEVER, "last": encoder.EVER, "approach": NEW}
            )
        if not len(behind):  # usual case, faster
            return np.append(due, np.ones(len(at), dtype=bool))
        return np.insert(due, at, True)

    def _at_instants(self, index: np.ndarray) -> list[np.ndarray]:
        """Return positions, reasons and motions of all joints at some of the instants."""
        return [
            joint[name][index]
            for joint in self._joints
            for name in ("position", "reason", "moving")
        ]

    def _groups(self, due: np.ndarray) -> list[np.ndarray]:
        """Return the due instants in groups with a limited number of samples, (n,) each.

        If halves need as many samples as the whole, as in a completely shuffled session, a group
        is not split.
        """
        groups = []
        waiting = [(due, np.inf)] if len(due) else []
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
        """Return the beginning of the search for a motion before each instant."""
        stamps = self._stamps.rows
        look_back = encoder.LOOK_BACK_NS
        earliest = np.maximum(stamps[index], encoder.NEVER + look_back) - look_back
        before = np.where(index > 0, stamps[np.maximum(index - 1, 0)], encoder.NEVER)
        return np.maximum(before, earliest)

    def _window(self, group: np.ndarray) -> tuple[int, int]:
        return int(self._since(group[:1])[0]), int(self._stamps.rows[group[-1]])

    def _look_up(self, group: np.ndarray) -> None:
        """Look up a group of instants, all between its ends."""
        start, end = self._window(group)
        index = np.arange(group[0], group[-1] + 1)
        rows = slice(group[0], group[-1] + 1)
        stamps = self._stamps.rows[rows]
        since = self._since(index)
        for number, (joint, track) in enumerate(
            zip(self._joints, self._tracks, strict=True)
        ):
            series = track.between(start, end)
            position, codes = series.query(stamps)
            joint["position"][rows], joint["reason"][rows] = position, codes
            joint["moving"][rows] = series.moving(stamps, codes)
            linear = number < N_LINEAR
            if linear:
                joint["motion"][rows] = self._motions(series, index, position)
            joint["first"][rows], joint["last"][rows] = series.decided_by(
                stamps, since if linear else None
            )

    def _motions(
        self, series: encoder.JointSamples, index: np.ndarray, position: np.ndarray
    ) -> np.ndarray:
        stamps = self._stamps.rows
        first = index[0]
        if first == 0:
            return series.approach(stamps[index], position, threshold=self._threshold_m)
        # after the previous exposure, whose own samples may be incomplete here
        with_previous = np.concatenate([stamps[first - 1 : first], stamps[index]])
        return series.approach(
            with_previous,
            np.concatenate([[np.nan], position]),
            threshold=self._threshold_m,
        )[1:]

    def _fill(self, due: np.ndarray, changed: np.ndarray) -> np.ndarray:
        """Compute the directions of approach; return the stamps of changes."""
        if not due.any():
            return NO_STAMPS
        start = int(due.argmax())  # nothing changes before the first one looked up
        changed = changed[start:]
        looked_up = np.zeros(0, dtype=bool)
        for joint in self._joints[:N_LINEAR]:
            old = joint["approach"][start:]
            before = (
                joint["approach"][start - 1 : start]
                if start
                else np.zeros(1, dtype=np.int8)
            )
            approach = encoder.filled(
                np.concatenate([before, joint["motion"][start:]])
            )[1:]
            looked_up = old != NEW
            changed |= approach != old
            joint["approach"][start:] = approach
        return self._stamps.rows[start:][changed & looked_up]


def _differ(before: list[np.ndarray], after: list[np.ndarray]) -> np.ndarray:
    """Return the instants with a changed result; NaN equals NaN."""
    return np.array(
        [(a != b) & ((a == a) | (b == b)) for a, b in zip(before, after, strict=True)]
    ).any(axis=0)
