# SPDX-License-Identifier: Apache-2.0
"""compensator: corrected positions, by a map from the graph or from a file."""

import json
import math
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node
from selfcal_msgs.srv import Correct

from selfcal_ros.bagio.messages import from_model
from selfcal_ros.compensation.compensator import Compensator
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.result import result_to_dict
from selfcal_ros.nodes import compensator, names
from selfcal_ros.nodes.compensator import KEPT, CompensatorNode
from selfcal_ros.nodes.filling import fill
from selfcal_ros.nodes.sessions.compensating import KEEPS_UP
from test.support.maps import random_map, result_of
from test.support.waiting import PATIENCE_S

MAP, OTHER = (random_map(Artifact(5, 0.01, 8), seed) for seed in (3, 4))
BENCH = Path(__file__).parents[1] / "bench" / "compensate.py"
PLACES = [
    (0.0, 0.0, 0.0),
    (0.0123, -0.0071, 0.4),
    (0.02, 0.02, 3.0),
    (0.09, -0.09, -1.0),
]


def summary():
    return fill(
        names.SUMMARY.type(),
        {
            "header": from_model.header(1, "stage"),
            "qualified": True,
            "views_done": 4,
            "views_planned": 4,
        },
    )


def latch_map(graph, error_map=MAP) -> None:
    publisher = graph.hand.create_publisher(
        names.ERROR_MAP.type, names.ERROR_MAP.name, names.ERROR_MAP.qos
    )
    publisher.publish(
        fill(
            names.ERROR_MAP.type(),
            from_model.error_map(result_of(error_map), 1, "stage"),
        )
    )
    summaries = graph.hand.create_publisher(
        names.SUMMARY.type, names.SUMMARY.name, names.SUMMARY.qos
    )
    summaries.publish(summary())


def map_file(folder) -> str:
    path = folder / "map.json"
    path.write_text(json.dumps(result_to_dict(result_of(MAP))))
    return str(path)


def sample(*position: float, name=("x", "y", "theta")):
    return names.ENCODER.type(
        name=list(name), position=list(position), velocity=[0.5] * len(position)
    )


def correct(graph, messages: list) -> list:
    """Publish samples until each has been answered, and return the answers."""
    heard = graph.listen(names.CORRECTED)
    publisher = graph.publisher(names.ENCODER)
    for index, message in enumerate(messages):
        message.header.stamp.sec = index + 1
        publisher.publish(message)
        graph.until(lambda index=index: len(heard) > index, f"answer {index}")
    return heard


@pytest.mark.parametrize("interpolation", ["bilinear", "bicubic"])
def test_each_sample_comes_back_with_the_stage_error_taken_off(
    graph, tmp_path, interpolation
):
    graph.node(CompensatorNode, map=map_file(tmp_path), interpolation=interpolation)
    reference = Compensator(MAP, method=interpolation, outside="clamp")
    for place, answer in zip(
        PLACES, correct(graph, [sample(*p) for p in PLACES]), strict=True
    ):
        x, y = reference.correct(place[0], place[1])
        assert list(answer.position) == [x, y, reference.correct_theta(place[2])]
        assert list(answer.velocity) == [0.5, 0.5, 0.5]


def test_the_error_is_taken_off_not_added(graph, tmp_path):
    """At a true position p the stage indicates p + G(p); the answer must be p."""
    graph.node(CompensatorNode, map=map_file(tmp_path))
    i, j = 3, 1
    p = np.array([(i - 2) * 0.01, (j - 2) * 0.01])
    indicated = p + np.array([MAP.gx[i, j], MAP.gy[i, j]])
    [answer] = correct(graph, [sample(*indicated, 0.0)])
    np.testing.assert_allclose(answer.position[:2], p, rtol=0, atol=1e-15)


def test_a_map_that_was_published_before_the_node_started_is_used(graph):
    latch_map(graph)
    node = graph.node(CompensatorNode)
    graph.until(lambda: node.session.compensator is not None, "the latched map")
    [answer] = correct(graph, [sample(0.01, 0.0, 0.0)])
    assert answer.position[0] == Compensator(MAP).correct(0.01, 0.0)[0]


