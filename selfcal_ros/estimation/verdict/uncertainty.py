# SPDX-License-Identifier: Apache-2.0
"""The uncertainty of a map: enlarged by effects that the readings show, coverage factor, budget.

An effect e of known size is added in quadrature at every node, u'^2 = u^2 + e^2, so that k u'
covers a map that contains it. L = e / sigma is a further factor of the map's covariance, which
comparisons of maps and budgets use. The budget lists labelled components as the GUM asks for.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from selfcal_ros.blocks import block_of, blocks, traits_of
from selfcal_ros.estimation.joint.problem import F_LEVEL, coverage_factor
from selfcal_ros.estimation.joint.solve import factors_of, variance_of_terms
from selfcal_ros.estimation.normal.angular import MAX_FULL
from selfcal_ros.estimation.options import OWED
from selfcal_ros.model.artifact import Interpolation
from selfcal_ros.model.budget import (
    READING_NOISE,
    BudgetLine,
    OfAssumption,
    OfCause,
    OfNoise,
    OfReference,
    OfTerm,
)
from selfcal_ros.model.error_map import (
    CELL_MEAN,
    ErrorMap,
    along_axes,
    error_at_edges,
    error_halfway,
    rms,
)
from selfcal_ros.model.kept import NOISE, rounded
from selfcal_ros.model.readings import lines_turned_over, turned_over
from selfcal_ros.model.reference import ReferenceLength
from selfcal_ros.model.result import CalibrationResult, Noise
from selfcal_ros.model.terms import TIMES
from selfcal_ros.model.verdict import Enlargement, TermResult

DETERMINED_BELOW = 0.5
"""Share of a term's size left by the readings below which they determine the term (type A)."""


@dataclass(frozen=True, eq=False)
class Effect:
    """Effect of a cause on the maps, stage frame.

    Attributes
    ----------
    name : str
        Name of the cause.
    xy : float array (2, nx, ny)
        Effect on Gx and Gy, m.
    theta : float array (K,)
        Effect on Gtheta, rad.
    plate : float array (2, nx, ny), optional
        Effect on Ax and Ay, m; if it is not known each mark has the rms of that on the stage.
    """

    name: str
    xy: np.ndarray
    theta: np.ndarray
    plate: np.ndarray | None = None

    @property
    def unit(self) -> str:
        """``m``, or ``rad`` if only the angular map changes."""
        return "m" if self.xy.any() else "rad"


def effect_of_field(
    name: str, field: np.ndarray, sense: str, theta: np.ndarray
) -> Effect:
    """Return an effect that is given in the frame of the equations.

    Parameters
    ----------
    name : str
        Name of the cause.
    field, theta : complex array (nx, ny), float array (K,)
        Effect on the maps, m and rad.
    sense : str
        Sense of the measurement.
    """
    field = turned_over(sense, field)
    return Effect(
        name, np.stack([field.real, field.imag]), lines_turned_over(sense, theta)
    )


def effect_everywhere(
    name: str,
    emap: ErrorMap,
    *,
    size_m: float | np.ndarray = 0.0,
    size_rad: float = 0.0,
) -> Effect:
    """Return an effect of a size on every known node and line.

    Its sign changes from node to node: the datum takes nothing of it out.
    """
    sign = 1 - 2 * (np.indices(emap.gx.shape).sum(axis=0) % 2)
    return Effect(
        name,
        np.where(emap.valid, sign * size_m, np.zeros((2, 1, 1))),
        np.where(np.isfinite(emap.g_theta), size_rad, 0.0),
    )


def difference(
    name: str, result: CalibrationResult, other: CalibrationResult
) -> Effect:
    """Return the difference of two maps of the same readings; 0 where one is unknown."""
    a, b = result.error_map, other.error_map
    theta = a.g_theta - b.g_theta
    if np.isfinite(theta).any():
        theta = theta - np.nanmean(theta)
    return Effect(
        name, np.nan_to_num(np.stack([a.gx - b.gx, a.gy - b.gy])), np.nan_to_num(theta)
    )


