# SPDX-License-Identifier: Apache-2.0
"""``selfcal plan``: make a plan, check it before anything moves, and suggest views."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from selfcal_ros.cli import plan_new, plan_terms
from selfcal_ros.cli.recheck import planned
from selfcal_ros.cli.terminal import busy, late_progress, say
from selfcal_ros.errors import ExitCode, InputError
from selfcal_ros.estimation.normal.equations import KNOWN
from selfcal_ros.estimation.observability.plan_check import (
    PlanCheck,
    Prediction,
    check_plan,
    predict_plan,
)
from selfcal_ros.estimation.observability.resistance import (
    PlanBudget,
    PlannedTerms,
    TermCheck,
    check_terms,
    plan_budget,
)
from selfcal_ros.estimation.observability.suggest import (
    Against,
    PlanScore,
    Suggestion,
    best_plan,
    rank_next,
)
from selfcal_ros.estimation.terms.equations import CAUSE_LEVEL
from selfcal_ros.estimation.terms.planned import Assumed
from selfcal_ros.files import write_yaml
from selfcal_ros.model.error_map import ThetaDatum
from selfcal_ros.model.plan_form import plan_to_dict, view_to_dict
from selfcal_ros.model.result import Observability
from selfcal_ros.model.terms import ModelTerm, in_order, parse_terms
from selfcal_ros.model.view import Plan, parse_order, reads_between_nodes
from selfcal_ros.outputs import check_outputs, plain
from selfcal_ros.reporting.summary.numbers import counted
from selfcal_ros.reporting.words.observability import worded_observability
from selfcal_ros.reporting.words.tables import plan_budget_text, search_text, step_text
from selfcal_ros.settings.estimator import read_plan
from selfcal_ros.units import MM_PER_M, UM_PER_M

SHOWN = 8
"""Default number of suggestions."""

HARMONICS_UNTESTED = (
    "the views of lines do not show whether the harmonics of the angular map suffice, and the "
    "result will not be qualified: read the lines in a further view at another turn"
)
NODES_UNTESTED = (
    "the readings do not show whether the nodes of the map suffice, and the result will not be "
    "qualified: read every mark twice (repeats: 2), add marks or views, or give the map fewer "
    "nodes"
)
NODES_ONLY = (
    "every reading lies at a node of the map: to test the error between nodes, add a view "
    "shifted by half a pitch along x and y, with nodes of the map's own (map:)"
)


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the sub-verbs ``new``, ``check`` and ``suggest``."""
    verbs = parser.add_subparsers(
        dest="plan_verb", metavar="new|check|suggest", required=True
    )
    plan_new.configure(
        verbs.add_parser(
            "new",
            help="write a plan and a CELL.yaml from what you know of stage, plate and time",
        )
    )
    check = verbs.add_parser(
        "check",
        help="rank, undetermined modes, predicted uncertainty; exit 3 if deficient",
    )
    suggest = verbs.add_parser(
        "suggest",
        help="rank the next views, or find the best plan for a number of views",
    )
    for sub in (check, suggest):
        sub.add_argument("plan", metavar="PLAN.yaml")
        sub.add_argument(
            "--theta-datum",
            choices=("xy_axes", "zero_mean"),
            default="zero_mean",
            help="convention of the angular map (default zero_mean)",
        )
        sub.add_argument("--json", action="store_true", help="print JSON")
        plan_terms.add_term_options(sub)
    check.add_argument(
        "--map",
        action="store_true",
        help="also print the predicted uncertainty at every site",
    )
    check.add_argument(
        "--model",
        metavar="TERM[:SIZE][,...]",
        action="append",
        default=[],
        help="terms to be estimated with the map, in addition to the plan's "
        "model_terms; without a size they are free, and exit code 3 means that "
        "the plan cannot separate them from the stage",
    )
    check.add_argument(
        "--repeats",
        type=int,
        metavar="N",
        help="judge the plan as if every mark were measured N times per view",
    )
    suggest.add_argument(
        "--views",
        type=int,
        metavar="N",
        help="find the best plan of N views for the plan's plate",
    )
    suggest.add_argument(
        "--criterion",
        choices=("rms", "max"),
        default="rms",
        help="which XY uncertainty to minimise (default rms)",
    )
    suggest.add_argument(
        "--top",
        type=int,
        metavar="N",
        help=f"number of suggestions to show (default {SHOWN})",
    )
    suggest.add_argument(
        "-o",
        "--output",
        metavar="PLAN.yaml",
        help="write the plan with the best suggestion",
    )


