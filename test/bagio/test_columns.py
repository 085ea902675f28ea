# SPDX-License-Identifier: Apache-2.0
"""Bags as columns say the same as bags message by message; indexes spare what is not needed."""

import struct

import numpy as np
import pytest
from mcap.opcode import Opcode
from mcap.records import Channel, Message, Schema
from mcap.stream_reader import breakup_chunk
from mcap.writer import CompressionType, Writer

from selfcal_ros.bagio import mcap_chunk, mcap_salvage
from selfcal_ros.bagio.mcap_chunk import MessageBlock, chunk_items
from selfcal_ros.bagio.messages.to_model import detection, encoder_sample
from selfcal_ros.bagio.reader import BagReader
from selfcal_ros.bagio.schemas import ENOUGH
from selfcal_ros.collection.inputs import Detection, EncoderSample
from selfcal_ros.topics import COMMAND_TOPIC, DETECTION_TOPIC, ENCODER_TOPIC
from test.support import bags
from test.support.bags import COMPRESSIONS, Foreign
from test.support.sessions import decoded, events_of, small_plan

EXTRA = "float64 temperature\nstring operator\n"


@pytest.fixture(scope="module")
def events():
    return events_of(small_plan("0", repeats=1))


def contract_fields(command):
    """Return the fields of a command that every version of the message has."""
    return [
        getattr(command, name)
        for name in (
            "phase",
            "plan_id",
            "view_index",
            "view_name",
            "rotation",
            "translation_x",
            "translation_y",
            "grid",
            "angular",
            "repeats",
            "grid_size",
            "grid_pitch",
            "angular_count",
        )
    ]


def one_by_one(path):
    """Return all inputs of a bag as sorted texts, and what was lost."""
    reader = BagReader(path)
    turn = {
        ENCODER_TOPIC: encoder_sample,
        DETECTION_TOPIC: detection,
        COMMAND_TOPIC: contract_fields,
    }
    found = sorted(repr(turn[topic](message)) for topic, _, message in decoded(reader))
    return found, reader.lost


def by_columns(path):
    reader, out = BagReader(path), []
    for topic, item in reader.columns():
        if topic == ENCODER_TOPIC:
            speeds = (
                [()] * len(item)
                if item.velocities is None
                else item.velocities.tolist()
            )
            out += [
                EncoderSample(stamp, item.names, tuple(position), tuple(speed))
                for stamp, position, speed in zip(
                    item.stamps_ns.tolist(),
                    item.positions.tolist(),
                    speeds,
                    strict=True,
                )
            ]
        elif topic == DETECTION_TOPIC:
            out += [Detection(*row) for row in item.tolist()]
        else:
            out.append(contract_fields(item))
    return sorted(map(repr, out)), reader.lost


def check(path, n_expected, lost=()):
    found, said = by_columns(path)
    assert (found, said) == one_by_one(path)
    assert len(found) == n_expected
    assert said == list(lost)


@pytest.mark.parametrize(
    "foreign",
    [
        Foreign(),
        Foreign({"chunk_size": 1}),
        Foreign({"use_chunking": False}),
        Foreign(little=False),
        Foreign({"chunk_size": 900}, others=True),
        Foreign(types=bags.contract_types(EXTRA)),
        Foreign(schemas=False),
    ],
    ids=[
        "plain",
        "a chunk a message",
        "no chunks",
        "big endian",
        "others",
        "more fields",
        "no definitions",
    ],
)
def test_columns_hold_what_the_messages_hold(tmp_path, events, foreign):
    check(foreign.write(tmp_path / "x.mcap", events), len(events))


class Tailed(Foreign):
    """Messages as ``rclpy.serialization.serialize_message`` leaves them: with a tail."""

    tail = bytes(range(1, 9))

    def _payload(self, event):
        topic, data = super()._payload(event)
        return topic, data + self.tail


@pytest.mark.parametrize("little", [True, False])
@pytest.mark.parametrize("size", [1, 4, 8, 40])
def test_what_stands_behind_the_fields_is_not_looked_at(tmp_path, events, little, size):
    plain = one_by_one(Foreign().write(tmp_path / "plain.mcap", events))
    foreign = Tailed(little=little)
    object.__setattr__(foreign, "tail", bytes(range(1, size + 1)))
    path = foreign.write(tmp_path / "x.mcap", events)
    assert one_by_one(path) == plain
    assert by_columns(path) == plain
    sent = [data for _, _, data in BagReader(path).cdr_messages()]
    assert len(sent) == len(events) and {data[:2] for data in sent} == {b"\0\1"}


