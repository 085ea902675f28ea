# SPDX-License-Identifier: Apache-2.0
"""Tables and lines for people: a validation, an uncertainty budget, next steps of a plan."""

import numpy as np

from selfcal_ros.estimation.observability import plan_check
from selfcal_ros.estimation.observability.resistance import PlanBudget, Removal
from selfcal_ros.estimation.observability.suggest import Search
from selfcal_ros.estimation.quality.validation import HeldOut
from selfcal_ros.estimation.verdict.uncertainty import Budget
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.budget import BudgetLine
from selfcal_ros.model.findings import Finding, RestNotIdentified
from selfcal_ros.model.parts import HeldOutFigures
from selfcal_ros.model.terms import TIMES
from selfcal_ros.model.view import Plan
from selfcal_ros.reporting.summary.numbers import arcsec, um
from selfcal_ros.reporting.words.findings import held_out_text, sentence_of
from selfcal_ros.reporting.words.observability import describe_view
from selfcal_ros.reporting.words.phrases import dof_text, line_text
from selfcal_ros.units import ARCSEC_PER_RAD, UM_PER_M


def why_text(why: Finding | None, artifact: Artifact) -> str:
    """Return why there is no prediction or no limit; empty for None."""
    if not isinstance(why, RestNotIdentified):
        return "" if why is None else sentence_of(why)
    more = "no single further view would change that"
    if why.add is not None:
        view = describe_view(why.add, artifact)
        more = f"with {view} measured as well it could be"
    return f"cannot be held out: the rest does not identify the stage; {more}"


def held_out_figures(
    held_out: list[HeldOut], artifact: Artifact
) -> tuple[HeldOutFigures, ...]:
    """Return the validation as a part of a result."""
    return tuple(
        HeldOutFigures(
            name=held_out_text(item.view, item.tenth),
            view=item.view,
            n_grid=item.n_grid,
            n_angular=item.n_angular,
            rms_m=item.rms_m,
            max_m=item.max_m,
            rms_rad=item.rms_rad,
            ratio=item.ratio,
            note=why_text(item.why, artifact),
            limit=item.limit,
            exceeds=bool(item.exceeds),
        )
        for item in held_out
    )


def validation_text(held_out: list[HeldOut], artifact: Artifact) -> list[str]:
    """Return one line for each held-out set, µm and arcsec."""
    lines = []
    for item in held_out:
        name = held_out_text(item.view, item.tenth)
        why = why_text(item.why, artifact)
        if not item.n_grid and not item.n_angular:
            lines.append(f"{name}: {why}")
            continue
        predictions = []
        if item.n_grid:
            predictions.append(
                f"{item.n_grid} marks predicted within {item.rms_m * UM_PER_M:.4g} µm "
                f"rms, {item.max_m * UM_PER_M:.4g} µm at most ({item.ratio:.2f} times "
                f"the noise{_limit_text(item, why)})"
            )
        if item.n_angular:
            predictions.append(
                f"{item.n_angular} lines within {item.rms_rad * ARCSEC_PER_RAD:.4g} arcsec rms"
            )
        lines.append(f"{name}: " + ", ".join(predictions))
    return lines


def _limit_text(item: HeldOut, why: str) -> str:
    if why:
        return f"; {why}"
    if not np.isfinite(item.limit):
        return ""
    return f", {'EXCEEDS' if item.exceeds else 'within'} the limit of {item.limit:.2f}"


_QUANTITIES = {
    ("xy", False): "XY, one coordinate at the nodes of the map",
    (
        "xy",
        True,
    ): "XY, one coordinate anywhere in the field, map interpolated between its nodes",
    ("theta", False): "theta at the lines of the map",
    ("theta", True): "theta at any angle, map interpolated between its lines",
}


def quantity_text(budget: Budget) -> str:
    """Return the quantity of a budget."""
    return _QUANTITIES[budget.quantity, budget.anywhere]


