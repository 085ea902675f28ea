# SPDX-License-Identifier: Apache-2.0
"""Normal equations of views at any pose (method eq. 12.3): dense, known by their uncertainty.

A mark's row has nodes of all views at different places, so that the matrix over the nodes is
nearly full: it is complex Hermitian, and factorised as such. No graph tells what is known. Nodes
are known if their standard uncertainty in the datum is below `KNOWN` readings' noise; the datum is
that of the known nodes.
"""

from functools import cached_property

import numpy as np
from scipy.linalg import lapack
from scipy.sparse import csr_matrix, diags

from selfcal_ros.errors import InputError
from selfcal_ros.estimation.lattice.connectivity import Components, Gauge
from selfcal_ros.estimation.lattice.placed import MapSpline, PlacedViews
from selfcal_ros.estimation.lattice.readings import MapPose
from selfcal_ros.estimation.normal.equations import NormalEquations
from selfcal_ros.estimation.normal.grid import GridSystem

KNOWN = 3.0
"""Largest standard uncertainty of a known node, in units of the noise of one reading."""

CORE = 0.75
"""Distance from the centre, in half widths, within which nodes fix the first datum."""

VAGUE = 1e-13
"""Information on every node, relative to the mean, that keeps the factorisation alive."""

UNMOVED = 1e-6
"""Change of a node by a misalignment of unit length up to which it is rounding."""

LOOSE = 10.0
"""Standard uncertainty of an undetermined field, in units of the noise of one reading."""

MAX_MODES = 21 * 21
"""Largest map whose undetermined fields are sought."""

BLOCK = 1024
"""Number of marks computed at once."""

MAX_NODES = 57 * 57
"""Largest map whose matrix is factorised: 2 GB and half a minute."""


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

    def inverse_diagonal(self) -> np.ndarray:
        """Return the diagonal of the inverse, real (n,)."""
        return self.inverse.diagonal().real.copy()


class PlacedSystem(GridSystem):
    """Normal equations of grid readings at any pose, independent of their values.

    Parameters
    ----------
    poses : tuple of MapPose
        One per view.
    weight : float array (views, nx, ny)
        Weight of each reading; 0 = not read.
    spline : MapSpline, optional
        Of the map, if it is not the one through its nodes.
    rotations : tuple of int
        As of `GridSystem`.

    Raises
    ------
    InputError
        If the map has more nodes than can be factorised.
    """

    views: PlacedViews

    def __init__(self, poses: tuple[MapPose, ...], weight: np.ndarray,
                 spline: MapSpline | None = None, rotations: tuple[int, ...] = ()) -> None:
        super().__init__((), weight, rotations=rotations)
        self.views = PlacedViews(poses, spline)

    @cached_property
    def components(self) -> Components:
        """One component of all nodes with readings near them, without a free vector."""
        read = [rows[weight.ravel() > 0] for rows, weight in zip(
            self.views.rows, self.weight, strict=True)]
        touched = np.unique(np.concatenate([rows.indices[rows.data != 0] for rows in read]))
        of_site = np.full(self.n_sites, -1)
        of_site[touched] = 0
        return Components(of_site, np.where(self.mark_read.ravel(), 0, -1), np.zeros(1, bool))

    @cached_property
    def unchecked(self) -> np.ndarray:
        """No node: each has several readings around it, bool (cx, cy)."""
        return np.zeros(self.views.shape, dtype=bool)

    @cached_property
    def matrix(self) -> np.ndarray:
        """The matrix over the nodes, marks eliminated, complex (n, n); `VAGUE` on its diagonal."""
        n = self.n_sites
        if n > MAX_NODES:
            raise InputError("map grid_size", f"{n} nodes are more than {MAX_NODES}",
                             "give the map fewer nodes")
        own, meant = csr_matrix((n, n)), csr_matrix((self.n_marks, n), dtype=complex)
        for rows, phase, weight, part in zip(self.views.rows, self.views.phases, self.weight,
                                             self.relative_weight, strict=True):
            own = own + rows.T @ diags(weight.ravel()) @ rows
            meant = meant + diags(part.ravel() * phase.conjugate()) @ rows
        total = diags(self.weight.sum(axis=0).ravel())
        out = self.views.spline.on_nodes((own - meant.conj().T @ total @ meant).toarray())
        out[np.diag_indices(n)] += self.vague
        return out

    @property
    def vague(self) -> float:
        """Information added to every node: too little to change a known one."""
        return float(VAGUE * self.weight.sum() / self.n_sites)

    @cached_property
    def factor(self) -> DenseFactor:  # type: ignore[override]
        """Factorisation of the matrix over the nodes."""
        return DenseFactor(self.matrix)

    def variance_of_means(self) -> np.ndarray:
        """Return the variance of the mean of the stage errors at the sites of each mark, (marks,).

        For known misalignments and unit noise.
        """
        views = self.views
        rows = csr_matrix((self.n_marks, self.n_sites), dtype=complex)
        for one, phase, part in zip(views.rows, views.phases, self.relative_weight, strict=True):
            rows = rows + diags(part.ravel() * phase.conjugate()) @ one
        inverse = self.factor.inverse.reshape(self.n_sites, *views.shape)
        half = views.spline.coefficients(inverse).reshape(self.n_sites, -1)
        cover = views.spline.coefficients(half.conj().T.reshape(-1, *views.shape)).reshape(
            self.n_sites, -1)
        out = np.zeros(self.n_marks)
        for start in range(0, self.n_marks, BLOCK):
            here = rows[start:start + BLOCK]
            out[start:start + BLOCK] = np.real(
                here.conj().multiply(here @ cover).sum(axis=1)).ravel()
        return out


