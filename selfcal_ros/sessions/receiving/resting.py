# SPDX-License-Identifier: Apache-2.0
"""Which encoder samples a journal keeps: all around what is measured, one a second at rest.

An encoder at 1 kHz writes 15 GB a day, whether anything is measured or not.
"""

from collections import deque

from selfcal_ros.units import NS_PER_S

REACH_NS = 10 * NS_PER_S
"""How long before and behind a command or a detection, by reception, every sample is kept: what
lies around an exposure comes before the command or the detection that tells of it."""
APART_NS = NS_PER_S
"""Time between the samples that are kept at rest, which show the encoder's clock."""

Sample = tuple[bytes, int]
"""Bytes, and the instant of reception, ns."""


class Resting:
    """Holds the newest samples back while nothing is measured."""

    def __init__(self) -> None:
        self._held: deque[Sample] = deque()
        self._until_ns: int | None = None  # all is kept up to here
        self._kept_ns: int | None = None  # the newest that was kept at rest

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
            if self._kept_ns is None or abs(oldest[1] - self._kept_ns) >= APART_NS:
                self._kept_ns = oldest[1]
                kept.append(oldest)
        return kept
