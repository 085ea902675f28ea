# SPDX-License-Identifier: Apache-2.0
"""A bag that somebody else wrote from the contract gives the same map, bit for bit."""

import pickle

import pytest
import yaml
import zstandard
from mcap.reader import make_reader
from mcap.writer import Writer
from rosbags.convert import cli as convert
from rosbags.rosbag2 import CompressionMode, Reader, StoragePlugin
from rosbags.rosbag2 import Writer as RosbagsWriter

from selfcal_ros.bagio.mcap_stream import McapStream
from selfcal_ros.bagio.messages import to_model
from selfcal_ros.bagio.offline import collect_bag
from selfcal_ros.bagio.reader import INPUT_TOPICS, BagReader
from selfcal_ros.bagio.schemas import typestore
from selfcal_ros.collection.collector import Collector
from selfcal_ros.collection.inputs import Command, Detection, EncoderSample
from selfcal_ros.errors import InputError, NoDataError
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.options import Options
from selfcal_ros.model.result import result_to_dict
from selfcal_ros.reporting.words.findings import worded
from selfcal_ros.settings.nodes import CollectorSettings
from selfcal_ros.topics import COMMAND_TOPIC, DETECTION_TOPIC, ENCODER_TOPIC
from test.support import bags
from test.support.bags import COMPRESSIONS, NO_SUMMARY, Foreign
from test.support.sessions import collected, decoded, events_of, small_plan

VALUES = CollectorSettings.checked({}, "test")
CALIBRATED: dict[bytes, dict] = {}
EXTRA = "float64 temperature\nstring operator\n"


@pytest.fixture(scope="module")
def events():
    return events_of(small_plan(repeats=1))


@pytest.fixture(scope="module")
def expected(events):
    return result_to_dict(worded(calibrate(collected(events)[1], Options())))


def calibrated(measurements):
    """Return the result of readings; the same ones, to the last bit, are calibrated once."""
    key = pickle.dumps(measurements)
    if key not in CALIBRATED:
        CALIBRATED[key] = result_to_dict(worded(calibrate(measurements, Options())))
    return CALIBRATED[key]


def solved(path, **more):
    measurements, _, lost, _ = collect_bag(path, VALUES, **more)
    return calibrated(measurements), lost


def check(path, expected, **more):
    result, lost = solved(path, **more)
    assert result == expected
    assert lost == []


def test_the_reference_is_a_calibration(expected):
    assert expected["observability"]["identifiable"]
    assert expected["rejected"] == {}
    assert max(max(row) for row in expected["error_map"]["gx"]) > 1e-7


@pytest.mark.parametrize("compression", COMPRESSIONS)
@pytest.mark.parametrize("chunk_size", [1, 700, 1 << 24])
def test_chunks_and_compression(tmp_path, events, expected, compression, chunk_size):
    foreign = Foreign(
        {"chunk_size": chunk_size, "compression": COMPRESSIONS[compression]}
    )
    check(foreign.write(tmp_path / "x.mcap", events), expected)


@pytest.mark.parametrize(
    "options",
    [
        {"use_chunking": False},
        {"use_chunking": False, **NO_SUMMARY},
        NO_SUMMARY,
        {"enable_crcs": False},
        {"enable_data_crcs": True},
        {**NO_SUMMARY, "enable_crcs": False},
    ],
    ids=[
        "no chunks",
        "no chunks, no summary",
        "no summary",
        "no crc",
        "data crc",
        "bare",
    ],
)
@pytest.mark.parametrize("footer", [True, False])
def test_what_mcap_leaves_open(tmp_path, events, expected, options, footer):
    path = Foreign(options, footer=footer).write(tmp_path / "x.mcap", events)
    result, lost = solved(path)
    assert result == expected
    assert len(lost) == (not footer)
    assert footer or "ends without its footer" in lost[0]


