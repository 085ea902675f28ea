# SPDX-License-Identifier: Apache-2.0
"""mark_detector: the detections of `selfcal detect` bit for bit, nothing lost without a word."""

import numpy as np
import pytest
from rclpy.duration import Duration
from rclpy.serialization import deserialize_message

from selfcal_ros.bagio.images import ImageBag
from selfcal_ros.bagio.messages import from_model
from selfcal_ros.bagio.reader import BagReader
from selfcal_ros.bagio.writer import BagWriter
from selfcal_ros.cli.main import main
from selfcal_ros.nodes import names
from selfcal_ros.nodes.mark_detector import MarkDetectorNode
from selfcal_ros.nodes.sessions.health import Level
from selfcal_ros.simulation.rendering import Camera
from selfcal_ros.topics import DETECTION_TOPIC, IMAGE_TYPES
from test.support.cameras import DETECTS

CAMERA = Camera(width=160, height=120, dirt=0.3, turn_deg=25.0)
PARAMETERS = DETECTS | {"turn": 25.0}


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    """A bag of 30 images with two marks each, dirt here and there, the fifth of another size."""
    path, rng = tmp_path_factory.mktemp("images") / "bag", np.random.default_rng(3)
    with BagWriter(path) as writer:
        writer.add_topic("/stage/image", IMAGE_TYPES["raw"], [])
        for number in range(30):
            marks = np.array([[-6e-5, 7e-5], [0.0, 3e-5]]) + rng.uniform(
                -1e-5, 1e-5, (2, 1)
            )
            values = CAMERA.image(marks, rng)[: 100 if number == 4 else 120]
            writer.write(
                "/stage/image",
                from_model.image(values, "mono8", (number + 1) * 10**8, "camera"),
                (number + 1) * 10**8,
            )
    return path


def images(bag):
    kind = names.IMAGE_TYPES["raw"]
    return [
        deserialize_message(item.message.data, kind) for item in ImageBag(bag).items()
    ]


def offline(bag, output):
    options = ["--pixel-size", "2e-6", "--mark-size", "5e-5", "--turn", "25"]
    assert main(["detect", str(bag), "-o", str(output), *options]) == 0
    return [
        deserialize_message(data, names.DETECTIONS.type)
        for topic, _, data in BagReader(output).cdr_messages()
        if topic == DETECTION_TOPIC
    ]


@pytest.mark.parametrize("reliable", [True, False])
def test_the_node_finds_what_the_command_finds_bit_for_bit(
    graph, bag, tmp_path, reliable
):
    expected = offline(bag, tmp_path / "found")
    assert 40 < len(expected) < 58  # dirt costs some
    node = graph.node(MarkDetectorNode, **PARAMETERS)
    heard = graph.listen(names.DETECTIONS)
    publisher = graph.publisher(names.image_topics("raw", 100)[0 if reliable else 1])
    for number, image in enumerate(images(bag)):
        publisher.publish(image)
        graph.until(lambda number=number: _taken(node) > number, f"image {number}")
    graph.until(lambda: len(heard) == len(expected), "all detections")
    assert heard == expected
    refused = node.refusals.diagnosis()
    assert refused.level == Level.WARN
    assert "160 x 100 pixels, but earlier images have 160 x 120" in refused.message


def _taken(node) -> int:
    found = node.session.diagnosis().values
    return int(found["images"]) + int(found["images_refused"])


def test_images_that_wait_at_the_end_are_used(graph, bag, tmp_path):
    """They are published while nothing spins: the node takes them when it is deactivated."""
    expected = offline(bag, tmp_path / "found")
    node = graph.node(MarkDetectorNode, **PARAMETERS)
    heard = graph.listen(names.DETECTIONS)
    publisher = graph.publisher(names.image_topics("raw", 100)[0])
    for image in images(bag):
        publisher.publish(image)
    publisher.wait_for_all_acked(Duration(seconds=60))
    node.trigger_deactivate()
    assert _taken(node) == 30
    graph.until(lambda: len(heard) == len(expected), "all detections")
    assert heard == expected


def test_images_that_were_overwritten_are_counted(graph, bag):
    """Thirty images wait in a queue of five."""
    node = graph.node(MarkDetectorNode, **PARAMETERS, max_waiting=5)
    publisher = graph.publisher(names.image_topics("raw", 100)[0])
    first, *others = images(bag)
    publisher.publish(first)
    graph.until(lambda: _taken(node) == 1, "the first image")
    for image in others:
        publisher.publish(image)
    publisher.wait_for_all_acked(Duration(seconds=60))
    graph.until(
        lambda: _taken(node) + node.losses.counts["stage/image"] == 30, "all images"
    )
    assert node.losses.counts["stage/image"] >= 20
    assert "messages lost" in node.losses.diagnosis().message


def test_no_event_of_lost_images_is_taken(graph):
    """Taken while more are lost, it may lock the node for ever (rmw_fastrtps 890)."""
    node = graph.node(MarkDetectorNode, **PARAMETERS)
    graph.publisher(names.image_topics("raw", 100)[0])
    (found,) = (s for s in node.subscriptions if s.topic_name.endswith("/stage/image"))
    assert not found.event_handlers


def test_without_the_size_of_a_pixel_it_says_so(graph):
    with pytest.raises(Exception, match="pixel_size: is not set"):
        graph.node(MarkDetectorNode, mark_size=5e-5)
