# SPDX-License-Identifier: Apache-2.0
"""bag_player and bag_recorder: what one plays the other writes, all of it."""

import time
from collections import Counter
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import yaml
from mcap.reader import make_reader
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data

from selfcal_ros.bagio.offline import collect_bag
from selfcal_ros.bagio.reader import BagReader
from selfcal_ros.errors import ExitCode, InputError, NoDataError
from selfcal_ros.model.readings import readings_digest
from selfcal_ros.nodes import names, player
from selfcal_ros.nodes.bag_player import BagPlayer
from selfcal_ros.nodes.bag_recorder import BagRecorder
from selfcal_ros.nodes.measurement_collector import MeasurementCollector
from selfcal_ros.nodes.sessions.health import Level
from selfcal_ros.settings.nodes import CollectorSettings
from test.support.sessions import decoded, small_bag


def stamps(bag: Path) -> list[tuple[str, int]]:
    """Return topic and header stamp of every message of a bag, in the order of the file."""
    return [
        (topic, m.header.stamp.sec * 10**9 + m.header.stamp.nanosec)
        for topic, _, m in decoded(BagReader(bag))
    ]


def content(bag: Path) -> Counter:
    return Counter(
        (topic, repr(message)) for topic, _, message in decoded(BagReader(bag))
    )


def digests(bag: Path) -> list[str]:
    measurements, _, _, _ = collect_bag(bag, CollectorSettings.checked({}, "test"))
    return [readings_digest(view, {}) for view in measurements.views]


def is_a_rosbag2_bag(recorded: Path) -> None:
    """Check what other readers want to know of a recording."""
    info = yaml.safe_load((recorded / "metadata.yaml").read_text())[
        "rosbag2_bagfile_information"
    ]
    assert (info["version"], info["storage_identifier"]) == (9, "mcap")
    counts = {
        t["topic_metadata"]["name"]: t["message_count"]
        for t in info["topics_with_message_count"]
    }
    expected = Counter(f"/{topic}" for topic, _ in stamps(recorded))
    assert {name: n for name, n in counts.items() if n} == expected
    qos = {
        t["topic_metadata"]["name"]: t["topic_metadata"]["offered_qos_profiles"][0]
        for t in info["topics_with_message_count"]
    }
    assert qos["/selfcal/view_command"]["durability"] == "transient_local"
    assert qos["/stage/mark_detections"]["durability"] == "volatile"
    with (recorded / info["relative_file_paths"][0]).open("rb") as stream:
        reader = make_reader(stream)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
    assert {schema.encoding for schema in summary.schemas.values()} == {"ros2msg"}
    assert {channel.message_encoding for channel in summary.channels.values()} == {
        "cdr"
    }


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    """Return a simulated bag."""
    return small_bag(tmp_path_factory.mktemp("simulated"))


@pytest.fixture
def played(graph, tmp_path, bag):
    """Return a function that plays the bag into a recorder: (recorded, player)."""

    def play(**parameters):
        recorder = graph.node(BagRecorder, bag=str(tmp_path / "recorded"))
        player = graph.node(
            BagPlayer,
            bag=str(bag),
            **({"rate": 0.0, "listener": "bag_recorder"} | parameters),
        )
        graph.until(player.finished.done, "the end of the bag")
        total = player.player.total
        graph.until(
            lambda: sum(recorder._writer.counts.values()) >= total, "the last message"
        )
        recorder.close()
        return tmp_path / "recorded", player

    return play


def test_nothing_is_lost_added_or_changed(played, bag):
    recorded, player = played()
    sent = content(bag)
    assert content(recorded) == sent
    assert sum(sent.values()) == player.player.total
    assert digests(recorded) == digests(bag)
    is_a_rosbag2_bag(recorded)


def test_shuffled_messages_arrive_in_another_order_with_their_own_stamps(played, bag):
    recorded, _ = played(seed=4)
    assert sorted(stamps(recorded)) == sorted(stamps(bag))
    assert stamps(recorded) != stamps(bag)
    assert digests(recorded) == digests(bag)


def test_a_bag_is_played_at_its_own_pace_times_the_rate(played, bag):
    recorded, _ = played(rate=20.0)
    assert content(recorded) == content(bag)
    arrivals = [stamp for _, stamp, _ in decoded(BagReader(recorded))]
    original = [stamp for _, stamp, _ in decoded(BagReader(bag))]
    assert max(arrivals) - min(arrivals) >= (max(original) - min(original)) / 20 * 0.9


