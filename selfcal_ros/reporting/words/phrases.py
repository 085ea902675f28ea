# SPDX-License-Identifier: Apache-2.0
"""Phrases for the lines of an uncertainty budget, the result of a recheck, and counts of views."""

import math
import os
from collections.abc import Callable, Sequence
from typing import Any

from selfcal_ros.errors import printable
from selfcal_ros.estimation.verdict.uncertainty import INTERPOLATION
from selfcal_ros.model.budget import (
    BudgetLine,
    OfAssumption,
    OfCause,
    OfNoise,
    OfPlate,
    OfReference,
    OfRuns,
    OfTerm,
)
from selfcal_ros.model.findings import (
    Changed,
    ChangedOrDrifted,
    ChangedOrMarks,
    ChangedOrMicroscope,
    FewRead,
    Finding,
    MicroscopeOff,
    OtherPlate,
    PlateMisfit,
    RepeatsContradict,
    ScaleChanged,
    ScaleNotCompared,
    ViewLeftOut,
)
from selfcal_ros.model.kept import LACK_OF_FIT
from selfcal_ros.model.pose import cell_label, without_cell
from selfcal_ros.model.recheck import LargestChange, Recheck, ScaleChange
from selfcal_ros.model.result import ViewResult
from selfcal_ros.reporting.summary.numbers import counted, p_text, with_u
from selfcal_ros.reporting.words.quantities import size_text
from selfcal_ros.units import ARCSEC_PER_RAD, MM_PER_M, MRAD_PER_RAD, UM_PER_M

_NOISES = {
    "residuals": "residuals of the fit",
    "repeats": "scatter of repeats",
    "declared": "declared by the detections",
    "together": "declared by the detections, and residuals of the fit",
}

OF_RECHECK = {
    "known plate": "covariance of the plate's map in {}",
    "plate temperature": "temperature of the plate now, and its expansion coefficient, "
    "beyond what its calibration in {} contains",
    "terms": "sizes of the terms of the model, which these views do not determine",
}
"""How a line of the budget was found, given the file of the plate."""


COUNTED_DOF = 1e5
"""Degrees of freedom from which on their number tells a reader nothing."""


def dof_text(dof: float) -> str:
    """Return degrees of freedom as an integer, ``> 100000``, or ``∞``."""
    if dof < COUNTED_DOF:
        return f"{dof:.0f}"
    return f"> {COUNTED_DOF:.0f}" if math.isfinite(dof) else "∞"


def counted_views(
    views: Sequence[ViewResult], of: Callable[[ViewResult], bool] = bool
) -> str:
    """Return ``4 views``, ``2 views with images of 9 marks``: the cells of images are not views.

    ``3 of 4 views`` if not in all of them a cell is one `of` those meant.
    """
    number = len({without_cell(view.name) for view in views})
    meant = len({without_cell(view.name) for view in views if of(view)})
    cells = len(
        {view.name.removeprefix(without_cell(view.name)) for view in views} - {""}
    )
    images = f" with images of {cells} marks" if cells else ""
    share = f"{meant} of " * (meant != number)
    return f"{share}{counted(number, 'view')}{images}"


def few_read_text(finding: FewRead) -> str:
    """Return the sentence on cells of images with few readings."""
    where = " and ".join(
        f"in cell {cell_label(few.cell)} of the images"
        f"{f' of view {few.view!r}' * bool(few.view)} ({few.read} of {few.shown})"
        for few in finding.cells
    )
    unknown = (
        "the camera's error could not be determined"
        if finding.unknown is None
        else f"the camera's error is not known in {_named(finding.unknown)}"
    )
    return (
        f"few marks were read {where}: look for dirt or a shadow in that part of the image"
        + (f"; {unknown}" if finding.unknown != () else "")
    )


def view_left_out_text(finding: ViewLeftOut) -> str:
    """Return the sentence on a view of which nothing, or a small part, became readings."""
    rejected = ", ".join(
        f"{reason} {count}" for reason, count in finding.rejected.items()
    )
    if any(finding.read):
        counts = " and ".join(
            f"{got} of {asked} {kind}"
            for got, asked, kind in zip(
                finding.read, finding.asked, ("marks", "lines"), strict=True
            )
            if asked
        )
        text = (
            f"view '{finding.view}' is only partly in the map: {counts} became readings"
        )
    else:
        text = f"view '{finding.view}' is not part of the map: " + (
            "none of its detections became a reading"
            if rejected
            else "nothing was detected in it"
        )
    return f"{text} ({rejected})" if rejected else text


def repeats_contradict_text(finding: RepeatsContradict) -> str:
    """Return the sentence on a view in which many readings are outliers among repeats."""
    return (
        f"{finding.rejected} of {finding.of} readings of view '{finding.view}' contradict the "
        "other repeats of their marks and were left out: the plate slipped within the view, or a "
        "second publisher sent readings (ros2 topic info -v); measure it again"
    )


