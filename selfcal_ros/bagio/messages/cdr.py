# SPDX-License-Identifier: Apache-2.0
"""Many CDR messages of one type at once: bytes in, numpy columns out.

In CDR the offset of a field depends on the lengths of preceding strings and sequences. Messages
that agree in these share a layout, a numpy structure over their bytes: one message is
parsed, all others of its layout are views. Messages without a layout, or with a rare one, are
left to the caller. Used for bags and by live nodes.
"""

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

HEAD = 4
"""Bytes of the encapsulation before a message; alignment is relative to its end."""
LITTLE, BIG = b"\0\1", b"\0\0"
SEQUENCE = -1
"""Count of a field whose number of elements is in the message."""
TEXT = "text"
WORD = 8
EVERY_BIT = (1 << 8 * WORD) - 1
MAX_LENGTH = 1 << 13
"""Bytes of the longest message that is decoded: 140 joints with names of 30 letters, positions,
velocities and efforts."""
MAX_KNOWN = 16
"""Cached layouts per message length."""
MAX_LENGTHS, MAX_KNOWN_BYTES = 256, 1 << 17
"""Number of lengths with cached layouts, and total bytes of their examples."""
FREE_TRIES, WORTH = 16, 32
"""New layouts allowed per call, and messages that allow one more."""
TRY_BYTES = 512
"""A layout of more bytes counts as several: 1 ms per kB."""


@dataclass(frozen=True)
class Field:
    """One field of a message type.

    Attributes
    ----------
    name : str
        Its name.
    kind : str or tuple of Field
        Numpy code without byte order (``f8``), `TEXT`, or the fields of a message in it.
    count : int or None
        None = a single one, `SEQUENCE`, or the number of elements of an array.
    """

    name: str
    kind: "str | tuple[Field, ...]"
    count: int | None = None


@dataclass(frozen=True)
class Layout:
    """Offsets of the fields of all messages of the same form.

    Attributes
    ----------
    length : int
        Bytes of such a message.
    end : int
        Bytes taken by its fields; trailing bytes are ignored.
    values : dict
        Name -> (numpy code, offset, None or number of elements); fields of inner messages as
        ``header.stamp.sec``, except those within sequences of messages.
    texts : dict
        Name -> the strings, the same in all these messages.
    fixed : bytes
        Mask of the bytes that decide the layout: 255 where all messages must agree.
    example : bytes
        The parsed message.
    """

    length: int
    end: int
    values: dict[str, tuple[str, int, int | None]]
    texts: dict[str, tuple[str, ...]]
    fixed: bytes
    example: bytes

    @cached_property
    def _words(self) -> list[tuple[str, int, np.uint64, np.uint64]]:
        """Return name, offset, mask and value of each word that determines the layout."""
        words = []
        for start in range(0, self.length, WORD):
            place = min(start, self.length - WORD)
            mask = int.from_bytes(self.fixed[place : place + WORD], "little")
            value = int.from_bytes(self.example[place : place + WORD], "little") & mask
            if mask:
                words.append(
                    (f"word {place}", place, np.uint64(mask), np.uint64(value))
                )
        return words

    @cached_property
    def dtype(self) -> np.dtype:
        """The messages as a numpy structure: the values, and the determining words."""
        fields = [
            (name, code if count is None else (code, (count,)), offset)
            for name, (code, offset, count) in self.values.items()
        ]
        fields += [(name, "<u8", offset) for name, offset, _, _ in self._words]
        names, formats, offsets = zip(*fields, strict=True)
        return np.dtype(
            {
                "names": names,
                "formats": formats,
                "offsets": offsets,
                "itemsize": self.length,
            }
        )

    def matches(self, rows: np.ndarray) -> np.ndarray:
        """Return which messages have this layout, bool (n,), from a table of `dtype`."""
        good = np.ones(len(rows), dtype=bool)
        for name, _, mask, value in self._words:
            column = rows[name]
            good &= (column if mask == EVERY_BIT else column & mask) == value
        return good


