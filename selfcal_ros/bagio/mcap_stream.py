# SPDX-License-Identifier: Apache-2.0
"""MCAP as a stream of messages that survives a truncated or damaged file.

The mcap library reads the records. This module adds what a recorder that died leaves behind:
a missing end, a damaged chunk, and the readable front part of a chunk that was cut off.
"""

import io
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, InvalidMagic, McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, DataEnd, Footer, Message, Schema
from mcap.stream_reader import StreamReader, breakup_chunk

from selfcal_ros.errors import InputError, first_line

MAGIC = b"\x89MCAP0\r\n"
DATA_END_SIZE = 13


@dataclass
class McapStream:
    """Messages of one MCAP file, in the order of the file.

    Attributes
    ----------
    path : Path
        The file.
    schemas, channels : dict
        Filled while the messages are read.
    lost : list of str
        What could not be read, one line each.
    """

    path: Path
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    lost: list[str] = field(default_factory=list)

    def messages(self) -> Iterator[tuple[Channel, Message]]:
        """Yield channel and message of every message that can be read.

        Raises
        ------
        InputError
            If the file is empty or no MCAP file.
        """
        size = self.path.stat().st_size
        with self.path.open("rb") as file:
            head = file.read(len(MAGIC))
            if not head:
                raise InputError(str(self.path), "the file is empty", "record the bag anew")
            if head != MAGIC:
                raise InputError(str(self.path), "not an MCAP file",
                                 "give an .mcap file or a rosbag2 folder")
            file.seek(0)
            yield from self._records(file, size)

    def _records(self, file: BinaryIO, size: int) -> Iterator[tuple[Channel, Message]]:
        records = iter(StreamReader(file, emit_chunks=True, record_size_limit=size).records)
        good_until, ended, data_ended = len(MAGIC), False, False
        while True:
            try:
                record = next(records)
            except StopIteration:
                return
            except (EndOfFile, InvalidMagic, McapError, struct.error, ValueError,
                    UnicodeDecodeError) as error:
                if not ended:
                    yield from self._salvage(file, good_until, size, error, summary=data_ended)
                return
            ended = ended or isinstance(record, Footer)
            whole = file.tell() - good_until == DATA_END_SIZE
            data_ended = data_ended or (isinstance(record, DataEnd) and whole)
            good_until = file.tell()
            if isinstance(record, Chunk):
                yield from self._chunk(record, good_until)
            else:
                yield from self._take(record)

    def _chunk(self, chunk: Chunk, position: int) -> Iterator[tuple[Channel, Message]]:
        try:
            records = breakup_chunk(chunk, validate_crc=True)
        except Exception as error:
            self.lost.append(f"the chunk that ends at byte {position} is damaged "
                             f"({first_line(error)[:80]}): its messages are lost")
            return
        for record in records:
            yield from self._take(record)

    def _take(self, record: object) -> Iterator[tuple[Channel, Message]]:
        if isinstance(record, Schema):
            self.schemas[record.id] = record
        elif isinstance(record, Channel):
            self.channels[record.id] = record
        elif isinstance(record, Message):
            channel = self.channels.get(record.channel_id)
            if channel is None:
                self.lost.append(f"a message of the undeclared channel {record.channel_id}")
            else:
                yield channel, record

    def _salvage(self, file: BinaryIO, start: int, size: int, error: Exception, *,
                 summary: bool) -> Iterator[tuple[Channel, Message]]:
        """Yield what is readable of the record that was cut off at the end of the file.

        `summary` tells that the data section was complete, so that only indexes can be missing.
        """
        if summary or (start == size and isinstance(error, EndOfFile)):
            self.lost.append(
                "the end of the file is damaged, behind the last message: no message is lost"
                if summary else "the file ends without its footer, as when a recorder is killed: "
                "every message that was written is read")
            return
        file.seek(start)
        rest = file.read()
        count = 0
        for record in _front_of_chunk(rest):
            for item in self._take(record):
                count += 1
                yield item
        reason = "truncated" if isinstance(error, EndOfFile) else f"damaged ({error})"
        self.lost.append(f"the file is {reason} after byte {start} of {size}: {count} messages "
                         "of the last chunk could be saved, what followed is lost")


def _front_of_chunk(data: bytes) -> Iterator[object]:
    """Yield the complete records in the front part of a chunk record that was cut off."""
    if len(data) < 49 or data[0] != Opcode.CHUNK:
        return
    name_length = struct.unpack_from("<I", data, 37)[0]
    begin = 41 + name_length + 8
    compression = data[41:41 + name_length].decode(errors="replace")
    body = _decompress_front(compression, data[begin:])
    at = 0
    while at + 9 <= len(body):
        opcode, length = struct.unpack_from("<BQ", body, at)
        at += 9
        if at + length > len(body):
            return
        stream = ReadDataStream(io.BytesIO(body[at:at + length]))
        try:
            record = (Schema.read(stream) if opcode == Opcode.SCHEMA
                      else Channel.read(stream) if opcode == Opcode.CHANNEL
                      else Message.read(stream, length) if opcode == Opcode.MESSAGE else None)
        except Exception:  # a chunk that is damaged, not only cut: its rest cannot be trusted
            return
        if record is not None:
            yield record
        at += length


def _decompress_front(compression: str, data: bytes) -> bytes:
    """Return what can be decompressed of a stream whose end is missing."""
    out = bytearray()
    try:
        if compression == "zstd":
            decoder = zstandard.ZstdDecompressor().decompressobj()
        elif compression == "lz4":
            decoder = lz4.frame.LZ4FrameDecompressor()
        else:
            return data
        for at in range(0, len(data), 4096):
            out += decoder.decompress(data[at:at + 4096])
    except (zstandard.ZstdError, RuntimeError, EOFError):
        pass  # the cut: what came out so far is good
    return bytes(out)