def budget_text(budgets: list[Budget]) -> list[str]:
    """Return the budgets as a table, µm and arcsec."""
    lines = []
    for budget in budgets:
        factor, unit = (
            (UM_PER_M, "µm") if budget.unit == "m" else (ARCSEC_PER_RAD, "arcsec")
        )
        lines += [
            f"uncertainty of {quantity_text(budget)}, {unit}",
            f"  {'component':22}{'type':>5}{'u rms':>12}{'u max':>12}{'dof':>10}  from",
        ]
        for line in budget.lines:
            lines.append(
                f"  {line.component:22}{line.kind:>5}{line.effect_rms * factor:12.4g}"
                f"{line.effect_max * factor:12.4g}{dof_text(line.dof):>10}  "
                f"{line.text or line_text(line)}"
            )
        lines += [
            f"  {'combined':22}{'':5}{budget.u_rms * factor:12.4g}"
            f"{budget.u_max * factor:12.4g}{dof_text(budget.dof):>10}",
            f"  {f'expanded, k = {budget.k:.2f}':27}{budget.U_rms * factor:12.4g}"
            f"{budget.U_max * factor:12.4g}          95.45 % coverage",
        ]
    return lines


_CERTIFICATES: dict[str, str] = {
    "microscope": "declare the microscope (--microscope), from a certificate of its scale",
    "plate_strain": "declare a smaller plate_strain:SIZE, from support and temperature",
    "line_eccentricity": "declare a smaller line_eccentricity:SIZE, from a certificate",
    "line_scale": "declare a smaller line_scale:SIZE, from a certificate",
    "yaw": "declare a smaller yaw:SIZE, from a measurement of the stage's angles",
}
"""What removes a line of a plan's budget that no change of the plan removes."""
_SIZES = {"xy": um, "theta": arcsec}
"""How sizes of a quantity are written, as in results."""


def plan_budget_text(budget: PlanBudget, plan: Plan) -> list[str]:
    """Return the predicted budget of a plan as a table, with what removes each line."""
    out = ["predicted uncertainty budget (standard uncertainty, rms):"]
    for quantity, name in (("xy", "XY, one coordinate"), ("theta", "theta")):
        size = _SIZES[quantity]
        lines = [line for line in budget.lines if line.quantity == quantity]
        for line in lines:
            removal = budget.removals.get((quantity, line.component))
            out.append(
                f"  {name if line is lines[0] else '':20}{line.component:18}"
                f"{size(line.effect_rms):>13}{100 * budget.share(line):5.0f} %"
                + ("" if removal is None else f"  {removal_text(removal, line, plan)}")
            )
        if lines:
            expanded, noise = (
                size(2 * budget.u_rms(quantity, noise_only=only))
                for only in (False, True)
            )
            larger = size(2 * budget.u_rms(quantity, if_larger=True))
            out.append(
                f"  {'':20}{'U (k = 2)':18}{expanded:>13}; from noise alone {noise}; {larger} "
                f"if all that is assumed were {TIMES} times as large"
            )
    return out


def removal_text(removal: Removal, line: BudgetLine, plan: Plan) -> str:
    """Return what removes a line of a plan's budget, and what is left of it."""
    if removal.step is None:
        return _CERTIFICATES.get(
            line.component, f"declare a smaller {line.component}:SIZE"
        )
    left = _SIZES[line.quantity](removal.effect_rms)
    return f"{step_text(removal.step, plan)}: {left}"


def step_text(step: plan_check.Step, plan: Plan) -> str:
    """Return the description of a change of a plan.

    Parameters
    ----------
    step : Step
        The change, such as a suggestion of `rank_next`.
    plan : Plan
        The plan before it.
    """
    if step.view is None and not step.order:
        return (
            f"add check_stops: {{marks: {plan_check.CHECK_MARKS}, "
            f"offset: {plan_check.CHECK_OFFSET_M * UM_PER_M:g}e-6}}"
        )
    if step.view is None:
        pairs = {
            (old.repeats, new.repeats)
            for old, new in zip(plan.views, step.views, strict=True)
        }
        return f"visit the marks in the order {step.order}" + "".join(
            f", {new} repeats for {old}" for old, new in sorted(pairs) if new != old
        )
    if step.repeat_of is None:
        return "add " + describe_view(step.view, plan.artifact)
    before = plan.views[step.repeat_of]
    return (
        f"measure view '{before.name}' {step.view.repeats} times, not {before.repeats}"
    )


def search_text(search: Search) -> str:
    """Return how the best plan was searched."""
    how = (
        "greedy choice, then exchange of single views"
        if search.n_plans is None
        else f"all {search.n_plans} plans tried"
    )
    size = search.size
    return how if size is None else f"{how} on a field of {size} x {size} sites"
