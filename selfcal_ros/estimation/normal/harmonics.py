# SPDX-License-Identifier: Apache-2.0
"""Normal equations of the angular readings for a map that is a Fourier series.

Model (method eq. 14.2): V(k) = Gtheta(2 pi k / K + alpha) + Atheta(k) + phi + noise for any turn
alpha, Gtheta a series of H < K/2 harmonics. For the other parts the unknowns are its values at the
K lines, which determine such a series; the equations are solved for its coefficients.
"""

from functools import cached_property

import numpy as np

from selfcal_ros.compensation.circle import fourier_basis, fourier_coefficients
from selfcal_ros.estimation.lattice.connectivity import Components
from selfcal_ros.estimation.normal.angular import AngularSystem

KNOWN = 3.0
"""Largest standard uncertainty (rms over the circle) of a harmonic that counts as determined, in
units of the noise of one reading."""

GAP = 1e-9
"""Relative eigenvalue of the matrix below which a combination of coefficients is undetermined."""


class HarmonicSystem(AngularSystem):
    """Normal equations of angular readings at any turn, independent of their values.

    Parameters
    ----------
    turns : tuple of float
        Total turn of each angular view, in lines.
    weight : float array (views, K)
        Weight of each reading; 0 = not read.
    harmonics : int
        H.
    """

    def __init__(self, turns: tuple[float, ...], weight: np.ndarray, harmonics: int) -> None:
        super().__init__(turns, weight)
        self.harmonics = harmonics
        line = 2 * np.pi / self.n_lines
        places = (np.arange(self.n_lines) + np.array(turns, dtype=float)[:, None]) * line
        self.basis = fourier_basis(places, harmonics)
        """Series at the plate lines in each view, (views, K, 2 H + 1)."""
        self.at_lines = fourier_basis(np.arange(self.n_lines) * line, harmonics)
        """Series at the lines of the map, (K, 2 H + 1)."""

    @property
    def n_unknowns(self) -> int:
        """Coefficients of the map and lines of the plate."""
        return 2 * self.harmonics + 1 + self.n_lines

    @property
    def rank(self) -> int:
        """Rank of the readings with known rotations."""
        told = 2 * (self.harmonics - len(self.missed)) + 1
        return told + self.n_marks - 1

    @cached_property
    def missed(self) -> tuple[int, ...]:
        """The harmonics that the readings do not determine, from 1."""
        lost = self._spectrum[1][1:, ~self._told] / GAP  # the constant is a datum
        variance = np.diag(self._inverse)[1:] + (lost**2).sum(axis=1)
        variance = variance.reshape(-1, 2).sum(axis=1) / 2
        return tuple(int(h) + 1 for h in np.flatnonzero(~(variance < KNOWN**2)))

    @property
    def n_marks(self) -> int:
        """Number of plate lines read."""
        return int(self.read.any(axis=0).sum())

    @cached_property
    def _told(self) -> np.ndarray:
        """Combinations of coefficients that the readings determine, bool (2 H + 1,)."""
        return self._spectrum[0] > GAP * self.weight.sum()

    @property
    def n_told(self) -> int:
        """Number of coefficients that the readings determine, however badly; not the constant."""
        return int(self._told.sum())

    @property
    def mean_variance(self) -> float:
        """Mean variance of what they determine of the map, for unit noise of a reading."""
        values, vectors = (part[..., self._told] for part in self._spectrum)
        return float(((vectors[1:] ** 2).sum(axis=0) / values).sum() / 2)

    @cached_property
    def components(self) -> Components:
        """One component; without lines of the stage if any harmonic is missed."""
        marks = np.where(self.read.any(axis=0), 0, -1)
        sites = np.full(self.n_lines, -1 if self.missed else 0)
        return Components(sites, marks, np.ones(1, dtype=bool))

    @cached_property
    def unchecked(self) -> np.ndarray:
        """No line: the series joins them, bool (K,)."""
        return np.zeros(self.n_lines, dtype=bool)

    def gather(self, field: np.ndarray) -> np.ndarray:
        """Return a map (K, ...) at the plate lines in each view, (views, K, ...)."""
        return np.tensordot(self.basis, fourier_coefficients(field, self.harmonics), axes=1)

    def rows(self, view: int, lines: np.ndarray) -> np.ndarray:
        """Return the rows that lead from the map to plate lines in a view, (lines, K)."""
        unit = fourier_coefficients(np.eye(self.n_lines), self.harmonics)
        return self.basis[view, lines] @ unit

    def covariance(self, matrix: np.ndarray, one: int, other: int) -> np.ndarray:
        """Return the covariances (K,) of the map (K, K) at plate lines in one and another view."""
        half = fourier_coefficients(matrix, self.harmonics)
        half = fourier_coefficients(half.T, self.harmonics)
        return np.einsum("ka,ab,kb->k", self.basis[other], half, self.basis[one])

    def scatter(self, y: np.ndarray) -> np.ndarray:
        """Return the adjoint of `gather`, (K, ...)."""
        sums = np.tensordot(self.basis, y, axes=((0, 1), (0, 1)))
        sums[0] /= 2
        return np.tensordot(self.at_lines, sums, axes=1) * (2 / self.n_lines)

    @cached_property
    def _spectrum(self) -> tuple[np.ndarray, np.ndarray]:
        """Eigenvalues and vectors of the matrix over the coefficients, plate eliminated."""
        flat = self.basis.reshape(-1, self.basis.shape[-1])
        own = (flat * self.weight.reshape(-1, 1)).T @ flat
        mean = np.einsum("vk,vka->ka", self.relative_weight, self.basis)
        own -= (mean.T * self.weight.sum(axis=0)) @ mean
        values, vectors = np.linalg.eigh((own + own.T) / 2)
        return values, vectors

    @cached_property
    def _inverse(self) -> np.ndarray:
        """Covariance of the coefficients for unit noise; what is undetermined is held."""
        values, vectors = self._spectrum
        return (vectors / np.where(self._told, values, self.weight.sum())) @ vectors.T

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Return the solution at the lines for (K,) or (K, k)."""
        return self.at_lines @ (self._inverse @ np.tensordot(self.at_lines.T, right, axes=1))