def run(args: argparse.Namespace) -> int:
    """Run the sub-verb and return its exit code."""
    if args.plan_verb == "new":
        return plan_new.run(args)
    plan = read_plan(args.plan)
    if plan.verify and len(plan.views) == 1:  # of the plate of the map
        plan = replace(plan, artifact_from=plan.artifact_from or plan.verify)
    if plan.artifact_from:
        return planned(
            args, _repeated(plan, args.repeats if args.plan_verb == "check" else None)
        )
    return _check(args, plan) if args.plan_verb == "check" else _suggest(args, plan)


@dataclass(frozen=True)
class JudgedPlan:
    """What is known of a plan before anything moves.

    Attributes
    ----------
    assumed : Assumed
        Noise and sizes that the budget goes by.
    model : tuple of ModelTerm
        Declared terms.
    check : PlanCheck
        Rank and unseen modes, those of the declared terms among them.
    alone, joint : Prediction or None
        Without and with the declared terms; None if the plan then does not identify the stage.
    terms : sequence of TermCheck
        What the plan shows of each declared term.
    budget : PlanBudget or None
        None if the plan does not identify the stage.
    """

    plan: Plan
    assumed: Assumed
    model: tuple[ModelTerm, ...]
    check: PlanCheck
    alone: Prediction | None
    joint: Prediction | None
    terms: Sequence[TermCheck]
    budget: PlanBudget | None


def _check(args: argparse.Namespace, plan: Plan) -> int:
    judged = _judged(args, plan)
    say(args, "\n".join(_text_of(args, judged)), _json_of(args, judged))
    identifiable = judged.check.observability.identifiable
    return ExitCode.DONE if identifiable else ExitCode.NOT_IDENTIFIABLE


def _judged(args: argparse.Namespace, plan: Plan) -> JudgedPlan:
    assumed, sizes = plan_terms.assumed_of(args), plan_terms.sizes_of(args)
    declared = plan_terms.declared_of(args, plan)
    model = tuple(term for term in declared if term.size > 0)
    plan = _repeated(plan, args.repeats)
    alone: Prediction | None = None
    joint: Prediction | None = None
    checks: Sequence[TermCheck] = ()
    budget: PlanBudget | None = None
    with busy("judging the plan"):
        checked = check_plan(plan)
        observability = checked.observability
        if observability.identifiable:
            alone = predict_plan(plan, ThetaDatum(args.theta_datum))
            observability, joint, checks = _with_terms(
                plan, model, assumed, sizes, (observability, alone)
            )
        if alone is not None and observability.identifiable:
            terms = (*model, *plan_terms.assumed_terms(args.model, declared, plan))
            budget = plan_budget(
                plan, terms, assumed, alone, declared=[term.name for term in declared]
            )
    checked = replace(checked, observability=worded_observability(observability))
    return JudgedPlan(plan, assumed, model, checked, alone, joint, checks, budget)


def _repeated(plan: Plan, repeats: int | None) -> Plan:
    if repeats is None:
        return plan
    if repeats < 1:
        raise InputError("--repeats", f"{repeats} is not positive", "give 1 or more")
    return replace(
        plan, views=tuple(replace(view, repeats=repeats) for view in plan.views)
    )


