# SPDX-License-Identifier: Apache-2.0
"""A simulated cell that runs a plan by itself, optionally recorded by bag_recorder.

`ros2 bag record` beside it wants --qos-profile-overrides-path config/rosbag2/record_qos.yaml.
"""

import os
from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.conditions import IfCondition
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, NotEqualsSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from selfcal_ros.nodes.launching import end_if_it_cannot_start

# apart from those of real runs: a simulated run that was left must never go on with real readings
JOURNALS = str(Path(os.environ.get("ROS_HOME") or Path.home() / ".ros")
               / "selfcal_journals_simulated")


def generate_launch_description() -> LaunchDescription:
    share = Path(get_package_share_directory("selfcal_ros"))
    argument = LaunchConfiguration

    def node(name: str, **kwargs) -> Node:
        return Node(package="selfcal_ros", executable=name, name=name, output="screen",
                    namespace=argument("namespace"), on_exit=end_if_it_cannot_start, **kwargs)

    return LaunchDescription([
        DeclareLaunchArgument("namespace", default_value="", description="namespace of the cell"),
        DeclareLaunchArgument("bag", default_value="", description="folder to record to; "
                              "empty = do not record"),
        DeclareLaunchArgument("params", default_value=str(
            share / "config/params/simulated_cell.yaml"), description="ROS parameter file for "
            "all nodes"),
        DeclareLaunchArgument("plan", default_value=str(share / "config/plans/resistant.yaml"),
                              description="PLAN.yaml with plate and views"),
        DeclareLaunchArgument("journal", default_value=JOURNALS, description="folder for the "
                              "journals of simulated runs; '' = none"),
        node("bag_recorder", parameters=[{"bag": ParameterValue(argument("bag"),
                                                                value_type=str)}],
             condition=IfCondition(NotEqualsSubstitution(argument("bag"), ""))),
        node("stage_simulator", parameters=[argument("params")]),
        IncludeLaunchDescription(
            PythonLaunchDescriptionSource(str(share / "launch/calibrate.launch.py")),
            launch_arguments={name: argument(name)
                              for name in ("params", "plan", "namespace", "journal")}.items()),
    ])
