# SPDX-License-Identifier: Apache-2.0
"""Reading of a compressed, truncated or damaged MCAP file.

A few kilobytes can decompress to gigabytes. Above `FREE`, the size must not exceed the declared
size, `RATIO` times the compressed bytes, or a quarter of the available memory; for a file, half of
the free disk space.

A chunk is found by its structure: its length must agree with the lengths inside it. So the
summary, which is missing if a recorder died, is not needed.
"""

import io
import os
import re
import shutil
import struct
import tempfile
import zlib
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from mmap import mmap
from pathlib import Path
from typing import BinaryIO

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, McapRecord, Message, Schema, Statistics

from selfcal_ros.errors import InputError, first_line
from selfcal_ros.units import BYTES_PER_MB

FREE = 64 << 20
"""Size that is always allowed, bytes."""
RATIO = 200
"""Largest ratio of decompressed to compressed size; recordings reach 3 to 30."""
ZSTD = b"\x28\xb5\x2f\xfd"
"""First bytes of a file of a bag with compression_mode FILE, or of a message with MESSAGE."""
BLOCK = 1 << 16
ZSTD_HEAD = 18
"""Longest header of a zstd frame."""
MEMORY = Path("/proc/meminfo")
HEAD = struct.Struct("<BQ")
"""Opcode and length of a record."""
PARSERS = {
    Opcode.SCHEMA: Schema.read,
    Opcode.CHANNEL: Channel.read,
    Opcode.CHUNK: Chunk.read,
    Opcode.STATISTICS: Statistics.read,
}
CHUNK_FRONT = 49
"""Bytes of a chunk record before its records, without the name of the compression."""
FOOTER_CONTENT = 28
"""Bytes from the footer's offset of the summary to the end of a file."""
MESSAGE_FRONT = 22
"""Bytes of a message before its payload."""
CHUNK_LOOKS = (
    rb"\x06(?s:.{36})(?:\x04\0\0\0zstd|\x03\0\0\0lz4|\0\0\0\0)"
    rb"|\x0f\x04\0\0\0\0\0\0\0(?s:.{4})[\x01-\x0e]"
)
"""The start of a chunk, or the end of the data section followed by another record."""
SLICE = 4096
"""Bytes decompressed at once if the end is missing."""
MESSAGE_LOOKS = rb"\x05(?s:.{5})\0\0\0"
CHUNKS = re.compile(b"(?=" + CHUNK_LOOKS + b")")
MESSAGES = re.compile(b"(?=" + CHUNK_LOOKS + b"|" + MESSAGE_LOOKS + b")")
"""The same in a file without chunks, also for messages. A look-ahead, so that a false match does
not hide an overlapping true one."""


class TooLargeError(ValueError):
    """Raised instead of decompressing to more than the limit."""


def memory_left() -> int:
    """Return the available memory in bytes, as far as the system reports it."""
    try:
        for line in MEMORY.read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
    except (OSError, ValueError, IndexError):
        pass
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2


