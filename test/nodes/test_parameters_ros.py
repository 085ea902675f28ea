# SPDX-License-Identifier: Apache-2.0
"""Parameters of the nodes: every one described and bounded, what is not known refused."""

from pathlib import Path

import pytest
import yaml
from rclpy.parameter import Parameter as RosParameter

from selfcal_ros.errors import InputError
from selfcal_ros.nodes.bag_player import BagPlayer
from selfcal_ros.nodes.bag_recorder import BagRecorder
from selfcal_ros.nodes.cell_driver import CellDriver
from selfcal_ros.nodes.compensator import CompensatorNode
from selfcal_ros.nodes.mark_detector import MarkDetectorNode
from selfcal_ros.nodes.measurement_collector import MeasurementCollector
from selfcal_ros.nodes.pose_sequencer import PoseSequencer
from selfcal_ros.nodes.solver import Solver
from selfcal_ros.nodes.stage_simulator import StageSimulator
from selfcal_ros.settings.nodes import NODE_PARAMETERS, overrides_in
from test.support.cameras import DETECTS
from test.support.sessions import plan_file, small_bag, small_plan

PARAMS = Path(__file__).parents[2] / "config" / "params"
NODES = {
    "measurement_collector": MeasurementCollector,
    "pose_sequencer": PoseSequencer,
    "solver": Solver,
    "compensator": CompensatorNode,
    "bag_player": BagPlayer,
    "mark_detector": MarkDetectorNode,
    "bag_recorder": BagRecorder,
    "cell_driver": CellDriver,
    "stage_simulator": StageSimulator,
}


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Return a bag, and the plan file beside it."""
    folder = tmp_path_factory.mktemp("files")
    return {"bag": str(small_bag(folder)), "plan": plan_file(folder, small_plan())}


@pytest.fixture
def needed(files, tmp_path):
    """Return the parameters without which a node cannot run."""
    return {
        "bag_player": {"bag": files["bag"]},
        "bag_recorder": {"bag": str(tmp_path / "recorded")},
        "mark_detector": DETECTS,
        "cell_driver": {"cell": str(PARAMS.parent / "cells/simulated.yaml")},
        "pose_sequencer": {"plan": files["plan"]},
    }


def test_the_table_covers_every_node():
    assert set(NODES) == set(NODE_PARAMETERS)


@pytest.mark.parametrize("name", NODES)
def test_every_parameter_is_described_bounded_and_has_its_default(graph, needed, name):
    node = graph.node(NODES[name], **needed.get(name, {}))
    for parameter in NODE_PARAMETERS[name]:
        found = node.describe_parameter(parameter.name)
        assert found.description.startswith(parameter.description)
        assert found.read_only
        for choice in parameter.choices:
            assert choice in found.additional_constraints
        ranges = [*found.floating_point_range, *found.integer_range]
        expected = [] if parameter.low is None else [(parameter.low, parameter.high)]
        assert [(r.from_value, r.to_value) for r in ranges] == expected
        if parameter.name not in needed.get(name, {}):
            assert node.get_parameter(parameter.name).value == parameter.default
    if name in ("bag_recorder", "cell_driver"):
        node.close()


@pytest.mark.parametrize("name", NODES)
def test_an_unknown_parameter_is_refused_with_the_known_names(graph, needed, name):
    first = NODE_PARAMETERS[name][0].name
    with pytest.raises(InputError) as caught:
        graph.node(NODES[name], misspelt=1, **needed.get(name, {}))
    message = str(caught.value)
    assert message.startswith(
        f"parameters of {name}: misspelt: {name} has no such parameter"
    )
    assert first in message


@pytest.mark.parametrize(
    "value, problem",
    [
        (-1.0, "-1.0 is outside 0.0 to 3600.0 s"),
        ("soon", "'soon' is not of type float"),
    ],
)
def test_a_value_that_cannot_be_is_refused(graph, value, problem):
    with pytest.raises(
        InputError, match=f"parameters of pose_sequencer: settle_time: {problem}"
    ):
        graph.node(PoseSequencer, settle_time=value)


def test_a_whole_number_is_taken_where_a_number_is_wanted(graph):
    """`settle_time: 2` in a file means 2.0, for the nodes as for `selfcal solve --params`."""
    node = graph.node(PoseSequencer, settle_time=2)
    assert node.get_parameter("settle_time").value == 2.0
    assert node.get_parameter("settle_time").type_ is RosParameter.Type.DOUBLE


@pytest.mark.parametrize(
    "namespace, name", [*(("/", name) for name in NODES), ("/cell1", "pose_sequencer")]
)
@pytest.mark.parametrize(
    "file", sorted(PARAMS.glob("*.yaml")), ids=lambda path: path.name
)
def test_every_node_takes_the_shipped_parameter_files(
    graph, needed, file, name, namespace
):
    """As ROS reads them: a bare y is true, and `name:` does not hold in a namespace."""
    stated = overrides_in(yaml.safe_load(file.read_text()), name, str(file))
    given = {
        key: value for key, value in needed.get(name, {}).items() if not stated.get(key)
    }
    more = [word for key, value in given.items() for word in ("-p", f"{key}:={value}")]
    node = graph.add(
        NODES[name](
            context=graph.context,
            namespace=namespace,
            cli_args=["--ros-args", "--params-file", str(file), *more],
        )
    )
    for key in stated.keys() - given.keys():
        assert node.get_parameter(key).value == stated[key]
    if name in ("bag_recorder", "cell_driver"):
        node.close()


def test_a_word_that_the_file_makes_a_bool_is_refused_with_the_mend(graph, tmp_path):
    file = tmp_path / "cell.yaml"
    file.write_text("measurement_collector: {ros__parameters: {joint_x: y}}")
    with pytest.raises(
        InputError, match="joint_x: True is not of type str; put it in quotes"
    ):
        MeasurementCollector(
            context=graph.context, cli_args=["--ros-args", "--params-file", str(file)]
        )


def test_a_dump_of_all_parameters_is_a_file_that_a_node_takes(graph, tmp_path):
    """As `ros2 param dump` writes it: a joint called y comes out bare, and ROS reads it as true."""
    first = graph.node(MeasurementCollector, max_speed=0.25)
    told = {
        name: parameter.value
        for name, parameter in first.get_parameters_by_prefix("").items()
    }
    file = tmp_path / "dump.yaml"
    file.write_text(
        yaml.dump({"/**": {"ros__parameters": told}}, default_flow_style=False)
    )
    assert "joint_y: y\n" in file.read_text()
    second = graph.add(
        MeasurementCollector(
            context=graph.context, cli_args=["--ros-args", "--params-file", str(file)]
        )
    )
    assert {name: second.get_parameter(name).value for name in told} == told


@pytest.mark.parametrize("name, value", [("settle_time", 2.0), ("use_sim_time", True)])
def test_a_parameter_cannot_be_changed_while_the_node_runs(graph, name, value):
    node = graph.node(PoseSequencer)
    [answer] = node.set_parameters([RosParameter(name, value=value)])
    assert not answer.successful
    assert "read-only" in answer.reason


@pytest.mark.parametrize("make", [BagPlayer, BagRecorder])
def test_a_bag_must_be_named(graph, make):
    with pytest.raises(InputError, match="no bag is named; set the parameter 'bag'"):
        graph.node(make)
