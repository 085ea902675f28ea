# SPDX-License-Identifier: Apache-2.0
"""Stage position at the instant of exposure, from the encoder samples of one joint.

The result for an exposure depends only on nearby samples: on the `DEPTH` stamps on either
side, on contradictions within half a gap, and, for the direction of approach, on the time
since the previous exposure. So it is final once these samples have been received.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from selfcal_ros.collection.inputs import Reason
from selfcal_ros.collection.samples import Limits, Samples, SampleStore
from selfcal_ros.units import NS_PER_S

BEYOND_NOISE = 6.0
"""Standard deviations by which two samples must differ to show that a joint has moved."""
NEAR = 16
"""Samples on either side of an exposure for the noise of a joint at rest."""
DEPTH = 2 * NEAR + 4
"""Stamps on either side of an exposure on which its result depends: if one side has too few samples
for the noise, more are taken from the other."""
MOST_NOISE_M = 1e-4
"""Largest plausible noise, m: above, the samples around the exposure are too few, and most of
them are of a moving stage."""
LOOK_BACK_NS = 60_000_000_000
"""Time before an exposure in which a motion is searched for."""
NEVER, EVER = np.iinfo(np.int64).min, np.iinfo(np.int64).max
GOOD, NO_ENCODER, MOVING, CONTRADICTION = range(4)
"""Codes of the result for an exposure, with an eighth of the memory of reasons."""
REASONS = np.array(
    [None, Reason.NO_ENCODER, Reason.MOVING, Reason.CONTRADICTION], dtype=object
)
"""The reasons for the codes; None if the position is good."""
AS_BEFORE = 2
"""Code for a direction of approach as at the previous exposure: no motion in between."""


@dataclass(frozen=True)
class TrackLimits:
    """Limits for valid positions: gap in ns, speed per s, agreement of equal stamps."""

    max_gap_ns: int
    max_speed: float
    agreement: float
    wraps: bool = False


class JointTrack:
    """Samples of one joint, in any order of arrival; queries depend on the set alone."""

    def __init__(self, limits: TrackLimits, store: Limits | None = None) -> None:
        self.limits = limits
        self.store = SampleStore(store)

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self.store)

    def between(self, start_ns: int, end_ns: int) -> "JointSamples":
        """Return the samples relevant to exposures from `start_ns` to `end_ns`."""
        half_gap = self.limits.max_gap_ns // 2
        return JointSamples(
            self.limits,
            self.store.near(
                max(start_ns, NEVER + half_gap) - half_gap,
                min(end_ns, EVER - half_gap) + half_gap,
                DEPTH + 2,
            ),
        )

    def usual_step_s(self) -> float:
        """Return the median time between the last samples, NaN with fewer than two."""
        span = self.store.span()
        if span is None:
            return float("nan")
        t = np.unique(self.store.near(span[1], span[1], 1000)[0])
        return float(np.median(np.diff(t)) / NS_PER_S) if len(t) > 1 else float("nan")


def filled(approach: np.ndarray) -> np.ndarray:
    """Return directions of approach with `AS_BEFORE` replaced; unknown before the first."""
    source = np.where(approach == AS_BEFORE, 0, np.arange(len(approach)))
    out = approach[np.maximum.accumulate(source)] if len(approach) else approach
    return np.where(out == AS_BEFORE, 0, out).astype(np.int8)


class JointSamples:
    """Samples of one joint in the order of their stamps, each stamp once."""

    def __init__(self, limits: TrackLimits, samples: Samples) -> None:
        self.limits = limits
        stamps, positions, speeds = samples
        if (stamps[1:] > stamps[:-1]).all():  # usual case: nothing to compare
            self.t, self.p, self.speed, self.v = (
                stamps,
                positions,
                speeds,
                np.abs(speeds),
            )
            self.bad = np.zeros(len(stamps), dtype=bool)
            return
        order = np.lexsort((positions, stamps))
        stamps, positions, speeds = stamps[order], positions[order], speeds[order]
        first = np.flatnonzero(np.diff(stamps, prepend=NEVER))
        # from the first of each stamp to all of them: on a circle the last may be nearer
        first_positions = np.repeat(
            positions[first], np.diff(first, append=len(stamps))
        )
        spread = np.abs(self._difference(positions - first_positions))
        self.t, self.p = stamps[first], positions[first]
        self.bad = (
            np.maximum.reduceat(spread, first) if len(first) else spread
        ) > limits.agreement
        self.speed = _fastest(speeds, first)  # with its sign
        self.v = np.abs(self.speed)

    def __len__(self) -> int:
        """Return the number of stamps."""
        return len(self.t)

    def decided_by(
        self, stamps_ns: np.ndarray, since_ns: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the first and last stamps on which the result for each exposure depends.

        Parameters
        ----------
        stamps_ns : int64 array (Q,)
            Instants of exposure.
        since_ns : int64 array (Q,), optional
            Instants from which a motion before each is searched for.
        """
        half_gap = self.limits.max_gap_ns // 2
        low = np.searchsorted(self.t, stamps_ns, "left") - DEPTH
        high = np.searchsorted(self.t, stamps_ns, "right") + DEPTH - 1
        first, last = np.full(len(stamps_ns), NEVER), np.full(len(stamps_ns), EVER)
        enough = low >= 0
        first[enough] = np.minimum(self.t[low[enough]], stamps_ns[enough] - half_gap)
        enough = high < len(self.t)
        last[enough] = np.maximum(self.t[high[enough]], stamps_ns[enough] + half_gap)
        if since_ns is not None and len(self):
            at = np.searchsorted(self.t, since_ns, "right") - 1
            first = np.where(at >= 0, np.minimum(first, self.t[at]), NEVER)
        return first, last

    def _difference(self, a: np.ndarray) -> np.ndarray:
        return np.remainder(a + np.pi, 2 * np.pi) - np.pi if self.limits.wraps else a

    def query(self, stamps_ns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the interpolated positions and whether each can be used.

        Parameters
        ----------
        stamps_ns : int64 array (Q,)
            Instants of exposure.

        Returns
        -------
        positions : float array (Q,)
            m or rad; NaN if none.
        codes : int8 array (Q,)
            `GOOD`, `NO_ENCODER`, `MOVING` or `CONTRADICTION`.
        """
        codes = np.zeros(len(stamps_ns), dtype=np.int8)
        if not len(self) or not len(stamps_ns):
            codes[:] = NO_ENCODER
            return np.full(len(stamps_ns), np.nan), codes
        t, p = self.t, self.p
        before, after, exact, outside = self._around(stamps_ns)
        gap = t[after] - t[before]
        step = self._difference(p[after] - p[before])
        weight = (stamps_ns - t[before]) / np.where(gap > 0, gap, 1)
        moving, reversing = self._motion(before, after, exact)
        codes[moving] = MOVING
        codes[reversing | self._contradicted(stamps_ns, before, after)] = CONTRADICTION
        codes[outside] = NO_ENCODER
        return np.where(outside, np.nan, p[before] + step * weight), codes

    def moving(self, stamps_ns: np.ndarray, codes: np.ndarray) -> np.ndarray:
        """Return where this joint is known to move, bool array (Q,); `codes` are those of `query`.

        For joints that a reading does not need: without nearby samples, or with contradictory ones,
        motion is unknown; and displacements within noise are not motion.
        """
        fast = codes == MOVING
        if fast.any():
            t, p, v = self.t, self.p, self.v
            before, after, exact, _ = self._around(stamps_ns)
            # at a sample: the larger distance to one of its neighbours
            left = np.where(exact, np.maximum(before - 1, 0), before)
            right = np.where(exact, np.minimum(after + 1, len(t) - 1), after)
            way = np.fmax(
                np.abs(self._difference(p[right] - p[after])),
                np.abs(self._difference(p[after] - p[left])),
            )
            noise = self._noise_near(stamps_ns)
            speed_noise = self._speed_noise_near(stamps_ns)
            excess = np.where(
                np.isfinite(v[before]) & np.isfinite(v[after]),
                np.fmax(v[before], v[after]),
                0.0,
            )
            excess = np.where(excess > BEYOND_NOISE * speed_noise, excess, 0.0)
            excess *= (t[right] - t[left]) / NS_PER_S
            fast &= np.fmax(way, excess) > BEYOND_NOISE * np.sqrt(2) * noise
        return fast

    def approach(
        self, stamps_ns: np.ndarray, positions: np.ndarray, *, threshold: float
    ) -> np.ndarray:
        """Return the sign of the last motion before each exposure, int8 array (Q,).

        A motion is a displacement beyond `threshold`, m, and beyond the noise at rest. It is
        searched for from the exposure back to the previous one; if there is none, the sign is
        `AS_BEFORE`. It is 0, unknown, after a gap in the samples, if the last exposure is
        more than `LOOK_BACK_NS` ago, and if too few samples are of a stage at rest.

        Parameters
        ----------
        stamps_ns : int64 array (Q,)
            Instants of exposure, rising, each once.
        positions : float array (Q,)
            Positions there, from `query`.
        threshold : float
            Smallest displacement that counts as a motion, m.
        """
        out = np.full(len(stamps_ns), AS_BEFORE, dtype=np.int8)
        if not len(self) or not len(stamps_ns):
            return np.zeros_like(out)
        t, p = self.t, self.p
        # the first exposure at or after a sample
        owner = np.searchsorted(stamps_ns, t, "left")
        sample = np.flatnonzero(owner < len(stamps_ns))
        owner = owner[sample]
        away = np.abs(p[sample] - positions[owner])
        displaced = (away > threshold) & (stamps_ns[owner] - t[sample] <= LOOK_BACK_NS)
        limit = np.full(len(stamps_ns), threshold)
        # the noise is computed only where it matters
        doubtful = np.unique(owner[displaced])
        limit[doubtful] = np.fmax(
            threshold, BEYOND_NOISE * np.sqrt(2) * self._noise_near(stamps_ns[doubtful])
        )
        displaced &= away > limit[owner]
        last = np.full(len(stamps_ns), -1)
        last[owner[displaced]] = sample[displaced]  # the last sample of each owner
        broken = np.diff(t, prepend=t[0]) > self.limits.max_gap_ns
        broken[0] = True
        resumed = np.full(len(stamps_ns), -1)
        resumed[owner[broken[sample]]] = sample[broken[sample]]
        has_motion = (last >= 0) & (last >= resumed)
        out[has_motion] = np.sign(positions[has_motion] - p[last[has_motion]])
        lost = (resumed >= 0) | ~np.isfinite(positions)
        lost |= np.diff(stamps_ns, prepend=stamps_ns[0]) > LOOK_BACK_NS
        lost |= limit > max(MOST_NOISE_M, threshold)
        out[lost & ~has_motion] = 0
        return out

    def _noise_near(self, stamps_ns: np.ndarray) -> np.ndarray:
        """Return the robust standard deviation of one position around each exposure, (Q,).

        From each sample's distance to the line through its neighbours, whose variance is 1.5 times
        as large: motion at a steady speed adds nothing to it.
        """

        def off(t: np.ndarray, p: np.ndarray) -> np.ndarray:
            step = self._difference(np.diff(p))
            dt = np.diff(t)
            return np.abs(
                step[..., :-1] * dt[..., 1:] - step[..., 1:] * dt[..., :-1]
            ) / (dt[..., :-1] + dt[..., 1:])

        return self._median_near(off, (self.t, self.p), stamps_ns) / np.sqrt(1.5)

    def _speed_noise_near(self, stamps_ns: np.ndarray) -> np.ndarray:
        """Return the robust standard deviation of one reported speed around each exposure, (Q,).

        From the second differences: a steady speed and a steady acceleration add nothing to it.
        """

        def off(v: np.ndarray) -> np.ndarray:
            return np.abs(np.diff(np.where(np.isfinite(v), v, 0.0), 2))

        return self._median_near(off, (self.speed,), stamps_ns) / np.sqrt(6)

    def _median_near(
        self,
        off: Callable[..., np.ndarray],
        columns: tuple[np.ndarray, ...],
        stamps_ns: np.ndarray,
    ) -> np.ndarray:
        """Return the robust standard deviation about 0 of values near each exposure.

        `off` converts columns (..., n) of samples to non-negative values (..., n - 2),
        one for each sample but the first and the last.
        """
        if len(self) < 3:
            return np.zeros(len(stamps_ns))
        width = min(2 * NEAR, len(self) - 2)
        start = np.clip(
            np.searchsorted(self.t, stamps_ns, "left") - 1 - NEAR,
            0,
            len(self) - 2 - width,
        )
        windows = np.lib.stride_tricks.sliding_window_view
        if len(start) * width < len(self):  # usual case: few exposures, far apart
            near = off(*(windows(column, width + 2)[start] for column in columns))
        else:
            near = windows(off(*columns), width)[start]
        return np.median(near, axis=1) / 0.6744897501960817

    def _around(self, stamps_ns: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return the samples before and after each instant, whether identical, whether too far.

        They are identical if the instant is that sample's stamp.
        """
        t = self.t
        after = np.searchsorted(t, stamps_ns, "left")
        outside = after >= len(t)
        after = np.minimum(after, len(t) - 1)
        exact = t[after] == stamps_ns
        before = np.where(exact, after, after - 1)
        outside |= before < 0
        before = np.maximum(before, 0)
        outside |= t[after] - t[before] > self.limits.max_gap_ns
        return before, after, exact, outside

    def _motion(
        self, before: np.ndarray, after: np.ndarray, exact: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return for which exposures the stage moves, and for which it jumps back and forth."""
        v = self.v
        move_left, fast_left, near_left = self._step_to(before)
        middle, fast, _ = self._step_to(after)
        move_right, fast_right, near_right = self._step_to(after + 1)
        # between two samples: their step; at a sample: the smaller of the adjacent steps
        calm = (near_left & ~fast_left) | (near_right & ~fast_right)
        fast_on_both_sides = ~calm & (near_left | near_right)
        moving = np.where(exact, fast_on_both_sides, fast)
        reported = np.isfinite(v[before]) & np.isfinite(v[after])
        rate = np.fmax(v[before], v[after])
        moving = np.where(reported & exact, rate > self.limits.max_speed, moving)
        moving |= reported & (rate > self.limits.max_speed)
        reversing = (
            fast
            & ~exact
            & (
                (fast_left & (move_left * middle < 0))
                | (fast_right & (move_right * middle < 0))
            )
        )
        reversing |= (
            exact & fast_left & fast_right & (move_left * move_right < 0) & ~reported
        )
        return moving, reversing

    def _step_to(self, number: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the step from the previous sample to each, whether it is fast, whether near.

        There is no step (0, False, False) to the first sample and beyond the last.
        """
        inside = (number > 0) & (number < len(self.t))
        to = np.clip(number, 0, len(self.t) - 1)
        since = np.maximum(to - 1, 0)
        dt = self.t[to] - self.t[since]
        step = np.where(inside, self._difference(self.p[to] - self.p[since]), 0.0)
        speed = np.abs(step) / np.where(dt > 0, dt, 1) * NS_PER_S
        return (
            step,
            inside & (speed > self.limits.max_speed),
            (inside & (dt <= self.limits.max_gap_ns)),
        )

    def _contradicted(
        self, stamps_ns: np.ndarray, before: np.ndarray, after: np.ndarray
    ) -> np.ndarray:
        """Return the exposures next to, or within half a gap of, a contradictory stamp."""
        t, bad = self.t, self.bad
        if not bad.any():
            return np.zeros(len(stamps_ns), dtype=bool)
        at = np.flatnonzero(bad)
        where = t[at]
        index = np.searchsorted(where, stamps_ns)
        window = self.limits.max_gap_ns // 2
        out = np.zeros(len(stamps_ns), dtype=bool)
        for side in (index - 1, index):
            inside = (side >= 0) & (side < len(at))
            chosen = np.clip(side, 0, len(at) - 1)
            near = np.abs(where[chosen] - stamps_ns) <= window
            adjacent = (at[chosen] >= before - 1) & (at[chosen] <= after + 1)
            out |= inside & (near | adjacent)
        return out


def _fastest(speeds: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Return the speed of largest magnitude of each stamp, whose speeds begin at `first`."""
    if not len(first):
        return speeds
    most, least = np.fmax.reduceat(speeds, first), np.fmin.reduceat(speeds, first)
    return np.where(most >= -least, most, least)
