# SPDX-License-Identifier: Apache-2.0
"""What all nodes share: checked parameters, ports for the session, diagnostics."""

import array
import inspect
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node
from rclpy.publisher import Publisher

from selfcal_ros.collection.parameters import NODE_PARAMETERS, Parameter, parameter_values
from selfcal_ros.errors import SelfcalError
from selfcal_ros.nodes.names import Topic
from selfcal_ros.sessions.ports import Diagnosis, Level, Ports


class SelfcalNode(Node):
    """A node whose parameters come from the package's one table.

    Parameters
    ----------
    name : str
        Key of `NODE_PARAMETERS`; also the node's name.
    **kwargs
        For rclpy.node.Node, e.g. parameter_overrides.

    Raises
    ------
    InputError
        For an unknown parameter name, a wrong type or a value out of bounds.
    """

    def __init__(self, name: str, **kwargs: Any) -> None:
        super().__init__(name, **kwargs)
        overrides = {key: value.value for key, value in self._parameter_overrides.items()}
        self.values = parameter_values(name, overrides, f"parameters of {name}")
        for parameter in NODE_PARAMETERS[name]:  # the checked value: 2 is a good 2.0 here
            self.declare_parameter(parameter.name, self.values[parameter.name],
                                   _descriptor(parameter), ignore_override=True)
        self.frame_id = self.values.get("frame_id", "stage")
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)

    def publisher(self, topic: Topic) -> Publisher:
        """Return a publisher of `topic`."""
        return self.create_publisher(topic.type, topic.name, topic.qos)

    def subscribe(self, topic: Topic, callback: Callable[[Any], None], **kwargs: Any):
        """Subscribe `callback` to `topic`; what it raises is logged and does not end the node."""
        return self.create_subscription(topic.type, topic.name, self.guarded(callback), topic.qos,
                                        **kwargs)

    def subscribe_with_age(self, topic: Topic, callback: Callable[[Any, bool], None]):
        """Subscribe `callback`; its second argument says if the message is older than this call.

        Only a latched message can be: it was published before this node listened.
        """
        began_ns = time.time_ns()

        def call(*received: Any) -> None:
            # the events executor of rclpy 7.1 passes message and info as one pair
            message, info = received[0] if len(received) == 1 else received
            callback(message, info["source_timestamp"] < began_ns)
        guarded = self.guarded(call)
        guarded.__signature__ = inspect.signature(lambda message, info: None)  # rclpy counts them
        return self.create_subscription(topic.type, topic.name, guarded, topic.qos)

    def guarded(self, callback: Callable[..., Any]) -> Callable[..., Any]:
        """Return `callback` with the package's errors logged in one line instead of raised."""
        def call(*args: Any) -> Any:
            try:
                return callback(*args)
            except SelfcalError as error:
                self.get_logger().error(str(error))
                return None
        return call

    def ports(self, publish: Callable[[str, dict[str, Any]], None]) -> Ports:
        """Return what a session needs of this node; `publish` takes its outputs."""
        return Ports(publish, self.say, time.monotonic,
                     lambda: self.get_clock().now().nanoseconds)

    def say(self, level: Level, line: str) -> None:
        """Write one line to the log."""
        logger = self.get_logger()  # a line each: rclpy tells call sites apart by their place
        if level == Level.OK:
            logger.info(line)
        elif level == Level.WARN:
            logger.warning(line)
        else:
            logger.error(line)

    def diagnose(self, diagnosis: Diagnosis) -> None:
        """Publish one diagnostic status of this node."""
        status = DiagnosticStatus(
            level=bytes([diagnosis.level]), name=self.get_fully_qualified_name().lstrip("/"),
            message=diagnosis.message, hardware_id="selfcal",
            values=[KeyValue(key=key, value=str(value))
                    for key, value in diagnosis.values.items()])
        array_message = DiagnosticArray(status=[status])
        array_message.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(array_message)

    def trigger(self, request: Any, response: Any, act: Callable[[], str]) -> Any:
        """Fill a Trigger or map-service response from `act`, or from the error it raises."""
        try:
            response.success, response.message = True, act()
        except SelfcalError as error:
            response.success, response.message = False, str(error)
            if hasattr(response, "error_code"):
                response.error_code = int(error.exit_code)
        return response


def _descriptor(parameter: Parameter) -> ParameterDescriptor:
    unit = f" [{parameter.unit}]" if parameter.unit else ""
    descriptor = ParameterDescriptor(description=parameter.description + unit, read_only=True)
    if parameter.choices:
        descriptor.additional_constraints = "one of " + ", ".join(parameter.choices)
    if parameter.low is not None and isinstance(parameter.default, float):
        descriptor.floating_point_range = [FloatingPointRange(
            from_value=float(parameter.low), to_value=float(parameter.high))]
    elif parameter.low is not None:
        descriptor.integer_range = [IntegerRange(from_value=int(parameter.low),
                                                 to_value=int(parameter.high), step=1)]
    return descriptor


def fill(message: Any, fields: dict[str, Any]) -> Any:
    """Return an rclpy message with its fields set from a plain nested dict."""
    for name, value in fields.items():
        if isinstance(value, dict):
            fill(getattr(message, name), value)
        elif isinstance(value, np.ndarray):
            current = getattr(message, name)
            if isinstance(current, array.array):
                value = array.array(current.typecode, value.tolist())
            setattr(message, name, value)
        else:
            setattr(message, name, value)
    return message
