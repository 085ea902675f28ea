# SPDX-License-Identifier: Apache-2.0
"""A view that does not get on: noticed by time, told with the marks that are missing."""

from collections.abc import Callable
from typing import Any

NAMED = 6
"""Missing marks and lines that a line names; the rest is counted."""


class StallWatch:
    """Notices that no detection of the current view has come for a while.

    Parameters
    ----------
    stall_s : float
        Shortest pause that counts; a slow cell gets three times its longest pause so far.
    now_s : callable
        Monotonic seconds.
    """

    def __init__(self, stall_s: float, now_s: Callable[[], float]) -> None:
        self._stall_s, self._now_s = stall_s, now_s
        self.restart()

    def restart(self) -> None:
        """Begin anew: a command has been sent."""
        self._since, self._longest_s = self._now_s(), 0.0
        self._seen: int | None = None

    def take(self, detections: int) -> None:
        """Take the number of detections of the view so far."""
        if detections != self._seen:
            now = self._now_s()
            if self._seen is not None:
                self._longest_s = max(self._longest_s, now - self._since)
            self._seen, self._since = detections, now

    @property
    def stalled(self) -> bool:
        """Whether the pause is longer than that of a slow cell."""
        return self._now_s() - self._since >= max(self._stall_s, 3 * self._longest_s)


def missing_marks(status: Any) -> str:
    """Return the missing marks, lines and check stops of a ViewStatus in words, "" if none."""
    marks = [f"({m}, {n})" for m, n in zip(status.missing_m, status.missing_n, strict=False)]
    grid = status.grid_expected - status.grid_done
    lines = [str(k) for k in status.missing_k]
    angular = status.angular_expected - status.angular_done
    checks = status.check_expected - status.check_done
    parts = [_named(words, count, what) for words, count, what in (
        (marks, grid, "mark"), (lines, angular, "line")) if count > 0]
    parts += [f"check stops of {checks} mark{'s' * (checks != 1)} (see check_marks of the view "
              "command)"] if checks > 0 else []
    return " and ".join(parts)


def _named(words: list[str], count: int, what: str) -> str:
    shown = ", ".join(words[:NAMED])
    rest = count - len(words[:NAMED])
    text = f"{count} {what}{'s' * (count != 1)}"
    if not shown:
        return text
    return f"{text}: {shown}" + (f" and {rest} more" if rest > 0 else "")