def test_fields_at_the_end_are_ignored(tmp_path, events, expected):
    check(
        Foreign(types=bags.contract_types(EXTRA)).write(tmp_path / "x.mcap", events),
        expected,
    )


def test_other_topics_are_ignored(tmp_path, events, expected):
    check(Foreign(others=True).write(tmp_path / "x.mcap", events), expected)


def test_order_in_the_file_makes_no_difference(tmp_path, events, expected):
    check(Foreign().write(tmp_path / "x.mcap", bags.shuffled(events)), expected)


def test_a_folder_without_metadata(tmp_path, events, expected):
    Foreign().write(tmp_path / "bag" / "any name.mcap", events)
    check(tmp_path / "bag", expected)


def test_the_writer_of_rosbags(tmp_path, events, expected):
    bag = bags.rosbags_bag(tmp_path / "bag", events)
    check(bag, expected)
    check(next(bag.glob("*.mcap")), expected)
    with Reader(bag) as reader:
        assert reader.message_count == len(events)


@pytest.mark.parametrize("compressed", ["none", "zstd"])
def test_a_bag_of_sqlite_that_was_converted(
    tmp_path, monkeypatch, events, expected, compressed
):
    """By the command that its refusal names."""
    plain, old = bags.rosbags_bag(tmp_path / "plain", events), tmp_path / "old"
    with (
        Reader(plain) as reader,
        RosbagsWriter(old, version=8, storage_plugin=StoragePlugin.SQLITE3) as writer,
    ):
        connections = {
            each.id: writer.add_connection(
                each.topic,
                each.msgtype,
                msgdef=each.msgdef.data,
                rihs01=each.digest,
            )
            for each in reader.connections
        }
        for each, logged_ns, data in reader.messages():
            writer.write(connections[each.id], logged_ns, data)
    with pytest.raises(InputError, match="rosbags-convert") as refused:
        solved(old)
    command = str(refused.value).split("`")[-2].split()
    paths = {"BAG": str(old), "NEW": str(tmp_path / "new")}
    asked = [paths.get(word, word) for word in command]
    monkeypatch.setattr("sys.argv", [*asked, "--compress", compressed])
    with pytest.raises(SystemExit, match="0"):
        convert.main()
    check(tmp_path / "new", expected)


@pytest.mark.parametrize("metadata", [True, False])
def test_a_bag_in_many_files_whose_channels_differ(
    tmp_path, events, expected, metadata
):
    parts = bags.split(events, 12)
    for number, part in enumerate(parts):
        Foreign(others=True).write(
            tmp_path / "bag" / f"part_{number}.mcap", part, order=number % 4
        )
    names = [f"part_{number}.mcap" for number in range(len(parts))]
    if metadata:
        (tmp_path / "bag" / "metadata.yaml").write_text(
            yaml.safe_dump(
                {"rosbag2_bagfile_information": {"relative_file_paths": names}}
            )
        )
    assert [file.name for file in BagReader(tmp_path / "bag").files] == names
    check(tmp_path / "bag", expected)


@pytest.mark.parametrize("compression", [None, "zstd"])
def test_files_joined_to_one_are_all_read(tmp_path, events, expected, compression):
    """As by `cat A B`; the numbers of channels differ between them."""
    joined = b""
    for number, part in enumerate(bags.split(events, 3)):
        file = Foreign(others=True).write(
            tmp_path / f"{number}.mcap", part, order=number
        )
        joined += file.read_bytes()
    if compression:
        joined = zstandard.compress(joined)
    (tmp_path / "bag.mcap").write_bytes(joined)
    check(tmp_path / "bag.mcap", expected)