def test_without_definitions_only_a_type_of_one_length_may_have_a_tail(
    tmp_path, events
):
    path = Tailed(schemas=False).write(tmp_path / "x.mcap", events)
    n_samples = sum(isinstance(event, EncoderSample) for event in events)
    found, lost = by_columns(path)
    assert (found, sorted(lost)) == (one_by_one(path)[0], sorted(one_by_one(path)[1]))
    n_found = sum(text.startswith("EncoderSample") for text in found)
    assert n_found == n_samples
    assert any(
        "messages on stage/mark_detections could not be decoded: the bag has no" in line
        for line in lost
    )


class Damaged(Foreign):
    """Every third payload is cut, every fifth has a name that is no text."""

    def write(self, path, events, **more):
        object.__setattr__(self, "count", [0])
        return super().write(path, events, **more)

    def _payload(self, event):
        topic, data = super()._payload(event)
        self.count[0] += 1
        if self.count[0] % 3 == 0:
            return topic, data[:-7]
        spoiled = data.replace(b"somewhere", b"some\xffhere")
        return topic, data if self.count[0] % 5 else spoiled


def test_damaged_payloads_are_counted_alike(tmp_path, events):
    path = Damaged().write(tmp_path / "x.mcap", events)
    found, lost = by_columns(path)
    assert found == one_by_one(path)[0]
    assert sorted(lost) == sorted(one_by_one(path)[1])
    said = sum(int(line.split()[0]) for line in lost)
    assert said == len(events) - len(found)
    assert said == len(events) // 3 + len(events) // 5 - len(events) // 15
    n_sent = sum(1 for _ in BagReader(path).cdr_messages())
    assert n_sent == len(found)


def test_joints_that_differ_in_number_are_kept_apart(tmp_path):
    samples = [
        EncoderSample(10**9 + i, ("x", "y", "theta")[: i % 3 + 1], (0.5,) * (i % 3 + 1))
        for i in range(300)
    ]
    samples.append(EncoderSample(5, ("x", "y"), (1.0,)))
    check(Foreign().write(tmp_path / "x.mcap", samples), 301)


def test_messages_of_small_chunks_are_decoded_together(tmp_path, monkeypatch):
    samples = [EncoderSample(i, ("x",), (0.5,)) for i in range(ENOUGH + 10)]
    path = Foreign({"chunk_size": 1}).write(tmp_path / "x.mcap", samples)
    assert [len(block) for _, block in BagReader(path).columns()] == [ENOUGH, 10]


def write_topics(path, chunks, *, crcs=True, compression=CompressionType.NONE):
    """Write chunks of (topic, count) each; JointStates on ours, noise on the others."""
    sample = Foreign()._payload(EncoderSample(5, ("x",), (0.5,)))[1]
    with path.open("wb") as file:
        writer = Writer(
            file, chunk_size=1 << 30, enable_crcs=crcs, compression=compression
        )
        writer.start(profile="ros2", library="by somebody else")
        text = bags.contract_types().generate_msgdef(bags.ENCODER_TYPE, ros_version=2)[
            0
        ]
        schema = writer.register_schema(bags.ENCODER_TYPE, "ros2msg", text.encode())
        ids = {}
        for chunk in chunks:
            for topic, count in chunk:
                if topic not in ids:
                    ids[topic] = writer.register_channel(topic, "cdr", schema)
                for number in range(count):
                    writer.add_message(ids[topic], number, sample, number)
            writer.flush()
        writer.finish()
    return path


CHUNKS = [
    [("/camera", 5)],
    [("/stage/joint_states", 7), ("/camera", 2)],
    [("/camera", 30)],
    [("/lidar", 1), ("/camera", 2)],
    [("/cell2/stage/joint_states", 3)],
]


@pytest.fixture
def opened(monkeypatch):
    """Count the chunks that are looked into."""
    seen = []
    monkeypatch.setattr(
        mcap_chunk, "chunk_items", lambda chunk: seen.append(1) or chunk_items(chunk)
    )
    return seen


