# SPDX-License-Identifier: Apache-2.0
"""Uncertainty budget of a calibrated map as the GUM asks for it: labelled components, k, U."""

from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from selfcal_ros.estimation.joint.noise import F_LEVEL, coverage_factor
from selfcal_ros.estimation.joint.solved import ANGULAR_KEY, variance_of_terms
from selfcal_ros.estimation.options import ReferenceLength
from selfcal_ros.estimation.verdict.enlarge import TOLD, remaining_part, with_coverage
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.result import CalibrationResult, Noise
from selfcal_ros.model.statistics import rms

CELL_MEAN = 8 / 15
"""Mean square of the parabola 4 s (1 - s) over a cell: rms of an interpolation error."""


class How:
    """How a component was found: each kind has its data as fields, SI units."""


class Source(Enum):
    """What the noise behind a map is told by."""

    RESIDUALS = "residuals"
    REPEATS = "repeats"
    DECLARED = "declared"


@dataclass(frozen=True)
class FromReadings(How):
    """Noise of readings by its source; None: there is none. `contradicted`: by another source."""

    source: Source | None
    contradicted: bool = False


@dataclass(frozen=True)
class FromTerm(How):
    """A term that was known to `given` beforehand, of which the readings leave a part.

    `allowed` is the size that was used instead where the readings contradict it, else None.
    """

    given: float
    allowed: float | None
    remaining_part: float


@dataclass(frozen=True)
class FromEffect(How):
    """A cause that the readings show and no term of the model holds: its effect on the map."""

    cause: str


@dataclass(frozen=True)
class FromReference(How):
    """The relative uncertainty and kind of a reference length; None: no length sets the scale."""

    reference: ReferenceLength | None


@dataclass(frozen=True)
class FromCurvature(How):
    """Interpolation between ``sites`` or ``lines``, by the curvature of the map."""

    between: str


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
    how : How
        How it was found.
    """

    label: str
    kind: str
    u_rms: float
    u_max: float
    dof: float
    how: How


@dataclass(frozen=True)
class Budget:
    """Components of one quantity and what they add up to.

    `quantity` is ``xy`` (one coordinate) or ``theta``, `anywhere` whether the map is interpolated
    between its nodes or lines; `unit` is ``m`` or ``rad``; `u_rms`, `u_max` the combined standard
    uncertainty; `dof` the effective degrees of freedom (Welch-Satterthwaite, GUM G.4); `k` the
    coverage factor for 95.45 %; `U_rms`, `U_max` the expanded uncertainty.
    """

    quantity: str
    anywhere: bool
    components: tuple[Component, ...]
    u_rms: float
    u_max: float
    dof: float
    k: float

    @property
    def unit(self) -> str:
        """Unit of the uncertainties."""
        return "m" if self.quantity == "xy" else "rad"

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
    out = [_combine("xy", parts, nodes),
           _combine("xy", parts, nodes, _interpolation_xy(result))]
    if np.isfinite(emap.u_g_theta).any():
        kept = {name: np.asarray(u, dtype=float)
                for name, u in result.extra.get(ANGULAR_KEY, {}).items()}
        own = emap.u_g_theta**2 - sum(u**2 for u in kept.values())
        lines = _dof(noise, "theta")
        parts = [_noise_part(np.sqrt(np.maximum(own, 0.0)), noise, "theta"),
                 *(_angular_part(result, name, u, lines) for name, u in kept.items())]
        out += [_combine("theta", parts, lines),
                _combine("theta", parts, lines, _interpolation_theta(result))]
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
        return Component("reading noise", "A", 0.0, 0.0, np.inf, FromReadings(None))
    dof = _dof(noise, kind)
    source = (Source.RESIDUALS if sigma == residuals else
              Source.REPEATS if sigma == repeats else Source.DECLARED)
    return Component("reading noise", "A" if np.isfinite(dof) else "B", rms(u),
                     float(np.nanmax(u)), dof, FromReadings(source, p < F_LEVEL))


def _term_part(result: CalibrationResult, name: str, variance: np.ndarray,
               dof: float) -> Component:
    """Return what a term with a size makes of the map's uncertainty.

    Of type A if the readings tell the term, of type B if its size does.
    """
    known = variance[:, result.error_map.valid]
    term = next((term for term in result.model.terms if term.name == name), None)
    if term is None:
        return Component(f"effect {name}", "B", float(np.sqrt(known.mean())),
                         float(np.sqrt(known.max())), np.inf, FromEffect(name))
    part = remaining_part(term)
    told = part < TOLD
    how = FromTerm(term.size or term.solved_with, term.size_used, part)
    return Component(f"term {name}", "A" if told else "B", float(np.sqrt(known.mean())),
                     float(np.sqrt(known.max())), dof if told else np.inf, how)


def _angular_part(result: CalibrationResult, name: str, u: np.ndarray, dof: float) -> Component:
    """Return what a term of the lines makes of the uncertainty of the angular map."""
    term = next(term for term in result.model.terms if term.name == name)
    part = remaining_part(term)
    told = part < TOLD
    return Component(f"term {name}", "A" if told else "B", rms(u), float(u.max(initial=0.0)),
                     dof if told else np.inf, FromTerm(term.size or term.solved_with,
                                                       term.size_used, part))


def _reference_part(artifact: Artifact, reference: ReferenceLength | None) -> Component:
    if reference is None:
        return Component("reference length", "B", 0.0, 0.0, np.inf, FromReference(None))
    coordinates = np.stack([artifact.x_m, artifact.y_m])
    return Component("reference length", "B", reference.u_relative * rms(coordinates),
                     reference.u_relative * float(abs(coordinates).max()), np.inf,
                     FromReference(reference))


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
                     FromCurvature("sites"))


def _interpolation_theta(result: CalibrationResult) -> Component:
    g, u = result.error_map.g_theta, result.error_map.u_g_theta
    ring, ring_u = (np.concatenate([a[-1:], a, a[:1]]) for a in (g, u))
    square, largest = _curvature(ring, ring_u, 0)
    return Component("interpolation", "B", float(np.sqrt(CELL_MEAN * max(square, 0.0)) / 4),
                     float(np.sqrt(largest) / 4), np.inf,
                     FromCurvature("lines"))


def _curvature(field: np.ndarray, u: np.ndarray, axis: int) -> tuple[float, float]:
    """Return mean and largest square of a site less the mean of its neighbours, noise taken off."""
    values, power = np.moveaxis(field, axis, 0), np.moveaxis(u, axis, 0) ** 2
    square = (values[1:-1] - (values[:-2] + values[2:]) / 2) ** 2
    square = square - (power[1:-1] + (power[:-2] + power[2:]) / 4)
    known = square[np.isfinite(square)]
    if not len(known):
        return 0.0, 0.0
    return float(known.mean()), float(max(known.max(), 0.0))


def _combine(quantity: str, parts: list[Component], dof: float,
             between: Component | None = None) -> Budget:
    """Return a budget: that of the map, with `dof` degrees of freedom, and what is between."""
    if between is not None:
        at_nodes = sum(part.u_rms**2 for part in parts)
        parts = [*parts, between]
        if at_nodes > 0:
            dof = dof * (1 + between.u_rms**2 / at_nodes) ** 2
    u_rms, u_max = (float(np.sqrt(sum(getattr(p, name) ** 2 for p in parts)))
                    for name in ("u_rms", "u_max"))
    return Budget(quantity, between is not None, tuple(parts), u_rms, u_max, float(dof),
                  coverage_factor(float(dof)))