def _named(cells: Sequence[Any]) -> str:
    return f"cell{'s' * (len(cells) > 1)} {', '.join(map(cell_label, cells))}"


def of_few_read(findings: Sequence[Finding]) -> str:
    """Return what the first sentence on a result says of cells with few readings."""
    cells = list(
        dict.fromkeys(
            few.cell
            for finding in findings
            if isinstance(finding, FewRead)
            for few in finding.cells
        )
    )
    return f", few of them read in {_named(cells)}" if cells else ""


def line_text(line: BudgetLine) -> str:
    """Return how a line of the budget was found."""
    match line.details:
        case OfNoise(by, contradicted):
            return _NOISES[by] + (
                ", the larger of two that contradict each other (see the verdict)"
                if contradicted
                else ""
            )
        case OfAssumption(given):
            size = size_text(line, given)
            return f"size {size}, what the readings do not determine of it"
        case OfTerm(given, allowed, remaining):
            but = (
                "of which the readings"
                if allowed is None
                else f"too small for the readings; of {size_text(line, allowed)}, which they "
                "allow, they"
            )
            return f"size {size_text(line, given)}, {but} leave {100 * remaining:.0f} %"
        case OfCause(cause) if cause == LACK_OF_FIT:
            return "residuals beyond the scatter of repeats, met in full at every place"
        case OfCause(cause):
            return f"effect of the cause '{cause}' that the readings show (see the verdict)"
        case OfRuns(runs):
            return {
                "between runs": f"scatter of {runs} runs beyond their uncertainties",
                "shared by all runs": "declared or assumed, the same in all runs",
            }.get(
                line.component,
                f"uncertainties of {runs} runs, by their weights: noise, and what is "
                "assumed of each",
            )
        case OfReference(kind):
            return f"relative {line.u:.3g} of the distance from the centre, by {kind}"
        case OfPlate(plate):
            return OF_RECHECK[line.component].format(plate)
    if line.component == INTERPOLATION:
        nodes = "sites" if line.quantity == "xy" else "lines"
        return f"curvature of the map; assumes that it is smooth between {nodes}"
    return (
        "no noise was found"
        if line.unit != "m/m"
        else "none: the scale is a convention, and not part of the map"
    )


STILL_GOOD = "Still good"
CHANGED = "Changed"
ONE_PASS = (
    "a single pass cannot tell a change from drift: measure two passes (repeats: 2, "
    "visit_order: there_and_back), or declare the drift (--model drift:SIZE)"
)


def recheck_sentence(recheck: Recheck, *, without_scale: bool = False) -> str:
    """Return the verdict of a recheck in one sentence.

    `without_scale`: the map before has a scale, which was not compared.
    """
    since = _since(recheck.of)
    scale = recheck.scale
    clearest = _clearest(recheck.largest)
    if recheck.changed:
        return _changed(since, clearest, recheck.p)
    if scale.changed:
        return (
            f"{_scale_changed(since, scale, one_pass=recheck.passes == 1)}; otherwise no "
            f"change beyond its uncertainty ({p_text(recheck.p)}); {clearest}"
        )
    still = STILL_GOOD + ", but for its scale, not compared" * without_scale
    return (
        f"{still}: no change since {since} beyond its uncertainty ({p_text(recheck.p)}); "
        f"{clearest}"
    )


def _since(where: str) -> str:
    """Return the name of the file of a calibration."""
    return printable(os.path.basename(where))


def _changed(since: str, clearest: str, p: float) -> str:
    return (
        f"{CHANGED} since {since}: calibrate again, provided this is the same plate, "
        "clean and placed as planned, and the camera was not touched (if it was, declare it: "
        f"--microscope 0.01); {clearest} ({p_text(p)})"
    )


def _scale_changed(since: str, scale: ScaleChange, *, one_pass: bool) -> str:
    how_much = (
        f"by {with_u(scale.change * UM_PER_M, scale.u * UM_PER_M, sign='+')} µm/m (k=1, "
        f"{p_text(scale.p)})"
    )
    if one_pass:
        return f"Scale changed or drifted since {since} {how_much}; {ONE_PASS}"
    return (
        f"Scale changed since {since} {how_much}: the temperature of the plate or of the "
        "encoders has changed, one plate cannot tell which"
    )


def scale_changed_text(finding: ScaleChanged) -> str:
    """Return the warning of encoders whose scale against the plate has changed."""
    scale = ScaleChange(True, finding.size, finding.u, finding.p)
    return _scale_changed(_since(finding.of), scale, one_pass=finding.passes == 1)


def scale_not_compared_text(finding: ScaleNotCompared) -> str:
    """Return the warning of a scale that a recheck does not compare."""
    remedy = (
        "name the temperature of the plate in this measurement (--reference-at)"
        if finding.certified
        else "calibrate with --reference and --reference-at of the plate"
    )
    return (
        f"the scale of {_since(finding.of)} was not compared: a stage that has grown as the plate "
        f"has looks unchanged; {remedy}"
    )


