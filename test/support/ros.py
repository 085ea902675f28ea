# SPDX-License-Identifier: Apache-2.0
"""A ROS graph in this process for one test: nodes, listeners, services, waits with a deadline."""

import time
from collections.abc import Callable, Iterable
from typing import Any

import rclpy
from diagnostic_msgs.msg import KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter

from selfcal_ros.bagio.messages.from_model import event_fields
from selfcal_ros.nodes import names
from selfcal_ros.nodes.filling import fill
from selfcal_ros.nodes.names import Topic
from selfcal_ros.simulation.cell import Event

PATIENCE_S = 300.0


class Graph:
    """Nodes of one test on one context; `hand` is the node that the test acts with."""

    def __init__(self, domain_id: int) -> None:
        self.context = rclpy.Context()
        rclpy.init(args=[], context=self.context, domain_id=domain_id)
        self.executor = EventsExecutor(context=self.context)
        self.nodes: list[Node] = []
        self.hand = self.add(Node("hand", context=self.context))
        self._clients: dict[str, Any] = {}
        self._voices: dict[str, Any] = {}
        self._alive: dict[str, dict[str, str]] = {}

    def add(self, node: Node) -> Node:
        self.executor.add_node(node)
        self.nodes.append(node)
        return node

    def node(self, make: Callable[..., Node], **parameters: Any) -> Any:
        """Make a node of the package with these parameters and spin it with the others."""
        overrides = [Parameter(name, value=value) for name, value in parameters.items()]
        node = self.add(make(context=self.context, parameter_overrides=overrides))
        getattr(node, "autostart", lambda: None)()
        return node

    def remove(self, node: Node) -> None:
        self.executor.remove_node(node)
        self.nodes.remove(node)
        node.destroy_node()

    def listen(self, topic: Topic) -> list:
        """Return a list that fills with the messages of a topic."""
        heard: list = []
        self.hand.create_subscription(topic.type, topic.name, heard.append, topic.qos)
        return heard

    def publisher(self, topic: Topic, *, readers: int = 1) -> Any:
        """Return a publisher once `readers` subscribers have found it."""
        publisher = self.hand.create_publisher(topic.type, topic.name, topic.qos)
        self.until(
            lambda: publisher.get_subscription_count() >= readers,
            f"{readers} subscribers of {topic.name}",
        )
        return publisher

    def health(self, node: str, **values: str) -> None:
        """Tell from now on, as `node` does each second, that it is alive, and these values.

        By a timer: what is told in a loop of waiting comes faster than it can be heard.
        """
        if not self._alive:
            self.hand.create_timer(
                0.1, self._tell, clock=Clock(clock_type=ClockType.STEADY_TIME)
            )
        if node not in self._voices:
            topic = names.of_node(node, names.HEALTH)
            self._voices[node] = self.hand.create_publisher(
                topic.type, topic.name, topic.qos
            )
        self._alive[node] = values

    def _tell(self) -> None:
        for node, values in self._alive.items():
            self._voices[node].publish(
                names.HEALTH.type(
                    level=b"\0",
                    name=node,
                    message="as told",
                    values=[
                        KeyValue(key=key, value=value) for key, value in values.items()
                    ],
                )
            )

    def until(self, condition: Callable[[], Any], what: str) -> None:
        """Spin until `condition` holds; fail when patience ends."""
        deadline = time.monotonic() + PATIENCE_S
        while not condition():
            assert time.monotonic() < deadline, f"waited in vain for {what}"
            self.executor.spin_once(timeout_sec=0.02)

    def finish(self, future: Any, what: str) -> Any:
        self.until(future.done, what)
        return future.result()

    def call(self, kind: type, name: str, **fields: Any) -> Any:
        """Call a service and return its response."""
        if name not in self._clients:
            self._clients[name] = self.hand.create_client(kind, name)
        client = self._clients[name]
        self.until(client.service_is_ready, f"service {name}")
        return self.finish(
            client.call_async(kind.Request(**fields)), f"answer of {name}"
        )

    def close(self) -> None:
        # messages of other nodes' end have come by then: beside them a node may hang
        # (nodes/running.py)
        time.sleep(0.02)
        for node in list(self.nodes):
            self.remove(node)
        self.executor.shutdown()
        self.context.try_shutdown()


def publish_events(
    graph: Graph, events: Iterable[Event], *, readers: int = 1
) -> dict[str, int]:
    """Publish simulated messages on the topics of the cell; return how many, by topic."""
    publishers = {
        topic.name: (topic, graph.publisher(topic, readers=readers))
        for topic in names.INPUTS
    }
    counts = dict.fromkeys(publishers, 0)
    for event in events:
        name, fields = event_fields(event, "stage")
        topic, publisher = publishers[name]
        publisher.publish(fill(topic.type(), fields))
        counts[name] += 1
    return counts