def test_a_file_without_its_end_joined_to_another_loses_no_more_than_that(
    tmp_path, events
):
    first, second = bags.split(events, 2)
    one = Foreign({"chunk_size": 1500}).write(tmp_path / "1.mcap", first).read_bytes()
    two = Foreign().write(tmp_path / "2.mcap", second, order=2).read_bytes()
    for cut in (
        one.rindex(b"\x89MCAP0"),
        len(one) // 2,
        len(one) - 60,
        1230,
        2038,
        9784,
    ):
        (tmp_path / "cut.mcap").write_bytes(one[:cut])
        (tmp_path / "bag.mcap").write_bytes(one[:cut] + two)
        alone, reader = (
            BagReader(tmp_path / "cut.mcap"),
            BagReader(tmp_path / "bag.mcap"),
        )
        count = len(list(decoded(alone)))
        assert len(list(decoded(reader))) == count + len(second)
        assert len(reader.lost) == len(alone.lost) <= 1


def test_what_follows_the_end_of_a_file_and_is_no_other_is_said(
    tmp_path, events, expected
):
    file = Foreign().write(tmp_path / "x.mcap", events)
    file.write_bytes(file.read_bytes() + bytes(50))
    result, lost = solved(file)
    assert result == expected
    assert lost == [
        "50 bytes after the end of the recording are not MCAP and were not used"
    ]


def test_a_recording_behind_strange_bytes_is_read(tmp_path, events, expected):
    one, two = (
        Foreign().write(tmp_path / f"{number}.mcap", part, order=number).read_bytes()
        for number, part in enumerate(bags.split(events, 2))
    )
    (tmp_path / "bag.mcap").write_bytes(one + bytes(50) + two)
    result, lost = solved(tmp_path / "bag.mcap")
    assert result == expected
    assert lost == [
        "50 bytes after the end of the recording are not MCAP and were not used"
    ]


@pytest.mark.parametrize(
    ("order", "where"),
    [
        ([0, 0], "b.mcap"),
        ([1, 0], "b.mcap"),
        ([0, 1], ""),
        ("joined", "a.mcap from byte"),
    ],
)
def test_copies_and_files_out_of_order_are_not_called_steps_of_a_clock(
    tmp_path, events, expected, order, where
):
    halves = [events, events] if order in ([0, 0], "joined") else bags.split(events, 2)
    names = "ab" if order != [1, 0] else "ba"
    (tmp_path / "bag").mkdir()
    files = [
        Foreign().write(tmp_path / "bag" / f"{name}.mcap", half)
        for name, half in zip(names, halves, strict=True)
    ]
    if order == "joined":
        files[0].write_bytes(files[0].read_bytes() + files[1].read_bytes())
        files[1].unlink()
    measurements, _, lost, _ = collect_bag(tmp_path / "bag", VALUES)
    assert calibrated(measurements)["error_map"] == expected["error_map"]
    assert len(lost) == bool(where)
    for line in lost:
        assert (
            line.startswith(where)
            and "before the end of what was read before it" in line
        )


def listing(bag, *files) -> None:
    (bag / "metadata.yaml").write_text(
        yaml.safe_dump(
            {"rosbag2_bagfile_information": {"relative_file_paths": list(files)}}
        )
    )


def test_a_file_that_metadata_does_not_list_is_said(tmp_path, events, expected):
    Foreign().write(tmp_path / "bag" / "a.mcap", events)
    Foreign().write(tmp_path / "bag" / "b.mcap", events)
    listing(tmp_path / "bag", "a.mcap")
    result, lost = solved(tmp_path / "bag")
    assert result == expected
    assert lost == ["the file b.mcap, which metadata.yaml does not list, was not used"]


def test_files_that_were_renamed_are_read(tmp_path, events, expected):
    Foreign().write(tmp_path / "bag" / "renamed.mcap", events)
    listing(tmp_path / "bag", "a.mcap")
    result, lost = solved(tmp_path / "bag")
    assert result == expected
    assert lost == [
        "the file a.mcap, which metadata.yaml lists, is missing; renamed.mcap was read"
    ]
    Foreign().write(tmp_path / "bag" / "other.mcap", events)
    _, [line, *_] = solved(tmp_path / "bag")
    assert line.endswith("; other.mcap, renamed.mcap were read")


