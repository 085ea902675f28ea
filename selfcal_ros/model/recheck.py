# SPDX-License-Identifier: Apache-2.0
"""What a recheck finds, a part of its result, and the significance of a difference of maps."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from selfcal_ros.outputs import filled_fields


@dataclass(frozen=True)
class Significance:
    """Test of a difference with the uncertainties of both maps.

    Attributes
    ----------
    chi2_ratio : float
        Square of the Mahalanobis distance over its degrees of freedom: 1 on average if the maps
        agree.
    dof : float
        Its degrees of freedom: combinations of nodes that are independent of the datum.
    p : float
        Probability of such a ratio if the maps agree.
    correlated : bool
        Whether the correlations between nodes are known; without them nodes are treated as
        independent, and p is approximate.
    largest_z : float
        Largest difference of a node on an axis (of a line) in standard uncertainties.
    z_limit : float
        Limit exceeded with half the probability of the verdict if the maps agree.
    p_z : float
        Probability of such a `largest_z` if the maps agree.
    noise_dof : float
        Degrees of freedom of the noise behind both uncertainties; infinite if known.
    significant : bool
        The verdict of both tests.
    u_rms, u_largest : float
        Standard uncertainty of the values: root mean square, and that of the largest.
    """

    chi2_ratio: float
    dof: float
    p: float
    correlated: bool
    largest_z: float = float("nan")
    z_limit: float = float("nan")
    p_z: float = float("nan")
    noise_dof: float = float("inf")
    significant: bool = False
    u_rms: float = float("nan")
    u_largest: float = float("nan")


@dataclass(frozen=True)
class PlateCalibration:
    """The calibration that made a plate known; `readings` are its input, exposures ISO dates."""

    plan_id: str
    run_id: str
    created: str
    readings: dict[str, str]
    first_exposure: str | None = None
    last_exposure: str | None = None


@dataclass(frozen=True)
class LargestChange:
    """The clearest change of a map: at x, y (m) along an axis, its size and u, m."""

    x: float
    y: float
    axis: str
    change: float
    u: float


@dataclass(frozen=True)
class LargestTurn:
    """The clearest change of an angular map: its line, size and u, rad."""

    line: int
    change: float
    u: float


@dataclass(frozen=True)
class ScaleChange:
    """Change of the scale of the encoders against the plate, and its u, m/m."""

    changed: bool
    change: float
    u: float
    p: float


@dataclass(frozen=True)
class Detectable:
    """Changes that are found in nine of ten cases: at one node, m, and smooth, rms, m."""

    one_node: float
    smooth: float


@dataclass(frozen=True, eq=False)
class Recheck:
    """Change of a stage since the calibration of the plate, SI units.

    Attributes
    ----------
    of : str
        File of the calibration.
    calibration : PlateCalibration
        What it was.
    changed : bool
        Whether the maps differ.
    p : float
        Probability of as large a change of any map if there is none.
    largest : LargestChange
        The clearest one.
    rms, u_rms : float
        Change of a coordinate and its u, rms over the nodes, m.
    p_xy : float
        Probability of as large a change of the XY map.
    significance_xy : Significance or None
        Its test.
    scale : ScaleChange
        Of the scale, which is not part of the map.
    dx, dy, u_dx, u_dy : float array (nx, ny)
        The change, new minus old, and its standard uncertainty; NaN where unknown.
    passes : int
        Passes of the view with the fewest.
    detectable : Detectable, optional
        Which changes would have been found.
    p_theta, significance_theta, d_theta, u_d_theta, largest_theta : optional
        The same of the angular map.
    """

    of: str
    calibration: PlateCalibration
    changed: bool
    p: float
    largest: LargestChange
    rms: float
    u_rms: float
    p_xy: float
    significance_xy: Significance | None
    scale: ScaleChange
    dx: np.ndarray
    dy: np.ndarray
    u_dx: np.ndarray
    u_dy: np.ndarray
    passes: int
    detectable: Detectable | None = None
    p_theta: float | None = None
    significance_theta: Significance | None = None
    d_theta: np.ndarray | None = None
    u_d_theta: np.ndarray | None = None
    largest_theta: LargestTurn | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return ``recheck`` of RESULT.json."""
        return filled_fields(self)
