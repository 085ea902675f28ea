# SPDX-License-Identifier: Apache-2.0
"""Normal equations of the angular readings with the plate's lines eliminated.

Model (method eq. 2.3): V(k) = Gtheta((k + s) mod K) + Atheta(k) + phi + noise.

For views at any turn alpha the map is a Fourier series of H < K/2 harmonics (method eq. 14.2):
V(k) = Gtheta(2 pi k / K + alpha) + Atheta(k) + phi + noise. For the other parts its unknowns are
the values at the K lines, which determine such a series; the equations are solved for its
coefficients.
"""

from functools import cached_property
from typing import Any

import numpy as np
from scipy.sparse import coo_matrix, csc_matrix
from scipy.sparse.linalg import splu

from selfcal_ros.compensation.circle import fourier_basis, fourier_coefficients
from selfcal_ros.estimation.lattice.connectivity import Components, components, rest_on_one

MAX_FULL = 31 * 31
"""Largest number of values with full matrices over them: 7 MB each."""

MAX_STEPS = 100
"""Most steps of an iteration, of which good readings need a few."""

ROUNDED = 1e-12
"""Relative size of what is rounding alone, an eigenvalue, a variance, a factor, a change: exact
lines leave eigenvalues of 1e-9 that are told."""

FLOOR = 1e-13
"""Noise or change, m or rad, that is rounding and not tested."""


