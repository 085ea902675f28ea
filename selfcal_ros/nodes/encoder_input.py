# SPDX-License-Identifier: Apache-2.0
"""The subscription to the encoder, matching the present offers of its publishers."""

from collections.abc import Callable
from typing import Any

from rclpy.qos import ReliabilityPolicy

from selfcal_ros.nodes import names
from selfcal_ros.nodes.base import NodeBase


class EncoderInput:
    """Subscribe reliably if all publishers of the encoder are reliable, else with best effort.

    Checked ten times a second: a driver may appear late, or return with another offer.
    """

    def __init__(self, node: NodeBase, callback: Callable[[Any], None], **kwargs: Any) -> None:
        self._node, self._callback, self._kwargs = node, callback, kwargs
        self._name = node.resolve_topic_name(names.ENCODER.name)
        self._topic: names.Topic | None = None
        self._subscription: Any = None
        self._match()
        node.own(self, EncoderInput.close)
        node.every(0.1, self._match)

    def _match(self) -> None:
        offers = self._node.get_publishers_info_by_topic(self._name)
        if not offers:
            return
        reliable = all(o.qos_profile.reliability == ReliabilityPolicy.RELIABLE for o in offers)
        topic = names.ENCODER if reliable else names.ENCODER_BEST_EFFORT
        if topic is self._topic:
            return
        self.close()
        self._topic = topic
        self._subscription = self._node.subscribe(topic, self._callback, **self._kwargs)

    def close(self) -> None:
        """End the subscription."""
        if self._subscription is not None:
            self._node.destroy_subscription(self._subscription)
        self._subscription = None
