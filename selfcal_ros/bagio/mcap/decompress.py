# SPDX-License-Identifier: Apache-2.0
"""Decompressing what somebody else compressed, with a limit that is known before.

A few kilobytes can decompress to gigabytes. What is more than `FREE` must not be more than the
file declares, than `RATIO` times the compressed bytes, or than a quarter of the memory that is
left; of a file, than half of the room on the disk.
"""

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

import lz4.frame
import zstandard

from selfcal_ros.errors import InputError, first_line
from selfcal_ros.units import BYTES_PER_MB

FREE = 64 << 20
"""Bytes that are always allowed."""
RATIO = 200
"""How often larger than its compressed form something may be; recordings reach 3 to 30."""
ZSTD = b"\x28\xb5\x2f\xfd"
"""First bytes of a file of a bag with compression_mode FILE, or of a message with MESSAGE."""
BLOCK = 1 << 16
ZSTD_HEAD = 18
"""Longest head of a zstd frame."""
MEMORY = Path("/proc/meminfo")


class TooLargeError(ValueError):
    """Raised instead of decompressing something that is larger than it may be."""


def memory_left() -> int:
    """Return the bytes of memory that can still be had, as far as the system tells."""
    try:
        for line in MEMORY.read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
    except (OSError, ValueError, IndexError):
        pass
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2


def limit_of(compressed: int, declared: int | None = None) -> int:
    """Return how many bytes `compressed` bytes may become; `declared`: what the file says."""
    large = min(RATIO * compressed, memory_left() // 4)
    return max(FREE, large if declared is None else min(large, declared))


def check_size(size: int, compressed: int, declared: int | None = None) -> None:
    """Raise TooLargeError if `compressed` bytes may not become `size` bytes."""
    if size > FREE:
        refuse_beyond(limit_of(compressed, declared), size)


def refuse_beyond(limit: int, size: int) -> None:
    """Raise TooLargeError if `size` bytes are more than `limit`."""
    if size > limit:
        raise TooLargeError(f"it would decompress to {size / BYTES_PER_MB:,.0f} MB, more than "
                            f"the {limit / BYTES_PER_MB:,.0f} MB that its size, the file and the "
                            "memory allow")


def zstd_chunk(data: bytes, declared: int) -> bytes:
    """Return the content of a zstd frame, `declared` bytes as the file says.

    Raises
    ------
    TooLargeError
        If it would be larger than is allowed; nothing has been allocated.
    zstandard.ZstdError
        If the frame is damaged.
    """
    with suppress(zstandard.ZstdError):  # the head is damaged: what follows says how
        inside = zstandard.frame_content_size(data)
        if not inside:
            return b""
        check_size(inside if inside > 0 else declared, len(data), declared)
    return zstandard.decompress(data, declared)


def lz4_chunk(data: bytes, declared: int) -> bytes:
    """Return the content of an LZ4 frame, `declared` bytes as the file says.

    Raises
    ------
    TooLargeError
        If it would be larger than is allowed.
    RuntimeError
        If the frame is damaged.
    """
    check_size(lz4.frame.get_frame_info(data)["content_size"], len(data), declared)
    decoder, out, size = lz4.frame.LZ4FrameDecompressor(), [], 0
    for start in range(0, len(data), BLOCK):  # a block becomes at most 255 times as large
        out.append(decoder.decompress(data[start:start + BLOCK]))
        size += len(out[-1])
        check_size(size, len(data), declared)
        if decoder.eof:
            return b"".join(out)
    raise RuntimeError("the LZ4 frame is incomplete")


def zstd_message(data: bytes) -> bytes:
    """Return the payload of a message that was compressed by itself; raises as `zstd_chunk`."""
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
    """Yield a file for reading, decompressed beforehand if it was compressed as a whole.

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
                raise InputError(str(path), str(error),
                                 "if it is a bag, decompress it with zstd -d") from error
            except zstandard.ZstdError as error:
                lost.append(f"the compression of the file is damaged "
                            f"({first_line(error)}): what follows is lost")
            if not plain.tell():
                raise InputError(str(path), "nothing of the compressed file can be read",
                                 "record the bag anew")
            plain.seek(0)
            yield plain


def _copy(file: BinaryIO, plain: BinaryIO) -> None:
    """Decompress `file` into `plain`, up to its limit."""
    size = os.fstat(file.fileno()).st_size
    limit = max(FREE, min(RATIO * size, shutil.disk_usage(tempfile.gettempdir()).free // 2))
    inside = zstandard.frame_content_size(file.read(ZSTD_HEAD))
    refuse_beyond(limit, inside)
    file.seek(0)
    stream = zstandard.ZstdDecompressor().stream_reader(file, read_across_frames=True)
    while block := stream.read(BLOCK):
        refuse_beyond(limit, plain.tell() + len(block))
        plain.write(block)
