# SPDX-License-Identifier: Apache-2.0
"""A bag of images played into mark_detector, collector and solver: the map of detect and solve."""

from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from mcap.reader import make_reader
from rclpy.serialization import deserialize_message

from selfcal_ros.bagio.offline import BagSession, Playlist, collect_bag
from selfcal_ros.bagio.reader import BagReader
from selfcal_ros.bagio.writer import BagWriter
from selfcal_ros.cli import replay as replay_verb
from selfcal_ros.cli.main import main
from selfcal_ros.errors import ExitCode
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.files import read_json, read_yaml
from selfcal_ros.nodes import names
from selfcal_ros.nodes.bag_player import BagPlayer
from selfcal_ros.nodes.mark_detector import MarkDetectorNode
from selfcal_ros.nodes.measurement_collector import MeasurementCollector
from selfcal_ros.nodes.player import WAITING_IMAGES
from selfcal_ros.nodes.solver import Solver
from selfcal_ros.settings.detector import DetectorSettings
from selfcal_ros.settings.nodes import CollectorSettings
from test.cli.test_detect import compressed, rewritten
from test.support.sessions import small_bag, small_plan
from test.support.verbs import simulate

BAG = Path(__file__).parents[2] / "bags/camera"
DETECTS = {"pixel_size": 6e-6, "mark_size": 7.2e-5, "turn": 1.5}


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    """Return the bag of the detections that `selfcal detect` finds."""
    folder = tmp_path_factory.mktemp("found") / "bag"
    assert (
        main(
            [
                "detect",
                str(BAG),
                "-o",
                str(folder),
                "--pixel-size",
                "6e-6",
                "--mark-size",
                "7.2e-5",
                "--turn",
                "1.5",
            ]
        )
        == 0
    )
    return folder


def test_images_that_are_played_give_the_map_of_detect_and_solve(graph, found):
    maps, solved = (
        graph.listen(names.ERROR_MAP),
        graph.listen(names.of_node("solver", names.SOLVED)),
    )
    detector = graph.node(MarkDetectorNode, **DETECTS)
    collector = graph.node(MeasurementCollector)
    graph.node(Solver)
    player = graph.node(BagPlayer, bag=str(BAG), rate=0.0, seed=3)
    most = []
    graph.until(
        lambda: (
            most.append(player.player.sent["image"] - (player.player.taken or 0))
            or player.finished.done()
        ),
        "the end of the bag",
    )
    assert player.exit_code == ExitCode.DONE
    assert player.player.sent["image"] == 100 and "detection" not in player.player.sent
    assert max(most) <= WAITING_IMAGES
    received = collector.session.collector.received
    graph.until(
        lambda: (
            list(received.values())
            == [player.player.sent["encoder"], 676, player.player.sent["command"]]
        ),
        "all detections",
    )
    digest = collector._finish()
    graph.until(
        lambda: solved and solved[-1].data == digest and maps, "the map of all readings"
    )
    assert not detector.losses.counts
    offline = calibrate(
        collect_bag(found, CollectorSettings.checked({}, "test"))[0]
    ).error_map
    np.testing.assert_array_equal(
        [maps[-1].gx, maps[-1].gy], [offline.gx.ravel(), offline.gy.ravel()]
    )


def test_compressed_images_are_played_to_a_detector_alone(graph, tmp_path):
    rewritten(BAG, tmp_path / "bag", compressed)
    assert (
        main(
            [
                "detect",
                str(tmp_path / "bag"),
                "-o",
                str(tmp_path / "found"),
                "--pixel-size",
                "6e-6",
                "--mark-size",
                "7.2e-5",
                "--turn",
                "1.5",
            ]
        )
        == 0
    )
    expected = [data for _, _, data in BagReader(tmp_path / "found").cdr_messages()]
    heard = graph.listen(names.DETECTIONS)
    graph.node(MarkDetectorNode, transport="compressed", **DETECTS)
    player = graph.node(BagPlayer, bag=str(tmp_path / "bag"), rate=0.0)
    graph.until(player.finished.done, "the end of the bag")
    graph.until(lambda: len(heard) >= len(expected) > 80, "all detections")
    assert heard == [
        deserialize_message(data, names.DETECTIONS.type) for data in expected
    ]