def enlarged(result: CalibrationResult, effects: Iterable[Effect]) -> CalibrationResult:
    """Return the result with effects added to its uncertainties and saved factors."""
    effects = [effect for effect in effects if effect.xy.any() or effect.theta.any()]
    if not effects:
        return result
    emap, plate, kept_parts = result.error_map, result.artifact_map, result.kept
    power = np.sum([effect.xy**2 for effect in effects], axis=0)
    of_plate, of_fields = np.zeros((2, 2, *plate.ax.shape))
    for effect in effects:
        added = np.mean(effect.xy**2) if effect.plate is None else effect.plate**2
        of_plate += added
        if effect.name != NOISE:  # it is no field, but more of what there is
            of_fields += added
    u_theta = np.sqrt(emap.u_g_theta**2 + sum(effect.theta**2 for effect in effects))
    if emap.gx.size <= MAX_FULL and result.noise.sigma_xy > 0:
        before = factors_of(result)
        sigma = result.noise.sigma_xy
        kept_parts = replace(
            kept_parts,
            factors=replace(
                before,
                terms=(*before.terms, *(effect.name for effect in effects)),
                of_map=np.concatenate(
                    [before.of_map, [rounded(effect.xy / sigma) for effect in effects]]
                ),
                on_plate=rounded(of_fields / sigma**2),
            ),
        )
    turned = dict(kept_parts.angular)
    for effect in effects:
        if effect.theta.any():
            turned[effect.name] = np.hypot(turned.get(effect.name, 0.0), effect.theta)
    kept_parts = replace(kept_parts, angular=turned)
    emap = replace(
        emap,
        u_gx=np.sqrt(emap.u_gx**2 + power[0]),
        u_gy=np.sqrt(emap.u_gy**2 + power[1]),
        u_g_theta=u_theta,
    )
    if plate.u_ax.size:
        plate = replace(
            plate,
            u_ax=np.sqrt(plate.u_ax**2 + of_plate[0]),
            u_ay=np.sqrt(plate.u_ay**2 + of_plate[1]),
        )
    return replace(result, error_map=emap, artifact_map=plate, kept=kept_parts)


def enlargements(
    result: CalibrationResult, names: Iterable[str], effects: Iterable[Effect]
) -> tuple[Enlargement, ...]:
    """Return the contributions of terms, by name, and effects to u, the largest first.

    To u of the XY map; of terms of lines, and of effects that change it alone, to that of the
    angular map (rad).
    """
    variance = variance_of_terms(result)
    contributions = [
        Enlargement(name, float(np.sqrt(power.mean())), float(np.sqrt(power.max())))
        for name in dict.fromkeys(names)
        if (power := variance.get(name)) is not None
    ]
    for name in dict.fromkeys(names):
        if name in result.kept.angular and block_of(name).of_lines:
            u = result.kept.angular[name]
            contributions.append(
                Enlargement(name, rms(u), float(u.max(initial=0.0)), "rad")
            )
    for effect in effects:
        values = effect.xy if effect.unit == "m" else effect.theta
        contributions.append(
            Enlargement(
                effect.name,
                rms(values),
                float(np.abs(values).max(initial=0)),
                effect.unit,
            )
        )
    return tuple(sorted(contributions, key=lambda item: -item.u_rms))


def remaining_part(term: TermResult) -> float:
    """Return the share of a term's size that the readings leave: rms u over the size."""
    return rms(np.array([estimate.u for estimate in term.estimates])) / term.solved_with


def variance_of_reference(result: CalibrationResult) -> np.ndarray:
    """Return the contribution of the reference length to the variance, (2, nx, ny), m^2."""
    u = 0.0 if result.reference is None else result.reference.u_relative
    return (u * np.stack([result.artifact.x_m, result.artifact.y_m])) ** 2


def known_beforehand(result: CalibrationResult) -> np.ndarray:
    """Return the variance of the map that does not come from readings, (2, nx, ny), m^2."""
    power = variance_of_reference(result)
    terms = {term.name: term for term in result.model.terms}
    for name, variance in variance_of_terms(result).items():
        if _is_undetermined(terms.get(name)):
            power += variance
    return power


