# SPDX-License-Identifier: Apache-2.0
"""Find all messages of a chunk at once, and the chunks that can be skipped.

The same is done with a block of a file without chunks.

Records contain their lengths, so each must be read to find the next. If lengths repeat, as those
of encoder samples or of the samples and detections of each visit, numpy tests for the next
messages at these distances. Chunks without any required topic are
skipped by the indexes in the summary, which is used only if its checksum is correct.
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

from selfcal_ros.bagio import mcap_salvage
from selfcal_ros.bagio.messages.cdr import Payloads

FRONT = mcap_salvage.HEAD.size + mcap_salvage.MESSAGE_FRONT
"""Bytes of a message record before its payload."""
FRONT_TYPE = np.dtype(
    {
        "names": ["length", "channel", "sequence", "log_time", "publish_time"],
        "formats": ["<u8", "<u2", "<u4", "<u8", "<u8"],
        "offsets": [1, 9, 11, 15, 23],
        "itemsize": FRONT,
    }
)
HEAD_TYPE = np.dtype(
    {
        "names": ["opcode", "length"],
        "formats": ["u1", "<u8"],
        "offsets": [0, 1],
        "itemsize": mcap_salvage.HEAD.size,
    }
)
PATIENCE, MAX_PATIENCE = 3, 1024
"""Messages after which repeating lengths are searched for; grows if there are none."""
MAX_PERIOD = 64
"""Longest period of repeating lengths, in messages."""
FIRST_LOOK = 64
STRETCH = 1 << 20
"""Block of a file without chunks in which messages are found at once, bytes."""
END = struct.Struct("<BQQQI8s")
"""The footer and the closing magic."""
FOOTER_SIZE = 20
MAGIC = b"\x89MCAP0\r\n"
"""First and last bytes of a file."""
JOINT = MAGIC + bytes([Opcode.HEADER])
"""First bytes of a file, also within one that was made by joining files."""


@dataclass(frozen=True)
class MessageBlock:
    """Messages in one buffer, in their order.

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

    def __getitem__(self, which: np.ndarray) -> "MessageBlock":
        """Return some of the messages."""
        return MessageBlock(self.fronts[which], self.payloads[which])

    def compressed(self) -> np.ndarray:
        """Return the messages that begin like a zstd frame, int64 (k,)."""
        payloads = self.payloads
        long = np.flatnonzero(payloads.length >= len(mcap_salvage.ZSTD))
        if not len(long):
            return long
        first = np.ndarray(
            (len(payloads.data) - len(mcap_salvage.ZSTD) + 1,),
            "V4",
            payloads.data,
            strides=(1,),
        )[payloads.start[long]].view("<u4")
        return long[first == int.from_bytes(mcap_salvage.ZSTD, "little")]

    def messages(self) -> Iterator[Message]:
        """Yield each message separately."""
        columns = (
            self.fronts[name].tolist()
            for name in ("channel", "sequence", "log_time", "publish_time")
        )
        for channel, sequence, log_time, publish_time, data in zip(
            *columns, self.payloads, strict=True
        ):
            yield Message(
                channel_id=channel,
                sequence=sequence,
                log_time=log_time,
                publish_time=publish_time,
                data=data,
            )


def block_of(messages: list[Message]) -> MessageBlock:
    """Return single messages as one block."""
    fronts = np.zeros(len(messages), dtype=FRONT_TYPE)
    for name, attribute in (
        ("channel", "channel_id"),
        ("sequence", "sequence"),
        ("log_time", "log_time"),
        ("publish_time", "publish_time"),
    ):
        fronts[name] = [getattr(message, attribute) for message in messages]
    return MessageBlock(fronts, Payloads.joined([message.data for message in messages]))


def message_block(data: bytes, first: int) -> tuple[MessageBlock, int]:
    """Return the consecutive messages from `first` on, and their end."""
    places = _Places(data)
    end = places.find(first)
    start = np.concatenate([*places.parts, np.array(places.single, dtype=np.int64)])
    if not len(start):
        return MessageBlock(
            np.zeros(0, dtype=FRONT_TYPE), Payloads(data, start, start)
        ), end
    fronts = np.ndarray((len(data) - FRONT + 1,), f"V{FRONT}", data, strides=(1,))[
        start
    ].view(FRONT_TYPE)
    length = fronts["length"].astype(np.int64) - mcap_salvage.MESSAGE_FRONT
    return MessageBlock(fronts, Payloads(data, start + FRONT, length)), end


