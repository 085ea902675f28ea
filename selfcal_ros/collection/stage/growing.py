# SPDX-License-Identifier: Apache-2.0
"""Tables that grow at their end at no cost, and elsewhere at that of a copy."""

from collections.abc import Mapping

import numpy as np


class GrowingTable:
    """Rows of a structured type."""

    def __init__(self, dtype: np.dtype) -> None:
        self._room = np.zeros(64, dtype=dtype)
        self._count = 0  # of the rows in the room
        self._waiting: list[np.ndarray] = []  # for a look at the rows, which makes room for them

    def __len__(self) -> int:
        """Return the number of rows."""
        return self._count + sum(map(len, self._waiting))

    @property
    def rows(self) -> np.ndarray:
        """The rows, as a view that may be written to; valid until rows are added."""
        total = len(self)
        if total > len(self._room):
            room = np.empty(max(total, 2 * len(self._room)), dtype=self._room.dtype)
            room[:self._count] = self._room[:self._count]
            self._room = room
        self._waiting.reverse()
        while self._waiting:
            rows = self._waiting.pop()  # and its memory is free
            self._room[self._count:self._count + len(rows)] = rows
            self._count += len(rows)
        return self._room[:self._count]

    def append(self, rows: np.ndarray) -> None:
        """Add rows at the end; they are the table's from now on, not to be written to."""
        self._waiting.append(rows)

    def insert(self, at: np.ndarray, rows: np.ndarray) -> None:
        """Add rows in front of the rows `at` (rising), as `numpy.insert` does."""
        if not len(rows) or at[0] == len(self):
            self.append(rows)
            return
        self._room = np.insert(self.rows, at, rows)
        self._count = len(self._room)


class GrowingColumns:
    """Columns that grow together, each by itself in memory: to look at one costs no other.

    Parameters
    ----------
    kinds : dict
        Name -> numpy type of a column.
    """

    def __init__(self, kinds: Mapping[str, str]) -> None:
        self._columns = {name: GrowingTable(np.dtype(kind)) for name, kind in kinds.items()}

    def __getitem__(self, name: str) -> np.ndarray:
        """Return a column, as a view that may be written to; valid until rows are added."""
        return self._columns[name].rows

    def insert(self, at: np.ndarray, values: Mapping[str, float]) -> None:
        """Add rows with the same values in front of the rows `at` (rising); unnamed ones are 0."""
        for name, column in self._columns.items():
            column.insert(at, np.full(len(at), values.get(name, 0), dtype=column.rows.dtype))
