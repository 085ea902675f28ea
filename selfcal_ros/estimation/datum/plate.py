# SPDX-License-Identifier: Apache-2.0
"""Uncertainty of the plate's map, and of the maps of stage and plate together.

Stage and plate exchange their parts: a view that lays mark m on site X lays site X on mark m by
the inverse pose. So on a lattice the covariance of the plate's map is that of a stage's map in the
exchanged equations, where the sites are eliminated and the marks are left (method eq. 4.13).

With the plate eliminated (method eq. 4.3), A(m) is the mean of the readings of its mark less what
stage and misalignments make of them: the noise of that mean is independent of both. So, on a
lattice or off it, the covariance of all functionals of G and A follows from M, Y and P (method
eq. 4.14).
"""

from dataclasses import replace

import numpy as np
from scipy.sparse import csr_matrix, diags

from selfcal_ros.estimation.datum.covariance import (
    NO_NOISE_M,
    FieldCovariance,
    ScaleDatum,
    TermSpread,
    plates_of_terms,
    scale_by_plate,
    scale_of,
    scale_of_plate,
    slope_in_datum,
    without_datum,
)
from selfcal_ros.estimation.lattice.maps import PHASES
from selfcal_ros.estimation.lattice.placed import PlacedViews
from selfcal_ros.estimation.normal.equations import NormalEquations
from selfcal_ros.estimation.normal.grid import GridSystem
from selfcal_ros.estimation.normal.systems import Marks, system_of
from selfcal_ros.estimation.options import ReferenceLength
from selfcal_ros.model.view import LatticePose


def exchanged(system: NormalEquations) -> NormalEquations:
    """Return the equations of the grid readings with stage and plate exchanged."""
    grid = system.grid
    poses = []
    for pose in grid.views.poses:
        back = -PHASES[-pose.q % 4] * (pose.a + 1j * pose.b)
        poses.append(LatticePose(-pose.q % 4, (round(back.real), round(back.imag)), None))
    weight = np.zeros((grid.n_views, grid.n_sites))
    view, mark = np.nonzero(grid.read.reshape(grid.n_views, -1))
    site = grid.views.site_index.reshape(grid.n_views, -1)[view, mark]
    weight[view, site] = grid.weight.reshape(grid.n_views, -1)[view, mark]
    return system_of(
        Marks(tuple(poses), weight.reshape(grid.weight.shape), system.grid_index,
              rotations=grid.rotations),
        Marks((), np.zeros((0, system.angular.n_lines)), ()))


def _misalignments(system: NormalEquations) -> np.ndarray:
    """Return the misalignments of the exchanged equations per unit of those of the grid views.

    About the centre of the field, in the stage frame: phi, t - phi i T with T the pose's shift.
    """
    views = system.grid.views
    out = np.zeros((3 * len(views.poses),) * 2)
    for v, pose in enumerate(views.poses):
        turn = PHASES[pose.q]
        out[3 * v:3 * v + 3, 3 * v:3 * v + 3] = [
            [1, 0, 0], [pose.b / views.unit, turn.real, -turn.imag],
            [-pose.a / views.unit, turn.imag, turn.real]]
    return out


def plate_covariance(cover: FieldCovariance, reference: ReferenceLength | None, *,
                     columns: np.ndarray, half_width_m: float,
                     sigma_m: float) -> FieldCovariance:
    """Return the covariance of the plate's map in its datum, for unit noise.

    Parameters
    ----------
    cover : FieldCovariance
        That of the stage's map.
    reference : ReferenceLength, optional
        As of the stage's map.
    columns : complex array (p, views, nx, ny)
        Columns of the terms of `cover` at the marks, plate frame.
    half_width_m : float
        Unit of the positions, m.
    sigma_m : float
        Noise of one grid reading.
    """
    system = cover.system
    other, move = exchanged(system), _misalignments(system)
    n = len(move)
    scale = _scale(system, other, reference, half_width_m)
    terms = None
    if len(columns):
        of_stage = cover.terms
        plates = plates_of_terms(cover, columns)
        moved = move @ of_stage.parameters[:n]
        flat = np.where(other.known_sites, plates, 0.0).reshape(len(plates), -1).T
        # the scale that a coefficient adds is known; the exchanged marks make up the rest of it
        row = _scale_row(system, reference)
        grown = np.real(row.reshape(-1).conj() @ of_stage.fields)
        if not _of_plate(reference):
            grown = grown + np.real(other.gauge.dual(3).reshape(-1).conj() @ flat)
        rest = grown - np.real(scale.rows.conj() @ flat) - scale.parameters @ moved
        if _of_plate(reference):  # the marks set their own scale
            rest = np.zeros(len(grown))
        terms = TermSpread(flat, moved, of_stage.covariance, rest, of_stage.turned)
    return FieldCovariance(other, move @ cover.inverse[:n, :n] @ move.T, scale, sigma_m, terms)