def _is_undetermined(term: TermResult | None) -> bool:
    """Return whether the readings do not determine a term; an effect is none."""
    return term is None or remaining_part(term) >= DETERMINED_BELOW


def with_coverage(result: CalibrationResult) -> CalibrationResult:
    """Return the result with degrees of freedom and k of the uncertainty of both maps.

    Without an uncertainty map k is that of the noise.
    """
    noise, emap = result.noise, result.error_map
    terms = {term.name: term for term in result.model.terms}
    of_lines = sum(
        (
            u**2
            for name, u in result.kept.angular.items()
            if _is_undetermined(terms.get(name))
        ),
        np.zeros(emap.u_g_theta.shape),
    )
    changed: dict[str, float] = {}
    for kind, power, known_variance in (
        ("xy", emap.u_xy**2, known_beforehand(result)),
        ("theta", emap.u_g_theta**2, of_lines),
    ):
        dof = getattr(noise, f"dof_{kind}")
        at = np.isfinite(power)
        if dof > 0 and known_variance[at].any():
            total = float(power[at].mean())
            of_readings = max(total - float(known_variance[at].mean()), 0.0)
            dof *= (total / of_readings) ** 2 if of_readings > 0 else float("inf")
            changed[f"k_{kind}"] = coverage_factor(dof)
        changed[f"dof_map_{kind}"] = dof
    return replace(result, noise=replace(noise, **changed))


INTERPOLATION = "interpolation"
"""The component that only a map used between its nodes or lines has."""

TERM = "term "
"""Beginning of the component of a term of the model."""


@dataclass(frozen=True)
class Budget:
    """Budget of one quantity: its lines and their sum.

    `quantity` is ``xy`` (one coordinate) or ``theta``, `anywhere` whether the map is interpolated
    between its nodes or lines; `worst` is the standard uncertainty of the worst node or line;
    `unit` is ``m`` or ``rad``; `u_rms`, `u_max` the combined standard uncertainty; `dof` the
    effective degrees of freedom (Welch-Satterthwaite, GUM G.4); `k` the coverage factor for
    95.45 %; `U_rms`, `U_max` the expanded uncertainty.
    """

    quantity: str
    anywhere: bool
    lines: tuple[BudgetLine, ...]
    dof: float
    worst: float

    @property
    def unit(self) -> str:
        """Unit of the uncertainties."""
        return "m" if self.quantity == "xy" else "rad"

    @property
    def k(self) -> float:
        """Coverage factor for 95.45 %."""
        return coverage_factor(self.dof)

    @property
    def u_rms(self) -> float:
        """Combined standard uncertainty, rms over the field."""
        return float(np.sqrt(sum(line.effect_rms**2 for line in self.lines)))

    @property
    def u_max(self) -> float:
        """Combined standard uncertainty at the worst node; anywhere, at most."""
        return float(
            np.hypot(
                self.worst,
                sum(
                    line.effect_max
                    for line in self.lines
                    if line.component == INTERPOLATION
                ),
            )
        )

    @property
    def U_rms(self) -> float:
        """Expanded uncertainty, rms over the field."""
        return self.k * self.u_rms

    @property
    def U_max(self) -> float:
        """Expanded uncertainty at the worst node; anywhere, at most."""
        return self.k * self.u_max

    @property
    def assumptions(self) -> tuple[BudgetLine, ...]:
        """Lines that matter of default terms that the readings do not determine."""
        return tuple(
            line
            for line in self.lines
            if line.source == "default"
            and (
                line.component.startswith(TERM)
                and line.effect_rms**2 > OWED * self.u_rms**2
            )
        )

    @property
    def U_max_if_larger(self) -> float:
        """`U_max`, at most, if what is assumed were `TIMES` as large."""
        more = (TIMES**2 - 1) * sum(line.effect_max**2 for line in self.assumptions)
        return self.k * float(np.sqrt(self.u_max**2 + more))


