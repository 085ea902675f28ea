# SPDX-License-Identifier: Apache-2.0
"""The SROS2 policy grants each node what it does on the graph, and nothing else."""

import contextlib
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

from selfcal_ros.nodes import names
from selfcal_ros.nodes.bag_player import BagPlayer
from selfcal_ros.nodes.bag_recorder import BagRecorder
from selfcal_ros.nodes.cell_driver import CellDriver
from selfcal_ros.nodes.compensator import CompensatorNode
from selfcal_ros.nodes.mark_detector import MarkDetectorNode
from selfcal_ros.nodes.measurement_collector import MeasurementCollector
from selfcal_ros.nodes.monitor_session import MonitorSession
from selfcal_ros.nodes.pose_sequencer import PoseSequencer
from selfcal_ros.nodes.solver import Solver
from selfcal_ros.nodes.stage_simulator import StageSimulator
from test.support.cameras import DETECTS, camera
from test.support.sessions import plan_file, small_bag, small_plan

POLICY = ElementTree.parse(
    Path(__file__).parents[2] / "config/sros2/policy.xml"
).getroot()
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
SIMULATED_CELL = Path(__file__).parents[2] / "config/cells/simulated.yaml"
KINDS = (
    ("topics", "publish"),
    ("topics", "subscribe"),
    ("services", "reply"),
    ("services", "request"),
    ("actions", "execute"),
)


def granted(node: str) -> dict[tuple[str, str], set[str]]:
    """Return (kind, right) -> full names that the policy grants a node in the root namespace."""
    [profile] = [p for p in POLICY.iter("profile") if p.get("node") == node]
    rights: dict = {kind: set() for kind in KINDS}
    for group in profile:
        for kind, right in KINDS:
            if group.tag == kind and group.get(right) == "ALLOW":
                rights[kind, right] |= {full(entry.text, node) for entry in group}
    return rights


def full(name: str, node: str) -> str:
    return f"/{node}/{name[2:]}" if name.startswith("~/") else f"/{name.lstrip('/')}"


def used(graph, node: str) -> dict[tuple[str, str], set[str]]:
    """Return (kind, right) -> full names that a node really uses."""
    hand = graph.hand

    def of(list_by_node, **kwargs) -> set[str]:
        return {name for name, _ in list_by_node(node, "/", **kwargs)}

    found = {
        ("topics", "publish"): of(hand.get_publisher_names_and_types_by_node),
        ("topics", "subscribe"): of(hand.get_subscriber_names_and_types_by_node),
        ("services", "reply"): of(hand.get_service_names_and_types_by_node),
        ("services", "request"): of(hand.get_client_names_and_types_by_node),
    }
    actions = {
        name.partition("/_action/")[0]
        for names_ in found.values()
        for name in names_
        if "/_action/" in name
    }
    found = {
        kind: {name for name in names_ if "/_action/" not in name}
        for kind, names_ in found.items()
    }
    found["topics", "subscribe"] |= {"/clock"}  # with use_sim_time
    if node == "mark_detector":  # with transport compressed
        found["topics", "subscribe"] |= {"/stage/image/compressed"}
    if node == "bag_player":  # with images for detections
        found["topics", "publish"] |= {"/stage/image", "/stage/image/compressed"}
        found["topics", "subscribe"] |= {"/mark_detector/received"}
    return found | {("actions", "execute"): actions}


@pytest.mark.parametrize("name", NODES)
def test_a_node_is_granted_what_it_does_and_nothing_else(graph, tmp_path, name):
    parameters = {
        "bag_player": {"bag": str(small_bag(tmp_path)), "rate": 0.001},
        "bag_recorder": {"bag": str(tmp_path / "new")},
        "mark_detector": DETECTS,
        "cell_driver": {"cell": str(SIMULATED_CELL)},
        "pose_sequencer": {"plan": plan_file(tmp_path, small_plan())},
    }
    graph.hand.create_publisher(
        names.ENCODER.type, names.ENCODER.name, names.ENCODER.qos
    )
    camera(graph)
    node = graph.node(NODES[name], **parameters.get(name, {}))
    wanted = granted(name)
    with contextlib.suppress(AssertionError):
        graph.until(lambda: used(graph, name) == wanted, name)
    assert used(graph, name) == wanted  # tells what is one too many, or too few
    getattr(node, "close", lambda: None)()


def test_the_monitor_is_granted_what_it_does_and_nothing_else(graph):
    from selfcal_ros.nodes import monitor_session

    class Monitor(MonitorSession):
        def __init__(self, **kwargs):
            super().__init__("", **kwargs)

        def _listen(self):
            """Leave stdin alone."""

    assert monitor_session.REQUESTS
    node = graph.add(Monitor(context=graph.context))
    wanted = granted("monitor")
    own = node.get_name()

    def done() -> dict:
        return {
            kind: {name.replace(f"/{own}/", "/monitor/") for name in names_}
            for kind, names_ in used(graph, own).items()
        }

    graph.until(lambda: done() == wanted, f"granted {wanted}, used {done()}")


def test_each_node_has_an_enclave_of_its_own():
    paths = {
        enclave.get("path"): [p.get("node") for p in enclave.iter("profile")]
        for enclave in POLICY.iter("enclave")
    }
    assert paths == {f"/selfcal/{node}": [node] for node in (*NODES, "monitor")}
