# SPDX-License-Identifier: Apache-2.0
"""The angular maps of stage and plate: their datum, and their variances in it.

The datum is zero mean, or Hu's four axis conditions (eqs. 9, 27). The four conditions fix one free
constant and test three differences. They must not bend the XY map, so they act on Gtheta alone,
with slopes and rotations from the readings.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import chdtrc

from selfcal_ros.errors import InputError
from selfcal_ros.estimation.datum.covariance import MapsCovariance
from selfcal_ros.estimation.normal.equations import NormalEquations
from selfcal_ros.estimation.normal.systems import Memo
from selfcal_ros.model.error_map import ThetaDatum, slope_rows
from selfcal_ros.model.readings import Sense

MISCLOSURE_LEVEL = 0.05
"""Level of the test of the three redundant axis conditions, which this datum claims to hold."""

CLOSED_RAD = 1e-12
"""Misclosure attributed to rounding, rad."""

BLOCK = 512
"""Number of lines computed at once."""


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

    @classmethod
    def none(cls, system: NormalEquations) -> "Conditions":
        """Return that of no datum."""
        lines, views = system.angular.n_lines, system.angular.n_views
        return cls(ThetaDatum.ZERO_MEAN, np.zeros((0, lines)),
                   np.zeros((0, *system.grid.views.shape)), np.zeros((lines, 0)),
                   np.zeros((views, 0)))


_of_system: Memo[tuple[ThetaDatum, Sense, float], Conditions] = Memo()


def conditions_for(system: NormalEquations, datum: ThetaDatum, sense: Sense,
                   half_width_m: float) -> Conditions:
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
    return _of_system.get(system, (datum, sense, half_width_m),
                          lambda: _conditions(system, datum, sense, half_width_m))


def _conditions(system: NormalEquations, datum: ThetaDatum, sense: Sense,
                half_width_m: float) -> Conditions:
    known, n_lines = system.known_lines, system.angular.n_lines
    flipped = sense is Sense.PLATE_MOVES
    if datum is ThetaDatum.XY_AXES and system.angular.n_views:
        if n_lines % 4:
            raise InputError("theta datum xy_axes", f"of {n_lines} lines, none lies on the y axis",
                             "use zero_mean")
        sites = system.known_sites[::-1, ::-1] if flipped else system.known_sites
        slopes = slope_rows(system.grid.views.z_sites * half_width_m, sites)
        lines = np.arange(4) * (n_lines // 4)
        rows = np.zeros((4, n_lines))
        rows[np.arange(4), lines] = 1.0
        if flipped:
            rows = -rows[:, -np.arange(n_lines) % n_lines]
            slopes = -slopes[:, ::-1, ::-1]
        _require_axes(sites, [bool(known[row != 0].all()) for row in rows])
        return _solve_conditions(system, rows, slopes)
    rows = np.atleast_2d(known / max(known.sum(), 1))
    return Conditions(ThetaDatum.ZERO_MEAN, rows,
                      np.zeros((1, *system.grid.views.shape), dtype=complex),
                      np.ones((n_lines, 1)), np.zeros((system.angular.n_views, 1)))


def _require_axes(known: np.ndarray, lines: list[bool]) -> None:
    """Raise InputError unless all four half axes and their lines are determined."""
    if not all(size % 2 for size in known.shape):
        raise InputError("theta datum xy_axes", f"no sites of {known.shape[0]} x {known.shape[1]} "
                         "lie on the axes", "use zero_mean, or odd numbers of sites")
    hx, hy = (size // 2 for size in known.shape)
    halves = (("+x", known[hx + 1:, hy]), ("+y", known[hx, hy + 1:]), ("-x", known[:hx, hy]),
              ("-y", known[hx, :hy]))
    for (name, half), line in zip(halves, lines, strict=True):
        what = ("has one site, which gives no slope" if len(half) < 2 else
                f"is known at {int(half.sum())} of {len(half)} sites" if not half.all() else
                "has no known angular line" if not line else "")
        if what:
            raise InputError("theta datum xy_axes", f"the half axis along {name} {what}",
                             "measure what is missing there, or use zero_mean")


def _solve_conditions(system: NormalEquations, rows: np.ndarray, slopes: np.ndarray) -> Conditions:
    """Return the least-squares response of the angular equations, given phi of the grid views."""
    angular = system.angular
    free = [v for v, i in enumerate(system.angular_index) if i not in system.grid_index]
    inverse = np.linalg.pinv(angular.schur[np.ix_(free, free)], hermitian=True)
    response = angular.response[:, free]
    spread = angular.solve(np.ascontiguousarray(rows.T))
    spread = spread + response @ (inverse @ (response.T @ rows.T))
    n, ones = len(rows), rows.sum(axis=1)
    border = np.zeros((n + 1, n + 1))
    border[:n, :n] = rows @ spread
    border[:n, n] = border[n, :n] = ones
    solved = np.linalg.pinv(border)[:, :n]
    gain = spread @ solved[:n] + solved[n]  # method eq. 3.8
    phi_gain = np.zeros((angular.n_views, n))
    phi_gain[free] = -inverse @ (response.T @ rows.T) @ solved[:n]
    return Conditions(ThetaDatum.XY_AXES, rows, slopes, gain, phi_gain)


def misclosure_test(misclosure: np.ndarray, covariance: np.ndarray) -> tuple[float, float]:
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
    contrasts = np.linalg.qr(np.column_stack([np.ones(n), np.eye(n)[:, 1:]]))[0][:, 1:].T
    contrast = contrasts @ misclosure
    spread = contrasts @ covariance @ contrasts.T + CLOSED_RAD**2 * np.eye(n - 1)
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
        self.cover, self.system, self.angular = cover, cover.system, cover.system.angular
        self._xy2, self._theta2 = sigma[0] ** 2, sigma[1] ** 2
        total = self.angular.weight.sum(axis=0)
        self._of_means = np.where(total > 0, self._theta2 / np.where(total > 0, total, 1.0), 0.0)

    @cached_property
    def terms(self) -> tuple[np.ndarray, np.ndarray]:
        """Free angular maps of stage and plate for a unit of each coefficient, (K, p)."""
        terms, field = self.cover.terms, -self.cover.terms.turned
        phi = terms.parameters[self.system.phi_at] / self.cover.length
        return field, self._plate(np.moveaxis(terms.lines, 0, -1), field, phi)

    def of_stage(self, conditions: Conditions) -> tuple[np.ndarray, np.ndarray]:
        """Return the variance of Gtheta (K,) in its datum and the covariance of the misclosure."""
        rows = conditions.rows.T
        misclosure = -rows, np.zeros(rows.shape), self.cover.functionals(conditions.slopes)
        closure, y, n = self.of(*misclosure), self.angular.response, self.angular.n_lines
        inverse = np.concatenate([self.angular.solve(np.eye(n, len(here), -here[0]))[
            here, here - here[0]] for here in self._blocks()])
        phi = self.cover.inverse[np.ix_(self.system.phi_at, self.system.phi_at)] * (
            self._xy2 / self.cover.length**2)
        own = self._theta2 * inverse + np.einsum("ka,ab,kb->k", y, phi, y)
        own += np.einsum("kp,pq,kq->k", self.terms[0], self._of_terms, self.terms[0])
        spread = self._spread(*misclosure)[0]
        variance = own + _by(conditions.gain, closure, spread)
        return np.where(self.system.known_lines, np.maximum(variance, 0.0), np.nan), closure

    def of_plate(self) -> np.ndarray:
        """Return the variance of the plate's angular map, (K,), in the datum `zero_mean`.

        The rotations of the views are those for which neither stage nor plate is turned.
        """
        system, angular, count = self.system, self.angular, self.angular.n_lines
        of_sites, of_marks = (-gauge.dual(2).reshape(-1, 1) / self.cover.length
                              for gauge in (system.gauge, system.plate_gauge))
        datum = ((system.known_lines / system.known_lines.sum())[:, None], np.zeros((count, 1)),
                 (of_sites, of_marks))
        own = np.zeros(count)
        for here in self._blocks():
            one = np.eye(count, len(here), -here[0])
            rows, factors, of_terms, _ = self._free(0 * one, one)
            own[here] = self._theta2 * np.einsum("kl,kl->l", rows, angular.solve(rows))
            own[here] += self._xy2 * np.einsum("vl,vw,wl->l", factors, self.cover.inverse, factors)
            own[here] += np.einsum("pl,pq,ql->l", of_terms, self._of_terms, of_terms)
        variance = own + self._of_means + _by(np.ones((count, 1)), self.of(*datum),
                                              self._spread(*datum)[1])
        return np.where(system.known_plate_lines, variance, np.nan)

    def of(self, stage: np.ndarray, plate: np.ndarray,
           maps: tuple[np.ndarray, np.ndarray] | None = None) -> np.ndarray:
        """Return the covariance of functionals of the free maps, (k, k).

        Parameters
        ----------
        stage, plate : float array (K, k)
            Factors of both angular maps.
        maps : tuple of complex array (sites, k) and (marks, k), optional
            Factors of both XY maps in addition, 1/m.
        """
        rows, factors, of_terms, cov = self._free(stage, plate, maps)
        cov = cov + self._theta2 * (rows.T @ self.angular.solve(np.ascontiguousarray(rows)))
        cov += (plate.T * self._of_means) @ plate
        cov += self._xy2 * (factors.T @ self.cover.inverse @ factors)
        cov += of_terms.T @ self._of_terms @ of_terms
        return (cov + cov.T) / 2

    def _free(self, stage: np.ndarray, plate: np.ndarray,
              maps: tuple[np.ndarray, np.ndarray] | None = None) -> tuple[np.ndarray, ...]:
        """Return functionals as those of stage lines, misalignments, 1/m, and terms.

        And the covariance of the part that is of sites and marks alone, (k, k), rad^2.
        """
        angular, share = self.angular, self.angular.relative_weight
        rows, read = stage.copy(), np.flatnonzero(plate.any(axis=1))
        for view in range(angular.n_views):
            rows -= angular.rows(view, read).T @ (share[view, read, None] * plate[read])
        factors = np.zeros((self.system.size, rows.shape[1]))
        factors[self.system.phi_at] = -(angular.response.T @ rows + share @ plate)
        factors /= self.cover.length
        of_terms = self.terms[0].T @ stage + self.terms[1].T @ plate
        if maps is None:
            return rows, factors, of_terms, np.zeros((rows.shape[1],) * 2)
        noise, of_maps, terms_of_maps = self.cover.independent(*maps)
        factors[:len(of_maps)] += of_maps
        return rows, factors, of_terms + terms_of_maps, self._xy2 * noise

    def _spread(self, stage: np.ndarray, plate: np.ndarray,
                maps: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Return the covariance of functionals with both free maps, (K, k) each."""
        rows, factors, of_terms, _ = self._free(stage, plate, maps)
        moved = self._of_terms @ of_terms
        phi = self._xy2 / self.cover.length * (self.cover.inverse @ factors)[self.system.phi_at]
        field = self._theta2 * self.angular.solve(np.ascontiguousarray(rows))
        field -= self.angular.response @ phi
        of_plate = self._plate(np.zeros(1), field, phi) + self._of_means[:, None] * plate
        return field + self.terms[0] @ moved, of_plate + self.terms[1] @ moved

    def _plate(self, y: np.ndarray, field: np.ndarray, phi: np.ndarray) -> np.ndarray:
        """Return what readings, maps (K, k) and rotations (views, k) make of the plate."""
        left = y - self.angular.gather(field) - phi[:, None]
        return np.einsum("vk,vkp->kp", self.angular.relative_weight, left)

    @property
    def _of_terms(self) -> np.ndarray:
        """Covariance of the coefficients of the terms, (p, p)."""
        return self.cover.terms.covariance * self._xy2

    def _blocks(self) -> list[np.ndarray]:
        n = self.angular.n_lines
        return [np.arange(start, min(start + BLOCK, n)) for start in range(0, n, BLOCK)]


def _by(fields: np.ndarray, inner: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """Return what fields (K, k) times functionals add to the variances of a free map, (K,)."""
    return np.einsum("kc,kc->k", fields @ inner + 2 * spread, fields)


def lines_alone(system: NormalEquations) -> LinesCovariance:
    """Return the covariance for unit noise of the lines, rotations of grid views taken as known.

    The grid determines them thousands of times better than the lines.
    """
    angular, inverse = system.angular, np.zeros((system.size, system.size))
    free = [v for v, i in enumerate(system.angular_index) if i not in system.grid_index]
    at = system.phi_at[free]
    inverse[np.ix_(at, at)] = np.linalg.pinv(angular.schur[np.ix_(free, free)], hermitian=True)
    return LinesCovariance(MapsCovariance(system, inverse), (1.0, 1.0))