def test_an_encoder_with_best_effort_is_recorded(graph, tmp_path):
    recorder = graph.node(BagRecorder, bag=str(tmp_path / "bag"))
    publisher = graph.publisher(names.ENCODER_EITHER[1])
    publisher.publish(names.ENCODER.type(name=["x"], position=[0.25]))
    graph.until(
        lambda: recorder._writer.counts["/stage/joint_states"] == 1, "the sample"
    )
    recorder.close()


def test_a_recorder_does_nothing_more_often_than_once_a_second(graph, tmp_path):
    """A timer without a period keeps a core busy."""
    recorder = graph.node(BagRecorder, bag=str(tmp_path / "bag"))
    assert min(timer.timer_period_ns for timer in recorder.timers) >= 10**8
    recorder.close()


def test_an_encoder_that_comes_back_with_best_effort_is_recorded(graph, tmp_path):
    recorder = graph.node(BagRecorder, bag=str(tmp_path / "bag"))
    first = graph.publisher(names.ENCODER)
    first.publish(names.ENCODER.type(name=["x"], position=[0.25]))
    graph.until(
        lambda: recorder._writer.counts["/stage/joint_states"] == 1, "the first sample"
    )
    graph.hand.destroy_publisher(first)
    graph.publisher(names.ENCODER_EITHER[1]).publish(
        names.ENCODER.type(name=["x"], position=[0.5])
    )
    graph.until(
        lambda: recorder._writer.counts["/stage/joint_states"] == 2, "the second sample"
    )
    recorder.close()


def test_a_player_does_not_take_the_collector_of_another_cell_for_its_own(graph, bag):
    player = graph.node(BagPlayer, bag=str(bag), rate=0.001).player
    own, other = (
        graph.hand.create_publisher(topic.type, f"{cell}{topic.name}", topic.qos)
        for topic in [names.of_node("measurement_collector", names.RECEIVED)]
        for cell in ("", "/cell2/")
    )
    other.publish(names.RECEIVED.type(data=[9, 9, 9]))
    own.publish(names.RECEIVED.type(data=[8, 8]))  # not the collector's form
    own.publish(names.RECEIVED.type(data=[7, 7, 7]))
    graph.until(lambda: player.heard, "the counts")
    assert player.heard == dict.fromkeys(player.sent, 7)


def endless(node, name: str, topics=names.INPUTS, **qos) -> list:
    """Have `node` listen to topics of the cell whatever they are; return what it hears."""
    heard: list = []
    for topic in topics:
        node.create_subscription(
            topic.type,
            name + topic.name,
            heard.append,
            **({"qos_profile": topic.qos} | qos),
        )
    return heard


def test_nothing_is_lost_beside_strangers_who_listen_before_the_collector(graph, bag):
    """As ros2 topic echo, foxglove_bridge and the compensator do."""
    heard = endless(graph.hand, "")
    endless(
        graph.add(Node("echo", context=graph.context)),
        "",
        qos_profile=qos_profile_sensor_data,
    )
    player = graph.node(BagPlayer, bag=str(bag), rate=0.0)
    graph.until(
        lambda: all(
            publisher.get_subscription_count() == 2
            for publisher in player.player._publishers.values()
        ),
        "the strangers",
    )
    looks: list = []
    player.every(0.01, lambda: looks.append(player.player.played))
    graph.until(lambda: len(looks) > 5, "looks at the player")
    assert (set(looks), heard) == ({0}, [])
    assert player.diagnosis().message == "waiting for /measurement_collector"
    collector = graph.node(MeasurementCollector)
    graph.until(player.finished.done, "the end of the bag")
    graph.until(
        lambda: collector.session.collector.received == player.player.sent, "all of it"
    )
    measurements, _ = collector.session.collector.collect()
    assert [readings_digest(view, {}) for view in measurements.views] == digests(bag)


def test_a_player_whose_listener_does_not_come_ends_and_has_played_nothing(graph, bag):
    heard = endless(graph.hand, "")
    player = graph.node(BagPlayer, bag=str(bag), rate=0.0, wait_for_subscribers=0.2)
    lines: list = []
    player.say = lambda level, line: lines.append((level, line))
    graph.until(player.finished.done, "its end")
    assert (player.exit_code, player.player.played, heard) == (
        ExitCode.BAD_INPUT,
        0,
        [],
    )
    assert lines == [
        (
            Level.ERROR,
            (
                "bag_player: /measurement_collector does not listen to "
                "stage/joint_states, stage/mark_detections, selfcal/view_command after "
                "0.2 s, nothing was played; start it, name another node as listener, "
                "or set listener to '' to play without waiting"
            ),
        )
    ]


