# SPDX-License-Identifier: Apache-2.0
"""A simulated cell that runs a plan by itself, optionally recorded."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.conditions import IfCondition
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, NotEqualsSubstitution
from launch_ros.actions import Node


def generate_launch_description() -> LaunchDescription:
    share = Path(get_package_share_directory("selfcal_ros"))
    params = str(share / "config/params/simulated_cell.yaml")
    return LaunchDescription([
        DeclareLaunchArgument("namespace", default_value="", description="namespace of the cell"),
        DeclareLaunchArgument("bag", default_value="", description="folder to record to; "
                              "empty = do not record"),
        Node(package="selfcal_ros", executable="bag_recorder", name="bag_recorder",
             namespace=LaunchConfiguration("namespace"), output="screen",
             parameters=[{"bag": LaunchConfiguration("bag")}],
             condition=IfCondition(NotEqualsSubstitution(LaunchConfiguration("bag"), ""))),
        Node(package="selfcal_ros", executable="stage_simulator", name="stage_simulator",
             namespace=LaunchConfiguration("namespace"), output="screen", parameters=[params]),
        IncludeLaunchDescription(
            PythonLaunchDescriptionSource(str(share / "launch/calibrate.launch.py")),
            launch_arguments={"params": params,
                              "namespace": LaunchConfiguration("namespace")}.items()),
    ])
