# SPDX-License-Identifier: Apache-2.0
"""The session of pose_sequencer: runs, missing nodes, time-outs, redos, other sequencers."""

import math
from collections.abc import Callable
from dataclasses import replace
from operator import ge
from typing import Any

import numpy as np

from selfcal_ros.bagio.messages import from_model, to_model
from selfcal_ros.collection.expected import expected_marks
from selfcal_ros.collection.inputs import Command, Phase, check_command
from selfcal_ros.collection.sequencer import ENDED, Sequencer, State
from selfcal_ros.collection.timeline import begins_run
from selfcal_ros.errors import InputError
from selfcal_ros.model.readings import placing_digest
from selfcal_ros.model.view import View
from selfcal_ros.nodes.sessions.clocks import is_future
from selfcal_ros.nodes.sessions.health import (
    Diagnosis,
    Level,
    Ports,
    Presence,
    StallWatch,
    missing_marks,
)
from selfcal_ros.settings.estimator import read_plan
from selfcal_ros.settings.nodes import SequencerSettings
from selfcal_ros.topics import COMMAND_TOPIC
from selfcal_ros.units import S_PER_NS

PATIENCE_S = 3.0
"""Time without health after which a node, which publishes it each second, is missing."""

SET_BACK_S = 0.1
"""Largest lag of the clock behind the newest command."""


