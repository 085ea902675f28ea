# SPDX-License-Identifier: Apache-2.0
"""One file of a journal: consecutive MCAP records, so that any leading part can be read.

Messages are stored without chunks: data passed to the system survive the process. A closed file
has a summary; `finish_file` adds one to a file whose writer was killed.
"""

import os
import struct
import zlib
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Channel, Footer, Header, McapRecord, Schema, Statistics

from selfcal_ros.bagio.mcap_chunk import (
    FOOTER_SIZE,
    MAGIC,
    MessageBlock,
    message_block,
    stretch,
)
from selfcal_ros.bagio.mcap_salvage import HEAD, MESSAGE_FRONT, parsed
from selfcal_ros.bagio.writer import FileEntry
from selfcal_ros.outputs import sync_folder

MESSAGE = struct.Struct("<BQHIQQ")
"""A message record before its payload."""


@dataclass
class Content:
    """Content of a file: counts of messages, declarations, and the end of its records.

    Attributes
    ----------
    entry : FileEntry
        Name, number of messages, first and last log time.
    counts : dict
        Channel -> number of messages.
    schemas, channels : dict
        By their numbers.
    kept : list of (int, bytes)
        Channel and payload of the requested messages.
    end : int
        End of the last complete record.
    damaged : bool
        Whether it is followed by something other than an unfinished record or the end.
    """

    entry: FileEntry
    counts: dict[int, int] = field(default_factory=dict)
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    kept: list[tuple[int, bytes]] = field(default_factory=list)
    end: int = len(MAGIC)
    damaged: bool = False

    def declare(self, record: Schema | Channel) -> None:
        """Add a schema or a channel."""
        if isinstance(record, Schema):
            self.schemas[record.id] = record
        else:
            self.channels[record.id] = record

    def add(self, channel: int, log_times_ns: list[int]) -> None:
        """Count messages by their log times, at least one."""
        entry = self.entry
        first = min(log_times_ns)
        last = max(log_times_ns)
        entry.first_ns = first if entry.first_ns is None else min(entry.first_ns, first)
        entry.last_ns = max(entry.last_ns, last)
        entry.count += len(log_times_ns)
        self.counts[channel] = self.counts.get(channel, 0) + len(log_times_ns)


def message_record(channel: int, sequence: int, log_time_ns: int, data: bytes) -> bytes:
    """Return the record of one message."""
    return (
        MESSAGE.pack(
            Opcode.MESSAGE,
            MESSAGE_FRONT + len(data),
            channel,
            sequence & 0xFFFFFFFF,
            log_time_ns,
            log_time_ns,
        )
        + data
    )


def records(*items: McapRecord) -> bytes:
    """Return the bytes of records."""
    builder = RecordBuilder()
    for item in items:
        item.write(builder)
    return builder.end()


def front() -> bytes:
    """Return the beginning of a file."""
    return MAGIC + records(Header(profile="ros2", library="selfcal_ros journal"))


def is_of_another_recorder(path: Path) -> bool:
    """Return whether another recorder writes a file: its header is another, or still to come.

    A file of a journal is never shorter than its magic; what is damaged from its first bytes on
    may be one.
    """
    own = front()
    with path.open("rb") as file:
        beginning = file.read(len(own))
    return len(beginning) < len(MAGIC) or (
        beginning.startswith(MAGIC) and not own.startswith(beginning)
    )


def ending(content: Content) -> bytes:
    """Return the end of a file: repeated declarations, statistics, and checksums."""
    entry = content.entry
    summary = records(
        *content.schemas.values(),
        *content.channels.values(),
        Statistics(
            attachment_count=0,
            channel_count=len(content.channels),
            channel_message_counts=content.counts,
            chunk_count=0,
            message_count=entry.count,
            message_end_time=entry.last_ns,
            message_start_time=entry.first_ns or 0,
            metadata_count=0,
            schema_count=len(content.schemas),
        ),
    )
    data_end = struct.pack("<BQI", Opcode.DATA_END, 4, 0)
    start = content.end + len(data_end)
    crc = zlib.crc32(
        struct.pack("<BQQQ", Opcode.FOOTER, FOOTER_SIZE, start, 0), zlib.crc32(summary)
    )
    footer = records(
        Footer(summary_start=start, summary_offset_start=0, summary_crc=crc)
    )
    return data_end + summary + footer + MAGIC