def test_chunks_without_our_topics_are_passed(tmp_path, opened):
    path = write_topics(tmp_path / "x.mcap", CHUNKS)
    reader = BagReader(path, namespace="")
    assert sum(len(block) for _, block in reader.columns()) == 7
    assert reader.lost == [] and reader.cells == {"", "cell2"}
    assert len(opened) == 2


def test_a_damaged_index_is_not_believed(tmp_path, opened):
    path = write_topics(tmp_path / "x.mcap", CHUNKS)
    data = bytearray(path.read_bytes())
    data[data.rindex(b"/lidar")] ^= 1
    path.write_bytes(data)
    reader = BagReader(path, namespace="")
    assert sum(len(block) for _, block in reader.columns()) == 7
    assert reader.lost == [] and len(opened) == len(CHUNKS)


def test_an_index_without_checksum_is_not_believed(tmp_path, opened):
    path = write_topics(tmp_path / "x.mcap", CHUNKS, crcs=False)
    assert sum(len(block) for _, block in BagReader(path, namespace="").columns()) == 7
    assert len(opened) == len(CHUNKS)


def test_a_chunk_that_is_passed_but_cut_short_is_found_out(tmp_path, opened):
    path = write_topics(tmp_path / "x.mcap", CHUNKS)
    data = path.read_bytes()
    reader = BagReader(path, namespace="")
    with path.open("rb") as file:
        passed = mcap_chunk.read_summary(file).needless(lambda topic: "joint" in topic)
    (place, end), *_ = passed.items()
    assert len(passed) == 3 and data[place] == Opcode.CHUNK
    path.write_bytes(
        data[: place + 1] + struct.pack("<Q", end - place) + data[place + 9 :]
    )
    assert sum(len(block) for _, block in reader.columns()) == 7
    assert len(opened) == 3 and len(reader.lost) <= 1


def record(opcode, body):
    return struct.pack("<BQ", opcode, len(body)) + body


def message(channel, payload, stamp=7):
    return record(
        Opcode.MESSAGE, struct.pack("<HIQQ", channel, 3, stamp, stamp + 1) + payload
    )


class FakeChunk:
    compression, uncompressed_crc = "", 0

    def __init__(self, data):
        self.data = data


def flat(items):
    """Return the records in the items of a chunk."""
    out = []
    for item in items:
        out += item.messages() if isinstance(item, MessageBlock) else [item]
    return out


def text(value):
    return struct.pack("<I", len(value)) + value


CHANNEL = record(
    Opcode.CHANNEL, struct.pack("<HH", 4, 0) + text(b"/a") + text(b"cdr") + text(b"")
)
SCHEMA = record(
    Opcode.SCHEMA, struct.pack("<H", 9) + text(b"n") + text(b"e") + text(b"definition")
)


