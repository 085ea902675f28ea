# SPDX-License-Identifier: Apache-2.0
"""What all nodes share: checked parameters, diagnostics, one way to run and to stop."""

import array
import inspect
import re
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy._rclpy_pybind11 import RCLError, UnknownROSArgsError
from rclpy.executors import ExternalShutdownException
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future

from selfcal_ros.collection.parameters import NODE_PARAMETERS, Parameter, parameter_values
from selfcal_ros.errors import ExitCode, InputError, SelfcalError
from selfcal_ros.nodes.names import Topic
from selfcal_ros.nodes.stopping import complete_on_signal, ignore_signals

SPIN_SECONDS = 86400.0
"""An infinite time-out overflows in the executor of the wheels; a day is long enough to loop."""


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

    def diagnose(self, message: str, values: dict[str, Any], *, ok: bool = True) -> None:
        """Publish one diagnostic status of this node."""
        status = DiagnosticStatus(
            level=DiagnosticStatus.OK if ok else DiagnosticStatus.WARN,
            name=self.get_fully_qualified_name().lstrip("/"), message=message,
            hardware_id="selfcal",
            values=[KeyValue(key=key, value=str(value)) for key, value in values.items()])
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


def spin(node: Node, until: Future) -> None:
    """Spin a node with the events executor until `until` is done or the context is shut down."""
    executor = EventsExecutor()
    executor.add_node(node)
    try:
        while rclpy.ok() and not until.done():
            executor.spin_until_future_complete(until, timeout_sec=SPIN_SECONDS)
    except ExternalShutdownException:
        pass
    finally:
        executor.remove_node(node)
        executor.shutdown()


def _init(argv: list[str] | None) -> None:
    try:
        rclpy.init(args=argv, signal_handler_options=SignalHandlerOptions.NO)
    except (RCLError, UnknownROSArgsError) as error:
        what = re.sub(r",? at /\S+", "", " ".join(str(error).split()))
        raise InputError("arguments after --ros-args", what, "mend them") from error


def run(make_node: Callable[[], Node], argv: list[str] | None = None) -> int:
    """Run one node as a process; SIGINT and SIGTERM end it cleanly. Return the exit code.

    A signal completes the future that the executor spins on, between two callbacks, so that no
    callback is torn and what a node has to finish in `close` is finished.
    """
    stop = Future()
    complete_on_signal(stop)
    node, code = None, int(ExitCode.DONE)
    try:
        _init(argv)
        node = make_node()
        finished = getattr(node, "finished", None)
        if finished is not None:
            finished.add_done_callback(lambda _: stop.set_result(None))
        spin(node, stop)
        code = int(getattr(node, "exit_code", ExitCode.DONE))
    except SelfcalError as error:
        print(f"selfcal: {error}", file=sys.stderr)
        code = int(error.exit_code)
    finally:
        if node is not None:
            getattr(node, "close", lambda: None)()
            node.destroy_node()
        rclpy.try_shutdown()
        ignore_signals()
    return code