UNFINISHED = ".part"
"""Suffix of a file whose beginning is not on the disk yet."""


class JournalFile:
    """Append records to a new file; a failed write is undone."""

    def __init__(self, path: Path) -> None:
        self.content = Content(FileEntry(path.name), end=0)
        self._torn = False  # whether there is data after the last complete record
        # so that a file of a journal is never empty
        part = path.with_suffix(UNFINISHED)
        self._fd = os.open(
            part,
            os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_APPEND | os.O_CLOEXEC,
            0o666,
        )
        try:
            self.append(front())
            os.fsync(self._fd)
            os.rename(part, path)
        except OSError:
            os.close(self._fd)
            part.unlink(missing_ok=True)
            raise
        sync_folder(path.parent)

    def append(self, data: bytes) -> None:
        """Write complete records; after an OSError the file is unchanged.

        If a failed write cannot be undone, nothing is appended until it can.
        """
        self._take_back()
        remaining = memoryview(data)
        try:
            while remaining:
                remaining = remaining[os.write(self._fd, remaining) :]
        except OSError:
            self._torn = True
            with suppress(OSError):
                self._take_back()
            raise
        self.content.end += len(data)

    def _take_back(self) -> None:
        if self._torn:
            os.ftruncate(self._fd, self.content.end)
            self._torn = False

    def sync(self) -> None:
        """Wait until the appended data is on the disk."""
        os.fsync(self._fd)

    def close(self) -> None:
        """Write the end of the file and close it."""
        try:
            self.append(ending(self.content))
            self.sync()
        finally:
            os.close(self._fd)


def finish_file(path: Path, keep: str) -> Content:
    """Return the content of a file; complete it if its writer was killed and nothing is damaged.

    Parameters
    ----------
    path : Path
        File of a journal.
    keep : str
        Topic, without a namespace, whose messages are kept.
    """
    with path.open("rb+") as file:
        content = _scan(file, path.name, keep)
        file.seek(-len(MAGIC), 2)
        closed = file.tell() > content.end and file.read() == MAGIC
        if not closed and not content.damaged:
            file.truncate(content.end)
            file.seek(content.end)
            file.write(ending(content))
            file.flush()
            os.fsync(file.fileno())
    return content


def scan_file(path: Path, keep: str) -> Content:
    """Return the same as `finish_file`, without writing."""
    with path.open("rb") as file:
        return _scan(file, path.name, keep)


def _scan(file: BinaryIO, name: str, keep: str) -> Content:
    """Read the records of a file up to the first incomplete one."""
    content = Content(FileEntry(name))
    size = file.seek(0, 2)
    file.seek(0)
    if file.read(len(MAGIC)) != MAGIC:
        content.damaged = True
        return content
    while True:
        block, end = stretch(file, content.end, size)
        if block is None:
            head = _next_head(file, content.end)
            if head is None:
                return content
            opcode, length = head
            end = content.end + HEAD.size + length
            if end > size or opcode == Opcode.DATA_END:
                return content
            body = file.read(length)
            # longer than a block
            if opcode == Opcode.MESSAGE and length >= MESSAGE_FRONT:
                block, _ = message_block(HEAD.pack(opcode, length) + body, 0)
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                record, _ = parsed(opcode, body)
                if isinstance(record, Schema | Channel):
                    content.declare(record)
            elif opcode != Opcode.HEADER:
                content.damaged = True
                return content
        if block is not None:
            _count(content, block, keep)
        content.end = end


def _next_head(file: BinaryIO, offset: int) -> tuple[int, int] | None:
    file.seek(offset)
    head = file.read(HEAD.size)
    return HEAD.unpack(head) if len(head) == HEAD.size else None


def _count(content: Content, block: MessageBlock, keep: str) -> None:
    """Count the messages of a block, and keep the requested ones."""
    for number in block.channels():
        part = block[block.fronts["channel"] == number]
        content.add(number, part.fronts["log_time"].tolist())
        channel = content.channels.get(number)
        if channel is not None and f"/{channel.topic}".endswith(f"/{keep}"):
            content.kept += [(number, data) for data in part.payloads]
