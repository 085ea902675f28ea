# SPDX-License-Identifier: Apache-2.0
"""Covariance of the calibrated maps in their datum, and the scale from a reference length.

For unit noise the sites have the covariance S = M^-1 + Y P Y', with M the eliminated matrix,
Y its answer to the misalignments and P their covariance; the datum projects it (method eq. 4.8).

No view determines the magnification: G = s z, A = -s m with offsets to match changes no reading.
With a reference the map in its datum (no scale) becomes G + c z, with c such that the reference
holds (method eq. 3.5).
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from selfcal_ros.errors import InputError
from selfcal_ros.estimation.lattice.connectivity import Gauge
from selfcal_ros.estimation.normal.equations import NormalEquations
from selfcal_ros.estimation.options import ReferenceKind, ReferenceLength


@dataclass(frozen=True, eq=False)
class ScaleDatum:
    """Dependence of the scale on a solution: c = const + Re(rows^H G) + parameters . p + noise.

    Attributes
    ----------
    rows : complex array (sites,)
        Factors of the map in no particular datum.
    parameters : float array (3 views,)
        Factors of the corresponding misalignments.
    variance : float
        Variance of the remaining part, for unit noise of one grid reading.
    u_m : float
        Standard uncertainty of the reference itself, m at the unit of position.
    of_plate : bool
        Whether the plate sets the scale, so that terms acting on its marks change it.
    dual : complex array (nx, ny), optional
        Factors of the plate's map where that sets the scale.
    """

    rows: np.ndarray
    parameters: np.ndarray
    variance: float
    u_m: float
    of_plate: bool = False
    dual: np.ndarray | None = None


def scale_datum(system: NormalEquations, reference: ReferenceLength,
                half_width_m: float) -> ScaleDatum:
    """Return the scale set by a reference length.

    Parameters
    ----------
    system : NormalEquations
        The measured plan.
    reference : ReferenceLength
        The length.
    half_width_m : float
        Unit of the system's positions, m.
    """
    u = reference.u_relative * half_width_m
    if not reference.kind.of_plate:
        return ScaleDatum(-slope_in_datum(system, reference.kind),
                          np.zeros(3 * system.grid.n_views), 0.0, u)
    return scale_by_plate(system, scale_of_plate(system, reference), u)


def scale_of_plate(system: NormalEquations, reference: ReferenceLength | None) -> np.ndarray:
    """Return the row of the plate's map that is its scale, complex (nx, ny).

    That of the distance of two marks if the reference is one, else the least-squares scale.

    Raises
    ------
    InputError
        If one of the two marks was not measured.
    """
    z, known = system.grid.views.z, system.known_marks
    if reference is None or reference.marks is None:
        return Gauge(z, known, scale=True).dual(3)
    first, second = (system.grid.views.index_of(*mark) for mark in reference.marks)
    for mark, at in zip(reference.marks, (first, second), strict=True):
        if not known[at]:
            raise InputError("reference length", f"the mark {mark} was not measured",
                             "measure it, or take another reference")
    apart, row = z[second] - z[first], np.zeros(z.shape, dtype=complex)
    row[second], row[first] = (sign * apart / abs(apart) ** 2 for sign in (1, -1))
    return row


def slope_in_datum(system: NormalEquations, kind: ReferenceKind) -> np.ndarray:
    """Return the row of the slope along an axis of a map in its datum, complex (sites,)."""
    return without_datum(system, _slope(system.grid.views.z_sites, system.known_sites, kind))


def without_datum(system: NormalEquations, rows: np.ndarray) -> np.ndarray:
    """Return functionals (sites,) or (sites, k) of a map in its datum as those of a free map."""
    basis = system.gauge.orthonormal
    return rows - basis @ np.real(basis.conj().T @ rows)


def scale_by_plate(system: NormalEquations, dual: np.ndarray, u_m: float = 0.0, *,
                   mode: int = 3) -> ScaleDatum:
    """Return the scale that a row `dual` of the plate's map sets, complex (nx, ny).

    With mode 2 the rotation instead of the scale (3).
    """
    grid = system.grid
    rows = system.gauge.dual(mode).ravel() - grid.views.scatter(
        grid.relative_weight * dual).ravel()
    sums = -np.einsum("cij,vij->vc", np.conj(grid.shapes), grid.relative_weight * dual)
    parameters = np.stack([sums[:, 0].real, sums[:, 1].real, sums[:, 1].imag], axis=1).ravel()
    total = grid.weight.sum(axis=0)
    variance = float((abs(dual) ** 2 / np.where(grid.mark_read, total, np.inf)).sum())
    return ScaleDatum(rows, parameters, variance, u_m, of_plate=True, dual=dual)


def scale_of(system: NormalEquations, reference: ReferenceLength, *, field: np.ndarray,
             plate: np.ndarray, half_width_m: float) -> float:
    """Return c for a map and a plate in their datum, m at the unit of position."""
    value = reference.relative_error * half_width_m
    if not reference.kind.of_plate:
        rows = _slope(system.grid.views.z_sites, system.known_sites, reference.kind)
        return value - float(np.real(rows.conj() @ field.ravel()))
    return float(np.real(np.vdot(scale_of_plate(system, reference), plate))) - value


def _slope(z: np.ndarray, known: np.ndarray, kind: ReferenceKind) -> np.ndarray:
    """Return the row of the slope of Gx on x, or Gy on y, over the known sites, (sites,)."""
    along, unit = (z.real, 1) if kind is ReferenceKind.STAGE_X else (z.imag, 1j)
    centred = np.where(known, along - along[known].mean(), 0.0)
    return (unit * centred / (centred**2).sum()).ravel()


NO_NOISE_M = 1e-100
"""Stands for zero noise; its square is still representable."""


@dataclass(frozen=True, eq=False)
class TermSpread:
    """Effect of the terms' coefficients on the map, for its covariance.

    Attributes
    ----------
    fields : complex array (sites, p)
        Map for a unit of each coefficient, in no particular datum.
    parameters : float array (size, p)
        The corresponding misalignments.
    covariance : float array (p, p)
        Of the coefficients, for unit noise of one grid reading.
    of_marks : float array (p,)
        Scale of the field added to the marks' means by a unit of each coefficient.
    turned : float array (K, p)
        Angular map for a unit of each coefficient, sign reversed, rad.
    """

    fields: np.ndarray
    parameters: np.ndarray
    covariance: np.ndarray
    of_marks: np.ndarray
    turned: np.ndarray


class FieldCovariance:
    """Covariance of the stage map G in its datum, for unit noise of one grid reading.

    Parameters
    ----------
    system : NormalEquations
        The measured plan.
    inverse : float array (size, size)
        Covariance of the misalignments for unit grid noise.
    scale : ScaleDatum, optional
        Sets the scale of the map; without it the map has none.
    sigma : float
        Noise of one grid reading, m, by which the reference's uncertainty is measured.
    terms : TermSpread, optional
        Terms of the model that were estimated with the map.
    """

    def __init__(self, system: NormalEquations, inverse: np.ndarray,
                 scale: ScaleDatum | None = None, sigma: float = 1.0,
                 terms: TermSpread | None = None) -> None:
        self.system, self.inverse = system, inverse
        if terms is None:
            terms = TermSpread(np.zeros((system.grid.n_sites, 0), dtype=complex),
                               np.zeros((system.size, 0)), np.zeros((0, 0)), np.zeros(0),
                               np.zeros((system.angular.n_lines, 0)))
        self.terms = terms
        self._of_marks = terms.of_marks * (scale is not None and scale.of_plate)
        self.scale, self._u2 = scale, 0.0
        if scale is not None:
            self._u2 = scale.variance + (scale.u_m / max(sigma, NO_NOISE_M)) ** 2
        n = 3 * system.grid.n_views
        self._p = inverse[:n, :n]

    def _raw(self, rows: np.ndarray) -> np.ndarray:
        """Return S times complex columns (sites, k)."""
        response = self.system.grid.response
        answer = self._p @ np.real(response.conj().T @ rows)
        of_terms = self.terms.covariance @ np.real(self.terms.fields.conj().T @ rows)
        return (self.system.grid.factor.solve(np.ascontiguousarray(rows)) + response @ answer
                + self.terms.fields @ of_terms)

    @cached_property
    def _datum(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        basis = self.system.gauge.orthonormal
        spread = self._raw(basis)
        return basis, spread, np.real(basis.conj().T @ spread)

    def project(self, rows: np.ndarray) -> np.ndarray:
        """Return functionals (sites, k) as acting on a map that is not in its datum."""
        return without_datum(self.system, rows)

    def _functionals(self, flat: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return functionals (sites, k) of G in its datum as those of the free unknowns.

        Of sites (sites, k), misalignments (3 views, k) and terms (p, k), and the scale, (k,).
        """
        out, grown = self.project(flat), np.zeros(flat.shape[1])
        if self.scale is not None:
            grown = np.real(self.system.grid.views.z_sites.ravel().conj() @ flat)
            out = out + self.scale.rows[:, None] * grown
        moved = np.zeros((len(self._p), len(grown)))
        if self.scale is not None:
            moved = np.outer(self.scale.parameters, grown)
        of_terms = np.real(self.terms.fields.conj().T @ out)
        of_terms += self.terms.parameters[:len(moved)].T @ moved + np.outer(self._of_marks, grown)
        return out, moved, of_terms, grown

    def of(self, rows: np.ndarray) -> np.ndarray:
        """Return the covariance (k, k) of functionals Re(conj(row) G), complex (k, nx, ny)."""
        out, moved, of_terms, grown = self._functionals(rows.reshape(len(rows), -1).T)
        answer = np.real(self.system.grid.response.conj().T @ out) - moved
        solved = self.system.grid.factor.solve(np.ascontiguousarray(out))
        cov = np.real(out.conj().T @ solved) + answer.T @ self._p @ answer
        cov += of_terms.T @ self.terms.covariance @ of_terms + self._u2 * np.outer(grown, grown)
        return (cov + cov.T) / 2

    def solved(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the covariance of functionals (sites, k) with the unknowns, for unit noise.

        With sites (sites, k), misalignments (3 views, k) and terms (p, k): what they make of the
        readings are the sensitivities of the functionals, times the weights.
        """
        grid = self.system.grid
        out, moved, of_terms, _ = self._functionals(rows)
        parameters = self._p @ (moved - np.real(grid.response.conj().T @ out))
        terms = -self.terms.covariance @ of_terms
        field = grid.factor.solve(np.ascontiguousarray(out)) - grid.response @ parameters
        return (field - self.terms.fields @ terms,
                parameters - self.terms.parameters[:len(moved)] @ terms, terms)

    def _of_scale(self, scale: ScaleDatum) -> tuple[np.ndarray, float]:
        """Return the covariance of the scale with G in its datum (sites,), and its variance."""
        grid, rows = self.system.grid, scale.rows
        answer = np.real(grid.response.conj().T @ rows) - scale.parameters
        solved = grid.factor.solve(rows)
        spread = solved + grid.response @ (self._p @ answer)
        basis = self.system.gauge.orthonormal
        variance = float(np.real(np.vdot(rows, solved)) + answer @ self._p @ answer) + self._u2
        terms, n = self.terms, len(answer)
        of_terms = np.real(terms.fields.conj().T @ rows) + terms.parameters[:n].T @ (
            scale.parameters) + self._of_marks
        spread = spread + terms.fields @ (terms.covariance @ of_terms)
        variance += float(of_terms @ terms.covariance @ of_terms)
        return spread - basis @ np.real(basis.conj().T @ spread), variance

    @property
    def scale_variance(self) -> float:
        """Variance of the scale set by the reference, at the unit of position."""
        return 0.0 if self.scale is None else self._of_scale(self.scale)[1]

    def maps_of_terms(self) -> np.ndarray:
        """Return the map for a unit of each coefficient in the datum, complex (sites, p)."""
        maps = self.project(self.terms.fields)
        if self.scale is None:
            return maps
        n = 3 * self.system.grid.n_views
        grown = np.real(self.scale.rows.conj() @ self.terms.fields) + (
            self.scale.parameters @ self.terms.parameters[:n]) + self._of_marks
        return maps + np.outer(self.system.grid.views.z_sites.ravel(), grown)

    def diagonal(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the variances of Gx and Gy at every site, (nx, ny) each; NaN if unknown."""
        grid = self.system.grid
        basis, spread, inner = self._datum
        out = []
        response = grid.response
        common = grid.factor.inverse_diagonal()
        with_scale, of_scale = (None, 0.0) if self.scale is None else self._of_scale(self.scale)
        for part in (np.real, np.imag):
            b, s, y = part(basis), part(spread), part(response)
            f = part(self.terms.fields)
            value = common + np.einsum("sa,sa->s", y @ self._p, y)
            value += np.einsum("sp,sp->s", f @ self.terms.covariance, f)
            value += np.einsum("sk,kl,sl->s", b, inner, b) - 2 * np.einsum("sk,sk->s", b, s)
            if with_scale is not None:
                z = part(grid.views.z_sites.ravel())
                value += 2 * z * part(with_scale) + z**2 * of_scale
            out.append(np.where(self.system.known_sites, np.maximum(value, 0.0).reshape(
                grid.views.shape), np.nan))
        return out[0], out[1]


def plates_of_terms(cover: FieldCovariance, columns: np.ndarray) -> np.ndarray:
    """Return the plate's map for a unit of each coefficient, complex (p, nx, ny), no datum."""
    grid, of_stage = cover.system.grid, cover.terms
    fields = of_stage.fields.T.reshape(-1, *grid.views.shape)
    parameters = of_stage.parameters[:3 * grid.n_views].T
    return np.array([grid.plate(*one)[0] for one in zip(columns, fields, parameters,
                                                        strict=True)])