def _with_terms(
    plan: Plan,
    model: tuple[ModelTerm, ...],
    assumed: Assumed,
    sizes: dict[str, float],
    without: tuple[Observability, Prediction],
) -> tuple[Observability, Prediction | None, Sequence[TermCheck]]:
    """Return observability and prediction with terms, and the checks of the terms.

    `without`: observability and prediction without terms.
    """
    terms = PlannedTerms(plan, model, assumed, sizes)
    for term in model:
        if not terms.all_terms.rows([term.name]).any():
            raise InputError(
                f"model: {term.name}",
                "no reading of this plan depends on it",
                "leave it out of --model and of model_terms, or add what it acts on (angular "
                "lines, images of several marks)",
            )
    observability = terms.with_free_terms(without[0])
    joint = terms.predicted(without[1]) if observability.identifiable else None
    return observability, joint, check_terms(terms, sizes, CAUSE_LEVEL)


def _json_of(args: argparse.Namespace, judged: JudgedPlan) -> dict[str, Any]:
    checked, observability = judged.check, judged.check.observability
    return {
        "plan_id": judged.plan.plan_id,
        "rank": observability.rank,
        "unknowns": observability.unknowns,
        "deficiency": observability.deficiency,
        "identifiable": observability.identifiable,
        "modes": [mode.text for mode in observability.modes],
        "advice": [advice.text for advice in observability.advice],
        "predicted": _predicted_json(args, judged, judged.alone)
        if judged.alone
        else None,
        "unknown_sites": checked.unknown_sites if observability.identifiable else None,
        "unchecked_sites": observability.unchecked_sites,
        "unchecked_lines": observability.unchecked_lines,
        "harmonics_untested": checked.harmonics_untested,
        "nodes_untested": checked.nodes_untested,
        "budget": judged.budget
        and plan_terms.budget_json(judged.budget, judged.plan, judged.assumed),
        "terms": plan_terms.terms_json(judged.terms),
    }


def _predicted_json(
    args: argparse.Namespace, judged: JudgedPlan, alone: Prediction
) -> dict[str, Any]:
    """Return factors of the noise of an averaged reading; with ``--sigma`` µm as well."""
    joint = judged.joint
    unit = _averaged_m(judged.plan, judged.assumed) * UM_PER_M
    in_um = args.sigma is not None
    out: dict[str, Any] = {
        "rms_gain_xy": alone.rms_xy,
        "max_gain_xy": alone.max_xy,
        "rms_gain_theta": alone.rms_theta,
        "note": field_note(alone, judged.plan),
    }
    if args.map:
        u_gx, u_gy = alone.u_xy
        out |= {"u_gx": u_gx, "u_gy": u_gy, "u_g_theta": alone.u_theta}
    if in_um:
        out |= {
            "rms_u_xy_um": alone.rms_xy * unit,
            "max_u_xy_um": alone.max_xy * unit,
        }
    out |= {
        "rms_gain_xy_with_terms": joint and joint.rms_xy,
        "max_gain_xy_with_terms": joint and joint.max_xy,
    }
    if in_um and joint is not None:
        out |= {
            "rms_u_xy_um_with_terms": joint.rms_xy * unit,
            "max_u_xy_um_with_terms": joint.max_xy * unit,
        }
    return plain(out)


def _text_of(args: argparse.Namespace, judged: JudgedPlan) -> list[str]:
    plan, assumed = judged.plan, judged.assumed
    alone, joint = judged.alone, judged.joint
    in_um = args.sigma is not None
    lines = _check_text(plan, judged.check, alone)
    if alone is not None and in_um:
        lines.append(_in_um("XY    ", alone, plan, assumed))
    if judged.model and joint is not None:
        what = f"XY with {', '.join(map(str, judged.model))}:"
        lines.append(f"  {what} rms {joint.rms_xy:.4f}   largest {joint.max_xy:.4f}")
        if in_um:
            lines.append(_in_um(what, joint, plan, assumed))
    if judged.budget:
        lines += plan_budget_text(judged.budget, plan)
    if judged.terms:
        lines += plan_terms.terms_text(plan, judged.terms, assumed)
    if args.map and alone and judged.check.observability.identifiable:
        lines += _map_text(alone)
    return lines


