# SPDX-License-Identifier: Apache-2.0
"""Standard uncertainties predicted for a plan before measurement."""

from dataclasses import dataclass, replace

import numpy as np

from selfcal_ros.estimation.datum.angular import conditions_for, lines_alone
from selfcal_ros.estimation.datum.covariance import MapsCovariance
from selfcal_ros.estimation.normal.equations import NormalEquations
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.error_map import ThetaDatum, rms
from selfcal_ros.model.readings import Sense

MAX_SITES = 151 * 151
"""Largest field whose uncertainty map is predicted in full."""


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
    ux, uy = np.sqrt(MapsCovariance(system, inverse).of_stage * repeats)
    if not system.angular.n_views:
        return Prediction(ux, uy, np.zeros(0))
    conditions = conditions_for(system, ThetaDatum(datum), Sense.MICROSCOPE_MOVES,
                                artifact.grid_pitch_m * max(artifact.reach))
    known = replace(conditions, slopes=np.zeros_like(conditions.slopes))
    return Prediction(ux, uy, np.sqrt(repeats * lines_alone(system).of_stage(known)[0]))
