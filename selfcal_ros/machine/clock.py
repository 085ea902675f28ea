# SPDX-License-Identifier: Apache-2.0
"""The clock that stamps a machine's readings, and waits."""

import time


class Clock:
    """The system's time, read once: later steps of the system's clock do not reach the stamps."""

    def __init__(self) -> None:
        self._epoch_ns = time.time_ns() - time.monotonic_ns()

    def now_ns(self) -> int:
        """Return the time, ns since 1970."""
        return self._epoch_ns + time.monotonic_ns()

    def sleep(self, seconds: float) -> None:
        """Wait."""
        time.sleep(seconds)
