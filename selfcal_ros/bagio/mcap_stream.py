# SPDX-License-Identifier: Apache-2.0
"""MCAP as a stream of messages that survives a truncated or damaged file.

The mcap library reads the single records. This module goes from one to the next, so that what a
recorder that died leaves behind, or what is damaged in the middle, costs no more than itself.
Files and messages that rosbag2 compressed are decompressed on the way.
"""

import shutil
import struct
import tempfile
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import BinaryIO

import zstandard
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, McapRecord, Message, Schema, Statistics
from mcap.stream_reader import breakup_chunk

from selfcal_ros.bagio.mcap_salvage import (
    HEAD,
    declarations,
    front_of_chunk,
    next_record,
    parsed,
)
from selfcal_ros.errors import InputError, first_line

MAGIC = b"\x89MCAP0\r\n"
ZSTD = b"\x28\xb5\x2f\xfd"
"""First bytes of a file of a bag with compression_mode FILE, or of a message with MESSAGE."""
CHECKED = (Opcode.HEADER, Opcode.CHUNK, Opcode.MESSAGE_INDEX, Opcode.MESSAGE, Opcode.SCHEMA,
           Opcode.CHANNEL)
"""Records whose length is not believed blindly: one that only skips may skip too far."""


class _Cut(Exception):
    """The file ends within a record."""


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
    _n_read: int = 0
    _n_written: int = 0
    _chunked: bool = False
    _undeclared: Counter = field(default_factory=Counter)

    def messages(self) -> Iterator[tuple[Channel, Message]]:
        """Yield channel and message of every message that can be read.

        Raises
        ------
        InputError
            If the file is empty, no MCAP file, or cannot be read.
        """
        try:
            with self._opened() as file:
                head = file.read(len(MAGIC))
                if not head:
                    raise InputError(str(self.path), "the file is empty", "record the bag anew")
                if head != MAGIC:
                    raise InputError(str(self.path), "not an MCAP file",
                                     "give an .mcap file or a rosbag2 folder")
                yield from self._records(file)
        except OSError as error:
            raise InputError(str(self.path), f"cannot be read ({error.strerror})",
                             "name a readable file") from error
        self.lost += [f"{count} messages of the undeclared channel {number} cannot be read"
                      for number, count in self._undeclared.items()]
        if self._n_read < self._n_written:
            self.lost.append(f"{self._n_written - self._n_read} of {self._n_written} messages of "
                             "the file are lost")

    @contextmanager
    def _opened(self) -> Iterator[BinaryIO]:
        """Yield the file, decompressed if it was compressed as a whole."""
        with self.path.open("rb") as file:
            compressed = file.read(len(ZSTD)) == ZSTD
            file.seek(0)
            if not compressed:
                yield file
                return
            with tempfile.TemporaryFile() as plain:
                try:
                    shutil.copyfileobj(zstandard.ZstdDecompressor().stream_reader(
                        file, read_across_frames=True), plain)
                except zstandard.ZstdError as error:
                    self.lost.append(f"the compression of the file is damaged "
                                     f"({first_line(error)}): what follows is lost")
                if not plain.tell():
                    raise InputError(str(self.path), "nothing of the compressed file can be read",
                                     "record the bag anew")
                plain.seek(0)
                yield plain

    def _records(self, file: BinaryIO) -> Iterator[tuple[Channel, Message]]:
        """Go from record to record; what begins before `sure` has certainly been read."""
        size = file.seek(0, 2)
        at = sure = clean = len(MAGIC)
        data_ended = False
        while True:
            try:
                opcode, record, end = _record(file, at, size)
            except Exception as error:  # a damaged record may fail anywhere in its parser
                if data_ended or at == size == clean:
                    self._say_end(data_ended)
                    return
                file.seek(at)
                start = at if file.read(1) == bytes([Opcode.CHUNK]) else sure
                yield from self._salvage(file, start, error)
                at = sure = self._found(file, start)
                if at == size:
                    return
                continue
            if opcode == Opcode.FOOTER:
                return
            data_ended = data_ended or opcode == Opcode.DATA_END
            if opcode in CHECKED:  # only the record behind a message shows that its length is right
                sure, clean = at if opcode == Opcode.MESSAGE else end, end
            at = end
            if isinstance(record, Chunk):
                self._chunked = True
                yield from self._chunk(file, record, end)
            elif record is not None:
                yield from self._take(record)

    def _chunk(self, file: BinaryIO, chunk: Chunk,
               position: int) -> Iterator[tuple[Channel, Message]]:
        try:
            records = breakup_chunk(chunk, validate_crc=True)
        except Exception as error:
            self.lost.append(f"the chunk that ends at byte {position} is damaged "
                             f"({first_line(error)[:80]}): its messages are lost")
            self._declare(file)
            return
        for record in records:
            yield from self._take(record)

    def _take(self, record: McapRecord) -> Iterator[tuple[Channel, Message]]:
        if isinstance(record, Schema):
            self.schemas[record.id] = record
        elif isinstance(record, Channel):
            self.channels[record.id] = record
        elif isinstance(record, Statistics):
            self._n_written = record.message_count
        elif isinstance(record, Message):
            self._n_read += 1
            channel = self.channels.get(record.channel_id)
            if channel is None:
                self._undeclared[record.channel_id] += 1
                return
            if record.data.startswith(ZSTD) and channel.message_encoding == "cdr":
                record.data = _decompressed(record.data)
            yield channel, record

    def _say_end(self, data_ended: bool) -> None:
        self.lost.append(
            "the end of the file is damaged, behind the last message: no message is lost"
            if data_ended else "the file ends without its footer, as when a recorder is killed: "
            "every message that was written is read")

    def _found(self, file: BinaryIO, start: int) -> int:
        """Return where reading can go on behind `start`."""
        with mmap(file.fileno(), 0, access=ACCESS_READ) as data:
            return next_record(data, start, None if self._chunked else self.channels)

    def _declare(self, file: BinaryIO) -> None:
        """Take from the summary what was declared in the part that is lost."""
        with mmap(file.fileno(), 0, access=ACCESS_READ) as data:
            for record in declarations(data):
                known = self.schemas if isinstance(record, Schema) else self.channels
                known.setdefault(record.id, record)

    def _salvage(self, file: BinaryIO, start: int,
                 error: Exception) -> Iterator[tuple[Channel, Message]]:
        """Yield what is readable of the record at `start`, and say what is not."""
        stop, size = self._found(file, start), file.seek(0, 2)
        file.seek(start)
        count = 0
        for record in front_of_chunk(file.read(stop - start)):
            self._chunked = True
            for item in self._take(record):
                count += 1
                yield item
        self._declare(file)
        if stop < size:
            self.lost.append(f"the file is damaged from byte {start} to {stop}: {count} messages "
                             "there could be saved, what else stood there is lost")
            return
        reason = "truncated" if isinstance(error, _Cut) else f"damaged ({first_line(error)})"
        self.lost.append(f"the file is {reason} after byte {start} of {size}: {count} messages "
                         "of the last chunk could be saved, what followed is lost")


