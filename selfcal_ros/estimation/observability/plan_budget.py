# SPDX-License-Identifier: Apache-2.0
"""The predicted uncertainty budget of a plan: noise of the readings, and assumed terms.

What the readings will not determine of a term with a size stays in U (GUM type B). What removes it
is found by trying: check stops, another visiting order, a further view.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from selfcal_ros.blocks import block_of
from selfcal_ros.estimation.multifrontal.factor import one_thread
from selfcal_ros.estimation.normal.systems import planned_system
from selfcal_ros.estimation.observability.plan_check import (
    PROXY_SIZE,
    Step,
    check_stops,
    more_views,
    other_orders,
    smaller,
    unit_repeats,
)
from selfcal_ros.estimation.observability.prediction import MAX_SITES, Prediction
from selfcal_ros.estimation.terms.equations import FREE, roots_by_term
from selfcal_ros.estimation.terms.planned import Assumed, planned_equations
from selfcal_ros.model.terms import ModelTerm
from selfcal_ros.model.verdict import BudgetLine
from selfcal_ros.model.view import Plan

NOISE = "reading noise"

QUANTITIES = ("xy", "theta")

MATTERS = 0.05
"""Share of u^2 from which a change of the plan that removes a line is sought."""

NEGLIGIBLE = 1e-6
"""Share of the noise below which a term has no line."""

REMOVED = 0.7
"""Part of a line that may be left by what removes it."""

SEARCH_SIZE = 11
"""Largest field on which removals are tried."""

CERTIFICATE = "certificate"
"""Kind of a removal: better knowledge of the term, given as its size."""


@dataclass(frozen=True)
class Removal:
    """What removes a line of the budget, and what is left of it.

    `kind` is ``check_stops``, ``order``, ``view`` or ``certificate``; `step` is the change of the
    plan, None for a certificate; `effect_rms` is what is left, m or rad, 0 for a certificate.
    """

    kind: str
    step: Step | None = None
    effect_rms: float = 0.0


@dataclass(frozen=True)
class PlanBudget:
    """Lines of the predicted budget, the noise first, and what removes them.

    Attributes
    ----------
    lines : tuple of BudgetLine
        Of the XY map and, if lines are measured, of the angular map.
    removals : dict
        Removal of the line of each (quantity, component) that matters.
    """

    lines: tuple[BudgetLine, ...]
    removals: Mapping[tuple[str, str], Removal]

    def u_rms(self, quantity: str, *, noise_only: bool = False) -> float:
        """Return the standard uncertainty, rms over the map; NaN without such a map."""
        parts = [line.effect_rms for line in self.lines if line.quantity == quantity
                 and (line.component == NOISE or not noise_only)]
        return float(np.sqrt(np.sum(np.square(parts)))) if parts else float("nan")

    def share(self, line: BudgetLine) -> float:
        """Return the share of a line in u^2."""
        return (line.effect_rms / self.u_rms(line.quantity)) ** 2


@one_thread()
def plan_budget(plan: Plan, terms: Sequence[ModelTerm], assumed: Assumed,
                alone: Prediction, *, asked: Iterable[str] = ()) -> PlanBudget:
    """Return the predicted budget of a plan that identifies the stage and its free terms.

    Parameters
    ----------
    plan : Plan
        The views.
    terms : sequence of ModelTerm
        All terms of the model, assumed ones included.
    assumed : Assumed
        Noise, offsets, visiting order.
    alone : Prediction
        Uncertainty without terms, from `predict_plan`.
    asked : iterable of str
        The terms that somebody declared; the others are defaults.
    """
    if plan.artifact.shape[0] * plan.artifact.shape[1] > MAX_SITES:
        plan = smaller(plan, PROXY_SIZE)
    declared, n = set(asked), unit_repeats(plan)
    effects = effects_of_terms(plan, terms, assumed) if terms else {}
    free = effects.pop(FREE, None)
    lines = []
    for at, (quantity, sigma, unit, gains) in enumerate((
            ("xy", assumed.sigma_m, "m", np.stack([alone.ux, alone.uy]).reshape(2, -1)),
            ("theta", assumed.sigma_rad, "rad", alone.u_theta))):
        if not gains.size:
            continue
        known = np.isfinite(gains)
        noise = (gains**2 * sigma**2 / n + (0.0 if free is None else free[at]))[known]
        lines.append(_line(quantity, NOISE, noise, u=sigma, unit=unit, source="readings"))
        for term in terms:
            effect = effects[term.name][at][known] if term.name in effects else np.zeros(1)
            if effect.mean() > NEGLIGIBLE * noise.mean():
                source = "declared" if term.name in declared else "default"
                lines.append(_line(quantity, str(term.name), effect, u=term.size,
                                   unit=term.block.unit, source=source))
    budget = PlanBudget(tuple(lines), {})
    return replace(budget, removals=_removals(budget, plan, terms, assumed))


def _line(quantity: str, component: str, variance: np.ndarray, *, u: float, unit: str,
          source: str) -> BudgetLine:
    return BudgetLine(
        quantity, component, "A" if component == NOISE else "B", float("nan"), u, unit,
        float(np.sqrt(variance.mean())), float(np.sqrt(variance.max())), np.inf, source)


def effects_of_terms(plan: Plan, terms: Iterable[ModelTerm], assumed: Assumed,
                     ) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return the variances of the XY map (2, sites), m^2, and of the lines (K,), rad^2, by term."""
    system = planned_system(plan.artifact, plan.views)
    equations = planned_equations(plan, system, terms, assumed)
    roots = roots_by_term(equations.inverse(assumed.sigma_m), equations.columns)
    return {name: equations.variances(assumed.sigma_m**2 * root @ root.T) for name, root in roots}


def _removals(budget: PlanBudget, plan: Plan, terms: Sequence[ModelTerm],
              assumed: Assumed) -> dict[tuple[str, str], Removal]:
    """Return what removes each line that matters; tried on a field of at most SEARCH_SIZE sites."""
    judged = smaller(plan, SEARCH_SIZE) if max(plan.artifact.shape) > SEARCH_SIZE else plan
    tried: dict[tuple, dict[str, tuple[np.ndarray, np.ndarray]]] = {}

    def effect(step: Step, line: BudgetLine) -> float:
        if step.views not in tried:
            tried[step.views] = effects_of_terms(
                replace(judged, views=step.views), terms, assumed)
        at = tried[step.views].get(line.component)
        return 0.0 if at is None else float(np.sqrt(at[QUANTITIES.index(line.quantity)].mean()))

    out = {}
    for line in budget.lines:
        if line.component == NOISE or not budget.share(line) > MATTERS:
            continue
        kind, steps = _changes(plan, line.component)
        now = effect(Step(None, plan.views), line)
        best = min(((effect(step, line), step) for step in steps), default=None,
                   key=lambda item: item[0])
        out[line.quantity, line.component] = (
            Removal(CERTIFICATE) if best is None or best[0] > REMOVED * now else
            Removal(kind, best[1], line.effect_rms * best[0] / now))
    return out


def _changes(plan: Plan, name: str) -> tuple[str, list[Step]]:
    """Return the kind of change that may determine a term, and the changes of that kind."""
    steps = {"check_stops": check_stops, "order": other_orders, "view": more_views}
    change = block_of(name).change
    return change, steps[change](plan)
