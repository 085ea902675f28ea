# SPDX-License-Identifier: Apache-2.0
"""Normal equations of the angular readings with the plate's lines eliminated.

Model (method eq. 2.3): V(k) = Gtheta((k + s) mod K) + Atheta(k) + phi + noise.

For views at any turn alpha the map is a Fourier series of H < K/2 harmonics (method eq. 14.2):
V(k) = Gtheta(2 pi k / K + alpha) + Atheta(k) + phi + noise. For the other parts its unknowns are
the values at the K lines, which determine such a series; the equations are solved for its
coefficients.
"""

import math
from functools import cached_property
from typing import Any

import numpy as np
from scipy.sparse import csr_matrix, diags, identity
from scipy.sparse.linalg import splu

from selfcal_ros.compensation.circle import fourier_basis, fourier_coefficients
from selfcal_ros.estimation.lattice.connectivity import Components
from selfcal_ros.estimation.normal.eliminated import PlateEliminated

MAX_FULL = 31 * 31
"""Largest number of values with full matrices over them: 7 MB each."""

MAX_STEPS = 100
"""Most steps of an iteration, of which good readings need a few."""

ROUNDED = 1e-12
"""Relative size of what is rounding alone, an eigenvalue, a variance, a factor, a change: exact
lines leave eigenvalues of 1e-9 that are told."""

FLOOR = 1e-13
"""Noise or change, m or rad, that is rounding and not tested."""


