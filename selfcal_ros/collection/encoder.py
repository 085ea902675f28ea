# SPDX-License-Identifier: Apache-2.0
"""The encoder's story: where the stage was at the instant of an exposure."""

from array import array
from dataclasses import dataclass

import numpy as np

from selfcal_ros.collection.reasons import Reason

BEYOND_NOISE = 6.0
"""Standard deviations by which two samples must differ to show that a joint has moved."""
NEAR = 16
"""Samples on either side of an exposure that tell the noise of a joint at rest there."""
LOOK_BACK_NS = 60_000_000_000
"""Time before an exposure in which a motion is looked for."""


@dataclass(frozen=True)
class TrackLimits:
    """When a position can be trusted: gap in ns, speed per s, agreement of equal stamps."""

    max_gap_ns: int
    max_speed: float
    agreement: float
    wraps: bool = False


class JointTrack:
    """Samples of one joint, in whatever order they arrive; queries depend on the set alone."""

    def __init__(self, limits: TrackLimits) -> None:
        self.limits = limits
        self._stamps, self._positions, self._speeds = array("q"), array("d"), array("d")
        self._sorted: tuple[np.ndarray, ...] | None = None
        self._noise: tuple[float, float] | None = None

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self._stamps)

    def add(self, stamp_ns: int, position: float, speed: float) -> None:
        """Add one sample; `speed` is NaN where the encoder does not tell it."""
        self._stamps.append(stamp_ns)
        self._positions.append(position + 0.0)  # -0.0 and 0.0 sort alike: keep one of them
        self._speeds.append(speed)
        self._sorted = self._noise = None

    def span(self) -> tuple[int, int]:
        """Return the first and the last stamp; there must be samples."""
        t = self._series()[0]
        return int(t[0]), int(t[-1])

    def usual_step_s(self) -> float:
        """Return the median time between the last samples, NaN with fewer than two."""
        t = self._series()[0][-1000:] if len(self) else np.zeros(0)
        return float(np.median(np.diff(t)) / 1e9) if len(t) > 1 else float("nan")

    def _difference(self, a: np.ndarray) -> np.ndarray:
        return np.remainder(a + np.pi, 2 * np.pi) - np.pi if self.limits.wraps else a

    def _series(self) -> tuple[np.ndarray, ...]:
        """Return stamps (unique, rising), positions, speeds and which stamps contradict."""
        if self._sorted is None:
            stamps = np.array(self._stamps, dtype=np.int64)
            positions = np.array(self._positions)
            speeds = np.array(self._speeds)
            order = np.lexsort((positions, stamps))
            stamps, positions, speeds = stamps[order], positions[order], speeds[order]
            first = np.flatnonzero(np.diff(stamps, prepend=stamps[:1] - 1))
            # from the first of each stamp to all of it: on a circle the last may lie nearer
            beside = np.repeat(positions[first], np.diff(first, append=len(stamps)))
            spread = np.abs(self._difference(positions - beside))
            bad = np.maximum.reduceat(spread, first) > self.limits.agreement
            speeds = np.fmax.reduceat(np.abs(speeds), first)
            self._sorted = stamps[first], positions[first], speeds, bad
        return self._sorted

    def query(self, stamps_ns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the interpolated positions and the reason why each cannot be used.

        Parameters
        ----------
        stamps_ns : int64 array (Q,)
            Instants of exposure.

        Returns
        -------
        positions : float array (Q,)
            m or rad; NaN where there is none.
        reasons : object array (Q,)
            None where the position is good, else a `Reason`.
        """
        reasons = np.full(len(stamps_ns), None, dtype=object)
        if not len(self) or not len(stamps_ns):
            reasons[:] = Reason.NO_ENCODER
            return np.full(len(stamps_ns), np.nan), reasons
        t, p, _, _ = self._series()
        before, after, exact, outside = self._around(stamps_ns)
        gap = t[after] - t[before]
        step = self._difference(p[after] - p[before])
        weight = (stamps_ns - t[before]) / np.where(gap > 0, gap, 1)
        moving, reversing = self._motion(before, after, exact)
        reasons[moving] = Reason.MOVING
        reasons[reversing | self._contradicted(stamps_ns, before, after)] = Reason.CONTRADICTION
        reasons[outside] = Reason.NO_ENCODER
        return np.where(outside, np.nan, p[before] + step * weight), reasons

    def moving(self, stamps_ns: np.ndarray) -> np.ndarray:
        """Return `Reason.MOVING` where this joint is known to move, else None, object array (Q,).

        For joints that a reading does not need: one that has no samples near, or whose samples
        contradict each other, tells nothing; and what its own noise can do is no motion.
        """
        _, reasons = self.query(stamps_ns)
        fast = reasons == Reason.MOVING
        if fast.any():
            t, p, v, _ = self._series()
            before, after, exact, _ = self._around(stamps_ns)
            # at a sample: the longer way to one of its neighbours
            left = np.where(exact, np.maximum(before - 1, 0), before)
            right = np.where(exact, np.minimum(after + 1, len(t) - 1), after)
            way = np.fmax(np.abs(self._difference(p[right] - p[after])),
                          np.abs(self._difference(p[after] - p[left])))
            noise, speed_noise = self._noise_of_rest()
            told = np.where(np.isfinite(v[before]) & np.isfinite(v[after]),
                            np.fmax(v[before], v[after]), 0.0)
            told = np.where(told > BEYOND_NOISE * speed_noise, told, 0.0)
            told *= (t[right] - t[left]) / 1e9
            fast &= np.fmax(way, told) > BEYOND_NOISE * np.sqrt(2) * noise
        return np.where(fast, Reason.MOVING, None)

    def approach(self, stamps_ns: np.ndarray, positions: np.ndarray, *, threshold: float,
                 ) -> np.ndarray:
        """Return the sign of the last motion before each exposure, int8 array (Q,); 0 = unknown.

        A motion is a displacement beyond `threshold`, m, and beyond the noise at rest. It is
        looked for from the exposure back to the one before; where there is none, the sign is that
        of the exposure before. A gap in the samples and a time of more than `LOOK_BACK_NS` without
        motion since the last exposure leave it unknown.

        Parameters
        ----------
        stamps_ns : int64 array (Q,)
            Instants of exposure, rising, each once.
        positions : float array (Q,)
            Positions there, as `query` returns them.
        threshold : float
            Smallest displacement that counts as a motion, m.
        """
        out = np.zeros(len(stamps_ns), dtype=np.int8)
        if not len(self) or not len(stamps_ns):
            return out
        t, p, _, _ = self._series()
        limit = np.fmax(threshold, BEYOND_NOISE * np.sqrt(2) * self._noise_near(stamps_ns))
        owner = np.searchsorted(stamps_ns, t, "left")  # the first exposure at or after a sample
        sample = np.flatnonzero(owner < len(stamps_ns))
        owner = owner[sample]
        away = p[sample] - positions[owner]
        moved = (np.abs(away) > limit[owner]) & (stamps_ns[owner] - t[sample] <= LOOK_BACK_NS)
        last = np.full(len(stamps_ns), -1)
        last[owner[moved]] = sample[moved]  # of samples with one owner the last stays
        broken = np.diff(t, prepend=t[0]) > self.limits.max_gap_ns
        broken[0] = True
        resumed = np.full(len(stamps_ns), -1)
        resumed[owner[broken[sample]]] = sample[broken[sample]]
        told = (last >= 0) & (last >= resumed)
        out[told] = np.sign(positions[told] - p[last[told]])
        lost = ~told & ((resumed >= 0) | ~np.isfinite(positions))
        lost |= ~told & (np.diff(stamps_ns, prepend=stamps_ns[0]) > LOOK_BACK_NS)
        settled = np.where(told | lost, np.arange(len(out)), 0)
        return out[np.maximum.accumulate(settled)]

    def _noise_near(self, stamps_ns: np.ndarray) -> np.ndarray:
        """Return the standard deviation of one position beside each exposure, robustly, (Q,).

        From each sample's distance to the line through its neighbours, as in `_noise_of_rest`.
        """
        t, p, _, _ = self._series()
        if len(t) < 3:
            return np.zeros(len(stamps_ns))
        step, dt = self._difference(np.diff(p)), np.diff(t)
        off = np.abs(step[:-1] * dt[1:] - step[1:] * dt[:-1]) / (dt[:-1] + dt[1:])
        width = min(2 * NEAR, len(off))
        start = np.clip(np.searchsorted(t, stamps_ns, "left") - 1 - NEAR, 0, len(off) - width)
        near = np.lib.stride_tricks.sliding_window_view(off, width)
        return np.median(near[start], axis=1) / (0.6744897501960817 * np.sqrt(1.5))

    def _noise_of_rest(self) -> tuple[float, float]:
        """Return the standard deviations of one position and of one told speed, robustly.

        That of a position comes from each sample's distance to the line through its neighbours,
        whose variance is 1.5 times as large: motion at a steady speed adds nothing to it.
        """
        if self._noise is None:
            t, p, v, _ = self._series()
            step, dt = self._difference(np.diff(p)), np.diff(t)
            off = (step[:-1] * dt[1:] - step[1:] * dt[:-1]) / (dt[:-1] + dt[1:])
            self._noise = _spread(off / np.sqrt(1.5)), _spread(v[np.isfinite(v)])
        return self._noise

    def _around(self, stamps_ns: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return the samples before and after each instant, where they are one, where too far.

        They are one where the instant is that sample's stamp.
        """
        t = self._series()[0]
        after = np.searchsorted(t, stamps_ns, "left")
        outside = after >= len(t)
        after = np.minimum(after, len(t) - 1)
        exact = t[after] == stamps_ns
        before = np.where(exact, after, after - 1)
        outside |= before < 0
        before = np.maximum(before, 0)
        outside |= t[after] - t[before] > self.limits.max_gap_ns
        return before, after, exact, outside

    def _motion(self, before: np.ndarray, after: np.ndarray, exact: np.ndarray,
                ) -> tuple[np.ndarray, np.ndarray]:
        """Return which exposures saw the stage moving, and which saw it jump to and fro."""
        t, p, v, _ = self._series()
        dt = np.diff(t)
        step = self._difference(np.diff(p))
        speed = np.abs(step) / np.where(dt > 0, dt, 1) * 1e9
        fast = np.concatenate([[False], speed > self.limits.max_speed, [False]])
        move = np.concatenate([[0.0], step, [0.0]])  # move[i]: from sample i-1 to sample i
        near = np.concatenate([[False], dt <= self.limits.max_gap_ns, [False]])
        left, right = before, after + 1
        # between two samples: their segment; at a sample: the calmer of the two beside it
        calm = (near[left] & ~fast[left]) | (near[right] & ~fast[right])
        both = ~calm & (near[left] | near[right])
        moving = np.where(exact, both, fast[after])
        told = np.isfinite(v[before]) & np.isfinite(v[after])
        rate = np.fmax(v[before], v[after])
        moving = np.where(told & exact, rate > self.limits.max_speed, moving)
        moving |= told & (rate > self.limits.max_speed)
        middle = move[after]
        reversing = fast[after] & ~exact & (
            (fast[left] & (move[left] * middle < 0)) | (fast[right] & (move[right] * middle < 0)))
        reversing |= exact & fast[left] & fast[right] & (move[left] * move[right] < 0) & ~told
        return moving, reversing

    def _contradicted(self, stamps_ns: np.ndarray, before: np.ndarray,
                      after: np.ndarray) -> np.ndarray:
        """Return which exposures lie beside, or within half a gap of, a contradicted stamp."""
        t, _, _, bad = self._series()
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
            beside = (at[chosen] >= before - 1) & (at[chosen] <= after + 1)
            out |= inside & (near | beside)
        return out


def _spread(values: np.ndarray) -> float:
    """Return the standard deviation about 0 of values most of which are noise; 0 without any."""
    return float(np.median(np.abs(values)) / 0.6744897501960817) if len(values) else 0.0
