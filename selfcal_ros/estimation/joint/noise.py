# SPDX-License-Identifier: Apache-2.0
"""The noise of one reading: from repeats, from residuals, and whether the two agree."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.special import fdtrc

MIN_REPEAT_DOF = 30
"""Degrees of freedom from which the scatter of repeats is trusted; below, residuals are."""

F_LEVEL = 1e-3
"""Two-sided level of the test that repeats and residuals show the same noise."""


@dataclass(frozen=True)
class NoiseEstimate:
    """Noise of one kind of readings.

    Attributes
    ----------
    sigma : float
        Standard deviation of one reading behind the uncertainties; NaN if unknown.
    dof : float
        Its degrees of freedom; infinite if the detections declare it.
    repeats, residuals : float
        The two estimates, NaN where there is none.
    dof_repeats, dof_residuals : int
        Their degrees of freedom.
    """

    sigma: float
    dof: float
    repeats: float
    residuals: float
    dof_repeats: int
    dof_residuals: int


def pooled(parts: Iterable[tuple[float, int]]) -> tuple[float, int]:
    """Return the pooled standard deviation and degrees of freedom of (sigma, dof) pairs."""
    good = [(sigma, dof) for sigma, dof in parts if dof > 0 and np.isfinite(sigma)]
    total = sum(dof for _, dof in good)
    if not total:
        return float("nan"), 0
    return float(np.sqrt(sum(dof * sigma**2 for sigma, dof in good) / total)), total


def noise_estimate(repeats: tuple[float, int], residuals: tuple[float, int],
                   declared: float) -> NoiseEstimate:
    """Return the noise to use: declared, else repeats, else residuals.

    Parameters
    ----------
    repeats, residuals : tuple
        (sigma, degrees of freedom) of each; dof 0 = none.
    declared : float
        As the detections declare it; NaN = not declared.
    """
    if np.isfinite(declared):
        sigma, dof = declared, float("inf")
    elif repeats[1] >= MIN_REPEAT_DOF or not residuals[1]:
        sigma, dof = repeats
    else:
        sigma, dof = residuals
    return NoiseEstimate(sigma, dof, repeats[0], residuals[0], repeats[1], residuals[1])


def disagreement(found: NoiseEstimate, what: str, unit: tuple[float, str], floor: float) -> str:
    """Return a warning if the residuals show another noise than repeats or declaration.

    Parameters
    ----------
    found : NoiseEstimate
        The noise.
    what : str
        Kind of readings.
    unit : tuple
        Factor and name of the unit in which a person reads it.
    floor : float
        Noise at the level of rounding, which is not tested.
    """
    base, dof = found.repeats, found.dof_repeats
    name = "repeats"
    if not np.isfinite(found.dof):
        base, dof, name = found.sigma, np.inf, "the detections' own sigma"
    if not (found.dof_residuals and dof) or max(base, found.residuals) <= floor:
        return ""
    ratio = (found.residuals / max(base, 1e-300)) ** 2
    upper = float(fdtrc(found.dof_residuals, min(dof, 1e9), ratio))
    if min(upper, 1 - upper) >= F_LEVEL / 2:
        return ""
    factor, symbol = unit
    return (f"{what}: residuals show a noise of {found.residuals * factor:.3g} {symbol}, {name} "
            f"{base * factor:.3g} {symbol}; " + (
                "something beside random noise is in the readings" if ratio > 1
                else "the stated noise is too large"))
