# SPDX-License-Identifier: Apache-2.0
"""Contribution of a finite rotation of the plate beyond the linear model (method eq. 2.6).

A mark is at R(phi) R^q (m + A) + t. The linear model contains R^q A + phi J R^q m + t; the rest
is (R(phi) - 1 - phi J) R^q m + (R(phi) - 1) R^q A. As complex numbers, R(phi) is exp(i phi).
"""

import numpy as np

from selfcal_ros.estimation.lattice.maps import PHASES
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.readings import ViewReadings
from selfcal_ros.model.result import ArtifactMap


def turned_marks(view: ViewReadings, artifact: Artifact) -> np.ndarray:
    """Return R^q m of the marks read, from the plate's centre, complex (P,), stage frame, m."""
    turn = PHASES[view.view.lattice_pose(artifact).q]
    return turn * (view.m + 1j * view.n) * artifact.grid_pitch_m


def turned_plate(view: ViewReadings, artifact: Artifact, plate: ArtifactMap) -> np.ndarray:
    """Return R^q A of the marks read, complex (P,), stage frame, m; NaN where unknown."""
    turn = PHASES[view.view.lattice_pose(artifact).q]
    at = view.m + artifact.half[0], view.n + artifact.half[1]
    return turn * (plate.ax[at] + 1j * plate.ay[at])


def rotation_excess(phi_rad: float, marks: np.ndarray, plate: np.ndarray) -> np.ndarray:
    """Return the contribution of the rotation beyond the linear model, complex (P,), m."""
    turn = np.expm1(1j * phi_rad)
    return (turn - 1j * phi_rad) * marks + turn * plate  # method eq. 2.6
