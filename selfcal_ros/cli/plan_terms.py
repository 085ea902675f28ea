# SPDX-License-Identifier: Apache-2.0
"""``selfcal plan``: its options for the terms of the model, and their table."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterable, Mapping
from typing import Any

from selfcal_ros.blocks import block_of
from selfcal_ros.errors import InputError
from selfcal_ros.estimation.observability.resistance import PlanBudget, TermCheck
from selfcal_ros.estimation.terms.planned import Assumed
from selfcal_ros.model.terms import (
    DRIFT_DEGREE,
    MAX_DRIFT_DEGREE,
    ModelTerm,
    block_of_offsets,
    default_terms,
    in_order,
    parse_terms,
)
from selfcal_ros.model.view import DEFAULT_ORDER, Plan, parse_order
from selfcal_ros.plain_numbers import quantity_of
from selfcal_ros.reporting.words.quantities import MRAD, unit_of
from selfcal_ros.reporting.words.tables import removal_text
from selfcal_ros.settings.nodes import NO_TERMS
from selfcal_ros.units import M_PER, RAD_PER, UM_PER_M

SIGMA = "20e-9"
SIGMA_THETA = "3.6arcsec"
STOP_ERROR = "100nm"
STAGE_ERROR = "1um"
PLACING = "0.3deg"
MOST_M, MOST_RAD = 1e-3, 0.1
"""Largest standard deviations: 20 without a unit is meant in another one."""


def add_term_options(parser: argparse.ArgumentParser) -> None:
    """Add the options for the terms against which a plan is judged."""
    parser.add_argument(
        "--against",
        metavar="TERM:SIZE[,...]",
        action="append",
        default=[],
        help="size of a term against which the plan is judged, a standard "
        "deviation in SI units; none: not even the terms assumed by default",
    )
    parser.add_argument(
        "--drift-degree",
        type=int,
        metavar="D",
        help="degree of the polynomial of the drift of a view (default 3)",
    )
    parser.add_argument(
        "--order",
        metavar="ORDER",
        default="",
        help="visiting order of all views, replaces the plan's",
    )
    parser.add_argument(
        "--sigma",
        metavar="LENGTH",
        help="noise of one reading, m or with a unit as in 20nm (default 20 nm); "
        "if given, uncertainties are printed in µm",
    )
    parser.add_argument(
        "--stop-error",
        metavar="LENGTH",
        default=STOP_ERROR,
        help="stop error of the stage relative to a mark, standard deviation per "
        f"axis, m or with a unit (default {STOP_ERROR})",
    )
    parser.add_argument(
        "--stage-error",
        metavar="LENGTH",
        default=STAGE_ERROR,
        help="errors of stage and plate, standard deviation per axis, m or with a "
        f"unit (default {STAGE_ERROR}): the scale error of the microscope multiplies "
        "them",
    )
    parser.add_argument(
        "--placing",
        metavar="ANGLE",
        default=PLACING,
        help="rotation by which plates are placed, standard deviation, rad or "
        f"with a unit (default {PLACING})",
    )
    parser.add_argument(
        "--sigma-theta",
        metavar="ANGLE",
        default=SIGMA_THETA,
        help=f"noise of one reading of a line, rad or with a unit (default {SIGMA_THETA})",
    )


def length_m(text: str, option: str, most: float = math.inf) -> float:
    """Return a length such as ``20e-9`` or ``20nm`` in m.

    Raises
    ------
    InputError
        If it is not a positive length, or above `most`.
    """
    return _quantity(text, option, M_PER, "length", most)


def _quantity(
    text: str, option: str, units: Mapping[str, float], what: str, most: float
) -> float:
    """Return a positive number with one of the units, SI if none is given."""
    plain = next(iter(units))
    try:
        value, _ = quantity_of(text, units)
    except ValueError:
        value = math.nan
    if not 0 < value < math.inf:
        raise InputError(
            option,
            f"'{text}' is not a positive {what}",
            f"give {plain}, or a number and one of " + ", ".join(units),
        )
    if value > most:
        raise InputError(
            option,
            f"'{text}' is {value:g} {plain}, and at most {most:g} {plain} is possible here",
            "give a number and one of " + ", ".join(units),
        )
    return value


def assumed_of(args: argparse.Namespace) -> Assumed:
    """Return the assumptions on the future measurement from the options.

    Raises
    ------
    InputError
        For an invalid length, order or degree.
    """
    degree = DRIFT_DEGREE if args.drift_degree is None else args.drift_degree
    if not 1 <= degree <= MAX_DRIFT_DEGREE:
        raise InputError(
            "--drift-degree",
            f"{degree} is not a degree of a drift",
            f"give 1 to {MAX_DRIFT_DEGREE}",
        )
    order = str(parse_order(args.order, "--order")) if args.order else ""
    return Assumed(
        sigma_m=length_m(args.sigma or SIGMA, "--sigma", MOST_M),
        stop_error_m=length_m(args.stop_error, "--stop-error", MOST_M),
        drift_degree=degree,
        order=order,
        sigma_rad=_quantity(
            args.sigma_theta, "--sigma-theta", RAD_PER, "angle", MOST_RAD
        ),
        turn_rad=_quantity(args.placing, "--placing", RAD_PER, "angle", MOST_RAD),
        error_m=length_m(args.stage_error, "--stage-error", MOST_M),
    )


def sizes_of(args: argparse.Namespace) -> dict[str, float]:
    """Return the sizes that ``--against`` gives, by term.

    Raises
    ------
    InputError
        For an unknown term or one without a size.
    """
    named = [text for text in args.against if text != NO_TERMS]
    terms = parse_terms(named, "--against")
    for term in terms:
        if term.free:
            raise InputError(
                f"--against: {term.name}",
                "a size is missing",
                f"write {term.name}:SIZE, a standard deviation in SI units",
            )
    return {term.name: term.size for term in terms}


def declared_of(args: argparse.Namespace, plan: Plan) -> tuple[ModelTerm, ...]:
    """Return the terms of the plan, replaced by those of ``--model``; those of size 0 as well."""
    if NO_TERMS in args.model:
        return ()
    term_of = {
        term.name: term
        for terms in (
            parse_terms(plan.model_terms, "model_terms"),
            parse_terms(args.model, "--model"),
        )
        for term in terms
    }
    return in_order(term_of.values())


def assumed_terms(
    given: list[str], named: tuple[ModelTerm, ...], plan: Plan
) -> tuple[ModelTerm, ...]:
    """Return the terms that are assumed by default beside the named ones.

    Parameters
    ----------
    given : list of str
        What ``--model`` or ``--against`` says: ``none`` excludes them.
    named : tuple of ModelTerm
        Terms of the plan and of the option, those of size 0 as well.
    plan : Plan
        The plan: its images may tell the microscope better than it is known.
    """
    if NO_TERMS in given:
        return ()
    names = {term.name for term in named}
    if tells_camera(plan):
        names.add(block_of_offsets().name)
    return tuple(term for term in default_terms() if term.name not in names)


def tells_camera(plan: Plan) -> bool:
    """Return whether the images of a plan tell the camera's scale, turn and distortion."""
    images = [view.image for view in plan.views if view.grid]
    return bool(images) and all(
        image and min(image.nx, image.ny) >= 3 for image in images
    )


