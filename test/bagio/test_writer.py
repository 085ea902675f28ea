# SPDX-License-Identifier: Apache-2.0
"""The bag writer: what it writes is read by mcap's and by rosbags' own readers, whole and alike."""

import errno
import os

import pytest
import yaml
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from rosbags.rosbag2 import Reader

from selfcal_ros.bagio.messages import from_model
from selfcal_ros.bagio.messages.from_model import event_fields
from selfcal_ros.bagio.reader import INPUT_TOPICS, BagReader
from selfcal_ros.bagio.schemas import hash_of, typestore
from selfcal_ros.bagio.writer import BagWriter, new_bag
from selfcal_ros.collection.inputs import Detection, EncoderSample
from selfcal_ros.errors import InputError
from selfcal_ros.simulation.bag import QOS
from selfcal_ros.topics import qos_profile
from test.support.sessions import decoded, events_of, small_plan

STRING_HASH = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
"""Of std_msgs/msg/String, as published with ROS 2."""
FOREVER = {"sec": 9223372036, "nsec": 854775807}
RELIABLE = qos_profile(reliable=True, transient_local=True, depth=7)
ENCODER, MARKS = "/stage/joint_states", "/stage/mark_detections"
SHIFT_NS = 1000


@pytest.fixture(scope="module")
def events():
    return events_of(small_plan("0", repeats=1))


def write(path, events, compression="zstd"):
    with BagWriter(path, compression) as writer:
        for topic, typename in INPUT_TOPICS.items():
            writer.add_topic(f"/{topic}", typename, [QOS[topic]])
        writer.add_topic("/notes", "std_msgs/msg/String", [])
        for event in events:
            topic, values = event_fields(event, "stage")
            writer.write(f"/{topic}", values, event.stamp_ns + SHIFT_NS)
    return path


def metadata(path):
    return yaml.safe_load((path / "metadata.yaml").read_text())[
        "rosbag2_bagfile_information"
    ]


def counted(events):
    out = {f"/{topic}": 0 for topic in INPUT_TOPICS} | {"/notes": 0}
    for event in events:
        out[f"/{event_fields(event, '')[0]}"] += 1
    return out


@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
def test_the_reader_of_mcap_finds_every_message(tmp_path, events, compression):
    file = write(tmp_path / "bag", events, compression) / "bag_0.mcap"
    with file.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        header, summary = reader.get_header(), reader.get_summary()
        found = [
            (channel.topic, schema.name, message.log_time, message.publish_time)
            for schema, channel, message in reader.iter_messages(log_time_order=False)
        ]
        stream.seek(0)
        chunks = [
            record.compression
            for record in StreamReader(
                stream, emit_chunks=True, validate_crcs=True
            ).records
            if hasattr(record, "compression")
        ]
    assert found == [
        (f"/{topic}", INPUT_TOPICS[topic], at, at)
        for topic, at in (
            (event_fields(event, "")[0], event.stamp_ns + SHIFT_NS) for event in events
        )
    ]
    assert (header.profile, header.library) == ("ros2", "selfcal_ros")
    assert summary.statistics.message_count == len(events)
    assert {
        channel.topic: summary.statistics.channel_message_counts.get(number, 0)
        for number, channel in summary.channels.items()
    } == counted(events)
    assert set(chunks) == {"" if compression == "none" else compression}


def test_schemas_and_channels_are_those_of_rosbag2(tmp_path, events):
    path = write(tmp_path / "bag", events)
    with (path / "bag_0.mcap").open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert {schema.encoding for schema in summary.schemas.values()} == {"ros2msg"}
    texts = {schema.name: schema.data.decode() for schema in summary.schemas.values()}
    assert "MSG: std_msgs/Header" in texts["sensor_msgs/msg/JointState"]
    assert "uint8 ANGULAR=1" in texts["selfcal_msgs/msg/MarkDetection"]
    for channel in summary.channels.values():
        name = summary.schemas[channel.schema_id].name
        assert channel.message_encoding == "cdr"
        assert set(channel.metadata) == {"offered_qos_profiles", "topic_type_hash"}
        assert channel.metadata["topic_type_hash"] == hash_of(name)
        profiles = yaml.safe_load(channel.metadata["offered_qos_profiles"] or "[]")
        assert profiles == (
            [QOS[channel.topic.strip("/")]] if channel.topic != "/notes" else []
        )