@pytest.mark.parametrize(
    "parameters", [{"listener": ""}, {"wait_for_subscribers": 0.0}]
)
def test_a_player_that_waits_for_nobody_plays_at_once(graph, bag, parameters):
    player = graph.node(BagPlayer, bag=str(bag), rate=0.0, **parameters)
    graph.until(player.finished.done, "the end of the bag")
    assert (player.exit_code, player.player.done) == (ExitCode.DONE, True)


@pytest.mark.parametrize(
    "listener, heard",
    [("measurement_collector", False), ("/cell2/measurement_collector", True)],
)
def test_a_listener_is_one_by_name_and_namespace(graph, bag, listener, heard):
    other = graph.add(
        Node("measurement_collector", namespace="cell2", context=graph.context)
    )
    endless(other, "/")
    player = graph.node(BagPlayer, bag=str(bag), rate=0.001, listener=listener).player
    graph.until(
        lambda: all(
            publisher.get_subscription_count()
            for publisher in player._publishers.values()
        ),
        "the subscriptions",
    )
    named = [
        f"{info.node_namespace}/{info.node_name}"
        for info in graph.hand.get_subscriptions_info_by_topic("stage/joint_states")
    ]
    assert named == ["/cell2/measurement_collector"]
    assert (player.unheard() == []) is heard


DRIVER = "/hand publishes stage/joint_states as well; 0 messages were played"


def test_nothing_is_played_beside_somebody_elses_publisher(graph, bag):
    heard = endless(graph.hand, "")
    graph.hand.create_publisher(
        names.ENCODER.type, names.ENCODER.name, names.ENCODER.qos
    )
    player = graph.node(BagPlayer, bag=str(bag), rate=0.0, listener="")
    lines: list = []
    player.say = lambda level, line: lines.append((level, line))
    graph.until(player.finished.done, "its end")
    assert (player.exit_code, player.player.played, heard) == (
        ExitCode.BAD_INPUT,
        0,
        [],
    )
    [(level, line)] = lines
    assert level == Level.ERROR and DRIVER in line


def test_a_node_named_as_one_of_selfcal_is_a_stranger_on_what_is_played(graph, bag):
    graph.add(Node("measurement_collector", context=graph.context)).create_publisher(
        names.ENCODER.type, names.ENCODER.name, names.ENCODER.qos
    )
    player = graph.node(BagPlayer, bag=str(bag), rate=0.0, listener="")
    lines: list = []
    player.say = lambda level, line: lines.append(line)
    graph.until(player.finished.done, "its end")
    assert (player.exit_code, player.player.played) == (ExitCode.BAD_INPUT, 0)
    assert DRIVER.replace("hand", "measurement_collector") in lines[0]


def test_a_bag_is_played_beside_others_where_that_is_asked_for(graph, bag):
    graph.hand.create_publisher(
        names.ENCODER.type, names.ENCODER.name, names.ENCODER.qos
    )
    player = graph.node(
        BagPlayer, bag=str(bag), rate=0.0, listener="", beside_others=True
    )
    graph.until(player.finished.done, "the end of the bag")
    assert (player.exit_code, player.player.done) == (ExitCode.DONE, True)


def test_one_own_sequencer_is_no_stranger_and_two_are(graph, bag):
    graph.add(Node("pose_sequencer", context=graph.context)).create_publisher(
        names.COMMAND.type, names.COMMAND.name, names.COMMAND.qos
    )
    player = graph.node(
        BagPlayer, bag=str(bag), rate=0.0, listener="", wait_for_subscribers=0.0
    )
    graph.until(player.finished.done, "the end of the bag")
    assert player.player.done
    graph.add(Node("pose_sequencer", context=graph.context)).create_publisher(
        names.COMMAND.type, names.COMMAND.name, names.COMMAND.qos
    )
    graph.remove(player)
    player = graph.node(BagPlayer, bag=str(bag), rate=0.0, listener="")
    graph.until(player.finished.done, "its end")
    assert (player.exit_code, player.player.played) == (ExitCode.BAD_INPUT, 0)


def test_others_are_looked_for_until_dds_has_repeated_itself(graph, bag, monkeypatch):
    monkeypatch.setattr(player, "FOUND_S", 0.5)
    begun_s = time.monotonic()
    node = graph.node(BagPlayer, bag=str(bag), rate=0.0, listener="")
    graph.until(lambda: node.player.played, "the first message")
    assert time.monotonic() - begun_s >= 0.5


def test_a_publisher_that_comes_while_a_bag_is_played_ends_the_player(graph, bag):
    player = graph.node(BagPlayer, bag=str(bag), rate=0.01, listener="")
    graph.until(lambda: player.player.played, "the first message")
    graph.hand.create_publisher(
        names.DETECTIONS.type, names.DETECTIONS.name, names.DETECTIONS.qos
    )
    graph.until(player.finished.done, "its end")
    assert player.exit_code == ExitCode.BAD_INPUT and not player.player.done


