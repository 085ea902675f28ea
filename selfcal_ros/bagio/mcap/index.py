# SPDX-License-Identifier: Apache-2.0
"""Which chunks of a file need not be read, by the indexes in its summary.

The summary is believed only if its checksum says that it is whole; then a chunk that holds none
of the topics that are wanted is passed.
"""

import io
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import BinaryIO

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Schema

from selfcal_ros.bagio.mcap.decompress import FREE
from selfcal_ros.bagio.mcap.salvage import HEAD

END = struct.Struct("<BQQQI8s")
"""The footer and what closes the file."""
FOOTER_SIZE = 20
MAGIC = b"\x89MCAP0\r\n"
"""First and last bytes of a file."""


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
