# SPDX-License-Identifier: Apache-2.0
"""Moving a solution to its datum: rigid modes out of G and A, into the misalignments."""

from functools import cached_property

import numpy as np


class Gauge:
    """Least-squares parts of a complex field in modes, over the known sites.

    Parameters
    ----------
    z : complex array (nx, ny)
        Positions in units of the longer half width.
    known : bool array (nx, ny)
        Sites that count.
    scale : bool
        Whether magnification belongs to the datum (stage: yes, plate: no).
    """

    def __init__(self, z: np.ndarray, known: np.ndarray, *, scale: bool) -> None:
        self.z, self.known, self.scale = z, known, scale
        self.modes = _modes(z, 4 if scale else 3)
        flat = (self.modes * known).reshape(len(self.modes), -1)
        self._flat = np.concatenate([flat.real, flat.imag], axis=1)
        self._gram_inverse = np.linalg.pinv(self._flat @ self._flat.T, hermitian=True)

    def parts(self, field: np.ndarray) -> np.ndarray:
        """Return the coefficients of the modes (1, i, iz, z) in `field`, (modes,)."""
        flat = field.reshape(-1)
        sums = self._flat @ np.concatenate([flat.real, flat.imag])
        return self._gram_inverse @ sums

    def dual(self, mode: int) -> np.ndarray:
        """Return the row that gives one of `parts`, complex (nx, ny), real inner product."""
        row = self._gram_inverse[mode] @ self._flat
        n = self.known.size
        return (row[:n] + 1j * row[n:]).reshape(self.known.shape)

    def remove(self, field: np.ndarray, parts: np.ndarray) -> np.ndarray:
        """Return `field` less the modes with coefficients `parts`."""
        return field - np.tensordot(parts, self.modes, axes=1)

    @cached_property
    def orthonormal(self) -> np.ndarray:
        """Orthonormal basis of the modes, complex (sites, modes), real inner product."""
        q = np.linalg.qr(self._flat.T)[0]
        n = self.known.size
        return q[:n] + 1j * q[n:]

    @cached_property
    def shear(self) -> np.ndarray:
        """Rows that give O and R of Hu eq. 6, times the half width: complex (2, nx, ny)."""
        shear = np.stack([1j * np.conj(self.z), np.conj(self.z)]) * self.known
        flat = np.concatenate([_modes(self.z, 4) * self.known, shear]).reshape(6, -1)
        real = np.concatenate([flat.real, flat.imag], axis=1)
        rows = (np.linalg.pinv(real @ real.T, hermitian=True) @ real)[4:]
        n = self.known.size
        return (rows[:, :n] + 1j * rows[:, n:]).reshape(2, *self.z.shape)

    def first_order(self, field: np.ndarray) -> tuple[float, float]:
        """Return O and R of `field`, times the half width."""
        both = np.einsum("cij,ij->c", np.conj(self.shear), np.where(self.known, field, 0.0)).real
        return float(both[0]), float(both[1])


def _modes(z: np.ndarray, number: int) -> np.ndarray:
    one = np.ones_like(z)
    return np.stack([one, 1j * one, 1j * z, z])[:number]
