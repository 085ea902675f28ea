# SPDX-License-Identifier: Apache-2.0
"""A plan against the terms of the model: separability, effect on the map, detection.

With c the columns of a term outside the model, b its coefficients, F = G(c) the maps of
its columns, and the model's own columns m (method, terms of the model), the map changes by
    (F_c - F_m Q m'Rc) b,     Q = cov of the model's coefficients, R = residual projection,
and the residuals explain, in units of the noise, a sum of squares distributed as
    sum_k (1 + lambda_k s^2 / sigma^2) chi^2(1)     for coefficients of standard deviation s,
with lambda_k the eigenvalues of the information on b given the model.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.special import fdtri

from selfcal_ros.blocks import block_of, blocks
from selfcal_ros.errors import NotIdentifiableError
from selfcal_ros.estimation.multifrontal.factor import one_thread
from selfcal_ros.estimation.normal.systems import planned_system
from selfcal_ros.estimation.observability.plan_check import PROXY_SIZE, smaller, unit_repeats
from selfcal_ros.estimation.observability.prediction import MAX_SITES, Prediction
from selfcal_ros.estimation.terms.equations import TermEquations
from selfcal_ros.estimation.terms.planned import (
    SEED,
    Assumed,
    planned_equations,
    rows_of,
    with_terms,
)
from selfcal_ros.estimation.terms.sizes import require_terms_told
from selfcal_ros.model.error_map import rms
from selfcal_ros.model.result import Observability
from selfcal_ros.model.terms import ModelTerm
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
    def told(self) -> bool:
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

    Fields above MAX_SITES are evaluated on a smaller one.

    Parameters
    ----------
    plan : Plan
        The views.
    model : sequence of ModelTerm
        Terms to be estimated with the map.
    assumed : Assumed
        Noise, stop errors, visiting order.
    """

    @one_thread()
    def __init__(self, plan: Plan, model: Sequence[ModelTerm], assumed: Assumed) -> None:
        artifact = plan.artifact
        if artifact.shape[0] * artifact.shape[1] > MAX_SITES:
            plan = smaller(plan, PROXY_SIZE)
        self.model, self.assumed = tuple(model), assumed
        self.repeats = unit_repeats(plan)
        system = planned_system(plan.artifact, plan.views)
        sized = [ModelTerm(name, size) for name, size in nominal_sizes().items()]
        self.every = planned_equations(plan, system, sized, assumed)
        self.of_model = with_terms(self.every, self.model)

    def require_told(self, seen: Observability) -> None:
        """Raise NotIdentifiableError if free terms of the model hide modes of the stage."""
        if self.of_model.free.any():
            require_terms_told(self.of_model, seen)

    def told(self, seen: Observability) -> Observability:
        """Return the observability of the plan with the free terms of its model as unknowns.

        Parameters
        ----------
        seen : Observability
            Observability without them.
        """
        try:
            self.require_told(seen)
        except NotIdentifiableError as error:
            found = error.observability
            return found if isinstance(found, Observability) else seen
        free = int(self.of_model.free.sum())
        return replace(seen, rank=seen.rank + free, unknowns=seen.unknowns + free)

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
        return TermCheck(name, kinds.get(name, ""), self._unseen_modes(name), size, rms, largest,
                         self._power(name, size, level))

    @one_thread()
    def predicted(self, alone: Prediction) -> Prediction:
        """Return the prediction `alone` with the contribution of the model's terms added."""
        return with_part_of_terms(alone, self.of_model, self.repeats)

    def _others(self, name: str) -> list[ModelTerm]:
        return [term for term in self.model if term.name != name]

    def _unseen_modes(self, name: str) -> int:
        others = [term for term in self._others(name) if term.free]
        return (_n_unseen(with_terms(self.every, [*others, ModelTerm(name)]))
                - _n_unseen(with_terms(self.every, others)))

    def _effect(self, name: str, size: float) -> tuple[float, float]:
        """Return rms and largest effect of the term on the map."""
        every, others = self.every, self._others(name)
        term, model = every.rows([name]), rows_of(every.columns, others)
        beside = with_terms(every, others)
        taken = beside.inverse(self.assumed.sigma_m) @ beside.unbiased_sums(
            every.information[np.ix_(model, term)])
        fields = every.maps[:, term] - every.maps[:, model] @ taken
        known = every.system.known_sites.ravel()
        spread = size * np.sqrt(np.stack([(fields.real**2).sum(axis=1),
                                          (fields.imag**2).sum(axis=1)])[:, known])
        return rms(spread), float(spread.max())

    def _power(self, name: str, size: float, level: float) -> float:
        every, others = self.every, self._others(name)
        beside = with_terms(every, [ModelTerm(term.name) for term in others])
        values, rank = self._information(name, beside)
        grid = every.system.grid
        dof = (2 * grid.n_readings - every.system.rank_grid + every.columns.within.dof
               - beside.rank() - rank)
        if rank == 0 or dof <= 0:
            return 0.0
        squares, state = _squares(rank)
        ratio = (size / self.assumed.sigma_m) ** 2
        explained = squares @ (1 + ratio * values)
        rng = np.random.default_rng()
        rng.bit_generator.state = state
        noise = rng.chisquare(dof, DRAWS) / dof
        return float(np.mean(explained / rank / noise > fdtri(rank, dof, 1 - level)))

    def _information(self, name: str, beside: TermEquations) -> tuple[np.ndarray, int]:
        """Return the eigenvalues of the information on a term given others, and its rank."""
        every = self.every
        term = every.rows([name])
        others = rows_of(every.columns,
                         [ModelTerm(n) for n in {c.term for c in beside.columns.columns}])
        cross = every.information[np.ix_(others, term)]
        rest = every.information[np.ix_(term, term)] - cross.T @ beside.inverse(
            0.0) @ beside.unbiased_sums(cross)
        norm = every.norm[term]
        scaled = np.linalg.eigvalsh(rest / np.outer(norm, norm))
        rank = int((scaled > every.limit(term)).sum())
        return np.linalg.eigvalsh(rest)[len(rest) - rank:], rank