def test_the_missing_files_of_a_bag_without_any_are_named(tmp_path):
    (tmp_path / "bag").mkdir()
    listing(tmp_path / "bag", "a_0.mcap", "a_1.mcap")
    with pytest.raises(
        InputError,
        match=r"no \.mcap file in this folder; a_0\.mcap, a_1\.mcap, "
        "which metadata.yaml lists, is missing",
    ):
        BagReader(tmp_path / "bag")


def test_a_damaged_file_of_several_is_named(tmp_path, events):
    for name, part in zip("ab", bags.split(events, 2), strict=True):
        Foreign().write(tmp_path / "bag" / f"{name}.mcap", part)
    cut = tmp_path / "bag" / "b.mcap"
    cut.write_bytes(cut.read_bytes()[:-9])
    reader = BagReader(tmp_path / "bag")
    list(decoded(reader))
    assert len(reader.lost) == 1 and reader.lost[0].startswith(
        "b.mcap: the end of the file is dam"
    )


def test_a_file_that_metadata_lists_but_nobody_has_is_said(tmp_path, events, expected):
    Foreign().write(tmp_path / "bag" / "a.mcap", events)
    listing(tmp_path / "bag", "a.mcap", "b.mcap")
    result, lost = solved(tmp_path / "bag")
    assert result == expected
    assert lost == ["the file b.mcap, which metadata.yaml lists, is missing"]


@pytest.mark.parametrize(
    ("names", "line"),
    [
        (["../.."], "metadata.yaml lists '../..', not an .mcap file: it was not read"),
        (
            ["..", "/", "a.mcap"],
            "metadata.yaml lists '..', '/', not an .mcap file: it was not read",
        ),
        ([], "metadata.yaml lists no file and was not used"),
    ],
)
def test_what_metadata_lists_besides_recordings_is_said(
    tmp_path, events, expected, names, line
):
    Foreign().write(tmp_path / "bag" / "a.mcap", events)
    listing(tmp_path / "bag", *names)
    assert solved(tmp_path / "bag") == (expected, [line])


@pytest.mark.parametrize(
    "text",
    [
        "",
        "a: [",
        "rosbag2_bagfile_information: 5",
        "[1, 2]",
        "rosbag2_bagfile_information: {relative_file_paths: 3}",
        "rosbag2_bagfile_information: {relative_file_paths: [3]}",
    ],
)
def test_damaged_metadata_is_said_and_not_used(tmp_path, events, expected, text):
    Foreign().write(tmp_path / "bag" / "a.mcap", events)
    (tmp_path / "bag" / "metadata.yaml").write_text(text)
    result, lost = solved(tmp_path / "bag")
    assert result == expected
    assert lost == ["metadata.yaml is damaged and was not used"]


@pytest.mark.parametrize("namespace", ["/cell1", "/plant/cell1", ""])
def test_a_namespace_in_front_of_the_topics(tmp_path, events, expected, namespace):
    path = Foreign(namespace=namespace).write(tmp_path / "x.mcap", events)
    check(path, expected)
    check(path, expected, namespace=namespace)
    check(path, expected, namespace=namespace.strip("/"))


def test_two_cells_in_one_bag(tmp_path, events, expected):
    other = events_of(small_plan("0, 90, ty"), seed=8)
    for name, content in (("cell1", events), ("cell2", other)):
        Foreign(namespace=f"/{name}").write(tmp_path / "bag" / f"{name}.mcap", content)
    with pytest.raises(
        InputError,
        match="topics of two cells, '/cell1' and '/cell2'; choose one with --namespace",
    ):
        solved(tmp_path / "bag")
    check(tmp_path / "bag", expected, namespace="cell1")
    result, lost = solved(tmp_path / "bag", namespace="/cell2")
    assert result == result_to_dict(worded(calibrate(collected(other)[1], Options())))
    assert lost == []
    with pytest.raises(
        NoDataError,
        match="no topics of the cell '/cell3'; choose one of /cell1, /cell2",
    ):
        solved(tmp_path / "bag", namespace="cell3")


