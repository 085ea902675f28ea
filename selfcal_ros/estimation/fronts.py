# SPDX-License-Identifier: Apache-2.0
"""Nested dissection of the field, and the fronts of a multifrontal factorisation.

A mark joins only sites that quarter turns and small shifts carry into each other. Folded into
one eighth of the plane, (max(|i|, |j|), min(|i|, |j|)), such sites are neighbours, so straight
cuts through the folded field separate the matrix.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix

LEAF = 192
"""Sites below which a part of the field is not cut any more."""


@dataclass(frozen=True, eq=False)
class Front:
    """One dense block of the elimination.

    Attributes
    ----------
    start, stop : int
        Range of the variables eliminated here, in the order of elimination.
    boundary : int array (b,)
        Later variables that they are joined to, sorted.
    children : tuple of int
        Fronts that are eliminated into this one.
    """

    start: int
    stop: int
    boundary: np.ndarray
    children: tuple[int, ...]

    def places(self, variables: np.ndarray) -> np.ndarray:
        """Return where variables stand in this front: its own first, then its boundary."""
        own = self.stop - self.start
        return np.where(variables < self.stop, variables - self.start,
                        own + np.searchsorted(self.boundary, variables))


@dataclass(frozen=True, eq=False)
class Dissection:
    """Order of elimination and its fronts, children before parents.

    Attributes
    ----------
    order : int array (free,)
        Variable eliminated at each position; the copies of the cut follow in their order.
    fronts : tuple of Front
        In the order of elimination.
    top : tuple of int
        Fronts without a parent: only copies are left on their boundaries.
    matrix : csr_matrix
        The matrix in that order.
    """

    order: np.ndarray
    fronts: tuple[Front, ...]
    top: tuple[int, ...]
    matrix: csr_matrix


MAX_BLOCKS = 24
"""Blocks of runs up to which matrices are added block by block rather than entry by entry."""

Places = tuple[np.ndarray, list[tuple[slice, slice]]]


def add_to(block: np.ndarray, rows: Places, columns: Places, update: np.ndarray) -> None:
    """Add `update` to the rows and columns of a matrix at places prepared by `runs`."""
    if len(rows[1]) * len(columns[1]) > MAX_BLOCKS:
        block[rows[0][:, None], columns[0]] += update
        return
    for take_rows, to_rows in rows[1]:
        for take_columns, to_columns in columns[1]:
            block[to_rows, to_columns] += update[take_rows, take_columns]


def runs(places: np.ndarray) -> Places:
    """Return places with the (from, to) slices of their runs of consecutive numbers."""
    if not len(places):
        return places, []
    ends = (np.flatnonzero(places[1:] - places[:-1] != 1) + 1).tolist()
    low, high = places[[0, *ends]].tolist(), places[[*(e - 1 for e in ends), -1]].tolist()
    return places, [(slice(a, b), slice(c, d + 1)) for a, b, c, d in
                    zip([0, *ends], [*ends, len(places)], low, high, strict=True)]


def dissect(matrix: csr_matrix, sites: np.ndarray, shape: tuple[int, int],
            reach: int) -> Dissection:
    """Return the nested dissection of a matrix over sites of a field.

    Parameters
    ----------
    matrix : csr_matrix
        Symmetric; the variables after the `sites` are not eliminated here.
    sites : int array (free,)
        Flat index of each variable's site.
    shape : tuple of int
        Sites along x and y.
    reach : int
        Largest folded distance of two sites that the matrix joins.
    """
    hx, hy = (size // 2 for size in shape)
    i, j = abs(sites // shape[1] - hx), abs(sites % shape[1] - hy)
    folded = np.stack([np.maximum(i, j), np.minimum(i, j)])
    pieces: list[tuple[np.ndarray, tuple[int, ...]]] = []
    # neighbours in a row, so that a child's boundary is a few runs of its parent's variables
    top = _cut(np.lexsort((folded[1], folded[0])), folded, max(reach, 1), pieces)
    order = np.concatenate([np.zeros(0, dtype=int), *(piece for piece, _ in pieces)])
    turned = _permuted(matrix, order)
    fronts: list[Front] = []
    position = 0
    for piece, children in pieces:
        stop = position + len(piece)
        near = turned.indices[turned.indptr[position]:turned.indptr[stop]]
        later = np.concatenate([near, *(fronts[c].boundary for c in children)])
        fronts.append(Front(position, stop, np.unique(later[later >= stop]), children))
        position = stop
    return Dissection(order, tuple(fronts), top, turned)


def _cut(sites: np.ndarray, folded: np.ndarray, reach: int, pieces: list) -> tuple[int, ...]:
    """Append the pieces of `sites`, separators last; return the numbers of the topmost ones."""
    if not len(sites):
        return ()
    if len(sites) > LEAF:
        at = folded[:, sites]
        spans = at.max(axis=1) - at.min(axis=1)
        axis = int(np.argmax(spans))
        if spans[axis] > 2 * reach:
            low = _best_cut(at[axis], reach)
            left, right = at[axis] < low, at[axis] >= low + reach
            below = (*_cut(sites[left], folded, reach, pieces),
                     *_cut(sites[right], folded, reach, pieces))
            between = sites[~left & ~right]
            if not len(between):
                return below
            pieces.append((between, below))
            return (len(pieces) - 1,)
    pieces.append((sites, ()))
    return (len(pieces) - 1,)


def _best_cut(at: np.ndarray, reach: int) -> int:
    """Return where to cut: halves as equal as they can be, both of them not empty."""
    counts = np.bincount(at - at.min())
    before = np.concatenate([[0], np.cumsum(counts)])
    starts = np.arange(1, len(counts) - reach)
    left, right = before[starts], before[-1] - before[starts + reach]
    return int(starts[np.argmin(np.maximum(left, right))] + at.min())


def _permuted(matrix: csr_matrix, order: np.ndarray) -> csr_matrix:
    inverse = np.arange(matrix.shape[0])
    inverse[order] = np.arange(len(order))
    rows = matrix[np.concatenate([order, np.arange(len(order), matrix.shape[0])])]
    return csr_matrix((rows.data, inverse[rows.indices], rows.indptr), shape=matrix.shape)
