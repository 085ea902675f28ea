# SPDX-License-Identifier: Apache-2.0
"""Covariances of saved maps: their correlations follow from the views, their sizes from the map.

A RESULT.json holds standard uncertainties, not covariances. The correlations depend on the views
alone, as long as few marks are missing, so that they are computed anew.
"""

import numpy as np

from selfcal_ros.estimation.prediction import theta_matrix
from selfcal_ros.estimation.rank import full_observability
from selfcal_ros.estimation.system import JointSystem, planned_system
from selfcal_ros.estimation.uncertainty import FieldCovariance
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
    at = np.flatnonzero(known.ravel())
    rows = np.zeros((2 * len(at), known.size), dtype=complex)
    rows[np.arange(len(at)), at] = 1.0
    rows[len(at) + np.arange(len(at)), at] = 1j
    cover = _field(system).of(rows.reshape(-1, *known.shape))
    scale = u / np.sqrt(np.maximum(np.diag(cover), np.finfo(float).tiny))
    return cover * scale[:, None] * scale, True


def theta_covariance(result: CalibrationResult, known: np.ndarray) -> tuple[np.ndarray, bool]:
    """Return the covariance of Gtheta at the known lines, rad^2; variances if not available."""
    u = result.error_map.u_g_theta[known]
    system = _system(result)
    if system is None or not system.angular.n_views or len(known) > MAX_LINES \
            or not np.isfinite(u).all():
        return u**2, False
    cover = theta_matrix(system, result.artifact, result.error_map.datum_theta)
    cover = cover[np.ix_(known, known)]
    scale = u / np.sqrt(np.maximum(np.diag(cover), 1e-12 * np.diag(cover).max()))
    return cover * scale[:, None] * scale, True


def first_order_u(result: CalibrationResult) -> tuple[float, float]:
    """Return the standard uncertainties of O and R of a map; NaN where the views do not tell."""
    system = _system(result)
    if system is None:
        return float("nan"), float("nan")
    length = result.artifact.grid_pitch_m * max(result.artifact.half)
    cover = _field(system).of(system.gauge.shear)
    mean = np.nanmean(np.stack([result.error_map.u_gx, result.error_map.u_gy]) ** 2)
    ux, uy = _field(system).diagonal()
    noise = np.sqrt(mean / np.nanmean(np.stack([ux, uy])))
    u = noise * np.sqrt(np.diag(cover)) / length
    return float(u[0]), float(u[1])


def _field(system: JointSystem) -> FieldCovariance:
    n = 3 * system.grid.n_views
    inverse = np.zeros((system.size, system.size))
    inverse[:n, :n] = system.grid_inverse
    return FieldCovariance(system, inverse)


def _system(result: CalibrationResult) -> JointSystem | None:
    """Return the system of the views behind a result; None if they do not identify the stage."""
    if np.isnan(result.error_map.u_gx).all() or not result.views:
        return None
    lines = result.artifact.angular_count > 0
    views = tuple(View(v.name, v.rotation, (v.translation_x, v.translation_y), bool(
        np.isfinite(v.tx)), lines and bool(np.isfinite(v.phi))) for v in result.views
        if np.isfinite(v.phi))
    if not any(view.grid for view in views):
        return None
    system = planned_system(result.artifact, views)
    if not full_observability(system, result.artifact, views).identifiable:
        return None
    return system
