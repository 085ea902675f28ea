# SPDX-License-Identifier: Apache-2.0
"""The clock that stamps a machine's readings, and waits."""

import time

from selfcal_ros.units import NS_PER_S


class Clock:
    """The system's time as last read: a later step of its clock does not reach the stamps."""

    def __init__(self) -> None:
        self.read()

    def read(self) -> None:
        """Follow the steps that the system's clock has made."""
        self._epoch_ns = time.time_ns() - time.monotonic_ns()

    def now_ns(self) -> int:
        """Return the time, ns since 1970."""
        return self._epoch_ns + time.monotonic_ns()

    def sleep(self, seconds: float) -> None:
        """Wait."""
        time.sleep(seconds)


class SimulatedClock(Clock):
    """A clock on which a wait takes no time; every look at it takes a microsecond.

    Attributes
    ----------
    ns : int
        Its time, ns since 1970.
    """

    def __init__(self, ns: int = 0) -> None:
        self.ns = ns

    def read(self) -> None:
        """Follow nothing."""

    def now_ns(self) -> int:
        """Return the time, ns since 1970."""
        self.ns += 1000
        return self.ns

    def sleep(self, seconds: float) -> None:
        """Let the time pass."""
        self.ns += round(seconds * NS_PER_S)
