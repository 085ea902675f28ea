# SPDX-License-Identifier: Apache-2.0
"""compensator: true positions from indicated ones, by the calibrated error map."""

import sys
from typing import Any

from selfcal_ros.collection.settings.nodes import CompensatorSettings
from selfcal_ros.nodes import names
from selfcal_ros.nodes.managed import ManagedNode, WhileConfigured
from selfcal_ros.nodes.polling import ByTheClock
from selfcal_ros.nodes.running import run
from selfcal_ros.sessions.compensating import CompensatingSession
from selfcal_ros.sessions.ports import Diagnosis


class CompensatorNode(ManagedNode[CompensatorSettings]):
    """Publishes stage/corrected_joint_states: each sample with the stage's error taken off."""

    session = WhileConfigured[CompensatingSession]()
    _input = WhileConfigured[ByTheClock]()
    _encoder = WhileConfigured[Any]()

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(CompensatorSettings, **kwargs)

    def configure(self) -> None:
        """Make the session, with the map of a file if one is named."""
        self.session = CompensatingSession(self.settings, self.ports(lambda *_: None))
        self._corrected = self.publisher(names.CORRECTED)
        self.alone_on += [names.CORRECTED.name]

    def activate(self) -> None:
        """Listen to the maps and to the encoder."""
        self.subscribe(names.SUMMARY, self.session.take_summary)
        self.subscribe(names.ERROR_MAP, self.session.take_map)
        self._input = ByTheClock(names.ENCODER.name, self.session.receive,
                                 self.guarded(self._on_samples, names.ENCODER.name))
        self._encoder = self.subscribe(names.ENCODER_NEWEST, self._input, raw=True)

    def _on_samples(self) -> None:
        """Correct what has come: the first sample of it calls, the others are taken here."""
        with self._encoder.handle:
            missing = self._input.empty(self._encoder, names.ENCODER_NEWEST.qos.depth)
        self.session.correct_waiting(missing.lost, self._corrected.publish)

    def diagnose_session(self) -> Diagnosis:
        """Return what the session says."""
        return self.session.diagnosis()


def main() -> None:
    """Run the node."""
    sys.exit(run(CompensatorNode))


if __name__ == "__main__":
    main()
