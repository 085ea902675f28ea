# SPDX-License-Identifier: Apache-2.0
"""Columns from bytes agree with rosbags, message by message; what is damaged is left over."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from selfcal_ros.bagio.messages import cdr
from selfcal_ros.bagio.messages.cdr import ColumnDecoder, Payloads, layout_of
from selfcal_ros.bagio.messages.to_model import (
    JOINT_STATE,
    PositionEditor,
    detection_table,
    encoder_block,
)
from selfcal_ros.bagio.schemas import fields_of, typestore

STORE = typestore()
JOINTS, MARK = "sensor_msgs/msg/JointState", "selfcal_msgs/msg/MarkDetection"


def header(stamp_ns, frame="stage", store=STORE):
    time = store.types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, 10**9))
    return store.types["std_msgs/msg/Header"](stamp=time, frame_id=frame)


def joint_state(
    stamp_ns,
    names=("x", "y", "theta"),
    positions=(1.0, -2.0, 3.0),
    velocities=(),
    effort=(),
    frame="stage",
):
    return STORE.types[JOINTS](
        header=header(stamp_ns, frame),
        name=list(names),
        position=np.array(positions, dtype=float),
        velocity=np.array(velocities, dtype=float),
        effort=np.array(effort, dtype=float),
    )


def mark(stamp_ns, rng):
    return STORE.types[MARK](
        header=header(stamp_ns),
        kind=int(rng.integers(3)),
        has_id=bool(rng.integers(2)),
        m=int(rng.integers(-9, 9)),
        n=int(rng.integers(-9, 9)),
        k=int(rng.integers(2**32)),
        offset_x=rng.normal(),
        offset_y=rng.normal(),
        offset_theta=rng.normal(),
        sigma=rng.normal(),
        score=float(np.float32(rng.uniform())),
    )


def as_cdr(message, little=True, tail=b"", name=JOINTS, store=STORE):
    return bytes(store.serialize_cdr(message, name, little_endian=little)) + tail


def blocks_of(data, fields=JOINT_STATE, tail=None):
    """Return the encoder samples of messages in blocks, and the indices of what remains."""
    groups, rest = ColumnDecoder(fields, tail).decode(Payloads.joined(data))
    return [encoder_block(group) for group in groups], rest


def samples(blocks):
    """Return the samples of blocks as tuples, in the order of their stamps."""
    return sorted(
        (
            stamp,
            block.names,
            tuple(position),
            () if block.velocities is None else tuple(block.velocities[i].tolist()),
        )
        for block in blocks
        for i, (stamp, position) in enumerate(
            zip(block.stamps_ns.tolist(), block.positions.tolist(), strict=True)
        )
    )


def test_the_fields_are_those_of_the_definitions():
    assert fields_of(STORE, JOINTS) == JOINT_STATE


texts = st.text(
    st.characters(blacklist_categories=["Cs"], blacklist_characters="\0"), max_size=9
)
numbers = st.lists(st.floats(allow_nan=False), max_size=4)
states = st.tuples(
    st.lists(texts, max_size=4),
    numbers,
    numbers,
    numbers,
    texts,
    st.booleans(),
    st.binary(max_size=9),
)


@settings(deadline=None, max_examples=30)
@given(st.lists(states, min_size=1, max_size=30))
def test_any_mixture_of_layouts_gives_what_rosbags_gives(drawn):
    data, expected = [], []
    for number, (names, position, velocity, effort, frame, little, tail) in enumerate(
        drawn * 3
    ):
        stamp = number * 1_500_000_001
        message = joint_state(stamp, names, position, velocity, effort, frame)
        data.append(as_cdr(message, little, tail))
        expected.append((stamp, tuple(names), tuple(position), tuple(velocity)))
    blocks, rest = blocks_of(data)
    left = {number * 1_500_000_001 for number in rest.tolist()}
    assert samples(blocks) == [item for item in expected if item[0] not in left]
    assert len(left) <= max(0, len(data) - cdr.FREE_TRIES)


def test_detections_of_both_byte_orders():
    rng = np.random.default_rng(1)
    marks = [mark(1_700_000_000_999_999_999 + 10**9 * i, rng) for i in range(50)]
    data = [as_cdr(m, little=bool(i % 3), name=MARK) for i, m in enumerate(marks)]
    groups, rest = ColumnDecoder(fields_of(STORE, MARK)).decode(Payloads.joined(data))
    tables = [detection_table(group) for group in groups]
    assert len(tables) == 2 and not len(rest)
    rows = sorted(row for table in tables for row in table.tolist())
    assert rows == [
        (
            1_700_000_000_999_999_999 + 10**9 * i,
            m.kind,
            m.has_id,
            m.m,
            m.n,
            m.k,
            m.offset_x,
            m.offset_y,
            m.offset_theta,
            m.sigma,
            m.score,
        )
        for i, m in enumerate(marks)
    ]


def test_a_stamp_before_1970_is_negative():
    message = joint_state(0)
    message.header.stamp = STORE.types["builtin_interfaces/msg/Time"](-2, 5)
    [block], _ = blocks_of([as_cdr(message)])
    assert block.stamps_ns.tolist() == [-1_999_999_995]


def test_fields_before_between_and_behind_the_known_ones():
    store = get_typestore(Stores.ROS2_JAZZY)
    text = (
        "uint8 first\nPart[] parts\nstd_msgs/Header header\nstring[2] pair\nstring[] name\n"
        "float64[] velocity\nbool b\nfloat64[] position\nPart[2] two\nPart one\n"
        + "=" * 80
        + "\nMSG: pkg/Part\nuint8 a\nfloat64 b\nstring c\nint16[3] d\n"
    )
    store.register(get_types_from_msg(text, "pkg/msg/Odd"))
    part = store.types["pkg/msg/Part"]
    parts = [part(1, 2.0, "three", np.array([4, 5, 6], dtype=np.int16))] * 3
    data = []
    for i in range(6):
        message = store.types["pkg/msg/Odd"](
            first=7,
            parts=parts[: i % 2],
            header=header(i, store=store),
            pair=["a", "bc"],
            name=["x", "y"],
            velocity=np.array([0.5, i]),
            b=True,
            position=np.array([i, -1.0]),
            two=parts[:2],
            one=parts[0],
        )
        data.append(as_cdr(message, i < 4, name="pkg/msg/Odd", store=store))
    blocks, rest = blocks_of(data, fields_of(store, "pkg/msg/Odd"))
    assert not len(rest) and len(blocks) == 4
    assert samples(blocks) == [(i, ("x", "y"), (i, -1.0), (0.5, i)) for i in range(6)]


def test_a_basic_type_without_a_numpy_code_is_left_to_rosbags():
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(
        get_types_from_msg("std_msgs/Header header\nfloat128 much\n", "pkg/msg/Long")
    )
    assert fields_of(store, "pkg/msg/Long") is None


def test_padding_may_hold_anything():
    data = bytearray(as_cdr(joint_state(5, effort=[1.0])))
    other = bytearray(as_cdr(joint_state(6, effort=[1.0])))
    layout = layout_of(JOINT_STATE, bytes(data))
    inside = set(range(2, len(data))) - {
        i for i, fixed in enumerate(layout.fixed) if fixed
    }
    for code, at, count in layout.values.values():
        inside -= set(range(at, at + int(code[2:]) * (1 if count is None else count)))
    assert inside - {2, 3}, "this message has padding"
    for at in inside:
        other[at] = 0xA5
    blocks, _ = blocks_of([bytes(data), bytes(other)])
    assert [len(block) for block in blocks] == [2]


@pytest.mark.parametrize("little", [True, False])
def test_no_part_of_a_message_is_taken_for_a_whole_one(little):
    whole = as_cdr(joint_state(5, velocities=[1.0, 2.0, 3.0]), little)
    cut = [whole[:size] for size in range(len(whole))]
    blocks, rest = blocks_of([*cut, whole, whole])
    assert [len(block) for block in blocks] == [2]
    assert rest.tolist() == list(range(len(cut)))


@pytest.mark.parametrize(
    "spoil",
    [
        lambda d: b"\0\2" + d[2:],
        lambda d: b"\1\1" + d[2:],
        lambda d: d.replace(b"theta\0", b"theta!"),
        lambda d: d.replace(b"theta", b"\xff\xfe\xff\xfe\xff"),
        lambda d: d.replace(b"stage\0", b"stage\1"),
        lambda d: d.replace(b"\6\0\0\0stage", b"\0\0\0\0stage"),
        lambda d: d.replace(b"\3\0\0\0\2\0\0\0x", b"\xff\xff\xff\x7f\2\0\0\0x"),
    ],
    ids=[
        "XCDR",
        "encapsulation",
        "no end of a name",
        "no UTF-8",
        "no end of the frame",
        "text of length 0",
        "very many names",
    ],
)
def test_damaged_messages_are_left_to_rosbags_which_refuses_them(spoil):
    good = as_cdr(joint_state(5))
    bad = spoil(good)
    assert bad != good
    with pytest.raises(Exception, match=r"deserialize|Invalid|Missing"):
        STORE.deserialize_cdr(bad, JOINTS)
    blocks, rest = blocks_of([good, bad, good])
    assert [len(block) for block in blocks] == [2] and rest.tolist() == [1]
    blocks, rest = blocks_of([bad, good, good])
    assert [len(block) for block in blocks] == [2] and rest.tolist() == [0]


def test_how_much_may_stand_behind_the_last_field():
    data = [as_cdr(joint_state(i), tail=bytes(i)) for i in range(12)]
    assert blocks_of(data)[1].tolist() == []
    assert blocks_of(data, tail=3)[1].tolist() == list(range(4, 12))


def test_layouts_that_few_share_are_not_tried_without_end(monkeypatch):
    tried = []
    monkeypatch.setattr(
        cdr,
        "layout_of",
        lambda fields, data: tried.append(1) or layout_of(fields, data),
    )
    data = [as_cdr(joint_state(i, frame=f"{i:05d}")) for i in range(640)]
    blocks, rest = blocks_of(data)
    assert len(tried) == len(blocks) == cdr.FREE_TRIES + 640 // cdr.WORTH
    assert len(rest) == 640 - len(blocks)
    assert samples(blocks) == [
        (i, ("x", "y", "theta"), (1.0, -2.0, 3.0), ())
        for i in sorted(set(range(640)) - set(rest.tolist()))
    ]


def test_known_layouts_are_not_walked_again(monkeypatch):
    decoder = ColumnDecoder(JOINT_STATE)
    data = [
        as_cdr(joint_state(i, names=("x", "y", "theta")[i % 3 :][:1], positions=[i]))
        for i in range(30)
    ]
    groups, _ = decoder.decode(Payloads.joined(data))
    assert sorted(len(group) for group in groups) == [10, 10, 10]
    monkeypatch.setattr(cdr, "layout_of", None)
    assert samples(
        map(encoder_block, decoder.decode(Payloads.joined(data))[0])
    ) == samples(map(encoder_block, groups))


def test_the_memory_of_layouts_is_bounded():
    decoder = ColumnDecoder(JOINT_STATE)
    for i in range(cdr.MAX_LENGTHS + 9):
        for frame in ("a", "b"):
            data = as_cdr(joint_state(0, frame=frame * (i + 1)))
            assert len(decoder.decode(Payloads.joined([data]))[0]) == 1
    assert len(decoder._known) <= cdr.MAX_LENGTHS
    for i in range(cdr.MAX_KNOWN + 9):
        decoder.decode(Payloads.joined([as_cdr(joint_state(0, frame=f"{i:04d}"))]))
    assert max(map(len, decoder._known.values())) == cdr.MAX_KNOWN


def test_long_messages_have_few_layouts_and_longer_ones_none(monkeypatch):
    """Names of random length: each message would have a layout of its own, of 1 ms a kB."""

    def named(length):
        shortest = len(as_cdr(joint_state(0, names=[""])))
        return as_cdr(joint_state(0, names=["x" * (length - shortest)]))

    longest = named(cdr.MAX_LENGTH - 4) + bytes(4)
    assert len(longest) == cdr.MAX_LENGTH
    decoder = ColumnDecoder(JOINT_STATE)
    groups, rest = decoder.decode(
        Payloads.joined([longest, *(named(length) for length in range(4004, 4404, 8))])
    )
    assert [len(group.layout.example) for group in groups] == [4004, 4012, 4020]
    assert len(rest) == 48
    for length in range(2000, cdr.MAX_LENGTH, 100):
        decoder.decode(Payloads.joined([named(length)]))
    kept = [layout.length for known in decoder._known.values() for layout in known]
    assert cdr.MAX_KNOWN_BYTES - 2 * max(kept) < sum(kept) <= cdr.MAX_KNOWN_BYTES
    assert decoder.decode(Payloads.joined([longest]))[1].tolist() == []
    assert decoder.decode(Payloads.joined([longest + b"0"]))[1].tolist() == [0]


def test_a_field_that_is_not_there():
    decoder = ColumnDecoder(JOINT_STATE)
    [columns], _ = decoder.decode(Payloads.joined([as_cdr(joint_state(0))]))
    assert "position" in columns and "word 0" not in columns
    with pytest.raises(KeyError, match="acceleration"):
        columns["acceleration"]


def test_nothing_gives_nothing():
    blocks, rest = blocks_of([])
    assert blocks == [] and len(rest) == 0


@pytest.mark.parametrize("little", [True, False])
@pytest.mark.parametrize("count", [0, 1, 3])
def test_of_a_joint_state_the_positions_alone_are_replaced(little, count):
    before = joint_state(
        7,
        names=("a", "bcd", "theta"),
        positions=np.arange(count) + 0.5,
        velocities=[1.0, 2.0],
        effort=[3.0],
    )
    editor, data = PositionEditor(), as_cdr(before, little, tail=b"tail")
    assert editor.read(data) == (("a", "bcd", "theta"), tuple(before.position))
    after = editor.replaced(data, (-before.position).tolist())
    before.position = -before.position
    assert after == as_cdr(before, little, tail=b"tail")


def test_an_editor_keeps_the_layouts_of_several_publishers_apart(monkeypatch):
    editor = PositionEditor()
    data = [
        as_cdr(joint_state(i, names=("x", "y", "theta")[i:][:1], positions=[float(i)]))
        for i in range(3)
    ]
    for _ in range(2):
        for number, message in enumerate(data):
            [name], [position] = editor.read(message)
            assert (name, position) == (("x", "y", "theta")[number], number)
            assert editor.replaced(message, [9.0]) == as_cdr(
                joint_state(number, names=[name], positions=[9.0])
            )
        monkeypatch.setattr(cdr, "layout_of", None)  # each is walked once
    monkeypatch.undo()
    for i in range(cdr.MAX_KNOWN + 9):
        editor.read(as_cdr(joint_state(0, frame=f"{i:04d}")))
    assert len(editor._known) == cdr.MAX_KNOWN


def test_an_editor_refuses_what_is_cut_or_too_long():
    editor = PositionEditor()
    whole = as_cdr(joint_state(5, velocities=[1.0, 2.0, 3.0]))
    assert editor.read(whole) is not None
    assert [size for size in range(len(whole)) if editor.read(whole[:size])] == []
    assert (
        editor.read(as_cdr(joint_state(5, positions=np.zeros(cdr.MAX_LENGTH // 8))))
        is None
    )
