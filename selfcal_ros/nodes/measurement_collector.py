# SPDX-License-Identifier: Apache-2.0
"""measurement_collector: encoder samples and detections in, readings of each view out."""

import sys
from typing import Any

from std_srvs.srv import Trigger

from selfcal_ros.nodes import names
from selfcal_ros.nodes.encoder_input import EncoderInput
from selfcal_ros.nodes.filling import fill
from selfcal_ros.nodes.managed import ManagedNode
from selfcal_ros.nodes.running import run
from selfcal_ros.sessions.collecting import CollectingSession
from selfcal_ros.sessions.ports import Diagnosis

TELL_EVERY = 500
"""Messages after which the counts are told at once, so that a player can keep pace."""
TICK_S = 0.02


class MeasurementCollector(ManagedNode):
    """Feeds a `CollectingSession`; publishes ViewStatus and ViewMeasurement."""

    def __init__(self, **kwargs: Any) -> None:
        self.session: CollectingSession | None = None
        self._untold = 0
        super().__init__("measurement_collector", **kwargs)

    def configure(self) -> None:
        """Make the session and the publishers."""
        self.session = CollectingSession(self.values, self.ports(self._publish))
        self._outputs = {"status": self.publisher(names.STATUS),
                         "measurement": self.publisher(names.MEASUREMENT)}
        self._received = self.publisher(names.private(names.RECEIVED))
        self.alone_on += [names.STATUS.name, names.ENCODER.name]

    def activate(self) -> None:
        """Listen to the cell and to the commands."""
        self._detections = self.subscribe(names.DETECTIONS, self._on_detection)
        self.subscribe_with_age(names.COMMAND, self._on_command)
        EncoderInput(self, self._on_encoder)
        self.every(TICK_S, self._on_timer)
        self.service(Trigger, "~/finish", lambda request: self.session.finish())

    def take_down(self) -> None:
        """Forget what was collected."""
        self.session = None

    def _publish(self, output: str, fields: dict[str, Any]) -> None:
        publisher = self._outputs[output]
        publisher.publish(fill(publisher.msg_type(), fields))

    def _on_encoder(self, message: Any) -> None:
        try:
            self.session.take_encoder(message)
        finally:
            self._count()

    def _on_detection(self, message: Any) -> None:
        try:
            self.session.take_detection(message)
        finally:
            self._count()

    def _on_command(self, message: Any, is_older: bool) -> None:
        try:
            self.session.take_command(message, is_older)
        finally:
            self._count()

    def _count(self) -> None:
        self._untold += 1
        if self._untold >= TELL_EVERY:
            self._tell()

    def _on_timer(self) -> None:
        if self._untold:
            self._tell()
        self.session.tick()

    def _tell(self) -> None:
        self._untold = 0
        self._received.publish(names.RECEIVED.type(
            data=list(self.session.collector.received.values())))

    def diagnose_session(self) -> Diagnosis:
        """Return what the session says."""
        return self.session.diagnosis(
            detections_matched=self._detections.get_publisher_count() > 0)


def main() -> None:
    """Run the node."""
    sys.exit(run(MeasurementCollector))


if __name__ == "__main__":
    main()
