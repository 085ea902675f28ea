# SPDX-License-Identifier: Apache-2.0
"""The messages of a chunk found all at once, and which chunks can be skipped.

The same is done with a stretch of a file without chunks.

Records tell their lengths, so that each must be passed to find the next. Where lengths come again
and again, those of samples of an encoder or of the samples and detections of each visit, the next
messages are looked for at these distances by numpy. Chunks without any topic that is wanted are
skipped by the indexes in the summary, which is believed only if its checksum is right.
"""

import io
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import BinaryIO

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, ChunkIndex, McapRecord, Message, Schema
from mcap.stream_reader import CRCValidationError, breakup_chunk

from selfcal_ros.bagio.mcap_salvage import (
    FREE,
    HEAD,
    MESSAGE_FRONT,
    ZSTD,
    lz4_chunk,
    parsed,
    zstd_chunk,
)
from selfcal_ros.messages.cdr import Payloads

FRONT = HEAD.size + MESSAGE_FRONT
"""Bytes of a message record before its payload."""
FRONT_TYPE = np.dtype({
    "names": ["length", "channel", "sequence", "log_time", "publish_time"],
    "formats": ["<u8", "<u2", "<u4", "<u8", "<u8"], "offsets": [1, 9, 11, 15, 23],
    "itemsize": FRONT})
HEAD_TYPE = np.dtype({"names": ["opcode", "length"], "formats": ["u1", "<u8"],
                      "offsets": [0, 1], "itemsize": HEAD.size})
PATIENCE, MAX_PATIENCE = 3, 1024
"""Messages after which lengths that come again are looked for; grows where there are none."""
MAX_PERIOD = 64
"""Messages after which lengths may come again, to be found."""
FIRST_LOOK = 64
STRETCH = 1 << 20
"""Bytes of a file without chunks in which messages are found at once."""
END = struct.Struct("<BQQQI8s")
"""The footer and what closes the file."""
FOOTER_SIZE = 20
MAGIC = b"\x89MCAP0\r\n"
"""First and last bytes of a file."""


@dataclass(frozen=True)
class Block:
    """Messages that stand in one buffer, in their order.

    Attributes
    ----------
    fronts : structured array (n,) of `FRONT_TYPE`
        Channel, sequence and times of each message.
    payloads : Payloads
        Their content.
    """

    fronts: np.ndarray
    payloads: Payloads

    def __len__(self) -> int:
        """Return the number of messages."""
        return len(self.fronts)

    def channels(self) -> list[int]:
        """Return the channels of the messages, in the order of first appearance."""
        column = self.fronts["channel"]
        numbers = np.flatnonzero(np.bincount(column)).tolist()
        if len(numbers) == 1:
            return numbers
        return sorted(numbers, key=lambda number: int((column == number).argmax()))

    def __getitem__(self, which: np.ndarray) -> "Block":
        """Return some of the messages."""
        return Block(self.fronts[which], self.payloads[which])

    def compressed(self) -> np.ndarray:
        """Return which messages begin as a zstd frame does, int64 (k,)."""
        payloads = self.payloads
        long = np.flatnonzero(payloads.length >= len(ZSTD))
        if not len(long):
            return long
        first = np.ndarray((len(payloads.data) - len(ZSTD) + 1,), "V4", payloads.data,
                           strides=(1,))[payloads.start[long]].view("<u4")
        return long[first == int.from_bytes(ZSTD, "little")]

    def messages(self) -> Iterator[Message]:
        """Yield each message by itself."""
        columns = (self.fronts[name].tolist() for name in ("channel", "sequence", "log_time",
                                                           "publish_time"))
        for channel, sequence, log_time, publish_time, data in zip(*columns, self.payloads,
                                                                   strict=True):
            yield Message(channel_id=channel, sequence=sequence, log_time=log_time,
                          publish_time=publish_time, data=data)


def block_of(messages: list[Message]) -> Block:
    """Return single messages as one block."""
    fronts = np.zeros(len(messages), dtype=FRONT_TYPE)
    for name, attribute in (("channel", "channel_id"), ("sequence", "sequence"),
                            ("log_time", "log_time"), ("publish_time", "publish_time")):
        fronts[name] = [getattr(message, attribute) for message in messages]
    return Block(fronts, Payloads.joined([message.data for message in messages]))