class PlacedEquations(NormalEquations):
    """Grid and angular equations of one measured plan whose views lie anywhere."""

    grid: PlacedSystem

    @property
    def _core(self) -> GridSystem:
        return self.grid

    @cached_property
    def hides_fields(self) -> bool:
        """Whether a misalignment that no reading determines changes the map beyond its datum.

        The rotation of a view with a single mark does not.
        """
        views = self.grid.views
        gauge = Gauge(views.z_sites, np.ones(views.shape, dtype=bool), scale=True)
        fields = (self.grid.response @ self.unseen[:3 * self.grid.n_views]).T
        return any(np.abs(gauge.remove(field, gauge.parts(field))).max() > UNMOVED
                   for field in fields.reshape(-1, *views.shape))

    @cached_property
    def known_sites(self) -> np.ndarray:
        """Nodes whose standard uncertainty is below `KNOWN` readings' noise, bool (cx, cy)."""
        views = self.grid.views
        some = (self.grid.components.of_site >= 0).reshape(views.shape)
        if self.hides_fields:
            return np.zeros(views.shape, dtype=bool)
        ratio = self.grid_scale / self.angular_scale if self.angular.n_views else 0.0
        inverse = self.inverse(ratio) if ratio else self.grid_inverse
        known = some & (np.maximum(abs(views.z_sites.real), abs(views.z_sites.imag)) < CORE)
        if known.sum() < 3:  # three nodes a side
            known = some
        for _ in range(2):
            if known.sum() < 3:
                return np.zeros(views.shape, dtype=bool)
            datum = Gauge(views.z_sites, known, scale=True)
            largest = np.maximum(*self._variances(datum, inverse))
            known = some & (largest.reshape(views.shape) < KNOWN**2)
        return known

    def _variances(self, datum: Gauge, inverse: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the variances of Gx and Gy at the nodes in a datum over some, unit noise.

        `inverse` is the covariance of the misalignments, (size, size).
        """
        n, rigid = 3 * self.grid.n_views, datum.orthonormal
        factor, response, own = self.grid.factor, self.grid.response, inverse[:n, :n]
        spread = factor.inverse @ rigid + response @ (
            own @ np.real(response.conj().T @ rigid))
        inner, out = np.real(rigid.conj().T @ spread), []
        for part in (np.real, np.imag):
            b, s, y = part(datum.everywhere), part(spread), part(response)
            out.append(factor.inverse_diagonal() + np.einsum("pa,pa->p", y @ own, y)
                       + np.einsum("pk,pk->p", b @ inner - 2 * s, b))
        return out[0], out[1]

    @cached_property
    def loose_modes(self) -> np.ndarray:
        """Fields with a standard uncertainty beyond `LOOSE` readings' noise, the worst first.

        Complex (modes, cx, cy), of length 1; those of a map of more than `MAX_MODES` nodes are not
        sought.
        """
        views, n = self.grid.views, self.grid.n_sites
        if n > MAX_MODES:
            return super().loose_modes
        inverse, response = self.grid.factor.inverse, self.grid.response
        cover = np.block([[inverse.real, -inverse.imag], [inverse.imag, inverse.real]])
        answer = np.concatenate([response.real, response.imag])
        cover += answer @ self.grid_inverse @ answer.T
        basis = Gauge(views.z_sites, np.ones(views.shape, dtype=bool), scale=True).orthonormal
        rigid = np.concatenate([basis.real, basis.imag])
        cover -= rigid @ (rigid.T @ cover)
        cover -= (cover @ rigid) @ rigid.T
        values, vectors = np.linalg.eigh(cover)
        loose = vectors[:, values > LOOSE**2][:, ::-1]
        return (loose[:n] + 1j * loose[n:]).T.reshape(-1, *views.shape)

    @cached_property
    def known_marks(self) -> np.ndarray:
        """Marks read where the map is known, bool (nx, ny)."""
        return (self.grid.read & self.grid.views.near(self.known_sites)).any(axis=0)
