# SPDX-License-Identifier: Apache-2.0
"""Uncertainty budget of a calibrated map as the GUM asks for it: labelled components, k, U."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from selfcal_ros.estimation.joint.noise import F_LEVEL, coverage_factor
from selfcal_ros.estimation.joint.saved_terms import variance_of_terms
from selfcal_ros.estimation.options import ReferenceLength
from selfcal_ros.estimation.verdict.coverage import TOLD, part_left, with_coverage
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.result import CalibrationResult, Noise
from selfcal_ros.model.statistics import rms
from selfcal_ros.units import ARCSEC_PER_RAD, UM_PER_M

MANY_DOF = 1e5
"""Degrees of freedom above which a number of them says nothing more."""

CELL_MEAN = 8 / 15
"""Mean square of the parabola 4 s (1 - s) over a cell: rms of an interpolation error."""


@dataclass(frozen=True)
class Component:
    """One line of the budget.

    Attributes
    ----------
    label : str
        Source of the uncertainty.
    kind : str
        ``A`` (statistics of readings) or ``B`` (other knowledge), GUM 4.2 and 4.3.
    u_rms, u_max : float
        Standard uncertainty, rms over the field and at its worst site, m or rad.
    dof : float
        Degrees of freedom; infinite if known.
    note : str
        How it was found.
    """

    label: str
    kind: str
    u_rms: float
    u_max: float
    dof: float
    note: str


@dataclass(frozen=True)
class Budget:
    """Components of one quantity and what they add up to.

    `unit` is ``m`` or ``rad``; `u_rms`, `u_max` the combined standard uncertainty; `dof` the
    effective degrees of freedom (Welch-Satterthwaite, GUM G.4); `k` the coverage factor for
    95.45 %; `U_rms`, `U_max` the expanded uncertainty.
    """

    quantity: str
    unit: str
    components: tuple[Component, ...]
    u_rms: float
    u_max: float
    dof: float
    k: float

    @property
    def U_rms(self) -> float:
        """Expanded uncertainty, rms over the field."""
        return self.k * self.u_rms

    @property
    def U_max(self) -> float:
        """Expanded uncertainty at the worst site."""
        return self.k * self.u_max


def budgets(result: CalibrationResult, reference: ReferenceLength | None = None) -> list[Budget]:
    """Return the budgets of the XY map (one coordinate) and, if there is one, of the angular map.

    Two of each: at the nodes of the map, where it was calibrated, and anywhere between them, where
    the interpolation errs as well.

    Parameters
    ----------
    result : CalibrationResult
        With its uncertainty map.
    reference : ReferenceLength, optional
        What set the scale.
    """
    emap, noise, artifact = result.error_map, result.noise, result.artifact
    power = np.stack([emap.u_gx, emap.u_gy]) ** 2
    of_terms = variance_of_terms(result)
    # the map's uncertainty holds the reference's and the terms', which have lines of their own
    power = power - sum(of_terms.values())
    if reference is not None:
        power = power - (reference.u_relative * np.stack([artifact.x_m, artifact.y_m])) ** 2
    dof = _dof(noise, "xy")
    parts = [_noise_part(np.sqrt(np.maximum(power, 0.0)), noise, "xy"),
             *(_term_part(result, name, variance, dof) for name, variance in of_terms.items()),
             _reference_part(artifact, reference)]
    nodes = _map_dof(result, reference)
    out = [_combine("XY, one coordinate at the nodes of the map", "m", parts, nodes),
           _combine("XY, one coordinate anywhere in the field, map interpolated between its nodes",
                    "m", parts, nodes, _interpolation_xy(result))]
    if np.isfinite(emap.u_g_theta).any():
        part = _noise_part(emap.u_g_theta, noise, "theta")
        lines = _dof(noise, "theta")
        out += [_combine("theta at the lines of the map", "rad", [part], lines),
                _combine("theta at any angle, map interpolated between its lines", "rad", [part],
                         lines, _interpolation_theta(result))]
    return out


def _map_dof(result: CalibrationResult, reference: ReferenceLength | None) -> float:
    """Return the degrees of freedom of the XY map's uncertainty; older results do not name them."""
    named = result.noise.dof_map_xy
    if not named > 0:
        noise = replace(result.noise, dof_xy=_dof(result.noise, "xy"))
        named = with_coverage(replace(result, noise=noise), reference).noise.dof_map_xy
    return named


