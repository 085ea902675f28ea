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

A mark joins only sites that quarter turns and small shifts carry into each other. In the quadrant
such sites are neighbours, so straight cuts through it separate the matrix.
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
from scipy.sparse import coo_matrix
from threadpoolctl import ThreadpoolController

from selfcal_ros.estimation.lattice.maps import PHASES, LatticeViews


@dataclass(frozen=True, eq=False)
class RealSymmetricForm:
    """What makes the matrix M = P^H R P over the sites of R, which is real.

    R is over the free sites and the copies of the cut sites.

    Attributes
    ----------
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
) -> tuple[coo_matrix, RealSymmetricForm]:
    """Return the folded matrix of weighted readings: R, and what makes M of it.

    R is symmetric: an entry may be in either triangle, those of one place are summed.

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
    diagonal = np.bincount(
        variable.ravel(),
        (weight * (1 - relative_weight)).ravel(),
        minlength=len(free) + len(keys),
    )
    pinned = place[pins[~is_cut[pins]]]
    diagonal[pinned] += mean
    matrix = _real_matrix(
        variable,
        diagonal,
        weight.reshape(read.shape),
        relative_weight.reshape(read.shape),
    )
    cut_pins = np.zeros(len(cut))
    cut_pins[place[pins[is_cut[pins]]]] = mean
    return matrix, RealSymmetricForm(
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


def _real_matrix(
    variable: np.ndarray,
    diagonal: np.ndarray,
    weight: np.ndarray,
    relative_weight: np.ndarray,
) -> coo_matrix:
    """Return R, one triangle of it."""
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
    at = np.concatenate(rows), np.concatenate(columns)
    return coo_matrix((np.concatenate(values), at), shape=(len(diagonal),) * 2)


LEAF = 96
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
    def n_own(self) -> int:
        """Number of variables eliminated here."""
        return self.stop - self.start

    @property
    def size(self) -> int:
        """Number of values stored by the front."""
        return self.n_own * (self.n_own + len(self.boundary))

    def blocks(self, storage: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return views of the blocks (own, own) and (b, own), by columns."""
        n_own, middle = self.n_own, self.offset + self.n_own**2
        below = storage[middle : self.offset + self.size]
        return (
            storage[self.offset : middle].reshape(n_own, n_own).T,
            below.reshape(n_own, len(self.boundary)).T,
        )

    def places(self, variables: np.ndarray) -> np.ndarray:
        """Return the positions of variables in this front: its own first, then its boundary."""
        return np.where(
            variables < self.stop,
            variables - self.start,
            self.n_own + np.searchsorted(self.boundary, variables),
        )


@dataclass(frozen=True, eq=False)
class Dissection:
    """Elimination order and fronts, children before parents.

    Attributes
    ----------
    order : int array (variables,)
        Variable eliminated at each position; the copies of the cut come last, in their order.
    fronts : tuple of Front
        In elimination order; the last has the copies.
    storage : float array
        The lower triangle of the matrix, laid out for the fronts.
    """

    order: np.ndarray
    fronts: tuple[Front, ...]
    storage: np.ndarray


def dissect(
    matrix: coo_matrix, folded: RealSymmetricForm, shape: tuple[int, int], reach: int
) -> Dissection:
    """Return the nested dissection of a matrix over sites of a field.

    Parameters
    ----------
    matrix, folded
        What `fold` returns.
    shape : tuple of int
        Sites along x and y.
    reach : int
        Largest distance in the quadrant of two sites joined by the matrix.
    """
    x, y = np.divmod(folded.free, shape[1])
    twice = (2 * x - shape[0] + 1) + 1j * (2 * y - shape[1] + 1)
    twice *= folded.phase[folded.free].conj()
    # places in the quadrant, rounded down to whole pitches
    at = np.stack([twice.real, twice.imag]).astype(int) // 2
    pieces: list[tuple[np.ndarray, tuple[int, ...]]] = []
    # consecutive: the variables of a front are contiguous in memory
    rows = np.argsort(at[0] * max(shape) + at[1], kind="stable")
    top = _cut(rows, at, max(reach, 1), pieces)
    size = matrix.shape[0]
    pieces.append((np.arange(len(folded.free), size), top))
    order = np.concatenate([piece for piece, _ in pieces])

    position = np.empty(size, dtype=int)
    position[order] = np.arange(size)
    a, b = position[matrix.row], position[matrix.col]
    row, column = np.maximum(a, b), np.minimum(a, b)
    front = np.repeat(np.arange(len(pieces)), [len(piece) for piece, _ in pieces])
    front = front[column]
    fronts = _fronts(pieces, row, front, size=size)
    at = _addresses(fronts, row, column, front=front, size=size)
    total = sum(piece_front.size for piece_front in fronts)
    return Dissection(order, fronts, np.bincount(at, matrix.data, minlength=total))


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
    widths = np.array([len(item.boundary) for item in fronts])
    keys = np.concatenate(
        [number * size + item.boundary for number, item in enumerate(fronts)]
    )
    before = np.cumsum(widths) - widths
    place = np.searchsorted(keys, front * size + row) - before[front]
    start, n_own, offset = np.array(
        [(item.start, item.n_own, item.offset) for item in fronts]
    ).T[:, front]
    row, column = row - start, column - start
    return offset + np.where(
        row < n_own,
        column * n_own + row,
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
    matrix, folded
        What `fold` returns.
    shape : tuple of int
        Sites along x and y.
    reach : int
        Largest distance in the quadrant of two sites joined by the matrix.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the matrix is not positive definite.
    """

    def __init__(
        self,
        matrix: coo_matrix,
        folded: RealSymmetricForm,
        shape: tuple[int, int],
        reach: int,
    ) -> None:
        self.folded = folded
        self.dissection = dissect(matrix, folded, shape, reach)
        *fronts, copies = self.dissection.fronts
        self._sites = folded.free[self.dissection.order[: copies.start]]
        """Site eliminated at each position, but for the copies."""
        self._factored: list[tuple[Front, np.ndarray, np.ndarray]] = []
        updates: dict[int, np.ndarray] = {}
        for number, front in enumerate(fronts):
            blocks = self._assembled(front, updates)
            inverse, below, updates[number] = _eliminate(*blocks)
            self._factored.append((front, inverse, below))
        self._cut_inverse = self._close(self._assembled(copies, updates)[0])

    def _assembled(
        self, front: Front, updates: dict[int, np.ndarray]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return F11, F21 and F22 of a front; the updates of its children are taken out."""
        f11, f21 = front.blocks(self.dissection.storage)
        f22 = np.zeros((len(f21), len(f21)), order="F")
        for child in front.children:
            places = front.places(self.dissection.fronts[child].boundary)
            _extend((f11, f21, f22), places, updates.pop(child))
        return f11, f21, f22

    def _close(self, lower: np.ndarray) -> np.ndarray:
        """Join the copies of the cut sites and invert what is left, complex (cut, cut)."""
        folded = self.folded
        if not len(folded.cut):
            return np.zeros((0, 0), dtype=complex)
        remainder = _mirrored(np.tril(lower))
        joined = np.zeros((len(remainder), len(folded.cut)), dtype=complex)
        joined[np.arange(len(remainder)), folded.copy_of] = folded.copy_phase
        closed = joined.conj().T @ (remainder @ joined)
        closed[np.diag_indices(len(closed))] += folded.pins
        lower, info = lapack.zpotrf(closed, lower=1)
        if info:
            raise np.linalg.LinAlgError("the normal matrix is not positive definite")
        return _mirrored(lapack.zpotri(lower, lower=1)[0])

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Return the solution for one or more right-hand sides, (sites,) or (sites, k)."""
        folded, n = self.folded, len(self._sites)
        work, closed = self._eliminated(right.reshape(len(right), -1))
        closed = self._cut_inverse @ closed
        work[n:] = folded.copy_phase[:, None] * closed[folded.copy_of]
        self._backward(work)
        out = np.empty((len(right), work.shape[1]), dtype=complex)
        out[self._sites] = work[:n]
        out[folded.cut] = closed
        out *= folded.phase[:, None]
        return out.reshape(right.shape)

    def products(self, right: np.ndarray) -> np.ndarray:
        """Return the inner products of right-hand sides (sites, k) with their solutions, (k, k).

        With M = P^H L L^H P these are the products of L^-1 P: no back substitution.
        """
        work, closed = self._eliminated(right)
        free = work[: len(self._sites)]
        return free.conj().T @ free + closed.conj().T @ (self._cut_inverse @ closed)

    def _eliminated(self, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return columns (sites, k) after elimination: for all variables, and for the cut sites."""
        folded, n = self.folded, len(self._sites)
        turned = folded.phase.conj()[:, None] * columns
        work = np.zeros((len(self.dissection.order), turned.shape[1]), dtype=complex)
        work[:n] = turned[self._sites]
        self._forward(work)
        closed = turned[folded.cut]
        np.add.at(closed, folded.copy_of, folded.copy_phase.conj()[:, None] * work[n:])
        return work, closed

    def _forward(self, work: np.ndarray) -> None:
        real = work.view(float)
        for front, inverse, below in self._factored:
            values = inverse @ real[front.start : front.stop]
            real[front.start : front.stop] = values
            if len(below):
                real[front.boundary] -= below @ values

    def _backward(self, work: np.ndarray) -> None:
        real = work.view(float)
        for front, inverse, below in reversed(self._factored):
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
        order, fronts = self.dissection.order, self.dissection.fronts
        place = np.empty_like(order)
        place[order] = np.arange(len(order))
        place = place[folded.of_reading]
        shares = folded.shares
        first = np.where(shares > 0, place, len(order)).min(axis=0)
        place = np.where(shares > 0, place, first)
        marks = np.argsort(first, kind="stable")
        after = first[marks]

        of_sites = np.empty(len(folded.phase))
        of_sites[folded.cut] = self._cut_inverse.diagonal().real
        of_means = np.zeros(len(marks))
        copies = self._cut_inverse[folded.copy_of[:, None], folded.copy_of]
        copies = (folded.copy_phase[:, None] * copies * folded.copy_phase.conj()).real
        known = {len(fronts) - 1: copies}
        for number, front in reversed(list(enumerate(fronts))):
            z = known.pop(number)
            if front is not fronts[-1]:
                z = _selected(*self._factored[number][1:], z)
                sites = self._sites[front.start : front.stop]
                of_sites[sites] = z.diagonal()[: front.n_own]
            mine = marks[slice(*np.searchsorted(after, (front.start, front.stop)))]
            at = front.places(place[:, mine])
            of_means[mine] = np.einsum(
                "vk,wk,vwk->k", shares[:, mine], shares[:, mine], z[at[:, None], at]
            )
            for child in front.children:
                places = front.places(fronts[child].boundary)
                known[child] = z[places[:, None], places]
            del z  # before the next one is made
        return of_sites, of_means


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
        F11, F21 and F22 of a front.
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
        blocks, ((first, first), (last, first), (last, last)), strict=True
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


def _selected(inverse: np.ndarray, below: np.ndarray, z22: np.ndarray) -> np.ndarray:
    """Return the inverse over one front, given the inverse over its boundary."""
    n_own = len(inverse)
    z = np.empty((n_own + len(z22),) * 2, order="F")
    weight = inverse.T @ below.T
    z12 = weight @ z22
    z[n_own:, n_own:], z[:n_own, n_own:], z[n_own:, :n_own] = z22, -z12, -z12.T
    z[:n_own, :n_own] = inverse.T @ inverse + z12 @ weight.T
    return z


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
