# SPDX-License-Identifier: Apache-2.0
"""For `launch_test`: the simulated cell runs a plan to its end, and ends when it is told to.

``launch_test test/launch/whole_calibration.py plan:=PLAN.yaml params:=PARAMS.yaml``, with
``camera:=SIM.yaml`` and ``namespace:=NAME`` as well.
"""

import time
import unittest
from pathlib import Path

import launch_testing.actions
import launch_testing.asserts
import rclpy
from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration

PATIENCE_S = 180.0
ARGUMENTS = {"plan": None, "params": None, "camera": "", "namespace": ""}


def generate_test_description() -> LaunchDescription:
    share = Path(get_package_share_directory("selfcal_ros"))
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, default_value=value)
                for name, value in ARGUMENTS.items()
            ),
            IncludeLaunchDescription(
                PythonLaunchDescriptionSource(
                    str(share / "launch/simulated_cell.launch.py")
                ),
                launch_arguments={
                    name: LaunchConfiguration(name) for name in ARGUMENTS
                }.items(),
            ),
            launch_testing.actions.ReadyToTest(),
        ]
    )


class TestCalibration(unittest.TestCase):
    """Beside the running cell."""

    def setUp(self):
        rclpy.init()
        self.node = rclpy.create_node(
            "onlooker", namespace=self.test_args.get("namespace", "")
        )

    def tearDown(self):
        self.node.destroy_node()
        rclpy.shutdown()

    def test_the_map_of_the_whole_plan_is_published(self):
        from selfcal_ros.nodes import names

        heard = {}
        for topic in (names.SUMMARY, names.ERROR_MAP):
            self.node.create_subscription(
                topic.type,
                topic.name,
                lambda message, name=topic.name: heard.update({name: message}),
                topic.qos,
            )
        deadline = time.monotonic() + PATIENCE_S
        summary = error_map = None
        # they come on two topics: the map perhaps after its summary
        while not (self.is_done(summary) and error_map and all(error_map.valid)):
            assert time.monotonic() < deadline, (
                f"the plan was not measured in time: {heard}"
            )
            rclpy.spin_once(self.node, timeout_sec=0.1)
            summary = heard.get(names.SUMMARY.name)
            error_map = heard.get(names.ERROR_MAP.name)
        assert summary.identifiable, summary
        assert error_map.run_id == summary.run_id != ""
        assert 0.0 < summary.rms_uncertainty_um < 0.1 < summary.max_error_um

    @staticmethod
    def is_done(summary) -> bool:
        return summary is not None and 0 < summary.views_planned == summary.views_done


@launch_testing.post_shutdown_test()
class TestEnd(unittest.TestCase):
    """After the launch was told to end."""

    def test_every_node_ends_with_code_0(self, proc_info):
        launch_testing.asserts.assertExitCodes(proc_info)
