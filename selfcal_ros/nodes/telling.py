# SPDX-License-Identifier: Apache-2.0
"""Base of the nodes that drive a machine: they publish what is read and seen."""

from selfcal_ros.machine.visiting import Event, message_of
from selfcal_ros.nodes import names
from selfcal_ros.nodes.base import SelfcalNode
from selfcal_ros.settings.nodes import DriverSettings, SimulatorSettings

IMAGES_KEPT = 100
"""Images that wait for a slow detector."""


class CellNode[S: (DriverSettings, SimulatorSettings)](SelfcalNode[S]):
    """Publishes positions, detections and images of a cell, and counts them in `sent`."""

    def publish(self, *, images: bool) -> None:
        """Create the publishers, also one of images if there are some."""
        topic_of_count = {
            "encoder_sent": names.ENCODER,
            "detection_sent": names.DETECTIONS,
        }
        if images:
            topic_of_count["image_sent"] = names.image_topics("raw", IMAGES_KEPT)[0]
        self.sent = dict.fromkeys(topic_of_count, 0)
        self._outputs = {
            topic.name: (count, self.output(topic))
            for count, topic in topic_of_count.items()
        }

    def tell(self, event: Event) -> None:
        """Publish an event."""
        name, fields = message_of(event, self.settings.frame_id)
        count, output = self._outputs[name]
        self.sent[count] += 1
        output(fields)
