# SPDX-License-Identifier: Apache-2.0
"""Which encoder samples a journal keeps: all around what is measured, some a minute at rest.

An encoder at 1 kHz writes 15 GB a day, whether anything is measured or not.
"""

from collections import deque

from selfcal_ros.collection.encoder import LOOK_BACK_NS
from selfcal_ros.units import NS_PER_S

REACH_NS = LOOK_BACK_NS + 10 * NS_PER_S
"""How long before and behind a command or a detection, by reception, every sample is kept: that far
back from an exposure the direction of approach is looked for, and messages take their time."""
APART_NS, BURST = 60 * NS_PER_S, 50
"""Time between the samples that are kept at rest, and how many of them follow one another: they
show that the encoder was there, how often it told its position, and steps of its clock."""

Sample = tuple[bytes, int]
"""Bytes, and the instant of reception, ns."""


class Resting:
    """Holds the newest samples back while nothing is measured."""

    def __init__(self) -> None:
        self._held: deque[Sample] = deque()
        self._until_ns: int | None = None  # all is kept up to here
        self._burst_ns: int | None = None  # begin of the newest burst that was kept at rest
        self._rest_of_burst = 0

    def wake(self, received_ns: int) -> list[Sample]:
        """Take note of a command or a detection; return what was held back, oldest first."""
        self._until_ns = received_ns + REACH_NS
        return self.end()

    def end(self) -> list[Sample]:
        """Return what is held back, oldest first, and hold it no more."""
        held, self._held = self._held, deque()
        return [*held]

    def sample(self, data: bytes, received_ns: int, *, measuring: bool) -> list[Sample]:
        """Take a sample; return those that are to be kept now, oldest first."""
        if measuring or (self._until_ns is not None and received_ns <= self._until_ns):
            return [*self.end(), (data, received_ns)]
        self._held.append((data, received_ns))
        kept = []
        while abs(received_ns - self._held[0][1]) > REACH_NS:  # a clock may be set back
            oldest = self._held.popleft()
            if self._is_kept(oldest[1]):
                kept.append(oldest)
        return kept

    def _is_kept(self, received_ns: int) -> bool:
        """Return whether a sample is kept that is too old to be of use."""
        if self._burst_ns is None or abs(received_ns - self._burst_ns) >= APART_NS:
            self._burst_ns, self._rest_of_burst = received_ns, BURST
        self._rest_of_burst -= 1
        return self._rest_of_burst >= 0
