# SPDX-License-Identifier: Apache-2.0
"""Every topic with its message type and QoS, and what other nodes publish on it.

Names are declared in `topics`.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.duration import Infinite
from rclpy.node import Node
from rclpy.qos import (
    DurabilityPolicy,
    QoSCompatibility,
    QoSProfile,
    ReliabilityPolicy,
    qos_check_compatible,
)
from rclpy.topic_endpoint_info import TopicEndpointInfo
from selfcal_msgs import msg
from sensor_msgs.msg import CompressedImage, Image, JointState
from std_msgs.msg import String, UInt64MultiArray
from visualization_msgs.msg import MarkerArray

from selfcal_ros import topics
from selfcal_ros.model.plan_form import MAX_VIEWS
from selfcal_ros.nodes.hearing import node_of, publishers_of
from selfcal_ros.nodes.sessions.health import Diagnosis, Level
from selfcal_ros.topics import qos_profile


@dataclass(frozen=True)
class Topic:
    """Name, message type, QoS."""

    name: str
    type: type
    qos: QoSProfile

    @property
    def type_name(self) -> str:
        """The message type as ROS writes it, e.g. sensor_msgs/msg/JointState."""
        package = self.type.__module__.split(".")[0]
        return f"{package}/msg/{self.type.__name__}"


def _qos(depth: int, *, reliable: bool = True, latched: bool = False) -> QoSProfile:
    return QoSProfile(
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE
        if reliable
        else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL
        if latched
        else DurabilityPolicy.VOLATILE,
        # as DDS states what is not asked for: subscribers are compared with it
        deadline=Infinite,
        liveliness_lease_duration=Infinite,
    )


PARTICIPANT = 12
"""First bytes of an endpoint's identity that all endpoints of a process share (DDS)."""

# encoder at 1 kHz: a pause of a second must not overwrite a sample
ENCODER = Topic(topics.ENCODER_TOPIC, JointState, _qos(5000))
ENCODER_EITHER = (
    ENCODER,
    Topic(topics.ENCODER_TOPIC, JointState, _qos(5000, reliable=False)),
)
# corrected positions of earlier, displaced samples are useless
ENCODER_NEWEST = Topic(topics.ENCODER_TOPIC, JointState, _qos(100, reliable=False))
DETECTIONS = Topic(topics.DETECTION_TOPIC, msg.MarkDetection, _qos(5000))
COMMAND = Topic(topics.COMMAND_TOPIC, msg.ViewCommand, _qos(256, latched=True))
NEWEST_COMMAND = Topic(topics.COMMAND_TOPIC, msg.ViewCommand, _qos(1, latched=True))
"""Offered by a sequencer: a late cell acts on the first command that it receives."""
STATUS = Topic(topics.STATUS_TOPIC, msg.ViewStatus, _qos(64, latched=True))
STATUS_AS_IT_COMES = Topic(topics.STATUS_TOPIC, msg.ViewStatus, _qos(64))
# one message a view, or a cell of its image; each is sent again when a view was redone
MEASUREMENT = Topic(
    topics.MEASUREMENT_TOPIC, msg.ViewMeasurement, _qos(2 * MAX_VIEWS, latched=True)
)
ERROR_MAP = Topic(topics.ERROR_MAP_TOPIC, msg.ErrorMap, _qos(1, latched=True))
SUMMARY = Topic(topics.SUMMARY_TOPIC, msg.CalibrationSummary, _qos(1, latched=True))
PROGRESS = Topic(topics.PROGRESS_TOPIC, String, _qos(1, latched=True))
"""One line for a person."""
MAP_MARKERS = Topic(topics.MAP_MARKERS_TOPIC, MarkerArray, _qos(1, latched=True))
CORRECTED = Topic(topics.CORRECTED_TOPIC, JointState, _qos(100, reliable=False))
MOTION = Topic(topics.MOTION_TOPIC, JointState, _qos(1000))
"""Commanded positions of the stage: each counts, none is displaced by newer ones."""
CORRECTED_MOTION = Topic(topics.CORRECTED_MOTION_TOPIC, JointState, _qos(1000))

DIAGNOSTICS = Topic("/diagnostics", DiagnosticArray, _qos(100, reliable=False))
"""Of all nodes, of other packages too."""
TOLD_TO_ALL = Topic(DIAGNOSTICS.name, DiagnosticArray, _qos(10))
"""The same as a node publishes it."""

# below the node's own name (~/)
HEALTH = Topic("health", DiagnosticStatus, _qos(1, latched=True))
RECEIVED = Topic("received", UInt64MultiArray, _qos(1, latched=True))
"""The collector's counts of encoder samples, detections and commands, or the detector's of images
taken, detections published and subscriptions connected to these, for a player's pace. Told again
with each beat: a player that missed the only one would wait for ever."""
SOLVED = Topic("solved", String, _qos(1, latched=True))
"""The solver's fingerprint of the readings behind its results, told again with each sweep."""


def of_node(node: str, topic: Topic) -> Topic:
    """Return the topic below a node's name as seen by others in its namespace."""
    return Topic(f"{node}/{topic.name}", topic.type, topic.qos)


def private(topic: Topic) -> Topic:
    """Return the topic as named by the node itself."""
    return Topic(f"~/{topic.name}", topic.type, topic.qos)


IMAGE_TYPES = {"raw": Image, "compressed": CompressedImage}


def image_topics(transport: str, depth: int) -> tuple[Topic, Topic]:
    """Return the topic of images, reliable and with best effort."""
    name = topics.IMAGE_TOPICS[transport]
    kind = IMAGE_TYPES[transport]
    return Topic(name, kind, _qos(depth)), Topic(
        name, kind, _qos(depth, reliable=False)
    )