def stretch(file: BinaryIO, start: int, size: int) -> tuple[MessageBlock | None, int]:
    """Return the messages outside chunks from `start` on and their end, or None.

    Nothing is read from byte `size` on, nor from where a file that was joined to it begins.
    """
    file.seek(start)
    if file.read(1) != bytes([Opcode.MESSAGE]):
        return None, start
    file.seek(start)
    data = file.read(min(STRETCH, size - start))
    joint = data.find(JOINT)
    block, end = message_block(data if joint < 0 else data[:joint], 0)
    return (block if len(block) else None), start + end


class _Places:
    """Find the beginnings of message records: `parts` of runs, then those in `single`."""

    def __init__(self, data: bytes) -> None:
        self.data = data
        self.parts: list[np.ndarray] = [np.zeros(0, dtype=np.int64)]
        self.single: list[int] = []

    def find(self, offset: int) -> int:
        """Skip the messages from `offset` on; return the beginning of the next other record."""
        data = self.data
        size = len(self.data)
        single = self.single
        waited = 0
        patience = PATIENCE
        while offset + FRONT <= size:
            opcode, length = mcap_salvage.HEAD.unpack_from(data, offset)
            end = offset + mcap_salvage.HEAD.size + length
            if (
                opcode != Opcode.MESSAGE
                or length < mcap_salvage.MESSAGE_FRONT
                or end > size
            ):
                break
            single.append(offset)
            offset = end
            waited += 1
            if waited >= patience:
                sizes = _period(np.diff([*single[-waited:], offset]))
                taken_messages = self._run(offset, sizes) if len(sizes) else 0
                patience = (
                    PATIENCE
                    if taken_messages >= FIRST_LOOK
                    else min(2 * patience, MAX_PATIENCE)
                )
                offset = offset + taken_messages // max(len(sizes), 1) * int(
                    sizes.sum()
                )
                waited = 0
        return offset

    def _run(self, start: int, sizes: np.ndarray) -> int:
        """Take messages with repeating sizes from `start` on; return their number."""
        stride = int(sizes.sum())
        offsets = np.cumsum(sizes) - sizes
        possible = (len(self.data) - start) // stride
        taken_runs = 0
        look = max(FIRST_LOOK // len(sizes), 1)
        while taken_runs < possible:
            count = min(look, possible - taken_runs)
            good = np.ones(count, dtype=bool)
            for offset, size in zip(offsets.tolist(), sizes.tolist(), strict=True):
                heads = np.ndarray(
                    (count,),
                    HEAD_TYPE,
                    self.data,
                    start + taken_runs * stride + offset,
                    (stride,),
                )
                good &= (heads["opcode"] == Opcode.MESSAGE) & (
                    heads["length"] == size - mcap_salvage.HEAD.size
                )
            step = count if good.all() else int(good.argmin())
            taken_runs += step
            if step < count:
                break
            look *= 4
        if taken_runs:
            self.parts.append(np.array(self.single, dtype=np.int64))
            starts = start + stride * np.arange(taken_runs, dtype=np.int64)
            self.parts.append((starts[:, None] + offsets).ravel())
            self.single.clear()
        return taken_runs * len(sizes)


def _period(sizes: np.ndarray) -> np.ndarray:
    """Return the period of `sizes`, repeated at least twice; empty if there is none."""
    for period in range(1, min(len(sizes) // 2, MAX_PERIOD) + 1):
        if (sizes[period:] == sizes[:-period]).all():
            return sizes[-period:]
    return sizes[:0]


def chunk_items(chunk: Chunk) -> list[MessageBlock | Schema | Channel]:
    """Return the content of a chunk in its order, consecutive messages as one block.

    Raises
    ------
    TooLargeError
        If it would decompress to more than is allowed.
    Exception
        Of any kind, if it is damaged.
    """
    data = chunk.data
    if chunk.compression == "zstd":
        data = mcap_salvage.zstd_chunk(data, chunk.uncompressed_size)
    elif chunk.compression == "lz4":
        data = mcap_salvage.lz4_chunk(data, chunk.uncompressed_size)
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise CRCValidationError(chunk.uncompressed_crc, zlib.crc32(data), chunk)
    try:
        return _items(data)
    except Exception:  # left to the library's reader
        chunk.data, chunk.compression = data, ""
        return [
            item
            for item in gathered(breakup_chunk(chunk))
            if isinstance(item, MessageBlock | Schema | Channel)
        ]


def _items(data: bytes) -> list[MessageBlock | Schema | Channel]:
    items: list[MessageBlock | Schema | Channel] = []
    offset = 0
    while offset < len(data):
        block, offset = message_block(data, offset)
        if len(block):
            items.append(block)
        if offset == len(data):
            break
        opcode, length = mcap_salvage.HEAD.unpack_from(data, offset)
        start = offset + mcap_salvage.HEAD.size
        offset = offset + mcap_salvage.HEAD.size + length
        if offset > len(data) or opcode == Opcode.MESSAGE:
            raise ValueError("a record does not fit into its chunk")
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            record, used = mcap_salvage.parsed(opcode, data[start:offset])
            if used != length:
                raise ValueError("the length of a record is wrong")
            if isinstance(record, Schema | Channel):
                items.append(record)
    return items


def gathered(records: list[McapRecord]) -> list[MessageBlock | McapRecord]:
    """Return records with consecutive messages as one block."""
    items: list[MessageBlock | McapRecord] = []
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
    """Content of a summary: declarations by number, and the indexes of the chunks."""

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    chunks: list[ChunkIndex] = field(default_factory=list)

    @property
    def complete(self) -> bool:
        """Whether everything used in the chunks is declared here."""
        used = {
            number for chunk in self.chunks for number in chunk.message_index_offsets
        }
        declared = {0, *self.schemas}
        return used <= self.channels.keys() and all(
            channel.schema_id in declared for channel in self.channels.values()
        )

    def needless(self, wanted: Callable[[str], bool]) -> dict[int, int]:
        """Return start -> end of the chunks with messages, but of no required topic."""
        return {
            chunk.chunk_start_offset: chunk.chunk_start_offset + chunk.chunk_length
            for chunk in self.chunks
            if chunk.message_index_offsets
            and not any(
                wanted(self.channels[number].topic)
                for number in chunk.message_index_offsets
            )
        }


def read_summary(file: BinaryIO) -> Summary:
    """Return the summary of a file; an empty one if damaged or incomplete.

    Parameters
    ----------
    file : binary file
        Its position changes.
    """
    try:
        summary = _parsed(_content(file))
    except Exception:
        # a damaged summary may fail anywhere in its parser: read everything
        return Summary()
    return summary if summary.complete else Summary()


def _content(file: BinaryIO) -> bytes:
    """Return the summary; ValueError unless its checksum is correct."""
    size = file.seek(0, 2)
    file.seek(size - END.size)
    tail = file.read(END.size)
    opcode, length, start, _, crc, magic = END.unpack(tail)
    if (
        (opcode, length, magic) != (Opcode.FOOTER, FOOTER_SIZE, MAGIC)
        or not crc
        or not start
    ):
        raise ValueError("no summary with a checksum")
    if not 0 < size - END.size - start <= mcap_salvage.FREE:
        raise ValueError("no summary of a sensible size")
    file.seek(start)
    summary = file.read(size - END.size - start)
    if zlib.crc32(tail[: END.size - len(MAGIC) - 4], zlib.crc32(summary)) != crc:
        raise ValueError("the summary is damaged")
    return summary


def _parsed(content: bytes) -> Summary:
    summary = Summary()
    for opcode, body in mcap_salvage.bodies(content):
        if opcode == Opcode.CHUNK_INDEX:
            stream = ReadDataStream(io.BytesIO(body))
            summary.chunks.append(ChunkIndex.read(stream))
            continue
        record, _ = mcap_salvage.parsed(opcode, body)
        if isinstance(record, Schema):
            summary.schemas[record.id] = record
        elif isinstance(record, Channel):
            summary.channels[record.id] = record
    return summary
