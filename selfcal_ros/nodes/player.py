# SPDX-License-Identifier: Apache-2.0
"""Playing a bag onto the graph: at its own pace, or as fast as the subscribers keep up."""

import math
import time
from pathlib import Path
from typing import Any

from rclpy.duration import Duration

from selfcal_ros.bagio.playlist import Playlist
from selfcal_ros.errors import NoDataError
from selfcal_ros.messages.topics import COMMAND_TOPIC, DETECTION_TOPIC, ENCODER_TOPIC
from selfcal_ros.nodes import names
from selfcal_ros.nodes.base import SelfcalNode
from selfcal_ros.units import S_PER_NS

KINDS = {ENCODER_TOPIC: "encoder", DETECTION_TOPIC: "detection", COMMAND_TOPIC: "command"}
WINDOW = 1500
"""Messages that may be under way to the collector; well below the depth of its queues."""
BURST, SLICE_S = 100, 0.02
"""Messages between two looks at the time and at how far the subscribers are; longest step."""
UNHEARD_RATE = 4000
"""Messages a second while no collector tells how far it is."""


class Player:
    """Publishes the input topics of a bag from the timers of a node.

    Messages go out as the bytes that the bag has, or are re-encoded where its types have other
    trailing fields than this package's. `seed` shuffles the order of arrival, not the stamps;
    `namespace` is that of the cell in the bag, None = the only one.
    """

    def __init__(self, node: SelfcalNode, bag: str, *, rate: float, seed: int,
                 namespace: str | None = None) -> None:
        self.node, self.rate = node, rate
        self.playlist = Playlist(Path(bag), namespace, seed)
        if not len(self.playlist):
            raise NoDataError(bag, "no message on the topics of the contract", "see the README")
        self._messages = iter(self.playlist)
        self._next = next(self._messages)
        self._first_ns = self._next[1]
        self._publishers = {topic.name: node.publisher(topic) for topic in names.INPUTS}
        self.sent = dict.fromkeys(KINDS.values(), 0)
        self.heard: dict[str, int] | None = None
        self._at = 0
        self._began: float | None = None
        node.subscribe(names.of_node("measurement_collector", names.RECEIVED), self._on_received)

    @property
    def total(self) -> int:
        """Messages to play."""
        return len(self.playlist)

    @property
    def done(self) -> bool:
        """Whether every message has been published."""
        return self._at >= len(self.playlist)

    @property
    def played(self) -> int:
        """Messages published so far."""
        return self._at

    def matched(self) -> list[str]:
        """Return the topics that have messages to play but no subscriber yet."""
        return [topic for topic, publisher in self._publishers.items()
                if topic in self.playlist.counts and publisher.get_subscription_count() == 0]

    def step(self) -> None:
        """Publish what is due now."""
        now = time.monotonic()
        self._began = began = now if self._began is None else self._began
        played_ns = (now - began) * self.rate / S_PER_NS
        due_ns = self._first_ns + played_ns if self.rate > 0 else math.inf
        while not self.done and (instant := time.monotonic()) < now + SLICE_S:
            count = min(self._room(instant - began), BURST)
            if count <= 0 or not self._publish(count, due_ns):
                return

    def _publish(self, count: int, due_ns: float) -> bool:
        """Publish up to so many messages that were logged by then; tell if more may be due."""
        for _ in range(min(count, self.total - self._at)):
            topic, stamp, data = self._next
            if stamp > due_ns:
                return False
            self._publishers[topic].publish(data)
            self.sent[KINDS[topic]] += 1
            self._at += 1
            self._next = next(self._messages, self._next)
        return True

    def _room(self, played_s: float) -> int:
        """Return how many messages the subscribers can take, `played_s` after the first one."""
        if self.heard is None:
            return int(WINDOW + UNHEARD_RATE * played_s / 2) - self._at
        return WINDOW - self._at + sum(self.heard.values())

    def _on_received(self, message: Any) -> None:
        if len(message.data) == len(self.sent):
            self.heard = dict(zip(self.sent, map(int, message.data), strict=True))

    def drain(self) -> None:
        """Wait until everything has been acknowledged."""
        for publisher in self._publishers.values():
            publisher.wait_for_all_acked(Duration(seconds=10))
