# SPDX-License-Identifier: Apache-2.0
"""Play a bag into the graph at its own pace, or as fast as the subscribers can follow."""

import math
import time
from functools import partial
from pathlib import Path
from typing import Any

from rclpy.duration import Duration
from rclpy.publisher import Publisher
from rclpy.qos import ReliabilityPolicy

from selfcal_ros.bagio.offline import Playlist
from selfcal_ros.collection.settings.nodes import CollectorSettings
from selfcal_ros.errors import InputError, NoDataError
from selfcal_ros.nodes import names
from selfcal_ros.nodes.base import SelfcalNode
from selfcal_ros.topics import COMMAND_TOPIC, DETECTION_TOPIC, ENCODER_TOPIC
from selfcal_ros.units import S_PER_NS

KINDS = {ENCODER_TOPIC: "encoder", DETECTION_TOPIC: "detection", COMMAND_TOPIC: "command"}
WINDOW = 1500
"""Largest number of messages on the way to the collector, well below its queue depth."""
BURST, SLICE_S = 100, 0.02
"""Messages between checks of the time and of the subscribers' progress; longest step."""
UNHEARD_RATE = 4000
"""Messages per second while no collector reports its progress."""


class Player:
    """Publish the input topics of a bag from the timers of a node.

    Messages are sent as the bytes in the bag, or re-encoded if its types have other
    trailing fields than this package's. `seed` shuffles the order of arrival, not the stamps;
    `namespace` is that of the cell in the bag, None = the only one; `listener` is the node that
    sets the pace.
    """

    def __init__(self, node: SelfcalNode, bag: str, *, rate: float, seed: int,
                 namespace: str | None = None, listener: str = CollectorSettings.NODE) -> None:
        self.node, self.rate, self._bag = node, rate, bag
        own = node.get_namespace().rstrip("/")
        self.listener = listener if listener.startswith("/") else f"{own}/{listener}"
        self.playlist = Playlist(Path(bag), namespace, seed)
        if not len(self.playlist):
            raise NoDataError(bag, "no message on the topics of the contract", "see the README")
        self._messages = iter(self.playlist)
        first = next(self._messages)
        self._next: tuple[str, int, bytes] | None = first
        self._first_ns = first[1]
        self._publishers = {topic.name: node.publisher(topic) for topic in names.INPUTS}
        self.sent = dict.fromkeys(KINDS.values(), 0)
        self.heard: dict[str, int] | None = None
        self._at = 0
        self._began: float | None = None
        self._published_s = 0.0  # last time that a message was sent, or none was due
        self._before = 0  # messages received by the listener before the first of these
        received = names.of_node(self.listener, names.RECEIVED)
        self._tells = partial(node.count_publishers, received.name)
        node.subscribe(received, self._on_received)

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

    def unheard(self) -> list[str]:
        """Return the topics with messages to play that `listener` has not subscribed to yet.

        Other subscribers (ros2 topic echo, foxglove_bridge) do not count; a collector that
        subscribes with best effort, because another publisher offers no more, would lose messages.
        """
        if self.heard is None and self._tells():
            return list(self.playlist.counts)
        hears = {topic: self._hears(publisher) for topic, publisher in self._publishers.items()
                 if topic in self.playlist.counts}
        return [topic + (" reliably (another publisher offers best effort)" if found else "")
                for topic, found in hears.items() if ReliabilityPolicy.RELIABLE not in found]

    def _hears(self, publisher: Publisher) -> list[ReliabilityPolicy]:
        """Return the reliabilities requested by the subscriptions of `listener` to a publisher."""
        if not publisher.get_subscription_count():
            return []
        readers = self.node.get_subscriptions_info_by_topic(publisher.topic_name)
        return [reader.qos_profile.reliability for reader in readers if self.listener
                == f"{reader.node_namespace.rstrip('/')}/{reader.node_name}"]

    def step(self) -> None:
        """Publish the messages due now."""
        now = time.monotonic()
        if self._began is None:
            self._began, self._before = now, sum((self.heard or {}).values())
        played_ns = (now - self._began) * self.rate / S_PER_NS
        due_ns = self._first_ns + played_ns if self.rate > 0 else math.inf
        while not self.done and (instant := time.monotonic()) < now + SLICE_S:
            count = min(self._room(instant - self._began), BURST)
            if count <= 0:
                return
            self._published_s = instant
            if not self._publish(count, due_ns):
                return

    @property
    def stalled_s(self) -> float:
        """Seconds for which messages have been due while the listener took no previous ones."""
        started = self._began is not None and not self.done
        return time.monotonic() - self._published_s if started else 0.0

    def _publish(self, count: int, due_ns: float) -> bool:
        """Publish up to this many messages logged by then; return whether more may be due."""
        for _ in range(min(count, self.total - self._at)):
            if self._next is None:
                raise InputError(self._bag, f"{self.total} messages when it was opened, "
                                 f"{self._at} now", "play a bag that nobody changes")
            topic, stamp, data = self._next
            if stamp > due_ns:
                return False
            self._publishers[topic].publish(data)
            self.sent[KINDS[topic]] += 1
            self._at += 1
            self._next = next(self._messages, None)
        return True

    def _room(self, played_s: float) -> int:
        """Return the number of messages that subscribers can take, `played_s` after the first."""
        if self.heard is None:
            return int(WINDOW + UNHEARD_RATE * played_s / 2) - self._at
        return WINDOW - self._at + sum(self.heard.values()) - self._before

    def _on_received(self, message: Any) -> None:
        if len(message.data) != len(self.sent):
            return
        if sum(message.data) < sum((self.heard or {}).values()):  # a listener that was restarted
            self._before = sum(message.data) - self._at
        self.heard = dict(zip(self.sent, map(int, message.data), strict=True))

    def drain(self) -> None:
        """Wait until everything has been acknowledged."""
        for publisher in self._publishers.values():
            publisher.wait_for_all_acked(Duration(seconds=10))
