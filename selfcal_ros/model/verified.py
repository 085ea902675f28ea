# SPDX-License-Identifier: Apache-2.0
"""What a measurement with the correction on says of it: ``verification`` of RESULT.json."""

from dataclasses import dataclass

from selfcal_ros.model.recheck import Significance


@dataclass(frozen=True)
class AxisError:
    """Error of one axis, m or rad: rms and largest over the nodes, U (k u, rms) of a node.

    `factor` is the part of the correction that acts, 1 as it should, `u_factor` its standard
    uncertainty; NaN where the map does not show it.
    """

    rms_before: float
    rms_after: float
    largest_before: float
    largest_after: float
    U_before: float
    U_after: float
    factor: float
    u_factor: float


@dataclass(frozen=True)
class Verified:
    """What a correction did while it was on.

    Attributes
    ----------
    of : str
        File of the map that corrected.
    sentence : str
        The verdict in one sentence.
    better, remains : bool
        Whether the error was less with the correction, and whether one remains in x and y, both
        beyond the uncertainty of both maps.
    passed : bool
        Whether the correction may stay on.
    fault, theta_fault : str
        What is wrong with it, ``none`` if nothing is, for x and y and for the angle.
    correlation : float
        Of the correction that acts with the map, -1 to 1.
    axes : dict
        ``x``, ``y`` and, with lines, ``theta`` -> error before and after.
    remaining : Significance, optional
        Test of the error that remains in x and y.
    """

    of: str
    sentence: str
    better: bool
    passed: bool
    fault: str
    theta_fault: str
    remains: bool
    correlation: float
    axes: dict[str, AxisError]
    remaining: Significance | None = None
