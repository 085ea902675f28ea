# SPDX-License-Identifier: Apache-2.0
"""MCAP as a stream of messages, tolerant of truncated or damaged files.

The mcap library reads the records other than messages. This module goes from record to record, so
that after truncation or damage only the affected part is lost. Consecutive messages are
yielded in blocks. Files and messages compressed by rosbag2 are decompressed. A file that is
still being written is read up to its size when opened. Files joined to one are read one by one.
"""

import struct
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import BinaryIO

import numpy as np
import zstandard
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, McapRecord, Message, Schema, Statistics

from selfcal_ros.bagio import mcap_chunk, mcap_salvage
from selfcal_ros.bagio.messages.cdr import Payloads
from selfcal_ros.errors import InputError, first_line

CHECKED = (
    Opcode.HEADER,
    Opcode.CHUNK,
    Opcode.MESSAGE_INDEX,
    Opcode.MESSAGE,
    Opcode.SCHEMA,
    Opcode.CHANNEL,
)
"""Records whose declared length is validated before skipping, as it may be too large."""
INDEX = struct.Struct("<HI")
"""Channel and bytes of the entries of a message index."""
INDEX_ENTRY = 16
SQLITE = b"SQLite format 3"
CONVERT = (
    "convert it with `ros2 bag convert -i BAG -o OPTIONS.yaml`, where OPTIONS.yaml says "
    "output_bags: [{uri: NEW, storage_id: mcap, all_topics: true}], or without ROS with "
    "`rosbags-convert --src BAG --dst NEW --dst-storage mcap`"
)
"""Remedy for a bag with another storage."""


class _Cut(Exception):
    """The file ends within a record."""


def streams(
    files: Iterable[Path], lost: list[str], wanted: Callable[[str], bool] | None = None
) -> Iterator["McapStream"]:
    """Yield a stream for each file, and for each file joined to it (`cat A B`), to be read in turn.

    Numbers of schemas and channels are those of one stream.
    """
    for file in files:
        begin: int | None = 0
        while begin is not None:
            stream = McapStream(file, lost=lost, wanted=wanted, begin=begin)
            yield stream
            begin = stream.rest


