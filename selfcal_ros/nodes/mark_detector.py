# SPDX-License-Identifier: Apache-2.0
"""mark_detector: images of a camera in, mark detections out."""

import sys
from typing import Any

from rclpy.duration import Duration
from rclpy.serialization import deserialize_message

from selfcal_ros.nodes import names
from selfcal_ros.nodes.base import BEAT_S
from selfcal_ros.nodes.filling import fill
from selfcal_ros.nodes.managed import WhileConfigured
from selfcal_ros.nodes.names import MatchedInput
from selfcal_ros.nodes.polling import ByTheClock, PollingNode
from selfcal_ros.nodes.running import run
from selfcal_ros.nodes.sessions.detecting import DetectingSession
from selfcal_ros.settings.detector import DetectorSettings
from selfcal_ros.topics import IMAGE_TOPICS

TICK_S = 0.2
"""Period of counting lost images."""
FEW = 4
"""Number of waiting images taken at once: health and requests come in between."""
PATIENCE_S = 5.0
"""Longest wait at the end for the subscribers of the detections."""


class MarkDetectorNode(PollingNode[DetectorSettings]):
    """Publish the detections of each image with its stamp; images wait in the middleware."""

    session = WhileConfigured[DetectingSession]()

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(DetectorSettings, **kwargs)

    def configure(self) -> None:
        """Create the session and the publisher."""
        self._detections = self.publisher(names.DETECTIONS)
        self._received = self.publisher(names.private(names.RECEIVED))
        self._taken = self._found = self._matched = 0
        self.alone_on.append(IMAGE_TOPICS[self.settings.transport])
        self.session = DetectingSession(self.settings, self.ports(self._publish))

    def activate(self) -> None:
        """Subscribe to the images."""
        # undone last: remaining images are used, and their detections delivered
        self.own(None, lambda _: self._deliver())
        topics = names.image_topics(self.settings.transport, self.settings.max_waiting)
        self._kind = topics[0].type
        images = ByTheClock(
            topics[0].name, self.guarded(self._take, topics[0].name), lambda: None
        )
        self._input = MatchedInput(self, topics, images, raw=True)
        self.every(TICK_S, self._look)
        self.every(BEAT_S, self._tell_taken)
        self._tell_taken()

    def _publish(self, _output: str, fields: dict[str, Any]) -> None:
        self._detections.publish(fill(names.DETECTIONS.type(), fields))
        self._found += 1

    def _take(self, data: bytes, _received_ns: int) -> None:
        self._taken += 1
        try:
            self.session.take(deserialize_message(data, self._kind))
        finally:
            self._tell_taken()

    def _tell_taken(self) -> None:
        self._matched = self._detections.get_subscription_count()
        self._received.publish(
            names.RECEIVED.type(data=[self._taken, self._found, self._matched])
        )

    def _look(self) -> None:
        """Take a few waiting images, and count the lost ones by their numbers."""
        if self._matched != self._detections.get_subscription_count():
            self._tell_taken()
        if self._input.subscription is not None:
            self._empty(self._input.subscription, self._input.callback, FEW)

    def _deliver(self) -> None:
        self._detections.wait_for_all_acked(Duration(seconds=PATIENCE_S))


def main() -> None:
    """Run the node."""
    sys.exit(run(MarkDetectorNode))


if __name__ == "__main__":
    main()