class SequencingSession:
    """Command the views of a plan: stamps, time-outs, other sequencers.

    Parameters
    ----------
    settings : SequencerSettings
        Values of the sequencer's parameters.
    ports : Ports
        Publishes ``command``.
    """

    def __init__(self, settings: SequencerSettings, ports: Ports) -> None:
        self._settings, self._ports = settings, ports
        path = settings.plan
        self.machine = Sequencer(read_plan(path) if path else None)
        self.presence = Presence(ports.now_s, PATIENCE_S)
        self.waiting = settings.auto_start
        self.run_id, self.coverage = "", 0.0
        self.on_end: Callable[[], None] | None = None
        self._own: set[tuple] = set()
        self._fresh = True  # has neither sent nor followed a command
        self._followed_runs = False  # and has not ended, by its last command
        self._deadline, self._confirm_at, self._redos = math.inf, math.inf, 0
        self._commanded_ns = 0
        self._measured: dict[tuple[str, str], dict[int, str]] = {}
        self._stall = StallWatch(settings.stall_time, ports.now_s)
        self._status: Any = None  # newest of the current view
        self._stalled = self._set_back = self._silent = ""
        # another publisher's command was not followed in this run
        self._strayed = False
        if self.waiting:
            self.machine.need_plan()

    @property
    def ended(self) -> bool:
        """Whether no plan is running or waiting."""
        return self.machine.state in ENDED and not self.waiting

    @property
    def current(self) -> View | None:
        """The view being placed or measured."""
        busy = self.machine.state in (State.PLACING, State.MEASURING)
        return self.machine.need_plan().views[self.machine.index] if busy else None

    @property
    def _view_name(self) -> str:
        return "" if self.current is None else self.current.name

    def missing(self) -> list[str]:
        """Return the missing nodes needed for a run."""
        if not self._settings.start_checks:
            return []
        collector = self.presence.of("measurement_collector")
        missing_nodes = []
        if collector is None:
            missing_nodes.append("measurement_collector (no sign of life)")
        else:
            if collector.values.get("encoder_heard") != "yes":
                missing_nodes.append(
                    "the encoder (measurement_collector hears no sample)"
                )
            if collector.values.get("detections_matched") != "yes":
                missing_nodes.append("a publisher of stage/mark_detections")
        if self.presence.of("solver") is None:
            missing_nodes.append("solver (no sign of life)")
        return missing_nodes

    def begin(self) -> str:
        """Start the plan, or resume its run; wait for missing nodes and name them."""
        if self.machine.state not in ENDED:
            raise InputError(
                "pose_sequencer",
                f"cannot start while {self.machine.state}",
                "abort the plan first",
            )
        self.machine.need_plan()
        missing = self.missing()
        self.waiting = bool(missing)
        if missing:
            answer = f"waiting for {', '.join(missing)}; starts automatically when they are present"
        else:
            answer = self._resume() or self._start()
        self._ports.say(Level.WARN if missing else Level.OK, answer)
        return answer

    def _start(self) -> str:
        self.run_id = ""
        return self.act(self.machine.start)

    def _resume(self) -> str:
        """Resume an unfinished run of this plan where the collector is; "" if there is none."""
        collector = self.presence.of("measurement_collector")
        plan = self.machine.need_plan()
        if not (self._settings.resume and self._fresh and collector):
            return ""
        health = collector.values
        phase = collector.values.get("phase", "")
        index, stamp_ns = collector.number("view"), collector.number("command_stamp")
        if (
            health.get("plan_id") != plan.plan_id
            or not health.get("run_id")
            or phase not in ("PLACE", "MEASURE")
            or index is None
            or index >= len(plan.views)
            or health.get("view_name") != plan.views[index].name
            or stamp_ns is None
            or is_future(stamp_ns, self._ports.now_ns())
        ):
            return ""
        if health.get("placing") not in (
            None,
            placing_digest(plan.artifact, plan.views[index]),
        ):
            return ""  # the plan has been edited: the readings are of another one
        self.run_id = health["run_id"]
        command = self.machine.resume(index, Phase[phase])
        self._send([command], stamp_ns=stamp_ns)  # unchanged: it is latched again
        view_names = self._measured.get((plan.plan_id, self.run_id), {})
        names = ", ".join(view_names[number] for number in sorted(view_names))
        return (
            f"resumed run {self.run_id} in view '{plan.views[index].name}', {phase}"
            + (f"; already measured: {names}" if names else "")
        )

    def act(self, request: Callable[[], list[Command]]) -> str:
        """Pass a request to the state machine and report the result."""
        self._send(request())
        plan, state, index = self.machine.plan, self.machine.state, self.machine.index
        if plan is None or state is State.IDLE or index >= len(plan.views):
            return str(state)
        return (
            f"{state}: view {index + 1} of {len(plan.views)} '{plan.views[index].name}'"
        )

    def skip(self) -> str:
        """Continue with the next view, and say which one is left as it is."""
        answer = self.act(self.machine.skip)
        return f"{answer}; view '{self.machine.skipped[-1]}' is left as it is"

    def give_up(self) -> str:
        """Abort the running plan, or stop waiting for missing nodes."""
        if self.waiting:
            self.waiting = False
            self._end()
            return f"{self.machine.state}: no longer waiting"
        goes_on = self.machine.state is State.FOLLOWING and self._followed_runs
        answer = self.act(self.machine.abort)
        if goes_on:
            answer += (
                "; what it followed is another node's run, and goes on: abort it there"
            )
        return answer

    def take_measurement(self, message: Any) -> None:
        """Record a view of this plan that has been completed."""
        plan = self.machine.plan
        if (
            plan is None
            or message.plan_id != plan.plan_id
            or (to_model.artifact_of(message) != plan.artifact)
        ):
            return
        view = to_model.view_of(
            message, repeats=message.repeats, grid=message.grid, angular=message.angular
        )
        n_read = [
            np.count_nonzero(np.asarray(counts) >= message.repeats)
            for counts in (message.count, message.count_theta)
        ]
        views = self._measured.setdefault((message.plan_id, message.run_id), {})
        if all(map(ge, n_read, expected_marks(plan.artifact, view))):
            views[message.view_index] = message.view_name
        else:
            views.pop(message.view_index, None)

    def take_command(self, message: Any) -> None:
        """Follow another publisher's command."""
        command = to_model.command(message)
        if _key(command) in self._own:
            return
        check_command(command)
        if is_future(command.stamp_ns, self._ports.now_ns()):
            raise InputError(
                COMMAND_TOPIC,
                "stamped in the future of this node's clock: not followed",
                "set the clock that stamps it",
            )
        if self.current is not None and not (
            begins_run(command) and command.stamp_ns > self._commanded_ns
        ):
            if not self._strayed:
                self._ports.say(
                    Level.WARN,
                    "another publisher sends view commands that begin no run later "
                    "than this one: not followed; find who sends them",
                )
            self._strayed = True
            return
        warning = (
            "another publisher sends view commands: following them; abort ends that"
        )
        if self.machine.state in ENDED:
            self._ports.say(Level.OK, warning)
        elif self.machine.state is not State.FOLLOWING:  # its own plan ends here
            self._ports.say(Level.WARN, warning)
        self.machine.foreign_command()
        self._followed_runs = command.phase in (Phase.PLACE, Phase.MEASURE)
        self.waiting = self._fresh = False
        self._end()

    def take_status(self, message: Any) -> None:
        """Record the progress of the view; continue when it is complete."""
        if to_model.stamp_ns(message) < self._commanded_ns:
            return  # from before the command: a redone view would look complete
        if message.run_id != self.run_id:
            return  # of another run
        expected = (
            message.grid_expected + message.angular_expected + message.check_expected
        )
        if message.view_index == self.machine.index and expected:
            n_measured = message.grid_done + message.angular_done + message.check_done
            self.coverage = n_measured / expected
            self._status = message
            self._stall.take(message.detections_used + message.detections_rejected)
        moved_on = self.machine.status(
            message.plan_id, message.view_index, message.complete
        )
        self._redos = 0 if moved_on else self._redos
        self._send(moved_on)

    def tick(self) -> None:
        """Perform due work."""
        now = self._ports.now_s()
        if self.waiting and not self.missing():
            self.begin()
        if (
            self.machine.state is State.PLACING
            and self._settings.auto_confirm
            and now >= self._confirm_at
        ):
            self._send(self.machine.confirm())
        self._tell_set_back()
        self._tell_silent()
        if self.machine.state is State.MEASURING:
            self._tell_stall()
            if self._settings.view_timeout > 0 and now >= self._deadline:
                self._time_out()

    def _tell_set_back(self) -> None:
        """Report once that the clock is behind the last command: new commands would precede it."""
        behind_s = (self._commanded_ns - self._ports.now_ns()) * S_PER_NS
        if self.current is None or behind_s <= SET_BACK_S:
            self._set_back = ""
        elif not self._set_back:
            self._set_back = (
                f"this machine's clock is {behind_s:.3g} s behind its own last "
                "command: it was set back, and what is detected until it has caught up "
                "counts in an earlier view; wait, then redo_view"
            )
            self._ports.say(Level.WARN, self._set_back)

    def _tell_silent(self) -> None:
        """Report once that a companion is silent while a plan is running."""
        nodes = " and ".join(self.presence.silent()) if self.current is not None else ""
        line = nodes and (
            f"no sign of life from {nodes} for {PATIENCE_S:g} s: it hangs or has "
            "ended; wait for it, or start it again: what was measured is kept"
        )
        if line and line != self._silent:
            self._ports.say(Level.WARN, line)
        self._silent = line

    def _tell_stall(self) -> None:
        if not self._stall.stalled:
            self._stalled = ""
        elif not self._stalled:
            self._stalled = self._stall_line()
            self._ports.say(Level.WARN, self._stalled)

    def _stall_line(self) -> str:
        status, name = self._status, self._view_name
        if status is None or not status.detections_used + status.detections_rejected:
            line = f"view '{name}' stalls: no detection has arrived since MEASURE"
        else:
            missing = (
                missing_marks(status) or "nothing, but it is not reported complete"
            )
            line = (
                f"view '{name}' stalls with {100 * self.coverage:.1f} % of its marks complete: "
                f"missing {missing}"
            )
        collector = self.presence.of("measurement_collector")
        if collector is None:
            return line + "; measurement_collector gives no sign of life"
        return line + (
            f"; measurement_collector: {collector.message}"
            if collector.level
            else "; redo_view measures it again, skip_view continues without it"
        )

    def _time_out(self) -> None:
        self._ports.say(Level.WARN, f"view {self._view_name} is not complete in time")
        redoes = self._redos < self._settings.max_redos
        self._redos = self._redos + 1 if redoes else 0
        self._send(self.machine.redo() if redoes else self.machine.skip())

    def diagnosis(self) -> Diagnosis:
        """Return the diagnosis of the node."""
        state = str(self.machine.state)
        level = Level.OK
        if self.waiting:
            state = f"waiting for {', '.join(self.missing())}"
            level = Level.WARN
        elif self.machine.state is State.MEASURING and self._stalled:
            state, level = self._stalled, Level.WARN
        for line in filter(None, (self._silent, self._set_back)):
            state = f"{line}; {state}"
            level = Level.WARN
        plan = self.machine.plan
        view = self.current
        return Diagnosis(
            level,
            state,
            {
                "state": self.machine.state.name,
                "plan_id": plan.plan_id if plan else "",
                "run_id": self.run_id,
                "view": self.machine.index,
                "view_name": view.name if view else "",
                "views": len(plan.views) if plan else 0,
                "coverage": f"{self.coverage:.3f}",
            },
        )

    def _send(self, commands: list[Command], stamp_ns: int = 0) -> None:
        for command in commands:
            now_ns = self._ports.now_ns()
            if not self.run_id and is_future(self._commanded_ns, now_ns):
                # the clock was set back: a new run uses its time
                self._commanded_ns = 0
            stamp = stamp_ns or max(now_ns, self._commanded_ns + 1)
            self._strayed &= bool(self.run_id)
            self.run_id = self.run_id or str(stamp)
            command = replace(command, stamp_ns=stamp, run_id=self.run_id)
            self._own.add(_key(command))
            self._commanded_ns, self._fresh = stamp, False
            self._ports.publish(
                "command", from_model.command(command, self._settings.frame_id)
            )
            name = command.view.name if command.view else command.plan_id
            self._ports.say(Level.OK, f"{command.phase.name} {name}")
            self.coverage, self._status, self._stalled = 0.0, None, ""
            self._stall.restart()
            self._confirm_at = self._ports.now_s() + self._settings.settle_time
            self._deadline = self._ports.now_s() + self._settings.view_timeout
        if self.machine.state in ENDED:
            self._end()

    def _end(self) -> None:
        if self.on_end is not None:
            self.on_end()


def _key(command: Command) -> tuple:
    return (command.stamp_ns, int(command.phase), command.plan_id, command.view_index)
