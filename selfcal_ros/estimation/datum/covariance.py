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
That gives the variance of every site; and of every mark: by the readings alone that of its mean
noise, and that of the mean of the stage at its sites (method eq. 4.13).

The datum of the angular maps is zero mean, or Hu's four axis conditions (eqs. 9, 27). The four
conditions fix one free constant and test three differences. They must not bend the XY map, so they
act on Gtheta alone, with slopes and rotations from the readings.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import chdtrc

from selfcal_ros.errors import InputError
from selfcal_ros.estimation.checks.wiring import LEAST_NOISE_M
from selfcal_ros.estimation.lattice.connectivity import Gauge
from selfcal_ros.estimation.normal.equations import BLOCK, NormalEquations, in_datum
from selfcal_ros.estimation.terms.equations import TermEquations
from selfcal_ros.model.error_map import ThetaDatum, slope_rows
from selfcal_ros.model.readings import Sense, lines_turned_over, turned_over
from selfcal_ros.model.reference import ReferenceKind, ReferenceLength

NO_NOISE = float(np.sqrt(np.finfo(float).tiny))
"""Noise that stands for none: its square is still a number."""


def scale_of(
    system: NormalEquations,
    reference: ReferenceLength,
    *,
    field: np.ndarray,
    plate: np.ndarray,
    half_width_m: float,
) -> float:
    """Return c for a map and a plate in their datum, m at the unit of position."""
    sites, marks = scale_rows(system, reference)
    value = (
        reference.relative_error * half_width_m * (-1 if reference.kind.of_plate else 1)
    )
    return value + float(np.real(np.vdot(sites, field) + np.vdot(marks, plate)))


