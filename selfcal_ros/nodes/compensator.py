# SPDX-License-Identifier: Apache-2.0
"""compensator: true positions from indicated ones, and commands, with the calibrated error map."""

import sys
from typing import Any

from selfcal_msgs.srv import Correct

from selfcal_ros.collection.settings.nodes import CompensatorSettings
from selfcal_ros.nodes import names
from selfcal_ros.nodes.filling import fill
from selfcal_ros.nodes.managed import ManagedNode, WhileConfigured
from selfcal_ros.nodes.polling import ByTheClock
from selfcal_ros.nodes.running import run
from selfcal_ros.sessions.compensating import CompensatingSession


class CompensatorNode(ManagedNode[CompensatorSettings]):
    """Publish samples without the stage's error, and commands with it.

    The topics are stage/corrected_joint_states and stage/corrected_command.
    """

    session = WhileConfigured[CompensatingSession]()
    _input = WhileConfigured[ByTheClock]()
    _encoder = WhileConfigured[Any]()

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(CompensatorSettings, **kwargs)

    def configure(self) -> None:
        """Create the session, with the map of a file if named."""
        self.session = CompensatingSession(self.settings, self.ports(lambda *_: None))
        self._corrected = self.publisher(names.CORRECTED)
        self._commands = self.publisher(names.CORRECTED_MOTION)
        self.alone_on += [names.ERROR_MAP.name, names.SUMMARY.name, names.CORRECTED.name,
                          names.CORRECTED_MOTION.name]

    def activate(self) -> None:
        """Subscribe to the maps and to the encoder."""
        self.subscribe(names.SUMMARY, self.session.take_summary)
        self.subscribe(names.ERROR_MAP, self.session.take_map)
        self._input = ByTheClock(names.ENCODER.name, self.session.receive,
                                 self.guarded(self._on_samples, names.ENCODER.name))
        self._encoder = self.subscribe(names.ENCODER_NEWEST, self._input, raw=True)
        self.subscribe(names.MOTION, self._on_command, raw=True)
        self.service(Correct, "~/correct", self._correct)

    def _on_samples(self) -> None:
        """Correct waiting samples: called for the first one, which takes the others."""
        with self._encoder.handle:
            missing = self._input.empty(self._encoder, names.ENCODER_NEWEST.qos.depth)
        self.session.correct_waiting(missing.lost, self._corrected.publish)

    def _on_command(self, data: bytes) -> None:
        corrected = self.session.command(data)
        if corrected is not None:
            self._commands.publish(corrected)

    def _correct(self, request: Any, response: Any) -> str:
        answer = self.session.answer(request.x, request.y, request.theta, inverse=request.inverse)
        fill(response, answer)
        return self.session.remark(answer)


def main() -> None:
    """Run the node."""
    sys.exit(run(CompensatorNode))


if __name__ == "__main__":
    main()
