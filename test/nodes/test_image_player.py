# SPDX-License-Identifier: Apache-2.0
"""A bag of images played into mark_detector, collector and solver: the map of detect and solve."""

from pathlib import Path

import numpy as np
import pytest
from rclpy.serialization import deserialize_message

from selfcal_ros.bagio.offline import Playlist, collect_bag
from selfcal_ros.bagio.reader import BagReader
from selfcal_ros.cli.main import main
from selfcal_ros.collection.settings.nodes import CollectorSettings
from selfcal_ros.errors import ExitCode
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.nodes import names
from selfcal_ros.nodes.bag_player import BagPlayer
from selfcal_ros.nodes.mark_detector import MarkDetectorNode
from selfcal_ros.nodes.measurement_collector import MeasurementCollector
from selfcal_ros.nodes.player import WAITING_IMAGES
from selfcal_ros.nodes.solver import Solver
from test.cli.test_detect import compressed, rewritten

BAG = Path(__file__).parents[2] / "bags/camera"
DETECTS = {"pixel_size": 6e-6, "mark_size": 7.2e-5, "turn": 1.5}


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    """Return the bag of the detections that `selfcal detect` finds."""
    folder = tmp_path_factory.mktemp("found") / "bag"
    assert main(["detect", str(BAG), "-o", str(folder), "--pixel-size", "6e-6", "--mark-size",
                 "7.2e-5", "--turn", "1.5"]) == 0
    return folder


@pytest.mark.parametrize("options", [{"rate": 0.0}, {"rate": 5.0}, {"rate": 0.0, "seed": 3}],
                         ids=["fast", "at a rate", "shuffled"])
def test_images_that_are_played_give_the_map_of_detect_and_solve(graph, found, options):
    maps, solved = graph.listen(names.ERROR_MAP), graph.listen(
        names.of_node("solver", names.SOLVED))
    detector = graph.node(MarkDetectorNode, **DETECTS)
    collector = graph.node(MeasurementCollector)
    graph.node(Solver)
    player = graph.node(BagPlayer, bag=str(BAG), **options)
    most = []
    graph.until(lambda: most.append(player.player.sent["image"] - (
        player.player.taken or 0)) or player.finished.done(), "the end of the bag")
    assert player.exit_code == ExitCode.DONE
    assert player.player.sent["image"] == 100 and "detection" not in player.player.sent
    assert max(most) <= WAITING_IMAGES
    received = collector.session.collector.received
    graph.until(lambda: list(received.values()) == [
        player.player.sent["encoder"], 676, player.player.sent["command"]], "all detections")
    digest = collector._finish()
    graph.until(lambda: solved and solved[-1].data == digest and maps, "the map of all readings")
    assert not detector.losses.counts
    offline = calibrate(collect_bag(found, CollectorSettings.checked({}, "test"))[0]).error_map
    np.testing.assert_array_equal([maps[-1].gx, maps[-1].gy],
                                  [offline.gx.ravel(), offline.gy.ravel()])


def test_compressed_images_are_played_to_a_detector_alone(graph, tmp_path):
    rewritten(BAG, tmp_path / "bag", compressed)
    assert main(["detect", str(tmp_path / "bag"), "-o", str(tmp_path / "found"), "--pixel-size",
                 "6e-6", "--mark-size", "7.2e-5", "--turn", "1.5"]) == 0
    expected = [data for _, _, data in BagReader(tmp_path / "found").cdr_messages()]
    heard = graph.listen(names.DETECTIONS)
    graph.node(MarkDetectorNode, transport="compressed", **DETECTS)
    player = graph.node(BagPlayer, bag=str(tmp_path / "bag"), rate=0.0)
    graph.until(player.finished.done, "the end of the bag")
    graph.until(lambda: len(heard) >= len(expected) > 80, "all detections")
    assert heard == [deserialize_message(data, names.DETECTIONS.type) for data in expected]


def test_nothing_is_played_without_a_detector(graph):
    graph.node(MeasurementCollector)
    player = graph.node(BagPlayer, bag=str(BAG), rate=0.0, wait_for_subscribers=0.5)
    assert player.diagnosis().message == "waiting for /measurement_collector"
    graph.until(lambda: player.diagnosis().message == "waiting for /mark_detector"
                or player.finished.done(), "the collector")
    graph.until(player.finished.done, "the end of patience")
    assert player.exit_code == ExitCode.BAD_INPUT
    assert player.player.played == 0


def test_images_are_played_at_their_times_among_the_other_messages():
    playlist = Playlist(BAG, with_images=True)
    messages = list(playlist)
    assert len(messages) == len(playlist) == sum(playlist.counts.values())
    assert playlist.counts["stage/image"] == 100 and playlist.lost == []
    stamps = [stamp for _, stamp, _ in messages]
    assert stamps == sorted(stamps) and playlist._order is None
    kinds = [topic for topic, _, _ in messages]
    places = [index for index, topic in enumerate(kinds) if topic == "stage/image"]
    assert np.diff(places).min() > 1  # encoder samples in between


def test_detections_are_played_rather_than_images(found, tmp_path):
    """The bag of both: the images are those from which the detections were made."""
    both = tmp_path / "both"
    both.mkdir()
    for bag, name in ((BAG, "a"), (found, "b")):
        (both / f"{name}.mcap").write_bytes(next(Path(bag).glob("*.mcap")).read_bytes())
    playlist = Playlist(both, with_images=True)
    assert "stage/image" not in playlist.counts and playlist.counts["stage/mark_detections"] == 676
    assert "images on /stage/image are not played" in playlist.lost[-1]
