# SPDX-License-Identifier: Apache-2.0
"""The `ros2` lines of README and docs name what the real nodes have on the graph."""

import importlib
import re
import shlex

import pytest
import yaml

from selfcal_ros.nodes.compensator import CompensatorNode
from selfcal_ros.nodes.measurement_collector import MeasurementCollector
from selfcal_ros.nodes.pose_sequencer import PoseSequencer
from selfcal_ros.nodes.solver import Solver
from test.support.pages import ROOT, lines_of
from test.support.sessions import plan_file, small_plan

CHECKED = {
    "run",
    "launch",
    "topic",
    "service",
    "action",
    "lifecycle",
    "param",
    "interface",
    "bag",
}
NOT_HERE = {"security", "pkg", "control"}
"""What is not of the graph: the tools of SROS2 and ros2_control, the index of packages."""
OPTIONS = re.compile(r"^--?[a-z]")


def lines(verb: str) -> list[list[str]]:
    """Return the words after `ros2 VERB` of every line that says what to do it with."""
    split = [shlex.split(line)[1:] for line in lines_of("ros2")]
    return [words[1:] for words in split if words[0] == verb and len(words) > 2]


def plain(words: list[str]) -> list[str]:
    return [word for word in words if not OPTIONS.match(word)]


def interface(name: str) -> type:
    package, kind, of = name.split("/")
    return getattr(importlib.import_module(f"{package}.{kind}"), of)


def test_every_verb_is_known_here():
    assert {line.split()[1] for line in lines_of("ros2")} <= CHECKED | NOT_HERE


def test_executables_exist():
    text = (ROOT / "setup.py").read_text()
    found = {words[1] for words in lines("run") if words[1].islower()}
    assert {"selfcal", "solver"} <= found
    for name in found:
        assert re.search(rf'"{name}( =|")|\b{name}\b', text), name


def test_launch_files_have_the_arguments_that_are_given():
    assert len(lines("launch")) >= 4
    for package, name, *arguments in lines("launch"):
        assert package == "selfcal_ros"
        text = (ROOT / "launch" / name).read_text()
        for path in (
            "selfcal_ros/nodes/launching.py",
            *re.findall(r"launch/\w+\.launch\.py", text),
        ):
            text += (
                ROOT / path
            ).read_text()  # an included file's arguments may be given, too
        for argument in arguments:
            assert re.search(rf'rgument\(\s*"{argument.partition(":=")[0]}"', text), (
                argument
            )


@pytest.fixture
def cell(graph, tmp_path):
    """Return a graph with the nodes of a cell."""
    graph.node(MeasurementCollector)
    graph.node(Solver)
    graph.node(PoseSequencer, plan=plan_file(tmp_path, small_plan()))
    graph.node(CompensatorNode)
    return graph


def test_topics_services_and_actions_exist_with_their_types(cell):
    services = [plain(words[1:]) for words in lines("service")]
    topics = [plain(words[1:])[-1] for words in lines("topic")]
    actions = [plain(words[1:]) for words in lines("action")]
    wanted_services = {(name, of) for name, of, *_ in services} | {
        (f"{name}/_action/send_goal", f"{of}_SendGoal") for name, of, *_ in actions
    }
    assert len(wanted_services) >= 5
    assert topics
    hand = cell.hand
    cell.until(
        lambda: (
            wanted_services
            <= {
                (name, of)
                for name, types in hand.get_service_names_and_types()
                for of in types
            }
        ),
        f"{wanted_services}",
    )
    cell.until(
        lambda: set(topics) <= {name for name, _ in hand.get_topic_names_and_types()},
        f"{topics}",
    )
    for _, of, *request in services:
        fields = yaml.safe_load(request[0]) if request else {}
        assert interface(of).Request(**fields)
    for _, of, goal in actions:
        assert interface(of).Goal(**yaml.safe_load(goal))


def test_nodes_transitions_and_interfaces_exist(cell):
    nodes = {f"/{node.get_name()}": node for node in cell.nodes}
    for _, name, transition in lines("lifecycle"):
        assert hasattr(nodes[name], f"trigger_{transition}")
    for _, of in lines("interface"):
        assert interface(of)


def test_what_is_recorded_are_the_topics_of_a_bag():
    from selfcal_ros.topics import INPUT_TOPICS

    recorded = next(
        words for words in lines("bag") if words[0] == "record" and len(words) > 4
    )
    assert {
        word[1:]
        for word in plain(recorded)
        if word.startswith("/") and word != "/tmp/session"
    } == set(INPUT_TOPICS)
    for words in lines("bag"):
        for word in words:
            if word.startswith(("config/", "bags/")):
                assert (ROOT / word).exists()
