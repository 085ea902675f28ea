# SPDX-License-Identifier: Apache-2.0
"""Other publishers: incompatible offers, and duplicates where only one is allowed."""

from collections.abc import Iterable, Mapping
from typing import Any

from rclpy.node import Node
from rclpy.qos import (
    DurabilityPolicy,
    QoSCompatibility,
    ReliabilityPolicy,
    qos_check_compatible,
)

from selfcal_ros.nodes.names import Topic
from selfcal_ros.sessions.ports import Diagnosis, Level
from selfcal_ros.topics import qos_profile


def mismatched(node: Node, heard_on: Mapping[str, Topic]) -> Diagnosis:
    """Name the publishers whose quality of service keeps their messages from this node."""
    found = []
    for name, topic in heard_on.items():
        for offer in node.get_publishers_info_by_topic(name):
            verdict, reason = qos_check_compatible(offer.qos_profile, topic.qos)
            if verdict == QoSCompatibility.ERROR:
                why = reason.removeprefix("ERROR: ").rstrip(";. ")
                found.append(f"{topic.name}: nothing is heard of {_name(offer)} ({why}); offer "
                             "what docs/ros2.md lists")
    return Diagnosis(Level.ERROR if found else Level.OK, "; ".join(found))


def others_publishing(node: Node, topics: Iterable[str]) -> Diagnosis:
    """Name all publishers of a topic that has more than one."""
    found = []
    for topic in topics:
        offers = node.get_publishers_info_by_topic(node.resolve_topic_name(topic))
        if len(offers) > 1:
            found.append(f"{topic} has {len(offers)} publishers: "
                         f"{', '.join(sorted(map(_name, offers)))}; one is right")
    return Diagnosis(Level.WARN if found else Level.OK, "; ".join(found))


def kept_names(node: Node, topic: Topic) -> tuple[str, str]:
    """Return the name of `topic` in a bag, and the name that it is remapped to, if any.

    Readers of a bag expect the names of the contract, after a namespace.
    """
    own, heard = f"{node.get_namespace().rstrip('/')}/{topic.name}", node.resolve_topic_name(
        topic.name)
    return own, heard if heard != own else ""


def offered(topic: Topic) -> dict:
    """Return the quality of service of a topic in the format of rosbag2."""
    return qos_profile(reliable=topic.qos.reliability == ReliabilityPolicy.RELIABLE,
                       transient_local=topic.qos.durability == DurabilityPolicy.TRANSIENT_LOCAL,
                       depth=topic.qos.depth)


def _name(offer: Any) -> str:
    return f"{offer.node_namespace.rstrip('/')}/{offer.node_name}"
