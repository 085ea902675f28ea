# SPDX-License-Identifier: Apache-2.0
"""The machine ``joint_trajectory``: a stage under ros2_control, with a camera driver's images."""

import math
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

import rclpy
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Image as ImageMessage
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from selfcal_ros.bagio.messages.to_model import stamp_ns
from selfcal_ros.machine.interface import Image, MachineError, Offset
from selfcal_ros.vision.images import picture_of

LEAST_S = 0.1
"""Shortest time of a trajectory."""
FRESH_S = 1.0
"""Longest wait for the position to stop at: an older one lies behind, and would be a way back."""
BEST_EFFORT = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Heard from reliable publishers as well."""


class JointTrajectoryMachine:
    """Joints of a joint_trajectory_controller.

    Parameters
    ----------
    joints : list of str, optional
        Names of the joints for x, y and, if there are three, theta; m and rad.
    controller : str, optional
        The controller; trajectories go to its topic ``joint_trajectory``.
    joint_states : str, optional
        Topic of the indicated positions.
    image : str, optional
        Topic of sensor_msgs/Image; empty = no images.
    speed, turn_speed : float, optional
        Speeds of moves, m/s and rad/s.
    timeout : float, optional
        Longest wait for a message, s.

    Raises
    ------
    MachineError
        If no controller listens, or no positions are published.
    """

    def __init__(
        self,
        joints: Sequence[str] = ("x", "y"),
        controller: str = "joint_trajectory_controller",
        joint_states: str = "joint_states",
        image: str = "",
        speed: float = 0.01,
        turn_speed: float = 0.1,
        timeout: float = 5.0,
    ) -> None:
        if len(joints) not in (2, 3) or min(speed, turn_speed, timeout) <= 0:
            raise MachineError(
                f"{len(joints)} joints, speeds {speed:g} and {turn_speed:g}",
                "joint_trajectory",
                "give two or three joints, positive numbers",
            )
        self.axes = ("x", "y", "theta")[: len(joints)]
        self._joints, self._timeout_s = list(joints), timeout
        self._speeds = (speed, speed, turn_speed)[: len(joints)]
        self._news = threading.Condition()  # guards what has been received
        self._states: tuple[int, tuple[float, ...]] = (0, ())
        self._image: ImageMessage | None = None
        self._context = Context()
        rclpy.init(context=self._context)
        self._node = Node("selfcal_machine", context=self._context)
        self._topic = f"{controller}/joint_trajectory"
        self._trajectory = self._node.create_publisher(JointTrajectory, self._topic, 10)
        self._node.create_subscription(
            JointState, joint_states, self._on_states, BEST_EFFORT
        )
        self._states_topic, self._image_topic = joint_states, image
        if image:
            self._node.create_subscription(
                ImageMessage, image, self._on_image, BEST_EFFORT
            )
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._thread = threading.Thread(
            target=self._spin, name="joint_trajectory", daemon=True
        )
        self._thread.start()
        try:
            self._need_controller()
            self.position()
        except BaseException:
            self.close()
            raise

    def _spin(self) -> None:
        try:
            self._executor.spin()
        except ExternalShutdownException:
            return

    def _need_controller(self) -> None:
        deadline = time.monotonic() + self._timeout_s
        while not self._trajectory.get_subscription_count():
            if time.monotonic() > deadline:
                raise MachineError(
                    "no controller listens",
                    self._topic,
                    "start and activate it (ros2 control list_controllers), or correct controller",
                )
            time.sleep(0.05)

    def _on_states(self, message: JointState) -> None:
        position_of_joint = dict(zip(message.name, message.position, strict=False))
        if all(joint in position_of_joint for joint in self._joints):
            with self._news:
                count, _ = self._states
                self._states = (
                    count + 1,
                    tuple(float(position_of_joint[joint]) for joint in self._joints),
                )
                self._news.notify_all()

    def _on_image(self, message: ImageMessage) -> None:
        with self._news:
            self._image = message
            self._news.notify_all()

    def _wait(self, arrived: Callable[[], bool], topic: str, timeout_s: float) -> None:
        """Wait for news; `self._news` is held."""
        if not self._news.wait_for(arrived, timeout_s):
            raise MachineError(
                f"no message in {timeout_s:g} s",
                topic,
                "check the driver, the topic and the names of the joints",
            )

    def position(self) -> tuple[float, ...]:
        """Return the next position that is published, m and rad."""
        return self._next_position(self._timeout_s)

    def _next_position(self, timeout_s: float) -> tuple[float, ...]:
        with self._news:
            before = self._states[0]
            self._wait(lambda: self._states[0] > before, self._states_topic, timeout_s)
            return self._states[1]

    def move_to(self, position: tuple[float, ...]) -> None:
        """Send a trajectory of one point, and wait for its time."""
        start = self.position()
        needed_s = max(
            LEAST_S,
            *(
                abs(to - at) / speed
                for to, at, speed in zip(position, start, self._speeds, strict=True)
            ),
        )
        self._send(position, needed_s)
        time.sleep(needed_s)

    def _send(self, position: Sequence[float], duration_s: float) -> None:
        self._need_controller()
        point = JointTrajectoryPoint(
            positions=list(position), velocities=[0.0] * len(self._joints)
        )
        point.time_from_start = Duration(
            nanoseconds=math.ceil(duration_s * 1e9)
        ).to_msg()
        self._trajectory.publish(
            JointTrajectory(joint_names=self._joints, points=[point])
        )

    def image(self) -> Image | None:
        """Return the first image exposed after the call, by its stamp; None without a topic."""
        if not self._image_topic:
            return None
        began_ns = time.time_ns()

        def is_new() -> bool:
            return self._image is not None and stamp_ns(self._image) >= began_ns

        with self._news:
            self._wait(is_new, self._image_topic, self._timeout_s)
            message: Any = self._image
        return Image(picture_of(message).values, stamp_ns(message))

    def offsets(self) -> list[Offset]:
        """Return nothing: without images nothing is seen."""
        return []

    def stop(self) -> None:
        """Send the joints to where they are.

        Raises
        ------
        MachineError
            If no controller listens, or no position is published now, or it is none.
        """
        position = self._next_position(min(FRESH_S, self._timeout_s))
        if not all(map(math.isfinite, position)):
            raise MachineError(
                f"the position is {position}", self._states_topic, "check the encoders"
            )
        self._send(position, LEAST_S)

    def close(self) -> None:
        """Leave the graph."""
        self._executor.shutdown()
        self._context.try_shutdown()
        self._thread.join(self._timeout_s)