def _dof(noise: Noise, kind: str) -> float:
    """Return the degrees of freedom of the noise behind the map; infinite if it is declared."""
    dof = getattr(noise, f"dof_{kind}")
    if dof > 0:
        return dof
    sigma = getattr(noise, f"sigma_{kind}")  # results of version 0.1 do not name them
    return next((getattr(noise, f"dof_{kind}_{way}") or np.inf for way in ("repeats", "residuals")
                 if getattr(noise, f"sigma_{kind}_{way}") == sigma), np.inf)


def _noise_part(u: np.ndarray, noise: Noise, kind: str) -> Component:
    """Return the noise of readings as it reaches the map."""
    sigma, repeats, residuals, p = (getattr(noise, name) for name in (
        f"sigma_{kind}", f"sigma_{kind}_repeats", f"sigma_{kind}_residuals", f"p_{kind}"))
    if not (np.isfinite(sigma) and sigma > 0):
        return Component("reading noise", "A", 0.0, 0.0, np.inf, "no noise was found")
    dof = _dof(noise, kind)
    if sigma == residuals:
        source = "residuals of the fit"
    elif sigma == repeats:
        source = "scatter of repeats"
    else:
        source = "declared by the detections"
    if p < F_LEVEL:
        source += ", the larger of two that contradict each other (see the verdict)"
    return Component("reading noise", "A" if np.isfinite(dof) else "B", rms(u),
                     float(np.nanmax(u)), dof, source)


def _term_part(result: CalibrationResult, name: str, variance: np.ndarray,
               dof: float) -> Component:
    """Return what a term with a size makes of the map's uncertainty.

    Of type A if the readings tell the term, of type B if its size does.
    """
    term = next(term for term in result.model.terms if term.name == name)
    size, left = term.solved_with, part_left(term)
    told = left < TOLD
    known = variance[:, result.error_map.valid]
    how = (f"given as {term.size:.3g}, which the readings contradict; they allow {size:.3g} and "
           if term.size_used else f"known to {size:.3g} beforehand; the readings ")
    note = f"{how}leave {left:.0%} of it"
    return Component(f"term {name}", "A" if told else "B", float(np.sqrt(known.mean())),
                     float(np.sqrt(known.max())), dof if told else np.inf, note)


def _reference_part(artifact: Artifact, reference: ReferenceLength | None) -> Component:
    if reference is None:
        return Component("reference length", "B", 0.0, 0.0, np.inf,
                         "none: the scale is a convention, and not part of the map")
    coordinates = np.stack([artifact.x_m, artifact.y_m])
    return Component("reference length", "B", reference.u_relative * rms(coordinates),
                     reference.u_relative * float(abs(coordinates).max()), np.inf,
                     f"relative {reference.u_relative:.3g} of the distance from the centre, "
                     f"by {reference.kind.value}")


def _interpolation_xy(result: CalibrationResult) -> Component:
    """Estimate the error of linear interpolation from the map's own curvature.

    A site less the mean of its neighbours errs as interpolation over two pitches does at the
    middle, four times as much as over one pitch, if the error is smooth. The part that noise
    explains is taken off.
    """
    emap = result.error_map
    squares = [_curvature(field, u, axis) for field, u in ((emap.gx, emap.u_gx),
                                                           (emap.gy, emap.u_gy))
               for axis in (0, 1)]
    # each coordinate errs by what both directions contribute
    middle = np.sqrt(max(sum(value for value, _ in squares) / 2, 0.0)) / 4
    worst = np.sqrt(max(largest for _, largest in squares)) / 4
    return Component("interpolation", "B", float(np.sqrt(CELL_MEAN) * middle), float(worst), np.inf,
                     "curvature of the map; assumes that it is smooth between sites")


