# SPDX-License-Identifier: Apache-2.0
"""Where reading goes on in a damaged file: at what is a chunk by its own lengths."""

import struct

import lz4.frame
import pytest
import zstandard

from selfcal_ros.bagio.mcap_salvage import declarations, front_of_chunk, next_record

DATA_END = b"\x0f" + struct.pack("<QI", 4, 0) + b"\x0b"
"""The end of the data section, and the opcode of what stands behind it."""


def chunk(name: bytes, inside: bytes, *, told: int | None = None) -> bytes:
    """Return a chunk as the MCAP specification has it; `told` = a wrong length of its records."""
    content = (
        struct.pack("<QQQII", 1, 2, len(inside), 0, len(name))
        + name
        + struct.pack("<Q", len(inside) if told is None else told)
        + inside
    )
    return b"\x06" + struct.pack("<Q", len(content)) + content


@pytest.mark.parametrize("name", [b"", b"lz4", b"zstd"])
@pytest.mark.parametrize("inside", [b"", b"x", b"records of it"])
def test_a_chunk_is_found_also_if_it_holds_nothing(name, inside):
    data = b"?" * 11 + chunk(name, inside) + DATA_END + b"?" * 30
    assert next_record(data, 0, None) == 11
    assert next_record(data, 11, None) == 11 + len(chunk(name, inside))


@pytest.mark.parametrize("told", [3, 5, 1 << 60])
def test_what_disagrees_with_its_lengths_is_no_chunk(told):
    data = b"?" * 11 + chunk(b"zstd", b"four", told=told)
    true = chunk(b"lz4", b"four")
    assert next_record(data + true, 0, None) == len(data)
    assert next_record(data, 0, None) == len(data)


@pytest.mark.parametrize(
    ("behind", "channels", "is_one"),
    [
        (b"", {3}, True),
        (b"\x05", {3}, True),
        (b"\x0f", {3}, True),  # whole to the last byte
        (b"\x00", {3}, False),
        (b"", {4}, False),
    ],
)
def test_a_message_without_a_chunk_is_known_by_its_channel_and_by_what_follows(
    behind, channels, is_one
):
    message = b"\x05" + struct.pack("<QHIQQ", 22, 3, 1, 10, 20)
    data = b"?" * 11 + message + behind
    assert next_record(data, 0, channels) == (11 if is_one else len(data))


@pytest.mark.parametrize("missing", range(1, 26))
def test_the_front_of_a_chunk_at_the_end_of_the_file_is_none(missing):
    """Its length counts what is there, so that only the lengths inside it are cut off."""
    whole = chunk(b"zstd", b"")[9:-missing]
    data = b"?" * 11 + b"\x06" + struct.pack("<Q", len(whole)) + whole
    assert next_record(data, 0, None) == len(data)


@pytest.mark.parametrize(
    ("name", "packed"),
    [
        ("", bytes),
        ("lz4", lz4.frame.compress),
        ("zstd", zstandard.ZstdCompressor().compress),
    ],
)
def test_a_chunk_cut_anywhere_gives_a_front_part_of_its_records(name, packed):
    """Messages of 22 bytes and a payload, which stand in a chunk one behind the other."""
    payloads = [b"", b"one", b"and another", b"\xff" * 40]
    inside = b"".join(
        struct.pack("<BQHIQQ", 5, 22 + len(payload), 3, number, 10, 20) + payload
        for number, payload in enumerate(payloads)
    )
    records = packed(inside)
    content = (
        struct.pack("<QQQII", 1, 2, len(inside), 0, len(name))
        + name.encode()
        + struct.pack("<Q", len(records))
        + records
    )
    whole = b"\x06" + struct.pack("<Q", len(content)) + content
    counts = []
    for size in range(len(whole) + 1):
        found = list(front_of_chunk(whole[:size]))
        assert [(m.sequence, m.data) for m in found] == list(enumerate(payloads))[
            : len(found)
        ]
        counts.append(len(found))
    assert counts == sorted(counts) and counts[-1] == 4
    assert counts[: len(whole) - len(records) + 1] == [0] * (
        len(whole) - len(records) + 1
    )
    if not name:  # a message is read as soon as its last byte is there
        ends = [len(whole) - len(inside) + end for end in (31, 65, 107, 178)]
        assert counts == [
            sum(size >= end for end in ends) for size in range(len(whole) + 1)
        ]


def test_a_file_too_short_for_a_summary_declares_nothing():
    schema = b"\x03" + struct.pack("<QH", 14, 1) + struct.pack("<I", 0) * 3
    assert len(b"?" + schema) < 28
    assert list(declarations(b"?" + schema)) == []
    footer = struct.pack("<QQI", 5, 0, 0) + b"?" * 8
    (found,) = declarations(b"magic" + schema + footer)
    assert (found.id, found.name) == (1, "")