def test_the_reader_of_rosbags_finds_every_message(tmp_path, events):
    path = write(tmp_path / "bag", events)
    with Reader(path) as reader:
        assert reader.message_count == len(events)
        assert reader.start_time == events[0].stamp_ns + SHIFT_NS
        assert reader.end_time - 1 == events[-1].stamp_ns + SHIFT_NS
        assert {c.topic: c.msgcount for c in reader.connections} == counted(events)
        for event, (link, at, data) in zip(events, reader.messages(), strict=True):
            message = typestore().deserialize_cdr(data, link.msgtype)
            stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
            assert (at, stamp) == (event.stamp_ns + SHIFT_NS, event.stamp_ns)
            if isinstance(event, Detection):
                assert (message.offset_x, message.m) == (event.offset_x, event.m)
            elif isinstance(event, EncoderSample):
                assert tuple(message.position) == event.positions


def test_metadata_is_what_rosbag2_writes_in_jazzy(tmp_path, events):
    info = metadata(write(tmp_path / "bag", events))
    first = events[0].stamp_ns + SHIFT_NS
    start = {"nanoseconds_since_epoch": first}
    duration = {"nanoseconds": events[-1].stamp_ns + SHIFT_NS - first}
    topics = info.pop("topics_with_message_count")
    assert info == {
        "version": 9,
        "storage_identifier": "mcap",
        "duration": duration,
        "starting_time": start,
        "message_count": len(events),
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": ["bag_0.mcap"],
        "files": [
            {
                "path": "bag_0.mcap",
                "starting_time": start,
                "duration": duration,
                "message_count": len(events),
            }
        ],
        "custom_data": None,
        "ros_distro": "jazzy",
    }
    assert {
        entry["topic_metadata"]["name"]: entry["message_count"] for entry in topics
    } == (counted(events))
    for entry in topics:
        assert set(entry) == {"topic_metadata", "message_count"}
        about = entry["topic_metadata"]
        assert set(about) == {
            "name",
            "type",
            "serialization_format",
            "offered_qos_profiles",
            "type_description_hash",
        }
        assert about["serialization_format"] == "cdr"
        assert about["type_description_hash"] == hash_of(about["type"])
    types = {
        entry["topic_metadata"]["name"]: entry["topic_metadata"]["type"]
        for entry in topics
    }
    assert types == {f"/{t}": name for t, name in INPUT_TOPICS.items()} | {
        "/notes": "std_msgs/msg/String"
    }
    assert topics[-1]["topic_metadata"]["type_description_hash"] == STRING_HASH


@pytest.mark.parametrize("reliable", [True, False])
@pytest.mark.parametrize("local", [True, False])
def test_a_qos_profile_has_the_words_of_jazzy(reliable, local):
    assert list(
        qos_profile(reliable=reliable, transient_local=local, depth=3).items()
    ) == [
        ("history", "keep_last"),
        ("depth", 3),
        ("reliability", "reliable" if reliable else "best_effort"),
        ("durability", "transient_local" if local else "volatile"),
        ("deadline", FOREVER),
        ("lifespan", FOREVER),
        ("liveliness", "automatic"),
        ("liveliness_lease_duration", FOREVER),
        ("avoid_ros_namespace_conventions", False),
    ]


def test_times_are_the_first_and_the_last_in_any_order(tmp_path):
    with BagWriter(tmp_path / "bag") as writer:
        writer.add_topic("/notes", "std_msgs/msg/String", [])
        for at in (50, 20, 90, 70):
            writer.write("/notes", {"data": "x"}, at)
        assert writer.counts == {"/notes": 4}
    info = metadata(tmp_path / "bag")
    assert (info["starting_time"], info["duration"]) == (
        {"nanoseconds_since_epoch": 20},
        {"nanoseconds": 70},
    )


