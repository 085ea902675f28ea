# SPDX-License-Identifier: Apache-2.0
"""An uncertainty budget in words: how each line was found, and as a table."""

from selfcal_ros.estimation.verdict.budget import Budget
from selfcal_ros.reporting.words.findings import line_text
from selfcal_ros.units import ARCSEC_PER_RAD, UM_PER_M

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
