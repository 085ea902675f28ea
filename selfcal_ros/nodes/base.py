# SPDX-License-Identifier: Apache-2.0
"""Base of all nodes: checked parameters, ports for the session, guarded callbacks, health."""

import time
from collections.abc import Callable
from functools import partial
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    ParameterType,
)
from rclpy.clock import Clock, ClockType
from rclpy.event_handler import (
    PublisherEventCallbacks,
    SubscriptionEventCallbacks,
)
from rclpy.publisher import Publisher
from rclpy.timer import Timer
from rclpy.utilities import get_rmw_implementation_identifier

from selfcal_ros.errors import InputError, printable
from selfcal_ros.nodes.callbacks import Numbered, WithInfo
from selfcal_ros.nodes.filling import fill, status_of
from selfcal_ros.nodes.names import (
    HEALTH,
    TOLD_TO_ALL,
    Topic,
    others_publishing,
    private,
    unheard,
    unreached,
)
from selfcal_ros.nodes.services import Answering
from selfcal_ros.nodes.sessions.clocks import RosTime
from selfcal_ros.nodes.sessions.health import (
    Diagnosis,
    Level,
    Losses,
    Ports,
    Refusals,
    merged,
)
from selfcal_ros.settings.parameter import BARE_Y, Parameter, Settings

BEAT_S = 1.0  # between two health messages
NUMBERS_TELL = "fastrtps" in get_rmw_implementation_identifier()
"""Whether lost messages are known from the numbers of those that arrive.

Fast DDS gives numbers, and its events of lost messages must not be taken: while more are lost, that
locks the node for ever, deaf to signals (rmw_fastrtps 890). Cyclone DDS gives events alone.
"""


