# SPDX-License-Identifier: Apache-2.0
"""Shared by the launch files: arguments, nodes, and an end with the reason if one cannot start."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ament_index_python.packages import (
    get_package_share_directory,
    get_packages_with_prefixes,
)
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.conditions import IfCondition
from launch.launch_context import LaunchContext
from launch.substitution import Substitution
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from selfcal_ros.errors import ExitCode, InputError
from selfcal_ros.machine.cell import Cell, read_cell

SHARED = ("namespace", "params", "plan", "use_sim_time", "log_level", "foxglove")
"""Arguments of all launch files."""


def share() -> Path:
    """Return the folder of the installed configurations and launch files."""
    return Path(get_package_share_directory("selfcal_ros"))


def arguments(params: str) -> list[Any]:
    """Return the declarations of the `SHARED` arguments, and the check of their files.

    Parameters
    ----------
    params : str
        Name of the parameter file that is the default.
    """
    argument = DeclareLaunchArgument
    return [
        argument("namespace", default_value="", description="namespace of the cell"),
        argument(
            "params",
            default_value=str(share() / "config/params" / params),
            description="ROS parameter file for all nodes",
        ),
        argument(
            "plan",
            default_value=str(share() / "config/plans/resistant.yaml"),
            description="PLAN.yaml with plate and views",
        ),
        argument(
            "use_sim_time",
            default_value="false",
            choices=["true", "false"],
            description="take time from /clock, as of a simulator or `ros2 bag play --clock`",
        ),
        argument(
            "log_level",
            default_value="info",
            choices=["debug", "info", "warn", "error", "fatal"],
            description="lowest level that nodes log",
        ),
        argument(
            "foxglove",
            default_value="false",
            choices=["true", "false"],
            description="also start foxglove_bridge, port 8765 (package foxglove_bridge)",
        ),
        OpaqueFunction(function=refuse_wrong),
    ]


def journal_argument(folder: str) -> DeclareLaunchArgument:
    """Return the declaration of `journal`, which is `folder` below ROS_HOME by default."""
    home = Path(os.environ.get("ROS_HOME") or Path.home() / ".ros")
    return DeclareLaunchArgument(
        "journal",
        default_value=str(home / folder),
        description="folder for journals, from which "
        "a restarted collector continues; none = no journal",
    )


def refuse_wrong(context: LaunchContext) -> None:
    """End the launch before a node starts if parameter file or foxglove_bridge is missing.

    Or if `rate` is not a number. launch_ros ignores the first, and on the others leaves the nodes
    running that it had started.
    """
    configurations = context.launch_configurations
    try:
        float(configurations.get("rate", "1"))
    except ValueError:
        raise InputError(
            f"rate:={configurations['rate']}",
            "not a number",
            "give the speed; 0 = as fast as the nodes can follow",
        ) from None
    if not Path(configurations["params"]).is_file():
        raise InputError(
            f"params:={configurations['params']}", "no such file", "check the path"
        )
    if (
        configurations["foxglove"] == "true"
        and "foxglove_bridge" not in get_packages_with_prefixes()
    ):
        raise InputError(
            "foxglove:=true",
            "there is no package foxglove_bridge",
            "sudo apt install ros-jazzy-foxglove-bridge",
        )


def text(name: str) -> ParameterValue:
    """Return a launch argument as a string, however YAML would interpret it."""
    return ParameterValue(LaunchConfiguration(name), value_type=str)


class OfCell(Substitution):
    """What the CELL.yaml of the launch argument ``cell`` states.

    Parameters
    ----------
    of : callable (cell)
        Returns it as text.
    """

    def __init__(self, of: Callable[[Cell], str]) -> None:
        super().__init__()
        self._of = of

    def perform(self, context: LaunchContext) -> str:
        """Read the file, and return it."""
        return self._of(read_cell(context.launch_configurations["cell"]))


def node(name: str, *parameters: Any, **kwargs: Any) -> Node:
    """Return the action that starts a node of this package with the shared arguments."""
    simulated = ParameterValue(LaunchConfiguration("use_sim_time"), value_type=bool)
    return Node(
        package="selfcal_ros",
        executable=name,
        name=name,
        output="screen",
        namespace=LaunchConfiguration("namespace"),
        parameters=[
            LaunchConfiguration("params"),
            *parameters,
            {"use_sim_time": simulated},
        ],
        ros_arguments=["--log-level", LaunchConfiguration("log_level")],
        on_exit=end_if_it_cannot_start,
        **kwargs,
    )


def foxglove() -> Node:
    """Return the action that starts foxglove_bridge if requested."""
    return Node(
        package="foxglove_bridge",
        executable="foxglove_bridge",
        output="screen",
        condition=IfCondition(LaunchConfiguration("foxglove")),
    )


def end_if_it_cannot_start(event: Any, _context: Any) -> None:
    """End the launch with code 1 if a node ended because of bad parameters or input.

    A node that ends later, or by a signal, ends alone: it can be restarted without the others.

    Parameters
    ----------
    event : launch.events.process.ProcessExited
        The exit.
    _context : launch.LaunchContext
        Not needed.
    """
    if event.returncode == int(ExitCode.BAD_INPUT):
        raise InputError(
            event.process_name, "cannot start", "its last line above says why"
        )