def test_nothing_is_played_without_a_detector(graph):
    graph.node(MeasurementCollector)
    player = graph.node(BagPlayer, bag=str(BAG), rate=0.0, wait_for_subscribers=0.5)
    assert player.diagnosis().message == "waiting for /measurement_collector"
    graph.until(
        lambda: (
            player.diagnosis().message == "waiting for /mark_detector"
            or player.finished.done()
        ),
        "the collector",
    )
    graph.until(player.finished.done, "the end of patience")
    assert player.exit_code == ExitCode.BAD_INPUT
    assert player.player.played == 0


def test_images_are_played_at_their_times_among_the_other_messages():
    playlist = Playlist(BAG)
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
    playlist = Playlist(both)
    assert (
        "stage/image" not in playlist.counts
        and playlist.counts["stage/mark_detections"] == 676
    )
    assert "images on /stage/image are not played" in playlist.lost[-1]


PARAMS = """
/**/mark_detector: {ros__parameters: {pixel_size: 5.0e-6, mark_size: 7.2e-5, turn: 1.5}}
/**/measurement_collector: {ros__parameters: {outlier_limit: 7.0}}
"""


def of_two_cells(folder):
    """Write the bag of images as of two cells, one in the namespace cell2; return its folder."""
    with BagWriter(folder) as writer, next(BAG.glob("*.mcap")).open("rb") as file:
        known = set()
        for schema, channel, message in make_reader(file).iter_messages():
            for topic in (channel.topic, f"/cell2{channel.topic}"):
                if topic not in known:
                    writer.add_topic(topic, schema.name, [])
                    known.add(topic)
                writer.write_raw(topic, message.data, message.log_time)
    return folder


def test_processes_give_the_result_of_detect_and_solve_bit_for_bit(
    ros_environment, found, tmp_path, capfd
):
    """Options win over the parameter file: one pixel size in it is wrong."""
    params, replayed, solved = (
        tmp_path / name for name in ("p.yaml", "replayed", "solved")
    )
    params.write_text(PARAMS)
    bag, common = (
        of_two_cells(tmp_path / "bag"),
        ["--params", str(params), "--quiet", "-o"],
    )
    assert (
        main(
            [
                "replay",
                str(bag),
                "--namespace",
                "cell2",
                "--fast",
                "--pixel-size",
                "6e-6",
                *common,
                str(replayed),
            ]
        )
        == 0
    )
    assert main(["solve", str(found), *common, str(solved)]) == 0
    said = capfd.readouterr()
    assert "ERROR" not in said.out + said.err
    assert "Traceback" not in said.out + said.err
    replayed, solved = read_json(replayed), read_json(solved)
    assert replayed.pop("input")["file"] == "bag"
    assert solved.pop("input")["file"] == "bag"
    for result in (replayed, solved):
        del result["digest"]["input"]
        result["provenance"].pop("created")
    assert replayed == solved


def test_the_detector_of_a_replay_gets_all_its_parameters(monkeypatch, tmp_path):
    """How images reach it is not what the file says of a live cell."""
    rewritten(BAG, tmp_path / "bag", compressed, "cell2/")
    params, started = tmp_path / "p.yaml", {}
    params.write_text(
        "mark_detector: {ros__parameters: {pixel_size: 6.0e-6, mark_size: 7.2e-5, "
        "max_waiting: 1, autostart: false, max_blur: 0.2}}"
    )

    @contextmanager
    def process(module, given, *_, **__):
        started[module.removeprefix("selfcal_ros.nodes.")] = given
        if module.endswith("mark_detector"):
            started["file"] = read_yaml(given[given.index("--params-file") + 1])
        yield SimpleNamespace(stdout=[], wait=lambda: 4)

    monkeypatch.setattr(replay_verb, "process", process)
    assert (
        main(
            [
                "replay",
                str(tmp_path / "bag"),
                "--namespace",
                "cell2",
                "--params",
                str(params),
                "--turn",
                "1.5",
                "--mirror",
            ]
        )
        == 4
    )
    values = started["file"]["mark_detector"]["ros__parameters"]
    assert values == DetectorSettings.checked(values, "test").__dict__
    told = {
        "pixel_size": 6e-6,
        "mark_size": 7.2e-5,
        "turn": 1.5,
        "mirror": True,
        "max_blur": 0.2,
        "transport": "compressed",
        "max_waiting": 32,
        "autostart": True,
    }
    assert {name: values[name] for name in told} == told
    assert list(started) == [
        "mark_detector",
        "file",
        *replay_verb.NODES,
        "replay_session",
    ]


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        (
            [],
            "has images and no detections: --pixel-size and --mark-size: are not "
            "set; give them in m; `selfcal camera init` finds the size of a pixel",
        ),
        (
            ["--pixel-size", "6e-6"],
            "has images and no detections: --mark-size: is not set; give it in m",
        ),
        (
            ["--pixel-size", "6e-6", "--mark-size", "7.2e-6"],
            "--mark-size: 1.2 pixels; a mark has 6 to 2000 pixels",
        ),
    ],
)
def test_replay_of_images_says_which_options_are_missing(options, problem, capsys):
    assert main(["replay", str(BAG), *options]) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert line.startswith(f"selfcal replay: {BAG} ") and problem in line


