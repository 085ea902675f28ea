# SPDX-License-Identifier: Apache-2.0
"""How the bench times."""

import time

MIN_SECONDS, MAX_REPEATS = 0.5, 30


def median_time(run, once: bool) -> tuple[float, object]:
    """Return the median wall time of `run` and its last result; at least one run."""
    times, start = [], time.perf_counter()
    while True:
        began = time.perf_counter()
        result = run()
        times.append(time.perf_counter() - began)
        if (
            once
            or len(times) == MAX_REPEATS
            or time.perf_counter() - start > MIN_SECONDS
        ):
            return sorted(times)[len(times) // 2], result