def budget_json(budget: PlanBudget, plan: Plan, assumed: Assumed) -> dict[str, Any]:
    """Return the predicted budget of a plan for programs."""
    lines = []
    for line in budget.lines:
        removed = budget.removals.get((line.quantity, line.component))
        lines.append(
            {
                name: getattr(line, name)
                for name in (
                    "quantity",
                    "component",
                    "kind",
                    "u",
                    "unit",
                    "effect_rms",
                    "effect_max",
                    "source",
                )
            }
            | {
                "share": budget.share(line),
                "removal": removed
                and {
                    "kind": removed.kind,
                    "effect_rms": removed.effect_rms,
                    "text": removal_text(removed, line, plan),
                },
            }
        )
    out: dict[str, Any] = {
        "sigma_m": assumed.sigma_m,
        "sigma_rad": assumed.sigma_rad,
        "lines": lines,
    }
    for quantity in dict.fromkeys(line.quantity for line in budget.lines):
        out |= {
            f"U_{quantity}": 2 * budget.u_rms(quantity),
            f"U_{quantity}_noise": 2 * budget.u_rms(quantity, noise_only=True),
            f"U_{quantity}_if_larger": 2 * budget.u_rms(quantity, if_larger=True),
        }
    return out


def terms_json(checks: Iterable[TermCheck]) -> list[dict[str, Any]]:
    """Return the checks of terms as JSON."""
    return [
        {
            "name": str(c.name),
            "told": c.determined,
            "unseen_modes": c.unseen_modes,
            "model": c.model,
            "size": c.size,
            "unit": c.unit,
            "effect_rms_m": c.effect_rms_m,
            "effect_max_m": c.effect_max_m,
            "power": c.power,
        }
        for c in checks
    ]


def terms_text(plan: Plan, checks: Iterable[TermCheck], assumed: Assumed) -> list[str]:
    """Return the checks of terms as a table, with the assumptions."""
    lines = [
        "terms: whether the readings separate them from the stage, what a term of this size",
        "does to the map if it is left out of the model, and how likely it is to be detected",
        f"  {'term':<13}{'model':<6}{'separable':<14}{'size':>11}  {'map rms':>10} "
        f"{'largest':>10} {'detected':>9}",
    ]
    for c in checks:
        separable = "yes" if c.determined else f"no, {c.unseen_modes} unseen"
        lines.append(
            f"  {c.name:<12} {c.model or '-':<6}{separable:<14}{size_text(c):>11}"
            f"  {c.effect_rms_m * UM_PER_M:7.5f} µm {c.effect_max_m * UM_PER_M:7.5f} µm"
            f" {100 * c.power:7.1f} %"
        )
    return [*lines, *_assumptions(plan, assumed)]


def size_text(check: TermCheck) -> str:
    """Return the size of a term in a person's unit."""
    # of a microscope the turn is shown, which is as large as the scale
    is_turn = block_of(check.name).of_microscope
    unit = MRAD if is_turn else unit_of(check.name, check.unit)
    return f"{check.size * unit.per_si:.6g} {unit.name}"


def _assumptions(plan: Plan, assumed: Assumed) -> list[str]:
    views = [view for view in plan.views if view.grid]
    orders = {
        view.name: parse_order(assumed.order or view.visit_order or DEFAULT_ORDER)
        for view in views
    }
    cut = [view for view in views if view.repeats < orders[view.name].passes]
    lines = [
        f"  assumed: order {', '.join(sorted({str(o) for o in orders.values()}))}; drifts of "
        f"degree {assumed.drift_degree}; {assumed.sigma_m * UM_PER_M:.6g} µm noise of "
        "one reading;",
        f"  plates placed within {math.degrees(assumed.turn_rad):g}° and "
        f"{assumed.away_m * UM_PER_M:g} µm, stops {assumed.stop_error_m * UM_PER_M:.6g} µm "
        "off the marks, drawn with a fixed seed",
    ]
    if cut:
        names = ", ".join(f"'{view.name}'" for view in cut)
        first = orders[cut[0].name]
        lines.append(
            f"  the order {first} needs {first.passes} repeats: it is truncated "
            f"in the views {names}"
        )
    return lines