@pytest.mark.parametrize("namespace", ["", "/"])
def test_the_cell_in_the_root_can_be_chosen(tmp_path, events, expected, namespace):
    other = events_of(small_plan("0, 90, ty"), seed=8)
    for name, content in (("", events), ("/cell2", other)):
        Foreign(namespace=name).write(
            tmp_path / "bag" / f"x{name.strip('/')}.mcap", content
        )
    with pytest.raises(
        InputError, match="topics of two cells, '/' and '/cell2'; choose"
    ):
        solved(tmp_path / "bag")
    check(tmp_path / "bag", expected, namespace=namespace)
    with pytest.raises(
        NoDataError, match="no topics of the cell '/'; choose one of /cell2"
    ):
        solved(tmp_path / "bag" / "xcell2.mcap", namespace=namespace)


@pytest.mark.parametrize(
    "more", ["", "uint32 grid_size_y\n", "uint32 grid_size_y\nuint32 views_planned\n"]
)
def test_without_definitions_messages_of_every_version_are_read(
    tmp_path, events, expected, more
):
    types = bags.contract_types(command=bags.COMMAND + more)
    path = Foreign(types=types, schemas=False).write(tmp_path / "x.mcap", events)
    check(path, expected)


def test_without_definitions_what_does_not_fit_is_said(tmp_path, events):
    types = bags.contract_types(EXTRA)
    path = Foreign(types=types, schemas=False).write(tmp_path / "x.mcap", events)
    with pytest.raises(
        NoDataError, match=r"no message on selfcal/view_command \(.*\); record"
    ):
        solved(path)
    reader = BagReader(path)
    assert {topic for topic, *_ in decoded(reader)} == {"stage/joint_states"}
    n_seen = sum(isinstance(event, Detection) for event in events)
    assert sorted(reader.lost) == [
        f"{count} messages on {topic} could not be decoded: the bag has no definition of {name}, "
        "and they do not fit the one known here"
        for count, topic, name in (
            (n_seen, "stage/mark_detections", bags.DETECTION_TYPE),
            (9, "selfcal/view_command", bags.COMMAND_TYPE),
        )
    ]


JOINT_STATE_IDL = """{line}
IDL: sensor_msgs/msg/JointState
// generated from rosidl_adapter/resource/msg.idl.em
// with input from sensor_msgs/msg/JointState.msg

#include "std_msgs/msg/Header.idl"

module sensor_msgs {{
  module msg {{
    @verbatim (language="comment", text=
      "This is a message that holds data to describe the state of joints." "\\n"
      "* the position of the joint (rad or m).")
    struct JointState {{
      std_msgs::msg::Header header;
      sequence<string> name;
      sequence<double> position;
      sequence<double> velocity;
      sequence<double> effort;
    }};
  }};
}};

{line}
IDL: std_msgs/msg/Header
#include "builtin_interfaces/msg/Time.idl"

module std_msgs {{
  module msg {{
    struct Header {{
      builtin_interfaces::msg::Time stamp;
      string frame_id;
    }};
  }};
}};

{line}
IDL: builtin_interfaces/msg/Time
module builtin_interfaces {{
  module msg {{
    struct Time {{
      int32 sec;
      uint32 nanosec;
    }};
  }};
}};
""".format(line="=" * 80)
"""As rosbag2 joins the files where the .msg is not installed."""