def test_joints_are_found_by_name_and_others_pass_unchanged(graph, tmp_path):
    graph.node(
        CompensatorNode, map=map_file(tmp_path), joint_x="stage_x", joint_y="stage_y"
    )
    [answer] = correct(
        graph, [sample(7.0, 0.01, 0.005, name=("z", "stage_y", "stage_x"))]
    )
    x, y = Compensator(MAP).correct(0.005, 0.01)
    assert list(answer.position) == [7.0, y, x]


def test_every_command_comes_back_in_order_with_the_error_added(graph, tmp_path):
    graph.node(CompensatorNode, map=map_file(tmp_path))
    heard, publisher = (
        graph.listen(names.CORRECTED_MOTION),
        graph.publisher(names.MOTION),
    )
    count = 3 * KEEPS_UP  # more than the newest of the samples
    for number in range(count):
        message = sample(0.0001 * number, 0.005, 0.4)
        message.header.stamp.nanosec = number
        publisher.publish(message)
    graph.until(lambda: len(heard) == count, "all of them")
    reference = Compensator(MAP)
    for number, answer in enumerate(heard):
        assert answer.header.stamp.nanosec == number
        x, y = reference.command(0.0001 * number, 0.005)
        assert list(answer.position) == [x, y, reference.command_theta(0.4)]


def test_the_service_answers_with_commands_their_u_and_the_way_back(graph, tmp_path):
    node = graph.node(CompensatorNode)
    none = graph.call(Correct, "compensator/correct", x=[0.01], y=[0.0])
    assert (none.success, none.error_code) == (False, 2) and not len(none.x)
    assert none.message.startswith(
        "compensator: no error map yet; calibrate, or name one"
    )
    node.session._load_file(map_file(tmp_path))
    there = graph.call(Correct, "compensator/correct", x=[0.01, -0.013], y=[0.0, 0.004])
    assert there.success and there.message.endswith("map.json, plan demo")
    x, y = Compensator(MAP).command([0.01, -0.013], [0.0, 0.004])
    assert (list(there.x), list(there.y), list(there.theta)) == (list(x), list(y), [])
    u_x, u_y = Compensator(MAP).uncertainty([0.01, -0.013], [0.0, 0.004])
    assert (list(there.u_x), list(there.u_y)) == (list(u_x), list(u_y))
    back = graph.call(
        Correct, "compensator/correct", x=there.x, y=there.y, inverse=True
    )
    np.testing.assert_allclose(back.x, [0.01, -0.013], rtol=0, atol=1e-15)


@pytest.mark.parametrize("count", [KEEPS_UP + 40, 3 * names.ENCODER_NEWEST.qos.depth])
def test_after_a_standstill_the_newest_sample_comes_first(graph, tmp_path, count):
    """Nothing runs while these are published; of the larger number most are displaced."""
    node = graph.node(CompensatorNode, map=map_file(tmp_path))
    heard, publisher = graph.listen(names.CORRECTED), graph.publisher(names.ENCODER)
    # with the number that the others are counted from
    publisher.publish(sample(0.0, 0.0, 0.0))
    graph.until(lambda: len(heard) == 1, "the first answer")
    for number in range(1, count + 1):
        message = sample(0.01, 0.0, 0.0)
        message.header.stamp.nanosec = number
        publisher.publish(message)
    graph.until(lambda: node.session.counts["skipped"] == count - 1, "all of them")
    graph.until(lambda: len(heard) == 2, "the answer")
    assert heard[1].header.stamp.nanosec == count
    publisher.publish(sample(0.02, 0.0, 0.0))
    graph.until(lambda: len(heard) == 3, "the answer to one that comes alone")
    assert node.session.counts == {
        "corrected": 3,
        "without_map": 0,
        "refused": 0,
        "skipped": count - 1,
        "commands": 0,
        "commands_refused": 0,
        "outside": 0,
    }


