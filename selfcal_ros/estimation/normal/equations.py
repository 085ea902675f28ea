# SPDX-License-Identifier: Apache-2.0
"""The normal equations of a measured plan, grid and lines together, and what they determine."""

from functools import cached_property

import numpy as np

from selfcal_ros.estimation.lattice.connectivity import Gauge
from selfcal_ros.estimation.normal.angular import AngularSystem
from selfcal_ros.estimation.normal.grid import GridSystem

GAP = 1e-9
"""Relative size below which an eigenvalue of a misalignment matrix is zero; true zeros are
near 1e-15 and the smallest others above 1e-4."""

CORE_SITES = 41
"""Sites per side of the middle part of a large field."""


class NormalEquations:
    """Grid and angular equations of one measured plan, coupled by the views' rotations.

    Parameters
    ----------
    grid, angular : GridSystem, AngularSystem
        The two sets of equations.
    grid_index, angular_index : tuple of int
        Position of their views in the measurement.
    rank_only : bool
        Whether only the rank is needed: a large field then needs no factorisation.
    """

    def __init__(self, grid: GridSystem, angular: AngularSystem, grid_index: tuple[int, ...],
                 angular_index: tuple[int, ...], *, rank_only: bool = False) -> None:
        self.grid, self.angular, self.rank_only = grid, angular, rank_only
        self.grid_index, self.angular_index = grid_index, angular_index
        extra = [i for i in angular_index if i not in grid_index]
        self.size = 3 * len(grid_index) + len(extra)
        """Misalignments: (phi, Re tau, Im tau) of each grid view, phi of each other view."""
        of_view = {i: 3 * row for row, i in enumerate(grid_index)}
        of_view |= {i: 3 * len(grid_index) + row for row, i in enumerate(extra)}
        self.phi_at = np.array([of_view[i] for i in angular_index], dtype=int)
        """Index of phi of each angular view among the misalignments."""

    @cached_property
    def _core(self) -> GridSystem:
        """Grid equations for the rank of the misalignments: the middle part of a large field.

        If the middle of the plate determines all misalignments up to the datum, so does the
        whole, since more readings can only add; if not, the whole has to be factorised.
        """
        if self.grid.n_sites <= CORE_SITES**2 or not self.rank_only:
            return self.grid
        core = core_of(self.grid)
        values = np.linalg.eigvalsh(core.schur)
        free = len(values) - core.differences.shape[1]
        return core if _rank(values, _trace(core)) == free - 7 else self.grid

    @cached_property
    def rigid(self) -> np.ndarray:
        """Datum modes in terms of all misalignments, (7, size)."""
        out = np.zeros((7, self.size))
        out[:, :3 * self.grid.n_views] = self.grid.rigid
        out[[2, 6], 3 * self.grid.n_views:] = -1
        return out

    def normal(self, ratio: float) -> np.ndarray:
        """Return the normal matrix of all misalignments; `ratio` weighs lines (method eq. 4.6)."""
        return self._joined(self.grid.schur, ratio)

    def _joined(self, of_grid: np.ndarray, ratio: float) -> np.ndarray:
        out = np.zeros((self.size, self.size))
        n = 3 * self.grid.n_views
        out[:n, :n] = of_grid
        out[np.ix_(self.phi_at, self.phi_at)] += ratio * self.angular.schur
        return self.grid.tied(out)

    @cached_property
    def grid_scale(self) -> float:
        """Size of the grid's misalignment matrix before plate and sites were eliminated.

        Ranks are relative to it: the matrix after elimination may be mere rounding.
        """
        return _trace(self.grid)

    @cached_property
    def angular_scale(self) -> float:
        """Size of the angular misalignment matrix before the lines were eliminated."""
        return float(max(self.angular.weight.sum(), np.finfo(float).tiny))

    @cached_property
    def _core_scale(self) -> float:
        return self.grid_scale if self._core is self.grid else _trace(self._core)

    @cached_property
    def _core_spectrum(self) -> tuple[np.ndarray, np.ndarray]:
        values, vectors = np.linalg.eigh(self._core.schur)
        return values, vectors

    @cached_property
    def rank_schur(self) -> int:
        """Rank of the grid's misalignment matrix."""
        return _rank(self._core_spectrum[0], self._core_scale)

    @cached_property
    def grid_inverse(self) -> np.ndarray:
        """Pseudo-inverse of the grid's misalignment matrix: their covariance, unit noise."""
        values, vectors = (self._core_spectrum if self._core is self.grid
                           else np.linalg.eigh(self.grid.schur))
        return pseudo_inverse(values, vectors, self.grid_scale)

    def alone(self, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return map and misalignments of grid readings `y` fitted alone, in no datum."""
        free, d = self.grid.reduced(y)
        parameters = self.grid_inverse @ d
        return (free - self.grid.response @ parameters).reshape(self.grid.views.shape), parameters

    @cached_property
    def angular_inverse(self) -> np.ndarray:
        """Pseudo-inverse of the angular misalignment matrix."""
        values, vectors = np.linalg.eigh(self.angular.schur)
        return pseudo_inverse(values, vectors, self.angular_scale)

    def inverse(self, ratio: float) -> np.ndarray:
        """Return the pseudo-inverse of `normal`: covariance of the misalignments, unit noise."""
        held, let_go = self._held
        out = np.linalg.inv(self.normal(ratio) + held) - let_go
        return (out + out.T) / 2

    @cached_property
    def _held(self) -> tuple[np.ndarray, np.ndarray]:
        """Matrix that makes the normal matrix regular, and its effect on the inverse."""
        held = self.grid_scale * (self._null @ self._null.T)
        return held, held / self.grid_scale**2

    @cached_property
    def rank_grid(self) -> int:
        """Rank of the grid readings (method eq. 6.1)."""
        parts = self.grid.components
        nodes = np.count_nonzero(parts.of_site >= 0) + np.count_nonzero(parts.of_mark >= 0)
        return int(2 * (nodes - np.count_nonzero(parts.balanced)) + self.rank_schur)

    @cached_property
    def rank_angular(self) -> int:
        """Rank of the angular readings (method eq. 6.2)."""
        turns = _rank(np.linalg.eigvalsh(self.angular.schur), self.angular_scale)
        return self.angular.rank + turns

    @cached_property
    def _null(self) -> np.ndarray:
        """Orthonormal undetermined misalignments, (size, nullity)."""
        values, vectors = self._core_spectrum
        if self.angular.n_views:
            ratio = self._core_scale / self.angular_scale
            values, vectors = np.linalg.eigh(self._joined(self._core.schur, ratio))
        return vectors[:, values <= GAP * self._core_scale]

    @cached_property
    def nullity(self) -> int:
        """Undetermined misalignments: the datum's, and the differences that are none."""
        return self._null.shape[1]

    @cached_property
    def unseen(self) -> np.ndarray:
        """Undetermined misalignments other than the datum, (size, modes)."""
        # without turns the rigid modes are dependent: an orthonormal basis of their span
        none = np.zeros((self.grid.differences.shape[1], self.size))
        none[:, :3 * self.grid.n_views] = self.grid.differences.T
        datum = np.vstack([self.rigid, *[self._turn_of_lines] * self.apart, none])
        rigid, size, _ = np.linalg.svd(datum.T, full_matrices=False)
        rigid = rigid[:, size > 1e-9 * size[0]]
        if rigid.shape[1] == self.nullity:  # no reading determines the datum
            return np.zeros((self.size, 0))
        residual = self._null - rigid @ (rigid.T @ self._null)
        u, s, _ = np.linalg.svd(residual, full_matrices=False)
        return u[:, s > 1e-6]

    @property
    def hides_fields(self) -> bool:
        """Whether undetermined misalignments may change the map beyond its datum."""
        return bool(self.unseen.shape[1])

    @property
    def apart(self) -> bool:
        """Whether no angular view shares its rotation with a grid view.

        Then a common rotation of the angular views and the constant of the plate's lines are an
        additional datum, which does not affect the stage's map.
        """
        return bool(self.angular_index) and set(self.angular_index).isdisjoint(self.grid_index)

    @property
    def _turn_of_lines(self) -> np.ndarray:
        """The common rotation of views of lines alone, (size,)."""
        out = np.zeros(self.size)
        out[3 * self.grid.n_views:] = 1.0
        return out

    @cached_property
    def known_sites(self) -> np.ndarray:
        """Sites whose error is determined up to the datum, bool (nx, ny)."""
        hidden = self.unseen[:3 * self.grid.n_views]
        parts = self.grid.components
        known = (parts.of_site >= 0) & ~parts.balanced[parts.of_site]
        if np.any(np.abs(hidden) > 1e-6) and known.any():
            moved = self.grid.response @ hidden
            gauge = Gauge(self.grid.views.z_sites, known.reshape(self.grid.views.shape), scale=True)
            for column in moved.T:
                field = column.reshape(self.grid.views.shape)
                residual = gauge.remove(field, gauge.parts(field)).ravel()
                known &= abs(residual) <= 1e-6
        return known.reshape(self.grid.views.shape)

    @property
    def loose_modes(self) -> np.ndarray:
        """Badly determined fields, complex (modes, nx, ny): none on a lattice.

        There fields are either determined or not.
        """
        return np.zeros((0, *self.grid.views.shape), dtype=complex)

    @property
    def unchecked_sites(self) -> np.ndarray:
        """Known sites that depend on unchecked readings, bool (nx, ny)."""
        return self.grid.unchecked & self.known_sites

    @property
    def unchecked_lines(self) -> np.ndarray:
        """Known stage lines that depend on unchecked readings, bool (K,)."""
        return self.angular.unchecked & self.known_lines

    @cached_property
    def known_views(self) -> np.ndarray:
        """Misalignments determined up to the datum, bool (size,)."""
        known = np.ones(self.size, dtype=bool)
        n, shape = 3 * self.grid.n_views, self.grid.views.shape
        nothing = np.zeros(self.grid.weight.shape)
        for column in self.unseen.T:
            # an unseen mode may contain rigid parts: take it in the datum
            field = -(self.grid.response @ column[:n]).reshape(shape)
            parts = self.gauge.parts(field)
            moved = column - parts @ self.rigid[:4]
            plate, _ = self.grid.plate(nothing, self.gauge.remove(field, parts), moved[:n])
            moved = moved - self.plate_gauge.parts(plate) @ self.rigid[4:]
            known &= abs(moved) <= 1e-6
        return known & (self._turn_of_lines == 0) if self.apart else known

    @cached_property
    def known_marks(self) -> np.ndarray:
        """Marks whose error is determined up to the datum, bool (nx, ny)."""
        index = self.grid.views.site_index
        good = self.grid.read & (index >= 0) & self.known_sites.reshape(-1)[index]
        return good.any(axis=0)

    @cached_property
    def known_lines(self) -> np.ndarray:
        """Stage lines determined up to one constant, bool (K,)."""
        parts = self.angular.components
        known = parts.of_site >= 0
        if len(parts.balanced):
            known &= parts.of_site == parts.largest
        if self.unseen.shape[1] and known.any():
            moved = self.angular.response @ self.unseen[self.phi_at]
            moved = moved - moved[known].mean(axis=0)
            known = known & np.all(abs(moved) <= 1e-6, axis=1)
        return known

    @cached_property
    def known_plate_lines(self) -> np.ndarray:
        """Plate lines that are determined, bool (K,)."""
        return (self.angular.read & self.known_lines[self.angular.site]).any(axis=0)

    @cached_property
    def gauge(self) -> Gauge:
        """Datum of the stage."""
        return Gauge(self.grid.views.z_sites, self.known_sites, scale=True)

    @cached_property
    def plate_gauge(self) -> Gauge:
        """Datum of the plate."""
        return Gauge(self.grid.views.z, self.known_marks, scale=False)


def core_of(grid: GridSystem) -> GridSystem:
    """Return the smaller system of the marks and sites in the middle of a field."""
    low = [(size - CORE_SITES) // 2 if size > CORE_SITES else 0 for size in grid.views.shape]
    part = tuple(slice(a, size - a) for a, size in zip(low, grid.views.shape, strict=True))
    weight = grid.weight[(slice(None), *part)]
    inside = GridSystem(grid.views.poses, weight, grid.views.unit).views.in_field
    return GridSystem(grid.views.poses, weight * inside, grid.views.unit, grid.rotations)


def _trace(grid: GridSystem) -> float:
    total = (grid.weight * (abs(grid.views.z) ** 2 + 2)).sum()
    return float(max(total, np.finfo(float).tiny))


def _rank(values: np.ndarray, scale: float) -> int:
    return int(np.count_nonzero(values > GAP * scale))


def pseudo_inverse(values: np.ndarray, vectors: np.ndarray, scale: float) -> np.ndarray:
    """Return the pseudo-inverse of a matrix of size `scale`, given its eigenvalues and vectors."""
    good = values > GAP * scale
    return (vectors[:, good] / values[good]) @ vectors[:, good].T


def grid_residuals(system: NormalEquations, y: np.ndarray) -> np.ndarray:
    """Return the residuals of the grid readings `y` (views, nx, ny), fitted alone."""
    return system.grid.plate(y, *system.alone(y))[1]


def angular_residuals(system: NormalEquations, y: np.ndarray) -> np.ndarray:
    """Return the residuals of the angular readings `y` (views, K), fitted alone."""
    angular = system.angular
    if not angular.n_views:
        return np.zeros(y.shape)
    free, d = angular.reduced(y)
    phi = system.angular_inverse @ d
    return angular.plate(y, free - angular.response @ phi, phi)[1]