def test_definitions_as_idl(tmp_path, events, expected):
    plain = Foreign().write(tmp_path / "plain.mcap", events)
    path, channels = tmp_path / "idl.mcap", {}
    with plain.open("rb") as source, path.open("wb") as target:
        writer = Writer(target)
        writer.start("ros2")
        for schema, channel, message in make_reader(source).iter_messages():
            if channel.topic not in channels:
                is_joints = schema.name == "sensor_msgs/msg/JointState"
                number = (
                    writer.register_schema(
                        schema.name, "ros2idl", JOINT_STATE_IDL.encode()
                    )
                    if is_joints
                    else writer.register_schema(
                        schema.name, schema.encoding, schema.data
                    )
                )
                channels[channel.topic] = writer.register_channel(
                    channel.topic, channel.message_encoding, number
                )
            writer.add_message(
                channels[channel.topic],
                message.log_time,
                message.data,
                message.publish_time,
            )
        writer.finish()
    check(path, expected)


TYPES = {
    "command": ("selfcal/view_command", bags.COMMAND),
    "detection": ("stage/mark_detections", bags.DETECTION),
}


@pytest.mark.parametrize(
    ("which", "old", "new"),
    [
        ("detection", "float64 offset_x", "string offset_x"),
        ("detection", "uint8 kind", "string kind"),
        ("detection", "float32 score", "float64[] score"),
        ("detection", "int32 m", "std_msgs/Header m"),
        ("command", "string plan_id", "uint32 plan_id"),
        (
            "command",
            "uint32 angular_count",
            "uint32 angular_count\nstring views_planned",
        ),
        ("command", "uint32 grid_size", "uint32[3] grid_size"),
    ],
)
def test_a_field_of_another_type_is_named(tmp_path, events, which, old, new):
    topic, text = TYPES[which]
    assert old in text
    types = bags.contract_types(**{which: text.replace(old + "\n", new + "\n")})
    kept = [e for e in events if isinstance(e, EncoderSample)]
    kept.append(
        next(
            e
            for e in events
            if isinstance(e, Detection | Command)
            and isinstance(e, Detection) == (which == "detection")
        )
    )
    path = Foreign(types=types).write(tmp_path / "x.mcap", kept, spoil=True)
    field = new.split()[-1]
    with pytest.raises(
        InputError,
        match=f"topic /{topic}: another version of .*: the field "
        f"'{field}' has another type; record the bag with",
    ):
        solved(path)


def test_a_header_of_another_kind_is_named(tmp_path, events):
    types = bags.contract_types(
        detection=bags.DETECTION.replace(
            "std_msgs/Header header", "builtin_interfaces/Time header"
        )
    )
    path = Foreign(types=types).write(tmp_path / "x.mcap", events, spoil=True)
    with pytest.raises(InputError, match="the field 'header' has another type"):
        solved(path)


def test_bounds_on_lengths_are_free(tmp_path, events, expected):
    types = bags.contract_types(
        command=bags.COMMAND.replace("string plan", "string<=64 plan")
    )
    check(Foreign(types=types).write(tmp_path / "x.mcap", events), expected)


@pytest.mark.parametrize("mode", [CompressionMode.FILE, CompressionMode.MESSAGE])
def test_bags_that_rosbag2_compressed(tmp_path, events, expected, mode):
    bag = bags.rosbags_bag(tmp_path / "bag", events, mode)
    [file] = bag.glob("*.mcap*")
    assert (file.suffix == ".zstd") == (mode == CompressionMode.FILE)
    check(bag, expected)
    check(file, expected)
    (bag / "metadata.yaml").unlink()
    check(bag, expected)