def test_options_for_images_are_refused_where_none_are_played(found, capsys):
    assert main(["replay", str(found), "--mark-size", "7.2e-5"]) == 2
    assert capsys.readouterr().err == (
        f"selfcal replay: --mark-size: no images of {found} are played; leave it out; it is for "
        "bags with images and no detections\n"
    )


def test_no_image_is_played_before_the_detections_are_heard(graph, monkeypatch):
    """The detector is connected to the collector last: detections until then would be lost."""
    node = graph.node(MarkDetectorNode, **DETECTS)
    count, connected = node._detections.get_subscription_count, []
    monkeypatch.setattr(
        node._detections, "get_subscription_count", lambda: count() if connected else 0
    )
    node._tell_taken()
    graph.node(MeasurementCollector)
    player = graph.node(BagPlayer, bag=str(BAG), rate=0.0)
    graph.until(
        lambda: (
            player.player.taken is not None
            and player.player.unheard() == [names.DETECTIONS.name]
            and count()
        ),
        "all but the connection",
    )
    assert player.player.played == 0
    connected.append(True)
    graph.until(lambda: player.player.played > 0, "the first message")


@pytest.mark.parametrize(
    ("mark", "ends", "fault", "code", "line"),
    [
        ("5e-5", 3, "", 3, ""),
        (
            "5e-5",
            3,
            "view 'b': the plate lies otherwise",
            2,
            "view 'b': the plate lies otherwise",
        ),
        ("5e-4", 4, "", 4, "no dark disc of 250 px was found; what repeats is 25 px"),
    ],
)
def test_the_code_of_images_is_that_of_detect_and_solve(
    monkeypatch, tmp_path, capsys, mark, ends, fault, code, line
):
    """The nodes find a plan not identified, or no mark; what the images show tells why."""
    simulate(
        tmp_path,
        "images",
        {
            "plan_id": "p",
            "artifact": {"grid_size": 3, "grid_pitch": 0.01, "angular_count": 0},
            "views": [
                {"name": "a", "repeats": 1},
                {"name": "b", "rotation_deg": 90, "repeats": 1},
            ],
        },
        camera={},
        truth={"g": 2e-7, "a": 2e-7, "t": 1e-6, "phi": 1e-5},
    )
    unidentified = tmp_path / "unidentified.json"
    assert (
        main(
            [
                "solve",
                str(small_bag(tmp_path, small_plan("0, 90"))),
                "--quiet",
                "-o",
                str(unidentified),
            ]
        )
        == 3
    )
    capsys.readouterr()

    @contextmanager
    def process(module, given, *_, **__):
        if module.endswith("replay_session") and ends == 3:
            Path(given[2]).write_bytes(unidentified.read_bytes())
        yield SimpleNamespace(stdout=[], wait=lambda: ends)

    def collected(bag, *_, **__):
        assert Playlist(Path(bag)).counts["stage/mark_detections"] >= 18
        return BagSession(None, {}, [], [fault] if fault else [])

    monkeypatch.setattr(replay_verb, "process", process)
    monkeypatch.setattr(replay_verb, "collect_bag", collected)
    assert (
        main(
            [
                "replay",
                str(tmp_path / "images"),
                "--fast",
                "--pixel-size",
                "2e-6",
                "--mark-size",
                mark,
            ]
        )
        == code
    )
    said = capsys.readouterr().err
    assert line in said and said.count("\n") == bool(line)
