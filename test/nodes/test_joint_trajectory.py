# SPDX-License-Identifier: Apache-2.0
"""The machine joint_trajectory over DDS, with a small trajectory controller and a camera."""

import threading
import time

import numpy as np
import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import Image, JointState
from trajectory_msgs.msg import JointTrajectory

from selfcal_ros.bagio.messages import from_model
from selfcal_ros.machine import MachineError
from selfcal_ros.machine.measuring import Run
from selfcal_ros.nodes.filling import fill
from selfcal_ros.nodes.joint_trajectory import JointTrajectoryMachine
from selfcal_ros.settings.estimator import read_plan
from test.machine.test_measuring import away_from
from test.support.cells import PLAN, Agreeing, write_cell
from test.support.waiting import wait_until


class Controller(Node):
    """Goes along each axis at a steady speed to the point of a trajectory; shows images."""

    def __init__(self, simulated, context) -> None:
        super().__init__("controller", context=context)
        self._simulated = simulated
        self.at, self._way, self.goals = np.zeros(2), None, []
        self.is_heard = True
        self._states = self.create_publisher(JointState, "joint_states", 10)
        self._images = self.create_publisher(Image, "camera/image", 10)
        self.create_subscription(
            JointTrajectory, "gantry/joint_trajectory", self._on_goal, 10
        )
        self.create_timer(0.01, self._tick)
        self.create_timer(0.05, self._show)

    def _on_goal(self, message) -> None:
        assert message.joint_names == ["gx", "gy"]
        [point] = message.points
        needed = point.time_from_start.sec + point.time_from_start.nanosec * 1e-9
        self.goals.append(tuple(point.positions))
        self._way = self.at, np.array(point.positions), time.monotonic(), needed

    def _tick(self) -> None:
        if self._way is not None:
            start, end, began, needed = self._way
            self.at = start + (end - start) * min(
                1.0, (time.monotonic() - began) / needed
            )
        message = JointState(name=["gy", "gx"], position=[self.at[1], self.at[0]])
        if self.is_heard:
            self._states.publish(message)

    def _show(self) -> None:
        stamp_ns = time.time_ns()
        self._simulated.move_to((*np.nan_to_num(self.at), 0.0))
        self._images.publish(
            fill(
                Image(),
                from_model.image(
                    self._simulated.image().pixels, "mono8", stamp_ns, "camera"
                ),
            )
        )


@pytest.fixture
def controller(graph, tmp_path):
    """Return the controller, spinning in a thread of its own, its cell and simulated machine."""
    plan = (
        PLAN.replace("marks: 3", "marks: 2")
        .replace("90, repeats: 2", "90")
        .replace("[1, 0], repeats: 2", "[1, 0]")
    )
    cell, simulated = write_cell(
        tmp_path,
        camera=True,
        plan=plan,
        simulation=(
            "plan: plan.yaml\nseed: 3\ntruth: {g: 2.0e-7, a: 2.0e-7, t: 5.0e-6, phi: 1.0e-3}\n"
            "cell: {servo_sigma: 0.0}\n"
        ),
    )
    context = rclpy.Context()
    rclpy.init(context=context)
    node = Controller(simulated, context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    thread = threading.Thread(target=executor.spin, daemon=True)
    thread.start()
    yield node, cell, simulated
    executor.shutdown()
    thread.join(10)
    node.destroy_node()
    context.try_shutdown()


KEYS = {
    "joints": ["gx", "gy"],
    "controller": "gantry",
    "image": "camera/image",
    "speed": 0.1,
}


def test_a_plan_is_measured_by_a_controller_to_its_true_map(controller, tmp_path):
    node, cell, simulated = controller
    machine = JointTrajectoryMachine(**KEYS, timeout=20.0)
    machine.place = simulated.place
    try:
        Run(
            read_plan(tmp_path / "plan.yaml"),
            cell,
            machine,
            tmp_path / "bag",
            Agreeing(),
        ).measure()
        before = len(node.goals)
        machine.stop()
        deadline = time.monotonic() + 20
        while len(node.goals) == before and time.monotonic() < deadline:
            machine.position()
        np.testing.assert_allclose(node.goals[-1], node.at, atol=1e-9)
    finally:
        machine.close()
    away, _ = away_from(simulated.truth, tmp_path / "bag")
    assert np.abs(away).max() < 5e-8


def test_a_position_that_is_no_number_is_not_commanded_at_a_stop(controller):
    node, _, _ = controller
    machine = JointTrajectoryMachine(**KEYS, timeout=20.0)
    node.at = np.array([np.nan, 0.0])
    try:
        while np.isfinite(machine.position()).all():
            pass
        with pytest.raises(MachineError, match=r"the position is .*nan"):
            machine.stop()
        assert not node.goals
    finally:
        machine.close()


def test_a_stop_does_not_lead_back_to_where_the_stage_was_last_heard_of(controller):
    node, _, _ = controller
    machine = JointTrajectoryMachine(**KEYS, timeout=0.5)
    try:
        machine.position()
        node.is_heard = False
        with pytest.raises(MachineError, match=r"joint_states: no message in 0\.5 s"):
            machine.stop()
        assert not node.goals
    finally:
        machine.close()


def test_a_stop_that_no_controller_hears_is_an_error(controller):
    node, _, _ = controller
    machine = JointTrajectoryMachine(**KEYS, timeout=2.0)
    for subscription in list(node.subscriptions):
        node.destroy_subscription(subscription)
    wait_until(lambda: not machine._trajectory.get_subscription_count(), "its end")
    try:
        with pytest.raises(MachineError, match="no controller listens"):
            machine.stop()
    finally:
        machine.close()


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({"controller": "other"}, "other/joint_trajectory: no controller listens"),
        ({"joints": ["gx", "gz"]}, "joint_states: no message in 1 s"),
        ({"joints": ["gx"]}, "1 joints"),
    ],
)
def test_what_is_not_there_is_named(controller, keys, said):
    with pytest.raises(MachineError, match=said):
        JointTrajectoryMachine(**KEYS | keys, timeout=1.0)