@dataclass
class McapStream:
    """Messages of one MCAP file, in the order of the file.

    Attributes
    ----------
    path : Path
        The file.
    begin : int
        Byte at which it begins; not 0 if it was joined to another file.
    rest : int or None
        Byte at which another file joined to it begins, after reading.
    schemas, channels : dict
        Filled while the messages are read.
    lost : list of str
        Parts that could not be read, one line each.
    wanted : callable or None
        Whether a topic is needed; chunks with only other topics are skipped. None = all.
    """

    path: Path
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    lost: list[str] = field(default_factory=list)
    wanted: Callable[[str], bool] | None = None
    begin: int = 0
    rest: int | None = None
    _needless: dict[int, int] = field(default_factory=dict)
    _size: int = 0  # size of the file when opened
    _n_read: int = 0
    _n_written: int = 0
    _chunked: bool = False
    _undeclared: Counter = field(default_factory=Counter)
    _too_large: Counter = field(default_factory=Counter)

    def messages(self) -> Iterator[tuple[Channel, Message]]:
        """Yield channel and message of every readable message; raises like `blocks`."""
        for block in self.blocks():
            for message in block.messages():
                yield self.channels[message.channel_id], message

    def blocks(self) -> Iterator[mcap_chunk.MessageBlock]:
        """Yield all readable messages of declared channels in blocks.

        Declarations between two blocks are in `schemas` and `channels` when the second one
        is yielded.

        Raises
        ------
        InputError
            If the file is empty, not an MCAP file, or cannot be read.
        """
        try:
            with mcap_salvage.plain_file(self.path, self.lost) as file:
                self._size = file.seek(0, 2)
                file.seek(self.begin)
                head = file.read(len(mcap_chunk.MAGIC))
                if head == mcap_chunk.MAGIC:
                    self._look_ahead(file)
                    yield from self._records(file)
                elif not self.begin:
                    raise self._refusal(head + file.read(len(SQLITE)))
                else:
                    self._pass_strange(file)
        except OSError as error:
            raise InputError(
                str(self.path),
                f"cannot be read ({error.strerror})",
                "name a readable file",
            ) from error
        self.lost += [
            f"{count} messages of the undeclared channel {number} cannot be read"
            for number, count in self._undeclared.items()
        ]
        self.lost += [
            f"{count} messages on {topic} were not decompressed: they would become too large"
            for topic, count in self._too_large.items()
        ]
        if self._n_read < self._n_written:
            self.lost.append(
                f"{self._n_written - self._n_read} of {self._n_written} messages of "
                "the file are lost"
            )

    def _pass_strange(self, file: BinaryIO) -> None:
        """Say what follows a recording and is not MCAP, up to the next one."""
        with mmap(file.fileno(), self._size, access=ACCESS_READ) as data:
            joint = data.find(mcap_chunk.MAGIC, self.begin)
        end = self._size
        if joint >= 0:
            end = self.rest = joint
        self.lost.append(
            f"{end - self.begin} bytes after the end of the recording are not MCAP "
            "and were not used"
        )

    def _refusal(self, head: bytes) -> InputError:
        """Return the problem of a file that is not MCAP, by its first bytes."""
        if not head:
            return InputError(
                str(self.path), "the file is empty", "record the bag again"
            )
        if head.startswith(SQLITE):
            return InputError(str(self.path), "a bag with sqlite3 storage", CONVERT)
        return InputError(
            str(self.path), "not an MCAP file", "give an .mcap file or a rosbag2 folder"
        )

    def _look_ahead(self, file: BinaryIO) -> None:
        """Determine the chunks that can be skipped; their declarations are also in the summary."""
        # places in a summary count from the begin
        if self.wanted is None or self.begin:
            return
        summary = mcap_chunk.read_summary(file)
        self._needless = summary.needless(self.wanted)
        if self._needless:
            self.schemas, self.channels = summary.schemas, summary.channels

    def _records(self, file: BinaryIO) -> Iterator[mcap_chunk.MessageBlock]:
        """Go from record to record; records that begin before `sure` have been read."""
        size = self._size
        offset = sure = clean = self.begin + len(mcap_chunk.MAGIC)
        last = offset  # the record before
        data_ended = passed = False
        while offset <= self._size:
            block, end = mcap_chunk.stretch(file, offset, size)
            if block is not None:
                last = sure = offset + int(block.payloads.start[-1]) - mcap_chunk.FRONT
                clean = end
                offset = end
                yield from self._take(block)
                continue
            if _is_chunk(file, offset, self._needless.get(offset)):
                self._chunked = passed = True
                offset = sure = clean = self._needless[offset]
                continue
            try:
                opcode, record, end = _record(file, offset, size)
            except Exception as error:
                # a damaged record may fail anywhere in its parser
                size = self._end_at_joint(file, last, size)
                # the one before is cut off
                offset, sure = (offset, sure) if offset <= size else (last, last)
                if data_ended or offset == size == clean:
                    self._say_end(file, data_ended)
                    return
                file.seek(offset)
                start = offset if file.read(1) == bytes([Opcode.CHUNK]) else sure
                yield from self._salvage(file, start, error)
                offset = sure = self._next_record(file, start)
                if offset == size:
                    return
                continue
            if opcode == Opcode.FOOTER:
                self._note_rest(file, end)
                return
            data_ended = data_ended or opcode == Opcode.DATA_END
            last = offset
            if opcode in CHECKED:  # only the record after a message confirms its length
                sure = offset if opcode == Opcode.MESSAGE else end
                clean = end
            if passed and opcode == Opcode.MESSAGE_INDEX:
                self._n_read += (
                    end - offset - mcap_salvage.HEAD.size - INDEX.size
                ) // INDEX_ENTRY
            offset = end
            if isinstance(record, Chunk):
                self._chunked, passed = True, False
                yield from self._chunk(file, record, (last, end))
            elif record is not None:
                yield from self._take(record)

    def _note_rest(self, file: BinaryIO, end: int) -> None:
        """Note what follows the footer that ends at `end`, and the magic after it."""
        file.seek(end)
        if file.read(len(mcap_chunk.JOINT)) != mcap_chunk.JOINT:
            end += len(mcap_chunk.MAGIC)
        self.rest = end if end < self._size else None

    def _end_at_joint(self, file: BinaryIO, start: int, stop: int) -> int:
        """End a file without its footer where one that was joined to it begins; return the end."""
        with mmap(file.fileno(), self._size, access=ACCESS_READ) as data:
            joint = data.find(mcap_chunk.JOINT, start, stop + len(mcap_chunk.JOINT) - 1)
        if joint >= 0:
            self._size = self.rest = joint
        return self._size

    def _chunk(
        self, file: BinaryIO, chunk: Chunk, place: tuple[int, int]
    ) -> Iterator[mcap_chunk.MessageBlock]:
        """Yield the messages of a chunk between two bytes of the file."""
        start, position = place
        try:
            items = mcap_chunk.chunk_items(chunk)
        except mcap_salvage.TooLargeError as error:
            self.lost.append(
                f"the chunk that ends at byte {position} was not read: {error}"
            )
            self._declare(file)
            return
        except Exception as error:
            self._end_at_joint(file, start, position)
            if self.rest is not None:
                yield from self._salvage(file, start, _Cut())
                return
            self.lost.append(
                f"the chunk that ends at byte {position} is damaged "
                f"({first_line(error)[:80]}): its messages are lost"
            )
            self._declare(file)
            return
        for item in items:
            yield from self._take(item)

    def _take(
        self, item: McapRecord | mcap_chunk.MessageBlock
    ) -> Iterator[mcap_chunk.MessageBlock]:
        if isinstance(item, Schema):
            self.schemas[item.id] = item
        elif isinstance(item, Channel):
            self.channels[item.id] = item
        elif isinstance(item, Statistics):
            self._n_written = item.message_count
        elif isinstance(item, Message):
            yield from self._take(mcap_chunk.block_of([item]))
        elif isinstance(item, mcap_chunk.MessageBlock):
            self._n_read += len(item)
            block = self._decompressed(self._declared(item))
            if len(block):
                yield block

    def _declared(self, block: mcap_chunk.MessageBlock) -> mcap_chunk.MessageBlock:
        """Return the messages of declared channels; the others are counted."""
        missing = [number for number in block.channels() if number not in self.channels]
        if not missing:
            return block
        for number in missing:
            self._undeclared[number] += int((block.fronts["channel"] == number).sum())
        return block[~np.isin(block.fronts["channel"], missing)]

    def _decompressed(self, block: mcap_chunk.MessageBlock) -> mcap_chunk.MessageBlock:
        """Return the messages with payloads compressed by rosbag2 decompressed.

        A payload that cannot be decompressed is unchanged: decoding it will fail, too.
        """
        packed = [
            number
            for number in block.compressed().tolist()
            if self.channels[int(block.fronts["channel"][number])].message_encoding
            == "cdr"
        ]
        if not packed:
            return block
        keep = np.ones(len(block), dtype=bool)
        payloads = list(block.payloads)
        for number in packed:
            try:
                payloads[number] = mcap_salvage.zstd_message(payloads[number])
            except mcap_salvage.TooLargeError:
                topic = self.channels[int(block.fronts["channel"][number])].topic
                self._too_large[topic] += 1
                keep[number] = False
            except zstandard.ZstdError:
                pass
        return mcap_chunk.MessageBlock(block.fronts, Payloads.joined(payloads))[keep]

    def _say_end(self, file: BinaryIO, data_ended: bool) -> None:
        self.lost.append(
            self._grown(file)
            or (
                "the end of the file is damaged, after the last message: no message is lost"
                if data_ended
                else "the file ends without its footer, as when a recorder is "
                "killed: every message that was written is read"
            )
        )

    def _grown(self, file: BinaryIO) -> str:
        """Return a note if a file has grown since it was opened, else ""."""
        if file.seek(0, 2) == self._size or self.rest is not None:
            return ""
        return (
            f"the file is still being written: the messages in its first {self._size} bytes "
            "are read"
        )

    def _next_record(self, file: BinaryIO, start: int) -> int:
        """Return where reading can continue after `start`."""
        with mmap(file.fileno(), self._size, access=ACCESS_READ) as data:
            return mcap_salvage.next_record(
                data, start, None if self._chunked else self.channels
            )

    def _declare(self, file: BinaryIO) -> None:
        """Take declarations of the lost part from the summary."""
        with mmap(file.fileno(), self._size, access=ACCESS_READ) as data:
            for record in mcap_salvage.declarations(data):
                if isinstance(record, Schema):
                    self.schemas.setdefault(record.id, record)
                else:
                    self.channels.setdefault(record.id, record)

    def _salvage(
        self, file: BinaryIO, start: int, error: Exception
    ) -> Iterator[mcap_chunk.MessageBlock]:
        """Yield the readable part of the record at `start`, and report the rest."""
        stop = self._next_record(file, start)
        size = self._size
        file.seek(start)
        count = 0
        for item in mcap_chunk.gathered(
            list(mcap_salvage.front_of_chunk(file.read(stop - start)))
        ):
            self._chunked = True
            for block in self._take(item):
                count += len(block)
                yield block
        self._declare(file)
        if stop < size:
            self.lost.append(
                f"the file is damaged from byte {start} to {stop}: {count} messages "
                "there were recovered, the rest there is lost"
            )
            return
        grown = self._grown(file) if isinstance(error, _Cut) else ""
        if grown:
            self.lost.append(grown)
            return
        reason = (
            "truncated" if isinstance(error, _Cut) else f"damaged ({first_line(error)})"
        )
        self.lost.append(
            f"the file is {reason} after byte {start} of {size}: {count} messages "
            "of the last chunk were recovered, the rest is lost"
        )


