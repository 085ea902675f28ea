# SPDX-License-Identifier: Apache-2.0
"""Play a bag into the graph at its own pace, or as fast as the subscribers can follow."""

import math
import time
from functools import partial
from pathlib import Path
from typing import Any

from rclpy.duration import Duration

from selfcal_ros.bagio.offline import Playlist
from selfcal_ros.errors import InputError, NoDataError
from selfcal_ros.nodes import names
from selfcal_ros.nodes.base import SelfcalNode
from selfcal_ros.nodes.hearing import FOUND_S, UNNAMED, hears, not_heard, others_on
from selfcal_ros.settings.detector import DetectorSettings
from selfcal_ros.settings.nodes import (
    CollectorSettings,
    SequencerSettings,
    SolverSettings,
)
from selfcal_ros.topics import (
    COMMAND_TOPIC,
    DETECTION_TOPIC,
    ENCODER_TOPIC,
    IMAGE_TOPICS,
)
from selfcal_ros.units import S_PER_NS

KINDS = {
    ENCODER_TOPIC: "encoder",
    DETECTION_TOPIC: "detection",
    COMMAND_TOPIC: "command",
}
IMAGES = "image"
KINDS_OF_ALL = KINDS | dict.fromkeys(IMAGE_TOPICS.values(), IMAGES)
WINDOW = 1500
"""Largest number of messages on the way to the collector, well below its queue depth."""
WAITING_IMAGES = 4
"""Largest number of images on the way to the detector, below the number that it lets wait."""
IMAGE_DEPTH = 32
"""Images kept for subscribers that have not acknowledged them."""
BURST, SLICE_S = 100, 0.02
"""Messages between checks of the time and of the subscribers' progress; longest step."""
LOOK_S = 1.0
"""Time between looks for other publishers."""
NAME_S = 10.0
"""Longest wait for the name of a node whose publishers are found before it."""
UNHEARD_RATE = 4000
"""Messages per second while no collector reports its progress."""


