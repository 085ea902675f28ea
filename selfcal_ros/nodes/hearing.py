# SPDX-License-Identifier: Apache-2.0
"""Which publishers a node hears, and how reliably; who else publishes.

The listeners of others do not count.
"""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress

from rclpy.node import Node, NodeNameNonExistentError
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from rclpy.topic_endpoint_info import TopicEndpointInfo

FOUND_S = 4.0
"""Time after which a node that begins has found all others: on a busy machine DDS may miss all but
the announcements that each participant repeats every 3 s."""
UNNAMED = "a node of unknown name"


def not_heard(node: Node, publishers: Mapping[str, Publisher], by: str) -> list[str]:
    """Return the topics that the node named `by` does not hear reliably, with the reason if known.

    Parameters
    ----------
    node : Node
        Node of the publishers.
    publishers : mapping
        Topic -> publisher.
    by : str
        Name of the listening node with its namespace.
    """
    reliabilities = {
        topic: _reliabilities(node, publisher, by)
        for topic, publisher in publishers.items()
    }
    return [
        topic + (" reliably (another publisher offers best effort)" if heard else "")
        for topic, heard in reliabilities.items()
        if ReliabilityPolicy.RELIABLE not in heard
    ]


def hears(node: Node, topic: str, by: str, *, matched: int) -> bool:
    """Return whether the node named `by` will hear the messages that a third node publishes.

    Parameters
    ----------
    node : Node
        A node that sees all subscriptions.
    topic : str
        The topic.
    by : str
        Name of the listening node with its namespace.
    matched : int
        Number of subscriptions to which the publisher is connected.
    """
    # others never match
    readers = [
        reader
        for reader in node.get_subscriptions_info_by_topic(
            node.resolve_topic_name(topic)
        )
        if reader.qos_profile.durability == DurabilityPolicy.VOLATILE
    ]
    return matched >= len(readers) and by in [node_of(reader) for reader in readers]


def publishers_of(node: Node, topic: str) -> Sequence[TopicEndpointInfo]:
    """Return the publishers of a topic that a node sees."""
    return node.get_publishers_info_by_topic(node.resolve_topic_name(topic))


def others_on(node: Node, topic: str, own_nodes: Iterable[str]) -> list[str]:
    """Return the nodes that publish on a topic beside `own_nodes`, each of which may once."""
    found = Counter(map(node_of, publishers_of(node, topic)))
    return [*(found - Counter(own_nodes))]


def others_serving(node: Node, service: str, own_node: str) -> list[str]:
    """Return the nodes beside `own_node` that answer requests to a service."""
    others = []
    for name, namespace in node.get_node_names_and_namespaces():
        full_name = f"{namespace.rstrip('/')}/{name}"
        if full_name != own_node:
            with suppress(NodeNameNonExistentError):
                served = node.get_service_names_and_types_by_node(name, namespace)
                others += [full_name] * (service in dict(served))
    return others


def node_of(endpoint: TopicEndpointInfo) -> str:
    """Return the node of a publisher or subscriber, with its namespace.

    An endpoint is found before the name of its node, and outlives it for a moment.
    """
    if endpoint.node_name == "_NODE_NAME_UNKNOWN_":  # of rmw
        return UNNAMED
    return f"{endpoint.node_namespace.rstrip('/')}/{endpoint.node_name}"


def _reliabilities(
    node: Node, publisher: Publisher, by: str
) -> list[ReliabilityPolicy]:
    """Return the reliabilities requested by the subscriptions of a node to a publisher."""
    if not publisher.get_subscription_count():
        return []
    return [
        reader.qos_profile.reliability
        for reader in node.get_subscriptions_info_by_topic(publisher.topic_name)
        if by == node_of(reader)
    ]
