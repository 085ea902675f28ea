# SPDX-License-Identifier: Apache-2.0
"""Standard uncertainties predicted for a plan before measurement."""

from dataclasses import dataclass

import numpy as np

from selfcal_ros.estimation.datum.angular import Conditions, conditions_for
from selfcal_ros.estimation.datum.covariance import FieldCovariance
from selfcal_ros.estimation.normal.equations import NormalEquations
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.error_map import ThetaDatum, rms
from selfcal_ros.model.readings import Sense

MAX_SITES = 151 * 151
"""Largest field whose uncertainty map is predicted in full."""

BLOCK = 512
"""Number of unit vectors solved at a time."""


@dataclass(frozen=True, eq=False)
class Prediction:
    """Standard uncertainty of the maps for unit noise of one averaged reading.

    If views differ in repeats, the reading with the fewest has unit noise.

    Attributes
    ----------
    ux, uy : float array (nx, ny)
        Of Gx and Gy, in units of the noise of a grid reading; their shape is that of the
        predicted field.
    u_theta : float array (K,)
        Of Gtheta, in units of the noise of an angular reading, misalignments of the grid
        views known; empty if no line is measured.
    """

    ux: np.ndarray
    uy: np.ndarray
    u_theta: np.ndarray

    @property
    def rms_xy(self) -> float:
        """Root mean square over all sites and both axes."""
        return rms(np.stack([self.ux, self.uy]))

    @property
    def max_xy(self) -> float:
        """Largest value of a site on either axis."""
        return float(np.nanmax(np.stack([self.ux, self.uy])))

    @property
    def n_unknown(self) -> int:
        """Number of sites that remain unknown."""
        return int(np.isnan(self.ux).sum())

    @property
    def rms_theta(self) -> float:
        """Root mean square over the lines; NaN if no line is measured."""
        return rms(self.u_theta)


def predict(system: NormalEquations, artifact: Artifact, datum: ThetaDatum, *,
            repeats: int = 1) -> Prediction:
    """Return the predicted uncertainties for readings that identify the stage.

    Parameters
    ----------
    system : NormalEquations
        The readings; weights are repeats.
    artifact : Artifact
        The plate.
    datum : ThetaDatum
        Convention of the angular map.
    repeats : int
        Repeats of the averaged reading whose noise is the unit.
    """
    n = 3 * system.grid.n_views
    inverse = np.zeros((system.size, system.size))
    inverse[:n, :n] = system.grid_inverse
    ux, uy = (np.sqrt(v * repeats) for v in FieldCovariance(system, inverse).diagonal())
    if not system.angular.n_views:
        return Prediction(ux, uy, np.zeros(0))
    return Prediction(ux, uy, np.sqrt(repeats * theta_variance(system, artifact, datum)))


def theta_variance(system: NormalEquations, artifact: Artifact, datum: ThetaDatum) -> np.ndarray:
    """Return the variance of Gtheta (K,) for unit noise of one angular reading.

    The rotations of the grid views are taken as known: the grid determines them thousands of times
    better than the lines. So are the slopes behind the datum ``xy_axes``.
    """
    answer, inner, spread, conditions = _theta_parts(system, artifact, datum)
    rows, gain = conditions.rows, conditions.gain
    n = system.angular.n_lines
    variance = np.einsum("ka,ab,kb->k", answer, inner, answer)
    for start in range(0, n, BLOCK):
        at = np.arange(start, min(start + BLOCK, n))
        variance[at] += system.angular.solve(np.eye(n, len(at), -start))[at, at - start]
    variance += np.einsum("kc,cd,kd->k", gain, rows @ spread, gain)
    variance -= 2 * np.einsum("kc,kc->k", gain, spread)
    return np.where(system.known_lines, np.maximum(variance, 0.0), np.nan)


def theta_matrix(system: NormalEquations, artifact: Artifact, datum: ThetaDatum, *,
                 sense: Sense = Sense.MICROSCOPE_MOVES) -> np.ndarray:
    """Return the covariance (K, K) of `theta_variance`, in the frame of the equations."""
    answer, inner, _, conditions = _theta_parts(system, artifact, datum, sense)
    n = system.angular.n_lines
    raw = system.angular.solve(np.eye(n)) + answer @ inner @ answer.T
    datum_map = np.eye(n) - conditions.gain @ conditions.rows
    return datum_map @ raw @ datum_map.T


def _theta_parts(system: NormalEquations, artifact: Artifact, datum: ThetaDatum,
                 sense: Sense = Sense.MICROSCOPE_MOVES
                 ) -> tuple[np.ndarray, np.ndarray, np.ndarray, Conditions]:
    """Return the lines' response to free rotations, their covariance, and the datum's columns."""
    angular = system.angular
    half_width_m = artifact.grid_pitch_m * max(artifact.reach)
    conditions = conditions_for(system, ThetaDatum(datum), sense, half_width_m)
    free = [v for v, i in enumerate(system.angular_index) if i not in system.grid_index]
    inner = np.linalg.pinv(angular.schur[np.ix_(free, free)], hermitian=True)
    answer = angular.response[:, free]
    columns = np.ascontiguousarray(conditions.rows.T)
    spread = angular.solve(columns) + answer @ inner @ (answer.T @ columns)
    return answer, inner, spread, conditions
