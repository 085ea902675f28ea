# SPDX-License-Identifier: Apache-2.0
"""The normal equations of a measured plan, grid and lines together, and what they determine.

Those of views at any pose are dense (method eq. 12.3). A mark's row has nodes of all views at
different places, so that the matrix over the nodes is nearly full: it is complex Hermitian, and
factorised as such. No graph tells what is known. Nodes are known if their standard uncertainty in
the datum is below `KNOWN` readings' noise; the datum is that of the known nodes.

Equations are made once for each plan, planned or measured, and kept.
"""

import math
from collections.abc import Sequence
from functools import cached_property, lru_cache
from typing import cast

import numpy as np
from scipy.linalg import lapack
from scipy.sparse import csr_matrix

from selfcal_ros.errors import InputError
from selfcal_ros.estimation.lattice.connectivity import Components, Gauge
from selfcal_ros.estimation.lattice.maps import MapSpline, PlacedViews
from selfcal_ros.estimation.lattice.readings import (
    Marks,
    angular_data,
    grid_data,
    planned_readings,
)
from selfcal_ros.estimation.normal.angular import (
    GAP,
    KNOWN,
    MAX_FULL,
    MAX_STEPS,
    ROUNDED,
    AngularSystem,
    HarmonicSystem,
)
from selfcal_ros.estimation.normal.grid import GridSystem
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.pose import AnyPose, LatticePose, PlacedPose
from selfcal_ros.model.view import View

TRACE = 1e-6
"""Part of a whole, or of a misalignment of unit length, that counts as none: rounding is 1e-9."""

ENOUGH_DOF = 30
"""Degrees of freedom from which a scatter is believed: that of repeats as the noise, rather than
that of residuals; that of residuals as a test of the nodes of a bilinear map."""

FULL_SIZE = 41
"""Sites per side of the largest field in which everything is tried, causes and candidates, in a
second; of a larger one its middle, or a smaller field of its shape, stands for it."""