def test_a_bag_without_messages_is_a_bag(tmp_path):
    with BagWriter(tmp_path / "bag") as writer:
        writer.add_topic("/notes", "std_msgs/msg/String", [RELIABLE])
    assert metadata(tmp_path / "bag")["message_count"] == 0
    with Reader(tmp_path / "bag") as reader:
        assert [c.topic for c in reader.connections] == ["/notes"]
        assert list(reader.messages()) == []
    reader = BagReader(tmp_path / "bag")
    assert list(decoded(reader)) == [] and reader.lost == []


def test_a_type_that_is_not_known_is_refused(tmp_path):
    with (
        BagWriter(tmp_path / "bag") as writer,
        pytest.raises(
            InputError,
            match="topic /a: no definition of b/msg/C; record only topics of known",
        ),
    ):
        writer.add_topic("/a", "b/msg/C", [])


def test_what_was_flushed_is_there_before_the_end_and_an_error_keeps_it(tmp_path):
    def torn():
        with BagWriter(tmp_path / "bag") as writer:
            writer.add_topic(ENCODER, "sensor_msgs/msg/JointState", [RELIABLE])
            sample = EncoderSample(5, ("x",), (0.5,))
            writer.write(ENCODER, from_model.joint_state(sample, "stage"), 5)
            writer.flush()
            reader = BagReader(tmp_path / "bag")
            assert (
                len(list(decoded(reader))) == 1
                and "without its footer" in reader.lost[0]
            )
            assert not (tmp_path / "bag" / "metadata.yaml").exists()
            raise RuntimeError("a fault")

    with pytest.raises(RuntimeError, match="a fault"):
        torn()
    reader = BagReader(tmp_path / "bag")
    assert len(list(decoded(reader))) == 1 and reader.lost == []
    assert metadata(tmp_path / "bag")["message_count"] == 1


def test_closing_twice_is_closing_once(tmp_path):
    writer = BagWriter(tmp_path / "bag")
    writer.close()
    before = (tmp_path / "bag" / "metadata.yaml").stat().st_mtime_ns
    writer.close()
    assert (tmp_path / "bag" / "metadata.yaml").stat().st_mtime_ns == before


@pytest.mark.parametrize(
    ("target", "said"),
    [
        ("folder", "exists already; remove it or name another folder"),
        ("file", "exists already; remove it or name another folder"),
        ("file/bag", "cannot be created (Not a directory); name a writable folder"),
        ("n" * 300, "cannot be created (File name too long); name a writable folder"),
    ],
)
def test_where_no_bag_can_be_made(tmp_path, target, said):
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").touch()
    with pytest.raises(InputError) as caught:
        BagWriter(tmp_path / target)
    assert str(caught.value) == f"{tmp_path / target}: {said}"


class FullDisk:
    """A file on a disk that is full."""

    def __init__(self, file):
        self.file = file

    def write(self, data):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def __getattr__(self, name):
        return getattr(self.file, name)


@pytest.mark.parametrize("act", ["flush", "write", "close"])
def test_a_full_disk_is_one_line(tmp_path, act):
    writer = BagWriter(tmp_path / "bag", "none")
    writer.add_topic("/notes", "std_msgs/msg/String", [])
    writer.write("/notes", {"data": "x"}, 1)
    writer._mcap._Writer__stream = FullDisk(writer._file)
    with pytest.raises(
        InputError,
        match=r"bag: cannot be written \(No space left on device\); "
        "free some space or name another folder",
    ):
        {
            "flush": writer.flush,
            "close": writer.close,
            "write": lambda: writer.write("/notes", {"data": "x" * 300_000}, 1),
        }[act]()
    writer._file.close()


def test_a_bag_that_fails_is_named_as_it_was_asked_for_and_leaves_nothing(tmp_path):
    with pytest.raises(InputError) as raised, new_bag(tmp_path / "bag") as unfinished:
        raise InputError(
            str(unfinished / "bag_0.mcap"), "cannot be written", "free some space"
        )
    assert (
        str(raised.value)
        == f"{tmp_path}/bag/bag_0.mcap: cannot be written; free some space"
    )
    assert not list(tmp_path.iterdir())