@lru_cache(maxsize=8)
def _squares(rank: int) -> tuple[np.ndarray, Mapping[str, Any]]:
    """Return chi^2(1) draws (DRAWS, rank), and the state of their generator after them."""
    rng = np.random.default_rng(SEED)
    return rng.chisquare(1, (DRAWS, rank)), rng.bit_generator.state


def with_part_of_terms(alone: Prediction, terms: TermEquations, repeats: int) -> Prediction:
    """Return a prediction with the contribution of terms added.

    Parameters
    ----------
    alone : Prediction
        Without terms.
    terms : TermEquations
        Their equations.
    repeats : int
        Repeats of the averaged reading whose noise is the unit.
    """
    (x, y), lines = terms.variances(terms.inverse(terms.noise_m) * repeats)
    shape = alone.ux.shape
    u_theta = np.sqrt(alone.u_theta**2 + terms.line_weight * lines) if (
        len(alone.u_theta)) else alone.u_theta
    return replace(alone, ux=np.sqrt(alone.ux**2 + x.reshape(shape)),
                   uy=np.sqrt(alone.uy**2 + y.reshape(shape)), u_theta=u_theta)


def check_terms(planned: PlannedTerms, sizes: Mapping[str, float],
                level: float) -> tuple[TermCheck, ...]:
    """Return the checks against all terms; `sizes` override the nominal ones."""
    own = {term.name: term.size for term in planned.model if not term.free}
    wanted = nominal_sizes() | own | dict(sizes)
    return tuple(planned.check(name, wanted[name], level) for name in nominal_sizes())


def _n_unseen(equations: TermEquations) -> int:
    if not equations.n:
        return 0
    return equations.unseen(np.ones(equations.n, dtype=bool)).shape[1]
