# SPDX-License-Identifier: Apache-2.0
"""Multifrontal factorisation of the eliminated normal matrix, and its selected inverse.

Each front keeps J = L^-1 and Y = F21 J', where F11 = L L'. A solution then needs matrix products
only, and the diagonal of the inverse follows from the last front down to the first (Takahashi):
with K = J' J and W = J' Y', Z12 = -W Z22, Z11 = K - Z12 W', with Z22 taken from the parent's Z.
All this is real except for the cut, which is solved last; only the real part of its inverse
enters the diagonal.

The elimination order is a nested dissection of the field folded into a quadrant. With G(X) = i^k
h(X), k the quadrant of X, and the like for marks, a reading whose mark and site lie k quarter turns
apart, as the view turns them, joins h and A by the real number 1. Only a shift across an axis
leaves a factor i^g. The few sites that such readings touch are the cut: each gets one real copy for
every g, and copies are joined by i^g h(X) at the very end. All the rest of the elimination is real
(method eq. 8.1).

A mark joins only sites that quarter turns and small shifts carry into each other. Folded into
one eighth of the plane, (max(|i|, |j|), min(|i|, |j|)), such sites are neighbours, so straight
cuts through the folded field separate the matrix.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import combinations, pairwise
from threading import RLock
from typing import Any

import numpy  # noqa: F401  (its library must be loaded before it can be found)
import numpy as np
import scipy.linalg  # noqa: F401  (so must scipy's own)
from scipy.linalg import blas, lapack
from threadpoolctl import ThreadpoolController

from selfcal_ros.estimation.lattice.maps import PHASES, LatticeViews


@dataclass(frozen=True, eq=False)
class RealSymmetricForm:
    """The matrix M = P^H R P over the sites, with R real.

    Attributes
    ----------
    rows, columns : int array (entries,)
        Variables joined by an entry of R: the free sites, then the copies of the cut sites. R is
        symmetric, an entry may be in either triangle; duplicate entries are summed.
    values : float array (entries,)
        The entries.
    size : int
        Number of variables.
    free, cut : int array
        Sites without and with copies.
    copy_of : int array (copies,)
        Index of each copy's site in `cut`.
    copy_phase : complex array (copies,)
        i^g: copy = i^g h.
    phase : complex array (sites,)
        i^k: G = i^k h.
    pins : float array (cut,)
        Values added to the diagonal of the cut sites.
    of_reading : int array (views, marks)
        Variable of each reading.
    shares : float array (views, marks)
        Its share in the mean of its mark.
    """

    rows: np.ndarray
    columns: np.ndarray
    values: np.ndarray
    size: int
    free: np.ndarray
    cut: np.ndarray
    copy_of: np.ndarray
    copy_phase: np.ndarray
    phase: np.ndarray
    pins: np.ndarray
    of_reading: np.ndarray
    shares: np.ndarray


def fold(
    views: LatticeViews,
    weight: np.ndarray,
    relative_weight: np.ndarray,
    pins: np.ndarray,
) -> RealSymmetricForm:
    """Return the folded matrix of weighted readings.

    Parameters
    ----------
    views : LatticeViews
        Maps between sites and marks.
    weight, relative_weight : float array (views, nx, ny)
        Weight of each reading, and its share in the mean of its mark.
    pins : int array
        Sites whose diagonal is raised by the mean weight, because they are otherwise undetermined.
    """
    n_sites = weight[0].size
    read = (weight > 0).reshape(len(weight), -1)
    quadrant = _quadrants(views.shape)
    index = views.site_index.reshape(len(weight), -1)
    turns = np.array([pose.q for pose in views.poses])[:, None]
    gain = (quadrant[index] - quadrant - turns) % 4
    is_cut = np.zeros(n_sites, dtype=bool)
    is_cut[index[read & (gain != 0)]] = True
    free = np.flatnonzero(~is_cut)
    cut = np.flatnonzero(is_cut)
    cut = cut[np.argsort(np.abs(views.z.ravel()[cut]), kind="stable")]
    place = np.empty(n_sites, dtype=np.int64)
    place[free], place[cut] = np.arange(len(free)), np.arange(len(cut))

    on_cut = read & is_cut[index]
    keys, copies = np.unique(
        place[index[on_cut]] * 4 + gain[on_cut], return_inverse=True
    )
    variable = place[index]
    variable[on_cut] = len(free) + copies
    mean = weight.sum() / max(np.count_nonzero(read), 1)
    size = len(free) + len(keys)
    diagonal = np.bincount(
        variable.ravel(), (weight * (1 - relative_weight)).ravel(), minlength=size
    )
    pinned = place[pins[~is_cut[pins]]]
    diagonal[pinned] += mean
    entries = _entries(
        variable,
        diagonal,
        weight.reshape(read.shape),
        relative_weight.reshape(read.shape),
    )
    cut_pins = np.zeros(len(cut))
    cut_pins[place[pins[is_cut[pins]]]] = mean
    return RealSymmetricForm(
        *entries,
        size=size,
        free=free,
        cut=cut,
        copy_of=keys // 4,
        copy_phase=PHASES[keys % 4],
        phase=PHASES[quadrant],
        pins=cut_pins,
        of_reading=variable,
        shares=relative_weight.reshape(read.shape),
    )


def _quadrants(shape: tuple[int, int]) -> np.ndarray:
    """Return k of every site, X = R^k o with o in the quadrant x > 0, y >= 0; the centre has 0."""
    x, y = (np.arange(size) - (size - 1) / 2 for size in shape)
    x, y = np.repeat(x, shape[1]), np.tile(y, shape[0])
    out = np.where((x <= 0) & (y > 0), 1, 0)
    out[(x < 0) & (y <= 0)] = 2
    out[(x >= 0) & (y < 0)] = 3
    return out


def _entries(
    variable: np.ndarray,
    diagonal: np.ndarray,
    weight: np.ndarray,
    relative_weight: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return rows, columns and values of one triangle of R."""
    rows = [np.arange(len(diagonal))]
    values = [diagonal]
    columns = rows.copy()
    for i, j in combinations(range(len(weight)), 2):
        in_both = np.flatnonzero((weight[i] > 0) & (weight[j] > 0))
        a, b = variable[i][in_both], variable[j][in_both]
        value = -weight[i][in_both] * relative_weight[j][in_both]
        rows.append(a)
        columns.append(b)
        # an entry and its mirror image may coincide on the diagonal
        values.append(np.where(a == b, 2 * value, value))
    return np.concatenate(rows), np.concatenate(columns), np.concatenate(values)


