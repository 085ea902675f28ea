# SPDX-License-Identifier: Apache-2.0
"""All encoder samples of one joint for a whole shift, in any order, in bounded memory.

Samples are stored in blocks of rising stamps. The newest blocks are in memory; older ones go to an
unnamed temporary file, from which a very late message can still get its
neighbours. The result is always that of the whole set, in any order of arrival.
"""

import io
import tempfile
import weakref
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

NO_STAMPS = np.zeros(0, dtype=np.int64)
LARGE_TEMPORARY = Path("/var/tmp")
"""Folder for large temporary files: /tmp may be in memory."""
Samples = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Stamps (int64, ns), positions and speeds (float; NaN = unknown)."""


class GrowingTable:
    """Growing rows of a structured type."""

    def __init__(self, dtype: np.dtype) -> None:
        self._room = np.zeros(64, dtype=dtype)
        self._count = 0  # of the rows in the buffer
        self._waiting: list[np.ndarray] = []  # pending until rows are accessed

    def __len__(self) -> int:
        """Return the number of rows."""
        return self._count + sum(map(len, self._waiting))

    @property
    def rows(self) -> np.ndarray:
        """The rows, as a writable view; valid until rows are added."""
        total = len(self)
        if total > len(self._room):
            room = np.empty(max(total, 2 * len(self._room)), dtype=self._room.dtype)
            room[: self._count] = self._room[: self._count]
            self._room = room
        self._waiting.reverse()
        while self._waiting:
            rows = self._waiting.pop()  # and its memory is freed
            self._room[self._count : self._count + len(rows)] = rows
            self._count += len(rows)
        return self._room[: self._count]

    def append(self, rows: np.ndarray) -> None:
        """Append rows; they are owned by the table afterwards and must not be written to."""
        self._waiting.append(rows)

    def insert(self, at: np.ndarray, rows: np.ndarray) -> None:
        """Insert rows before the rows `at` (rising), like `numpy.insert`."""
        if not len(rows) or at[0] == len(self):
            self.append(rows)
            return
        self._room = np.insert(self.rows, at, rows)
        self._count = len(self._room)


class GrowingColumns:
    """Columns that grow together, each separate in memory.

    Parameters
    ----------
    kinds : dict
        Name -> numpy type of a column.
    """

    def __init__(self, kinds: Mapping[str, str]) -> None:
        self._columns = {
            name: GrowingTable(np.dtype(kind)) for name, kind in kinds.items()
        }

    def __getitem__(self, name: str) -> np.ndarray:
        """Return a column, as a writable view; valid until rows are added."""
        return self._columns[name].rows

    def insert(self, at: np.ndarray, values: Mapping[str, float]) -> None:
        """Insert rows with the same values before the rows `at` (rising); unnamed columns are 0."""
        for name, column in self._columns.items():
            column.insert(
                at, np.full(len(at), values.get(name, 0), dtype=column.rows.dtype)
            )


@dataclass(frozen=True)
class Limits:
    """Samples per block, and blocks kept in memory."""

    block: int = 65_536
    in_memory: int = 6


@dataclass(frozen=True)
class _Block:
    """Samples with rising stamps, in memory or in the file; `speeds` may be None."""

    first_ns: int
    last_ns: int
    count: int
    has_speeds: bool
    columns: tuple[np.ndarray, ...] = ()
    place: int = 0


class SampleStore:
    """All samples of one joint.

    Attributes
    ----------
    newest_ns : int
        Largest stamp of the samples.
    problem : str
        Why blocks stay in memory beyond the limit; empty while the file can be written.
    """

    def __init__(self, limits: Limits | None = None) -> None:
        self._limits = limits or Limits()
        self._filling = self._empty()  # the block that is being filled
        self._filled, self._rising, self._last_ns = 0, True, np.iinfo(np.int64).min
        self._blocks: list[_Block] = []
        self._firsts = self._lasts = self._counts = NO_STAMPS  # of the blocks
        self._unseen: list[np.ndarray] = []
        self._count, self._end = 0, 0
        self._file: io.FileIO | None = None
        # the last block read
        self._read: tuple[_Block, tuple[np.ndarray, ...]] | None = None
        self.newest_ns, self.problem = int(np.iinfo(np.int64).min), ""

    def __len__(self) -> int:
        """Return the number of samples."""
        return self._count

    def _empty(self) -> Samples:
        """Return the columns of an empty block, without memory pages until it is filled."""
        size = self._limits.block
        return np.empty(size, dtype=np.int64), np.empty(size), np.empty(size)

    def add_block(
        self,
        stamps: np.ndarray,
        positions: np.ndarray,
        speeds: np.ndarray | None = None,
    ) -> None:
        """Add samples in any order; `speeds` None or NaN if unknown."""
        start = 0
        while start < len(stamps):
            count = min(self._limits.block - self._filled, len(stamps) - start)
            target, source = (slice(at, at + count) for at in (self._filled, start))
            t = self._filling[0][target]
            t[:] = stamps[source]
            # -0.0 and 0.0 sort as equal
            np.add(positions[source], 0.0, out=self._filling[1][target])
            self._filling[2][target] = np.nan if speeds is None else speeds[source]
            self._rising &= bool(t[0] >= self._last_ns and (t[1:] >= t[:-1]).all())
            self._last_ns = max(self._last_ns, int(t[-1]))
            self.newest_ns = max(self.newest_ns, int(t.max()))
            self._unseen.append(t)
            self._filled += count
            self._count += count
            start += count
            if self._filled == self._limits.block:
                self._close()

    def _open(self) -> Samples:
        """Return the samples of the block that is being filled, in the order of their stamps."""
        filled = tuple(column[: self._filled] for column in self._filling)
        if not self._rising:
            order = np.argsort(filled[0], kind="stable")
            self._filling = self._empty()  # arrays returned before are unchanged
            for column, old in zip(self._filling, filled, strict=True):
                column[: self._filled] = old[order]
            self._rising, self._last_ns = True, int(self._filling[0][self._filled - 1])
            filled = tuple(column[: self._filled] for column in self._filling)
        stamps, positions, speeds = filled
        return stamps, positions, speeds

    def _close(self) -> None:
        stamps, positions, speeds = self._open()
        has_speeds = not np.isnan(speeds).all()
        columns = (stamps, positions, speeds) if has_speeds else (stamps, positions)
        self._blocks.append(
            _Block(int(stamps[0]), int(stamps[-1]), len(stamps), has_speeds, columns)
        )
        self._firsts, self._lasts, self._counts = (
            np.append(values, new)
            for values, new in (
                (self._firsts, stamps[0]),
                (self._lasts, stamps[-1]),
                (self._counts, len(stamps)),
            )
        )
        self._filling, self._filled, self._rising = self._empty(), 0, True
        self._last_ns = np.iinfo(np.int64).min
        loaded = [number for number, block in enumerate(self._blocks) if block.columns]
        if len(loaded) > self._limits.in_memory and not self.problem:
            self._store(min(loaded, key=lambda number: self._blocks[number].last_ns))

    def _store(self, number: int) -> None:
        """Move a block to the file."""
        block = self._blocks[number]
        try:
            if self._file is None:
                folder = LARGE_TEMPORARY if LARGE_TEMPORARY.is_dir() else None
                self._file = tempfile.TemporaryFile(dir=folder, buffering=0)  # noqa: SIM115
                weakref.finalize(self, self._file.close)
            self._file.seek(self._end)
            for column in block.columns:
                data = memoryview(column).cast("B")
                while len(data):
                    data = data[self._file.write(data) :]
        except OSError as error:
            self.problem = (
                f"encoder samples stay in memory: no temporary file can be written "
                f"({error.strerror})"
            )
            return
        self._blocks[number] = replace(block, columns=(), place=self._end)
        self._end += sum(column.nbytes for column in block.columns)

    def _columns(self, block: _Block) -> tuple[np.ndarray, ...]:
        """Return the columns of a block, read back if not in memory."""
        if block.columns:
            return block.columns
        if self._read is None or self._read[0] is not block:
            self._read = block, self._read_back(block)
        return self._read[1]

    def _read_back(self, block: _Block) -> tuple[np.ndarray, ...]:
        """Return the columns of a block from the file."""
        if self._file is None:
            raise ValueError("a block that is not in memory has been stored")
        kinds = (np.int64, np.float64, np.float64)[: 3 if block.has_speeds else 2]
        data = bytearray(8 * block.count * len(kinds))
        self._file.seek(block.place)
        view = memoryview(data)
        while len(view):
            view = view[self._file.readinto(view) :]
        return tuple(
            np.frombuffer(data, kind, block.count, 8 * block.count * at)
            for at, kind in enumerate(kinds)
        )

    def new_stamps(self) -> np.ndarray:
        """Return the stamps added since the last call, rising."""
        unseen = self._unseen
        self._unseen = []
        stamps = np.concatenate([NO_STAMPS, *unseen])
        return stamps if (stamps[1:] >= stamps[:-1]).all() else np.sort(stamps)

    def span(self) -> tuple[int, int] | None:
        """Return the first and the last stamp, None without samples."""
        stamps = self._open()[0]
        ends = [(b.first_ns, b.last_ns) for b in self._blocks]
        ends += [(int(stamps[0]), int(stamps[-1]))] if len(stamps) else []
        return (min(e[0] for e in ends), max(e[1] for e in ends)) if ends else None

    def count_between(self, start_ns: int, end_ns: int) -> int:
        """Return an upper estimate of the number of samples between two stamps."""
        stamps = self._open()[0]
        inside = int(
            np.searchsorted(stamps, end_ns, "right") - np.searchsorted(stamps, start_ns)
        )
        return inside + int(self._counts[self._touched(start_ns, end_ns)].sum())

    def _touched(self, start_ns: int, end_ns: int) -> np.ndarray:
        """Return which blocks may have samples between two stamps."""
        return (self._lasts >= start_ns) & (self._firsts <= end_ns)

    def near(self, start_ns: int, end_ns: int, neighbours: int) -> Samples:
        """Return the samples from `start_ns` to `end_ns`, and their neighbours, in any order.

        On each side at least the `neighbours` nearest stamps are included with all of their
        samples, or as many as exist. Samples received in the order of their stamps keep it. The
        result may be owned by the store and must not be written to.
        """
        open_samples = self._open()
        pieces = (
            [_samples_between(open_samples, start_ns, end_ns, neighbours)]
            if len(open_samples[0])
            else []
        )
        pieces += [
            _samples_between(
                self._columns(self._blocks[number]), start_ns, end_ns, neighbours
            )
            for number in np.flatnonzero(self._touched(start_ns, end_ns))
        ]
        before = np.flatnonzero(self._lasts < start_ns)
        after = np.flatnonzero(self._firsts > end_ns)
        for side, sign, edge, nearest in (
            (before, -1, start_ns, -self._lasts[before]),
            (after, 1, end_ns, self._firsts[after]),
        ):
            for at in np.argsort(nearest, kind="stable"):
                if nearest[at] > _nth(pieces, edge, sign, neighbours):
                    break
                pieces.append(
                    _samples_between(
                        self._columns(self._blocks[side[at]]),
                        start_ns,
                        end_ns,
                        neighbours,
                    )
                )
        pieces = [piece for piece in pieces if len(piece[0])]
        return _joined(sorted(pieces, key=lambda piece: piece[0][0]))


def _joined(pieces: list[Samples]) -> Samples:
    if len(pieces) < 2:
        return pieces[0] if pieces else (NO_STAMPS, np.zeros(0), np.zeros(0))
    stamps, positions, speeds = (
        np.concatenate(column) for column in zip(*pieces, strict=True)
    )
    return stamps, positions, speeds


def _with_speeds(columns: tuple[np.ndarray, ...]) -> Samples:
    """Return samples from their columns; unknown speeds are NaN."""
    stamps, positions, *speeds = columns
    return stamps, positions, speeds[0] if speeds else np.full(len(stamps), np.nan)


def _nth(pieces: list[Samples], edge: int, sign: int, n: int) -> float:
    """Return sign times the n-th stamp before or after an edge, infinity if there are fewer."""
    beyond = [
        t[: np.searchsorted(t, edge)]
        if sign < 0
        else t[np.searchsorted(t, edge, "right") :]
        for t, _, _ in pieces
    ]
    stamps = np.unique(sign * np.concatenate([NO_STAMPS, *beyond]))
    return float("inf") if len(stamps) < n else int(stamps[n - 1])


def _samples_between(
    columns: tuple[np.ndarray, ...], start_ns: int, end_ns: int, neighbours: int
) -> Samples:
    """Return the samples between two stamps and of at least `neighbours` stamps on either side."""
    t = columns[0]
    low = _reach(t[: np.searchsorted(t, start_ns)][::-1], neighbours)
    high = _reach(t[np.searchsorted(t, end_ns, "right") :], neighbours)
    first = int(np.searchsorted(t, start_ns)) - low
    last = int(np.searchsorted(t, end_ns, "right")) + high
    return _with_speeds(tuple(column[first:last] for column in columns))


def _reach(stamps: np.ndarray, n: int) -> int:
    """Return the number of samples from the front that contain n complete stamps."""
    take = 2 * n
    while take < len(stamps):
        change = np.flatnonzero(stamps[1:take] != stamps[: take - 1])
        if len(change) >= n:
            return int(change[n - 1]) + 1
        take *= 2
    return len(stamps)