def other_plate_text(finding: OtherPlate) -> str:
    """Return the reason why what was read is not the plate that is known."""
    since = _since(finding.of)
    return (
        f"another plate, or the plate has changed, in view '{printable(finding.view)}': its "
        f"marks differ from {since} by {finding.size * UM_PER_M:.3g} µm, {finding.times:.0f} times "
        "u, and neighbouring marks are not correlated, unlike the errors of a stage: check "
        "which plate it is, that it is clean and lies as planned; if it has changed, calibrate "
        "again"
    )


def _clearest(of: LargestChange) -> str:
    return (
        f"clearest at x = {of.x * MM_PER_M:.6g}, y = {of.y * MM_PER_M:.6g} mm: "
        f"{with_u(of.change * UM_PER_M, of.u * UM_PER_M, sign='+')} µm along {of.axis} (k=1)"
    )


def recheck_lines(recheck: Recheck) -> list[str]:
    """Return what a recheck found in a few lines: both maps, and the scale."""
    out = [
        f"XY     rms {with_u(recheck.rms * UM_PER_M, recheck.u_rms * UM_PER_M)} µm per axis "
        f"(k=1), {p_text(recheck.p_xy)}"
    ]
    if (sizes := recheck.detectable) is not None:
        out.append(
            f"detectable in 9 of 10 cases: {sizes.one_node * UM_PER_M:.2g} µm at one node, "
            f"or a smooth change of {sizes.smooth * UM_PER_M:.2g} µm rms per axis"
        )
    if (turn := recheck.largest_theta) is not None:
        out.append(
            f"theta  clearest at line {turn.line}: "
            f"{with_u(turn.change * ARCSEC_PER_RAD, turn.u * ARCSEC_PER_RAD, sign='+')} "
            f"arcsec (k=1), {p_text(recheck.p_theta)}"
        )
    if recheck.passes == 1:
        out.append(ONE_PASS)
    scale = recheck.scale
    return [
        *out,
        f"scale  {with_u(scale.change * UM_PER_M, scale.u * UM_PER_M, sign='+')} µm/m "
        f"against the plate (k=1), {p_text(scale.p)}",
    ]


def changed_text(finding: Changed) -> str:
    """Return the warning of a stage that has changed."""
    return _changed(_since(finding.of), _clearest_of(finding), finding.p)


def changed_or_drifted_text(finding: ChangedOrDrifted) -> str:
    """Return the reason why a change that one pass shows is not qualified."""
    return (
        f"the map differs from {_since(finding.of)}, {_clearest_of(finding)} "
        f"({p_text(finding.p)}); {ONE_PASS}"
    )


def changed_or_microscope_text(finding: ChangedOrMicroscope) -> str:
    """Return the reason why a change that a microscope explains too is not qualified."""
    return (
        f"the map differs from {_since(finding.of)}, {_clearest_of(finding)} "
        f"({p_text(finding.p)}); a changed stage, or a microscope with a scale wrong by "
        f"{with_u(100 * finding.scale, 100 * finding.u_scale, sign='+')} % and turned by "
        f"{_turn(finding)} mrad (k=1) "
        "explains it alike: measure check stops (check_stops in the plan), or correct the "
        "pixel size"
    )


def _turn(finding: ChangedOrMicroscope | MicroscopeOff) -> str:
    """Return the turn of a microscope in mrad, with its u."""
    return with_u(finding.turn * MRAD_PER_RAD, finding.u_turn * MRAD_PER_RAD, sign="+")


def changed_or_marks_text(finding: ChangedOrMarks) -> str:
    """Return the reason why a change that single marks show is not qualified."""
    more = f" and {counted(finding.others, 'other')} likewise" if finding.others else ""
    return (
        f"the map differs from {_since(finding.of)}, {_clearest_of(finding)} "
        f"({p_text(finding.p)}), but mark {finding.mark} lies "
        f"{finding.away * UM_PER_M:.3g} µm away from where its neighbours show it{more}: dirt or "
        "damage explains that as well as a stage that has changed there alone; clean the plate "
        "and measure again, or place it turned by 90°: what stays with the mark is of the plate"
    )


def microscope_off_text(finding: MicroscopeOff) -> str:
    """Return the warning of a microscope that is not as assumed, which the readings correct."""
    return (
        "the scale of the microscope is wrong by "
        f"{with_u(100 * finding.size, 100 * finding.u, sign='+')} % and it is turned by "
        f"{_turn(finding)} mrad "
        "(k=1), as visits of one mark at several places show: the readings were corrected by "
        "that; correct the pixel size before the next calibration"
    )


def _clearest_of(finding: Changed) -> str:
    return _clearest(
        LargestChange(finding.x, finding.y, finding.axis, finding.size, finding.u)
    )


def misfit_text(finding: PlateMisfit) -> str:
    """Return the reason why readings do not fit a known plate."""
    return (
        f"residuals are {finding.size:.2f} times what the noise and the known plate allow "
        f"({p_text(finding.p)}): is it that plate, does it lie as planned, and has the map "
        "enough nodes?"
    )