LEAF = 192
"""Number of sites below which a part of the field is not cut further."""


@dataclass(frozen=True, eq=False)
class Front:
    """One dense block of the elimination.

    Attributes
    ----------
    start, stop : int
        Range of the variables eliminated here, in the order of elimination.
    boundary : int array (b,)
        Later variables joined to these, sorted.
    children : tuple of int
        Fronts eliminated into this one.
    offset : int
        Start of the front's values in the common storage: the block of its own variables,
        then the block of its boundary against them, both by columns.
    """

    start: int
    stop: int
    boundary: np.ndarray
    children: tuple[int, ...]
    offset: int

    @property
    def size(self) -> int:
        """Number of values stored by the front."""
        n_own = self.stop - self.start
        return n_own * (n_own + len(self.boundary))

    def blocks(self, storage: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return views of the blocks (own, own) and (b, own), by columns."""
        n_own = self.stop - self.start
        middle = self.offset + (self.stop - self.start) ** 2
        return (
            storage[self.offset : middle].reshape(n_own, n_own).T,
            storage[middle : self.offset + self.size].reshape(n_own, -1).T,
        )

    def places(self, variables: np.ndarray) -> np.ndarray:
        """Return the positions of variables in this front: its own first, then its boundary."""
        n_own = self.stop - self.start
        return np.where(
            variables < self.stop,
            variables - self.start,
            n_own + np.searchsorted(self.boundary, variables),
        )


@dataclass(frozen=True, eq=False)
class Dissection:
    """Elimination order and fronts, children before parents.

    Attributes
    ----------
    order : int array (free,)
        Variable eliminated at each position; the copies of the cut follow in their order.
    fronts : tuple of Front
        In elimination order.
    top : tuple of int
        Fronts without a parent: only copies are left on their boundaries.
    storage : float array
        The lower triangle of the matrix, laid out for the fronts.
    rest : float array (copies, copies)
        The lower triangle over the copies, by columns.
    """

    order: np.ndarray
    fronts: tuple[Front, ...]
    top: tuple[int, ...]
    storage: np.ndarray
    rest: np.ndarray


def dissect(
    folded: RealSymmetricForm, shape: tuple[int, int], reach: int
) -> Dissection:
    """Return the nested dissection of a matrix over sites of a field.

    Parameters
    ----------
    folded : RealSymmetricForm
        The matrix; copies are not eliminated here.
    shape : tuple of int
        Sites along x and y.
    reach : int
        Largest folded distance of two sites joined by the matrix.
    """
    # |x| and |y|, rounded down to whole pitches
    i, j = (
        abs(2 * at - size + 1) // 2
        for at, size in zip(np.divmod(folded.free, shape[1]), shape, strict=True)
    )
    far, near = np.maximum(i, j), np.minimum(i, j)
    pieces: list[tuple[np.ndarray, tuple[int, ...]]] = []
    # consecutive: the variables of a front are contiguous in memory
    rows = np.argsort(far * (max(shape) + 1) + near, kind="stable")
    top = _cut(rows, np.stack([far, near]), max(reach, 1), pieces)
    order = np.concatenate([np.zeros(0, dtype=int), *(piece for piece, _ in pieces)])

    n = len(order)
    size = folded.size
    position = np.arange(size)
    position[order] = np.arange(n)
    a, b = position[folded.rows], position[folded.columns]
    row, column = np.maximum(a, b), np.minimum(a, b)
    inner = column < n
    lengths = [len(piece) for piece, _ in pieces]
    front = np.repeat(np.arange(len(pieces)), lengths)[column[inner]]
    fronts = _fronts(pieces, row[inner], front, size=size)
    total = sum(piece_front.size for piece_front in fronts)
    at = total + (column - n) * (size - n) + row - n
    at[inner] = _addresses(fronts, row[inner], column[inner], front=front, size=size)
    values = np.bincount(at, folded.values, minlength=total + (size - n) ** 2)
    return Dissection(
        order, fronts, top, values[:total], values[total:].reshape(size - n, size - n).T
    )


def _fronts(
    pieces: list, row: np.ndarray, front: np.ndarray, *, size: int
) -> tuple[Front, ...]:
    """Return the fronts of the pieces, given the matrix rows in each front's columns."""
    stops = np.cumsum([len(piece) for piece, _ in pieces], dtype=int)
    later = row >= stops[front]
    keys = np.unique(front[later] * size + row[later])
    cuts = np.searchsorted(keys, np.arange(len(pieces) + 1) * size).tolist()
    keys %= size
    fronts: list[Front] = []
    start = offset = 0
    for (_, children), (a, b), stop in zip(
        pieces, pairwise(cuts), stops.tolist(), strict=True
    ):
        boundary = keys[a:b]
        if children:
            later = np.concatenate([boundary, *(fronts[c].boundary for c in children)])
            boundary = np.unique(later[later >= stop])
        fronts.append(Front(start, stop, boundary, children, offset))
        start = stop
        offset = offset + fronts[-1].size
    return tuple(fronts)


def _addresses(
    fronts: tuple[Front, ...],
    row: np.ndarray,
    column: np.ndarray,
    *,
    front: np.ndarray,
    size: int,
) -> np.ndarray:
    """Return the storage positions of entries (row, column) of the lower triangle."""
    start = np.array([item.start for item in fronts])[front]
    n_own = np.array([item.stop for item in fronts])[front] - start
    widths = np.array([len(item.boundary) for item in fronts])
    keys = np.concatenate(
        [
            np.zeros(0, dtype=int),
            *(number * size + item.boundary for number, item in enumerate(fronts)),
        ]
    )
    before = np.cumsum(widths) - widths
    place = np.searchsorted(keys, front * size + row) - before[front]
    offset = np.array([item.offset for item in fronts])[front]
    column = column - start
    return offset + np.where(
        row < start + n_own,
        column * n_own + row - start,
        n_own * n_own + column * widths[front] + place,
    )


def _cut(
    sites: np.ndarray, folded: np.ndarray, reach: int, pieces: list
) -> tuple[int, ...]:
    """Append the pieces of `sites`, separators last; return the indices of the topmost ones."""
    if not len(sites):
        return ()
    if len(sites) > LEAF:
        at = folded[:, sites]
        spans = at.max(axis=1) - at.min(axis=1)
        axis = int(np.argmax(spans))
        if spans[axis] > 2 * reach:
            low = _best_cut(at[axis], reach)
            left = at[axis] < low
            right = at[axis] >= low + reach
            below = (
                *_cut(sites[left], folded, reach, pieces),
                *_cut(sites[right], folded, reach, pieces),
            )
            between = sites[~left & ~right]
            if not len(between):
                return below
            pieces.append((between, below))
            return (len(pieces) - 1,)
    pieces.append((sites, ()))
    return (len(pieces) - 1,)


def _best_cut(at: np.ndarray, reach: int) -> int:
    """Return where to cut into two non-empty halves, as equal as possible."""
    counts = np.bincount(at - at.min())
    before = np.concatenate([[0], np.cumsum(counts)])
    starts = np.arange(1, len(counts) - reach)
    left = before[starts]
    right = before[-1] - before[starts + reach]
    return int(starts[np.argmin(np.maximum(left, right))] + at.min())


class Factor:
    """Factorised Hermitian positive definite matrix over the sites of a field.

    Parameters
    ----------
    folded : RealSymmetricForm
        The matrix.
    shape : tuple of int
        Sites along x and y.
    reach : int
        Largest folded distance of two sites joined by the matrix.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the matrix is not positive definite.
    """

    def __init__(
        self, folded: RealSymmetricForm, shape: tuple[int, int], reach: int
    ) -> None:
        self.folded = folded
        self.dissection = dissect(folded, shape, reach)
        self._blocks: list[tuple[np.ndarray, np.ndarray]] = []
        updates: dict[int, np.ndarray] = {}
        for number, front in enumerate(self.dissection.fronts):
            f11, f21 = front.blocks(self.dissection.storage)
            f22 = np.zeros((len(f21), len(f21)), order="F")
            for child in front.children:
                boundary = self.dissection.fronts[child].boundary
                _extend((f11, f21, f22), front.places(boundary), updates.pop(child))
            inverse, below, updates[number] = _eliminate(f11, f21, f22)
            self._blocks.append((inverse, below))
        self._cut_inverse = self._close(updates)

    @property
    def _n_free(self) -> int:
        return len(self.folded.free)

    def _close(self, updates: dict[int, np.ndarray]) -> np.ndarray:
        """Join the copies of the cut sites and invert the remainder, complex (cut, cut)."""
        folded = self.folded
        remainder = self.dissection.rest
        for number in self.dissection.top:
            places = self.dissection.fronts[number].boundary - self._n_free
            _extend((remainder,), places, updates.pop(number))
        remainder = _mirrored(np.tril(remainder))
        size = len(folded.cut)
        joined = np.zeros((len(remainder), size), dtype=complex)
        joined[np.arange(len(remainder)), folded.copy_of] = folded.copy_phase
        closed = joined.conj().T @ (remainder @ joined)
        closed[np.diag_indices(size)] += folded.pins
        if not size:
            return closed
        lower, info = lapack.zpotrf(closed, lower=1)
        if info:
            raise np.linalg.LinAlgError("the normal matrix is not positive definite")
        return _mirrored(lapack.zpotri(lower, lower=1)[0])

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Return the solution for one or more right-hand sides, (sites,) or (sites, k)."""
        folded, n = self.folded, self._n_free
        work, closed = self._eliminated(right.reshape(len(right), -1))
        closed = self._cut_inverse @ closed
        work[n:] = folded.copy_phase[:, None] * closed[folded.copy_of]
        self._backward(work)
        out = np.empty((len(right), work.shape[1]), dtype=complex)
        out[folded.free[self.dissection.order]] = work[:n]
        out[folded.cut] = closed
        out *= folded.phase[:, None]
        return out.reshape(right.shape)

    def products(self, right: np.ndarray) -> np.ndarray:
        """Return the inner products of right-hand sides (sites, k) with their solutions, (k, k).

        With M = P^H L L^H P these are the products of L^-1 P: no back substitution.
        """
        work, closed = self._eliminated(right)
        free = work[: self._n_free]
        return free.conj().T @ free + closed.conj().T @ (self._cut_inverse @ closed)

    def _eliminated(self, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return columns (sites, k) after elimination: for all variables, and for the cut sites."""
        folded, n = self.folded, self._n_free
        turned = folded.phase.conj()[:, None] * columns
        work = np.zeros((folded.size, turned.shape[1]), dtype=complex)
        work[:n] = turned[folded.free[self.dissection.order]]
        self._forward(work)
        closed = turned[folded.cut]
        np.add.at(closed, folded.copy_of, folded.copy_phase.conj()[:, None] * work[n:])
        return work, closed

    def _forward(self, work: np.ndarray) -> None:
        real = work.view(float)
        for front, (inverse, below) in zip(
            self.dissection.fronts, self._blocks, strict=True
        ):
            values = inverse @ real[front.start : front.stop]
            real[front.start : front.stop] = values
            if len(below):
                real[front.boundary] -= below @ values

    def _backward(self, work: np.ndarray) -> None:
        real = work.view(float)
        for front, (inverse, below) in zip(
            reversed(self.dissection.fronts), reversed(self._blocks), strict=True
        ):
            values = real[front.start : front.stop]
            if len(below):
                values = values - below.T @ real[front.boundary]
            real[front.start : front.stop] = inverse.T @ values

    @cached_property
    def variances(self) -> tuple[np.ndarray, np.ndarray]:
        """Variances of the sites, (sites,), and of the mean of each mark's sites, (marks,).

        The sites of a mark are joined: all of them are in the front in which the first is
        eliminated.
        """
        folded = self.folded
        fronts = self.dissection.fronts
        n = self._n_free
        sites = folded.free[self.dissection.order]
        place = np.arange(folded.size)
        place[self.dissection.order] = np.arange(n)
        place = place[folded.of_reading]
        shares = folded.shares
        first = np.where(shares > 0, place, folded.size).min(axis=0)
        place = np.where(shares > 0, place, first)
        marks = np.argsort(first, kind="stable")
        after = first[marks]

        def of_means(z: np.ndarray, mine: np.ndarray, at: np.ndarray) -> np.ndarray:
            return np.einsum(
                "vk,wk,vwk->k", shares[:, mine], shares[:, mine], z[at[:, None], at]
            )

        of_sites = np.empty(len(folded.phase))
        means = np.zeros(len(marks))
        of_sites[folded.cut] = self._cut_inverse.diagonal().real
        copies = self._cut_inverse[folded.copy_of[:, None], folded.copy_of]
        copies = (folded.copy_phase[:, None] * copies * folded.copy_phase.conj()).real
        mine = marks[(after >= n) & (after < folded.size)]
        means[mine] = of_means(copies, mine, place[:, mine] - n)
        needed = {}
        for number in self.dissection.top:
            places = fronts[number].boundary - n
            needed[number] = copies[places[:, None], places]
        for number in range(len(fronts) - 1, -1, -1):
            front = fronts[number]
            z = self._selected(number, needed.pop(number))
            of_sites[sites[front.start : front.stop]] = z.diagonal()[
                : front.stop - front.start
            ]
            mine = marks[slice(*np.searchsorted(after, (front.start, front.stop)))]
            means[mine] = of_means(z, mine, front.places(place[:, mine]))
            for child in front.children:
                places = front.places(fronts[child].boundary)
                needed[child] = z[places[:, None], places]
        return of_sites, means

    def _selected(self, number: int, z22: np.ndarray) -> np.ndarray:
        """Return the inverse over one front, given the inverse over its boundary."""
        lower, below = self._blocks[number]
        inverse = lower.T @ lower
        weight = lower.T @ below.T
        n_own = len(inverse)
        z = np.empty((n_own + len(z22),) * 2, order="F")
        z12 = weight @ z22
        z[n_own:, n_own:], z[:n_own, n_own:], z[n_own:, :n_own] = z22, -z12, -z12.T
        z[:n_own, :n_own] = inverse + z12 @ weight.T
        return z


def _mirrored(lower: np.ndarray) -> np.ndarray:
    """Return the Hermitian matrix with this lower triangle; the upper one is zero."""
    out = lower + lower.conj().T
    out[np.diag_indices(len(out))] /= 2
    return out


def _extend(
    blocks: tuple[np.ndarray, ...], places: np.ndarray, update: np.ndarray
) -> None:
    """Add the lower triangle of `update` to a symmetric matrix given by its lower blocks.

    Parameters
    ----------
    blocks : tuple of float arrays
        (F11, F21, F22) of a front; or the whole matrix.
    places : int array (b,)
        Rows and columns of the update, ascending.
    update : float array (b, b)
        Its upper triangle is not used.
    """
    n_own = len(blocks[0])
    inner = int(np.searchsorted(places, n_own))
    first = slice(inner)
    last = slice(inner, len(places))
    to = {first: places[first], last: places[last] - n_own}
    for block, (rows, columns) in zip(
        blocks, ((first, first), (last, first), (last, last)), strict=False
    ):
        at = to[columns][:, None] * len(block) + to[rows]
        np.add.at(block.T.reshape(-1), at.ravel(), update[rows, columns].T.ravel())


def _eliminate(
    f11: np.ndarray, f21: np.ndarray, f22: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return L^-1, F21 L^-T and the Schur complement of the boundary; inputs are overwritten.

    Only the lower triangles of symmetric blocks are read and written.
    """
    lower, info = lapack.dpotrf(f11, lower=1, overwrite_a=1)
    if info:
        raise np.linalg.LinAlgError("the normal matrix is not positive definite")
    inverse = lapack.dtrtri(lower, lower=1, overwrite_c=1)[0]
    if not len(f21):
        return inverse, f21, f22
    below = blas.dtrmm(1.0, inverse, f21, side=1, lower=1, trans_a=1, overwrite_b=1)
    schur = blas.dsyrk(-1.0, below, beta=1.0, c=f22, lower=1, overwrite_c=1)
    return inverse, below, schur


_lock = RLock()
_limits: list[Any] = []


_controller = cache(ThreadpoolController)


@contextmanager
def one_thread() -> Iterator[None]:
    """Run the block with one BLAS thread.

    The number is restored when the outermost block of any thread of this process has ended.
    """
    with _lock:
        _limits.append(
            _limits[0] if _limits else _controller().limit(limits=1, user_api="blas")
        )
    try:
        yield
    finally:
        with _lock:
            last = _limits.pop()
            if not _limits:
                last.restore_original_limits()
