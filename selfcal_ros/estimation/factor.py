# SPDX-License-Identifier: Apache-2.0
"""Multifrontal factorisation of the eliminated normal matrix, and its selected inverse.

Each front keeps K = F11^-1 and W = F11^-1 F12. A solution then needs matrix products only, and
the diagonal of the inverse follows from the last front down to the first (Takahashi):
Z12 = -W Z22, Z11 = K - Z12 W', with Z22 taken from the parent's Z. K and W are real; only the
cut, which is solved last, is complex, and only the real part of its inverse reaches a diagonal.
"""

import numpy as np
from scipy.linalg import blas, lapack

from selfcal_ros.estimation.fold import FoldedMatrix
from selfcal_ros.estimation.fronts import Front, add_to, dissect, runs


class Factor:
    """Factorised Hermitian positive definite matrix over the sites of a field.

    Parameters
    ----------
    folded : FoldedMatrix
        The matrix.
    shape : tuple of int
        Sites along x and y.
    reach : int
        Largest folded distance of two sites that the matrix joins.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the matrix is not positive definite.
    """

    def __init__(self, folded: FoldedMatrix, shape: tuple[int, int], reach: int) -> None:
        self.folded = folded
        self.dissection = dissect(folded.real, folded.free, shape, reach)
        self._inverses: list[np.ndarray] = []
        self._weights: list[np.ndarray] = []
        updates: dict[int, np.ndarray] = {}
        for number, front in enumerate(self.dissection.fronts):
            inverse, weight, updates[number] = _eliminate(*self._assemble(front, updates))
            self._inverses.append(inverse)
            self._weights.append(weight)
        self._cut_inverse = self._close(updates)

    @property
    def _n_free(self) -> int:
        return len(self.folded.free)

    def _assemble(self, front: Front, updates: dict[int, np.ndarray]
                  ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return F11, F12, F22 of a front: rows of the matrix and what its children left."""
        matrix, own, n = self.dissection.matrix, front.stop - front.start, len(front.boundary)
        f11, f12, f22 = (np.zeros(size, order="F") for size in ((own, own), (own, n), (n, n)))
        span = slice(matrix.indptr[front.start], matrix.indptr[front.stop])
        columns, data = matrix.indices[span], matrix.data[span]
        rows = np.repeat(np.arange(own), np.diff(matrix.indptr[front.start:front.stop + 1]))
        inner = (columns >= front.start) & (columns < front.stop)
        f11[rows[inner], columns[inner] - front.start] = data[inner]
        outer = columns >= front.stop
        f12[rows[outer], np.searchsorted(front.boundary, columns[outer])] = data[outer]
        for child in front.children:
            boundary, update = self.dissection.fronts[child].boundary, updates.pop(child)
            k = int(np.searchsorted(boundary, front.stop))
            to_own = runs(boundary[:k] - front.start)
            to_rest = runs(np.searchsorted(front.boundary, boundary[k:]))
            add_to(f11, to_own, to_own, update[:k, :k])
            add_to(f12, to_own, to_rest, update[:k, k:])
            add_to(f22, to_rest, to_rest, update[k:, k:])
        return f11, f12, f22

    def _close(self, updates: dict[int, np.ndarray]) -> np.ndarray:
        """Join the copies of the cut sites and invert what remains, complex (cut, cut)."""
        folded, n = self.folded, self._n_free
        rest = self.dissection.matrix[n:, n:].toarray()
        for number in self.dissection.top:
            places = runs(self.dissection.fronts[number].boundary - n)
            add_to(rest, places, places, updates.pop(number))
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
        half, _ = lapack.zpotri(lower, lower=1)
        return np.tril(half) + np.tril(half, -1).conj().T

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Return the solution for one or more right-hand sides, (sites,) or (sites, k)."""
        folded, n = self.folded, self._n_free
        columns = right.reshape(len(right), -1)
        turned = folded.phase.conj()[:, None] * columns
        work = np.zeros((self.dissection.matrix.shape[0], turned.shape[1]), dtype=complex)
        work[:n] = turned[folded.free[self.dissection.order]]
        real = work.view(float)
        self._forward(real)
        closed = turned[folded.cut]
        np.add.at(closed, folded.copy_of, folded.copy_phase.conj()[:, None] * work[n:])
        closed = self._cut_inverse @ closed
        work[n:] = folded.copy_phase[:, None] * closed[folded.copy_of]
        self._backward(real)
        out = np.empty_like(work[:len(right)])
        out[folded.free[self.dissection.order]] = work[:n]
        out[folded.cut] = closed
        out *= folded.phase[:, None]
        return out.reshape(right.shape)

    def _forward(self, work: np.ndarray) -> None:
        for front, weight in zip(self.dissection.fronts, self._weights, strict=True):
            if len(front.boundary):
                work[front.boundary] -= weight.T @ work[front.start:front.stop]

    def _backward(self, work: np.ndarray) -> None:
        for front, inverse, weight in zip(reversed(self.dissection.fronts),
                                          reversed(self._inverses), reversed(self._weights),
                                          strict=True):
            own = inverse @ work[front.start:front.stop]
            if len(front.boundary):
                own -= weight @ work[front.boundary]
            work[front.start:front.stop] = own

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
            z = self._selected(number, needed.pop(number))
            out[sites[front.start:front.stop]] = z[:own, :own].diagonal()
            for child in front.children:
                places = front.places(fronts[child].boundary)
                needed[child] = z[places[:, None], places]
        return out

    def _selected(self, number: int, z22: np.ndarray) -> np.ndarray:
        """Return the inverse over one front, given that over its boundary."""
        inverse, weight = self._inverses[number], self._weights[number]
        own = len(inverse)
        z = np.empty((own + len(z22),) * 2, order="F")
        z12 = weight @ z22
        z[own:, own:], z[:own, own:], z[own:, :own] = z22, -z12, -z12.T
        z[:own, :own] = inverse + z12 @ weight.T
        return z


def _eliminate(f11: np.ndarray, f12: np.ndarray, f22: np.ndarray
               ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return F11^-1, F11^-1 F12 and what remains for the boundary; f22 is overwritten."""
    lower, info = lapack.dpotrf(f11, lower=1, overwrite_a=1)
    if info:
        raise np.linalg.LinAlgError("the normal matrix is not positive definite")
    half, _ = lapack.dpotri(lower, lower=1, overwrite_c=1)
    inverse = half + np.tril(half, -1).T
    if not f12.shape[1]:
        return inverse, f12, f22
    weight = blas.dgemm(1.0, inverse, f12)
    rest = blas.dgemm(-1.0, f12, weight, trans_a=1, beta=1.0, c=f22, overwrite_c=1)
    return inverse, weight, rest