class AngularSystem:
    """Normal equations of a set of angular readings, independent of their values.

    Parameters
    ----------
    turns : tuple of int
        Total turn of each angular view, in lines.
    weight : float array (views, K)
        Weight of each reading; 0 = not read.
    known_plate : bool
        Whether the plate is known, so that none of its lines is eliminated.
    """

    def __init__(self, turns: tuple[float, ...], weight: np.ndarray, *,
                 known_plate: bool = False) -> None:
        self.turns, self.weight, self.known_plate = turns, weight, known_plate
        self.read = weight > 0
        total = weight.sum(axis=0)
        self.relative_weight = weight / np.where(total > 0, total, 1.0) * (not known_plate)
        lines = np.arange(weight.shape[1])
        self.site = (lines + np.rint(turns).astype(int)[:, None]) % max(len(lines), 1)
        """Stage line of each plate line in each view, or the nearest one, (views, K)."""

    @property
    def n_views(self) -> int:
        """Number of angular views."""
        return len(self.turns)

    @property
    def n_lines(self) -> int:
        """K."""
        return self.weight.shape[1]

    @property
    def n_readings(self) -> int:
        """Number of lines read, over all views."""
        return int(np.count_nonzero(self.read))

    @property
    def n_unknowns(self) -> int:
        """Lines of stage and plate."""
        return 2 * self.n_lines

    @property
    def rank(self) -> int:
        """Rank of the readings with known rotations (method eq. 6.2)."""
        parts = self.components
        nodes = np.count_nonzero(parts.of_site >= 0) + np.count_nonzero(parts.of_mark >= 0)
        return int(nodes - len(parts.balanced))

    @cached_property
    def components(self) -> Components:
        """Components of the graph of stage lines and plate lines: each has a free constant."""
        view, line = np.nonzero(self.read)
        if self.known_plate:
            return Components.of_one(np.isin(np.arange(self.n_lines), self.site[view, line]),
                                     np.zeros(self.n_lines, dtype=bool))
        return components(self.site[view, line], line, np.zeros(len(line), dtype=int),
                          n_sites=self.n_lines, n_marks=self.n_lines)

    @cached_property
    def unchecked(self) -> np.ndarray:
        """Stage lines that depend on unchecked readings, bool (K,)."""
        view, line = np.nonzero(self.read)
        return rest_on_one(self.site[view, line], line, n_sites=self.n_lines,
                           n_marks=self.n_lines)

    def centred(self, y: np.ndarray) -> np.ndarray:
        """Return `y` (views, K, ...) minus the weighted mean of each line over its views."""
        return y - np.einsum("vk,vk...->k...", self.relative_weight, y)

    def gather(self, field: np.ndarray) -> np.ndarray:
        """Return a map (K, ...) at the plate lines in each view, (views, K, ...)."""
        return field[self.site]

    def rows(self, view: int, lines: np.ndarray) -> np.ndarray:
        """Return the rows that lead from the map to plate lines in a view, (lines, K)."""
        out = np.zeros((len(lines), self.n_lines))
        out[np.arange(len(lines)), self.site[view, lines]] = 1.0
        return out

    def covariance(self, matrix: np.ndarray, one: int, other: int) -> np.ndarray:
        """Return the covariances (K,) of the map (K, K) at plate lines in one and another view."""
        return matrix[self.site[one], self.site[other]]

    def scatter(self, y: np.ndarray) -> np.ndarray:
        """Return the sum over readings at every stage line, (K, ...)."""
        out = np.zeros((self.n_lines, *y.shape[2:]))
        for v in range(self.n_views):
            out[self.site[v]] += y[v]
        return out

    @cached_property
    def matrix(self) -> csc_matrix:
        """The eliminated matrix over the stage lines, one line of each component pinned."""
        rows, cols, values = [], [], []
        for i in range(self.n_views):
            for j in range(self.n_views):
                value = -self.weight[i] * self.relative_weight[j]
                value = value + (self.weight[i] if i == j else 0.0)
                rows.append(self.site[i])
                cols.append(self.site[j])
                values.append(value)
        parts = self.components
        pins = np.concatenate([np.flatnonzero(parts.of_site < 0),
                               parts.first_sites[parts.balanced]])
        rows.append(pins)
        cols.append(pins)
        values.append(np.full(len(pins), self.weight.sum() / max(self.n_readings, 1)))
        data, at = np.concatenate(values), (np.concatenate(rows), np.concatenate(cols))
        return coo_matrix((data, at), shape=(self.n_lines, self.n_lines)).tocsc()

    @cached_property
    def _factor(self) -> Any:
        return splu(self.matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0,
                    options={"SymmetricMode": True})

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Return the solution of the pinned system for (K,) or (K, k)."""
        return self._factor.solve(right)

    @cached_property
    def columns(self) -> np.ndarray:
        """Coupling of the stage lines to phi of each view, (K, views)."""
        if not self.n_views:
            return np.zeros((self.n_lines, 0))
        unit = np.eye(self.n_views)[:, None, :] - self.relative_weight.T
        return self.scatter(self.weight[:, :, None] * unit)

    @cached_property
    def response(self) -> np.ndarray:
        """M^-1 times `columns`, (K, views)."""
        return self.solve(self.columns) if self.n_views else self.columns

    @cached_property
    def schur(self) -> np.ndarray:
        """Normal matrix of phi alone, (views, views)."""
        block = np.diag(self.weight.sum(axis=1)) - self.weight @ self.relative_weight.T
        out = block - self.columns.T @ self.response
        return (out + out.T) / 2

    def reduced(self, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return M^-1 b and the right-hand side of phi with the stage lines eliminated."""
        weighted = self.weight * self.centred(y)
        free = self.solve(self.scatter(weighted))
        return free, weighted.sum(axis=1) - self.columns.T @ free

    def plate(self, y: np.ndarray, field: np.ndarray, phi: np.ndarray) -> tuple:
        """Return Atheta (K,) and the residuals (views, K) for given Gtheta and phi."""
        residual = y - self.gather(field) - phi[:, None]
        a = np.einsum("vk,vk->k", self.relative_weight, residual)
        return a, np.where(self.read, residual - a, 0.0)


KNOWN = 3.0
"""Largest standard uncertainty, in units of the noise of one reading, of a node that is known, or
(rms over the circle) of a harmonic: what is known no worse is corrected rather than left."""

GAP = 1e-9
"""Relative size below which a number counts as zero: true zeros (of eigenvalues, of variances that
the datum removes, of differences of pitches) are near 1e-15, the smallest others above 1e-4."""


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
    known_plate : bool
        As of `AngularSystem`.
    """

    def __init__(self, turns: tuple[float, ...], weight: np.ndarray, harmonics: int, *,
                 known_plate: bool = False) -> None:
        super().__init__(turns, weight, known_plate=known_plate)
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
        determined = 2 * (self.harmonics - len(self.missed)) + 1
        return determined + self.n_marks - 1

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
