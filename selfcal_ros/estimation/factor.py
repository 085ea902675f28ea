# SPDX-License-Identifier: Apache-2.0
"""Factorisation of the eliminated normal matrix."""

import numpy as np
from scipy.linalg import lapack
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import splu


class DenseFactor:
    """Cholesky factor of a Hermitian positive definite matrix, dense."""

    def __init__(self, matrix: csc_matrix) -> None:
        self.lower, info = lapack.zpotrf(matrix.toarray(), lower=1)
        if info:
            raise np.linalg.LinAlgError(f"pivot {info} is not positive")

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Return the solution for one or more right-hand sides (sites,) or (sites, k)."""
        return lapack.zpotrs(self.lower, right, lower=1)[0].reshape(right.shape)

    def inverse_diagonal(self) -> np.ndarray:
        """Return the diagonal of the inverse, real (sites,)."""
        inverse, _ = lapack.zpotri(self.lower, lower=1)
        return inverse.diagonal().real.copy()


class SparseFactor:
    """LU factor of a larger matrix."""

    def __init__(self, matrix: csc_matrix) -> None:
        self.lu = splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0,
                       options={"SymmetricMode": True})

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Return the solution for one or more right-hand sides (sites,) or (sites, k)."""
        return self.lu.solve(right)

    def inverse_diagonal(self) -> np.ndarray:
        """Return the diagonal of the inverse, real (sites,)."""
        n = self.lu.shape[0]
        out = np.empty(n)
        for start in range(0, n, 512):
            stop = min(start + 512, n)
            part = np.zeros((n, stop - start), dtype=complex)
            part[np.arange(start, stop), np.arange(stop - start)] = 1
            out[start:stop] = self.lu.solve(part)[np.arange(start, stop),
                                                  np.arange(stop - start)].real
        return out


def factorise(matrix: csc_matrix, shape: tuple[int, int]) -> DenseFactor | SparseFactor:
    """Return the factorisation that suits the size of the field `shape`."""
    return DenseFactor(matrix) if matrix.shape[0] <= 1000 else SparseFactor(matrix)