class AngularSystem(PlateEliminated):
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

    coordinates, of_view = 1, 1

    def __init__(
        self, turns: tuple[float, ...], weight: np.ndarray, *, known_plate: bool = False
    ) -> None:
        super().__init__(weight, known_plate=known_plate)
        self.turns = turns
        lines = np.arange(self.n_lines)
        self.site = (lines + np.rint(turns).astype(int)[:, None]) % max(len(lines), 1)
        """Stage line of each plate line in each view, or the nearest one, (views, K)."""

    @property
    def n_lines(self) -> int:
        """K."""
        return self.n_marks

    @property
    def n_unknowns(self) -> int:
        """Lines of stage and plate."""
        return 2 * self.n_lines

    @property
    def harmonics_untested(self) -> bool:
        """Whether no residual shows harmonics that the map lacks; of a value a line none are."""
        return False

    @property
    def edges(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Stage line, plate line and no turn of every reading: components have free constants."""
        view, line = np.nonzero(self.read)
        return self.site[view, line], line, np.zeros(len(line), dtype=int)

    @cached_property
    def rows(self) -> tuple[csr_matrix | np.ndarray, ...]:
        """Rows of each view's plate lines on the map, (K, K)."""
        unit = identity(self.n_lines, format="csr")
        return tuple(unit[site] for site in self.site)

    @cached_property
    def _columns(self) -> tuple[csr_matrix | np.ndarray, ...]:
        """The transposed rows."""
        return tuple(rows.T for rows in self.rows)

    def gather(self, field: np.ndarray) -> np.ndarray:
        """Return maps (..., K) at the plate lines in each view, (..., views, K)."""
        flat = field.reshape(math.prod(field.shape[:-1]), self.n_lines).T
        out = np.zeros((self.n_views, *flat.shape))
        for of_view, rows in zip(out, self.rows, strict=True):
            of_view[...] = rows @ flat
        return out.transpose(2, 0, 1).reshape(*field.shape[:-1], *self.weight.shape)

    def adjoint(self, readings: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return sums of readings (k, views, K) at the lines, (K, k), and of views, (views, k)."""
        sites = np.zeros((self.n_lines, len(readings)))
        for columns, view in zip(
            self._columns, readings.transpose(1, 2, 0), strict=True
        ):
            sites += columns @ view
        return sites, readings.sum(axis=-1).T

    def covariance(self, matrix: np.ndarray, first: int, second: int) -> np.ndarray:
        """Return the covariances (K,) of the map (K, K) at plate lines in one and another view."""
        return matrix[self.site[first], self.site[second]]

    @cached_property
    def _factor(self) -> Any:
        """Factor of the eliminated matrix over the lines, one of each component pinned."""
        pins = np.zeros(self.n_lines)
        pins[self.pins] = self.weight.sum() / max(self.n_readings, 1)
        matrix = self.over_nodes(self.rows)[0] + diags(pins)
        return splu(
            matrix.tocsc(),
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Return the solution of the pinned system for (K,) or (K, k)."""
        return self._factor.solve(np.ascontiguousarray(right))

    def misaligned(self, parameters: np.ndarray) -> np.ndarray:
        """Return what phi, (..., views), makes of the lines, (..., views, 1)."""
        return parameters[..., None]


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

    smooth = True

    def __init__(
        self,
        turns: tuple[float, ...],
        weight: np.ndarray,
        harmonics: int,
        *,
        known_plate: bool = False,
    ) -> None:
        super().__init__(turns, weight, known_plate=known_plate)
        self.harmonics = harmonics
        line = 2 * np.pi / self.n_lines
        places = (
            np.arange(self.n_lines) + np.array(turns, dtype=float)[:, None]
        ) * line
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
        return determined + int(self.mark_read.sum()) - 1

    @cached_property
    def missed(self) -> tuple[int, ...]:
        """The harmonics that the readings do not determine, from 1."""
        lost = self._spectrum[1][1:, ~self._determined] / GAP  # the constant is a datum
        variance = np.diag(self._inverse)[1:] + (lost**2).sum(axis=1)
        variance = variance.reshape(-1, 2).sum(axis=1) / 2
        return tuple(int(h) + 1 for h in np.flatnonzero(~(variance < KNOWN**2)))

    @cached_property
    def _determined(self) -> np.ndarray:
        """Combinations of coefficients that the readings determine, bool (2 H + 1,)."""
        return self._spectrum[0] > GAP * self.weight.sum()

    @property
    def n_determined(self) -> int:
        """Number of coefficients that the readings determine, however badly; not the constant."""
        return int(self._determined.sum())

    @property
    def n_left(self) -> int:
        """Number of readings that plate, rotations and series leave."""
        of_plate = int(self.mark_read.sum()) + self.n_views - 1
        return self.n_readings - of_plate - self.n_determined

    @property
    def harmonics_untested(self) -> bool:
        """Whether no residual shows harmonics that the series lacks.

        Lines read in two views leave fewer numbers than it has coefficients: it follows nearly all.
        """
        return self.n_left < self.n_determined

    @property
    def mean_variance(self) -> float:
        """Mean variance of what they determine of the map, for unit noise of a reading."""
        values, vectors = (
            values_of[..., self._determined] for values_of in self._spectrum
        )
        return float(((vectors[1:] ** 2).sum(axis=0) / values).sum() / 2)

    @cached_property
    def components(self) -> Components:
        """One component; without lines of the stage if any harmonic is missed."""
        marks = np.where(self.read.any(axis=0), 0, -1)
        sites = np.full(self.n_lines, -1 if self.missed else 0)
        return Components(sites, marks, np.ones(1, dtype=bool))

    @cached_property
    def rows(self) -> tuple[csr_matrix | np.ndarray, ...]:
        """Rows of each view's plate lines on the map, (K, K)."""
        unit = fourier_coefficients(np.eye(self.n_lines), self.harmonics)
        return tuple(self.basis @ unit)

    def covariance(self, matrix: np.ndarray, first: int, second: int) -> np.ndarray:
        """Return the covariances (K,) of the map (K, K) at plate lines in one and another view."""
        return np.einsum("ka,ka->k", self.rows[first] @ matrix, self.rows[second])

    @cached_property
    def _spectrum(self) -> tuple[np.ndarray, np.ndarray]:
        """Eigenvalues and vectors of the matrix over the coefficients, plate eliminated."""
        matrix = self.over_nodes(tuple(self.basis))[0]
        values, vectors = np.linalg.eigh((matrix + matrix.T) / 2)
        return values, vectors

    @cached_property
    def _inverse(self) -> np.ndarray:
        """Covariance of the coefficients for unit noise; what is undetermined is held."""
        values, vectors = self._spectrum
        return (
            vectors / np.where(self._determined, values, self.weight.sum())
        ) @ vectors.T

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Return the solution at the lines for (K,) or (K, k)."""
        return self.at_lines @ (
            self._inverse @ np.tensordot(self.at_lines.T, right, axes=1)
        )