def _is_chunk(file: BinaryIO, offset: int, end: int | None) -> bool:
    """Return whether there is a chunk of the indexed length at `offset`."""
    if end is None:
        return False
    head = mcap_salvage.HEAD
    file.seek(offset)
    return file.read(head.size) == head.pack(Opcode.CHUNK, end - offset - head.size)


def _record(
    file: BinaryIO, offset: int, size: int
) -> tuple[int, McapRecord | None, int]:
    """Return opcode, content (None if not needed) and end of the record at `offset`."""
    file.seek(offset)
    head = file.read(mcap_salvage.HEAD.size)
    if len(head) < mcap_salvage.HEAD.size:
        raise _Cut
    opcode, length = mcap_salvage.HEAD.unpack(head)
    # the range of private records
    if not (0 < opcode <= max(Opcode) or opcode >= 0x80):
        raise ValueError(f"no record has the opcode {opcode}")
    if offset + mcap_salvage.HEAD.size + length > size:
        raise _Cut
    if opcode >= 0x80 or opcode == Opcode.ATTACHMENT:
        return opcode, None, offset + mcap_salvage.HEAD.size + length
    body = file.read(length)
    if opcode != Opcode.CHUNK and mcap_chunk.JOINT in body + file.read(
        len(mcap_chunk.JOINT) - 1
    ):
        raise _Cut
    if opcode == Opcode.MESSAGE_INDEX:
        if INDEX.unpack_from(body)[1] != length - INDEX.size:
            raise ValueError("the length of a message index is wrong")
        return opcode, None, offset + mcap_salvage.HEAD.size + length
    record, used = mcap_salvage.parsed(opcode, body)
    # a chunk ends where its records do, even if the length before it says more
    size = used if opcode == Opcode.CHUNK else length
    return opcode, record, offset + mcap_salvage.HEAD.size + size