class Player:
    """Publish the input topics of a bag from the timers of a node.

    Messages are sent as the bytes in the bag, or re-encoded if its types have other
    trailing fields than this package's. `seed` shuffles the order of arrival, not the stamps;
    `namespace` is that of the cell in the bag, None = the only one; `listener` is the node that
    sets the pace. Images take the place of missing detections, at the pace of mark_detector in the
    node's namespace. It plays only where nobody else publishes on its topics, but the nodes
    of selfcal in its namespace, unless `beside_others`.
    """

    def __init__(
        self,
        node: SelfcalNode,
        bag: str,
        *,
        rate: float,
        seed: int = -1,
        namespace: str | None = None,
        listener: str = CollectorSettings.NODE,
        beside_others: bool = False,
    ) -> None:
        self.node, self.rate, self._bag = node, rate, bag
        own_namespace = node.get_namespace().rstrip("/")
        self.listener = (
            listener if listener.startswith("/") else f"{own_namespace}/{listener}"
        )
        self.detector = f"{own_namespace}/{DetectorSettings.NODE}"
        self.playlist = Playlist(Path(bag), namespace, seed)
        if not len(self.playlist):
            raise NoDataError(
                bag, "no message on the topics of the contract", "see the README"
            )
        self._messages = iter(self.playlist)
        self._next: tuple[str, int, bytes] | None = (first := next(self._messages))
        self._first_ns = first[1]
        transport = self.playlist.transport
        images = names.image_topics(transport, IMAGE_DEPTH)[:1] if transport else []
        # detections of images are the detector's
        played = [
            topic
            for topic in names.INPUTS
            if not images or topic.name != DETECTION_TOPIC
        ]
        self._publishers = {
            topic.name: node.publisher(topic) for topic in (*played, *images)
        }
        self.sent = dict.fromkeys([KINDS_OF_ALL[name] for name in self._publishers], 0)
        self.heard: dict[str, int] | None = None
        self._at = 0
        self._began: float | None = None
        self._published_s = 0.0  # last time that a message was sent, or none was due
        self._before = 0  # messages received by the listener before the first of these
        self.alone_on = (
            []
            if beside_others
            else [*self._publishers, *([DETECTION_TOPIC] if images else [])]
        )
        self._own = [
            node.get_fully_qualified_name(),
            *(
                f"{own_namespace}/{name}"
                for name in (
                    SequencerSettings.NODE,
                    CollectorSettings.NODE,
                    SolverSettings.NODE,
                )
            ),
        ]
        self._own += [self.detector] if images else []
        self._created_s = self._looked_s = time.monotonic()
        received = names.of_node(self.listener, names.RECEIVED)
        self._tells = partial(node.count_publishers, received.name)
        node.subscribe(received, self._on_received)
        if images:
            taken_topic = names.of_node(self.detector, names.RECEIVED)
            self._detector_tells = partial(node.count_publishers, taken_topic.name)
            node.subscribe(taken_topic, self._on_taken)

    taken: int | None = None
    """Images that the detector has taken."""
    found = 0
    """Detections that it has published."""
    matched = 0
    """Subscribers matched to them."""
    _taken_before = 0

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
        played = [topic for topic in self.playlist.counts if topic in KINDS]
        waits = self.heard is None and self._tells()
        if (
            played
            and self.taken is not None
            and not hears(
                self.node, DETECTION_TOPIC, self.listener, matched=self.matched
            )
        ):
            return [DETECTION_TOPIC]  # it would lose those of the first images
        return played if waits else self._not_heard(played, self.listener)

    def unseen(self) -> list[str]:
        """Return the topics of images to play that the detector has not subscribed to yet."""
        played = [topic for topic in self.playlist.counts if topic not in KINDS]
        waits = played and self.taken is None and self._detector_tells()
        return played if waits else self._not_heard(played, self.detector)

    def deaf(self) -> list[str]:
        """Return which nodes do not listen yet, and to what, one line each."""
        return [
            f"{node} does not listen to {', '.join(topics)}"
            for node, topics in (
                (self.listener, self.unheard()),
                (self.detector, self.unseen()),
            )
            if topics
        ]

    def _not_heard(self, topics: list[str], by: str) -> list[str]:
        return not_heard(
            self.node, {topic: self._publishers[topic] for topic in topics}, by
        )

    @property
    def arrived(self) -> bool:
        """Whether the nodes have received everything sent, and the detections in its images."""
        if IMAGES not in self.sent:
            return self.heard == self.sent
        return self.taken == self.sent[IMAGES] and self.heard == {
            KINDS[topic]: self.found
            if topic == DETECTION_TOPIC
            else self.sent[KINDS[topic]]
            for topic in KINDS
        }

    @property
    def overheard(self) -> bool:
        """Whether the listener has received more than was sent, from somebody else."""
        heard = self.heard or {}
        return any(heard.get(kind, 0) > sent for kind, sent in self.sent.items())

    def is_alone(self) -> bool:
        """Return whether nobody else publishes where this one will; False until that is known.

        Raises
        ------
        InputError
            If somebody does.
        """
        self._looked_s = time.monotonic()
        looked_s = self._looked_s - self._created_s
        other_nodes = self._other_publishers()
        named = {
            name: topics
            for name, topics in other_nodes.items()
            if name != UNNAMED or looked_s > NAME_S
        }
        for name, topics in named.items():
            raise InputError(
                f"ROS domain {self.node.context.get_domain_id()}",
                f"{name} publishes {', '.join(topics)} as well; {self._at} messages were played",
                "end it, or play in another ROS domain",
            )
        return not other_nodes and (looked_s >= FOUND_S or not self.alone_on)

    def _other_publishers(self) -> dict[str, list[str]]:
        """Return who else publishes on which topics; selfcal's nodes may, on topics of their own.

        A node of that name on another topic is somebody else's.
        """
        topics_of_node: dict[str, list[str]] = {}
        for topic in self.alone_on:
            played = topic in self._publishers and topic != COMMAND_TOPIC
            own_nodes = self._own[:1] if played else self._own
            for name in others_on(self.node, topic, own_nodes):
                topics_of_node.setdefault(name, []).append(topic)
        return topics_of_node

    def step(self) -> None:
        """Publish the messages due now.

        Raises
        ------
        InputError
            If somebody else began to publish on the topics played, or the bag has changed.
        """
        now = time.monotonic()
        if now - self._looked_s >= LOOK_S:
            self.is_alone()
        if self._began is None:
            self._began, self._before = now, self._received
            self._taken_before = self.taken or 0
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
                raise InputError(
                    self._bag,
                    f"{self.total} messages when it was opened, {self._at} now",
                    "play a bag that is not being changed",
                )
            topic, stamp, data = self._next
            if stamp > due_ns:
                return False
            self._publishers[topic].publish(data)
            self.sent[KINDS_OF_ALL[topic]] += 1
            self._at += 1
            self._next = next(self._messages, None)
        return True

    def _room(self, played_s: float) -> int:
        """Return the number of messages that subscribers can take, `played_s` after the first."""
        images = self.sent.get(IMAGES, 0)
        other_messages = self._at - images
        room = (
            WINDOW
            - other_messages
            + (
                int(UNHEARD_RATE * played_s / 2)
                if self.heard is None
                else self._received - self._before
            )
        )
        if self.taken is None:
            return room
        return min(room, WAITING_IMAGES - images + self.taken - self._taken_before)

    @property
    def _received(self) -> int:
        """Number of messages of the kinds played here that the listener has received."""
        return sum(
            count for kind, count in (self.heard or {}).items() if kind in self.sent
        )

    def _on_received(self, message: Any) -> None:
        if len(message.data) != len(KINDS):
            return
        before = self._received
        self.heard = dict(zip(KINDS.values(), map(int, message.data), strict=True))
        if self._received < before:  # a listener that was restarted
            self._before = self._received - self._at + self.sent.get(IMAGES, 0)

    def _on_taken(self, message: Any) -> None:
        if len(message.data) != len(("taken", "found", "matched")):
            return
        n_taken, self.found, self.matched = map(int, message.data)
        if n_taken < (self.taken or 0):  # a detector that was restarted
            self._taken_before = n_taken - self.sent[IMAGES]
        self.taken = n_taken

    def drain(self) -> None:
        """Wait until everything has been acknowledged."""
        for publisher in self._publishers.values():
            publisher.wait_for_all_acked(Duration(seconds=10))
