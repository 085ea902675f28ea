# SPDX-License-Identifier: Apache-2.0
"""Tables and lines for people: a validation, an uncertainty budget, next steps of a plan."""

from typing import Any

import numpy as np

from selfcal_ros.estimation.observability.plan_check import describe_view
from selfcal_ros.estimation.observability.suggest import Search, Suggestion
from selfcal_ros.estimation.quality.validation import HeldOut
from selfcal_ros.estimation.verdict.uncertainty import Budget
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.verdict import Finding
from selfcal_ros.model.view import Plan, View
from selfcal_ros.reporting.words.findings import held_out_text, line_text, sentence_of
from selfcal_ros.units import ARCSEC_PER_RAD, UM_PER_M


def why_text(why: Finding | None, artifact: Artifact) -> str:
    """Return why nothing could be predicted, or why it is not judged; empty for None."""
    if why is None or why.name != "rest_not_identified":
        return "" if why is None else sentence_of(why)
    more = "no single further view would change that"
    if add := (why.details or {}).get("add"):
        view = View("", add["rotation"], (add["translation_x"], add["translation_y"]),
                    add["grid"], add["angular"])
        more = f"with {describe_view(view, artifact)} measured as well it could be"
    return f"cannot be held out: the rest does not identify the stage; {more}"


def validation_json(found: list[HeldOut], artifact: Artifact) -> list[dict[str, Any]]:
    """Return the validation for ``extra["validation"]`` of a result: SI units."""
    return [{"name": held_out_text(item.view, item.tenth), "view": item.view,
             "n_grid": item.n_grid, "n_angular": item.n_angular, "rms_m": item.rms_m,
             "max_m": item.max_m, "rms_rad": item.rms_rad, "ratio": item.ratio,
             "note": why_text(item.why, artifact), "limit": item.limit,
             "exceeds": item.exceeds} for item in found]


def validation_text(found: list[HeldOut], artifact: Artifact) -> list[str]:
    """Return one line a held-out set, µm and arcsec."""
    lines = []
    for item in found:
        name, why = held_out_text(item.view, item.tenth), why_text(item.why, artifact)
        if not item.n_grid and not item.n_angular:
            lines.append(f"{name}: {why}")
            continue
        parts = []
        if item.n_grid:
            parts.append(f"{item.n_grid} marks predicted within {item.rms_m * UM_PER_M:.4g} µm "
                         f"rms, {item.max_m * UM_PER_M:.4g} µm at most "
                         f"({item.ratio:.2f} times the noise{_limit_text(item, why)})")
        if item.n_angular:
            parts.append(f"{item.n_angular} lines within "
                         f"{item.rms_rad * ARCSEC_PER_RAD:.4g} arcsec rms")
        lines.append(f"{name}: " + ", ".join(parts))
    return lines


def _limit_text(item: HeldOut, why: str) -> str:
    if why:
        return f"; {why}"
    if not np.isfinite(item.limit):
        return ""
    return f", {'EXCEEDS' if item.exceeds else 'within'} the limit of {item.limit:.2f}"


COUNTED_DOF = 1e5
"""Degrees of freedom above which a number of them says nothing more."""

_QUANTITIES = {
    ("xy", False): "XY, one coordinate at the nodes of the map",
    ("xy", True): "XY, one coordinate anywhere in the field, map interpolated between its nodes",
    ("theta", False): "theta at the lines of the map",
    ("theta", True): "theta at any angle, map interpolated between its lines"}


def quantity_text(budget: Budget) -> str:
    """Return what a budget is of."""
    return _QUANTITIES[budget.quantity, budget.anywhere]


def budget_text(found: list[Budget]) -> list[str]:
    """Return the budgets as a table, µm and arcsec."""
    lines = []
    for budget in found:
        factor, unit = (UM_PER_M, "µm") if budget.unit == "m" else (ARCSEC_PER_RAD, "arcsec")
        lines += [f"uncertainty of {quantity_text(budget)}, {unit}",
                  f"  {'component':18}{'type':>5}{'u rms':>12}{'u max':>12}{'dof':>10}  from"]
        for line in budget.lines:
            lines.append(f"  {line.component:18}{line.kind:>5}{line.effect_rms * factor:12.4g}"
                         f"{line.effect_max * factor:12.4g}{dof_text(line.dof):>10}  "
                         f"{line.text or line_text(line)}")
        lines += [f"  {'combined':18}{'':5}{budget.u_rms * factor:12.4g}"
                  f"{budget.u_max * factor:12.4g}{dof_text(budget.dof):>10}",
                  f"  {f'expanded, k = {budget.k:.2f}':23}{budget.U_rms * factor:12.4g}"
                  f"{budget.U_max * factor:12.4g}          95.45 % coverage"]
    return lines


def dof_text(dof: float) -> str:
    """Return degrees of freedom as an integer, or ``many``."""
    return f"{dof:.0f}" if dof < COUNTED_DOF else "many"


def step_text(step: Suggestion, plan: Plan) -> str:
    """Return what a suggestion asks for.

    Parameters
    ----------
    step : Suggestion
        One of `rank_next`.
    plan : Plan
        The plan that it is a next step of.
    """
    if step.view is None:
        pairs = {(old.repeats, new.repeats)
                 for old, new in zip(plan.views, step.views, strict=True)}
        return f"visit the marks in the order {step.order}" + "".join(
            f", {new} repeats for {old}" for old, new in sorted(pairs) if new != old)
    if step.repeat_of is None:
        return "add " + describe_view(step.view, plan.artifact)
    before = plan.views[step.repeat_of]
    return f"measure view '{before.name}' {step.view.repeats} times, not {before.repeats}"


def search_text(search: Search) -> str:
    """Return how the best plan was searched."""
    how = ("greedy choice, then exchange of single views" if search.n_plans is None
           else f"all {search.n_plans} plans tried")
    size = search.size
    return how if size is None else f"{how} on a field of {size} x {size} sites"
