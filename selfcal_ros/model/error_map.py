# SPDX-License-Identifier: Apache-2.0
"""The calibrated error map of the stage, with datum and uncertainty; NaN means unknown."""

from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from selfcal_ros.model.artifact import Artifact

MANY_DOF = 1e9
"""Finite substitute for infinite degrees of freedom in the tails of F and t."""


def rms(values: np.ndarray) -> float:
    """Return the root mean square of the finite values; NaN if there are none."""
    finite = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(finite**2))) if finite.size else float("nan")


class ThetaDatum(StrEnum):
    """Condition that fixes the constant of the angular map (method eqs. 3.6, 3.7)."""

    XY_AXES = "xy_axes"
    ZERO_MEAN = "zero_mean"


@dataclass(frozen=True, eq=False)
class ErrorMap:
    """Stage error G = indicated - true at the sites, stage frame.

    Datum: no translation, rotation or magnification (Hu eq. 5), unless a reference
    length sets the scale; theta by `datum_theta`.

    Attributes
    ----------
    artifact : Artifact
        Lattice of the sites.
    gx, gy : float array (nx, ny)
        Error at site m = i - hx, n = j - hy, m; NaN where unknown.
    u_gx, u_gy : float array (nx, ny)
        Standard uncertainties (k=1), m.
    g_theta, u_g_theta : float array (K,)
        Angular error at line k and its standard uncertainty, rad; NaN where unknown.
    nonorthogonality, scale_difference : float
        O and R of Hu eq. 6: Gx = O y + R x + Fx, Gy = O x - R y + Fy.
    datum_theta : ThetaDatum
        Convention behind `g_theta`.
    """

    artifact: Artifact
    gx: np.ndarray
    gy: np.ndarray
    u_gx: np.ndarray
    u_gy: np.ndarray
    g_theta: np.ndarray = field(default_factory=lambda: np.zeros(0))
    u_g_theta: np.ndarray = field(default_factory=lambda: np.zeros(0))
    nonorthogonality: float = 0.0
    scale_difference: float = 0.0
    datum_theta: ThetaDatum = ThetaDatum.ZERO_MEAN

    @property
    def valid(self) -> np.ndarray:
        """Sites whose error is known, bool (nx, ny)."""
        return np.isfinite(self.gx) & np.isfinite(self.gy)
