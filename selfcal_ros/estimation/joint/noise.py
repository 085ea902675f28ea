# SPDX-License-Identifier: Apache-2.0
"""The noise of one reading, from repeats and from residuals, and their agreement."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import fdtrc, stdtrit

from selfcal_ros.model.error_map import MANY_DOF

MIN_REPEAT_DOF = 30
"""Degrees of freedom from which the scatter of repeats is used; below, the residuals."""

F_LEVEL = 1e-3
"""Two-sided level of the test that repeats and residuals have the same noise."""

SAME = 1.1
"""Ratio of two noises up to which they count as equal, however significant the difference."""

COVERAGE = 0.9545
"""Coverage of an expanded uncertainty: k = 2 for many degrees of freedom."""


@dataclass(frozen=True)
class NoiseEstimate:
    """Noise of one kind of readings.

    Attributes
    ----------
    sigma : float
        Standard deviation of one reading behind the uncertainties; NaN if unknown. If repeats
        (or the declaration) and residuals contradict each other it is the larger one.
    dof : float
        Its degrees of freedom; infinite if the detections declare it.
    repeats, residuals : float
        The two estimates, NaN if none.
    dof_repeats, dof_residuals : float
        Their degrees of freedom.
    declared : float
        As declared by the detections, NaN if not declared.
    p : float
        Two-sided probability of such a difference of residuals and repeats (or declaration) if
        both have the same noise; NaN if there is nothing to compare.
    """

    sigma: float
    dof: float
    repeats: float
    residuals: float
    dof_repeats: float
    dof_residuals: float
    declared: float = float("nan")
    p: float = float("nan")

    @property
    def stated(self) -> float:
        """Noise compared with the residuals: the declared one, or that of repeats."""
        return self.declared if np.isfinite(self.declared) else self.repeats

    @property
    def contradicted(self) -> bool:
        """Whether residuals and repeats (or declaration) contradict each other."""
        if not self.p < F_LEVEL:
            return False
        small, large = sorted((self.stated, self.residuals))
        return large > SAME * small

    @property
    def k(self) -> float:
        """Coverage factor for 95.45 % (Student's t); NaN if the noise is unknown."""
        return coverage_factor(self.dof) if self.dof > 0 else float("nan")


def coverage_factor(dof: float, probability: float = COVERAGE) -> float:
    """Return k such that value +- k u covers the truth with `probability` (Student's t)."""
    return float(stdtrit(min(dof, MANY_DOF), (1 + probability) / 2))


def pooled(parts: Iterable[tuple[float, float]]) -> tuple[float, float]:
    """Return the pooled standard deviation and degrees of freedom of (sigma, dof) pairs."""
    good = [(sigma, dof) for sigma, dof in parts if dof > 0 and np.isfinite(sigma)]
    total = float(sum(dof for _, dof in good))
    if not total:
        return float("nan"), 0.0
    return float(np.sqrt(sum(dof * sigma**2 for sigma, dof in good) / total)), total


def noise_estimate(repeats: tuple[float, float], residuals: tuple[float, float], declared: float, *,
          floor: float = 0.0) -> NoiseEstimate:
    """Return the noise to use: declared, else repeats, else residuals.

    If a test contradicts this choice, the larger one is used. Repeats that are identical to the
    last bit show the resolution of the sensor, not the noise, and are ignored.

    Parameters
    ----------
    repeats, residuals : tuple
        (sigma, degrees of freedom) of each; dof 0 = none.
    declared : float
        As declared by the detections; NaN = not declared.
    floor : float
        Noise at the level of rounding, which is not tested.
    """
    identical = repeats[1] > 0 and repeats[0] == 0 and residuals[1] > 0 and residuals[0] > floor
    base = (declared, float("inf")) if np.isfinite(declared) else (
        (float("nan"), 0.0) if identical else repeats)
    p = _same_noise(base, residuals, floor)
    if np.isfinite(declared) or base[1] >= MIN_REPEAT_DOF or not residuals[1]:
        chosen = base
    else:
        chosen = residuals
    found = NoiseEstimate(
        sigma=chosen[0], dof=chosen[1], repeats=repeats[0], residuals=residuals[0],
        dof_repeats=repeats[1], dof_residuals=residuals[1], declared=declared, p=p)
    if found.contradicted:
        sigma, dof = max(base, residuals)
        found = replace(found, sigma=sigma, dof=dof)
    return found


def _same_noise(base: tuple[float, float], residuals: tuple[float, float], floor: float) -> float:
    """Return the two-sided probability that both are estimates of the same noise (F-test)."""
    if not (base[1] > 0 and residuals[1] > 0) or not max(base[0], residuals[0]) > floor:
        return float("nan")
    ratio = np.square(min(residuals[0] / max(base[0], np.finfo(float).tiny), 1e100))
    upper = float(fdtrc(residuals[1], min(base[1], MANY_DOF), ratio))
    return 2 * min(upper, 1 - upper)