def scale_rows(
    system: NormalEquations, reference: ReferenceLength
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
    z = system.grid.views.z
    known_marks = system.known_marks
    if reference.marks is None:
        return Gauge(z, known_marks, scale=True).dual(3)
    first, second = (system.grid.views.index_of(*mark) for mark in reference.marks)
    for mark, index in zip(reference.marks, (first, second), strict=True):
        if not known_marks[index]:
            raise InputError(
                "reference length",
                f"the mark {mark} was not measured",
                "measure it, or take another reference",
            )
    apart = z[second] - z[first]
    row = np.zeros(z.shape, dtype=complex)
    row[second], row[first] = (sign * apart / abs(apart) ** 2 for sign in (1, -1))
    return row


def _slope(system: NormalEquations, kind: ReferenceKind) -> np.ndarray:
    """Return the row of the slope of Gx on x, or Gy on y, over the known sites, (sites,)."""
    z = system.grid.views.z_sites
    known_sites = system.known_sites
    along, unit = (z.real, 1) if kind is ReferenceKind.STAGE_X else (z.imag, 1j)
    centred = np.where(known_sites, along - along[known_sites].mean(), 0.0)
    return (unit * centred / (centred**2).sum()).ravel()


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
        Noise of one grid reading, by which the reference's uncertainty and the sizes of terms are
        measured.
    terms : TermEquations, optional
        Equations of the terms that were estimated with the maps.

    Attributes
    ----------
    fields : complex array (sites, p)
        Map for a unit of each coefficient of the terms, in no particular datum.
    plates : complex array (marks, p)
        The corresponding map of the plate.
    covariance_of_terms : float array (p, p)
        Of the coefficients.
    """

    def __init__(
        self,
        system: NormalEquations,
        inverse: np.ndarray,
        reference: ReferenceLength | None = None,
        *,
        half_width_m: float = 1.0,
        sigma_m: float = 1.0,
        terms: TermEquations | None = None,
    ) -> None:
        self.system, self.inverse, self.length = system, inverse, half_width_m
        self.terms, n = terms, 3 * system.grid.n_views
        self._p = inverse[:n, :n]
        self.fields = np.zeros((system.grid.n_sites, 0))
        self.plates = np.zeros((system.grid.n_marks, 0))
        self.covariance_of_terms = np.zeros((0, 0))
        if terms is not None:
            self.fields, self.plates = terms.projected.fields, terms.plates
            self.covariance_of_terms = terms.inverse(sigma_m)
        self._scale = None if reference is None else scale_rows(system, reference)
        self._u = (
            0.0
            if reference is None
            else (reference.u_relative * half_width_m / max(sigma_m, NO_NOISE))
        )

    def of(self, sites: np.ndarray, marks: np.ndarray | None = None) -> np.ndarray:
        """Return the covariance (k, k) of functionals Re(conj(sites) G + conj(marks) A).

        Parameters
        ----------
        sites : complex array (k, nx, ny)
            Factors of the stage's map, frame of the equations.
        marks : complex array (k, nx, ny), optional
            Factors of the plate's map.
        """
        g, a, grown = self.functionals(sites, marks)
        return self.of_free(g, a) + np.outer(grown, grown) * self._u**2

    def of_free(self, g: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the covariance of functionals (sites, k), (marks, k) of the free maps, (k, k)."""
        cov, factors, of_terms = self.independent(g, a)
        cov += (
            factors.T @ self._p @ factors
            + of_terms.T @ self.covariance_of_terms @ of_terms
        )
        return (cov + cov.T) / 2

    def independent(self, g: np.ndarray, a: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return functionals (sites, k), (marks, k) of free maps by what is independent.

        The covariance of the part that is of sites and marks alone, (k, k), and the factors of
        the misalignments, (3 views, k), and of the terms, (p, k).
        """
        grid = self.system.grid
        of_terms = self.of_terms(g, a)
        cov = np.real(a.conj().T @ (grid.noise_of_means[:, None] * a))
        g, misalignments = grid.functionals(g, a)
        cov += np.real(g.conj().T @ grid.solve(g))
        return cov, misalignments, of_terms

    def sensitivities(
        self, sites: np.ndarray, marks: np.ndarray | None = None
    ) -> np.ndarray:
        """Return those of functionals as in `of` to the readings, over their weights, plate frame.

        Complex (k, views, nx, ny).
        """
        grid = self.system.grid
        g, a, _ = self.functionals(sites, marks)
        field, parameters, of_terms = self._solved(g, a)
        y = np.zeros((1, *grid.weight.shape))
        if self.terms is not None:
            y = np.tensordot(of_terms.T, self.terms.columns.grid, axes=1)
            moved = self.terms.projected.parameters[: len(self._p)]
            parameters = parameters - moved @ of_terms
        maps = (field - self.fields @ of_terms).T.reshape(-1, *grid.views.shape)
        residuals = grid.plate(-y, maps, parameters.T)[1]
        of_mark = (grid.noise_of_means[:, None] * a).T.reshape(
            -1, 1, *grid.views.plate_shape
        )
        return np.where(grid.read, of_mark, 0) - residuals

    def variance_of_scale(self, reference: ReferenceLength) -> float:
        """Return the variance of the scale that an exact reference would set, at the unit."""
        return float(
            self.of_free(*self._free(*scale_rows(self.system, reference)))[0, 0]
        )

    @cached_property
    def of_stage(self) -> np.ndarray:
        """Variances of Gx and Gy at every site, (2, nx, ny); NaN if unknown."""
        return self._of_map(plate=False)

    @cached_property
    def of_plate(self) -> np.ndarray:
        """Variances of Ax and Ay at every mark, (2, nx, ny); NaN if unknown."""
        return self._of_map(plate=True)

    def maps_of_terms(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the maps for a unit of each coefficient in the datum, (sites, p), (marks, p)."""
        out = []
        for fields_of_terms, plate, is_known in (
            (self.fields, False, self.system.known_sites),
            (self.plates, True, self.system.known_marks),
        ):
            fields, g, a = self._datum(plate=plate)
            of_coefficients = fields_of_terms + fields @ self.of_terms(g, a).T
            out.append(np.where(is_known.reshape(-1, 1), of_coefficients, 0.0))
        return out[0], out[1]

    def of_terms(self, g: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return functionals (sites, k), (marks, k) of free maps of the terms, (p, k)."""
        return np.real(self.fields.conj().T @ g) + np.real(self.plates.conj().T @ a)

    def functionals(
        self, sites: np.ndarray, marks: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return functionals (k, nx, ny) of the maps as those of free maps, (sites, k), (marks, k).

        And the share of the reference's length in each, (k,).
        """
        count = len(sites)
        views = self.system.grid.views
        g = sites.reshape(count, -1).T
        grown = np.zeros(count)
        a = (
            np.zeros((views.z.size, count))
            if marks is None
            else marks.reshape(count, -1).T
        )
        if self._scale is not None:
            grown = np.real(
                views.z_sites.reshape(-1).conj() @ g - views.z.reshape(-1).conj() @ a
            )
            g, a = (
                rows + scale * grown
                for rows, scale in zip((g, a), self._scale, strict=True)
            )
        return *self._free(g, a), grown

    def _free(self, g: np.ndarray, a: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return functionals (sites, k), (marks, k) of maps without scale as those of free maps."""
        system = self.system
        a, g = system.plate_gauge.without(a), system.gauge.without(g)
        # what the datum takes off the stage as its scale, the plate has
        grown = np.real(system.grid.views.z.reshape(-1).conj() @ a)
        return g + np.outer(system.gauge.dual(3).reshape(-1), grown), a

    def _datum(self, *, plate: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return what leads from a free map into its datum: fields, and functionals of both maps.

        The map is the free one plus each field (places, k) times its functional of the free maps,
        (sites, k) and (marks, k).
        """
        system = self.system
        views = self.system.grid.views
        if plate:
            z = views.z.reshape(-1)
            basis = system.plate_gauge.orthonormal
            fields = np.column_stack([-basis, system.plate_gauge.without(z)])
            g = np.column_stack(
                [
                    np.zeros((views.z_sites.size, basis.shape[1])),
                    system.gauge.dual(3).reshape(-1),
                ]
            )
            a = np.column_stack([basis, np.zeros(len(z))])
        else:
            z = -views.z_sites.reshape(-1)
            g = system.gauge.orthonormal
            fields = -g
            a = np.zeros((views.z.size, g.shape[1]))
        if self._scale is not None:
            fields, g, a = (
                np.column_stack(pair)
                for pair in zip(
                    (fields, g, a), (-z, *self._free(*self._scale)), strict=True
                )
            )
        return fields, g, a

    def _solved(
        self, g: np.ndarray, a: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the covariance of functionals of free maps with the unknowns, for unit noise.

        With sites (sites, k) and misalignments (3 views, k), each without terms, and terms (p, k).
        """
        grid = self.system.grid
        of_coefficients = -self.covariance_of_terms @ self.of_terms(g, a)
        g, misalignments = grid.functionals(g, a)
        parameters = self._p @ misalignments
        return grid.solve(g) - grid.response @ parameters, parameters, of_coefficients

    def _of_map(self, *, plate: bool) -> np.ndarray:
        """Return the variances of a map in its datum, (2, nx, ny); NaN if unknown."""
        grid = self.system.grid
        z, known_places = grid.views.z_sites, self.system.known_sites
        own_variance = grid.variance_of_sites  # first: it needs much memory for a while
        fields, g, a = self._datum(plate=plate)
        field, parameters, of_coefficients = self._solved(g, a)
        answer = grid.response
        of_terms = self.fields
        if plate:
            noise = grid.noise_of_means
            field = self._plates(field, parameters) + noise[:, None] * a
            own_variance = noise + grid.variance_of_means
            of_terms = self.plates
            answer = self._plates(-answer, np.eye(len(self._p)))
            z, known_places = grid.views.z, self.system.known_marks
        variance = in_datum(
            own_variance,
            ((answer, self._p), (of_terms, self.covariance_of_terms)),
            field - of_terms @ of_coefficients,
            fields,
            self.of_free(g, a),
        )
        of_length = (np.stack([z.real, z.imag]) * self._u) ** 2
        return np.where(known_places, variance.reshape(2, *z.shape) + of_length, np.nan)

    def _plates(self, fields: np.ndarray, parameters: np.ndarray) -> np.ndarray:
        """Return what maps (sites, k) and misalignments (3 views, k) make of the plate."""
        grid = self.system.grid
        maps = fields.T.reshape(-1, *grid.views.shape)
        plates = grid.plate(np.zeros(grid.weight.shape), maps, parameters.T)[0]
        return plates.reshape(len(maps), -1).T


USUAL_LEVEL = 0.05
"""Level of a test of two statements against each other, of maps, runs, or axes and their datum:
as often as that an interval of k = 2 misses."""


@dataclass(frozen=True, eq=False)
class Conditions:
    """Linear conditions on the angular map and the map's response to them.

    In the frame of the equations: with ``plate_moves`` the solved fields are H(X) = -G(-X).

    Attributes
    ----------
    datum : ThetaDatum
        The convention.
    rows : float array (conditions, K)
        rows @ Gtheta = slopes @ G.
    slopes : complex array (conditions, nx, ny)
        Slopes of the XY error, 1 / length; real inner product. Zero for ``zero_mean``.
    gain : float array (K, conditions)
        Change of Gtheta for a unit misclosure.
    phi_gain : float array (views, conditions)
        Change of phi of the angular views without grid readings.
    """

    datum: ThetaDatum
    rows: np.ndarray
    slopes: np.ndarray
    gain: np.ndarray
    phi_gain: np.ndarray


def conditions_for(
    system: NormalEquations, datum: ThetaDatum, sense: Sense, half_width_m: float
) -> Conditions:
    """Return the conditions of a datum for the measured plan.

    Parameters
    ----------
    system : NormalEquations
        The measured plan.
    datum : ThetaDatum
        The requested convention.
    sense : Sense
        What moves.
    half_width_m : float
        Length of the unit of the system's positions, m.

    Raises
    ------
    InputError
        For ``xy_axes`` if a half axis has no sites or no line, or is not completely determined.
    """
    known_lines = system.known_lines
    n_lines = system.angular.n_lines
    if datum is ThetaDatum.XY_AXES and system.angular.n_views:
        if n_lines % 4:
            raise InputError(
                "theta datum xy_axes",
                f"of {n_lines} lines, none lies on the y axis",
                "use zero_mean",
            )
        sites = turned_over(sense, system.known_sites, sign=1)
        slopes = turned_over(
            sense, slope_rows(system.grid.views.z_sites * half_width_m, sites)
        )
        rows = lines_turned_over(sense, np.eye(n_lines)[:, :: n_lines // 4]).T
        _require_axes(sites, [bool(known_lines[row != 0].all()) for row in rows])
        return _solve_conditions(system, rows, slopes)
    rows = np.atleast_2d(known_lines / max(known_lines.sum(), 1))
    return Conditions(
        ThetaDatum.ZERO_MEAN,
        rows,
        np.zeros((1, *system.grid.views.shape), dtype=complex),
        np.ones((n_lines, 1)),
        np.zeros((system.angular.n_views, 1)),
    )


def _require_axes(known_sites: np.ndarray, lines: list[bool]) -> None:
    """Raise InputError unless all four half axes and their lines are determined."""
    if not all(size % 2 for size in known_sites.shape):
        raise InputError(
            "theta datum xy_axes",
            f"no sites of {known_sites.shape[0]} x {known_sites.shape[1]} lie on the axes",
            "use zero_mean, or odd numbers of sites",
        )
    hx, hy = (size // 2 for size in known_sites.shape)
    halves = (
        ("+x", known_sites[hx + 1 :, hy]),
        ("+y", known_sites[hx, hy + 1 :]),
        ("-x", known_sites[:hx, hy]),
        ("-y", known_sites[hx, :hy]),
    )
    for (name, half), line in zip(halves, lines, strict=True):
        fault = (
            "has one site, which gives no slope"
            if len(half) < 2
            else f"is known at {int(half.sum())} of {len(half)} sites"
            if not half.all()
            else "has no known angular line"
            if not line
            else ""
        )
        if fault:
            raise InputError(
                "theta datum xy_axes",
                f"the half axis along {name} {fault}",
                "measure what is missing there, or use zero_mean",
            )


def _solve_conditions(
    system: NormalEquations, rows: np.ndarray, slopes: np.ndarray
) -> Conditions:
    """Return the least-squares response of the angular equations, given phi of the grid views."""
    angular = system.angular
    free, inverse = _free_rotations(system)
    response = angular.response[:, free]
    spread = angular.solve(rows.T)
    spread = spread + response @ (inverse @ (response.T @ rows.T))
    n = len(rows)
    ones = rows.sum(axis=1)
    border = np.zeros((n + 1, n + 1))
    border[:n, :n] = rows @ spread
    border[:n, n] = border[n, :n] = ones
    solved = np.linalg.pinv(border)[:, :n]
    gain = spread @ solved[:n] + solved[n]  # method eq. 3.8
    phi_gain = np.zeros((angular.n_views, n))
    phi_gain[free] = -inverse @ (response.T @ rows.T) @ solved[:n]
    return Conditions(ThetaDatum.XY_AXES, rows, slopes, gain, phi_gain)


def _free_rotations(system: NormalEquations) -> tuple[list[int], np.ndarray]:
    """Return the views of lines alone, and the covariance of their rotations, unit noise."""
    free = [v for v, i in enumerate(system.angular_index) if i not in system.grid_index]
    information = system.angular.schur[np.ix_(free, free)]
    return free, np.linalg.pinv(information, hermitian=True)


def misclosure_test(
    misclosure: np.ndarray, covariance: np.ndarray
) -> tuple[float, float]:
    """Return probability and size (rad) of the misclosure of the redundant axis conditions.

    Parameters
    ----------
    misclosure : float array (conditions,)
        Slopes minus Gtheta at the axes, up to one common constant, rad.
    covariance : float array (conditions, conditions)
        Its covariance, rad^2.

    Returns
    -------
    p, size_rad : float
        Probability of such a misclosure if the conditions hold; its largest contrast. The
        probability is 1 if there is nothing to test.
    """
    n = len(misclosure)
    if n < 2:
        return 1.0, 0.0
    contrasts = np.linalg.qr(np.column_stack([np.ones(n), np.eye(n)[:, 1:]]))[0][
        :, 1:
    ].T
    contrast = contrasts @ misclosure
    spread = contrasts @ covariance @ contrasts.T + LEAST_NOISE_M**2 * np.eye(n - 1)
    value = float(contrast @ np.linalg.solve(spread, contrast))
    return float(chdtrc(n - 1, value)), float(np.abs(contrast).max())


class LinesCovariance:
    """Covariance of both angular maps, rad^2 (method eq. 4.9).

    As of the XY maps: a map in its datum is the free one and a few fields times functionals.

    Parameters
    ----------
    cover : MapsCovariance
        That of the XY maps.
    sigma : tuple of float
        Noise of one grid reading, m, and of one angular reading, rad.
    """

    def __init__(self, cover: MapsCovariance, sigma: tuple[float, float]) -> None:
        self.cover, self.system, self.angular = (
            cover,
            cover.system,
            cover.system.angular,
        )
        self._xy2, self._theta2 = sigma[0] ** 2, sigma[1] ** 2
        self._of_means = self._theta2 * self.angular.noise_of_means

    @cached_property
    def terms(self) -> tuple[np.ndarray, np.ndarray]:
        """Free angular maps of stage and plate for a unit of each coefficient, (K, p)."""
        terms = self.cover.terms
        if terms is None:
            none = np.zeros((self.angular.n_lines, 0))
            return none, none
        lines = terms.columns.lines
        plates = terms.projected.of_lines(self.system, lines, self.cover.length)[0]
        return -terms.projected.turned, plates.T

    def stage_of_terms(self, conditions: Conditions) -> np.ndarray:
        """Return Gtheta in its datum for a unit of each coefficient, (K, p)."""
        free = self.terms[0]
        slopes = self.cover.of_terms(*self.cover.functionals(conditions.slopes)[:2]).T
        return free + conditions.gain @ (slopes - conditions.rows @ free)

    def of_stage(self, conditions: Conditions) -> tuple[np.ndarray, np.ndarray]:
        """Return the variance of Gtheta (K,) in its datum and the covariance of the misclosure."""
        rows = conditions.rows.T
        no_plate = np.zeros_like(rows)
        slopes = self.cover.independent(*self.cover.functionals(conditions.slopes)[:2])
        closure = self.of(-rows, no_plate, slopes)
        gain = conditions.gain.T
        stage = np.eye(len(rows)) - rows @ gain
        variance = self._variances(stage, no_plate @ gain, slopes, gain)
        return np.where(self.system.known_lines, variance, np.nan), closure

    def of_plate(self) -> np.ndarray:
        """Return the variance of the plate's angular map, (K,), in the datum `zero_mean`.

        The rotations of the views are those for which neither stage nor plate is turned.
        """
        system = self.system
        turns = self.cover.independent(
            *(
                -gauge.dual(2).reshape(-1, 1) / self.cover.length
                for gauge in (system.gauge, system.plate_gauge)
            )
        )
        count = self.angular.n_lines
        everywhere = np.ones((1, count))
        mean = (system.known_lines / system.known_lines.sum())[:, None]
        variance = self._variances(mean * everywhere, np.eye(count), turns, everywhere)
        return np.where(system.known_plate_lines, variance, np.nan)

    def _variances(
        self,
        stage: np.ndarray,
        plate: np.ndarray,
        maps: tuple[np.ndarray, ...],
        share: np.ndarray,
    ) -> np.ndarray:
        """Return the variances of functionals of the free maps, (K,).

        Parameters
        ----------
        stage, plate : float array (K, K)
            Factors of both angular maps.
        maps : tuple of arrays
            A few functionals of both XY maps, 1/m, by what is independent.
        share : float array (k, K)
            Share of each of the few in every functional.
        """
        noise, misalignments, of_terms = maps
        variances = []
        for start in range(0, self.angular.n_lines, BLOCK):
            block = slice(start, start + BLOCK)
            part = share[:, block]
            shared = part.T @ noise @ part, misalignments @ part, of_terms @ part
            variances += list(
                self.of(stage[:, block], plate[:, block], shared).diagonal()
            )
        return np.maximum(variances, 0.0)

    def of(
        self,
        stage: np.ndarray,
        plate: np.ndarray,
        maps: tuple[np.ndarray, ...] | None = None,
    ) -> np.ndarray:
        """Return the covariance of functionals of the free maps, (k, k).

        Parameters
        ----------
        stage, plate : float array (K, k)
            Factors of both angular maps.
        maps : tuple of arrays, optional
            Functionals of both XY maps in addition, 1/m, by what is independent.
        """
        rows, of_rotations = self.angular.functionals(stage, plate)
        factors = np.zeros((self.system.size, rows.shape[1]))
        factors[self.system.phi_at] = of_rotations / self.cover.length
        of_terms = self.terms[0].T @ stage + self.terms[1].T @ plate
        cov = self._theta2 * (rows.T @ self.angular.solve(rows))
        cov += (plate.T * self._of_means) @ plate
        if maps is not None:
            noise, of_maps, terms_of_maps = maps
            cov += self._xy2 * noise
            factors[: len(of_maps)] += of_maps
            of_terms = of_terms + terms_of_maps
        cov += self._xy2 * (factors.T @ self.cover.inverse @ factors)
        cov += self._xy2 * (of_terms.T @ self.cover.covariance_of_terms @ of_terms)
        return (cov + cov.T) / 2


def lines_alone(system: NormalEquations) -> LinesCovariance:
    """Return the covariance for unit noise of the lines, rotations of grid views taken as known.

    The grid determines them thousands of times better than the lines.
    """
    inverse = np.zeros((system.size, system.size))
    free, of_free = _free_rotations(system)
    at = system.phi_at[free]
    inverse[np.ix_(at, at)] = of_free
    return LinesCovariance(MapsCovariance(system, inverse), (1.0, 1.0))