def _of_plate(reference: ReferenceLength | None) -> bool:
    return reference is not None and reference.kind.of_plate


def _scale_row(system: NormalEquations, reference: ReferenceLength | None) -> np.ndarray:
    """Return the row of the stage's map that is the plate's scale, but for the plate's own part."""
    if _of_plate(reference):
        return np.zeros(system.grid.views.shape, dtype=complex)
    row = system.gauge.dual(3)
    if reference is not None:
        row = row + slope_in_datum(system, reference.kind).reshape(row.shape)
    return row


def _scale(system: NormalEquations, other: NormalEquations, reference: ReferenceLength | None,
           half_width_m: float) -> ScaleDatum:
    """Return the scale of the plate's map: that of stage and plate together, or the reference's."""
    u_m = 0.0 if reference is None else reference.u_relative * half_width_m
    if reference is not None and reference.kind.of_plate:
        row = np.zeros(other.grid.n_sites, dtype=complex)
        if reference.marks is not None:  # else the datum has it
            row = -without_datum(other, scale_of_plate(system, reference).reshape(-1))
        return ScaleDatum(row, np.zeros(3 * other.grid.n_views), 0.0, u_m, of_plate=True)
    return scale_by_plate(other, _scale_row(system, reference), u_m)


BLOCK = 1024
"""Number of marks computed at once."""


