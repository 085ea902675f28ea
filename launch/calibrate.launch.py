# SPDX-License-Identifier: Apache-2.0
"""Collector, sequencer and solver of one cell: ros2 launch selfcal_ros calibrate.launch.py."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition, UnlessCondition
from launch.substitutions import LaunchConfiguration, PythonExpression
from launch_ros.parameter_descriptions import ParameterValue

from selfcal_ros.nodes.launching import (
    OfCell,
    arguments,
    foxglove,
    journal_argument,
    node,
    text,
)

HAS_CELL = PythonExpression(["'", LaunchConfiguration("cell"), "' != ''"])
JOURNAL, PLAN = {"journal": text("journal")}, {"plan": text("plan")}
SENSE = {"measurement_sense": OfCell(lambda cell: str(cell.sense))}
"""A map with the other sense has the other sign: the cell knows it, whatever `params` says."""
PLACING = {
    "auto_confirm": ParameterValue(
        OfCell(lambda cell: str(cell.placing == "robot")), value_type=bool
    )
}


def generate_launch_description() -> LaunchDescription:
    return LaunchDescription(
        [
            *arguments("cell.yaml"),
            journal_argument("selfcal_journals"),
            # choices, as launch leaves nodes running that it started before a wrong condition
            DeclareLaunchArgument(
                "compensate",
                default_value="false",
                choices=["true", "false"],
                description="publish corrected joint states as well",
            ),
            DeclareLaunchArgument(
                "detect",
                default_value="false",
                choices=["true", "false"],
                description="find marks in stage/image as well",
            ),
            node("mark_detector", condition=IfCondition(LaunchConfiguration("detect"))),
            DeclareLaunchArgument(
                "cell",
                default_value="",
                description="CELL.yaml of the machine that "
                "cell_driver drives; empty = a cell of your own",
            ),
            node(
                "cell_driver", {"cell": text("cell")}, condition=IfCondition(HAS_CELL)
            ),
            node(
                "measurement_collector", JOURNAL, SENSE, condition=IfCondition(HAS_CELL)
            ),
            node("measurement_collector", JOURNAL, condition=UnlessCondition(HAS_CELL)),
            node("solver"),
            node("pose_sequencer", PLAN, PLACING, condition=IfCondition(HAS_CELL)),
            node("pose_sequencer", PLAN, condition=UnlessCondition(HAS_CELL)),
            node(
                "compensator", condition=IfCondition(LaunchConfiguration("compensate"))
            ),
            foxglove(),
        ]
    )