@pytest.mark.usefixtures("quick_beat")
def test_what_is_not_corrected_is_counted_and_not_published(graph, tmp_path):
    node = graph.node(CompensatorNode, map=map_file(tmp_path), outside="refuse")
    heard, said = graph.listen(names.CORRECTED), []
    graph.hand.create_subscription(DiagnosticArray, "/diagnostics", said.append, 10)
    publisher = graph.publisher(names.ENCODER)
    publisher.publish(sample(0.5, 0.0, 0.0))
    publisher.publish(sample(name=("x", "y")))
    publisher.publish(sample(0.0, 0.0, 0.0))
    graph.until(lambda: len(heard) == 1, "the good sample")
    wanted = {"corrected": "1", "without_map": "0", "refused": "2"}
    graph.until(
        lambda: (
            said
            and wanted.items()
            <= {v.key: v.value for v in said[-1].status[0].values}.items()
        ),
        "the counts",
    )
    assert node.get_name() == "compensator"


@pytest.mark.usefixtures("quick_beat")
def test_places_beside_unknown_sites_and_no_numbers_are_refused(graph):
    graph.node(CompensatorNode)
    latch_map(graph, random_map(Artifact(5, 0.01, 8), 3, unknown=[(2, 2)]))
    said: list = []
    graph.hand.create_subscription(DiagnosticArray, "/diagnostics", said.append, 10)
    graph.until(
        lambda: (
            said
            and said[-1].status[0].message.startswith("correcting by the map of plan ")
        ),
        "the map",
    )
    heard, publisher = graph.listen(names.CORRECTED), graph.publisher(names.ENCODER)
    for place in ((0.002, 0.002, 0.0), (math.nan, 0.0, 0.0), (0.0, 0.0, math.inf)):
        publisher.publish(sample(*place))
    publisher.publish(sample(0.015, 0.015, 0.0))
    graph.until(lambda: heard, "the good sample")
    assert heard[0].position[0] == pytest.approx(0.015, abs=1e-5)
    graph.until(
        lambda: {v.key: v.value for v in said[-1].status[0].values}["refused"] == "3",
        "the counts",
    )


@pytest.mark.usefixtures("quick_beat")
def test_without_a_map_the_state_is_a_warning(graph):
    graph.node(CompensatorNode)
    said: list = []
    graph.hand.create_subscription(DiagnosticArray, "/diagnostics", said.append, 10)
    graph.until(lambda: said, "diagnostics")
    status = said[0].status[0]
    assert (status.level, status.message) == (b"\x01", "no error map yet")


@pytest.mark.usefixtures("quick_beat")
def test_a_second_publisher_of_maps_is_named(graph):
    graph.node(CompensatorNode)
    said: list = []
    graph.hand.create_subscription(DiagnosticArray, "/diagnostics", said.append, 10)
    for _ in range(2):
        latch_map(graph)
    line = "selfcal/error_map has 2 publishers: /hand, /hand; only one is allowed"
    graph.until(lambda: said and line in said[-1].status[0].message, "the warning")
    assert said[-1].status[0].level == b"\x01"


def publish_map(graph, by, error_map, stamp_ns: int) -> None:
    """Publish a map and its summary by a node."""
    summary = {
        "header": from_model.header(stamp_ns, "stage"),
        "qualified": True,
        "views_done": 4,
        "views_planned": 4,
    }
    for topic, fields in (
        (
            names.ERROR_MAP,
            from_model.error_map(result_of(error_map), stamp_ns, "stage"),
        ),
        (names.SUMMARY, summary),
    ):
        publisher = by.create_publisher(topic.type, topic.name, topic.qos)
        publisher.publish(fill(topic.type(), fields))


@pytest.mark.usefixtures("quick_beat")
@pytest.mark.parametrize("leaves", ["intruder", "solver"])
def test_a_map_of_a_second_node_is_not_used_until_one_is_left(graph, leaves):
    node = graph.node(CompensatorNode)
    others = {
        name: Node(name, context=graph.context) for name in ("solver", "intruder")
    }
    for other in others.values():
        graph.add(other)
    heard: list = []
    graph.hand.create_subscription(DiagnosticArray, "/diagnostics", heard.append, 10)
    publish_map(graph, others["solver"], MAP, 1)
    graph.until(lambda: node.session.compensator is not None, "the map of the solver")
    first = node.session.compensator
    publish_map(graph, others["intruder"], OTHER, 2)
    graph.until(
        lambda: any(
            KEPT in status.message
            and status.level == b"\x01"
            and "2 publishers: /intruder, /solver" in status.message
            for array in heard
            for status in array.status
        ),
        "the warning",
    )
    graph.until(lambda: node.refusals.counts[names.ERROR_MAP.name] > 0, "the refusal")
    graph.remove(others[leaves])
    kept = {"intruder": MAP, "solver": OTHER}[leaves]
    graph.until(
        lambda: node.session.compensator is not first, "the latched map of who is left"
    )
    assert node.session.compensator.correct(0.01, 0.0) == Compensator(kept).correct(
        0.01, 0.0
    )


