# SPDX-License-Identifier: Apache-2.0
"""Move a solution to its datum: rigid modes out of G and A, into the misalignments."""

from functools import cached_property

import numpy as np


class Gauge:
    """Least-squares components of a complex field in modes, over the known sites.

    Parameters
    ----------
    z : complex array (nx, ny)
        Positions in units of the longer half width.
    known : bool array (nx, ny)
        Sites to use.
    scale : bool
        Whether magnification belongs to the datum (stage: yes, plate: no).
    """

    def __init__(self, z: np.ndarray, known: np.ndarray, *, scale: bool) -> None:
        self.z, self.known, self.scale = z, known, scale
        self._rows = _modes(z, known)[:4 if scale else 3]
        self._gram_inverse = _inverse((self._rows.conj() @ self._rows.T).real)

    def parts(self, field: np.ndarray) -> np.ndarray:
        """Return the coefficients of the modes (1, i, iz, z) in `field`, (modes,)."""
        return self._gram_inverse @ (self._rows @ field.conj().reshape(-1)).real

    def dual(self, mode: int) -> np.ndarray:
        """Return the row that gives one of `parts`, complex (nx, ny), real inner product."""
        return (self._gram_inverse[mode] @ self._rows).reshape(self.known.shape)

    def remove(self, field: np.ndarray, parts: np.ndarray) -> np.ndarray:
        """Return `field` minus the modes with coefficients `parts`."""
        shift, slope = complex(parts[0], parts[1]), complex(0.0, parts[2])
        if self.scale:
            slope += parts[3]
        return field - shift - slope * self.z

    @cached_property
    def orthonormal(self) -> np.ndarray:
        """Orthonormal basis of the modes, complex (sites, modes), real inner product."""
        q = np.linalg.qr(np.concatenate([self._rows.real, self._rows.imag], axis=1).T)[0]
        n = self.known.size
        return q[:n] + 1j * q[n:]

    @cached_property
    def shear(self) -> np.ndarray:
        """Rows that give O and R of Hu eq. 6, times the half width: complex (2, nx, ny)."""
        back = (np.conj(self.z) * self.known).reshape(-1)
        flat = np.stack([*_modes(self.z, self.known), 1j * back, back])
        rows = _inverse((flat.conj() @ flat.T).real)[4:] @ flat
        return rows.reshape(2, *self.z.shape)

    def first_order(self, field: np.ndarray) -> tuple[float, float]:
        """Return O and R of `field`, times the half width."""
        known = np.where(self.known, field, 0.0).conj().reshape(-1)
        both = (self.shear.reshape(2, -1) @ known).real
        return float(both[0]), float(both[1])


def _modes(z: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Return the modes 1, i, iz, z over the known sites, complex (4, sites)."""
    out = np.empty((4, z.size), dtype=complex)
    out[0], out[3] = known.reshape(-1), (z * known).reshape(-1)
    out[1], out[2] = 1j * out[0], 1j * out[3]
    return out


def _inverse(gram: np.ndarray) -> np.ndarray:
    """Return the pseudo-inverse of a Gram matrix: few sites may not separate all modes."""
    values, vectors = np.linalg.eigh(gram)
    good = values > 1e-12 * values[-1]
    return (vectors[:, good] / values[good]) @ vectors[:, good].T