class NormalEquations:
    """Grid and angular equations of one measured plan, coupled by the views' rotations.

    Parameters
    ----------
    grid, angular : GridSystem, AngularSystem
        The two sets of equations.
    grid_index, angular_index : tuple of int
        Position of their views in the measurement.
    """

    nodes_untested = False
    """Whether no other map can test the nodes of the map: a lattice has none of its own."""
    dof_of_map = math.inf
    """The degrees of freedom left to test them; only maps with their own nodes have to be."""

    def __init__(
        self,
        grid: GridSystem,
        angular: AngularSystem,
        grid_index: tuple[int, ...],
        angular_index: tuple[int, ...],
    ) -> None:
        self.grid, self.angular = grid, angular
        self.grid_index, self.angular_index = grid_index, angular_index
        extra = [i for i in angular_index if i not in grid_index]
        self.size = 3 * len(grid_index) + len(extra)
        """Misalignments: (phi, Re tau, Im tau) of each grid view, phi of each other view."""
        of_view = {i: 3 * row for row, i in enumerate(grid_index)}
        of_view |= {i: 3 * len(grid_index) + row for row, i in enumerate(extra)}
        self.phi_at = np.array([of_view[i] for i in angular_index], dtype=int)
        """Index of phi of each angular view among the misalignments."""

    @cached_property
    def rigid(self) -> np.ndarray:
        """Datum modes in terms of all misalignments, (7, size)."""
        out = np.zeros((7, self.size))
        out[:, : 3 * self.grid.n_views] = self.grid.rigid
        out[[2, 6], 3 * self.grid.n_views :] = -1
        return out

    def normal(self, ratio: float) -> np.ndarray:
        """Return the normal matrix of all misalignments; `ratio` weighs lines (method eq. 4.6)."""
        out = np.zeros((self.size, self.size))
        n = 3 * self.grid.n_views
        out[:n, :n] = self.grid.schur
        out[np.ix_(self.phi_at, self.phi_at)] += ratio * self.angular.schur
        return self.grid.tied(out)

    @cached_property
    def grid_scale(self) -> float:
        """Size of the grid's misalignment matrix before plate and sites were eliminated.

        Ranks are relative to it: the matrix after elimination may be mere rounding.
        """
        grid = self.grid
        total = (grid.weight * (abs(grid.views.z) ** 2 + 2)).sum()
        return float(max(total, np.finfo(float).tiny))

    @cached_property
    def angular_scale(self) -> float:
        """Size of the angular misalignment matrix before the lines were eliminated."""
        return float(max(self.angular.weight.sum(), np.finfo(float).tiny))

    @cached_property
    def _spectrum(self) -> tuple[np.ndarray, np.ndarray]:
        """Eigenvalues and vectors of the grid's misalignment matrix."""
        values, vectors = np.linalg.eigh(self.grid.schur)
        return values, vectors

    @cached_property
    def rank_schur(self) -> int:
        """Rank of the grid's misalignment matrix."""
        return _rank(self._spectrum[0], self.grid_scale)

    @cached_property
    def grid_inverse(self) -> np.ndarray:
        """Pseudo-inverse of the grid's misalignment matrix: their covariance, unit noise."""
        return pseudo_inverse(*self._spectrum, self.grid_scale)

    def grid_fit(self, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return map and misalignments of grid readings `y` fitted alone, in no datum."""
        field, parameters = self.grid.fitted(y, self.grid_inverse)
        return field.reshape(self.grid.views.shape), parameters

    def in_datum(
        self, y: np.ndarray, field: np.ndarray, parameters: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return a solution in its datum: map, misalignments, plate and residuals.

        Parameters
        ----------
        y : complex array (views, nx, ny)
            Grid readings.
        field, parameters : complex array (nx, ny), float array (size,) or (3 views,)
            Their map and misalignments, in no datum.
        """
        modes = self.gauge.coefficients(field)
        field = self.gauge.remove(field, modes)
        rigid = self.rigid[:, : len(parameters)]
        parameters = parameters - modes @ rigid[: len(modes)]
        plate, residuals = self.grid.plate(
            y, field, parameters[: 3 * self.grid.n_views]
        )
        modes = self.plate_gauge.coefficients(plate)
        return (
            field,
            parameters - modes @ rigid[4:],
            self.plate_gauge.remove(plate, modes),
            residuals,
        )

    @cached_property
    def angular_inverse(self) -> np.ndarray:
        """Pseudo-inverse of the angular misalignment matrix."""
        values, vectors = np.linalg.eigh(self.angular.schur)
        return pseudo_inverse(values, vectors, self.angular_scale)

    def inverse(self, ratio: float) -> np.ndarray:
        """Return the pseudo-inverse of `normal`: covariance of the misalignments, unit noise."""
        # the undetermined modes are held, and let go again
        held_modes = self.grid_scale * (self._null @ self._null.T)
        out = (
            np.linalg.inv(self.normal(ratio) + held_modes)
            - held_modes / self.grid_scale**2
        )
        return (out + out.T) / 2

    @cached_property
    def rank_grid(self) -> int:
        """Rank of the grid readings (method eq. 6.1)."""
        return 2 * self.grid.rank + self.rank_schur

    @cached_property
    def rank_angular(self) -> int:
        """Rank of the angular readings (method eq. 6.2)."""
        turns = _rank(np.linalg.eigvalsh(self.angular.schur), self.angular_scale)
        return self.angular.rank + turns

    @property
    def dof_grid(self) -> int:
        """Degrees of freedom of the residuals of marks fitted alone."""
        return 2 * self.grid.n_readings - self.rank_grid

    @property
    def dof_angular(self) -> int:
        """Degrees of freedom of the residuals of lines fitted alone."""
        return self.angular.n_readings - self.rank_angular

    @cached_property
    def _null(self) -> np.ndarray:
        """Orthonormal undetermined misalignments, (size, nullity)."""
        values, vectors = self._spectrum
        if self.angular.n_views:
            values, vectors = np.linalg.eigh(
                self.normal(self.grid_scale / self.angular_scale)
            )
        return vectors[:, values <= GAP * self.grid_scale]

    @cached_property
    def nullity(self) -> int:
        """Undetermined misalignments: the datum's, and the differences that are none."""
        return self._null.shape[1]

    @cached_property
    def unseen(self) -> np.ndarray:
        """Undetermined misalignments other than the datum, (size, modes)."""
        # without turns the rigid modes are dependent: an orthonormal basis of their span
        none = np.zeros((self.grid.differences.shape[1], self.size))
        none[:, : 3 * self.grid.n_views] = self.grid.differences.T
        datum = np.vstack([self.rigid, *[self._turn_of_lines] * self.apart, none])
        rigid, size, _ = np.linalg.svd(datum.T, full_matrices=False)
        rigid = rigid[:, size > GAP * size[0]]
        if rigid.shape[1] == self.nullity:  # no reading determines the datum
            return np.zeros((self.size, 0))
        residual = self._null - rigid @ (rigid.T @ self._null)
        u, s, _ = np.linalg.svd(residual, full_matrices=False)
        return u[:, s > TRACE]

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
        return bool(self.angular_index) and set(self.angular_index).isdisjoint(
            self.grid_index
        )

    @property
    def _turn_of_lines(self) -> np.ndarray:
        """The common rotation of views of lines alone, (size,)."""
        out = np.zeros(self.size)
        out[3 * self.grid.n_views :] = 1.0
        return out

    @cached_property
    def known_sites(self) -> np.ndarray:
        """Sites whose error is determined up to the datum, bool (nx, ny)."""
        hidden = self.unseen[: 3 * self.grid.n_views]
        components = self.grid.components
        is_known = (components.of_site >= 0) & ~components.balanced[components.of_site]
        if np.any(np.abs(hidden) > TRACE) and is_known.any():
            fields = self.grid.response @ hidden
            gauge = Gauge(
                self.grid.views.z_sites,
                is_known.reshape(self.grid.views.shape),
                scale=True,
            )
            for column in fields.T:
                field = column.reshape(self.grid.views.shape)
                residual = gauge.remove(field, gauge.coefficients(field)).ravel()
                is_known &= abs(residual) <= TRACE
        return is_known.reshape(self.grid.views.shape)

    @property
    def loose_modes(self) -> np.ndarray:
        """Badly determined fields, complex (modes, nx, ny): none on a lattice.

        There fields are either determined or not.
        """
        return np.zeros((0, *self.grid.views.shape), dtype=complex)

    @property
    def unchecked_sites(self) -> np.ndarray:
        """Known sites that depend on unchecked readings, bool (nx, ny)."""
        return self.grid.unchecked.reshape(self.known_sites.shape) & self.known_sites

    @property
    def unchecked_lines(self) -> np.ndarray:
        """Known stage lines that depend on unchecked readings, bool (K,)."""
        return self.angular.unchecked & self.known_lines

    @cached_property
    def known_views(self) -> np.ndarray:
        """Misalignments determined up to the datum, bool (size,)."""
        is_known = np.ones(self.size, dtype=bool)
        n = 3 * self.grid.n_views
        nothing = np.zeros(self.grid.weight.shape)
        for column in self.unseen.T:
            # an unseen mode may contain rigid parts: take it in the datum
            field = -(self.grid.response @ column[:n]).reshape(self.grid.views.shape)
            is_known &= abs(self.in_datum(nothing, field, column)[1]) <= TRACE
        return is_known & (self._turn_of_lines == 0) if self.apart else is_known

    @cached_property
    def known_marks(self) -> np.ndarray:
        """Marks whose error is determined up to the datum, bool (nx, ny)."""
        index = self.grid.views.site_index
        good = self.grid.read & (index >= 0) & self.known_sites.reshape(-1)[index]
        return good.any(axis=0)

    @cached_property
    def known_lines(self) -> np.ndarray:
        """Stage lines determined up to one constant, bool (K,)."""
        components = self.angular.components
        is_known = components.of_site >= 0
        if len(components.balanced):
            is_known &= components.of_site == components.largest
        if self.unseen.shape[1] and is_known.any():
            fields = self.angular.response @ self.unseen[self.phi_at]
            fields = fields - fields[is_known].mean(axis=0)
            is_known = is_known & np.all(abs(fields) <= TRACE, axis=1)
        return is_known

    @cached_property
    def known_plate_lines(self) -> np.ndarray:
        """Plate lines that are determined, bool (K,)."""
        return (self.angular.read & self.known_lines[self.angular.site]).any(axis=0)

    @cached_property
    def gauge(self) -> Gauge:
        """Datum of the stage: its scale is a convention, unless the plate is known."""
        return Gauge(
            self.grid.views.z_sites, self.known_sites, scale=not self.grid.known_plate
        )

    @cached_property
    def plate_gauge(self) -> Gauge:
        """Datum of the plate."""
        return Gauge(self.grid.views.z, self.known_marks, scale=False)


def _rank(values: np.ndarray, scale: float) -> int:
    return int(np.count_nonzero(values > GAP * scale))


def pseudo_inverse(values: np.ndarray, vectors: np.ndarray, scale: float) -> np.ndarray:
    """Return the pseudo-inverse of a matrix of size `scale`, given its eigenvalues and vectors."""
    good = values > GAP * scale
    return (vectors[:, good] / values[good]) @ vectors[:, good].T


def in_datum(
    own_variance: np.ndarray,
    answers: Sequence[tuple[np.ndarray, np.ndarray]],
    spread: np.ndarray,
    fields: np.ndarray,
    inner: np.ndarray,
) -> np.ndarray:
    """Return the variances of a map in its datum, (2, places); of a real map twice the same.

    The map is a free one plus each field times a functional of free maps.

    Parameters
    ----------
    own_variance : float array (places,)
        Variance of each value by the readings alone.
    answers : sequence of (places, p) and (p, p)
        What misalignments or terms make of the map, and their covariance.
    spread : array (places, k)
        Covariance of the free map with the functionals.
    fields : array (places, k)
        The fields.
    inner : float array (k, k)
        Covariance of the functionals.
    """
    out = []
    for coordinate in (np.real, np.imag):
        field = coordinate(fields)
        value = own_variance + np.einsum(
            "pk,pk->p", field @ inner + 2 * coordinate(spread), field
        )
        for answer, covariance in answers:
            value += np.einsum(
                "pa,pa->p", coordinate(answer) @ covariance, coordinate(answer)
            )
        out.append(value)
    return np.maximum(out, 0.0)


def grid_residuals(system: NormalEquations, y: np.ndarray) -> np.ndarray:
    """Return the residuals of the grid readings `y` (views, nx, ny), fitted alone."""
    return system.grid.plate(y, *system.grid_fit(y))[1]


def angular_residuals(system: NormalEquations, y: np.ndarray) -> np.ndarray:
    """Return the residuals of the angular readings `y` (views, K), fitted alone."""
    angular = system.angular
    if not angular.n_views:
        return np.zeros(y.shape)
    return angular.plate(y, *angular.fitted(y, system.angular_inverse))[1]


def noise_of(
    rng: np.random.Generator, shape: tuple[int, ...], weight: np.ndarray
) -> np.ndarray:
    """Return noise of variance 1 / weight on each axis, complex `shape`; 0 where weight is 0."""
    root = np.sqrt(np.where(weight > 0, weight, 1.0))
    coordinates = rng.standard_normal((2, *shape)) / root * (weight > 0)
    return coordinates[0] + 1j * coordinates[1]


CORE = 0.75
"""Distance from the centre, in half widths, within which nodes fix the first datum."""

BLOCK = 128
"""Number of marks, nodes or lines computed at once."""

MAX_NODES = 57 * 57
"""Largest map whose full matrix is factorised, or used: 2 GB and half a minute."""

UNASKED_SITES = 201 * 201
"""Largest field with an uncertainty and a search for causes unasked: a second, beyond many."""

N_DRAWS = 64
"""Draws of unit noise for a variance, of a residual as of an image: 9 % standard error."""


class DenseFactor:
    """Factorised Hermitian positive definite matrix over the nodes, with its inverse.

    Parameters
    ----------
    matrix : complex array (n, n)
        The matrix.

    Raises
    ------
    numpy.linalg.LinAlgError
        If it is not positive definite.
    """

    def __init__(self, matrix: np.ndarray) -> None:
        self._lower, info = lapack.zpotrf(matrix, lower=1)
        if info:
            raise np.linalg.LinAlgError("the normal matrix is not positive definite")

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Return the solution for one or more right-hand sides, (n,) or (n, k)."""
        return lapack.zpotrs(self._lower, right, lower=1)[0].reshape(right.shape)

    def products(self, right: np.ndarray) -> np.ndarray:
        """Return the inner products of right-hand sides (n, k) with their solutions, (k, k)."""
        half = lapack.ztrtrs(self._lower, right, lower=1)[0]
        return half.conj().T @ half

    @cached_property
    def inverse(self) -> np.ndarray:
        """The inverse, complex (n, n)."""
        lower = np.tril(lapack.zpotri(self._lower, lower=1)[0])
        return lower + np.tril(lower, -1).conj().T


class PlacedSystem(GridSystem):
    """Normal equations of grid readings at any pose, independent of their values.

    Parameters
    ----------
    plate : Artifact
        The plate, with the grid of the map.
    poses : tuple of PlacedPose
        One per view.
    weight : float array (views, nx, ny)
        Weight of each reading; 0 = not read.
    spline : MapSpline, optional
        Of the map, if it is not the one through its nodes.
    rotations, known_plate
        As of `GridSystem`.

    Raises
    ------
    InputError
        If the map has more nodes than can be factorised.
    """

    views: PlacedViews
    smooth = True

    def __init__(
        self,
        plate: Artifact,
        poses: tuple[PlacedPose, ...],
        weight: np.ndarray,
        spline: MapSpline | None = None,
        rotations: tuple[int, ...] = (),
        *,
        known_plate: bool = False,
    ) -> None:
        super().__init__((), weight, rotations=rotations, known_plate=known_plate)
        self.views = PlacedViews(plate, poses, spline)

    @property
    def shape(self) -> tuple[int, ...]:
        """Nodes of the map along x and y."""
        return self.views.shape

    @cached_property
    def components(self) -> Components:
        """One component of all nodes with readings near them, without a free vector."""
        read = [
            rows[weight.ravel() > 0]
            for rows, weight in zip(self.views.rows, self.weight, strict=True)
        ]
        touched = np.concatenate([rows.indices[rows.data != 0] for rows in read])
        return Components.of_one(
            np.isin(np.arange(self.n_sites), touched),
            self.mark_read.ravel() & (not self.known_plate),
        )

    @cached_property
    def matrix(self) -> np.ndarray:
        """The matrix over the nodes, marks eliminated, complex (n, n).

        With `vague` on its diagonal.
        """
        n = self.n_sites
        if n > MAX_NODES:
            raise InputError(
                "map grid_size",
                f"{n} nodes are more than {MAX_NODES}",
                "give the map fewer nodes",
            )
        out = self.views.spline.on_nodes(self._over_coefficients[0].toarray())
        out[np.diag_indices(n)] += self.vague
        return out

    @cached_property
    def _over_coefficients(self) -> tuple[csr_matrix, csr_matrix]:
        """The matrix over the spline's coefficients, and the rows of the means of the marks."""
        rows = [
            phase.conjugate() * view_rows
            for phase, view_rows in zip(self.views.phases, self.views.rows, strict=True)
        ]
        return self.over_nodes(rows)

    @property
    def too_large_to_refine(self) -> bool:
        """Whether the map has too many nodes for one with twice as many intervals."""
        return math.prod(self.views.spline.refined.shape) > MAX_FULL

    @property
    def equations_of_map(self) -> int:
        """The readings beyond plate and misalignments: two numbers each."""
        n_marks = int(self.mark_read.sum())
        return 2 * self.n_readings - 2 * n_marks - (self.n_misalignments - 7)

    @property
    def vague(self) -> float:
        """Information added to every node: too little to change a known one."""
        return float(ROUNDED * self.weight.sum() / self.n_sites)

    @cached_property
    def factor(self) -> DenseFactor:  # type: ignore[override]
        """Factorisation of the matrix over the nodes."""
        return DenseFactor(self.matrix)

    @property
    def variance_of_sites(self) -> np.ndarray:
        """Variance of the stage error at each node, (nodes,): known misalignments, unit noise."""
        return self.factor.inverse.diagonal().real

    @cached_property
    def variance_of_means(self) -> np.ndarray:
        """Variance of the mean stage error at the sites of each mark, (marks,), likewise."""
        views = self.views
        rows = self._over_coefficients[1].tocsr()
        inverse = self.factor.inverse.reshape(self.n_sites, *views.shape)
        half = views.spline.coefficients(inverse).reshape(self.n_sites, -1)
        cover = views.spline.coefficients(
            half.conj().T.reshape(-1, *views.shape)
        ).reshape(self.n_sites, -1)
        out = np.zeros(self.n_marks)
        for start in range(0, self.n_marks, BLOCK):
            block = rows[start : start + BLOCK]
            out[start : start + BLOCK] = np.real(
                block.conj().multiply(block @ cover).sum(axis=1)
            ).ravel()
        return out


class PlacedEquations(NormalEquations):
    """Grid and angular equations of one measured plan whose views lie anywhere."""

    grid: PlacedSystem

    @property
    def determined_coefficients(self) -> float:
        """The real coefficients of the map that the readings determine."""
        grid = self.grid
        return 2 * (grid.n_sites - grid.vague * float(grid.variance_of_sites.sum()))

    @property
    def dof_of_map(self) -> float:  # type: ignore[override]
        """The degrees of freedom that the map leaves to the residuals."""
        return self.grid.equations_of_map - self.determined_coefficients

    @cached_property
    def nodes_untested(self) -> bool:  # type: ignore[override]
        """Whether no other map can test the nodes: it is too large, or has too few readings."""
        grid = self.grid
        spline = grid.views.spline
        if grid.too_large_to_refine:
            return True
        n_left = grid.equations_of_map
        if grid.views.bilinear:  # a smooth map of the same nodes tests them
            return self.dof_of_map < ENOUGH_DOF
        if n_left > 2 * math.prod(spline.refined.shape):
            return False
        fine = PlacedSystem(
            grid.views.artifact, grid.views.poses, grid.weight, spline.refined
        )
        finer = PlacedEquations(fine, self.angular, self.grid_index, self.angular_index)
        return n_left - finer.determined_coefficients < 1

    @cached_property
    def hides_fields(self) -> bool:
        """Whether a misalignment that no reading determines changes the map beyond its datum.

        The rotation of a view with a single mark does not.
        """
        views = self.grid.views
        gauge = Gauge(views.z_sites, np.ones(views.shape, dtype=bool), scale=True)
        fields = (self.grid.response @ self.unseen[: 3 * self.grid.n_views]).T
        return any(
            np.abs(gauge.remove(field, gauge.coefficients(field))).max() > TRACE
            for field in fields.reshape(-1, *views.shape)
        )

    @cached_property
    def known_sites(self) -> np.ndarray:
        """Nodes whose standard uncertainty is below `KNOWN` readings' noise, bool (cx, cy)."""
        views = self.grid.views
        some = (self.grid.components.of_site >= 0).reshape(views.shape)
        if self.hides_fields:
            return np.zeros(views.shape, dtype=bool)
        ratio = self.grid_scale / self.angular_scale if self.angular.n_views else 0.0
        inverse = self.inverse(ratio) if ratio else self.grid_inverse
        is_known = some & (
            np.maximum(abs(views.z_sites.real), abs(views.z_sites.imag)) < CORE
        )
        if is_known.sum() < 3:  # three nodes a side
            is_known = some
        settled = 0
        for _ in range(MAX_STEPS):
            if is_known.sum() < 3 or settled == 2:
                break
            datum = Gauge(views.z_sites, is_known, scale=not self.grid.known_plate)
            largest = np.maximum(*self._variances(datum, inverse)).reshape(views.shape)
            best = largest[some].min()
            settled += int(best < KNOWN**2)
            # if the core itself has nodes that are not determined: the datum of the better ones
            is_known = some & (largest < (KNOWN**2 if best < KNOWN**2 else 4 * best))
        return is_known & (settled == 2) & (is_known.sum() >= 3)

    def _variances(self, datum: Gauge, inverse: np.ndarray) -> np.ndarray:
        """Return the variances of Gx and Gy at the nodes in a datum over some, (2, nodes).

        `inverse` is the covariance of the misalignments, (size, size).
        """
        n = 3 * self.grid.n_views
        rigid = datum.orthonormal
        factor = self.grid.factor
        response = self.grid.response
        misalignments = inverse[:n, :n]
        spread = factor.inverse @ rigid + response @ (
            misalignments @ np.real(response.conj().T @ rigid)
        )
        return in_datum(
            self.grid.variance_of_sites,
            ((response, misalignments),),
            spread,
            -datum.everywhere,
            np.real(rigid.conj().T @ spread),
        )

    @cached_property
    def loose_modes(self) -> np.ndarray:
        """Fields with a standard uncertainty beyond `KNOWN` readings' noise, the worst first.

        Complex (modes, cx, cy), of length 1; not sought where a full matrix over both coordinates
        is too large.
        """
        views, n = self.grid.views, self.grid.n_sites
        if 2 * n > MAX_FULL:
            return super().loose_modes
        inverse = self.grid.factor.inverse
        response = self.grid.response
        cover = np.block([[inverse.real, -inverse.imag], [inverse.imag, inverse.real]])
        answer = np.concatenate([response.real, response.imag])
        cover += answer @ self.grid_inverse @ answer.T
        basis = Gauge(
            views.z_sites, np.ones(views.shape, dtype=bool), scale=True
        ).orthonormal
        rigid = np.concatenate([basis.real, basis.imag])
        cover -= rigid @ (rigid.T @ cover)
        cover -= (cover @ rigid) @ rigid.T
        values, vectors = np.linalg.eigh(cover)
        loose = vectors[:, values > KNOWN**2][:, ::-1]
        return (loose[:n] + 1j * loose[n:]).T.reshape(-1, *views.shape)

    @cached_property
    def known_marks(self) -> np.ndarray:
        """Marks read where the map is known, bool (nx, ny)."""
        return (self.grid.read & self.grid.views.near(self.known_sites)).any(axis=0)


@lru_cache(maxsize=4)
def system_of(grid: Marks[AnyPose], angular: Marks[float]) -> NormalEquations:
    """Return the system of marks that were read; the last few are kept."""
    return _equations(grid, angular)


def _equations(grid: Marks[AnyPose], angular: Marks[float]) -> NormalEquations:
    lines = lines_of(angular)
    if grid.plate is not None:
        return PlacedEquations(
            PlacedSystem(
                grid.plate,
                cast(tuple[PlacedPose, ...], grid.poses),
                grid.weight,
                rotations=grid.rotations,
                known_plate=grid.known_plate,
            ),
            lines,
            grid.index,
            angular.index,
        )
    poses = cast(tuple[LatticePose, ...], grid.poses)
    return NormalEquations(
        GridSystem(
            poses, grid.weight, rotations=grid.rotations, known_plate=grid.known_plate
        ),
        lines,
        grid.index,
        angular.index,
    )


def lines_of(angular: Marks[float]) -> AngularSystem:
    """Return the equations of the angular readings."""
    if angular.harmonics and angular.poses:
        return HarmonicSystem(
            angular.poses,
            angular.weight,
            angular.harmonics,
            known_plate=angular.known_plate,
        )
    return AngularSystem(angular.poses, angular.weight, known_plate=angular.known_plate)


def planned_system(artifact: Artifact, views: Sequence[View]) -> NormalEquations:
    """Return the system of the planned views: every mark in the field, unit repeats.

    Parameters
    ----------
    artifact : Artifact
        The plate.
    views : sequence of View
        The plan; the cells of images are views of their own.
    """
    readings = planned_readings(artifact, views)
    return _equations(grid_data(readings), angular_data(readings))