def _check_text(
    plan: Plan, checked: PlanCheck, predicted: Prediction | None
) -> list[str]:
    artifact, image = plan.artifact, plan.image
    observability = checked.observability
    marks = (
        f"{artifact.shape[0]} x {artifact.shape[1]}"
        if artifact.marks is None
        else f"a list of {artifact.shape[0]}"
    )
    lines = [
        f"plan {plan.plan_id}: {counted(len(plan.views), 'view')} of {marks} marks, "
        f"{artifact.angular_count or 'no'} angular lines",
        *_nodes_text(plan),
        *([f"images of {image.nx} x {image.ny} marks"] if image else []),
        _rank_text(observability),
    ]
    if predicted is None or not observability.identifiable:
        lines += ["the plan does not identify the stage: it cannot determine"]
        lines += [f"  - {mode.text}" for mode in observability.modes]
        return [
            *lines,
            "to determine all of it,",
            *(f"  - {advice.text}" for advice in observability.advice),
        ]
    lines += [
        _known_text(plan, checked.unknown_sites),
        *([HARMONICS_UNTESTED] if checked.harmonics_untested else []),
        *([NODES_UNTESTED] if checked.nodes_untested else []),
        *_unchecked_text(observability),
        _check_stops_text(plan),
        *([] if _lines_show_their_sign(plan) else [LINES_SIGN]),
        *([] if reads_between_nodes(plan.views, artifact) else [NODES_ONLY]),
        "predicted standard uncertainty, in units of the noise of one averaged reading:",
        f"  XY     rms {predicted.rms_xy:.4f}   largest {predicted.max_xy:.4f}",
    ]
    if len(predicted.u_theta):
        lines.append(f"  theta  rms {predicted.rms_theta:.4f}")
    note = field_note(predicted, plan)
    return [*lines, *([f"  ({note})"] if note else [])]


def _rank_text(observability: Observability) -> str:
    """Return rank and unseen modes; the rank is that of the marks, without the lines."""
    lines = observability.deficiency - (observability.unknowns - observability.rank)
    modes = (
        counted(observability.deficiency, "undetermined mode")
        if observability.deficiency
        else "no undetermined modes"
    )
    return (
        f"rank {observability.rank} of {observability.unknowns} unknowns, {modes}"
        + (f", {lines} of them in the angular map" if lines else "")
    )


def _known_text(plan: Plan, unknown: int) -> str:
    nodes = math.prod(plan.artifact.field.shape)
    return "the plan identifies the stage" + (
        f" at {nodes - unknown} of {nodes} nodes of the map: the other {unknown} remain unknown "
        f"(standard uncertainty above {KNOWN:g} times the noise of a reading); add a view, or give "
        "the map fewer nodes"
        if unknown
        else ""
    )


def _nodes_text(plan: Plan) -> list[str]:
    """Return the nodes of a map that is not on the plate's lattice, in a line."""
    grid = plan.artifact.map_grid
    nx, ny = plan.artifact.field.shape
    nodes = (
        []
        if grid is None
        else [
            f"map of {nx} x {ny} nodes, {grid.pitch_m * MM_PER_M:.6g} mm apart, "
            f"{grid.interpolation} between them"
        ]
    )
    return nodes + (
        [f"angular map: Fourier series of {plan.artifact.harmonics} harmonics"]
        if plan.artifact.harmonics
        else []
    )


def _check_stops_text(plan: Plan) -> str:
    marks, offset_m = plan.check_stops
    if not marks and plan_terms.tells_camera(plan):
        return (
            "no check stops: images show scale, turn, distortion and sign of the camera"
        )
    if not marks:
        return (
            "no check stops: scale, turn and sign of the microscope show only if the stage "
            "happens to stop off its marks; add check_stops: {marks: 5, offset: 20e-6}"
        )
    return (
        f"check stops: {marks} marks of each grid view, {offset_m * UM_PER_M:g} µm off in x "
        f"and y: {4 * marks} more exposures"
    )


LINES_SIGN = (
    "marks and lines are read together in fewer than two views: the sign of the lines' offsets "
    "shows only if the stage happens to stop off its lines; read both in two views, the plate "
    "turned by 0.1 mrad or more between them"
)


def _lines_show_their_sign(plan: Plan) -> bool:
    """Return whether lines turn with the marks from view to view, or there are none."""
    together = sum(view.grid and view.angular for view in plan.views)
    return together > 1 or not any(view.angular for view in plan.views)


