# SPDX-License-Identifier: Apache-2.0
"""A bag replayed into live nodes: ros2 launch selfcal_ros replay.launch.py bag:=FOLDER.

The plan is for a run after the bag; the bag's own commands are followed as they are.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration
from launch_ros.parameter_descriptions import ParameterValue

from selfcal_ros.nodes.launching import SHARED, arguments, node, share, text


def generate_launch_description() -> LaunchDescription:
    return LaunchDescription(
        [
            *arguments("cell.yaml"),
            DeclareLaunchArgument("bag", description="MCAP file or rosbag2 folder"),
            DeclareLaunchArgument(
                "rate",
                default_value="1.0",
                description="speed; 0 = as fast as the nodes can follow",
            ),
            IncludeLaunchDescription(
                PythonLaunchDescriptionSource(
                    str(share() / "launch/calibrate.launch.py")
                ),
                launch_arguments={
                    **{name: LaunchConfiguration(name) for name in SHARED},
                    "journal": "none",
                }.items(),
            ),  # there is a bag already
            node(
                "bag_player",
                {
                    "bag": text("bag"),
                    "rate": ParameterValue(
                        LaunchConfiguration("rate"), value_type=float
                    ),
                },
            ),
        ]
    )
