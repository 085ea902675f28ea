# SPDX-License-Identifier: Apache-2.0
"""The uncertainty of a map enlarged by effects that the readings show, and its coverage factor.

An effect e of known size is added in quadrature at every node, u'^2 = u^2 + e^2, so that k u'
covers a map that holds it. As L = e / sigma it is a further factor of the map's covariance, so
that maps are compared and budgets drawn up with it.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from selfcal_ros.estimation.joint.noise import coverage_factor
from selfcal_ros.estimation.joint.solved import (
    ANGULAR_KEY,
    KEY,
    rounded,
    variance_of_terms,
)
from selfcal_ros.model.readings import Sense
from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.model.statistics import rms
from selfcal_ros.model.verdict import Enlargement, TermResult

TOLD = 0.5
"""Part of a term's size that readings leave, below which it is they that tell the term."""


@dataclass(frozen=True, eq=False)
class Effect:
    """What a cause does to the maps, stage frame.

    Attributes
    ----------
    name : str
        Of the cause.
    xy : float array (2, nx, ny)
        On Gx and Gy, m.
    theta : float array (K,)
        On Gtheta, rad.
    """

    name: str
    xy: np.ndarray
    theta: np.ndarray


def effect_of_field(name: str, field: np.ndarray, sense: str, theta: np.ndarray) -> Effect:
    """Return the effect of what is moved, in the frame of the equations.

    Parameters
    ----------
    name : str
        Of the cause.
    field, theta : complex array (nx, ny), float array (K,)
        On the maps, m and rad.
    sense : str
        Who moved.
    """
    if sense == Sense.PLATE_MOVES:
        field, theta = -field[::-1, ::-1], -np.roll(theta[::-1], 1)
    return Effect(name, np.stack([field.real, field.imag]), theta)


def difference(name: str, one: CalibrationResult, other: CalibrationResult) -> Effect:
    """Return by how much two maps of the same readings differ; 0 where one is not known."""
    a, b = one.error_map, other.error_map
    theta = a.g_theta - b.g_theta
    if np.isfinite(theta).any():
        theta = theta - np.nanmean(theta)
    return Effect(name, np.nan_to_num(np.stack([a.gx - b.gx, a.gy - b.gy])), np.nan_to_num(theta))


def enlarged(result: CalibrationResult, effects: Iterable[Effect]) -> CalibrationResult:
    """Return the result with effects added to its uncertainties and saved factors."""
    effects = [effect for effect in effects if effect.xy.any() or effect.theta.any()]
    if not effects:
        return result
    emap, extra = result.error_map, dict(result.extra)
    power = np.sum([effect.xy**2 for effect in effects], axis=0)
    u_theta = np.sqrt(emap.u_g_theta**2 + sum(effect.theta**2 for effect in effects))
    if KEY in extra and result.noise.sigma_xy > 0:
        kept = extra[KEY]
        factors = [rounded(effect.xy / result.noise.sigma_xy).tolist() for effect in effects]
        extra[KEY] = {"terms": [*kept["terms"], *(effect.name for effect in effects)],
                      "factors": [*kept["factors"], *factors]}
    emap = replace(emap, u_gx=np.sqrt(emap.u_gx**2 + power[0]),
                   u_gy=np.sqrt(emap.u_gy**2 + power[1]), u_g_theta=u_theta)
    return replace(result, error_map=emap, extra=extra)


def enlargements(result: CalibrationResult, names: Iterable[str],
                 effects: Iterable[Effect]) -> tuple[Enlargement, ...]:
    """Return what terms, by name, and effects add to the uncertainty, the most first.

    Of the XY map, or of the angular map (rad) where that is all they change.
    """
    variance = variance_of_terms(result)
    found = [Enlargement(name, float(np.sqrt(power.mean())), float(np.sqrt(power.max())))
             for name in dict.fromkeys(names) if (power := variance.get(name)) is not None]
    for name in dict.fromkeys(names):
        if name in result.extra.get(ANGULAR_KEY, {}):
            u = np.asarray(result.extra[ANGULAR_KEY][name])
            found.append(Enlargement(name, rms(u), float(u.max(initial=0.0)), "rad"))
    for effect in effects:
        values, unit = (effect.xy, "m") if effect.xy.any() else (effect.theta, "rad")
        found.append(Enlargement(effect.name, rms(values), float(np.abs(values).max(initial=0)),
                                 unit))
    return tuple(sorted(found, key=lambda item: -item.u_rms))


def remaining_part(term: TermResult) -> float:
    """Return the part of a term's size that the readings leave: rms u over the size."""
    return rms(np.array([estimate.u for estimate in term.estimates])) / term.solved_with


def variance_of_reference(result: CalibrationResult) -> np.ndarray:
    """Return the variance of the map that the reference length makes, (2, nx, ny), m^2."""
    u = 0.0 if result.reference is None else float(result.reference["u_relative"])
    return (u * np.stack([result.artifact.x_m, result.artifact.y_m])) ** 2


def known_beforehand(result: CalibrationResult) -> np.ndarray:
    """Return the variance of the map that no reading determined, (2, nx, ny), m^2."""
    found = variance_of_reference(result)
    terms = {term.name: term for term in result.model.terms}
    for name, variance in variance_of_terms(result).items():
        if name not in terms or remaining_part(terms[name]) >= TOLD:  # else an effect
            found += variance
    return found


def with_coverage(result: CalibrationResult) -> CalibrationResult:
    """Return the result with degrees of freedom and k of the XY map's uncertainty.

    Without an uncertainty map k is that of the noise. The reference length is that of the result.
    """
    noise, emap = result.noise, result.error_map
    dof = noise.dof_xy
    power = np.stack([emap.u_gx, emap.u_gy]) ** 2
    at = np.isfinite(power)
    known = known_beforehand(result)
    if not (at.any() and dof > 0 and known[at].any()):
        return replace(result, noise=replace(noise, dof_map_xy=dof, dof_map_theta=noise.dof_theta))
    whole = float(power[at].mean())
    told = max(whole - float(known[at].mean()), 0.0)
    more = dof * (whole / told) ** 2 if told > 0 else float("inf")
    return replace(result, noise=replace(noise, dof_map_xy=more, k_xy=coverage_factor(more),
                                         dof_map_theta=noise.dof_theta))
