# SPDX-License-Identifier: Apache-2.0
"""A plan against the terms of the model: separability, effect on the map, detection.

With c the columns of a term outside the model, b its coefficients, F = G(c) the maps of
its columns, and the model's own columns m (method, terms of the model), the map changes by
    (F_c - F_m Q m'Rc) b,     Q = cov of the model's coefficients, R = residual projection,
and the residuals explain, in units of the noise, a sum of squares distributed as
    sum_k (1 + lambda_k s^2 / sigma^2) chi^2(1)     for coefficients of standard deviation s,
with lambda_k the eigenvalues of the information on b given the model.

The predicted budget has the noise of the readings and the assumed terms. What the readings will not
determine of a term with a size stays in U (GUM type B). What removes it is found by trying: check
stops, another visiting order, a further view.
"""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import fdtri

from selfcal_ros.blocks import block_of, blocks
from selfcal_ros.errors import NotIdentifiableError
from selfcal_ros.estimation.multifrontal.factor import one_thread
from selfcal_ros.estimation.normal.equations import TRACE, planned_system
from selfcal_ros.estimation.observability.plan_check import (
    SEARCH_SIZE,
    Prediction,
    Step,
    check_stops,
    more_views,
    other_orders,
    predicted_on,
    unit_repeats,
)
from selfcal_ros.estimation.observability.rank import smaller
from selfcal_ros.estimation.options import OWED
from selfcal_ros.estimation.terms.equations import (
    FREE,
    TermEquations,
    require_terms_determined,
    roots_by_term,
)
from selfcal_ros.estimation.terms.planned import (
    Assumed,
    planned_equations,
    rows_of,
    with_terms,
)
from selfcal_ros.model.budget import READING_NOISE, BudgetLine
from selfcal_ros.model.error_map import rms
from selfcal_ros.model.result import Observability
from selfcal_ros.model.terms import TIMES, UNDETERMINED, ModelTerm, nominal_terms
from selfcal_ros.model.view import Plan

DRAWS = 20_000
"""Draws for the power, whose standard error is at most 0.4 %."""


@dataclass(frozen=True)
class TermCheck:
    """Check of a plan against one term.

    Attributes
    ----------
    name : str
        Which.
    model : str
        In the model as ``free`` or ``sized``; empty if not in the model.
    unseen_modes : int
        Modes of the stage hidden by it if free, together with the model's other free terms.
    size : float
        Standard deviation of its coefficients for the following, in `unit`.
    effect_rms_m, effect_max_m : float
        Standard deviation of a coordinate of the map if the model does not contain it: root mean
        square over the sites, and largest, m.
    power : float
        Probability that the test for causes then detects it, 0 to 1.
    """

    name: str
    model: str
    unseen_modes: int
    size: float
    effect_rms_m: float
    effect_max_m: float
    power: float

    @property
    def determined(self) -> bool:
        """Whether the readings separate it from the stage."""
        return self.unseen_modes == 0

    @property
    def unit(self) -> str:
        """SI unit of `size`."""
        return block_of(self.name).unit


def nominal_sizes() -> dict[str, float]:
    """Return the sizes for which the effects of terms on a plan are stated, by name."""
    return {name: block.nominal for name, block in blocks().items() if block.nominal}