def budgets(result: CalibrationResult) -> list[Budget]:
    """Return the budgets of the XY map (one coordinate) and, if there is one, of the angular map.

    Two of each: at the nodes of the map, and anywhere between them, where interpolation adds its
    error. None without an uncertainty map.
    """
    lines = result.budget or tuple(budget_lines(result))
    all_budgets = []
    emap = result.error_map
    for quantity, u in (("xy", emap.u_xy), ("theta", emap.u_g_theta)):
        dof = _or_infinite(result.noise.dof_of(quantity))
        anywhere = tuple(line for line in lines if line.quantity == quantity)
        nodes = tuple(line for line in anywhere if line.component != INTERPOLATION)
        at_nodes = sum(line.effect_rms**2 for line in nodes)
        between = sum(line.effect_rms**2 for line in anywhere[len(nodes) :])
        more = (1 + between / at_nodes) ** 2 if at_nodes > 0 else 1.0
        worst = float(np.max(u, initial=0.0, where=np.isfinite(u)))
        all_budgets += (
            [
                Budget(quantity, False, nodes, dof, worst),
                Budget(quantity, True, anywhere, dof * more, worst),
            ]
            if nodes
            else []
        )
    return all_budgets


def budget_lines(result: CalibrationResult) -> Iterator[BudgetLine]:
    """Yield the lines of the budget: noise, terms, reference, interpolation of each map.

    A result without an uncertainty map has none.
    """
    emap, noise = result.error_map, result.noise
    if not result.has_uncertainty:
        return
    power = emap.u_xy**2
    of_terms, of_reference = variance_of_terms(result), variance_of_reference(result)
    # the uncertainty of the map includes those of reference and terms, which have their own lines
    power = power - sum(of_terms.values()) - of_reference
    yield noise_line("xy", np.sqrt(np.maximum(power, 0.0)), noise)
    for name, variance in of_terms.items():
        yield _term_line("xy", name, np.sqrt(variance[:, emap.valid]), result)
    yield _reference_line(np.sqrt(of_reference), result.reference)
    yield _interpolation_xy(result)
    if np.isfinite(emap.u_g_theta).any():
        power_of_noise = emap.u_g_theta**2 - sum(
            u**2 for u in result.kept.angular.values()
        )
        yield noise_line("theta", np.sqrt(np.maximum(power_of_noise, 0.0)), noise)
        for name, u in result.kept.angular.items():
            yield _term_line("theta", name, u, result)
        yield _interpolation_theta(result)


def _dof(noise: Noise, kind: str) -> float:
    """Return the degrees of freedom of the noise behind the map; infinite if unknown."""
    return _or_infinite(float(getattr(noise, f"dof_{kind}")))


def _or_infinite(dof: float) -> float:
    return dof if dof > 0 else np.inf


def noise_line(
    kind: str, u: np.ndarray, noise: Noise, *, otherwise: str = "together"
) -> BudgetLine:
    """Return the contribution of the noise of readings to a map.

    `otherwise` is how the noise was found if it is that of neither residuals, repeats nor
    detections.
    """
    sigma, p = getattr(noise, f"sigma_{kind}"), getattr(noise, f"p_{kind}")
    unit = "m" if kind == "xy" else "rad"
    if not (np.isfinite(sigma) and sigma > 0):
        return BudgetLine(
            quantity=kind,
            component=READING_NOISE,
            kind="A",
            unit=unit,
            source="readings",
        )
    by = next(
        (
            source
            for source in ("residuals", "repeats", "declared")
            if getattr(noise, f"sigma_{kind}_{source}") == sigma
        ),
        otherwise,
    )
    return BudgetLine(
        quantity=kind,
        component=READING_NOISE,
        kind="B" if by == "declared" else "A",
        u=sigma,
        unit=unit,
        effect_rms=rms(u),
        effect_max=float(np.nanmax(u)),
        dof=_dof(noise, kind),
        source="declared" if by == "declared" else "readings",
        details=OfNoise(by, contradicted=bool(p < F_LEVEL)),
    )