class NodeBase[S: Settings](Answering):
    """A node of rclpy with parameters from the package's table, and health once a second.

    Work and health use a steady clock: a simulated or stepped ROS time does not stop them.
    """

    def prepare(self, kind: type[S]) -> None:
        """Check the parameters and start publishing health.

        Raises
        ------
        InputError
            For an unknown parameter name, a wrong type or a value out of bounds.
        """
        self.refusals = Refusals(self.say, time.monotonic)
        self.losses = Losses(self.say, time.monotonic)
        self._ros_time = RosTime(self.say)
        self.alone_on: list[str] = []
        self._subscribed: dict[str, Topic] = {}
        self._published: dict[str, Topic] = {}
        # what was logged of other nodes' endpoints without messages
        self._unmatched: set[str] = set()
        try:
            self._take_parameters(kind)
            self.set_descriptor(
                "use_sim_time",
                ParameterDescriptor(
                    type=ParameterType.PARAMETER_BOOL,
                    read_only=True,
                    description="take the time of stamps from /clock",
                ),
            )
        except InputError:
            self.destroy_node()  # otherwise its name stays in the graph until garbage collection
            raise
        self._diagnostics = self.publisher(TOLD_TO_ALL)
        self._health = self.publisher(private(HEALTH))
        self._beat = self.every(BEAT_S, self.report)

    def _take_parameters(self, kind: type[S]) -> None:
        overrides = {
            key: value.value for key, value in self._parameter_overrides.items()
        }
        self.settings = kind.checked(overrides, f"parameters of {kind.NODE}")
        for parameter in kind.parameters():  # the checked value: 2 is accepted as 2.0
            self.declare_parameter(
                parameter.name,
                getattr(self.settings, parameter.name),
                descriptor(parameter),
                ignore_override=True,
            )
        for key in (key for key, value in overrides.items() if value is True):
            if getattr(self.settings, key, "") == BARE_Y:
                self.say(
                    Level.OK, f"{key}: true is a bare y as ROS reads it; taken as 'y'"
                )

    def publisher(self, topic: Topic) -> Publisher:
        """Return a publisher of `topic`."""
        name = self.resolve_topic_name(topic.name)
        self._published[name] = topic

        def end(publisher: Publisher) -> None:
            self._published.pop(name, None)
            self.destroy_publisher(publisher)

        # no default callbacks: one due when a publisher ends would end the process (rclpy 1644)
        events = PublisherEventCallbacks(use_default_callbacks=False)
        return self.own(
            self.create_publisher(
                topic.type, topic.name, topic.qos, event_callbacks=events
            ),
            end,
        )

    def output(self, topic: Topic) -> Callable[[dict[str, Any]], None]:
        """Return a function that publishes the fields of a message on `topic`."""
        publisher = self.publisher(topic)
        return lambda fields: publisher.publish(fill(topic.type(), fields))

    def subscribe(
        self, topic: Topic, callback: Callable[..., None], **kwargs: Any
    ) -> Any:
        """Subscribe `callback` to `topic`; its exceptions are counted and do not end the node."""
        name = self.resolve_topic_name(topic.name)
        guarded = (
            callback
            if hasattr(callback, "__signature__")
            else self.guarded(callback, topic.name)
        )
        self._subscribed[name] = topic

        lost = partial(self.losses.add, topic.name)

        def told(event: Any) -> None:
            lost(event.total_count_change)

        # otherwise only the newest is used: the others are not lost
        is_counted = topic.qos.depth > 1
        take = guarded
        if (
            is_counted
            and NUMBERS_TELL
            and not getattr(callback, "counts_losses", False)
        ):
            take = Numbered(guarded, lost)
        # no default callbacks: one due when a subscription ends would end the process (rclpy 1644)
        events = SubscriptionEventCallbacks(
            message_lost=told if is_counted and not NUMBERS_TELL else None,
            use_default_callbacks=False,
        )
        subscription = self.create_subscription(
            topic.type, topic.name, take, topic.qos, event_callbacks=events, **kwargs
        )
        if isinstance(take, Numbered):
            take.subscription = subscription
        return self.own(subscription, self.destroy_subscription)

    def subscribe_with_age(
        self, topic: Topic, callback: Callable[[Any, bool], None], **kwargs: Any
    ) -> Any:
        """Subscribe `callback`; its second argument is whether the message is older than this call.

        Only a latched message, published before the subscription, can be.
        """
        began_ns = time.time_ns()

        def call(*received: Any) -> None:
            # the events executor of rclpy 7.1 passes message and info as one pair
            message, info = received[0] if len(received) == 1 else received
            callback(message, info["source_timestamp"] < began_ns)

        return self.subscribe(topic, WithInfo(self.guarded(call, topic.name)), **kwargs)

    def every(self, seconds: float, callback: Callable[[], None]) -> Timer:
        """Call `callback` periodically, in seconds of a steady clock used by no other timer.

        For each timer that is added or reset the events executor of rclpy 7.1 calls again
        every due timer of the same clock, and each call delays the next by a period:
        the health of a node that starts slowly would be published three times, then not for 3 s.
        """
        timer = self.create_timer(
            seconds,
            self.guarded(callback),
            clock=Clock(clock_type=ClockType.STEADY_TIME),
        )
        return self.own(timer, self.destroy_timer)

    def own(self, entity: Any, destroy: Callable[[Any], Any]) -> Any:
        """Return `entity`; a managed node registers it for destruction."""
        return entity

    def ports(self, publish: Callable[[str, dict[str, Any]], None]) -> Ports:
        """Return the ports of this node for a session; `publish` takes its outputs."""
        return Ports(
            publish,
            self.say,
            time.monotonic,
            lambda: self.get_clock().now().nanoseconds,
        )

    def say(self, level: Level, line: str) -> None:
        """Write one line to the log."""
        logger = self.get_logger()
        line = printable(line)
        # a line each: rclpy distinguishes call sites by their location
        if level == Level.OK:
            logger.info(line)
        elif level == Level.WARN:
            logger.warning(line)
        else:
            logger.error(line)

    def diagnosis(self) -> Diagnosis:
        """Return the diagnosis of this node."""
        return Diagnosis(Level.OK, "running")

    def report(self) -> None:
        """Publish the health of this node."""
        graph = [unheard(self, self._subscribed), unreached(self, self._published)]
        for found in graph:
            if found.message and found.message not in self._unmatched:
                self.say(found.level, found.message)
        self._unmatched = {found.message for found in graph}
        graph.append(others_publishing(self, self.alone_on))
        clock = self._ros_time.look(
            simulated=self.get_parameter("use_sim_time").value,
            now_ns=self.get_clock().now().nanoseconds,
        )
        self.diagnose(
            merged(
                self.diagnosis(),
                [self.refusals.diagnosis(), self.losses.diagnosis(), clock, *graph],
            )
        )

    def diagnose(self, diagnosis: Diagnosis) -> None:
        """Publish a diagnostic status of this node, on /diagnostics and on its health topic."""
        stage = self.settings.hardware_id or self.get_namespace().strip("/") or "stage"
        status = status_of(
            diagnosis, self.get_fully_qualified_name().lstrip("/"), stage
        )
        array_message = DiagnosticArray(status=[status])
        array_message.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(array_message)
        self._health.publish(status)


class SelfcalNode[S: Settings](NodeBase[S]):
    """A node that is active from its construction.

    Parameters
    ----------
    kind : type
        The node's settings.
    **kwargs
        For rclpy.node.Node, e.g. parameter_overrides.
    """

    def __init__(self, kind: type[S], **kwargs: Any) -> None:
        super().__init__(kind.NODE, **kwargs)
        self.prepare(kind)


def descriptor(parameter: Parameter) -> ParameterDescriptor:
    """Return the descriptor of a parameter, read-only while the node runs."""
    unit = f" [{parameter.unit}]" if parameter.unit else ""
    described = ParameterDescriptor(
        description=parameter.description + unit, read_only=True
    )
    if parameter.choices:
        described.additional_constraints = "one of " + ", ".join(parameter.choices)
    low, high = parameter.low, parameter.high
    if low is None or high is None:
        return described
    if isinstance(parameter.default, float):
        described.floating_point_range = [
            FloatingPointRange(from_value=float(low), to_value=float(high))
        ]
    else:
        described.integer_range = [
            IntegerRange(from_value=int(low), to_value=int(high), step=1)
        ]
    return described
