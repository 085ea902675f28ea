# SPDX-License-Identifier: Apache-2.0
"""The bytes of shipped bags, republished as `ros2 bag play` does, give their maps."""

import pytest
from mcap.reader import make_reader

from selfcal_ros.bagio.messages import to_model
from selfcal_ros.nodes import names
from selfcal_ros.nodes.measurement_collector import MeasurementCollector
from selfcal_ros.nodes.pose_sequencer import PoseSequencer
from selfcal_ros.nodes.solver import Solver
from test.support.shipped import BAGS, MANIFEST, require_map

TOGETHER = 300
"""Messages published before the nodes have taken those before them."""
GRADES = {"not_qualified": 0, "enlarged": 1, "good": 2}


def republish(graph, name, taken):
    """Publish the bytes of a bag as they are; `taken` counts the messages that were received."""
    publishers, sent = {}, 0
    topics = {f"/{topic.name}": topic for topic in names.INPUTS}
    with (BAGS / name / f"{name}_0.mcap").open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            if channel.topic not in publishers:
                publishers[channel.topic] = graph.publisher(topics[channel.topic])
            publishers[channel.topic].publish(message.data)
            sent += 1
            if sent % TOGETHER == 0:
                graph.until(
                    lambda due=sent: taken() >= due, "the nodes to take what came"
                )
    graph.until(lambda: taken() >= sent, "the nodes to take everything")


@pytest.mark.parametrize("name", ["hu_noise", "fig10_faults", "deficient"])
def test_the_bytes_of_a_bag_give_what_the_manifest_says(graph, name):
    maps, summaries = graph.listen(names.ERROR_MAP), graph.listen(names.SUMMARY)
    solved = graph.listen(names.of_node("solver", names.SOLVED))
    collector = graph.node(MeasurementCollector)
    for node in (PoseSequencer, Solver):
        graph.node(node)
    expected = MANIFEST[name]["expected"]
    received = collector.session.collector.received
    republish(graph, name, lambda: sum(received.values()))
    digest = collector._finish()
    graph.until(
        lambda: solved and solved[-1].data == digest, "a solution of all readings"
    )
    graph.until(
        lambda: summaries and summaries[-1].identifiable == expected["identifiable"],
        "its summary",
    )
    if not expected["identifiable"]:
        assert not maps and summaries[-1].rank_deficiency == expected["deficiency"]
        return
    graph.until(lambda: maps and maps[-1].header == summaries[-1].header, "its map")
    assert maps[-1].grade == summaries[-1].grade == GRADES[expected["grade"]]
    require_map(name, to_model.error_map(maps[-1]))
