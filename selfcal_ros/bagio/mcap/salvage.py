# SPDX-License-Identifier: Apache-2.0
"""What can still be read where an MCAP file is cut off or damaged.

A chunk is found again by its own form: its length must agree with the lengths inside it. So the
summary, which a recorder that died never wrote, is not needed.
"""

import io
import re
import struct
import zlib
from collections.abc import Collection, Iterator
from mmap import mmap

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, McapRecord, Message, Schema, Statistics

from selfcal_ros.bagio.mcap.decompress import limit_of

HEAD = struct.Struct("<BQ")
"""Opcode and length of a record."""
PARSERS = {Opcode.SCHEMA: Schema.read, Opcode.CHANNEL: Channel.read, Opcode.CHUNK: Chunk.read,
           Opcode.STATISTICS: Statistics.read}
CHUNK_FRONT = 49
"""Bytes of a chunk record before its records, without the name of the compression."""
FOOTER_CONTENT = 28
"""Bytes from the place of the summary in the footer to the end of a file."""
MESSAGE_FRONT = 22
"""Bytes of a message before its payload."""
CHUNK_LOOKS = (rb"\x06(?s:.{36})(?:\x04\0\0\0zstd|\x03\0\0\0lz4|\0\0\0\0)"
               rb"|\x0f\x04\0\0\0\0\0\0\0(?s:.{4})[\x01-\x0e]")
"""The start of a chunk, or the end of the data section with another record behind it."""
SLICE = 4096
"""Bytes that are decompressed at once where the end is missing."""
MESSAGE_LOOKS = rb"\x05(?s:.{5})\0\0\0"
CHUNKS = re.compile(b"(?=" + CHUNK_LOOKS + b")")
MESSAGES = re.compile(b"(?=" + CHUNK_LOOKS + b"|" + MESSAGE_LOOKS + b")")
"""The same in a file without chunks, where messages stand by themselves. Looking ahead only, so
that what looks alike does not hide a true one that it overlaps."""


def parsed(opcode: int, body: bytes) -> tuple[McapRecord | None, int]:
    """Return a record (None for a kind that is not needed) and how many bytes it takes of `body`.

    Raises
    ------
    Exception
        Of any kind, if the body is no such record.
    """
    stream = ReadDataStream(io.BytesIO(body))
    if opcode == Opcode.MESSAGE:
        return Message.read(stream, len(body)), len(body)
    if opcode == Opcode.CHUNK and chunk_length(body, 0) > len(body):
        raise ValueError("the length of a chunk is wrong")
    for known, parse in PARSERS.items():
        if opcode == known:
            return parse(stream), stream.count
    return None, len(body)


def chunk_length(data: bytes | mmap, at: int) -> int:
    """Return the length of the chunk whose content begins at `at`, from the lengths inside it.

    More than there is where `data` ends before them.
    """
    name_length = int.from_bytes(data[at + 28:at + 32], "little")
    inside = int.from_bytes(data[at + 32 + name_length:at + 40 + name_length], "little")
    return CHUNK_FRONT - HEAD.size + name_length + inside


def declarations(data: mmap) -> Iterator[Schema | Channel]:
    """Yield the schemas and channels that the summary repeats; nothing if there is no summary."""
    at = struct.unpack_from("<Q", data, len(data) - FOOTER_CONTENT)[0] if len(
        data) >= FOOTER_CONTENT else 0
    while 0 < at <= len(data) - HEAD.size:
        opcode, length = HEAD.unpack_from(data, at)
        at += HEAD.size
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            try:
                record, _ = parsed(opcode, data[at:at + length])
            except Exception:  # no summary, or a damaged one
                return
            if isinstance(record, Schema | Channel):
                yield record
        at += length


def next_record(data: mmap, start: int, channels: Collection[int] | None) -> int:
    """Return where the next chunk or the end of the data section begins, or the size of the file.

    Parameters
    ----------
    data : mmap
        The file.
    start : int
        First byte that may belong to it.
    channels : collection of int or None
        Known channels of a file without chunks, whose messages are looked for as well.
    """
    pattern = CHUNKS if channels is None else MESSAGES
    for match in pattern.finditer(data, start + 1):
        at = match.start()
        opcode, length = HEAD.unpack_from(data, at)
        end = at + HEAD.size + length
        if opcode == Opcode.DATA_END:
            return at
        if end > len(data) or length < MESSAGE_FRONT:
            continue
        if opcode == Opcode.CHUNK:
            fits = length == chunk_length(data, at + HEAD.size)
        else:
            fits = (struct.unpack_from("<H", data, at + HEAD.size)[0] in (channels or ())
                    and (end == len(data) or data[end] in (Opcode.MESSAGE, Opcode.DATA_END)))
        if fits:
            return at
    return len(data)


def front_of_chunk(data: bytes) -> Iterator[McapRecord]:
    """Yield the complete records in the front part of a chunk that was cut off.

    A chunk that is all there but whose checksum does not agree gives nothing.
    """
    if len(data) < CHUNK_FRONT or data[0] != Opcode.CHUNK:
        return
    size, crc, name_length = struct.unpack_from("<QII", data, 25)
    begin = CHUNK_FRONT + name_length
    inside = int.from_bytes(data[begin - 8:begin], "little")
    name = data[41:41 + name_length].decode(errors="replace")
    body = _decompressed_front(name, data[begin:begin + inside], size)
    if crc and len(body) >= size and zlib.crc32(body[:size]) != crc:
        return
    at = 0
    while at + HEAD.size <= len(body):
        opcode, length = HEAD.unpack_from(body, at)
        at += HEAD.size
        if at + length > len(body):
            return
        try:
            record, _ = parsed(opcode, body[at:at + length])
        except Exception:  # a chunk that is damaged, not only cut: its rest cannot be trusted
            return
        if record is not None:
            yield record
        at += length


def _decompressed_front(compression: str, data: bytes, declared: int) -> bytes:
    """Return what can be decompressed of a stream whose end is missing.

    Nothing of one that is larger than is allowed (`decompress`).
    """
    out = bytearray()
    limit = limit_of(len(data), declared)
    try:
        if compression == "zstd":
            decoder = zstandard.ZstdDecompressor().decompressobj()
            if zstandard.frame_content_size(data) > limit:
                return b""
        elif compression == "lz4":
            decoder = lz4.frame.LZ4FrameDecompressor()
        else:
            return data
        for at in range(0, len(data), SLICE):
            out += decoder.decompress(data[at:at + SLICE])
            if len(out) > limit:
                return b""
    except (zstandard.ZstdError, RuntimeError, EOFError):
        pass  # the cut: what came out so far is good
    return bytes(out)
