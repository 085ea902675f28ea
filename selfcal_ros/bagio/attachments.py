# SPDX-License-Identifier: Apache-2.0
"""Files kept in a bag as MCAP attachments: result, plan, exports.

The messages of the file stay as they are, byte by byte: attachments follow them, and the summary
is written anew.
"""

import io
import os
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, AttachmentIndex, DataEnd, Footer, McapRecord, Statistics

from selfcal_ros.bagio.journal_file import records
from selfcal_ros.bagio.mcap_chunk import FOOTER_SIZE, MAGIC
from selfcal_ros.bagio.mcap_salvage import HEAD
from selfcal_ros.bagio.reader import BagReader
from selfcal_ros.errors import InputError
from selfcal_ros.outputs import atomic_file
from selfcal_ros.results import REMEDY, attachments, records_in, summary_of

BLOCK = 1 << 20
DATA_END_SIZE = HEAD.size + 4
PARSERS = {Opcode.STATISTICS: Statistics.read, Opcode.ATTACHMENT_INDEX: AttachmentIndex.read}
_WRITTEN_ANEW = (Opcode.SUMMARY_OFFSET, Opcode.STATISTICS, Opcode.ATTACHMENT_INDEX)


@dataclass(frozen=True, eq=False)
class _Summary:
    """End of a file: where its data end, and the records of its summary."""

    data_end: int
    others: bytes
    statistics: Statistics | None
    index: tuple[AttachmentIndex, ...]


def _parsed(opcode: int, body: bytes) -> McapRecord | None:
    """Return a record; None if the body is not one of that kind."""
    try:
        return PARSERS[Opcode(opcode)](ReadDataStream(io.BytesIO(body)))
    except (McapError, KeyError, ValueError, struct.error, MemoryError):
        return None


def attached(bag: str | Path) -> dict[str, bytes]:
    """Return the attachments of a bag by name.

    Raises
    ------
    InputError
        If a file of the bag has no summary, or an attachment is damaged.
    """
    return attachments(BagReader(Path(bag)).files)


def attach(bag: str | Path, items: Sequence[tuple[str, str, bytes]], log_time_ns: int) -> None:
    """Add attachments to the first file of a bag.

    Parameters
    ----------
    bag : str or Path
        The bag; its file is replaced at once, or left as it was.
    items : sequence of (str, str, bytes)
        Name, media type and content.
    log_time_ns : int
        Time of the attachments.

    Raises
    ------
    InputError
        If the file has no summary, has an attachment of this name, is write-protected, or is
        written to meanwhile.
    """
    path = BagReader(Path(bag)).files[0]
    if not path.stat().st_mode & 0o222:  # a new file in its place would not ask
        raise InputError(str(path), "is write-protected", "allow writing to it, or take a copy")
    state = _state(path)
    taken = set(attached(bag))
    for name, *_ in items:
        if not name.isprintable():  # nor are bytes that are no UTF-8
            raise InputError(f"{bag}: {name!a}", "has characters that cannot be printed",
                             "rename the file")
        if name in taken:
            raise InputError(f"{bag}: {name}", "is already in the bag",
                             "give the file another name, or take a copy of the recording")
        taken.add(name)
    with path.open("rb") as file, atomic_file(path) as out:
        summary = _summary(file, path)
        file.seek(0)
        _copy(file, out, summary.data_end)
        index = list(summary.index)
        for name, kind, data in items:
            raw = records(Attachment(log_time_ns, log_time_ns, name, kind, data))
            index.append(AttachmentIndex(out.tell(), len(raw), log_time_ns, log_time_ns, len(data),
                                         name, kind))
            out.write(raw)
        out.write(records(DataEnd(0)))
        more: list[McapRecord] = list(index)
        if summary.statistics is not None:
            count = summary.statistics.attachment_count + len(items)  # some may have no index
            more.append(replace(summary.statistics, attachment_count=count))
        text, start = summary.others + records(*more), out.tell()
        crc = zlib.crc32(struct.pack("<BQQQ", Opcode.FOOTER, FOOTER_SIZE, start, 0),
                         zlib.crc32(text))
        out.write(text + records(Footer(start, 0, crc)) + MAGIC)
        out.flush()
        os.fsync(out.fileno())  # takes its time: before the last look at the file
        if _state(path) != state:
            raise InputError(str(path), "another program has written to it meanwhile",
                             "embed again")


def _state(path: Path) -> tuple[int, ...]:
    """Return what changes when a file is written or replaced."""
    found = path.stat()
    return found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns


def _copy(file: BinaryIO, out: BinaryIO, size: int) -> None:
    """Copy the first `size` bytes of a file."""
    while size > 0 and (block := file.read(min(size, BLOCK))):
        out.write(block)
        size -= len(block)


def _summary(file: BinaryIO, path: Path) -> _Summary:
    """Return the end of a file; InputError if it has no complete one."""
    start, text = summary_of(file, path)
    file.seek(max(start - DATA_END_SIZE, 0))
    if file.read(HEAD.size) != HEAD.pack(Opcode.DATA_END, 4):
        raise InputError(str(path), "not an MCAP file with a summary", REMEDY)
    others, statistics, index = [], None, []
    for opcode, body in records_in(text, path):
        record = _parsed(opcode, body)
        if opcode in _WRITTEN_ANEW[1:] and record is None:
            raise InputError(str(path), "its summary is damaged", REMEDY)
        if isinstance(record, Statistics):
            statistics = record
        elif isinstance(record, AttachmentIndex):
            index.append(record)
        elif opcode not in _WRITTEN_ANEW:
            others.append(HEAD.pack(opcode, len(body)) + body)
    return _Summary(start - DATA_END_SIZE, b"".join(others), statistics, tuple(index))
