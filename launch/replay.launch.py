# SPDX-License-Identifier: Apache-2.0
"""A bag replayed into live nodes: ros2 launch selfcal_ros replay.launch.py bag:=FOLDER."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from selfcal_ros.nodes.launching import end_if_it_cannot_start


def generate_launch_description() -> LaunchDescription:
    share = Path(get_package_share_directory("selfcal_ros"))
    return LaunchDescription([
        DeclareLaunchArgument("bag", description="MCAP file or rosbag2 folder"),
        DeclareLaunchArgument("rate", default_value="1.0",
                              description="speed; 0 = as fast as the nodes keep up"),
        DeclareLaunchArgument("namespace", default_value="", description="namespace of the cell"),
        DeclareLaunchArgument("params", default_value=str(share / "config/params/cell.yaml"),
                              description="ROS parameter file for all nodes"),
        DeclareLaunchArgument("plan", default_value=str(share / "config/plans/resistant.yaml"),
                              description="PLAN.yaml of a run that follows the bag; the bag's own "
                              "commands are followed as they are"),
        IncludeLaunchDescription(
            PythonLaunchDescriptionSource(str(share / "launch/calibrate.launch.py")),
            launch_arguments={
                **{name: LaunchConfiguration(name) for name in ("params", "plan", "namespace")},
                "journal": ""}.items()),  # there is a bag already
        Node(package="selfcal_ros", executable="bag_player", name="bag_player", output="screen",
             namespace=LaunchConfiguration("namespace"), on_exit=end_if_it_cannot_start,
             parameters=[LaunchConfiguration("params"), {
                          "bag": ParameterValue(LaunchConfiguration("bag"), value_type=str),
                          "rate": ParameterValue(LaunchConfiguration("rate"), value_type=float)}]),
    ])
