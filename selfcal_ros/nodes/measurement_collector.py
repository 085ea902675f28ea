# SPDX-License-Identifier: Apache-2.0
"""measurement_collector: encoder samples and detections in, readings of each view out."""

import sys
from typing import Any

from std_srvs.srv import Trigger

from selfcal_ros.nodes import names
from selfcal_ros.nodes.base import SelfcalNode, fill
from selfcal_ros.nodes.encoder_input import EncoderInput
from selfcal_ros.nodes.running import run
from selfcal_ros.sessions.collecting import CollectingSession

REPORT_EVERY = 500
"""Messages after which the counts are reported at once, so that a player can keep pace."""


class MeasurementCollector(SelfcalNode):
    """Feeds a `CollectingSession`; publishes ViewStatus and ViewMeasurement."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("measurement_collector", **kwargs)
        self.session = CollectingSession(self.values, self.ports(self._publish))
        self._since_report = 0
        self._outputs = {"status": self.publisher(names.STATUS),
                         "measurement": self.publisher(names.MEASUREMENT)}
        self.subscribe(names.DETECTIONS, self._on_detection)
        self.subscribe_with_age(names.COMMAND, self._on_command)
        EncoderInput(self, self._on_encoder)
        self.create_timer(0.05, self.guarded(self._on_timer))
        self.create_timer(1.0, self._report)
        self.create_service(Trigger, "~/finish", lambda request, response: self.trigger(
            request, response, self.session.finish))

    def _publish(self, output: str, fields: dict[str, Any]) -> None:
        publisher = self._outputs[output]
        publisher.publish(fill(publisher.msg_type(), fields))

    def _on_encoder(self, message: Any) -> None:
        self.session.take_encoder(message)
        self._count()

    def _on_detection(self, message: Any) -> None:
        self.session.take_detection(message)
        self._count()

    def _on_command(self, message: Any, is_older: bool) -> None:
        try:
            self.session.take_command(message, is_older)
        finally:
            self._count()

    def _count(self) -> None:
        self._since_report += 1
        if self._since_report >= REPORT_EVERY:
            self._report()

    def _on_timer(self) -> None:
        if self._since_report:
            self._report()
        self.session.tick()

    def _report(self) -> None:
        self._since_report = 0
        self.diagnose(self.session.diagnosis())


def main() -> None:
    """Run the node."""
    sys.exit(run(MeasurementCollector))


if __name__ == "__main__":
    main()