class PlannedTerms:
    """All terms with the grid readings of a plan that identifies the stage.

    Fields above UNASKED_SITES are evaluated on a smaller one.

    Parameters
    ----------
    plan : Plan
        The views.
    model : sequence of ModelTerm
        Terms to be estimated with the map.
    assumed : Assumed
        Noise, stop errors, visiting order.
    against : iterable of str, optional
        Further terms that are checked: those without a nominal size.
    """

    @one_thread()
    def __init__(
        self,
        plan: Plan,
        model: Sequence[ModelTerm],
        assumed: Assumed,
        against: Iterable[str] = (),
    ) -> None:
        plan = predicted_on(plan)
        self.model, self.assumed = tuple(model), assumed
        self.repeats = unit_repeats(plan)
        system = planned_system(plan.artifact, plan.views)
        names = {*nominal_sizes(), *against, *(term.name for term in self.model)}
        # with any size all columns exist; their own is in `with_terms`
        sized = [
            ModelTerm(name, block.nominal or 1.0)
            for name, block in blocks().items()
            if name in names
        ]
        self.all_terms = planned_equations(plan, system, sized, assumed)
        self.of_model = with_terms(self.all_terms, self.model)

    def with_free_terms(self, observability: Observability) -> Observability:
        """Return the observability of the plan with the free terms of its model as unknowns.

        Parameters
        ----------
        observability : Observability
            Observability without them.
        """
        try:
            require_terms_determined(self.of_model, observability)
        except NotIdentifiableError as error:
            return error.observability
        free = int(self.of_model.free.sum())
        return replace(
            observability,
            rank=observability.rank + free,
            unknowns=observability.unknowns + free,
        )

    @one_thread()
    def check(self, name: str, size: float, level: float) -> TermCheck:
        """Return the check of the plan against a term.

        Parameters
        ----------
        name : str
            Which.
        size : float
            Standard deviation of its coefficients.
        level : float
            Level of the test for causes.
        """
        rms, largest = self._effect(name, size)
        kinds = {term.name: "free" if term.free else "sized" for term in self.model}
        return TermCheck(
            name=name,
            model=kinds.get(name, ""),
            unseen_modes=self._unseen_modes(name),
            size=size,
            effect_rms_m=rms,
            effect_max_m=largest,
            power=self._power(name, size, level),
        )

    @one_thread()
    def predicted(self, without_terms: Prediction) -> Prediction:
        """Return a prediction with the contribution of the model's terms added."""
        return with_part_of_terms(without_terms, self.of_model, self.repeats)

    def _other_terms(self, name: str) -> list[ModelTerm]:
        return [term for term in self.model if term.name != name]

    def _unseen_modes(self, name: str) -> int:
        free_terms = [term for term in self._other_terms(name) if term.free]
        before, after = (
            self.all_terms.unseen(rows_of(self.all_terms.columns, terms)).shape[1]
            for terms in (free_terms, [*free_terms, ModelTerm(name)])
        )
        return after - before

    def _effect(self, name: str, size: float) -> tuple[float, float]:
        """Return rms and largest effect of the term on the map."""
        all_terms = self.all_terms
        term = self.all_terms.rows([name])
        model, explained, _ = self._remainder(
            name, self._other_terms(name), self.assumed.sigma_m
        )
        fields = all_terms.maps[:, term] - all_terms.maps[:, model] @ explained
        known_sites = all_terms.system.known_sites.ravel()
        spread = size * np.sqrt(
            np.stack([(fields.real**2).sum(axis=1), (fields.imag**2).sum(axis=1)])[
                :, known_sites
            ]
        )
        return rms(spread), float(spread.max())

    def _power(self, name: str, size: float, level: float) -> float:
        all_terms = self.all_terms
        other_terms = [ModelTerm(term.name) for term in self._other_terms(name)]
        others = rows_of(all_terms.columns, other_terms)
        rank_of_others = others.sum() - all_terms.undetermined(others).shape[1]
        values, rank = self._information(name, other_terms)
        grid = all_terms.system.grid
        dof = (
            2 * grid.n_readings
            - all_terms.system.rank_grid
            + all_terms.columns.within.dof
            - rank_of_others
            - rank
        )
        if rank == 0 or dof <= 0:
            return 0.0
        rng = np.random.default_rng(1)
        ratio = (size / self.assumed.sigma_m) ** 2
        explained = rng.chisquare(1, (DRAWS, rank)) @ (1 + ratio * values)
        noise = rng.chisquare(dof, DRAWS) / dof
        return float(np.mean(explained / rank / noise > fdtri(rank, dof, 1 - level)))

    def _remainder(
        self, name: str, other_terms: Sequence[ModelTerm], sigma_m: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the columns of other terms, bool (p,), and what they take of those of a term.

        The latter (o, t), and the information that is left on the term, (t, t).
        """
        all_terms = self.all_terms
        term = self.all_terms.rows([name])
        of_others = with_terms(all_terms, other_terms)
        columns = rows_of(all_terms.columns, other_terms)
        cross = all_terms.information[np.ix_(columns, term)]
        explained = of_others.inverse(sigma_m) @ of_others.unbiased_sums(cross)
        return (
            columns,
            explained,
            all_terms.information[np.ix_(term, term)] - cross.T @ explained,
        )

    def _information(
        self, name: str, other_terms: Sequence[ModelTerm]
    ) -> tuple[np.ndarray, int]:
        """Return the eigenvalues of the information on a term given others, and its rank."""
        all_terms = self.all_terms
        term = self.all_terms.rows([name])
        information = self._remainder(name, other_terms, 0.0)[2]
        norm = all_terms.norm[term]
        scaled = np.linalg.eigvalsh(information / np.outer(norm, norm))
        rank = int((scaled > all_terms.limit(term)).sum())
        return np.linalg.eigvalsh(information)[len(information) - rank :], rank


def with_part_of_terms(
    without_terms: Prediction, terms: TermEquations, repeats: int
) -> Prediction:
    """Return a prediction with the contribution of terms added.

    Parameters
    ----------
    without_terms : Prediction
        Without terms.
    terms : TermEquations
        Their equations.
    repeats : int
        Repeats of the averaged reading whose noise is the unit.
    """
    of_xy, lines = terms.variances(terms.inverse(terms.noise_m) * repeats)
    u_xy = without_terms.u_xy
    u_theta = (
        np.sqrt(without_terms.u_theta**2 + terms.line_weight * lines)
        if (len(without_terms.u_theta))
        else without_terms.u_theta
    )
    return replace(
        without_terms,
        u_xy=np.sqrt(u_xy**2 + of_xy.reshape(u_xy.shape)),
        u_theta=u_theta,
    )


def check_terms(
    planned: PlannedTerms, sizes: Mapping[str, float], level: float
) -> tuple[TermCheck, ...]:
    """Return the checks against all terms; `sizes` override the nominal ones."""
    sizes_of_model = {term.name: term.size for term in planned.model if not term.free}
    all_sizes = nominal_sizes() | sizes_of_model | dict(sizes)
    return tuple(
        planned.check(name, all_sizes[name], level)
        for name in blocks()
        if name in all_sizes
    )


QUANTITIES = ("xy", "theta")

REMOVED = 0.7
"""Part of a line that may be left by what removes it."""

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
    if_larger : tuple of BudgetLine
        The lines if all that is assumed by default were `TIMES` as large.
    """

    lines: tuple[BudgetLine, ...]
    removals: Mapping[tuple[str, str], Removal]
    if_larger: tuple[BudgetLine, ...] = ()

    def u_rms(
        self, quantity: str, *, noise_only: bool = False, if_larger: bool = False
    ) -> float:
        """Return the standard uncertainty, rms over the map; NaN without such a map."""
        effects_m = [
            line.effect_rms
            for line in (self.if_larger if if_larger else self.lines)
            if line.quantity == quantity
            and (line.component == READING_NOISE or not noise_only)
        ]
        return (
            float(np.sqrt(np.sum(np.square(effects_m)))) if effects_m else float("nan")
        )

    def share(self, line: BudgetLine) -> float:
        """Return the share of a line in u^2."""
        return (line.effect_rms / self.u_rms(line.quantity)) ** 2


@one_thread()
def plan_budget(
    plan: Plan,
    terms: Sequence[ModelTerm],
    assumed: Assumed,
    without_terms: Prediction,
    *,
    declared: Iterable[str] = (),
) -> PlanBudget:
    """Return the predicted budget of a plan that identifies the stage and its free terms.

    Parameters
    ----------
    plan : Plan
        The views.
    terms : sequence of ModelTerm
        All terms of the model, assumed ones included.
    assumed : Assumed
        Noise, offsets, visiting order.
    without_terms : Prediction
        Uncertainty without terms, from `predict_plan`.
    declared : iterable of str
        The terms that somebody declared, also to be zero; the others are defaults.
    """
    plan, declared = predicted_on(plan), set(declared)
    budget = _budget(plan, terms, assumed, without_terms, declared=declared)
    if more := _undetermined_terms(budget, plan, terms, assumed, declared=declared):
        terms = [*terms, *more]
        budget = _budget(plan, terms, assumed, without_terms, declared=declared)
    larger = [term if term.name in declared else term.scaled(TIMES) for term in terms]
    return replace(
        budget,
        removals=_removals(budget, plan, terms, assumed),
        if_larger=_budget(
            plan, larger, assumed, without_terms, declared=declared
        ).lines,
    )


def _budget(
    plan: Plan,
    terms: Sequence[ModelTerm],
    assumed: Assumed,
    without_terms: Prediction,
    *,
    declared: Collection[str],
) -> PlanBudget:
    """Return the lines of the budget."""
    n = unit_repeats(plan)
    effects = effects_of_terms(plan, terms, assumed) if terms else {}
    free = effects.pop(FREE, None)
    lines = []
    for at, (quantity, sigma, unit, gains) in enumerate(
        (
            ("xy", assumed.sigma_m, "m", without_terms.u_xy.reshape(2, -1)),
            ("theta", assumed.sigma_rad, "rad", without_terms.u_theta),
        )
    ):
        if not gains.size:
            continue
        determined = np.isfinite(gains)
        noise = (gains**2 * sigma**2 / n + (0.0 if free is None else free[at]))[
            determined
        ]
        lines.append(
            _line(quantity, READING_NOISE, noise, u=sigma, unit=unit, source="readings")
        )
        for term in terms:
            effect = (
                effects[term.name][at][determined]
                if term.name in effects
                else np.zeros(1)
            )
            if effect.mean() > TRACE * noise.mean():
                source = "declared" if term.name in declared else "default"
                lines.append(
                    _line(
                        quantity,
                        str(term.name),
                        effect,
                        u=term.size,
                        unit=term.block.unit,
                        source=source,
                    )
                )
    return PlanBudget(tuple(lines), {})


def _undetermined_terms(
    budget: PlanBudget,
    plan: Plan,
    terms: Sequence[ModelTerm],
    assumed: Assumed,
    *,
    declared: Iterable[str],
) -> list[ModelTerm]:
    """Return the terms that readings of the plan will not determine: they will be assumed."""
    more = nominal_terms({*declared, *(term.name for term in terms)}, visits=True)
    effects = effects_of_terms(plan, [*terms, *more], assumed) if terms and more else {}
    least = (UNDETERMINED * budget.u_rms("xy")) ** 2
    return [
        term
        for term in more
        if term.name in effects and effects[term.name][0].mean() > least
    ]


def _line(
    quantity: str,
    component: str,
    variance: np.ndarray,
    *,
    u: float,
    unit: str,
    source: str,
) -> BudgetLine:
    return BudgetLine(
        quantity=quantity,
        component=component,
        kind="A" if component == READING_NOISE else "B",
        value=float("nan"),
        u=u,
        unit=unit,
        effect_rms=float(np.sqrt(variance.mean())),
        effect_max=float(np.sqrt(variance.max())),
        source=source,
    )


def effects_of_terms(
    plan: Plan, terms: Iterable[ModelTerm], assumed: Assumed
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return the variances of the XY map (2, sites), m^2, and of the lines (K,), rad^2, by term."""
    system = planned_system(plan.artifact, plan.views)
    equations = planned_equations(plan, system, terms, assumed)
    roots = roots_by_term(equations.inverse(assumed.sigma_m), equations.columns)
    return {
        name: equations.variances(assumed.sigma_m**2 * root @ root.T)
        for name, root in roots
    }


def _removals(
    budget: PlanBudget, plan: Plan, terms: Sequence[ModelTerm], assumed: Assumed
) -> dict[tuple[str, str], Removal]:
    """Return what removes each line that matters; tried on a field of at most SEARCH_SIZE sites."""
    judged = smaller(plan, SEARCH_SIZE)
    tried: dict[tuple, dict[str, tuple[np.ndarray, np.ndarray]]] = {}

    def effect(step: Step, line: BudgetLine) -> float:
        if step.views not in tried:
            tried[step.views] = effects_of_terms(
                replace(judged, views=step.views), terms, assumed
            )
        at = tried[step.views].get(line.component)
        return (
            0.0
            if at is None
            else float(np.sqrt(at[QUANTITIES.index(line.quantity)].mean()))
        )

    out = {}
    for line in budget.lines:
        if line.component == READING_NOISE or not budget.share(line) > OWED:
            continue
        kind, steps = _changes(plan, line.component)
        now = effect(Step(None, plan.views), line)
        # the first of equal ones
        best = min(
            ((effect(step, line), step) for step in steps),
            default=None,
            key=lambda item: float(f"{item[0]:.9g}"),
        )
        out[line.quantity, line.component] = (
            Removal(CERTIFICATE)
            if best is None or best[0] > REMOVED * now
            else Removal(kind, best[1], line.effect_rms * best[0] / now)
        )
    return out


def _changes(plan: Plan, name: str) -> tuple[str, list[Step]]:
    """Return the kind of change that may determine a term, and the changes of that kind."""
    steps = {"check_stops": check_stops, "order": other_orders, "view": more_views}
    change = block_of(name).change
    return change, steps[change](plan)
