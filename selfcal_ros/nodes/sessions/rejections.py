# SPDX-License-Identifier: Apache-2.0
"""Why detections are rejected, reported once it is not merely that other messages are late."""

from collections import Counter
from collections.abc import Callable, Collection, Mapping

from selfcal_ros.collection.diagnosis import RejectionFinding
from selfcal_ros.collection.expected import ViewProgress
from selfcal_ros.collection.inputs import advice
from selfcal_ros.nodes.sessions.health import Level

PATIENCE_S = 6.0
"""Time for which a cause must persist before it is reported. The topics of a cell
are received independently: until the encoder samples around a detection and the commands before it
have come, it is rejected or counted in another view."""

Key = tuple[int | None, str]
"""View, None = all, and reason of rejection."""
OfLast = Callable[[int, Mapping[str, int]], RejectionFinding | None]
"""Return why the last detections of a view, rejected for these reasons, were rejected."""


class RejectionWatch:
    """Report why the detections of a session, or of single views, are rejected, once each.

    Parameters
    ----------
    say : callable (level, line)
        Writes to the log.
    now_s : callable
        Monotonic seconds.
    """

    def __init__(
        self, say: Callable[[Level, str], None], now_s: Callable[[], float]
    ) -> None:
        self._say, self._now_s = say, now_s
        self.restart()

    def restart(self) -> None:
        """Forget everything: another run has begun."""
        self._found: dict[Key, tuple[float, str]] = {}  # since when, and the line now
        self._advised: dict[Key, tuple[float, str]] = {}
        self._said: set[Key] = set()
        self._progress: dict[
            int, tuple[int, Counter[str]]
        ] = {}  # used, and rejected until then

    def take(
        self,
        findings: Mapping[int | None, RejectionFinding],
        progress: Mapping[int, ViewProgress],
        ended: Collection[int],
        of_last: OfLast,
        *,
        final: bool = False,
    ) -> None:
        """Take what is found now.

        Parameters
        ----------
        findings : dict
            View, None = all -> why most of its detections were rejected.
        progress : dict
            view_index -> progress.
        ended : collection of int
            Views that are over: single rejections with a remedy are reported as well.
        of_last : callable (view_index, rejected)
            Returns why the last detections of a view were rejected, none of which was used.
        final : bool
            Whether all messages have come: nothing is waited for.
        """
        where: dict[int | None, str] = {None: ""}
        where.update(
            (index, f"view '{view.view.name}': ") for index, view in progress.items()
        )
        line_of_finding: dict[Key, str] = {
            (index, finding.reason): f"{where[index]}{finding}"
            for index, finding in findings.items()
        }
        for index, rejected in self._since_used(progress, ended).items():
            finding = of_last(index, rejected)
            if (
                finding
                and not {(index, finding.reason), (None, finding.reason)}
                & line_of_finding.keys()
            ):
                line_of_finding[index, finding.reason] = (
                    f"{where[index]}none of the last ones was used: {finding}"
                )
        reported = line_of_finding.keys() | self._said
        advised: dict[Key, str] = {
            (index, reason): where[index] + line
            for index in ended
            for reason, count in progress[index].readings.rejected.items()
            if not {(index, reason), (None, reason)} & reported
            for line in advice({reason: count})
        }
        now = float("-inf") if final else self._now_s()
        self._found = _since(now, self._found, line_of_finding)
        self._advised = _since(now, self._advised, advised)
        self.tell()

    def _since_used(
        self, progress: Mapping[int, ViewProgress], ended: Collection[int]
    ) -> dict[int, Counter[str]]:
        """Return what was rejected of each open view since one of its detections was used.

        Where the marks are read and the lines are not, that need not be most of the view.
        """
        since = {}
        for index in progress.keys() - ended:
            readings = progress[index].readings
            rejected = Counter(readings.rejected)
            if self._progress.get(index, (-1,))[0] != readings.used:
                self._progress[index] = readings.used, rejected
            since[index] = rejected - self._progress[index][1]
        return since

    def tell(self) -> None:
        """Log each cause that has lasted, once."""
        for key, line in (
            self._lasting(self._found) | self._lasting(self._advised)
        ).items():
            if key not in self._said:
                self._said.add(key)
                self._say(Level.WARN, line)

    @property
    def findings(self) -> list[str]:
        """Why most detections are rejected, for the health; without what may be late messages."""
        return list(self._lasting(self._found).values())

    def _lasting(self, lines: Mapping[Key, tuple[float, str]]) -> dict[Key, str]:
        now = self._now_s()
        return {
            key: line
            for key, (since, line) in lines.items()
            if now - since >= PATIENCE_S
        }


def _since(
    now: float, before: Mapping[Key, tuple[float, str]], lines: Mapping[Key, str]
) -> dict[Key, tuple[float, str]]:
    """Return the lines, each with the time since which there has been one for its key."""
    return {
        key: (min(now, before.get(key, (now, ""))[0]), line)
        for key, line in lines.items()
    }