def _interpolation_theta(result: CalibrationResult) -> Component:
    g, u = result.error_map.g_theta, result.error_map.u_g_theta
    ring, ring_u = (np.concatenate([a[-1:], a, a[:1]]) for a in (g, u))
    square, largest = _curvature(ring, ring_u, 0)
    return Component("interpolation", "B", float(np.sqrt(CELL_MEAN * max(square, 0.0)) / 4),
                     float(np.sqrt(largest) / 4), np.inf,
                     "curvature of the map; assumes that it is smooth between lines")


def _curvature(field: np.ndarray, u: np.ndarray, axis: int) -> tuple[float, float]:
    """Return mean and largest square of a site less the mean of its neighbours, noise taken off."""
    values, power = np.moveaxis(field, axis, 0), np.moveaxis(u, axis, 0) ** 2
    square = (values[1:-1] - (values[:-2] + values[2:]) / 2) ** 2
    square = square - (power[1:-1] + (power[:-2] + power[2:]) / 4)
    known = square[np.isfinite(square)]
    if not len(known):
        return 0.0, 0.0
    return float(known.mean()), float(max(known.max(), 0.0))


def _combine(quantity: str, unit: str, parts: list[Component], dof: float,
             between: Component | None = None) -> Budget:
    """Return a budget: that of the map, with `dof` degrees of freedom, and what is between."""
    if between is not None:
        at_nodes = sum(part.u_rms**2 for part in parts)
        parts = [*parts, between]
        if at_nodes > 0:
            dof = dof * (1 + between.u_rms**2 / at_nodes) ** 2
    u_rms, u_max = (float(np.sqrt(sum(getattr(p, name) ** 2 for p in parts)))
                    for name in ("u_rms", "u_max"))
    return Budget(quantity, unit, tuple(parts), u_rms, u_max, float(dof),
                  coverage_factor(float(dof)))


def budget_json(found: list[Budget]) -> list[dict[str, Any]]:
    """Return the budgets for ``extra["budget"]`` of a result: a row a component, SI units."""
    rows = []
    for budget in found:
        unit = budget.unit
        lines = [(p.label, p.kind, p.u_rms, p.u_max, p.dof, p.note) for p in budget.components]
        lines += [("combined", "", budget.u_rms, budget.u_max, budget.dof, ""),
                  ("expanded", "", budget.U_rms, budget.U_max, budget.dof,
                   f"k = {budget.k:.3f}, 95.45 % coverage")]
        for label, kind, u_rms, u_max, dof, note in lines:
            row: dict[str, Any] = {"quantity": budget.quantity, "component": label, "type": kind}
            for name in ("m", "rad"):
                row |= {f"u_rms_{name}": u_rms if name == unit else None,
                        f"u_max_{name}": u_max if name == unit else None}
            rows.append(row | {"dof": dof, "note": note})
    return rows


def budget_text(found: list[Budget]) -> list[str]:
    """Return the budgets as a table, um and arcsec."""
    lines = []
    for budget in found:
        factor, unit = (UM_PER_M, "um") if budget.unit == "m" else (ARCSEC_PER_RAD, "arcsec")
        lines += [f"uncertainty of {budget.quantity}, {unit}",
                  f"  {'component':18}{'type':>5}{'u rms':>12}{'u max':>12}{'dof':>10}  from"]
        for part in budget.components:
            dof = _dof_text(part.dof)
            lines.append(f"  {part.label:18}{part.kind:>5}{part.u_rms * factor:12.4g}"
                         f"{part.u_max * factor:12.4g}{dof:>10}  {part.note}")
        dof = _dof_text(budget.dof)
        lines += [f"  {'combined':18}{'':5}{budget.u_rms * factor:12.4g}"
                  f"{budget.u_max * factor:12.4g}{dof:>10}",
                  f"  {f'expanded, k = {budget.k:.2f}':23}{budget.U_rms * factor:12.4g}"
                  f"{budget.U_max * factor:12.4g}          95.45 % coverage"]
    return lines


def _dof_text(dof: float) -> str:
    return f"{dof:.0f}" if dof < MANY_DOF else "many"
