# SPDX-License-Identifier: Apache-2.0
"""Readings of one kind, marks or lines, with the plate eliminated (method eqs. 4.3-4.5).

The plate's error at a mark is the weighted mean of the residuals of its readings, so eliminating
it is exact and local. The remaining equations couple the map at the sites that one mark visits, and
the misalignments of the views, which are eliminated last.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from functools import cached_property

import numpy as np
from scipy.sparse import csr_matrix, diags

from selfcal_ros.estimation.lattice.connectivity import (
    Components,
    components,
    rest_on_one,
)


class PlateEliminated(ABC):
    """Normal equations of readings of one kind, independent of their values.

    Parameters
    ----------
    weight : float array (views, *marks)
        Weight of each reading; 0 = not read.
    known_plate : bool
        Whether the plate is known, so that no mark is eliminated.
    """

    coordinates: int
    """Numbers of one reading: two of a mark, one of a line."""

    of_view: int
    """Misalignments of one view: phi, Re tau, Im tau of marks, phi of lines; p of all views."""

    smooth = False
    """Whether the map has values between its sites, so that no site rests on one reading."""

    def __init__(self, weight: np.ndarray, *, known_plate: bool) -> None:
        self.weight, self.known_plate = weight, known_plate
        self.read = weight > 0
        total = weight.sum(axis=0)
        self.mark_read = total > 0
        self.relative_weight = (
            weight / np.where(self.mark_read, total, 1.0) * (not known_plate)
        )
        """Share of each reading in the mean of its mark, (views, *marks) (method eq. 4.3)."""

    @property
    def n_views(self) -> int:
        """Number of views."""
        return len(self.weight)

    @property
    def n_marks(self) -> int:
        """Number of marks of the plate, or of its lines."""
        return self.mark_read.size

    @property
    def n_sites(self) -> int:
        """Number of sites of the map."""
        return math.prod(self.shape)

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the map: that of the marks, unless it has nodes of its own."""
        return self.mark_read.shape

    @property
    def n_readings(self) -> int:
        """Number of marks read, over all views."""
        return int(np.count_nonzero(self.read))

    @property
    def noise_of_means(self) -> np.ndarray:
        """Variance of the mean of the readings of each mark, (marks,); 0 where not read."""
        total = self.weight.sum(axis=0).ravel()
        return np.where(total > 0, 1 / np.where(total > 0, total, 1.0), 0.0)

    @property
    @abstractmethod
    def edges(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Site, mark and quarter turns of every reading."""

    @cached_property
    def components(self) -> Components:
        """Components of the graph of sites and marks."""
        site, mark, q = self.edges
        if self.known_plate:
            return Components.of_one(
                np.isin(np.arange(self.n_sites), site),
                np.zeros(self.n_marks, dtype=bool),
            )
        return components(site, mark, q, n_sites=self.n_sites, n_marks=self.n_marks)

    @property
    def rank(self) -> int:
        """Rank of one coordinate of the readings with known misalignments (method eq. 6.1)."""
        connected = self.components
        nodes = np.count_nonzero(connected.of_site >= 0) + np.count_nonzero(
            connected.of_mark >= 0
        )
        return int(nodes - np.count_nonzero(connected.balanced))

    @cached_property
    def unchecked(self) -> np.ndarray:
        """Sites that depend on unchecked readings, bool (sites,)."""
        if self.smooth:
            return np.zeros(self.n_sites, dtype=bool)
        site, mark, _ = self.edges
        return rest_on_one(site, mark, n_sites=self.n_sites, n_marks=self.n_marks)

    @cached_property
    def pins(self) -> np.ndarray:
        """The pinned sites: those never visited, and one of each free component."""
        connected = self.components
        one_of_each = connected.first_sites[connected.balanced]
        return np.concatenate([np.flatnonzero(connected.of_site < 0), one_of_each])

    @abstractmethod
    def solve(self, right: np.ndarray) -> np.ndarray:
        """Return M^-1 of right-hand sides, (sites,) or (sites, k)."""

    @abstractmethod
    def gather(self, field: np.ndarray) -> np.ndarray:
        """Return maps at the marks of each view, frame of the readings, (..., views, *marks)."""

    @abstractmethod
    def covariance(self, matrix: np.ndarray, first: int, second: int) -> np.ndarray:
        """Return the covariances of a map at the marks of one and another view, (*marks,).

        `matrix` is that of the map, (sites, sites); the frame is that of the readings.
        """

    @abstractmethod
    def misaligned(self, parameters: np.ndarray) -> np.ndarray:
        """Return what misalignments (..., p) make of the readings, (..., views, *marks)."""

    @abstractmethod
    def adjoint(self, readings: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return sums of readings (k, views, *marks) at the sites, and over the misalignments.

        The adjoint of `gather` and `misaligned`, (sites, k) and (p, k).
        """

    def tied(self, normal: np.ndarray) -> np.ndarray:
        """Return a normal matrix of misalignments without those that are one."""
        return normal

    @cached_property
    def _coupling(self) -> tuple[np.ndarray, np.ndarray]:
        """Coupling of sites, (sites, p), and misalignments, (p, p), to the misalignments."""
        p = self.of_view * self.n_views
        parts = [(np.zeros((self.n_sites, 0)), np.zeros((p, 0)))]
        parts += [
            self.adjoint(self.weight * self.centred(self.misaligned(unit)))
            for unit in np.eye(p).reshape(self.n_views, self.of_view, p)
        ]
        sites, block = (np.hstack(part) for part in zip(*parts, strict=True))
        return sites, self.tied(block)

    @property
    def coupling(self) -> np.ndarray:
        """Coupling of the sites to the misalignments, plate eliminated, (sites, p)."""
        return self._coupling[0]

    @property
    def block(self) -> np.ndarray:
        """Normal matrix of the misalignments, plate eliminated, (p, p)."""
        return self._coupling[1]

    def coupled(self, fields: np.ndarray) -> np.ndarray:
        """Return the coupling of fields (sites, ...) to the misalignments, (p, ...)."""
        return np.real(fields.conj().T @ self.coupling).T

    @cached_property
    def response(self) -> np.ndarray:
        """M^-1 times `coupling`: response of the sites to the misalignments, (sites, p)."""
        return self.solve(self.coupling) if self.n_views else self.coupling

    @cached_property
    def schur(self) -> np.ndarray:
        """Normal matrix of the misalignments alone, (p, p) (method eq. 4.5)."""
        out = self.tied(self.block - self.coupled(self.response))
        return (out + out.T) / 2

    def means(self, y: np.ndarray) -> np.ndarray:
        """Return the weighted mean of each mark over its views, (..., 1, *marks)."""
        return (self.relative_weight * y).sum(axis=-self.weight.ndim, keepdims=True)

    def centred(self, y: np.ndarray) -> np.ndarray:
        """Return `y` (..., views, *marks) minus the weighted mean of each mark over its views."""
        return y - self.means(y)

    def right_side(self, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the right-hand sides of sites, (sites,), and misalignments, (p,), of readings."""
        sites, misalignments = self.adjoint((self.weight * self.centred(y))[None])
        return sites[:, 0], misalignments[:, 0]

    def reduced(self, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return M^-1 b and the right-hand side of the misalignments with sites eliminated."""
        b, d = self.right_side(y)
        free = self.solve(b)
        return free, d - self.coupled(free)

    def fitted(
        self, y: np.ndarray, inverse: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return map, (sites,), and misalignments, (p,), of readings fitted alone, in no datum.

        `inverse` is the pseudo-inverse of `schur`.
        """
        free, d = self.reduced(y)
        parameters = inverse @ d
        return free - self.response @ parameters, parameters

    def plate(
        self, y: np.ndarray, field: np.ndarray, parameters: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the plate (..., *marks) and the residuals for a map and misalignments.

        The residuals, (..., views, *marks), are 0 where not read.
        """
        residual = y - self.gather(field) - self.misaligned(parameters)
        a = self.means(residual)
        out = np.where(self.read, residual - a, 0.0)
        return a.squeeze(axis=-self.weight.ndim), out

    def squares(self, residuals: np.ndarray) -> float:
        """Return the weighted sum of squares of residuals (views, *marks)."""
        return float((self.weight * np.abs(residuals) ** 2).sum())

    def functionals(
        self, sites: np.ndarray, marks: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return functionals of map and plate as those of the sites and the misalignments.

        But for the noise of the means of the marks, whose factors are `marks`.

        Parameters
        ----------
        sites, marks : array (sites, k) and (marks, k)
            Factors of both maps; real inner product.

        Returns
        -------
        array (sites, k), float array (p, k)
        """
        misalignments = np.zeros((len(self.response.T), sites.shape[1]))
        if marks.any():
            of_marks = marks.T.reshape(-1, 1, *self.weight.shape[1:])
            of_sites, misalignments = self.adjoint(self.relative_weight * of_marks)
            sites = sites - of_sites
        return sites, -misalignments - np.real(sites.conj().T @ self.response).T

    def over_nodes(
        self, rows: Sequence[csr_matrix | np.ndarray]
    ) -> tuple[csr_matrix, csr_matrix]:
        """Return the matrix over the nodes with the marks eliminated, and the rows of their means.

        `rows`, matrices (marks, nodes), lead from the map to the readings of each view.
        """
        weight, share = (
            of_readings.reshape(self.n_views, -1)
            for of_readings in (self.weight, self.relative_weight)
        )
        mean = sum(
            diags(of_view) @ row for of_view, row in zip(share, rows, strict=True)
        )
        of_views = sum(
            row.conj().T @ (diags(of_view) @ row)
            for of_view, row in zip(weight, rows, strict=True)
        )
        return of_views - mean.conj().T @ (diags(weight.sum(axis=0)) @ mean), mean
