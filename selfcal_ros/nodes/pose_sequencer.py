# SPDX-License-Identifier: Apache-2.0
"""pose_sequencer: commands the views of a plan."""

import sys
from functools import partial
from typing import Any

from std_srvs.srv import Trigger

from selfcal_ros.collection.settings.nodes import SequencerSettings
from selfcal_ros.nodes import names
from selfcal_ros.nodes.calibration_action import CalibrationAction
from selfcal_ros.nodes.filling import diagnosis_of
from selfcal_ros.nodes.managed import ManagedNode, WhileConfigured
from selfcal_ros.nodes.running import run
from selfcal_ros.sessions.sequencing import SequencingSession

COMPANIONS = ("measurement_collector", "solver")
TICK_S = 0.05


class PoseSequencer(ManagedNode[SequencerSettings]):
    """Publish PLACE and MEASURE for each view, driven by services and an action."""

    session = WhileConfigured[SequencingSession]()
    _action = WhileConfigured[CalibrationAction]()

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(SequencerSettings, **kwargs)

    def configure(self) -> None:
        """Create the session, with its plan, and the publisher of commands."""
        command = self.output(names.NEWEST_COMMAND)
        self.session = SequencingSession(
            self.settings, self.ports(lambda _, fields: command(fields)))

    def activate(self) -> None:
        """Subscribe to the companions, offer services and the action."""
        session = self.session
        self.subscribe_with_age(names.COMMAND, self._on_command)
        self.subscribe(names.STATUS_AS_IT_COMES, session.take_status)
        self.subscribe(names.MEASUREMENT, session.take_measurement)
        for node in COMPANIONS:
            self.subscribe_with_age(names.of_node(node, names.HEALTH),
                                    partial(self._on_health, node))
        machine = session.machine
        for name, act in (
                ("start", session.begin), ("abort", session.give_up),
                ("confirm_view", lambda: session.act(machine.confirm)),
                ("redo_view", lambda: session.act(machine.redo)),
                ("skip_view", lambda: session.act(machine.skip))):
            self.service(Trigger, f"~/{name}", lambda request, act=act: act())
        self._action = CalibrationAction(self, session)
        self.every(TICK_S, self._on_timer)

    def _on_command(self, message: Any, is_older: bool) -> None:
        """Take a command, except the last one of a sequencer that has been shut down."""
        if not is_older or self.count_publishers(names.COMMAND.name) > 1:
            self.session.take_command(message)

    def _on_health(self, node: str, status: Any, is_older: bool) -> None:
        """Take the present health of a companion: a run is resumed where the collector is."""
        if not is_older:
            self.session.presence.take(node, diagnosis_of(status))

    def _on_timer(self) -> None:
        self.session.tick()
        self._action.tick()


def main() -> None:
    """Run the node."""
    sys.exit(run(PoseSequencer))


if __name__ == "__main__":
    main()
