# SPDX-License-Identifier: Apache-2.0
"""compensator: true positions from indicated ones, by the calibrated error map."""

import sys
from typing import Any

from selfcal_ros.nodes import names
from selfcal_ros.nodes.base import SelfcalNode
from selfcal_ros.nodes.running import run
from selfcal_ros.sessions.compensating import CompensatingSession


class CompensatorNode(SelfcalNode):
    """Publishes stage/corrected_joint_states: each sample with the stage's error taken off."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("compensator", **kwargs)
        self.session = CompensatingSession(self.values)
        self._corrected = self.publisher(names.CORRECTED)
        self.subscribe(names.ERROR_MAP, self.session.take_map)
        self.subscribe(names.ENCODER_BEST_EFFORT, self._on_sample)
        self.create_timer(1.0, lambda: self.diagnose(self.session.diagnosis()))

    def _on_sample(self, message: Any) -> None:
        corrected = self.session.correct(list(message.name), list(message.position))
        if corrected is not None:
            message.position = corrected
            self._corrected.publish(message)


def main() -> None:
    """Run the node."""
    sys.exit(run(CompensatorNode))


if __name__ == "__main__":
    main()