class BothCovariance:
    """Covariance of G and A in their datum without terms of the model, for unit noise.

    Parameters
    ----------
    system : NormalEquations
        The measured plan.
    inverse : float array (size, size)
        Covariance of the misalignments for unit grid noise.
    reference : ReferenceLength, optional
        Sets the scale.
    half_width_m : float
        Unit of the positions, m.
    sigma_m : float
        Noise of one grid reading.
    """

    def __init__(self, system: NormalEquations, inverse: np.ndarray,
                 reference: ReferenceLength | None, *, half_width_m: float,
                 sigma_m: float) -> None:
        self.system, self.reference, self.length = system, reference, half_width_m
        n = 3 * system.grid.n_views
        self._inverse, self._p = inverse, inverse[:n, :n]
        self._u = 0.0 if reference is None else (
            reference.u_relative * half_width_m / max(sigma_m, NO_NOISE_M))

    def of(self, sites: np.ndarray, marks: np.ndarray) -> np.ndarray:
        """Return the covariance (k, k) of functionals Re(conj(sites) G + conj(marks) A).

        Parameters
        ----------
        sites : complex array (k, nx, ny)
            Factors of the stage's map, frame of the equations.
        marks : complex array (k, nx, ny)
            Factors of the plate's map.
        """
        count, grid = len(sites), self.system.grid
        g, a, grown = self._free(sites.reshape(count, -1).T, marks.reshape(count, -1).T)
        g, moved = self._readings(g, a)
        answer = np.real(grid.response.conj().T @ g) - moved
        cov = np.real(g.conj().T @ grid.factor.solve(np.ascontiguousarray(g)))
        cov += answer.T @ self._p @ answer + np.outer(grown, grown) * self._u**2
        cov += np.real(a.conj().T @ (self._noise[:, None] * a))
        return (cov + cov.T) / 2

    def sensitivities(self, sites: np.ndarray, marks: np.ndarray) -> np.ndarray:
        """Return those of functionals as in `of` to the readings, over their weights, plate frame.

        Complex (k, views, nx, ny).
        """
        count, grid = len(sites), self.system.grid
        g, a, _ = self._free(sites.reshape(count, -1).T, marks.reshape(count, -1).T)
        g, moved = self._readings(g, a)
        parameters = self._p @ (moved - np.real(grid.response.conj().T @ g))
        field = grid.factor.solve(np.ascontiguousarray(g)) - grid.response @ parameters
        rest = grid.plate(np.zeros(1), field.T.reshape(-1, *grid.views.shape), parameters.T)[1]
        of_mark = (self._noise[:, None] * a).T.reshape(-1, 1, *grid.views.plate_shape)
        return np.where(grid.read, of_mark, 0) - rest

    def of_lines(self, stage: np.ndarray, plate: np.ndarray,
                 sigma: tuple[float, float]) -> np.ndarray:
        """Return the covariance of functionals of both angular maps without terms, (k, k), rad^2.

        Parameters
        ----------
        stage, plate : float array (k, K)
            Factors of both maps: those of a map add up to 0, as its constant is free.
        sigma : tuple of float
            Noise of one grid reading, m, and of one angular reading, rad.
        """
        angular, phi = self.system.angular, self.system.phi_at
        share, total = angular.relative_weight, angular.weight.sum(axis=0)
        rows = stage.T - angular.scatter(share[..., None] * plate.T)
        answer = -angular.response.T @ rows - share @ plate.T
        cover = sigma[1]**2 * (rows.T @ angular.solve(np.ascontiguousarray(rows)) + (
            plate / np.where(total > 0, total, np.inf)) @ plate.T)
        cover += (sigma[0] / self.length) ** 2 * (
            answer.T @ self._inverse[np.ix_(phi, phi)] @ answer)
        return (cover + cover.T) / 2

    @property
    def _noise(self) -> np.ndarray:
        """Variance of the mean of each mark, (marks,); 0 where not read."""
        total = self.system.grid.weight.sum(axis=0).ravel()
        return np.where(total > 0, 1 / np.where(total > 0, total, 1.0), 0.0)

    def _free(self, g: np.ndarray, a: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return functionals (sites, k), (marks, k) of the maps as those of free maps.

        And the share of the reference's length in each, (k,).
        """
        grown = np.zeros(g.shape[1])
        if self.reference is not None:
            views = self.system.grid.views
            grown = np.real(views.z_sites.reshape(-1).conj() @ g
                            - views.z.reshape(-1).conj() @ a)
            g, a = (rows + np.outer(scale, grown) for rows, scale in zip(
                (g, a), self._scale(self.reference), strict=True))
        return *self._without_datum(g, a), grown

    def _scale(self, reference: ReferenceLength) -> tuple[np.ndarray, np.ndarray]:
        """Return the scale that a reference sets, as functionals (sites,), (marks,) of the maps."""
        system, views = self.system, self.system.grid.views
        if reference.kind.of_plate:
            return (np.zeros(system.grid.n_sites, dtype=complex),
                    scale_of_plate(system, reference).reshape(-1))
        return -slope_in_datum(system, reference.kind), np.zeros(views.z.size, dtype=complex)

    def _without_datum(self, g: np.ndarray, a: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return functionals (sites, k), (marks, k) of maps in the datum as those of free maps."""
        system = self.system
        a, g = (rows - basis @ np.real(basis.conj().T @ rows) for rows, basis in (
            (a, system.plate_gauge.orthonormal), (g, system.gauge.orthonormal)))
        # what the datum takes off the stage as its scale, the plate has
        grown = np.real(system.grid.views.z.reshape(-1).conj() @ a)
        return g + np.outer(system.gauge.dual(3).reshape(-1), grown), a

    def _readings(self, g: np.ndarray, a: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return functionals of free maps as those of G and of the misalignments alone.

        But for the means of the marks, whose factors are `a`.
        """
        grid = self.system.grid
        out = np.ascontiguousarray(g.T, dtype=complex).reshape(-1, *grid.views.shape)
        marks = a.T.reshape(-1, *grid.views.plate_shape)
        moved = np.zeros((grid.n_views, 3, g.shape[1]))
        for v, part in enumerate(grid.relative_weight):
            grid.views.add_scattered(out, v, -part * marks)
            sums = np.einsum("cij,kij->ck", np.conj(grid.shapes), part * marks)
            moved[v] = -sums[0].real, -sums[1].real, -sums[1].imag
        return out.reshape(g.shape[1], -1).T, moved.reshape(-1, g.shape[1])

    def maps_of_terms(self, fields: np.ndarray, plates: np.ndarray
                      ) -> tuple[np.ndarray, np.ndarray]:
        """Return the maps in the datum for a unit of each coefficient, (sites, p) and (marks, p).

        Parameters
        ----------
        fields : complex array (sites, p)
            Those of the stage, free.
        plates : complex array (p, nx, ny)
            Those of the plate, free.
        """
        views = self.system.grid.views
        both = [self._maps(field, plate) for field, plate in zip(
            fields.T.reshape(-1, *views.shape), plates, strict=True)]
        g, a = (np.array([pair[part].ravel() for pair in both], dtype=complex).reshape(-1, size)
                for part, size in enumerate((views.z_sites.size, views.z.size)))
        return g.T, a.T

    def _maps(self, field: np.ndarray, plate: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return free maps (nx, ny) that belong together in the datum, as far as they are known."""
        system = self.system
        parts = system.gauge.parts(field)
        field = system.gauge.remove(field, parts)
        plate = plate + parts[3] * system.grid.views.z
        plate = system.plate_gauge.remove(plate, system.plate_gauge.parts(plate))
        if self.reference is not None:
            free = replace(self.reference, relative_error=0.0)
            grown = scale_of(system, free, field=field, plate=plate, half_width_m=self.length)
            field = field + grown * system.grid.views.z_sites
            plate = plate - grown * system.grid.views.z
        return (np.where(system.known_sites, field, 0.0),
                np.where(system.known_marks, plate, 0.0))

    def placed_diagonal(self, plates: np.ndarray, terms: TermSpread
                        ) -> tuple[np.ndarray, np.ndarray]:
        """Return the variances of Ax and Ay, (nx, ny) each, for views off the lattice.

        The plate's map in its datum is the free one and a few fields times as many functionals.

        Parameters
        ----------
        plates : complex array (p, nx, ny)
            The plate for a unit of each coefficient, `plates_of_terms`.
        terms : TermSpread
            The terms' coefficients.
        """
        system, grid = self.system, self.system.grid
        z, basis = grid.views.z.reshape(-1), system.plate_gauge.orthonormal
        fields = np.column_stack([-basis, z - basis @ np.real(basis.conj().T @ z)])
        g = np.column_stack([np.zeros((grid.n_sites, 3)), system.gauge.dual(3).reshape(-1)])
        a = np.column_stack([basis, np.zeros(len(z))])
        if self.reference is not None:
            more = self._without_datum(*(row[:, None] for row in self._scale(self.reference)))
            fields, g, a = (np.column_stack(pair) for pair in zip(
                (fields, g, a), (-z, *more), strict=True))
        rows, moved = self._readings(g, a)
        parameters = self._p @ (moved - np.real(grid.response.conj().T @ rows))
        solved = grid.factor.solve(np.ascontiguousarray(rows)) - grid.response @ parameters
        spread = self._plates(solved, parameters) + self._noise[:, None] * a
        inner = np.real(g.conj().T @ solved + a.conj().T @ spread)
        noise = self._noise + _of_nodes(grid)
        own = self._plates(-grid.response, np.eye(len(self._p)))
        of_terms, out = self.maps_of_terms(terms.fields, plates)[1], []
        for part in (np.real, np.imag):
            b, s, y, t = part(fields), part(spread), part(own), part(of_terms)
            value = noise + np.einsum("ma,ab,mb->m", y, self._p, y)
            value += np.einsum("mk,mk->m", b @ inner + 2 * s, b) + (part(z) * self._u) ** 2
            value += np.einsum("mp,pq,mq->m", t, terms.covariance, t)
            out.append(np.where(system.known_marks, value.reshape(grid.views.plate_shape), np.nan))
        return out[0], out[1]

    def _plates(self, fields: np.ndarray, parameters: np.ndarray) -> np.ndarray:
        """Return what maps (sites, k) and misalignments (3 views, k) make of the plate."""
        grid = self.system.grid
        maps = fields.T.reshape(-1, *grid.views.shape)
        plates = grid.plate(np.zeros(grid.weight.shape), maps, parameters.T)[0]
        return plates.reshape(len(maps), -1).T


def _of_nodes(grid: GridSystem) -> np.ndarray:
    """Return the variance of the mean of the stage errors at the sites of each mark, (marks,)."""
    views = grid.views
    if not isinstance(views, PlacedViews):
        raise TypeError("only for views off the lattice")
    rows = csr_matrix((grid.n_marks, grid.n_sites), dtype=complex)
    for one, phase, part in zip(views.rows, views.phases, grid.relative_weight, strict=True):
        rows = rows + diags(part.ravel() * phase.conjugate()) @ one
    inverse = grid.factor.inverse.reshape(grid.n_sites, *views.shape)
    half = views.spline.coefficients(inverse).reshape(grid.n_sites, -1)
    cover = views.spline.coefficients(half.conj().T.reshape(-1, *views.shape)).reshape(
        grid.n_sites, -1)
    out = np.zeros(grid.n_marks)
    for start in range(0, grid.n_marks, BLOCK):
        here = rows[start:start + BLOCK]
        out[start:start + BLOCK] = np.real(here.conj().multiply(here @ cover).sum(axis=1)).ravel()
    return out