def limit_of(compressed: int, declared: int | None = None) -> int:
    """Return the limit for decompressing `compressed` bytes; `declared`: size in the file."""
    large = min(RATIO * compressed, memory_left() // 4)
    return max(FREE, large if declared is None else min(large, declared))


def check_size(size: int, compressed: int, declared: int | None = None) -> None:
    """Raise TooLargeError if `compressed` bytes may not become `size` bytes."""
    if size > FREE:
        refuse_beyond(limit_of(compressed, declared), size)


def refuse_beyond(limit: int, size: int) -> None:
    """Raise TooLargeError if `size` bytes are more than `limit`."""
    if size > limit:
        raise TooLargeError(
            f"it would decompress to {size / BYTES_PER_MB:,.0f} MB, more than the "
            f"{limit / BYTES_PER_MB:,.0f} MB that its size, the file and the memory "
            "allow"
        )


def zstd_chunk(data: bytes, declared: int) -> bytes:
    """Return the content of a zstd frame of `declared` bytes.

    Raises
    ------
    TooLargeError
        If it would exceed the limit; nothing has been allocated.
    zstandard.ZstdError
        If the frame is damaged.
    """
    with suppress(zstandard.ZstdError):  # the header is damaged: decompression raises
        inside = zstandard.frame_content_size(data)
        if not inside:
            return b""
        check_size(inside if inside > 0 else declared, len(data), declared)
    return zstandard.decompress(data, declared)


def lz4_chunk(data: bytes, declared: int) -> bytes:
    """Return the content of an LZ4 frame of `declared` bytes.

    Raises
    ------
    TooLargeError
        If it would exceed the limit.
    RuntimeError
        If the frame is damaged.
    """
    check_size(lz4.frame.get_frame_info(data)["content_size"], len(data), declared)
    decoder = lz4.frame.LZ4FrameDecompressor()
    out = []
    size = 0
    for start in range(0, len(data), BLOCK):  # a block expands by at most 255
        out.append(decoder.decompress(data[start : start + BLOCK]))
        size += len(out[-1])
        check_size(size, len(data), declared)
        if decoder.eof:
            return b"".join(out)
    raise RuntimeError("the LZ4 frame is incomplete")


def zstd_message(data: bytes) -> bytes:
    """Return the payload of a compressed message; raises like `zstd_chunk`."""
    inside = zstandard.frame_content_size(data)
    if inside >= 0:
        check_size(inside, len(data))
        return zstandard.ZstdDecompressor().decompressobj().decompress(data)
    limit = limit_of(len(data))
    with zstandard.ZstdDecompressor().stream_reader(data) as stream:
        out = stream.read(limit + 1)
    refuse_beyond(limit, len(out))
    return out


@contextmanager
def plain_file(path: Path, lost: list[str]) -> Iterator[BinaryIO]:
    """Yield a file for reading, decompressed first if it was compressed as a whole.

    Raises
    ------
    InputError
        If nothing of it can be decompressed, or it would become larger than is allowed.
    """
    with path.open("rb") as file:
        compressed = file.read(len(ZSTD)) == ZSTD
        file.seek(0)
        if not compressed:
            yield file
            return
        with tempfile.TemporaryFile() as plain:
            try:
                _copy(file, plain)
            except TooLargeError as error:
                raise InputError(
                    str(path), str(error), "if it is a bag, decompress it with zstd -d"
                ) from error
            except zstandard.ZstdError as error:
                lost.append(
                    f"the compression of the file is damaged ({first_line(error)}): "
                    "what follows is lost"
                )
            if not plain.tell():
                raise InputError(
                    str(path),
                    "no part of the compressed file can be read",
                    "record the bag again",
                )
            plain.seek(0)
            yield plain


def _copy(file: BinaryIO, plain: BinaryIO) -> None:
    """Decompress `file` into `plain`, up to its limit."""
    size = os.fstat(file.fileno()).st_size
    limit = max(
        FREE, min(RATIO * size, shutil.disk_usage(tempfile.gettempdir()).free // 2)
    )
    inside = zstandard.frame_content_size(file.read(ZSTD_HEAD))
    refuse_beyond(limit, inside)
    file.seek(0)
    stream = zstandard.ZstdDecompressor().stream_reader(file, read_across_frames=True)
    while block := stream.read(BLOCK):
        refuse_beyond(limit, plain.tell() + len(block))
        plain.write(block)


def parsed(opcode: int, body: bytes) -> tuple[McapRecord | None, int]:
    """Return a record (None if not needed) and the number of bytes it takes of `body`.

    Raises
    ------
    Exception
        Of any kind, if the body is not such a record.
    """
    stream = ReadDataStream(io.BytesIO(body))
    if opcode == Opcode.MESSAGE:
        return Message.read(stream, len(body)), len(body)
    if opcode == Opcode.CHUNK and chunk_length(body, 0) > len(body):
        raise ValueError("the length of a chunk is wrong")
    for parsed_opcode, parse in PARSERS.items():
        if opcode == parsed_opcode:
            return parse(stream), stream.count
    return None, len(body)


def chunk_length(data: bytes | mmap, start: int) -> int:
    """Return the length of the chunk whose content begins at `start`, from the lengths inside it.

    More than available if `data` ends before them.
    """
    name_length = int.from_bytes(data[start + 28 : start + 32], "little")
    inside = int.from_bytes(
        data[start + 32 + name_length : start + 40 + name_length], "little"
    )
    return CHUNK_FRONT - HEAD.size + name_length + inside


def bodies(data: bytes | mmap, offset: int = 0) -> Iterator[tuple[int, bytes]]:
    """Yield opcode and content of each record from `offset` on, up to the first incomplete one."""
    while offset + HEAD.size <= len(data):
        opcode, length = HEAD.unpack_from(data, offset)
        start = offset + HEAD.size
        offset = start + length
        if offset > len(data):
            return
        yield opcode, data[start:offset]


def declarations(data: mmap) -> Iterator[Schema | Channel]:
    """Yield the schemas and channels repeated in the summary; nothing without a summary."""
    if len(data) < FOOTER_CONTENT:
        return
    [summary] = struct.unpack_from("<Q", data, len(data) - FOOTER_CONTENT)
    for opcode, body in bodies(data, summary) if summary else ():
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            try:
                record, _ = parsed(opcode, body)
            except Exception:  # no summary, or a damaged one
                return
            if isinstance(record, Schema | Channel):
                yield record


def next_record(data: mmap, start: int, channels: Collection[int] | None) -> int:
    """Return the start of the next chunk or end of the data section, or the size of the file.

    Parameters
    ----------
    data : mmap
        The file.
    start : int
        First byte that may belong to it.
    channels : collection of int or None
        Known channels of a file without chunks, whose messages are searched for as well.
    """
    pattern = CHUNKS if channels is None else MESSAGES
    for match in pattern.finditer(data, start + 1):
        offset = match.start()
        opcode, length = HEAD.unpack_from(data, offset)
        end = offset + HEAD.size + length
        if opcode == Opcode.DATA_END:
            return offset
        if end > len(data) or length < MESSAGE_FRONT:
            continue
        if opcode == Opcode.CHUNK:
            fits = length == chunk_length(data, offset + HEAD.size)
        else:
            fits = struct.unpack_from("<H", data, offset + HEAD.size)[0] in (
                channels or ()
            ) and (end == len(data) or data[end] in (Opcode.MESSAGE, Opcode.DATA_END))
        if fits:
            return offset
    return len(data)


def front_of_chunk(data: bytes) -> Iterator[McapRecord]:
    """Yield the complete records in the front part of a truncated chunk.

    A complete chunk with a wrong checksum gives nothing.
    """
    if len(data) < CHUNK_FRONT or data[0] != Opcode.CHUNK:
        return
    size, crc, name_length = struct.unpack_from("<QII", data, 25)
    begin = CHUNK_FRONT + name_length
    inside = int.from_bytes(data[begin - 8 : begin], "little")
    name = data[41 : 41 + name_length].decode(errors="replace")
    body = _decompressed_front(name, data[begin : begin + inside], size)
    if crc and len(body) >= size and zlib.crc32(body[:size]) != crc:
        return
    for opcode, content in bodies(body):
        try:
            record, _ = parsed(opcode, content)
        except Exception:
            # a damaged chunk, not only truncated: the rest cannot be trusted
            return
        if record is not None:
            yield record


def _decompressed_front(compression: str, data: bytes, declared: int) -> bytes:
    """Return the decompressible part of a truncated stream.

    Nothing if it exceeds the limit.
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
        for start in range(0, len(data), SLICE):
            out += decoder.decompress(data[start : start + SLICE])
            if len(out) > limit:
                return b""
    except (zstandard.ZstdError, RuntimeError, EOFError):
        pass  # the truncation: the output so far is good
    return bytes(out)
