# SPDX-License-Identifier: Apache-2.0
"""Uncertainty budget of a calibrated map as the GUM asks for it: labelled components, k, U."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import norm
from scipy.stats import t as student

from selfcal_ros.estimation.options import ReferenceLength
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.model.statistics import rms
from selfcal_ros.units import ARCSEC_PER_RAD, UM_PER_M

COVERAGE = 0.9545
"""Probability of the expanded uncertainty: k = 2 for many degrees of freedom."""

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

    Parameters
    ----------
    result : CalibrationResult
        With its uncertainty map.
    reference : ReferenceLength, optional
        What set the scale.
    """
    emap, noise, artifact = result.error_map, result.noise, result.artifact
    u = np.stack([emap.u_gx, emap.u_gy])
    if reference is not None:
        # the map's uncertainty holds the reference's, which has a line of its own
        own = reference.u_relative * np.stack([artifact.x_m, artifact.y_m])
        u = np.sqrt(np.maximum(u**2 - own**2, 0.0))
    parts = _noise_parts(u, noise.sigma_xy, repeats=(noise.sigma_xy_repeats,
                                                     noise.dof_xy_repeats),
                         residuals=(noise.sigma_xy_residuals, noise.dof_xy_residuals))
    parts += [_reference_part(artifact, reference), _interpolation_xy(result)]
    out = [_combine("XY, one coordinate at any point of the field", "m", parts)]
    if np.isfinite(emap.u_g_theta).any():
        parts = _noise_parts(emap.u_g_theta, noise.sigma_theta,
                             repeats=(noise.sigma_theta_repeats, noise.dof_theta_repeats),
                             residuals=(noise.sigma_theta_residuals, noise.dof_theta_residuals))
        out.append(_combine("theta at any angle", "rad", [*parts, _interpolation_theta(result)]))
    return out


def _noise_parts(u: np.ndarray, sigma: float, *, repeats: tuple[float, float],
                 residuals: tuple[float, float]) -> list[Component]:
    """Return what repeats show, and what residuals show beyond it, as they reach the map."""
    if not (np.isfinite(sigma) and sigma > 0):
        return [Component("reading noise", "A", 0.0, 0.0, np.inf, "no noise was found")]
    gain_rms, gain_max = rms(u) / sigma, float(np.nanmax(u)) / sigma
    if sigma not in (repeats[0], residuals[0]):
        level, dof, kind, base = sigma, np.inf, "B", "declaration"
        source = "declared by the detections"
    elif repeats[1] > 0:
        (level, dof), kind, base, source = repeats, "A", "repeats", "scatter of repeats"
    else:
        level, dof, kind, base, source = sigma, residuals[1], "A", "", "residuals of the fit"
    out = [Component("reading noise", kind, gain_rms * level, gain_max * level, dof, source)]
    if base:
        beyond_what = "scatter of repeats" if base == "repeats" else "declared noise"
        beyond = float(np.sqrt(max(residuals[0]**2 - level**2, 0.0))) if residuals[1] else 0.0
        out.append(Component(f"beyond {base}", "A", gain_rms * beyond, gain_max * beyond,
                             residuals[1] or np.inf, f"residuals beyond the {beyond_what}: drift, "
                             "seating, slow vibration"))
    return out


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


def _combine(quantity: str, unit: str, parts: list[Component]) -> Budget:
    u_rms, u_max = (float(np.sqrt(sum(getattr(p, name) ** 2 for p in parts)))
                    for name in ("u_rms", "u_max"))
    spread = sum(part.u_rms**4 / part.dof for part in parts)
    dof = u_rms**4 / spread if spread > 0 else np.inf
    tail = (1 - COVERAGE) / 2
    k = float(student.isf(tail, dof) if np.isfinite(dof) else norm.isf(tail))
    return Budget(quantity, unit, tuple(parts), u_rms, u_max, float(dof), k)


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