@pytest.mark.parametrize("seed", range(60))
def test_a_chunk_gives_what_the_library_gives(seed):
    rng = np.random.default_rng(seed)
    parts = []
    for _ in range(rng.integers(1, 12)):
        choice = rng.integers(6)
        size = int(rng.integers(0, 40))
        if choice < 3:
            parts += [
                message(int(rng.integers(3)), rng.bytes(size), int(rng.integers(2**62)))
                for _ in range(rng.integers(1, (3, 90, 400)[choice]))
            ]
        elif choice == 3:
            period = int(rng.integers(2, 90))
            sizes = rng.integers(0, 40, period) if choice == 3 else np.arange(3)
            parts += [
                message(i % 3, rng.bytes(int(sizes[i % len(sizes)])))
                for i in range(int(rng.integers(60, 700)))
            ]
        else:
            parts.append(
                (CHANNEL, SCHEMA, record(0x99, rng.bytes(size + 1)))[rng.integers(3)]
            )
    data = b"".join(parts)
    expected = breakup_chunk(FakeChunk(data))
    assert flat(chunk_items(FakeChunk(data))) == expected
    between = len(b"".join(parts[: len(parts) // 2]))
    for cut in (*rng.integers(0, len(data), 2), between):
        outcomes = []
        for read in (lambda chunk: flat(chunk_items(chunk)), breakup_chunk):
            try:
                outcomes.append(read(FakeChunk(data[:cut])))
            except Exception as error:
                outcomes.append(type(error))
        assert outcomes[0] == outcomes[1]


def test_records_between_messages_keep_their_place():
    data = message(1, b"a") + CHANNEL + message(4, b"b") + message(4, b"c") + SCHEMA
    kinds = [type(item) for item in chunk_items(FakeChunk(data))]
    assert kinds == [MessageBlock, Channel, MessageBlock, Schema]
    assert [
        m.data for m in flat(chunk_items(FakeChunk(data))) if isinstance(m, Message)
    ] == [b"a", b"b", b"c"]


def test_runs_are_taken_at_once(monkeypatch):
    data = b"".join(message(1, bytes(20)) for _ in range(5000))
    singles = []
    unpack = mcap_salvage.HEAD.unpack_from
    monkeypatch.setattr(
        mcap_salvage,
        "HEAD",
        type(
            "Head",
            (),
            {
                "size": 9,
                "unpack_from": staticmethod(
                    lambda d, at: singles.append(at) or unpack(d, at)
                ),
            },
        ),
    )
    [block] = chunk_items(FakeChunk(data))
    assert len(block) == 5000
    assert singles == [0, 51, 102]  # three tell the length of those behind them


@pytest.mark.parametrize("behind", [b"", CHANNEL, message(1, b"cut short")[:-1]])
@pytest.mark.parametrize("n", [0, 1, 2, 3, 4, 5, 6, 8, 67, 70, 400])
@pytest.mark.parametrize("lengths", [(7,), (2, 5), (1, 1, 4, 0)])
def test_messages_in_a_row_are_found_up_to_what_stands_behind_them(lengths, n, behind):
    payloads = [bytes([i % 251]) * lengths[i % len(lengths)] for i in range(n)]
    front = SCHEMA + b"".join(
        message(i % 3, payload, i) for i, payload in enumerate(payloads)
    )
    block, end = mcap_chunk.message_block(front + behind, len(SCHEMA))
    assert end == len(front)
    assert [bytes(payload) for payload in block.payloads] == payloads
    assert block.fronts["log_time"].tolist() == list(range(n))
    assert block.fronts["channel"].tolist() == [i % 3 for i in range(n)]


@pytest.mark.parametrize(
    "pattern", [(20, 40), (20, 40, 40, 40, 40, 40, 40, 40, 20), tuple(range(1, 65))]
)
def test_lengths_that_come_again_are_taken_at_once(monkeypatch, pattern):
    lengths = [pattern[i % len(pattern)] for i in range(6000)]
    lengths[3000] += 1  # one visit is another: the rest is found again
    data = b"".join(
        message(1, bytes([i % 251]) * length) for i, length in enumerate(lengths)
    )
    looked = []
    unpack = mcap_salvage.HEAD.unpack_from
    monkeypatch.setattr(
        mcap_salvage,
        "HEAD",
        type(
            "Head",
            (),
            {
                "size": 9,
                "unpack_from": staticmethod(
                    lambda d, at: looked.append(at) or unpack(d, at)
                ),
            },
        ),
    )
    [block] = chunk_items(FakeChunk(data))
    assert block.payloads.length.tolist() == lengths
    assert [data[0] for data in block.payloads] == [i % 251 for i in range(6000)]
    assert len(looked) < 1000


@pytest.mark.parametrize(
    "sizes, period",
    [
        ([7, 7, 7], [7]),
        ([7, 7, 8], []),
        ([1, 2, 1, 2], [1, 2]),
        ([1, 2, 1, 2, 1], [2, 1]),
        ([1, 2, 1], []),
        ([1, 1, 2, 1, 1, 2], [1, 1, 2]),
        (list(range(64)) * 2, list(range(64))),
        (list(range(65)) * 2, []),
    ],
)
def test_a_period_is_one_that_came_twice(sizes, period):
    assert mcap_chunk._period(np.array(sizes)).tolist() == period


@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_times_of_logging_beyond_63_bits_are_kept(tmp_path, compression):
    path = tmp_path / "x.mcap"
    with path.open("wb") as file:
        writer = Writer(file, compression=COMPRESSIONS[compression])
        writer.start()
        channel = writer.register_channel("/stage/joint_states", "cdr", 0)
        data = Foreign()._payload(EncoderSample(5, ("x",), (0.5,)))[1]
        writer.add_message(channel, 2**64 - 1, data, 0)
        writer.finish()
    assert [stamp for _, stamp, _ in BagReader(path).cdr_messages()] == [2**64 - 1]
