# SPDX-License-Identifier: Apache-2.0
"""Whether the readings separate the free terms from the stage, and the remedy if not."""

from dataclasses import replace

from selfcal_ros.errors import NotIdentifiableError
from selfcal_ros.estimation.terms.equations import TermEquations
from selfcal_ros.model.result import Observability
from selfcal_ros.model.terms import TermName

CURES = {
    TermName.MICROSCOPE: "ask for check_stops in the plan, or align the microscope and leave "
                         "the term out",
    TermName.DRIFT: "visit the marks in more than one order, e.g. visit_order: x_back_y_back",
    TermName.PLATE_SCALE: "add views that are turned and shifted",
    TermName.PLATE_SHAPE: "add views shifted both ways along both axes, and one along a diagonal",
    TermName.PLATE_STRAIN: "add views shifted both ways along both axes",
    TermName.LINE_ECCENTRICITY: "centre the circle of lines better",
    TermName.ROTATION: "read lines in more views with marks",
    TermName.APPROACH: "visit the marks from both sides, e.g. visit_order: x_back_y_back",
}
"""Remedies that make a term separable, in words."""


def unseen_by_term(equations: TermEquations) -> dict[TermName, int]:
    """Return, for each free term that is not separable from the stage, the modes that it hides.

    Terms that are not separable only in combination are all named, with the modes hidden together.
    """
    free = {column.term for column in equations.columns.columns if column.size == float("inf")}
    out = {}
    for name in TermName:
        if name in free:
            modes = equations.unseen(equations.rows([name])).shape[1]
            if modes:
                out[name] = modes
    together = equations.unseen(equations.free).shape[1]
    if together and not out:
        out = {name: together for name in TermName if name in free}
    return out


def require_terms_told(equations: TermEquations, seen: Observability) -> None:
    """Raise NotIdentifiableError if free terms hide modes of the stage.

    Parameters
    ----------
    equations : TermEquations
        The terms.
    seen : Observability
        Observability without terms.
    """
    modes = equations.unseen(equations.free).shape[1]
    if not modes:
        return
    by_term = unseen_by_term(equations)
    texts = tuple(f"{name}: {count} mode{'s' * (count != 1)} of the stage look like it"
                  for name, count in by_term.items())
    advice = tuple(f"{name}: {CURES[name]}, or give it a size, as in {name}:SIZE"
                   for name in by_term)
    free = int(equations.free.sum())
    found = replace(seen, unknowns=seen.unknowns + free, rank=seen.rank + free - modes,
                    deficiency=seen.deficiency + modes, identifiable=False, modes=texts,
                    advice=advice)
    raise NotIdentifiableError(
        f"the readings do not tell {' and '.join(by_term)} from the stage "
        f"({modes} mode{'s' * (modes != 1)} unseen): " + "; ".join(advice), found)