def _unchecked_text(observability: Observability) -> list[str]:
    counts = (
        (observability.unchecked_sites, "sites"),
        (observability.unchecked_lines, "lines"),
    )
    groups = " and ".join(f"{count} {what}" for count, what in counts if count)
    return (
        [
            f"{groups} depend on single readings that no other reading checks: another view would "
            "check them"
        ]
        if groups
        else []
    )


def field_note(predicted: Prediction, plan: Plan) -> str:
    """Return a note if a prediction is not for the plan's own field, else an empty string."""
    _, nx, ny = predicted.u_xy.shape
    return (
        ""
        if (nx, ny) == plan.artifact.field.shape
        else (
            f"predicted for a field of {nx} x {ny} sites; XY is about 5 % larger for "
            "each doubling of the field"
        )
    )


def _averaged_m(plan: Plan, assumed: Assumed) -> float:
    """Return the noise of an averaged reading of the plan, m."""
    return assumed.sigma_m / min(view.repeats for view in plan.views) ** 0.5


def _in_um(what: str, predicted: Prediction, plan: Plan, assumed: Assumed) -> str:
    unit = _averaged_m(plan, assumed) * UM_PER_M
    return (
        f"  {what} rms {predicted.rms_xy * unit:.4f} µm   largest "
        f"{predicted.max_xy * unit:.4f} µm (k=1) for {assumed.sigma_m * UM_PER_M:.4g} µm "
        "noise of one reading"
    )


def _map_text(predicted: Prediction) -> list[str]:
    u_x, u_y = predicted.u_xy
    u_xy = (u_x**2 + u_y**2) ** 0.5
    return [
        "sqrt(u_gx^2 + u_gy^2), one line for each y from the top, x to the right:",
        *(" ".join(f"{value:5.2f}" for value in row) for row in u_xy.T[::-1]),
    ]


def _suggest(args: argparse.Namespace, plan: Plan) -> int:
    if args.top is not None and args.views is not None:
        raise InputError(
            "--top", "with --views one plan is found, not a list", "omit it"
        )
    n_shown = SHOWN if args.top is None else args.top
    if n_shown < 1:
        raise InputError("--top", f"{n_shown} is not positive", "give 1 or more")
    check_outputs([args.plan], [args.output])
    plan = _in_order(plan, args.order)
    against = _against(args, plan)
    best = (
        _next_step(args, plan, against, n_shown)
        if args.views is None
        else _best(args, plan, against)
    )
    if args.output:
        write_yaml(args.output, plan_to_dict(best))
    return ExitCode.DONE


def _next_step(
    args: argparse.Namespace, plan: Plan, against: Against, n_shown: int
) -> Plan:
    """Print the best next steps, and return the plan after the first of them."""
    with late_progress("judging plans") as progress:
        now, ranked = rank_next(
            plan,
            criterion=args.criterion,
            datum=ThetaDatum(args.theta_datum),
            against=against,
            progress=progress,
        )
    _show_ranked(
        args, plan, (now, _shown_noise_m(args, plan, against)), ranked[:n_shown]
    )
    return replace(plan, views=ranked[0].views)


def _best(args: argparse.Namespace, plan: Plan, against: Against) -> Plan:
    """Print the best plan of a number of views, and return it."""
    like = [view for view in plan.views if view.grid] or list(plan.views)
    with late_progress("judging plans") as progress:
        best, score, search = best_plan(
            plan.artifact,
            args.views,
            angular=any(view.angular for view in plan.views)
            and plan.artifact.angular_count > 0,
            criterion=args.criterion,
            like=replace(like[0], repeats=min(view.repeats for view in like)),
            datum=ThetaDatum(args.theta_datum),
            against=against,
            progress=progress,
        )
    best = replace(
        best,
        plan_id=f"{plan.plan_id}_best{args.views}",
        model_terms=plan.model_terms,
    )
    shown = score, _shown_noise_m(args, best, against)
    _show_best(args, best, shown, search_text(search))
    return best


