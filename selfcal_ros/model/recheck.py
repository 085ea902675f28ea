# SPDX-License-Identifier: Apache-2.0
"""The significance of a difference of maps."""

from dataclasses import dataclass


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
