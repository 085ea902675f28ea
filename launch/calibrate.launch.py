# SPDX-License-Identifier: Apache-2.0
"""Collector, sequencer and solver of one cell: ros2 launch selfcal_ros calibrate.launch.py."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PythonExpression

from selfcal_ros.nodes.launching import arguments, foxglove, journal_argument, node, text


def generate_launch_description() -> LaunchDescription:
    return LaunchDescription([
        *arguments("cell.yaml"),
        journal_argument("selfcal_journals"),
        # choices, as launch leaves nodes running that it started before a wrong condition
        DeclareLaunchArgument("compensate", default_value="false", choices=["true", "false"],
                              description="publish corrected joint states as well"),
        DeclareLaunchArgument("detect", default_value="false", choices=["true", "false"],
                              description="find marks in stage/image as well"),
        node("mark_detector", condition=IfCondition(LaunchConfiguration("detect"))),
        DeclareLaunchArgument("cell", default_value="", description="CELL.yaml of the machine that "
                              "cell_driver drives; empty = a cell of your own"),
        node("cell_driver", {"cell": text("cell")}, condition=IfCondition(
            PythonExpression(["'", LaunchConfiguration("cell"), "' != ''"]))),
        node("measurement_collector", {"journal": text("journal")}),
        node("solver"),
        node("pose_sequencer", {"plan": text("plan")}),
        node("compensator", condition=IfCondition(LaunchConfiguration("compensate"))),
        foxglove(),
    ])
