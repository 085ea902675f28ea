# SPDX-License-Identifier: Apache-2.0
"""The angular maps of stage and plate: their datum, and their variances in it.

The datum is zero mean, or Hu's four axis conditions (eqs. 9, 27). The four conditions fix one free
constant and test three differences. They must not bend the XY map, so they act on Gtheta alone,
with slopes and rotations from the readings.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from selfcal_ros.errors import InputError
from selfcal_ros.estimation.datum.covariance import (
    FieldCovariance,
    plates_of_terms,
    scale_by_plate,
)
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
        For ``xy_axes`` if a half axis is not completely determined, or has no line.
    """
    return _of_system.get(system, (datum, sense, half_width_m),
                          lambda: _conditions(system, datum, sense, half_width_m))


def _conditions(system: NormalEquations, datum: ThetaDatum, sense: Sense,
                half_width_m: float) -> Conditions:
    known, n_lines = system.known_lines, system.angular.n_lines
    flipped = sense is Sense.PLATE_MOVES
    if datum is ThetaDatum.XY_AXES and system.angular.n_views:
        if n_lines % 4:
            raise InputError("theta datum xy_axes", f"of {n_lines} lines none lies on the y axis",
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
    hx, hy = (size // 2 for size in known.shape)
    halves = (("+x", known[hx + 1:, hy]), ("+y", known[hx, hy + 1:]), ("-x", known[:hx, hy]),
              ("-y", known[hx, :hy]))
    for (name, half), line in zip(halves, lines, strict=True):
        what = ("has one site and no slope" if len(half) < 2 else
                f"is known at {int(half.sum())} of {len(half)} sites" if not half.all() else
                "has no known angular line" if not line else "")
        if what:
            raise InputError("theta datum xy_axes", f"the half axis along {name} {what}",
                             "read what is missing there, or use zero_mean")


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


def angular_variance(field: FieldCovariance, conditions: Conditions, *,
                     sigma: tuple[float, float], half_width_m: float
                     ) -> tuple[np.ndarray, np.ndarray]:
    """Return the variance of Gtheta (K,) in its datum and the covariance of the misclosure.

    Parameters
    ----------
    field : FieldCovariance
        Covariance of the XY map.
    conditions : Conditions
        The angular datum.
    sigma : tuple of float
        Noise of one grid reading, m, and of one angular reading, rad.
    half_width_m : float
        Length of the unit of the system's positions, m.
    """
    system, (sigma_xy, sigma_theta) = field.system, sigma
    angular, rows, gain = system.angular, conditions.rows, conditions.gain
    per_phi = sigma_xy**2 / half_width_m**2
    p_phi = field.inverse[np.ix_(system.phi_at, system.phi_at)] * per_phi
    y = angular.response

    columns = angular.solve(np.ascontiguousarray(rows.T)) * sigma_theta**2
    columns = columns + y @ (p_phi @ (y.T @ rows.T))
    variance = sigma_theta**2 * _inverse_diagonal(system) + np.einsum("ka,ab,kb->k", y, p_phi, y)

    flat = field.project(conditions.slopes.reshape(len(rows), -1).T)
    n = 3 * system.grid.n_views
    answer = np.real(system.grid.response.conj().T @ flat) * sigma_xy**2 / half_width_m
    with_slopes = y @ (field.inverse[np.ix_(system.phi_at, np.arange(n))] @ answer)
    of_slopes = field.of(conditions.slopes) * sigma_xy**2

    turned = field.terms.turned
    cover = field.terms.covariance * sigma_xy**2
    sloped = np.real(flat.conj().T @ field.terms.fields)
    columns = columns + turned @ (cover @ (rows @ turned).T)
    variance += np.einsum("kp,kp->k", turned @ cover, turned)
    with_slopes = with_slopes - turned @ (cover @ sloped.T)
    cross = rows @ with_slopes
    closure = of_slopes + rows @ columns - cross - cross.T
    both = with_slopes - columns
    variance = variance + np.einsum("kc,cd,kd->k", gain, closure, gain)
    variance = variance + 2 * np.einsum("kc,kc->k", gain, both)
    return np.where(system.known_lines, np.maximum(variance, 0.0), np.nan), closure


def _inverse_diagonal(system: NormalEquations) -> np.ndarray:
    n = system.angular.n_lines
    units = (np.eye(n, min(BLOCK, n - start), -start) for start in range(0, n, BLOCK))
    return np.concatenate([(unit * system.angular.solve(unit)).sum(axis=0) for unit in units])


def angular_plate_variance(cover: FieldCovariance, *, columns: np.ndarray,
                           lines: tuple[np.ndarray, np.ndarray], sigma: tuple[float, float],
                           half_width_m: float) -> np.ndarray:
    """Return the variance of the plate's angular map, (K,), rad^2, in the datum `zero_mean`.

    The rotations of the views are those for which neither stage nor plate is turned.

    Parameters
    ----------
    cover : FieldCovariance
        Covariance of the stage's map.
    columns : complex array (p, views, nx, ny)
        Columns of the terms of `cover` at the marks, plate frame.
    lines : tuple of array
        Indices of the terms that act on lines, (q,), and their columns (q, views, K), rad.
    sigma : tuple of float
        Noise of one grid reading, m, and of one angular reading, rad.
    half_width_m : float
        Unit of the positions, m.
    """
    system, (sigma_xy, sigma_theta) = cover.system, sigma
    angular, share = system.angular, system.angular.relative_weight
    known, count = system.known_lines, system.angular.n_lines
    noise = (sigma_xy / half_width_m) ** 2
    dual = system.plate_gauge.dual(2)
    turn, n = scale_by_plate(system, dual, mode=2), 3 * system.grid.n_views
    turned = np.zeros(system.size)
    turned[:n] = np.real(system.grid.response.conj().T @ turn.rows) - turn.parameters
    total = noise * (turn.variance + float(np.real(
        np.vdot(turn.rows, system.grid.factor.solve(turn.rows)))))
    moved = lines_of_terms(cover, lines, half_width_m)
    if len(columns):
        plates = plates_of_terms(cover, columns).reshape(len(columns), -1)
        moved = moved - (np.real(system.gauge.dual(2).reshape(-1).conj() @ cover.terms.fields)
                         + np.real(plates @ dual.reshape(-1).conj())) / half_width_m
    weight = angular.weight.sum(axis=0)
    out = total + sigma_theta**2 / np.where(weight > 0, weight, 1)
    out = out + np.einsum("kp,pq,kq->k", moved, cover.terms.covariance * sigma_xy**2, moved)
    for start in range(0, count, BLOCK):
        here = np.arange(start, min(start + BLOCK, count))
        rows = np.tile((known / known.sum())[:, None], len(here))
        for view in range(angular.n_views):
            rows -= angular.rows(view, here).T * share[view, here]
        answer = np.tile(turned[:, None], len(here))
        answer[system.phi_at] -= angular.response.T @ rows + share[:, here]
        out[here] += sigma_theta**2 * np.einsum("kl,kl->l", rows, angular.solve(rows))
        out[here] += noise * np.einsum("vl,vw,wl->l", answer, cover.inverse, answer)
    return np.where(system.known_plate_lines, out, np.nan)


def lines_of_terms(cover: FieldCovariance, lines: tuple[np.ndarray, np.ndarray],
                    half_width_m: float) -> np.ndarray:
    """Return the plate's angular map for a unit of each coefficient, (K, p), no rotation taken."""
    system, field = cover.system, -cover.terms.turned
    share = system.angular.relative_weight
    own: np.ndarray = np.zeros((*share.shape, field.shape[1]))
    for at, values in zip(*lines, strict=True):
        own[..., at] = values
    phi = cover.terms.parameters[system.phi_at] / half_width_m
    found = np.einsum("vk,vkp->kp", share, own - system.angular.gather(field) - phi[:, None])
    return found + field[system.known_lines].mean(axis=0)
