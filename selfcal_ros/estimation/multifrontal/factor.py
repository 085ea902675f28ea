# SPDX-License-Identifier: Apache-2.0
"""Multifrontal factorisation of the eliminated normal matrix, and its selected inverse.

Each front keeps J = L^-1 and Y = F21 J', where F11 = L L'. A solution then needs matrix products
only, and the diagonal of the inverse follows from the last front down to the first (Takahashi):
with K = J' J and W = J' Y', Z12 = -W Z22, Z11 = K - Z12 W', with Z22 taken from the parent's Z.
All this is real except for the cut, which is solved last; only the real part of its inverse
enters the diagonal.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from threading import RLock
from typing import Any

import numpy  # noqa: F401  (its library must be loaded before it can be found)
import numpy as np
import scipy.linalg  # noqa: F401  (so must scipy's own)
from scipy.linalg import blas, lapack
from threadpoolctl import ThreadpoolController

from selfcal_ros.estimation.multifrontal.dissection import RealSymmetricForm, dissect

SMALL = 64
"""Largest side of a triangle inverted by substitution."""


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

    def __init__(self, folded: RealSymmetricForm, shape: tuple[int, int], reach: int) -> None:
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
        folded, rest = self.folded, self.dissection.rest
        for number in self.dissection.top:
            places = self.dissection.fronts[number].boundary - self._n_free
            _extend((rest,), places, updates.pop(number))
        rest = _mirrored(np.tril(rest))
        size = len(folded.cut)
        joined = np.zeros((len(rest), size), dtype=complex)
        joined[np.arange(len(rest)), folded.copy_of] = folded.copy_phase
        closed = joined.conj().T @ (rest @ joined)
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
        free = work[:self._n_free]
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
        real, lanes = work.view(float), _lanes(work)
        for front, (inverse, below) in zip(self.dissection.fronts, self._blocks, strict=True):
            own = inverse @ real[front.start:front.stop]
            real[front.start:front.stop] = own
            if len(below):
                update = (below @ own).view(complex).reshape(-1, *lanes.shape[1:])
                lanes[front.boundary] = lanes.take(front.boundary, axis=0) - update

    def _backward(self, work: np.ndarray) -> None:
        real, lanes = work.view(float), _lanes(work)
        for front, (inverse, below) in zip(reversed(self.dissection.fronts),
                                           reversed(self._blocks), strict=True):
            own = real[front.start:front.stop]
            if len(below):
                later = lanes.take(front.boundary, axis=0).view(float)
                own = own - below.T @ later.reshape(len(below), -1)
            real[front.start:front.stop] = inverse.T @ own

    def inverse_diagonal(self) -> np.ndarray:
        """Return the diagonal of the inverse, real (sites,)."""
        folded, fronts = self.folded, self.dissection.fronts
        out = np.empty(len(folded.phase))
        out[folded.cut] = self._cut_inverse.diagonal().real
        copies = self._cut_inverse[folded.copy_of[:, None], folded.copy_of]
        copies = (folded.copy_phase[:, None] * copies * folded.copy_phase.conj()).real
        needed = {}
        for number in self.dissection.top:
            places = fronts[number].boundary - self._n_free
            needed[number] = copies[places[:, None], places]
        sites = folded.free[self.dissection.order]
        for number in range(len(fronts) - 1, -1, -1):
            front, own = fronts[number], fronts[number].stop - fronts[number].start
            if not front.children:
                out[sites[front.start:front.stop]] = self._diagonal(number, needed.pop(number))
                continue
            z = self._selected(number, needed.pop(number))
            out[sites[front.start:front.stop]] = z[:own, :own].diagonal()
            for child in front.children:
                places = front.places(fronts[child].boundary)
                needed[child] = z[places[:, None], places]
        return out

    def _diagonal(self, number: int, z22: np.ndarray) -> np.ndarray:
        """Return the diagonal of `_selected` for a front without children.

        Z11 = J' J + (Y J)' Z22 (Y J).
        """
        lower, below = self._blocks[number]
        carried = below @ lower
        return (lower * lower).sum(axis=0) + (carried * (z22 @ carried)).sum(axis=0)

    def _selected(self, number: int, z22: np.ndarray) -> np.ndarray:
        """Return the inverse over one front, given the inverse over its boundary."""
        lower, below = self._blocks[number]
        inverse, weight = lower.T @ lower, lower.T @ below.T
        own = len(inverse)
        z = np.empty((own + len(z22),) * 2, order="F")
        z12 = weight @ z22
        z[own:, own:], z[:own, own:], z[own:, :own] = z22, -z12, -z12.T
        z[:own, :own] = inverse + z12 @ weight.T
        return z


def _lanes(work: np.ndarray) -> np.ndarray:
    """Return (n, k) as (n,) if k is 1: indexing scalars is faster than rows."""
    return work.reshape(-1) if work.shape[1] == 1 else work


def _mirrored(lower: np.ndarray) -> np.ndarray:
    """Return the Hermitian matrix with this lower triangle; the upper one is zero."""
    out = lower + lower.conj().T
    out[np.diag_indices(len(out))] /= 2
    return out


def _extend(blocks: tuple[np.ndarray, ...], places: np.ndarray, update: np.ndarray) -> None:
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
    own = len(blocks[0])
    inner = int(np.searchsorted(places, own))
    first, last = slice(inner), slice(inner, len(places))
    to = {first: places[first], last: places[last] - own}
    for block, (rows, columns) in zip(blocks, ((first, first), (last, first), (last, last)),
                                      strict=False):
        at = to[columns][:, None] * len(block) + to[rows]
        np.add.at(block.T.reshape(-1), at.ravel(), update[rows, columns].T.ravel())


def _eliminate(f11: np.ndarray, f21: np.ndarray, f22: np.ndarray
               ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return L^-1, F21 L^-T and the Schur complement of the boundary; inputs are overwritten.

    Only the lower triangles of symmetric blocks are read and written.
    """
    lower, info = lapack.dpotrf(f11, lower=1, overwrite_a=1)
    if info:
        raise np.linalg.LinAlgError("the normal matrix is not positive definite")
    inverse = _inverse(lower)
    if not len(f21):
        return inverse, f21, f22
    below = blas.dtrmm(1.0, inverse, f21, side=1, lower=1, trans_a=1, overwrite_b=1)
    rest = blas.dsyrk(-1.0, below, beta=1.0, c=f22, lower=1, overwrite_c=1)
    return inverse, below, rest