def test_a_listener_of_one_topic_alone_is_not_enough(graph, bag):
    node = graph.add(Node("one", context=graph.context))
    endless(node, "", [names.DETECTIONS])
    player = graph.node(BagPlayer, bag=str(bag), rate=0.001, listener="one").player
    graph.until(lambda: names.DETECTIONS.name not in player.unheard(), "the one")
    assert player.unheard() == [names.ENCODER.name, names.COMMAND.name]


def test_a_collector_that_a_stranger_has_hear_with_best_effort_is_waited_for(
    graph, bag
):
    driver = graph.hand.create_publisher(
        names.ENCODER.type, names.ENCODER.name, names.ENCODER_EITHER[1].qos
    )
    graph.node(MeasurementCollector)
    player = graph.node(BagPlayer, bag=str(bag), rate=0.0, beside_others=True).player
    graph.until(lambda: len(player.unheard()) == 1, "the collector")
    assert player.unheard() == [
        "stage/joint_states reliably (another publisher offers best effort)"
    ]
    graph.hand.destroy_publisher(driver)
    graph.until(lambda: player.done, "the end of the bag")


def test_a_bag_that_goes_away_while_it_is_played_ends_the_player_with_a_line(
    graph, bag
):
    player = graph.node(BagPlayer, bag=str(bag), rate=0.0, listener="")
    player.player._messages = iter(())
    lines: list = []
    player.say = lambda level, line: lines.append((level, line))
    graph.until(player.finished.done, "its end")
    assert (player.exit_code, player.player.played) == (ExitCode.BAD_INPUT, 1)
    total = player.player.total
    assert lines == [
        (
            Level.ERROR,
            f"{bag}: {total} messages when it was opened, 1 now; play a bag that is "
            "not being changed",
        )
    ]


def test_what_was_flushed_survives_a_crash(graph, tmp_path):
    recorder = graph.node(BagRecorder, bag=str(tmp_path / "bag"))
    graph.publisher(names.DETECTIONS).publish(names.DETECTIONS.type(m=3))
    graph.until(
        lambda: recorder._writer.counts["/stage/mark_detections"] == 1, "the message"
    )
    recorder._flush()
    reader = BagReader(tmp_path / "bag")
    assert [message.m for _, _, message in decoded(reader)] == [3]
    assert reader.lost
    recorder.close()


def test_only_the_inputs_are_recorded_when_asked(graph, tmp_path):
    recorder = graph.node(BagRecorder, bag=str(tmp_path / "bag"), all_topics=False)
    assert set(recorder._writer.counts) == {f"/{topic.name}" for topic in names.INPUTS}
    recorder.close()


def test_an_existing_folder_is_never_written_into(graph, tmp_path):
    with pytest.raises(
        InputError, match="exists already; remove it or name another folder"
    ):
        graph.node(BagRecorder, bag=str(tmp_path))


def test_a_bag_that_is_none_is_refused(graph, tmp_path):
    with pytest.raises(InputError, match="no such file or folder"):
        graph.node(BagPlayer, bag=str(tmp_path / "no"))


def test_a_bag_without_our_topics_is_refused(graph, tmp_path):
    recorder = graph.node(BagRecorder, bag=str(tmp_path / "bag"))
    recorder.close()
    with pytest.raises(NoDataError, match="no message on the topics of the contract"):
        graph.node(BagPlayer, bag=str(tmp_path / "bag"))


def test_a_remapped_topic_is_recorded_under_the_name_of_the_contract(graph, tmp_path):
    recorder = graph.node(
        partial(
            BagRecorder,
            cli_args=["--ros-args", "-r", "stage/mark_detections:=/robot/marks"],
        ),
        bag=str(tmp_path / "bag"),
    )
    marks = graph.publisher(replace(names.DETECTIONS, name="/robot/marks"))
    marks.publish(names.DETECTIONS.type(m=3))
    graph.until(lambda: sum(recorder._writer.counts.values()) == 1, "the detection")
    recorder.close()
    [(topic, _, message)] = decoded(BagReader(tmp_path / "bag"))
    assert (topic, message.m) == (names.DETECTIONS.name, 3)
    with (tmp_path / "bag" / "bag_0.mcap").open("rb") as stream:
        assert {
            channel.metadata["heard_on"]
            for channel in make_reader(stream).get_summary().channels.values()
            if "heard_on" in channel.metadata
        } == {"/robot/marks"}
