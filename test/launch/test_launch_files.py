# SPDX-License-Identifier: Apache-2.0
"""The launch files: they load, state their arguments, and start executables that exist."""

from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
FILES = sorted((ROOT / "launch").glob("*.launch.py"))
SHARED = {"namespace", "params", "plan", "use_sim_time", "log_level", "foxglove"}
ARGUMENTS = {
    "calibrate.launch.py": SHARED | {"cell", "compensate", "detect", "journal"},
    "replay.launch.py": SHARED | {"bag", "rate"},
    "simulated_cell.launch.py": SHARED | {"bag", "camera", "journal"},
}
STARTED = {
    "calibrate.launch.py": {
        "measurement_collector",
        "solver",
        "pose_sequencer",
        "compensator",
        "mark_detector",
        "cell_driver",
        "foxglove_bridge",
    },
    "replay.launch.py": {"bag_player"},
    "simulated_cell.launch.py": {"bag_recorder", "stage_simulator"},
}


@pytest.fixture
def description():
    """Return a function that loads a launch file with the real launch package."""
    pytest.importorskip("launch.actions", reason="needs the launch package of ROS 2")
    pytest.importorskip("launch_ros.actions", reason="needs launch_ros")
    packages = pytest.importorskip("ament_index_python.packages")
    try:
        packages.get_package_share_directory("selfcal_ros")
    except (OSError, KeyError):  # no ROS environment, or the package is not in it
        pytest.skip("selfcal_ros is not installed in this ROS 2 environment")

    def load(path: Path):
        spec = spec_from_file_location(path.name.replace(".", "_"), path)
        module = module_from_spec(spec)
        spec.loader.exec_module(module)
        return module.generate_launch_description()

    return load


def test_every_launch_file_is_known_here():
    assert [path.name for path in FILES] == sorted(ARGUMENTS) == sorted(STARTED)


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_it_states_its_arguments(description, path):
    from launch.actions import DeclareLaunchArgument

    stated = [
        entity
        for entity in description(path).entities
        if isinstance(entity, DeclareLaunchArgument)
    ]
    assert {argument.name for argument in stated} == ARGUMENTS[path.name]
    assert all(argument.description for argument in stated)


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_it_starts_executables_of_this_package(description, path):
    from launch_ros.actions import Node

    from selfcal_ros.settings.nodes import NODE_PARAMETERS

    nodes = [
        entity for entity in description(path).entities if isinstance(entity, Node)
    ]
    assert {node.node_executable for node in nodes} == STARTED[path.name]
    assert {node.node_executable for node in nodes} <= {
        *NODE_PARAMETERS,
        "foxglove_bridge",
    }
    assert {node.node_package for node in nodes} <= {"selfcal_ros", "foxglove_bridge"}


def test_shipped_files_that_are_defaults_exist(description):
    from launch import LaunchContext
    from launch.actions import DeclareLaunchArgument
    from launch.utilities import perform_substitutions

    for path in FILES:
        for entity in description(path).entities:
            if isinstance(entity, DeclareLaunchArgument) and entity.default_value:
                value = perform_substitutions(LaunchContext(), entity.default_value)
                # made when it is needed, apart for what is simulated
                if entity.name == "journal":
                    simulated = path.name == "simulated_cell.launch.py"
                    assert value.endswith("_simulated") == simulated
                    continue
                assert not value.startswith("/") or Path(value).is_file(), value


def parameters_of(description, **given: str) -> list[dict]:
    """Return the parameters by name that each node of the launch files is given."""
    from launch import LaunchContext
    from launch_ros.actions import Node
    from launch_ros.utilities import evaluate_parameters

    # other with a cell
    once = {"measurement_collector", "pose_sequencer", "cell_driver"}
    found = []
    for path in FILES:
        context = LaunchContext()
        context.launch_configurations.update(
            {argument: "" for arguments in ARGUMENTS.values() for argument in arguments}
            | {"rate": "1.0", "use_sim_time": "false"}
            | given
        )
        for entity in description(path).entities:
            if (
                isinstance(entity, Node)
                and entity.node_package == "selfcal_ros"
                and not (
                    entity.node_executable in once
                    and entity.condition
                    and not entity.condition.evaluate(context)
                )
            ):
                rows = [
                    row for row in entity._Node__parameters if isinstance(row, dict)
                ]
                found.append(
                    {
                        key: value
                        for row in evaluate_parameters(context, rows)
                        for key, value in row.items()
                    }
                )
    return found


@pytest.mark.parametrize("name", ["bag", "plan"])
def test_a_name_like_a_date_or_a_number_stays_text(description, name):
    told = {
        row[name]
        for row in parameters_of(description, **{name: "2026_01_05"})
        if name in row
    }
    assert told == {"2026_01_05"}


def test_simulated_time_is_for_every_node(description):
    rows = parameters_of(description, use_sim_time="true")
    assert len(rows) == sum(
        len(nodes - {"foxglove_bridge", "cell_driver"}) for nodes in STARTED.values()
    )
    assert all(row["use_sim_time"] is True for row in rows)


@pytest.mark.parametrize(
    ("sense", "placing"), [("plate_moves", "person"), ("microscope_moves", "robot")]
)
def test_collector_and_sequencer_are_told_what_the_cell_states(
    description, tmp_path, sense, placing
):
    cell = tmp_path / "cell.yaml"
    cell.write_text(
        f"machine: simulated\nsimulated: {{simulation: sim.yaml}}\nsense: {sense}\n"
        f"placing: {placing}\nlimits: {{x: [-1, 1], y: [-1, 1], theta: [-7, 7]}}\n"
    )
    rows = parameters_of(description, cell=str(cell))
    assert [row["cell"] for row in rows if "cell" in row] == [str(cell)]
    assert [row["measurement_sense"] for row in rows if "measurement_sense" in row] == [
        sense
    ]
    assert [row["auto_confirm"] for row in rows if "auto_confirm" in row] == [
        placing == "robot"
    ]
    assert not any(
        {"measurement_sense", "auto_confirm"} & row.keys()
        for row in parameters_of(description)
    )