def _record(file: BinaryIO, at: int, size: int) -> tuple[int, McapRecord | None, int]:
    """Return opcode, content (None where it does not matter) and end of the record at `at`."""
    file.seek(at)
    head = file.read(HEAD.size)
    if len(head) < HEAD.size:
        raise _Cut
    opcode, length = HEAD.unpack(head)
    if not (0 < opcode <= max(Opcode) or opcode >= 0x80):  # the range that private records have
        raise ValueError(f"no record has the opcode {opcode}")
    if at + HEAD.size + length > size:
        raise _Cut
    if opcode >= 0x80 or opcode == Opcode.ATTACHMENT:
        return opcode, None, at + HEAD.size + length
    body = file.read(length)
    if opcode == Opcode.MESSAGE_INDEX and struct.unpack_from("<I", body, 2)[0] != length - 6:
        raise ValueError("the length of a message index is wrong")
    record, used = parsed(opcode, body)
    # a chunk ends where its records do, even if the length before it says more
    return opcode, record, at + HEAD.size + (used if opcode == Opcode.CHUNK else length)


def _decompressed(data: bytes) -> bytes:
    """Return a message's payload, or `data` as it is if that fails: it will not decode either."""
    try:
        return zstandard.ZstdDecompressor().decompressobj().decompress(data)
    except zstandard.ZstdError:
        return data
