# SPDX-License-Identifier: Apache-2.0
"""How each line of an uncertainty budget was found, in words."""

from selfcal_ros.estimation.verdict.uncertainty import INTERPOLATION
from selfcal_ros.model.verdict import BudgetLine

_NOISES = {"residuals": "residuals of the fit", "repeats": "scatter of repeats",
           "declared": "declared by the detections"}

OF_RECHECK = {"known plate": "covariance of the plate's map in {}",
              "terms": "sizes of the terms of the model, which these views do not tell"}
"""How a line of the budget was found, given the file of the plate."""


def line_text(line: BudgetLine) -> str:
    """Return how a line of the budget was found."""
    of = line.details
    if "by" in of:
        return _NOISES[of["by"]] + (", the larger of two that contradict each other (see the "
                                    "verdict)" if of["contradicted"] else "")
    if "given" in of:
        given = f"size {of['given']:.3g}, " + (
            "of which the readings" if of["allowed"] is None else
            f"which the readings contradict; of {of['allowed']:.3g}, which they allow, they")
        return f"{given} leave {of['remaining']:.0%}"
    if "cause" in of:
        return f"effect of the cause '{of['cause']}' that the readings show (see the verdict)"
    if "runs" in of:
        return {"between runs": f"scatter of {of['runs']} runs beyond their uncertainties",
                "shared by all runs": "declared or assumed, the same in all runs"}.get(
                    line.component, f"uncertainties of {of['runs']} runs, by their weights")
    if "kind" in of:
        return f"relative {line.u:.3g} of the distance from the centre, by {of['kind']}"
    if "plate" in of:
        return OF_RECHECK[line.component].format(of["plate"])
    if line.component == INTERPOLATION:
        nodes = "sites" if line.quantity == "xy" else "lines"
        return f"curvature of the map; assumes that it is smooth between {nodes}"
    return ("no noise was found" if line.unit != "m/m" else
            "none: the scale is a convention, and not part of the map")
