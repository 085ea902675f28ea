# SPDX-License-Identifier: Apache-2.0
"""Covariances of saved maps: their correlations follow from the views, their sizes from the map.

A RESULT.json holds standard uncertainties, not covariances. The correlations depend on the views
alone, as long as few marks are missing, so that they are computed anew.
"""

import numpy as np
from scipy.optimize import nnls

from selfcal_ros.estimation.datum.covariance import FieldCovariance
from selfcal_ros.estimation.law.solve import law_covariance
from selfcal_ros.estimation.normal.equations import NormalEquations
from selfcal_ros.estimation.normal.planned import planned_system
from selfcal_ros.estimation.observability.prediction import theta_matrix
from selfcal_ros.estimation.observability.rank import full_observability
from selfcal_ros.model.readings import Sense
from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.model.view import View

MAX_SITES = 31 * 31
"""Largest field whose covariance is formed as a whole."""

MAX_LINES = 1024
"""Largest number of lines whose covariance is formed as a whole."""


def xy_covariance(result: CalibrationResult, known: np.ndarray) -> tuple[np.ndarray, bool]:
    """Return the covariance of Gx, Gy at the known sites, m^2, and whether it is a full matrix.

    (2n, 2n), or the variances (2n,) where the views do not tell the correlations.
    """
    emap = result.error_map
    u = np.concatenate([emap.u_gx[known], emap.u_gy[known]])
    system = _system(result)
    if system is None or known.size > MAX_SITES or not np.isfinite(u).all():
        return u**2, False
    if result.method == "law":
        cover, both = law_covariance(result), np.tile(known.ravel(), 2)
        return (u**2, False) if cover is None else (_sized(cover[0][np.ix_(both, both)], u), True)
    at = np.flatnonzero(known.ravel())
    rows = np.zeros((2 * len(at), known.size), dtype=complex)
    rows[np.arange(len(at)), at] = 1.0
    rows[len(at) + np.arange(len(at)), at] = 1j
    rows = rows.reshape(-1, *known.shape)
    if _flipped(result):
        rows = rows[:, ::-1, ::-1]
    cover = _field(system).of(rows)
    noise, scale = _powers(result, system)
    place = np.concatenate([result.artifact.x_m[known], result.artifact.y_m[known]])
    cover = noise * cover + scale * np.outer(place, place)
    return _sized(cover, u), True


def theta_covariance(result: CalibrationResult, known: np.ndarray) -> tuple[np.ndarray, bool]:
    """Return the covariance of Gtheta at the known lines, rad^2; variances if not available."""
    u = result.error_map.u_g_theta[known]
    system = _system(result)
    if system is None or not system.angular.n_views or len(known) > MAX_LINES \
            or not np.isfinite(u).all():
        return u**2, False
    if result.method == "law":
        cover = law_covariance(result)
        return (u**2, False) if cover is None else (_sized(cover[1][np.ix_(known, known)], u), True)
    cover = theta_matrix(system, result.artifact, result.error_map.datum_theta,
                         sense=Sense(result.sense))
    if _flipped(result):
        back = -np.arange(len(known)) % len(known)
        cover = cover[np.ix_(back, back)]
    return _sized(cover[np.ix_(known, known)], u), True


def _sized(cover: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Return a covariance with its correlations and the standard uncertainties `u`."""
    variances = np.diag(cover)
    size = u / np.sqrt(np.maximum(variances, max(1e-12 * variances.max(), np.finfo(float).tiny)))
    return cover * size[:, None] * size


def first_order_u(result: CalibrationResult) -> tuple[float, float]:
    """Return the standard uncertainties of O and R of a map; NaN where the views do not tell."""
    system = _system(result)
    if system is None:
        return float("nan"), float("nan")
    length = result.artifact.grid_pitch_m * max(result.artifact.half)
    cover = _field(system).of(system.gauge.shear)
    u = np.sqrt(_powers(result, system)[0] * np.diag(cover)) / length
    return float(u[0]), float(u[1])


def _powers(result: CalibrationResult, system: NormalEquations) -> tuple[float, float]:
    """Return the variance of a reading, m^2, and that of the map's scale, behind a map's u.

    A map whose scale a reference length sets has u^2 = sigma^2 d + s^2 x^2, with d from the views.
    """
    artifact, emap = result.artifact, result.error_map
    found = np.stack([emap.u_gx, emap.u_gy]) ** 2
    unit = np.stack(_field(system).diagonal())
    if _flipped(result):
        unit = unit[:, ::-1, ::-1]
    place = np.stack([artifact.x_m, artifact.y_m]) ** 2
    good = np.isfinite(found) & np.isfinite(unit)
    sizes = np.array([unit[good].mean(), place[good].mean()])
    target = found[good].mean()
    columns = np.stack([unit[good], place[good]], axis=1) / sizes
    powers = nnls(columns, found[good] / max(target, np.finfo(float).tiny))[0]
    noise, scale = powers * target / sizes
    return float(noise), float(scale)


def _flipped(result: CalibrationResult) -> bool:
    """Return whether the equations are solved for H(X) = -G(-X)."""
    return result.sense == Sense.PLATE_MOVES


def _field(system: NormalEquations) -> FieldCovariance:
    n = 3 * system.grid.n_views
    inverse = np.zeros((system.size, system.size))
    inverse[:n, :n] = system.grid_inverse
    return FieldCovariance(system, inverse)


def _system(result: CalibrationResult) -> NormalEquations | None:
    """Return the system of the views behind a result; None if they do not identify the stage."""
    if np.isnan(result.error_map.u_gx).all() or not result.views:
        return None
    views = _views(result)
    if not any(view.grid for view in views):
        return None
    system = planned_system(result.artifact, views)
    if not full_observability(system, result.artifact, views).identifiable:
        return None
    return system


def _views(result: CalibrationResult) -> tuple[View, ...]:
    """Return the views behind a result with the kinds of marks that were read in them.

    The rotation of a view is known if its grid was read, or if its lines were and share their
    rotation with a grid. Used readings without a known rotation are lines in views of their own:
    then no grid view has lines.
    """
    lines = result.artifact.angular_count > 0
    alone = [lines and v.used > 0 and not np.isfinite(v.phi) for v in result.views]
    return tuple(View(v.name, v.rotation, (v.translation_x, v.translation_y), bool(
        np.isfinite(v.tx)), lines and (apart or not any(alone)))
        for v, apart in zip(result.views, alone, strict=True) if apart or np.isfinite(v.phi))
