# SPDX-License-Identifier: Apache-2.0
"""Runs of a plan: which readings belong together, and which run is the newer one."""

from dataclasses import dataclass

from selfcal_ros.collection.inputs import MAX_AHEAD_NS, Command, begun_ns
from selfcal_ros.collection.timeline import begins_run
from selfcal_ros.units import NS_PER_S, S_PER_NS


@dataclass(frozen=True)
class Run:
    """One run of a plan; `run_id` is the stamp of its first command, ns, as text.

    `run_id` is empty where a publisher or a recording does not tell it.
    """

    plan_id: str = ""
    run_id: str = ""


def supersedes(new: Run, current: Run) -> bool:
    """Return whether what belongs to `new` takes the place of what belongs to `current`.

    The later run does. Where one of them does not tell its beginning, the one that came last.
    """
    begun, before = begun_ns(new.run_id), begun_ns(current.run_id)
    return begun is None or before is None or begun > before


def is_future(stamp_ns: int, now_ns: int) -> bool:
    """Return whether a stamp lies further ahead of a node's clock than is believed.

    A clock that stands at 0 is that of a /clock which nobody publishes: it tells nothing.
    """
    return now_ns > 0 and stamp_ns > now_ns + MAX_AHEAD_NS


def begins_in_future(run: Run, now_ns: int) -> bool:
    """Return whether a run has a beginning that a node's clock has not come near."""
    return is_future(begun_ns(run.run_id) or 0, now_ns)


class RunWatch:
    """Finds what keeps a run from being shown: its stamps, a clock that was set back, strays."""

    def __init__(self) -> None:
        self._hidden: Command | None = None

    def command(self, command: Command, newest: Command | None, now_ns: int) -> None:
        """Take a command as it comes; one of long ago, as a recorded one, hides nothing."""
        if newest is None or _run_of(command) == _run_of(newest):
            self._hidden = None
        elif begins_run(command) and abs(command.stamp_ns - now_ns) <= MAX_AHEAD_NS and (
                command.stamp_ns < newest.stamp_ns):
            self._hidden = command

    def lines(self, newest: Command | None, strays: tuple[Command, ...],
              now_ns: int) -> list[str]:
        """Return what is wrong and the way out, one line each."""
        found = []
        if newest is not None and is_future(newest.stamp_ns, now_ns):
            found.append(
                f"the newest view command is stamped {(newest.stamp_ns - now_ns) * S_PER_NS:.0f} s "
                "ahead of this machine's clock, which was set back: no later run is shown; restart "
                "measurement_collector, which leaves such a run aside, and start the plan again")
        elif newest is not None and 0 < now_ns < newest.stamp_ns - NS_PER_S:
            found.append(
                f"the newest view command is stamped {(newest.stamp_ns - now_ns) * S_PER_NS:.1f} s "
                "ahead of this machine's clock: detections until then count before it; synchronise "
                "the clocks")
        if self._hidden is not None and newest is not None:
            behind = (newest.stamp_ns - self._hidden.stamp_ns) * S_PER_NS
            found.append(
                f"run {self._hidden.run_id} is not shown: it began {behind:.3g} s before the last "
                f"view command of run {newest.run_id}, by its stamps; abort it, synchronise the "
                "clocks, and start it again")
        if strays:
            found.append(
                f"{len(strays)} view command{'s' * (len(strays) > 1)} of plan "
                f"'{strays[-1].plan_id}' came within a run that goes on, of no run that has begun, "
                "and changed nothing: find who published them")
        return found


def _run_of(command: Command) -> Run:
    return Run(command.plan_id, command.run_id)