def test_of_two_nodes_that_were_there_before_no_map_is_used(graph):
    others = [Node(name, context=graph.context) for name in ("solver", "intruder")]
    for number, (other, error_map) in enumerate(zip(others, (MAP, OTHER), strict=True)):
        graph.add(other)
        publish_map(graph, other, error_map, number + 1)
    node = graph.node(CompensatorNode)
    graph.until(lambda: node.refusals.counts[names.ERROR_MAP.name] > 0, "the refusal")
    assert node.session.compensator is None


def test_a_node_that_begins_waits_until_others_have_been_found(graph, monkeypatch):
    monkeypatch.setattr(compensator, "ALONE_S", 0.0)
    monkeypatch.setattr(compensator, "FOUND_S", 0.5)
    latch_map(graph)
    begun_s = time.monotonic()
    node = graph.node(CompensatorNode)
    graph.until(lambda: node.session.compensator is not None, "the latched map")
    assert time.monotonic() - begun_s >= 0.5


def test_a_map_that_waits_when_a_second_node_is_found_is_counted(graph, monkeypatch):
    monkeypatch.setattr(compensator, "ALONE_S", PATIENCE_S)
    monkeypatch.setattr(names, "rivals", lambda node, topics: "")
    node = graph.node(CompensatorNode)
    latch_map(graph)
    graph.until(lambda: len(node._maps._waiting) == 2, "map and summary")
    monkeypatch.setattr(names, "rivals", lambda node, topics: "two nodes publish")
    graph.until(lambda: node.refusals.counts[names.ERROR_MAP.name] == 1, "the refusal")
    assert node.refusals.counts[names.SUMMARY.name] == 1 and not node._maps._waiting
    assert node.session.compensator is None


def test_many_summaries_take_no_map_away_and_the_oldest_are_counted(graph, monkeypatch):
    monkeypatch.setattr(compensator, "ALONE_S", PATIENCE_S)
    node = graph.node(CompensatorNode)
    latch_map(graph)
    graph.until(lambda: len(node._maps._waiting) == 2, "map and summary")
    summaries, more = graph.publisher(names.SUMMARY), compensator.MOST_WAITING + 2
    for number in range(1, more + 1):
        summaries.publish(summary())
        graph.until(
            lambda number=number: (
                node.refusals.counts[names.SUMMARY.name] + len(node._maps._waiting)
                == number + 2
            ),
            f"summary {number}",
        )
    assert node.refusals.counts[names.SUMMARY.name] == 3
    assert [topic for _, topic, _ in node._maps._waiting].count(
        names.ERROR_MAP.name
    ) == 1
    monkeypatch.setattr(compensator, "ALONE_S", 0.0)
    graph.until(lambda: node.session.compensator is not None, "the map")


def test_a_malformed_map_does_not_end_the_node(graph):
    node = graph.node(CompensatorNode)
    publisher = graph.publisher(names.ERROR_MAP)
    publisher.publish(names.ERROR_MAP.type(grid_size=5, grid_pitch=0.01, gx=[0.0] * 3))
    latch_map(graph)
    graph.until(lambda: node.session.compensator is not None, "the good map")


def test_the_bench_takes_corrected_samples(ros_environment):
    done = subprocess.run(
        [sys.executable, BENCH, "--worker", "selfcal", "100", "--seconds", "0.2"],
        capture_output=True,
        text=True,
        check=True,
        timeout=PATIENCE_S,
    )
    row = json.loads(done.stdout)
    assert (row["benchmark"], row["method"], row["n"]) == (
        "compensate 100 Hz",
        "selfcal",
        20,
    )
    assert row["corrected"] > 0
    assert row["max_error"] < 1e-12
