# SPDX-License-Identifier: Apache-2.0
"""The session of pose_sequencer: time-outs, redos, other publishers of commands, the goal."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from selfcal_ros.collection.messages import Command
from selfcal_ros.collection.sequencer import ENDED, Sequencer, State
from selfcal_ros.files import read_yaml
from selfcal_ros.messages import from_model, to_model
from selfcal_ros.model.view import Plan, View, plan_from_dict
from selfcal_ros.sessions.ports import Diagnosis, Level, Ports


def load_plan(path: str) -> Plan:
    """Return the plan in a PLAN.yaml."""
    return plan_from_dict(read_yaml(path), path)


class SequencingSession:
    """Leads through the views of a plan: stamps the commands, counts the time, yields to others.

    Parameters
    ----------
    values : dict
        Values of the sequencer's parameters.
    ports : Ports
        Publishes ``command``.
    collectors : callable
        Returns how many collectors are seen.
    """

    def __init__(self, values: dict[str, Any], ports: Ports,
                 collectors: Callable[[], int]) -> None:
        self._values, self._ports, self._collectors = values, ports, collectors
        path = values["plan"]
        self.machine = Sequencer(load_plan(path) if path else None)
        self.waiting = values["auto_start"]
        self.coverage = 0.0
        self.on_end: Callable[[], None] | None = None
        self._own: set[tuple] = set()
        self._deadline, self._confirm_at, self._redos = 0.0, 0.0, 0
        self._commanded_ns = 0
        self._measured: dict[str, dict[int, str]] = {}
        if self.waiting:
            self.machine.need_plan()

    @property
    def ended(self) -> bool:
        """Whether no plan runs."""
        return self.machine.state in ENDED

    @property
    def current(self) -> View | None:
        """The view that is being placed or measured."""
        busy = self.machine.state in (State.PLACING, State.MEASURING)
        return self.machine.plan.views[self.machine.index] if busy else None

    def begin(self) -> str:
        """Start the plan; say what is known of it and who is missing."""
        self.waiting = False
        answer = self.act(self.machine.start)
        known = self._measured.get(self.machine.plan.plan_id, {})
        if known:
            views = ", ".join(known[index] for index in sorted(known))
            answer += f"; measured already: {views} (skip_view keeps a view as it is)"
        if not self._collectors():
            answer += "; no measurement_collector is seen yet: make sure that one runs"
        self._ports.say(Level.OK, answer)
        return answer

    def act(self, request: Callable[[], list[Command]]) -> str:
        """Carry out a request to the state machine and say where that leads."""
        self._send(request())
        return f"{self.machine.state}: view {self.machine.index}"

    def abort(self) -> None:
        """Give the plan up if one runs."""
        if not self.ended:
            self._send(self.machine.abort())

    def take_measurement(self, message: Any) -> None:
        """Note a view that has been measured."""
        self._measured.setdefault(message.plan_id, {})[message.view_index] = message.view_name

    def take_command(self, message: Any) -> None:
        """Follow a command that somebody else published."""
        if _key(to_model.command(message)) in self._own:
            return
        said = "another publisher sends view commands: following them; abort ends that"
        if self.ended:
            self._ports.say(Level.OK, said)
        elif self.machine.state is not State.FOLLOWING:  # its own plan stops here
            self._ports.say(Level.WARN, said)
        self.machine.foreign_command()
        self._end()

    def take_status(self, message: Any) -> None:
        """Note how far the view is; move on when it is complete."""
        if to_model.stamp_ns(message) < self._commanded_ns:
            return  # of before the command: a redone view would look complete
        expected = message.grid_expected + message.angular_expected
        if message.view_index == self.machine.index and expected:
            self.coverage = (message.grid_done + message.angular_done) / expected
        moved_on = self.machine.status(message.plan_id, message.view_index, message.complete)
        self._redos = 0 if moved_on else self._redos
        self._send(moved_on)

    def tick(self) -> None:
        """Do what is due by the clock."""
        now = self._ports.now_s()
        if self.waiting and self._collectors():
            self.begin()
        if (self.machine.state is State.PLACING and self._values["auto_confirm"]
                and now >= self._confirm_at):
            self._send(self.machine.confirm())
        timed_out = self._values["view_timeout"] > 0 and now >= self._deadline
        if self.machine.state is State.MEASURING and timed_out:
            self._ports.say(Level.WARN, f"view {self.current.name} is not complete in time")
            again = self._redos < self._values["max_redos"]
            self._redos = self._redos + 1 if again else 0
            self._send(self.machine.redo() if again else self.machine.skip())

    def diagnosis(self) -> Diagnosis:
        """Return what the node says of itself."""
        state = "waiting for a measurement_collector" if self.waiting else str(self.machine.state)
        return Diagnosis(Level.OK, state, {"view": self.machine.index,
                                           "coverage": f"{self.coverage:.3f}"})

    def _send(self, commands: list[Command]) -> None:
        for command in commands:
            command = replace(command, stamp_ns=self._ports.now_ns())
            self._own.add(_key(command))
            self._commanded_ns = command.stamp_ns
            self._ports.publish("command", from_model.command(command, self._values["frame_id"]))
            name = command.view.name if command.view else self.machine.plan.plan_id
            self._ports.say(Level.OK, f"{command.phase.name} {name}")
            self.coverage = 0.0
            self._confirm_at = self._ports.now_s() + self._values["settle_time"]
            self._deadline = self._ports.now_s() + self._values["view_timeout"]
        if self.ended:
            self._end()

    def _end(self) -> None:
        if self.on_end is not None:
            self.on_end()


def _key(command: Command) -> tuple:
    return (command.stamp_ns, int(command.phase), command.plan_id, command.view_index)
