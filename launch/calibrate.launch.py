# SPDX-License-Identifier: Apache-2.0
"""Collector, sequencer and solver of one cell: ros2 launch selfcal_ros calibrate.launch.py."""

import os
from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from selfcal_ros.nodes.launching import end_if_it_cannot_start

JOURNALS = str(Path(os.environ.get("ROS_HOME") or Path.home() / ".ros") / "selfcal_journals")


def generate_launch_description() -> LaunchDescription:
    share = Path(get_package_share_directory("selfcal_ros"))
    argument = LaunchConfiguration

    def node(name: str, *more: dict, **kwargs) -> Node:
        return Node(package="selfcal_ros", executable=name, name=name, output="screen",
                    namespace=argument("namespace"), parameters=[argument("params"), *more],
                    on_exit=end_if_it_cannot_start, **kwargs)

    return LaunchDescription([
        DeclareLaunchArgument("namespace", default_value="", description="namespace of the cell"),
        DeclareLaunchArgument("params", default_value=str(share / "config/params/cell.yaml"),
                              description="ROS parameter file for all nodes"),
        DeclareLaunchArgument("plan", default_value=str(share / "config/plans/resistant.yaml"),
                              description="PLAN.yaml with plate and views"),
        DeclareLaunchArgument("compensate", default_value="false",
                              description="publish corrected joint states as well"),
        DeclareLaunchArgument("journal", default_value=JOURNALS, description="folder for journals, "
                              "from which a collector that died goes on; '' = none"),
        node("measurement_collector", {"journal": ParameterValue(argument("journal"),
                                                                 value_type=str)}),
        node("solver"),
        node("pose_sequencer", {"plan": ParameterValue(argument("plan"), value_type=str)}),
        node("compensator", condition=IfCondition(argument("compensate"))),
    ])