def _shown_noise_m(
    args: argparse.Namespace, plan: Plan, against: Against
) -> float | None:
    """Return the noise of an averaged reading of the plan, m; None if gains are shown."""
    # without terms (--against none) and --sigma
    in_um = bool(against.all_terms) or args.sigma is not None
    return _averaged_m(plan, plan_terms.assumed_of(args)) if in_um else None


def _in_order(plan: Plan, order: str) -> Plan:
    """Return the plan with all grid marks visited in `order`, unchanged if empty."""
    if not order:
        return plan
    order = str(parse_order(order, "--order"))
    return replace(
        plan,
        views=tuple(
            replace(view, visit_order=order) if view.grid else view
            for view in plan.views
        ),
    )


def _against(args: argparse.Namespace, plan: Plan) -> Against:
    """Return the terms included in the uncertainty: the plan's, --against's, default ones."""
    term_of = {term.name: term for term in parse_terms(plan.model_terms, "model_terms")}
    term_of |= {
        name: ModelTerm(name, size) for name, size in plan_terms.sizes_of(args).items()
    }
    named = in_order(term_of.values())
    by_default = plan_terms.assumed_terms(args.against, named, plan)
    return Against(named, plan_terms.assumed_of(args), by_default)


def _show_ranked(
    args: argparse.Namespace,
    plan: Plan,
    now: tuple[PlanScore, float | None],
    ranked: Sequence[Suggestion],
) -> None:
    """Print the next steps; `now`: score of the plan and the noise of an averaged reading, m."""
    unit = now[1]
    lines = [
        f"plan {plan.plan_id}: {_score_text(*now)}",
        f"next steps, best first ({args.criterion} uncertainty of XY):",
    ]
    lines += [
        f"  {_score_text(item.score, unit)}   {step_text(item, plan)}"
        for item in ranked
    ]
    suggestions = [
        {
            "text": step_text(item, plan),
            "view": item.view and view_to_dict(item.view, plan.artifact),
            "repeat_of": item.repeat_of,
            "visit_order": item.order or None,
            **_score_json(item.score, unit),
        }
        for item in ranked
    ]
    say(
        args,
        "\n".join(lines),
        {
            "plan_id": plan.plan_id,
            "criterion": args.criterion,
            "now": _score_json(*now),
            "suggestions": suggestions,
        },
    )


def _show_best(
    args: argparse.Namespace,
    best: Plan,
    score: tuple[PlanScore, float | None],
    how: str,
) -> None:
    views = [view_to_dict(view, best.artifact) for view in best.views]
    lines = [
        f"best plan of {len(views)} views ({args.criterion} uncertainty of XY; {how}):"
    ]
    for view in views:
        a, b = view["translation_pitch"]
        kind = "" if view["grid"] else ", lines only"
        lines.append(
            f"  {view['name']}: turn {view['rotation_deg']:g}°, shift [{a:g}, {b:g}]{kind}"
        )
    say(
        args,
        "\n".join([*lines, _score_text(*score)]),
        {
            "plan_id": best.plan_id,
            "criterion": args.criterion,
            "views": views,
            "how": how,
            **_score_json(*score),
        },
    )


def _score_json(score: PlanScore, noise_m: float | None) -> dict[str, Any]:
    out = {
        "deficiency": score.deficiency,
        "rms_gain_xy": score.rms_xy,
        "max_gain_xy": score.max_xy,
        "rms_gain_theta": score.rms_theta,
    }
    if noise_m is not None:
        out |= {
            "u_rms_m": score.rms_xy * noise_m,
            "u_max_m": score.max_xy * noise_m,
        }
    return plain(out)


def _score_text(score: PlanScore, noise_m: float | None) -> str:
    if score.deficiency:
        return counted(score.deficiency, "undetermined mode")
    theta = f"  theta rms {score.rms_theta:.3f}" if score.rms_theta else ""
    if noise_m is not None:
        unit = noise_m * UM_PER_M
        return f"u XY rms {score.rms_xy * unit:.5f} µm  max {score.max_xy * unit:.5f} µm{theta}"
    return f"XY rms {score.rms_xy:.3f}  max {score.max_xy:.3f}{theta}"