def message_block(data: bytes, at: int) -> tuple[Block, int]:
    """Return the messages that stand in a row from `at` on, and where they end."""
    places = _Places(data)
    end = places.find(at)
    start = np.concatenate([*places.parts, np.array(places.single, dtype=np.int64)])
    if not len(start):
        return Block(np.zeros(0, dtype=FRONT_TYPE), Payloads(data, start, start)), end
    fronts = np.ndarray((len(data) - FRONT + 1,), f"V{FRONT}", data, strides=(1,))[start].view(
        FRONT_TYPE)
    length = fronts["length"].astype(np.int64) - MESSAGE_FRONT
    return Block(fronts, Payloads(data, start + FRONT, length)), end


def stretch(file: BinaryIO, at: int, size: int) -> tuple[Block | None, int]:
    """Return messages that stand by themselves from `at` on and where they end, or None.

    Nothing is read from byte `size` on.
    """
    file.seek(at)
    if file.read(1) != bytes([Opcode.MESSAGE]):
        return None, at
    file.seek(at)
    block, end = message_block(file.read(min(STRETCH, size - at)), 0)
    return (block if len(block) else None), at + end


class _Places:
    """Finds where message records begin: `parts` of runs, then those in `single`."""

    def __init__(self, data: bytes) -> None:
        self.data = data
        self.parts: list[np.ndarray] = [np.zeros(0, dtype=np.int64)]
        self.single: list[int] = []

    def find(self, at: int) -> int:
        """Pass the messages from `at` on; return where something else begins."""
        data, size, single = self.data, len(self.data), self.single
        waited, patience = 0, PATIENCE
        while at + FRONT <= size:
            opcode, length = HEAD.unpack_from(data, at)
            end = at + HEAD.size + length
            if opcode != Opcode.MESSAGE or length < MESSAGE_FRONT or end > size:
                break
            single.append(at)
            at = end
            waited += 1
            if waited >= patience:
                sizes = _period(np.diff([*single[-waited:], at]))
                found = self._run(at, sizes) if len(sizes) else 0
                patience = PATIENCE if found >= FIRST_LOOK else min(2 * patience, MAX_PATIENCE)
                at, waited = at + found // max(len(sizes), 1) * int(sizes.sum()), 0
        return at

    def _run(self, at: int, sizes: np.ndarray) -> int:
        """Take messages whose sizes come again and again from `at` on; return how many."""
        stride, offsets = int(sizes.sum()), np.cumsum(sizes) - sizes
        possible = (len(self.data) - at) // stride
        found, look = 0, max(FIRST_LOOK // len(sizes), 1)
        while found < possible:
            count = min(look, possible - found)
            good = np.ones(count, dtype=bool)
            for offset, size in zip(offsets.tolist(), sizes.tolist(), strict=True):
                heads = np.ndarray((count,), HEAD_TYPE, self.data, at + found * stride + offset,
                                   (stride,))
                good &= (heads["opcode"] == Opcode.MESSAGE) & (heads["length"]
                                                               == size - HEAD.size)
            step = count if good.all() else int(good.argmin())
            found += step
            if step < count:
                break
            look *= 4
        if found:
            self.parts.append(np.array(self.single, dtype=np.int64))
            starts = at + stride * np.arange(found, dtype=np.int64)
            self.parts.append((starts[:, None] + offsets).ravel())
            self.single.clear()
        return found * len(sizes)


def _period(sizes: np.ndarray) -> np.ndarray:
    """Return the sizes that come again in all of `sizes`, at least twice; empty if none do."""
    for period in range(1, min(len(sizes) // 2, MAX_PERIOD) + 1):
        if (sizes[period:] == sizes[:-period]).all():
            return sizes[-period:]
    return sizes[:0]


def chunk_items(chunk: Chunk) -> list[Block | Schema | Channel]:
    """Return what a chunk holds, in its order, messages that stand together as one block.

    Raises
    ------
    TooLargeError
        If it would decompress to more than is allowed.
    Exception
        Of any kind, if it is damaged.
    """
    data = chunk.data
    if chunk.compression == "zstd":
        data = zstd_chunk(data, chunk.uncompressed_size)
    elif chunk.compression == "lz4":
        data = lz4_chunk(data, chunk.uncompressed_size)
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise CRCValidationError(chunk.uncompressed_crc, zlib.crc32(data), chunk)
    try:
        return _items(data)
    except Exception:  # a form that only the library's own reader takes, or does not
        chunk.data, chunk.compression = data, ""
        return [item for item in gathered(breakup_chunk(chunk))
                if isinstance(item, Block | Schema | Channel)]


def _items(data: bytes) -> list[Block | Schema | Channel]:
    items: list[Block | Schema | Channel] = []
    at = 0
    while at < len(data):
        block, at = message_block(data, at)
        if len(block):
            items.append(block)
        if at == len(data):
            break
        opcode, length = HEAD.unpack_from(data, at)
        start, at = at + HEAD.size, at + HEAD.size + length
        if at > len(data) or opcode == Opcode.MESSAGE:
            raise ValueError("a record does not fit into its chunk")
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            record, used = parsed(opcode, data[start:at])
            if used != length:
                raise ValueError("the length of a record is wrong")
            if isinstance(record, Schema | Channel):
                items.append(record)
    return items


def gathered(records: list[McapRecord]) -> list[Block | McapRecord]:
    """Return records with messages that stand together as one block."""
    items: list[Block | McapRecord] = []
    messages: list[Message] = []
    for record in records:
        if isinstance(record, Message):
            messages.append(record)
            continue
        if messages:
            items.append(block_of(messages))
            messages = []
        items.append(record)
    return [*items, block_of(messages)] if messages else items


@dataclass
class Summary:
    """What a summary tells: declarations by number, and the indexes of the chunks."""

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    chunks: list[ChunkIndex] = field(default_factory=list)

    @property
    def complete(self) -> bool:
        """Whether everything that is used in the chunks is declared here."""
        used = {number for chunk in self.chunks for number in chunk.message_index_offsets}
        declared = {0, *self.schemas}
        return used <= self.channels.keys() and all(
            channel.schema_id in declared for channel in self.channels.values())

    def needless(self, wanted: Callable[[str], bool]) -> dict[int, int]:
        """Return place -> end of the chunks that hold messages, but of no topic wanted."""
        return {chunk.chunk_start_offset: chunk.chunk_start_offset + chunk.chunk_length
                for chunk in self.chunks if chunk.message_index_offsets
                and not any(wanted(self.channels[number].topic)
                            for number in chunk.message_index_offsets)}


def read_summary(file: BinaryIO) -> Summary:
    """Return the summary of a file; an empty one if it is damaged or does not tell everything.

    Parameters
    ----------
    file : binary file
        Its position changes.
    """
    try:
        summary = _parsed(_content(file))
    except Exception:  # a damaged summary may fail anywhere in its parser: read everything
        return Summary()
    return summary if summary.complete else Summary()


def _content(file: BinaryIO) -> bytes:
    """Return the summary; ValueError if there is none that proves to be whole."""
    size = file.seek(0, 2)
    file.seek(size - END.size)
    tail = file.read(END.size)
    opcode, length, start, _, crc, magic = END.unpack(tail)
    if (opcode, length, magic) != (Opcode.FOOTER, FOOTER_SIZE, MAGIC) or not crc or not start:
        raise ValueError("no summary with a checksum")
    if not 0 < size - END.size - start <= FREE:
        raise ValueError("no summary of a sensible size")
    file.seek(start)
    summary = file.read(size - END.size - start)
    if zlib.crc32(tail[:END.size - len(MAGIC) - 4], zlib.crc32(summary)) != crc:
        raise ValueError("the summary is damaged")
    return summary


def _parsed(content: bytes) -> Summary:
    summary, at = Summary(), 0
    while at < len(content):
        opcode, length = HEAD.unpack_from(content, at)
        at += HEAD.size
        body = ReadDataStream(io.BytesIO(content[at:at + length]))
        if opcode == Opcode.SCHEMA:
            schema = Schema.read(body)
            summary.schemas[schema.id] = schema
        elif opcode == Opcode.CHANNEL:
            channel = Channel.read(body)
            summary.channels[channel.id] = channel
        elif opcode == Opcode.CHUNK_INDEX:
            summary.chunks.append(ChunkIndex.read(body))
        at += length
    return summary
