# SPDX-License-Identifier: Apache-2.0
"""Many CDR messages of one type at once: bytes in, numpy columns out.

Used for bags and by live nodes alike. Messages are grouped by layout; each group is decoded by
one structured view. What has no layout, or one that few others share, is left to the caller.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from selfcal_ros.messages.cdr_layout import HEAD, WORD, Field, Layout, layout_of

MAX_LENGTH = 1 << 13
"""Bytes of the longest message that is decoded: 140 joints with names of 30 letters, positions,
velocities and efforts."""
MAX_KNOWN = 16
"""Layouts of one length that are kept for the next messages."""
MAX_LENGTHS, MAX_KNOWN_BYTES = 256, 1 << 17
"""Lengths of which layouts are kept, and bytes of all messages that have one."""
FREE_TRIES, WORTH = 16, 32
"""Layouts that may be new in one call, and messages that allow one more."""
TRY_BYTES = 512
"""A layout of more bytes counts as several: it takes 1 ms a kB."""


@dataclass(frozen=True)
class Payloads:
    """Messages of one type within one buffer.

    Attributes
    ----------
    data : bytes
        The buffer.
    start, length : int64 array (n,)
        Where each message lies, encapsulation included.
    """

    data: bytes
    start: np.ndarray
    length: np.ndarray

    @classmethod
    def joined(cls, messages: Sequence[bytes]) -> "Payloads":
        """Return the messages one behind the other."""
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
        for start, length in zip(self.start.tolist(), self.length.tolist(), strict=True):
            yield self.data[start:start + length]


@dataclass(frozen=True)
class Columns:
    """Messages of one layout, decoded.

    Attributes
    ----------
    index : int64 array (n,)
        Which of the messages they are.
    layout : Layout
        Their layout, with the texts that are common to all.
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
    """Decodes messages of one type; it remembers the layouts that it has met.

    Parameters
    ----------
    fields : sequence of Field
        The type.
    tail : int or None
        Bytes that may stand behind the last field; None = any number.
    """

    def __init__(self, fields: Sequence[Field], tail: int | None = None) -> None:
        self._fields, self._tail = tuple(fields), tail
        self._known: dict[int, list[Layout]] = {}

    def decode(self, messages: Payloads) -> tuple[list[Columns], np.ndarray]:
        """Return the messages by layout, and the indices of those that remain, int64 (r,).

        What remains is damaged, or of a layout that is not worth it: it has to be decoded one by
        one.
        """
        groups: list[Columns] = []
        rest: list[np.ndarray] = [np.zeros(0, dtype=np.int64)]
        tries = FREE_TRIES + len(messages) // WORTH
        # the lengths that most messages have come first, so that what is odd costs them nothing
        for index in sorted(_by_length(messages.length), key=len, reverse=True):
            tries, undecoded = self._decode_length(messages, index, groups, tries)
            rest.append(undecoded)
        return groups, np.sort(np.concatenate(rest))

    def _decode_length(self, messages: Payloads, index: np.ndarray, groups: list[Columns],
                       tries: int) -> tuple[int, np.ndarray]:
        """Decode messages of one length; return what is left of `tries`, and what remains."""
        length = int(messages.length[index[0]])
        if not HEAD + WORD <= length <= min(len(messages.data), MAX_LENGTH):
            return tries, index
        bytes_at = np.ndarray((len(messages.data) - length + 1,), f"V{length}", messages.data,
                              strides=(1,))
        rows = bytes_at[messages.start[index]]
        for known in tuple(self._known.get(length, ())):
            index, rows = _take(known, index, rows, groups)
        failed = []
        while len(index) and tries > 0:
            tries -= 1 + length // TRY_BYTES
            layout = layout_of(self._fields, rows[0].tobytes())
            if layout is None or (self._tail is not None
                                  and layout.length - layout.end > self._tail):
                failed.append(index[0])
                index, rows = index[1:], rows[1:]
                continue
            self._remember(layout)
            index, rows = _take(layout, index, rows, groups)
        return tries, np.concatenate([np.array(failed, dtype=np.int64), index])

    def _remember(self, layout: Layout) -> None:
        known = [*self._known.pop(layout.length, []), layout]
        self._known[layout.length] = known[-MAX_KNOWN:]
        while len(self._known) > MAX_LENGTHS or sum(
                length * len(found) for length, found in self._known.items()) > MAX_KNOWN_BYTES:
            self._known.pop(next(iter(self._known)))


def _by_length(length: np.ndarray) -> list[np.ndarray]:
    """Return the indices of the messages of each length."""
    if not len(length):
        return []
    if (length == length[0]).all():
        return [np.arange(len(length))]
    order = np.argsort(length, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(length[order])) + 1)


def _take(layout: Layout, index: np.ndarray, rows: np.ndarray,
          groups: list[Columns]) -> tuple[np.ndarray, np.ndarray]:
    """Add the messages of a layout to `groups` and return the others."""
    table = rows.view(layout.dtype)
    good = layout.matches(table)
    if len(index) and good.all():  # as they are, without a copy
        groups.append(Columns(index, layout, table))
    elif good.any():
        groups.append(Columns(index[good], layout, table[good]))
    return index[~good], rows[~good]