def _term_line(
    quantity: str, name: str, u: np.ndarray, result: CalibrationResult
) -> BudgetLine:
    """Return the contribution of a term with a size, or of a cause, to a map's uncertainty.

    A term is of type A if the readings determine it, otherwise of type B.
    """
    effect_rms, effect_max = rms(u), float(u.max(initial=0.0))
    term = next((term for term in result.model.terms if term.name == name), None)
    if term is None:
        cause = next(
            (cause for cause in result.verdict.causes if cause.name == name), None
        )
        if cause is None and name in blocks():  # not determined by the readings
            block = block_of(name)
            return BudgetLine(
                quantity=quantity,
                component=TERM + name,
                kind="B",
                value=np.nan,
                u=block.nominal,
                unit=block.unit,
                effect_rms=effect_rms,
                effect_max=effect_max,
                source="default",
                details=OfAssumption(block.nominal),
            )
        value, u_value, unit = (
            (np.nan, np.nan, "m")
            if cause is None
            else (cause.size, cause.u, cause.unit)
        )
        return BudgetLine(
            quantity=quantity,
            component=f"effect {name}",
            kind="B",
            value=value,
            u=u_value,
            unit=unit,
            effect_rms=effect_rms,
            effect_max=effect_max,
            source="readings",
            details=OfCause(name),
        )
    remaining = remaining_part(term)
    determined = remaining < DETERMINED_BELOW
    by_images = (
        result.camera is not None
        and traits_of(name).of_microscope
        and term.source == "default"
    )
    largest = max(
        term.estimates, key=lambda estimate: abs(np.nan_to_num(estimate.value))
    )
    by_readings = determined or term.size_used or by_images
    return BudgetLine(
        quantity=quantity,
        component=TERM + name,
        kind="A" if determined else "B",
        value=largest.value,
        u=largest.u,
        unit=largest.unit,
        effect_rms=effect_rms,
        effect_max=effect_max,
        dof=_dof(result.noise, quantity) if determined else np.inf,
        source="readings" if by_readings else term.source,
        details=OfTerm(
            given=term.size or term.solved_with,
            allowed=term.size_used,
            remaining=remaining,
        ),
    )


def _reference_line(u: np.ndarray, reference: ReferenceLength | None) -> BudgetLine:
    if reference is None:
        return BudgetLine(
            quantity="xy",
            component="reference length",
            kind="B",
            unit="m/m",
            source="default",
        )
    return BudgetLine(
        quantity="xy",
        component="reference length",
        kind="B",
        value=reference.relative_error,
        u=reference.u_relative,
        unit="m/m",
        effect_rms=rms(u),
        effect_max=float(u.max()),
        source="declared",
        details=OfReference(str(reference.kind)),
    )


def _interpolation_xy(result: CalibrationResult) -> BudgetLine:
    """Estimate the error of interpolation; none where readings between the nodes show it.

    It is then lack of fit, part of the uncertainty at the nodes.
    """
    if result.is_fitted_between_nodes:
        return _interpolation("xy", 0.0, 0.0)
    emap = result.error_map
    all_known = bool(emap.valid.all())
    is_spline = all_known and result.interpolation == Interpolation.BICUBIC
    errors = along_axes(partial(error_halfway, cubic=is_spline), emap) ** 2
    edges = along_axes(error_at_edges, emap) ** 2
    cells = np.array(emap.valid.shape) - 1
    mean = errors[..., 0] + edges.sum(axis=2) / cells
    largest = errors[..., 1] + edges.max(axis=2)
    return _interpolation(
        "xy",
        float(np.sqrt(mean.sum(axis=1).mean())),
        float(np.sqrt(largest.sum(axis=1).max())),
    )


def _interpolation_theta(result: CalibrationResult) -> BudgetLine:
    if result.plate.harmonics:  # a Fourier series is known between the lines as on them
        return _interpolation("theta", 0.0, 0.0)
    emap = result.error_map
    return _interpolation(
        "theta", *error_halfway(emap.g_theta, emap.u_g_theta, ring=True)
    )


def _interpolation(quantity: str, halfway: float, largest: float) -> BudgetLine:
    u = float(np.sqrt(CELL_MEAN) * halfway)
    return BudgetLine(
        quantity=quantity,
        component=INTERPOLATION,
        kind="B",
        u=u,
        unit="m" if quantity == "xy" else "rad",
        effect_rms=u,
        effect_max=largest,
        source="readings",
    )