def layout_of(fields: Sequence[Field], data: bytes) -> Layout | None:
    """Return the layout of one message; None if damaged or unsupported.

    Parameters
    ----------
    fields : sequence of Field
        The fields of its type, in their order.
    data : bytes
        The message with its encapsulation.
    """
    if data[:2] not in (LITTLE, BIG) or len(data) < HEAD + WORD:
        return None
    walk = _Walk(data)
    try:
        walk.fields(fields, "")
    except (struct.error, ValueError):
        return None
    return Layout(
        length=len(data),
        end=walk.at,
        values=walk.values,
        texts=walk.texts,
        fixed=bytes(walk.fixed),
        example=data,
    )


class _Walk:
    """Parse one message field by field; raises ValueError if damaged."""

    def __init__(self, data: bytes) -> None:
        self.data, self.order = data, "<" if data[:2] == LITTLE else ">"
        self.at = HEAD
        self.values: dict[str, tuple[str, int, int | None]] = {}
        self.texts: dict[str, tuple[str, ...]] = {}
        self.fixed = bytearray(len(data))
        self._fix(0, 2)

    def fields(self, fields: Sequence[Field], prefix: str | None) -> None:
        """Skip the fields of a message; `prefix` is None within a sequence of messages."""
        for field in fields:
            name = None if prefix is None else prefix + field.name
            count = self._length() if field.count == SEQUENCE else field.count
            if field.kind == TEXT:
                texts = tuple(
                    self._text() for _ in range(1 if count is None else count)
                )
                if name is not None:
                    self.texts[name] = texts
            elif isinstance(field.kind, str):
                self._numbers(name, field.kind, count)
            elif count is None:
                self.fields(field.kind, None if name is None else f"{name}.")
            else:
                for _ in range(count):
                    self.fields(field.kind, None)

    def _fix(self, start: int, stop: int) -> None:
        self.fixed[start:stop] = b"\xff" * (stop - start)

    def _pass(self, size: int) -> int:
        """Advance by `size` bytes and return their start."""
        start = self.at
        self.at += size
        if self.at > len(self.data):
            raise ValueError("the message ends too early")
        return start

    def _align(self, size: int) -> None:
        self.at += (HEAD - self.at) % size

    def _length(self) -> int:
        self._align(4)
        start = self._pass(4)
        self._fix(start, self.at)
        count = struct.unpack_from(f"{self.order}I", self.data, start)[0]
        if count > len(self.data) - self.at:  # every element takes at least a byte
            raise ValueError("the message ends too early")
        return count

    def _text(self) -> str:
        start = self._pass(self._length())
        self._fix(start, self.at)
        if self.at == start or self.data[self.at - 1]:
            raise ValueError("a text without its end")
        return self.data[start : self.at - 1].decode()

    def _numbers(self, name: str | None, code: str, count: int | None) -> None:
        size = int(code[1:])
        if count != 0:
            self._align(size)
        start = self._pass(size if count is None else size * count)
        if name is not None:
            self.values[name] = (self.order + code, start, count)


@dataclass(frozen=True)
class Payloads:
    """Messages of one type within one buffer.

    Attributes
    ----------
    data : bytes
        The buffer.
    start, length : int64 array (n,)
        Position of each message, encapsulation included.
    """

    data: bytes
    start: np.ndarray
    length: np.ndarray

    @classmethod
    def joined(cls, messages: Sequence[bytes]) -> "Payloads":
        """Return the messages concatenated."""
        length = np.fromiter(map(len, messages), np.int64, len(messages))
        return cls(b"".join(messages), np.cumsum(length) - length, length)

    def __len__(self) -> int:
        """Return the number of messages."""
        return len(self.start)

    def __getitem__(self, which: np.ndarray) -> "Payloads":
        """Return some of the messages."""
        return Payloads(self.data, self.start[which], self.length[which])

    def __iter__(self) -> Iterator[bytes]:
        """Yield the bytes of each message."""
        for start, length in zip(
            self.start.tolist(), self.length.tolist(), strict=True
        ):
            yield self.data[start : start + length]


