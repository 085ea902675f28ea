# SPDX-License-Identifier: Apache-2.0
"""Degrees of freedom and coverage factor of the map's uncertainty: worked out here, read elsewhere.

What is known beforehand (a reference length, a term that its size holds) has no degrees of freedom
to lose: the sum with the noise of readings has more than the noise alone (Welch-Satterthwaite, GUM
G.4).
"""

from dataclasses import replace

import numpy as np

from selfcal_ros.estimation.joint.noise import coverage_factor
from selfcal_ros.estimation.joint.saved_terms import variance_of_terms
from selfcal_ros.estimation.options import ReferenceLength
from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.model.statistics import rms
from selfcal_ros.model.verdict import TermResult

TOLD = 0.5
"""Part of a term's size that readings leave, below which it is they that tell the term."""


def remaining_part(term: TermResult) -> float:
    """Return the part of a term's size that the readings leave: rms u over the size."""
    return rms(np.array([estimate.u for estimate in term.estimates])) / term.solved_with


def known_beforehand(result: CalibrationResult, reference: ReferenceLength | None) -> np.ndarray:
    """Return the variance of the map that no reading told, (2, nx, ny), m^2."""
    artifact = result.artifact
    found = np.zeros((2, *artifact.shape))
    if reference is not None:
        found += (reference.u_relative * np.stack([artifact.x_m, artifact.y_m])) ** 2
    terms = {term.name: term for term in result.model.terms}
    for name, variance in variance_of_terms(result).items():
        if remaining_part(terms[name]) >= TOLD:
            found += variance
    return found


def with_coverage(result: CalibrationResult,
                  reference: ReferenceLength | None) -> CalibrationResult:
    """Return the result with degrees of freedom and k of the XY map's uncertainty.

    Parameters
    ----------
    result : CalibrationResult
        With its uncertainty map; without one k is that of the noise.
    reference : ReferenceLength, optional
        What set the scale.
    """
    noise, emap = result.noise, result.error_map
    dof = noise.dof_xy
    power = np.stack([emap.u_gx, emap.u_gy]) ** 2
    at = np.isfinite(power)
    known = known_beforehand(result, reference)
    if not (at.any() and dof > 0 and known[at].any()):
        return replace(result, noise=replace(noise, dof_map_xy=dof, dof_map_theta=noise.dof_theta))
    whole = float(power[at].mean())
    told = max(whole - float(known[at].mean()), 0.0)
    more = dof * (whole / told) ** 2 if told > 0 else float("inf")
    return replace(result, noise=replace(noise, dof_map_xy=more, k_xy=coverage_factor(more),
                                         dof_map_theta=noise.dof_theta))
