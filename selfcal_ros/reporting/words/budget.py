# SPDX-License-Identifier: Apache-2.0
"""An uncertainty budget in words: as a table for people, and as the rows of a RESULT.json."""

from functools import singledispatch
from typing import Any

from selfcal_ros.estimation.verdict.budget import (
    Budget,
    FromCurvature,
    FromEffect,
    FromReadings,
    FromReference,
    FromTerm,
    How,
    Source,
)
from selfcal_ros.units import ARCSEC_PER_RAD, UM_PER_M

COUNTED_DOF = 1e5
"""Degrees of freedom above which a number of them says nothing more."""

_SOURCES = {Source.RESIDUALS: "residuals of the fit", Source.REPEATS: "scatter of repeats",
            Source.DECLARED: "declared by the detections"}
_QUANTITIES = {
    ("xy", False): "XY, one coordinate at the nodes of the map",
    ("xy", True): "XY, one coordinate anywhere in the field, map interpolated between its nodes",
    ("theta", False): "theta at the lines of the map",
    ("theta", True): "theta at any angle, map interpolated between its lines"}


def quantity_text(budget: Budget) -> str:
    """Return what a budget is of."""
    return _QUANTITIES[budget.quantity, budget.anywhere]


@singledispatch
def how_text(how: How) -> str:
    """Return how a component was found."""
    raise TypeError(f"no words for {type(how).__name__}")


@how_text.register
def _(how: FromReadings) -> str:
    if how.source is None:
        return "no noise was found"
    more = ", the larger of two that contradict each other (see the verdict)"
    return _SOURCES[how.source] + (more if how.contradicted else "")


@how_text.register
def _(how: FromTerm) -> str:
    known = (f"known to {how.given:.3g} beforehand; the readings " if how.allowed is None else
             f"given as {how.given:.3g}, which the readings contradict; they allow "
             f"{how.allowed:.3g} and ")
    return f"{known}leave {how.remaining_part:.0%} of it"


@how_text.register
def _(how: FromEffect) -> str:
    return f"effect of the cause '{how.cause}' that the readings show (see the verdict)"


@how_text.register
def _(how: FromReference) -> str:
    if how.reference is None:
        return "none: the scale is a convention, and not part of the map"
    return (f"relative {how.reference.u_relative:.3g} of the distance from the centre, by "
            f"{how.reference.kind.value}")


@how_text.register
def _(how: FromCurvature) -> str:
    return f"curvature of the map; assumes that it is smooth between {how.between}"


def budget_json(found: list[Budget]) -> list[dict[str, Any]]:
    """Return the budgets for ``extra["budget"]`` of a result: a row a component, SI units."""
    rows = []
    for budget in found:
        unit = budget.unit
        lines = [(p.label, p.kind, p.u_rms, p.u_max, p.dof, how_text(p.how))
                 for p in budget.components]
        lines += [("combined", "", budget.u_rms, budget.u_max, budget.dof, ""),
                  ("expanded", "", budget.U_rms, budget.U_max, budget.dof,
                   f"k = {budget.k:.3f}, 95.45 % coverage")]
        for label, kind, u_rms, u_max, dof, note in lines:
            row: dict[str, Any] = {"quantity": quantity_text(budget), "component": label,
                                   "type": kind}
            for name in ("m", "rad"):
                row |= {f"u_rms_{name}": u_rms if name == unit else None,
                        f"u_max_{name}": u_max if name == unit else None}
            rows.append(row | {"dof": dof, "note": note})
    return rows


def budget_text(found: list[Budget]) -> list[str]:
    """Return the budgets as a table, µm and arcsec."""
    lines = []
    for budget in found:
        factor, unit = (UM_PER_M, "µm") if budget.unit == "m" else (ARCSEC_PER_RAD, "arcsec")
        lines += [f"uncertainty of {quantity_text(budget)}, {unit}",
                  f"  {'component':18}{'type':>5}{'u rms':>12}{'u max':>12}{'dof':>10}  from"]
        for part in budget.components:
            dof = dof_text(part.dof)
            lines.append(f"  {part.label:18}{part.kind:>5}{part.u_rms * factor:12.4g}"
                         f"{part.u_max * factor:12.4g}{dof:>10}  {how_text(part.how)}")
        dof = dof_text(budget.dof)
        lines += [f"  {'combined':18}{'':5}{budget.u_rms * factor:12.4g}"
                  f"{budget.u_max * factor:12.4g}{dof:>10}",
                  f"  {f'expanded, k = {budget.k:.2f}':23}{budget.U_rms * factor:12.4g}"
                  f"{budget.U_max * factor:12.4g}          95.45 % coverage"]
    return lines


def dof_text(dof: float) -> str:
    """Return degrees of freedom as an integer, or ``many``."""
    return f"{dof:.0f}" if dof < COUNTED_DOF else "many"