INPUTS = (ENCODER, DETECTIONS, COMMAND)
RESULTS = (STATUS, MEASUREMENT, ERROR_MAP, SUMMARY, CORRECTED)
COMMANDED = (MOTION, CORRECTED_MOTION)


def unheard(node: Node, subscribed: Mapping[str, Topic]) -> Diagnosis:
    """Name the publishers whose type or quality of service keeps their messages from this node."""
    faults = [
        f"{topic.name}: no messages are received from {node_of(other)} {why}"
        for name, topic in subscribed.items()
        for other in node.get_publishers_info_by_topic(name)
        if (why := _mismatch(topic, other, publishes=True))
    ]
    return Diagnosis.of(faults, level=Level.ERROR)


def unreached(node: Node, published: Mapping[str, Topic]) -> Diagnosis:
    """Name the subscribers that this node's messages do not reach, by type or by QoS."""
    faults = [
        f"{topic.name}: no messages reach {node_of(other)} {why}"
        for name, topic in published.items()
        for other in node.get_subscriptions_info_by_topic(name)
        if (why := _mismatch(topic, other, publishes=False))
    ]
    return Diagnosis.of(faults)


def _mismatch(topic: Topic, other: Any, *, publishes: bool) -> str:
    """Return why an endpoint of another node does not match, and the remedy; "" if it does.

    `publishes` is whether the other node publishes on `topic`, or subscribes to it.
    """
    if other.topic_type != topic.type_name:
        does, do = (
            ("publishes", "publish") if publishes else ("subscribes to", "subscribe to")
        )
        return f"(it {does} {other.topic_type}); {do} {topic.type_name}, or remap its topic"
    offer, request = (
        (other.qos_profile, topic.qos) if publishes else (topic.qos, other.qos_profile)
    )
    verdict, reason = qos_check_compatible(offer, request)
    if verdict != QoSCompatibility.ERROR:
        return ""
    why = reason.replace("ERROR: ", " ").strip(";. ")
    how = "offer" if publishes else "subscribe with"
    return f"({why}); {how} the QoS in docs/reference/ros2.md"


def others_publishing(node: Node, topics: Iterable[str]) -> Diagnosis:
    """Name all publishers of a topic that has more than one."""
    offers = {topic: publishers_of(node, topic) for topic in topics}
    return Diagnosis.of(
        [
            f"{_several(topic, publishers)}; only one is allowed"
            for topic, publishers in offers.items()
            if len(publishers) > 1
        ]
    )


def _several(topic: str, publishers: Sequence[TopicEndpointInfo]) -> str:
    """Return that a topic has several publishers, and who they are."""
    nodes = ", ".join(sorted(map(node_of, publishers)))
    return f"{topic} has {len(publishers)} publishers: {nodes}"


def rivals(node: Node, topics: Iterable[str]) -> str:
    """Return which of these topics several nodes publish on, and who, "" if none.

    A node is told by its participant as well: two processes may bear one name.
    """
    shared_topics = []
    for topic in topics:
        publishers = publishers_of(node, topic)
        nodes = {
            (node_of(publisher), bytes(publisher.endpoint_gid[:PARTICIPANT]))
            for publisher in publishers
        }
        if len(nodes) > 1:
            shared_topics.append(_several(topic, publishers))
    return "; ".join(shared_topics)


def kept_names(node: Node, topic: Topic) -> tuple[str, str]:
    """Return the name of `topic` in a bag, and the name that it is remapped to, if any.

    Readers of a bag expect the names of the contract, after a namespace.
    """
    name_in_bag = f"{node.get_namespace().rstrip('/')}/{topic.name}"
    heard = node.resolve_topic_name(topic.name)
    return name_in_bag, heard if heard != name_in_bag else ""


def offered(topic: Topic) -> dict:
    """Return the quality of service of a topic in the format of rosbag2."""
    return qos_profile(
        reliable=topic.qos.reliability == ReliabilityPolicy.RELIABLE,
        transient_local=topic.qos.durability == DurabilityPolicy.TRANSIENT_LOCAL,
        depth=topic.qos.depth,
    )


class MatchedInput:
    """Subscribe reliably if all publishers of a topic are reliable, else with best effort.

    Checked ten times a second: a driver may appear late, or return with another offer.

    Parameters
    ----------
    node : NodeBase
        The subscriber.
    topics : tuple of Topic
        The topic, reliable and with best effort.
    callback : callable
        Takes a message.
    **kwargs
        For `NodeBase.subscribe`.
    """

    def __init__(
        self, node: Any, topics: tuple[Topic, Topic], callback: Any, **kwargs: Any
    ) -> None:
        self._node, self.callback, self._kwargs = node, callback, kwargs
        self._topics = topics
        self._name = node.resolve_topic_name(topics[0].name)
        self._topic: Topic | None = None
        self.subscription: Any = None
        self._match()
        node.own(self, MatchedInput.close)
        node.every(0.1, self._match)

    def _match(self) -> None:
        offers = self._node.get_publishers_info_by_topic(self._name)
        if not offers:
            return
        reliable = all(
            o.qos_profile.reliability == ReliabilityPolicy.RELIABLE for o in offers
        )
        topic = self._topics[0 if reliable else 1]
        if topic is self._topic:
            return
        self.close()
        self._topic = topic
        self.subscription = self._node.subscribe(topic, self.callback, **self._kwargs)

    def close(self) -> None:
        """End the subscription."""
        if self.subscription is not None:
            self._node.destroy_subscription(self.subscription)
        self.subscription = None
