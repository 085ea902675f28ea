# SPDX-License-Identifier: Apache-2.0
"""Uncertainty of the plate's map.

Stage and plate exchange their parts: a view that lays mark m on site X lays site X on mark m by
the inverse pose. So the covariance of the plate's map is that of a stage's map in the exchanged
equations, where the sites are eliminated and the marks are left (method eq. 4.13).
"""

import numpy as np

from selfcal_ros.estimation.datum.covariance import (
    FieldCovariance,
    ScaleDatum,
    TermSpread,
    scale_by_plate,
    scale_of_plate,
    slope_in_datum,
    without_datum,
)
from selfcal_ros.estimation.lattice.maps import PHASES
from selfcal_ros.estimation.normal.equations import NormalEquations
from selfcal_ros.estimation.normal.systems import Marks, system_of
from selfcal_ros.estimation.options import ReferenceLength
from selfcal_ros.model.view import LatticePose

BLOCK = 512
"""Number of lines computed at once."""


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
        Marks(tuple(poses), weight.reshape(grid.weight.shape), system.grid_index),
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


def plates_of_terms(cover: FieldCovariance, columns: np.ndarray) -> np.ndarray:
    """Return the plate's map for a unit of each coefficient, complex (p, nx, ny), no datum."""
    grid, of_stage = cover.system.grid, cover.terms
    fields = of_stage.fields.T.reshape(-1, *grid.views.shape)
    parameters = of_stage.parameters[:3 * grid.n_views].T
    return np.array([grid.plate(*one)[0] for one in zip(columns, fields, parameters,
                                                        strict=True)])


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