def _inverse(lower: np.ndarray) -> np.ndarray:
    """Return the inverse of a lower triangular matrix, which is overwritten.

    Recursive by halves: matrix products are faster than substitution.
    """
    n = len(lower)
    if n <= SMALL:
        return lapack.dtrtri(lower, lower=1, overwrite_c=1)[0]
    half = n // 2
    first = _inverse(np.asfortranarray(lower[:half, :half]))
    last = _inverse(np.asfortranarray(lower[half:, half:]))
    below = blas.dtrmm(1.0, first, lower[half:, :half], side=1, lower=1)
    lower[half:, :half] = blas.dtrmm(-1.0, last, below, lower=1, overwrite_b=1)
    lower[:half, :half], lower[half:, half:] = first, last
    return lower


_lock = RLock()
_limits: list[Any] = []
_depth = 0


_controller = cache(ThreadpoolController)


@contextmanager
def one_thread() -> Iterator[None]:
    """Run the block with one BLAS thread.

    The number is restored when the outermost block of any thread of this process has ended.
    """
    global _depth
    with _lock:
        _depth += 1
        if _depth == 1:
            _limits.append(_controller().limit(limits=1, user_api="blas"))
    try:
        yield
    finally:
        with _lock:
            _depth -= 1
            if _depth == 0:
                _limits.pop().restore_original_limits()
