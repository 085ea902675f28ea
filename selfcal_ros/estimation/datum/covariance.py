# SPDX-License-Identifier: Apache-2.0
"""Covariance of the maps of stage and plate in their datum, and the scale of both.

No view determines the magnification: G = s z, A = -s m with offsets to match changes no reading.
With a reference the maps in their datum (no scale) become G + c z and A - c m, with c such that the
reference holds (method eq. 3.5).

For unit noise the sites have the covariance S = M^-1 + Y P Y', with M the eliminated matrix,
Y its answer to the misalignments and P their covariance (method eq. 4.8). With the plate
eliminated (method eq. 4.3), A(m) is the mean of the readings of its mark less what stage and
misalignments make of them: the noise of that mean is independent of both. So the covariance of all
functionals of G and A follows from M, Y and P (method eq. 4.14).

A map in its datum is the free one, and a few fields times as many functionals of both free maps.
That gives the variance of every site. Stage and plate exchange their parts: a view that lays mark m
on site X lays site X on mark m by the inverse pose. So on a lattice the variances of the plate are
those of a stage in the exchanged equations, where the marks are left (method eq. 4.13).
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from selfcal_ros.errors import InputError
from selfcal_ros.estimation.lattice.connectivity import Gauge
from selfcal_ros.estimation.lattice.maps import PHASES
from selfcal_ros.estimation.normal.equations import NormalEquations
from selfcal_ros.estimation.normal.placed import PlacedSystem
from selfcal_ros.estimation.normal.systems import Marks, system_of
from selfcal_ros.estimation.options import ReferenceKind, ReferenceLength
from selfcal_ros.model.pose import LatticePose

NO_NOISE_M = 1e-100
"""Stands for zero noise; its square is still representable."""


def scale_of(system: NormalEquations, reference: ReferenceLength, *, field: np.ndarray,
             plate: np.ndarray, half_width_m: float) -> float:
    """Return c for a map and a plate in their datum, m at the unit of position."""
    value = reference.relative_error * half_width_m
    if not reference.kind.of_plate:
        return value - float(np.real(_slope(system, reference.kind).conj() @ field.ravel()))
    return float(np.real(np.vdot(scale_of_plate(system, reference), plate))) - value


def scale_rows(system: NormalEquations, reference: ReferenceLength
               ) -> tuple[np.ndarray, np.ndarray]:
    """Return c as functionals of both maps in their datum, complex (sites, 1) and (marks, 1)."""
    sites = np.zeros((system.grid.n_sites, 1), dtype=complex)
    marks = np.zeros((system.grid.n_marks, 1), dtype=complex)
    if reference.kind.of_plate:
        marks[:, 0] = scale_of_plate(system, reference).reshape(-1)
    else:
        sites[:, 0] = -_slope(system, reference.kind)
    return sites, marks


def scale_of_plate(system: NormalEquations, reference: ReferenceLength) -> np.ndarray:
    """Return the row of the plate's map that is its scale, complex (nx, ny).

    That of the distance of two marks if the reference is one, else the least-squares scale.

    Raises
    ------
    InputError
        If one of the two marks was not measured.
    """
    z, known = system.grid.views.z, system.known_marks
    if reference.marks is None:
        return Gauge(z, known, scale=True).dual(3)
    first, second = (system.grid.views.index_of(*mark) for mark in reference.marks)
    for mark, at in zip(reference.marks, (first, second), strict=True):
        if not known[at]:
            raise InputError("reference length", f"the mark {mark} was not measured",
                             "measure it, or take another reference")
    apart, row = z[second] - z[first], np.zeros(z.shape, dtype=complex)
    row[second], row[first] = (sign * apart / abs(apart) ** 2 for sign in (1, -1))
    return row


def _slope(system: NormalEquations, kind: ReferenceKind) -> np.ndarray:
    """Return the row of the slope of Gx on x, or Gy on y, over the known sites, (sites,)."""
    z, known = system.grid.views.z_sites, system.known_sites
    along, unit = (z.real, 1) if kind is ReferenceKind.STAGE_X else (z.imag, 1j)
    centred = np.where(known, along - along[known].mean(), 0.0)
    return (unit * centred / (centred**2).sum()).ravel()


@dataclass(frozen=True, eq=False)
class TermSpread:
    """What the coefficients of the terms do to an estimate, for its covariance.

    Attributes
    ----------
    columns : complex array (p, views, nx, ny)
        Readings of the marks for a unit of each coefficient, plate frame.
    lines : float array (p, views, K)
        The same of the lines.
    fields : complex array (sites, p)
        Map for a unit of each coefficient, in no particular datum.
    plates : complex array (marks, p)
        The corresponding map of the plate.
    parameters : float array (size, p)
        The corresponding misalignments.
    turned : float array (K, p)
        Angular map for a unit of each coefficient, sign reversed, rad.
    covariance : float array (p, p)
        Of the coefficients, for unit noise of one grid reading.
    """

    columns: np.ndarray
    lines: np.ndarray
    fields: np.ndarray
    plates: np.ndarray
    parameters: np.ndarray
    turned: np.ndarray
    covariance: np.ndarray

    @classmethod
    def none(cls, system: NormalEquations) -> "TermSpread":
        """Return that of no term."""
        grid, angular = system.grid, system.angular
        return cls(np.zeros((0, *grid.weight.shape), dtype=complex),
                   np.zeros((0, *angular.weight.shape)), np.zeros((grid.n_sites, 0), dtype=complex),
                   np.zeros((grid.n_marks, 0), dtype=complex), np.zeros((system.size, 0)),
                   np.zeros((angular.n_lines, 0)), np.zeros((0, 0)))


class MapsCovariance:
    """Covariance of G and A in their datum, for unit noise of one grid reading.

    Parameters
    ----------
    system : NormalEquations
        The measured plan.
    inverse : float array (size, size)
        Covariance of the misalignments for unit grid noise.
    reference : ReferenceLength, optional
        Sets the scale; without it the map of the stage has none.
    half_width_m : float
        Unit of the positions, m.
    sigma_m : float
        Noise of one grid reading, by which the reference's uncertainty is measured.
    terms : TermSpread, optional
        Terms of the model that were estimated with the maps.
    """

    def __init__(self, system: NormalEquations, inverse: np.ndarray,
                 reference: ReferenceLength | None = None, *, half_width_m: float = 1.0,
                 sigma_m: float = 1.0, terms: TermSpread | None = None) -> None:
        self.system, self.inverse, self.length = system, inverse, half_width_m
        self.terms = terms or TermSpread.none(system)
        n = 3 * system.grid.n_views
        self._p, self._moved = inverse[:n, :n], self.terms.parameters[:n]
        self._scale = None if reference is None else scale_rows(system, reference)
        self._u = 0.0 if reference is None else (
            reference.u_relative * half_width_m / max(sigma_m, NO_NOISE_M))

    def of(self, sites: np.ndarray, marks: np.ndarray | None = None) -> np.ndarray:
        """Return the covariance (k, k) of functionals Re(conj(sites) G + conj(marks) A).

        Parameters
        ----------
        sites : complex array (k, nx, ny)
            Factors of the stage's map, frame of the equations.
        marks : complex array (k, nx, ny), optional
            Factors of the plate's map.
        """
        g, a, grown = self._functionals(sites, marks)
        return self.of_free(g, a) + np.outer(grown, grown) * self._u**2

    def of_free(self, g: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the covariance of functionals (sites, k), (marks, k) of the free maps, (k, k)."""
        cov, factors, of_terms = self.independent(g, a)
        cov += factors.T @ self._p @ factors + of_terms.T @ self.terms.covariance @ of_terms
        return (cov + cov.T) / 2

    def independent(self, g: np.ndarray, a: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return functionals (sites, k), (marks, k) of free maps by what is independent.

        The covariance of the part that is of sites and marks alone, (k, k), and the factors of
        the misalignments, (3 views, k), and of the terms, (p, k).
        """
        grid, of_terms = self.system.grid, self._of_terms(g, a)
        cov = np.real(a.conj().T @ (self._noise[:, None] * a))
        g, moved = self._readings(g, a)
        cov += np.real(g.conj().T @ grid.factor.solve(np.ascontiguousarray(g)))
        return cov, moved - np.real(grid.response.conj().T @ g), of_terms

    def sensitivities(self, sites: np.ndarray, marks: np.ndarray | None = None) -> np.ndarray:
        """Return those of functionals as in `of` to the readings, over their weights, plate frame.

        Complex (k, views, nx, ny).
        """
        grid, terms = self.system.grid, self.terms
        g, a, _ = self._functionals(sites, marks)
        field, parameters, taken = self._solved(g, a)
        maps = (field - terms.fields @ taken).T.reshape(-1, *grid.views.shape)
        y = np.tensordot(taken.T, terms.columns, axes=1) if len(taken) else np.zeros(1)
        rest = grid.plate(-y, maps, (parameters - self._moved @ taken).T)[1]
        of_mark = (self._noise[:, None] * a).T.reshape(-1, 1, *grid.views.plate_shape)
        return np.where(grid.read, of_mark, 0) - rest

    def variance_of_scale(self, reference: ReferenceLength) -> float:
        """Return the variance of the scale that an exact reference would set, at the unit."""
        return float(self.of_free(*self._free(*scale_rows(self.system, reference)))[0, 0])

    @cached_property
    def of_stage(self) -> np.ndarray:
        """Variances of Gx and Gy at every site, (2, nx, ny); NaN if unknown."""
        system = self.system
        variance = self._of_sites(*self._datum(plate=False)) + self._of_length(
            system.grid.views.z_sites)
        return np.where(system.known_sites, variance.reshape(2, *system.known_sites.shape), np.nan)

    @cached_property
    def of_plate(self) -> np.ndarray:
        """Variances of Ax and Ay at every mark, (2, nx, ny); NaN if unknown."""
        system, (fields, g, a) = self.system, self._datum(plate=True)
        variance = self._of_marks(system.grid, fields, g, a) if isinstance(
            system.grid, PlacedSystem) else self._exchanged()._of_sites(fields, a, g)
        variance = variance + self._of_length(system.grid.views.z)
        return np.where(system.known_marks, variance.reshape(2, *system.known_marks.shape), np.nan)

    def maps_of_terms(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the maps for a unit of each coefficient in the datum, (sites, p), (marks, p)."""
        out = []
        for own, plate, known in ((self.terms.fields, False, self.system.known_sites),
                                  (self.terms.plates, True, self.system.known_marks)):
            fields, g, a = self._datum(plate=plate)
            moved = own + fields @ self._of_terms(g, a).T
            out.append(np.where(known.reshape(-1, 1), moved, 0.0))
        return out[0], out[1]

    def _of_terms(self, g: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return functionals (sites, k), (marks, k) of free maps of the terms, (p, k)."""
        return np.real(self.terms.fields.conj().T @ g) + np.real(self.terms.plates.conj().T @ a)

    def functionals(self, sites: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return functionals (k, nx, ny) of the stage's map as those of the free maps."""
        return self._functionals(sites, None)[:2]

    def _readings(self, g: np.ndarray, a: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return functionals of free maps as those of G and of the misalignments alone.

        But for the means of the marks, whose factors are `a`.
        """
        grid = self.system.grid
        moved = np.zeros((grid.n_views, 3, g.shape[1]))
        if not a.any():
            return g, moved.reshape(-1, g.shape[1])
        out = np.array(g.T, dtype=complex, order="C").reshape(-1, *grid.views.shape)
        marks = a.T.reshape(-1, *grid.views.plate_shape)
        for v, part in enumerate(grid.relative_weight):
            grid.views.add_scattered(out, v, -part * marks)
            sums = np.einsum("cij,kij->ck", np.conj(grid.shapes), part * marks)
            moved[v] = -sums[0].real, -sums[1].real, -sums[1].imag
        return out.reshape(g.shape[1], -1).T, moved.reshape(-1, g.shape[1])

    @property
    def _noise(self) -> np.ndarray:
        """Variance of the mean of each mark, (marks,); 0 where not read."""
        total = self.system.grid.weight.sum(axis=0).ravel()
        return np.where(total > 0, 1 / np.where(total > 0, total, 1.0), 0.0)

    def _of_length(self, z: np.ndarray) -> np.ndarray:
        """Return the variances that the reference itself adds at places, (2, places)."""
        return (np.stack([z.real, z.imag]).reshape(2, -1) * self._u) ** 2

    def _functionals(self, sites: np.ndarray, marks: np.ndarray | None
                     ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return functionals (k, nx, ny) of the maps as those of free maps, (sites, k), (marks, k).

        And the share of the reference's length in each, (k,).
        """
        count, views = len(sites), self.system.grid.views
        g, grown = sites.reshape(count, -1).T, np.zeros(count)
        a = np.zeros((views.z.size, count)) if marks is None else marks.reshape(count, -1).T
        if self._scale is not None:
            grown = np.real(views.z_sites.reshape(-1).conj() @ g - views.z.reshape(-1).conj() @ a)
            g, a = (rows + scale * grown for rows, scale in zip((g, a), self._scale, strict=True))
        return *self._free(g, a), grown

    def _free(self, g: np.ndarray, a: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return functionals (sites, k), (marks, k) of maps without scale as those of free maps."""
        system = self.system
        a, g = (rows - basis @ np.real(basis.conj().T @ rows) for rows, basis in (
            (a, system.plate_gauge.orthonormal), (g, system.gauge.orthonormal)))
        # what the datum takes off the stage as its scale, the plate has
        grown = np.real(system.grid.views.z.reshape(-1).conj() @ a)
        return g + np.outer(system.gauge.dual(3).reshape(-1), grown), a

    def _datum(self, *, plate: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return what leads from a free map into its datum: fields, and functionals of both maps.

        The map is the free one plus each field (places, k) times its functional of the free maps,
        (sites, k) and (marks, k).
        """
        system, views = self.system, self.system.grid.views
        if plate:
            z, basis = views.z.reshape(-1), system.plate_gauge.orthonormal
            fields = np.column_stack([-basis, z - basis @ np.real(basis.conj().T @ z)])
            g = np.column_stack([np.zeros((views.z_sites.size, basis.shape[1])),
                                 system.gauge.dual(3).reshape(-1)])
            a = np.column_stack([basis, np.zeros(len(z))])
        else:
            z, g = -views.z_sites.reshape(-1), system.gauge.orthonormal
            fields, a = -g, np.zeros((views.z.size, g.shape[1]))
        if self._scale is not None:
            fields, g, a = (np.column_stack(pair) for pair in zip(
                (fields, g, a), (-z, *self._free(*self._scale)), strict=True))
        return fields, g, a

    def _solved(self, g: np.ndarray, a: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the covariance of functionals of free maps with the unknowns, for unit noise.

        With sites (sites, k) and misalignments (3 views, k), each without terms, and terms (p, k).
        """
        grid, taken = self.system.grid, -self.terms.covariance @ self._of_terms(g, a)
        g, moved = self._readings(g, a)
        parameters = self._p @ (moved - np.real(grid.response.conj().T @ g))
        field = grid.factor.solve(np.ascontiguousarray(g)) - grid.response @ parameters
        return field, parameters, taken

    def _of_sites(self, fields: np.ndarray, g: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the variances of the stage's map in a datum as in `_datum`, (2, sites)."""
        grid = self.system.grid
        field, _, taken = self._solved(g, a)
        return self._in_datum(grid.factor.inverse_diagonal(), grid.response, self.terms.fields,
                              field - self.terms.fields @ taken, fields, self.of_free(g, a))

    def _of_marks(self, grid: PlacedSystem, fields: np.ndarray, g: np.ndarray,
                  a: np.ndarray) -> np.ndarray:
        """Return the variances of the plate's map, for views off the lattice, (2, marks)."""
        plates = self.terms.plates
        field, parameters, taken = self._solved(g, a)
        spread = self._plates(field, parameters) + self._noise[:, None] * a - plates @ taken
        answer = self._plates(-grid.response, np.eye(len(self._p)))
        return self._in_datum(self._noise + grid.variance_of_means(), answer, plates, spread,
                              fields, self.of_free(g, a))

    def _in_datum(self, own: np.ndarray, answer: np.ndarray, terms: np.ndarray, spread: np.ndarray,
                  fields: np.ndarray, inner: np.ndarray) -> np.ndarray:
        """Return the variances of a map in its datum, (2, places).

        From those of readings alone, the answers to misalignments and terms, the covariance with
        the functionals of the datum, its fields, and the covariance of the functionals.
        """
        out = []
        for part in (np.real, np.imag):
            b, s, y, t = part(fields), part(spread), part(answer), part(terms)
            value = own + np.einsum("sa,sa->s", y @ self._p, y)
            value += np.einsum("sp,sp->s", t @ self.terms.covariance, t)
            out.append(value + np.einsum("sk,sk->s", b @ inner + 2 * s, b))
        return np.maximum(out, 0.0)

    def _plates(self, fields: np.ndarray, parameters: np.ndarray) -> np.ndarray:
        """Return what maps (sites, k) and misalignments (3 views, k) make of the plate."""
        grid = self.system.grid
        maps = fields.T.reshape(-1, *grid.views.shape)
        plates = grid.plate(np.zeros(grid.weight.shape), maps, parameters.T)[0]
        return plates.reshape(len(maps), -1).T

    def _exchanged(self) -> "MapsCovariance":
        """Return the covariance with stage and plate exchanged, on a lattice."""
        system, terms = self.system, self.terms
        grid, views = system.grid, system.grid.views
        poses, n = [], 3 * grid.n_views
        move = np.zeros((n, n))
        for v, pose in enumerate(views.poses):
            turn = PHASES[pose.q]
            back = -turn.conj() * (pose.a + 1j * pose.b)
            poses.append(LatticePose(-pose.q % 4, (back.real + 0.0, back.imag + 0.0), None))
            # about the centre of the field, in the stage frame: phi, t - phi i T (T: the shift)
            move[3 * v:3 * v + 3, 3 * v:3 * v + 3] = [
                [1, 0, 0], [pose.b / views.unit, turn.real, -turn.imag],
                [-pose.a / views.unit, turn.imag, turn.real]]
        weight = np.zeros((grid.n_views, grid.n_sites))
        view, mark = np.nonzero(grid.read.reshape(grid.n_views, -1))
        site = views.site_index.reshape(grid.n_views, -1)[view, mark]
        weight[view, site] = grid.weight.reshape(grid.n_views, -1)[view, mark]
        other = system_of(
            Marks(tuple(poses), weight.reshape(grid.weight.shape), system.grid_index,
                  rotations=grid.rotations),
            Marks((), np.zeros((0, system.angular.n_lines)), ()))
        return MapsCovariance(other, move @ self._p @ move.T, terms=TermSpread(
            terms.columns, terms.lines, terms.plates, terms.fields, move @ self._moved,
            terms.turned, terms.covariance))
