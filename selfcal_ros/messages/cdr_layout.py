# SPDX-License-Identifier: Apache-2.0
"""Where the fields of a CDR message lie: one message is walked, all of its form are views.

In CDR the place of a field depends on the lengths of the texts and sequences before it. Messages
that agree in these have one layout, which is then a numpy structure over their bytes.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

HEAD = 4
"""Bytes of the encapsulation in front of a message; alignment counts from behind it."""
LITTLE, BIG = b"\0\1", b"\0\0"
SEQUENCE = -1
"""Count of a field whose number of elements stands in the message."""
TEXT = "text"
WORD = 8
EVERY_BIT = (1 << 8 * WORD) - 1


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
    """Where the fields of all messages lie that agree with one of them in form.

    Attributes
    ----------
    length : int
        Bytes of such a message.
    end : int
        Bytes that its fields take; what stands behind is not looked at.
    values : dict
        Name -> (numpy code, offset, None or number of elements); fields of inner messages as
        ``header.stamp.sec``, those within sequences of messages left out.
    texts : dict
        Name -> the texts, which are the same in all these messages.
    fixed : bytes
        Mask of the bytes that decide the layout: 255 where all messages must agree.
    example : bytes
        The message that was walked.
    """

    length: int
    end: int
    values: dict[str, tuple[str, int, int | None]]
    texts: dict[str, tuple[str, ...]]
    fixed: bytes
    example: bytes

    @cached_property
    def _words(self) -> list[tuple[str, int, np.uint64, np.uint64]]:
        """Return name, offset, mask and value of each word that decides the layout."""
        words = []
        for at in range(0, self.length, WORD):
            place = min(at, self.length - WORD)
            mask = int.from_bytes(self.fixed[place:place + WORD], "little")
            value = int.from_bytes(self.example[place:place + WORD], "little") & mask
            if mask:
                words.append((f"word {place}", place, np.uint64(mask), np.uint64(value)))
        return words

    @cached_property
    def dtype(self) -> np.dtype:
        """The messages as a numpy structure: the values, and the words that decide."""
        fields = [(name, code if count is None else (code, (count,)), at)
                  for name, (code, at, count) in self.values.items()]
        fields += [(name, "<u8", at) for name, at, _, _ in self._words]
        names, formats, offsets = zip(*fields, strict=True)
        return np.dtype({"names": names, "formats": formats, "offsets": offsets,
                         "itemsize": self.length})

    def matches(self, rows: np.ndarray) -> np.ndarray:
        """Return which messages have this layout, bool (n,), from a table of `dtype`."""
        good = np.ones(len(rows), dtype=bool)
        for name, _, mask, value in self._words:
            column = rows[name]
            good &= (column if mask == EVERY_BIT else column & mask) == value
        return good


def layout_of(fields: Sequence[Field], data: bytes) -> Layout | None:
    """Return the layout of one message; None if it is damaged or cannot have one.

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
    return Layout(len(data), walk.at, walk.values, walk.texts, bytes(walk.fixed), data)


class _Walk:
    """Goes through one message field by field; raises ValueError where it is damaged."""

    def __init__(self, data: bytes) -> None:
        self.data, self.order = data, "<" if data[:2] == LITTLE else ">"
        self.at = HEAD
        self.values: dict[str, tuple[str, int, int | None]] = {}
        self.texts: dict[str, tuple[str, ...]] = {}
        self.fixed = bytearray(len(data))
        self._fix(0, 2)

    def fields(self, fields: Sequence[Field], prefix: str | None) -> None:
        """Pass the fields of a message; `prefix` is None within a sequence of messages."""
        for field in fields:
            name = None if prefix is None else prefix + field.name
            count = self._length() if field.count == SEQUENCE else field.count
            if field.kind == TEXT:
                texts = tuple(self._text() for _ in range(1 if count is None else count))
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
        """Go on by `size` bytes and return where they begin."""
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
        return self.data[start:self.at - 1].decode()

    def _numbers(self, name: str | None, code: str, count: int | None) -> None:
        size = int(code[1:])
        if count != 0:
            self._align(size)
        start = self._pass(size if count is None else size * count)
        if name is not None:
            self.values[name] = (self.order + code, start, count)