def test_a_compressed_file_beside_its_plain_one_is_read_once(
    tmp_path, events, expected
):
    bag = bags.rosbags_bag(tmp_path / "bag", events, CompressionMode.FILE)
    [file] = bag.glob("*.mcap.zstd")
    file.with_suffix("").write_bytes(
        zstandard.ZstdDecompressor().stream_reader(file.read_bytes()).read()
    )
    check(bag, expected)
    (bag / "metadata.yaml").unlink()
    check(bag, expected)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda data: data[: len(data) * 9 // 10],
        lambda data: data[:-900] + bytes(50) + data[-850:],
    ],
)
def test_a_compressed_file_that_is_damaged_is_read_as_far_as_it_goes(tmp_path, spoil):
    events = events_of(small_plan())
    bag = bags.rosbags_bag(tmp_path / "bag", events, CompressionMode.FILE)
    [file] = bag.glob("*.mcap.zstd")
    data = file.read_bytes()
    file.write_bytes(spoil(data))
    reader = BagReader(bag)
    assert 100 < len(list(decoded(reader))) < len(events)
    assert reader.lost
    file.write_bytes(data[:100])
    with pytest.raises(
        InputError, match="no part of the compressed file can be read; record"
    ):
        solved(bag)


def test_a_message_whose_compression_is_damaged_is_counted(tmp_path, events):
    bag = bags.rosbags_bag(tmp_path / "bag", events, CompressionMode.MESSAGE)
    [file] = bag.glob("*.mcap")
    data = bytearray(file.read_bytes())
    data[data.index(b"\x28\xb5\x2f\xfd") + 4] ^= 0xFF
    file.write_bytes(data)
    reader = BagReader(bag)
    assert len(list(decoded(reader))) == len(events) - 1
    assert reader.lost == ["1 messages on selfcal/view_command could not be decoded"]


def test_a_file_listed_twice_is_read_once(tmp_path, events, expected):
    Foreign().write(tmp_path / "bag" / "a.mcap", events)
    (tmp_path / "bag" / "metadata.yaml").write_text(
        yaml.safe_dump(
            {
                "rosbag2_bagfile_information": {
                    "relative_file_paths": ["a.mcap", "a.mcap"]
                }
            }
        )
    )
    check(tmp_path / "bag", expected)


def test_a_folder_with_the_name_of_a_file_is_no_file(tmp_path, events, expected):
    Foreign().write(tmp_path / "bag" / "a.mcap", events)
    (tmp_path / "bag" / "b.mcap").mkdir()
    check(tmp_path / "bag", expected)


def played(path):
    """Return the result of the bytes that a player sends, decoded by the own types."""
    messages = [
        (topic, typestore().deserialize_cdr(data, INPUT_TOPICS[topic]))
        for topic, _, data in BagReader(path).cdr_messages()
    ]
    collector = Collector(VALUES)
    feed = {
        ENCODER_TOPIC: lambda m: collector.add_encoder(to_model.encoder_sample(m)),
        DETECTION_TOPIC: lambda m: collector.add_detection(to_model.detection(m)),
        COMMAND_TOPIC: lambda m: collector.add_command(to_model.command(m)),
    }
    for topic, message in messages:
        feed[topic](message)
    return calibrated(collector.collect()[0])


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"types": bags.contract_types(EXTRA)},
        {"schemas": False},
        {"types": bags.contract_types(command=bags.COMMAND + "uint32 grid_size_y\n")},
    ],
    ids=["contract", "more fields", "no definitions", "one version back"],
)
def test_the_bytes_to_play_are_of_the_own_types_and_give_the_same(
    tmp_path, events, expected, options
):
    path = Foreign(**options).write(tmp_path / "x.mcap", events)
    assert played(path) == expected


def test_bytes_of_the_own_types_are_played_as_they_are(tmp_path, events):
    path = Foreign().write(tmp_path / "x.mcap", events)
    raw = {message.data for _, message in McapStream(path).messages()}
    sent = [(topic, data) for topic, _, data in BagReader(path).cdr_messages()]
    assert {topic for topic, data in sent if data not in raw} == {
        "selfcal/view_command"
    }


def test_bytes_of_the_other_order_are_turned(tmp_path, events, expected):
    types = bags.contract_types()
    swapped = Foreign(little=False, types=types).write(tmp_path / "x.mcap", events)
    check(swapped, expected)
    assert played(swapped) == expected
    assert {data[1] for _, _, data in BagReader(swapped).cdr_messages()} == {1}