@dataclass(frozen=True)
class Columns:
    """Messages of one layout, decoded.

    Attributes
    ----------
    index : int64 array (n,)
        Indices of the messages.
    layout : Layout
        Their layout, with the common strings.
    """

    index: np.ndarray
    layout: Layout
    _rows: np.ndarray

    def __len__(self) -> int:
        """Return the number of messages."""
        return len(self.index)

    def __getitem__(self, name: str) -> np.ndarray:
        """Return the numbers of a field in native byte order, (n,) or (n, elements).

        Raises
        ------
        KeyError
            If the type has no such field of numbers.
        """
        if name not in self:
            raise KeyError(name)
        column = self._rows[name]
        return column.astype(column.dtype.newbyteorder("="))

    def __contains__(self, name: str) -> bool:
        """Return whether the type has such a field of numbers."""
        return name in self.layout.values


class ColumnDecoder:
    """Decode messages of one type, with a cache of layouts.

    Parameters
    ----------
    fields : sequence of Field
        The type.
    tail : int or None
        Allowed bytes after the last field; None = any number.
    """

    def __init__(self, fields: Sequence[Field], tail: int | None = None) -> None:
        self._fields, self._tail = tuple(fields), tail
        self._known: dict[int, list[Layout]] = {}

    def decode(self, messages: Payloads) -> tuple[list[Columns], np.ndarray]:
        """Return the messages by layout, and the indices of those that remain, int64 (r,).

        The remaining ones are damaged, or of a rare layout, and have to be decoded one by
        one.
        """
        groups: list[Columns] = []
        undecoded_parts: list[np.ndarray] = [np.zeros(0, dtype=np.int64)]
        tries = FREE_TRIES + len(messages) // WORTH
        # frequent lengths first, so that odd messages do not slow them down
        for index in sorted(_by_length(messages.length), key=len, reverse=True):
            tries, undecoded = self._decode_length(messages, index, groups, tries)
            undecoded_parts.append(undecoded)
        return groups, np.sort(np.concatenate(undecoded_parts))

    def _decode_length(
        self, messages: Payloads, index: np.ndarray, groups: list[Columns], tries: int
    ) -> tuple[int, np.ndarray]:
        """Decode messages of one length; return the remaining `tries` and messages."""
        length = int(messages.length[index[0]])
        if not HEAD + WORD <= length <= min(len(messages.data), MAX_LENGTH):
            return tries, index
        bytes_at = np.ndarray(
            (len(messages.data) - length + 1,),
            f"V{length}",
            messages.data,
            strides=(1,),
        )
        rows = bytes_at[messages.start[index]]
        for known_layout in tuple(self._known.get(length, ())):
            index, rows = _take(known_layout, index, rows, groups)
        failed = []
        while len(index) and tries > 0:
            tries -= 1 + length // TRY_BYTES
            layout = layout_of(self._fields, rows[0].tobytes())
            if layout is None or (
                self._tail is not None and layout.length - layout.end > self._tail
            ):
                failed.append(index[0])
                index, rows = index[1:], rows[1:]
                continue
            self._remember(layout)
            index, rows = _take(layout, index, rows, groups)
        return tries, np.concatenate([np.array(failed, dtype=np.int64), index])

    def _remember(self, layout: Layout) -> None:
        layouts = [*self._known.pop(layout.length, []), layout]
        self._known[layout.length] = layouts[-MAX_KNOWN:]
        while (
            len(self._known) > MAX_LENGTHS
            or sum(length * len(of_length) for length, of_length in self._known.items())
            > MAX_KNOWN_BYTES
        ):
            self._known.pop(next(iter(self._known)))


def _by_length(length: np.ndarray) -> list[np.ndarray]:
    """Return the indices of the messages of each length."""
    if not len(length):
        return []
    if (length == length[0]).all():
        return [np.arange(len(length))]
    order = np.argsort(length, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(length[order])) + 1)


def _take(
    layout: Layout, index: np.ndarray, rows: np.ndarray, groups: list[Columns]
) -> tuple[np.ndarray, np.ndarray]:
    """Add the messages of a layout to `groups` and return the others."""
    table = rows.view(layout.dtype)
    good = layout.matches(table)
    if len(index) and good.all():  # without a copy
        groups.append(Columns(index, layout, table))
    elif good.any():
        groups.append(Columns(index[good], layout, table[good]))
    return index[~good], rows[~good]
