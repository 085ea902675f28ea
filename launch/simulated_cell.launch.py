# SPDX-License-Identifier: Apache-2.0
"""A simulated cell that runs a plan by itself, optionally recorded by bag_recorder.

`ros2 bag record` alongside needs --qos-profile-overrides-path config/rosbag2/record_qos.yaml.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.conditions import IfCondition
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, NotEqualsSubstitution

from selfcal_ros.nodes.launching import (
    SHARED,
    arguments,
    journal_argument,
    node,
    share,
    text,
)


def generate_launch_description() -> LaunchDescription:
    return LaunchDescription(
        [
            *arguments("simulated_cell.yaml"),
            # separate from real runs: a simulated run must never continue with real readings
            journal_argument("selfcal_journals_simulated"),
            DeclareLaunchArgument(
                "bag",
                default_value="",
                description="folder to record to; empty = do not record",
            ),
            node(
                "bag_recorder",
                {"bag": text("bag")},
                condition=IfCondition(
                    NotEqualsSubstitution(LaunchConfiguration("bag"), "")
                ),
            ),
            DeclareLaunchArgument(
                "camera",
                default_value="",
                description="SIM.yaml with a camera: "
                "the cell publishes images, mark_detector finds the marks in them; "
                "empty = detections",
            ),
            node("stage_simulator", {"camera": text("camera")}),
            IncludeLaunchDescription(
                PythonLaunchDescriptionSource(
                    str(share() / "launch/calibrate.launch.py")
                ),
                launch_arguments={
                    **{
                        name: LaunchConfiguration(name) for name in (*SHARED, "journal")
                    },
                    "detect": NotEqualsSubstitution(LaunchConfiguration("camera"), ""),
                }.items(),
            ),
        ]
    )
