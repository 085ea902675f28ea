# SPDX-License-Identifier: Apache-2.0
"""What readings or a plan do not determine, and the views that would, in words."""

import math
from dataclasses import replace
from functools import singledispatch

from selfcal_ros.blocks import block_of
from selfcal_ros.errors import NotIdentifiableError
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.findings import (
    AddViews,
    AddViewsOrFewerNodes,
    BendingX,
    BendingY,
    EveryField,
    Finding,
    GroupsOfLines,
    GroupsOfSites,
    HarmonicsUnseen,
    LineOffsets,
    LinesNeverVisited,
    LooksLikeStage,
    MarksMissing,
    MarksNeverRead,
    Nonorthogonality,
    OrAddViews,
    PeriodicFields,
    PeriodicLines,
    RotationSymmetric,
    ScaleDifference,
    SeparateTerm,
    SitesNeverVisited,
    UndeterminedFields,
)
from selfcal_ros.model.result import Observability
from selfcal_ros.model.view import View
from selfcal_ros.reporting.summary.numbers import counted
from selfcal_ros.units import MM_PER_M

NAMED = 4
"""Sites of a group that are named."""


def worded_observability(observability: Observability) -> Observability:
    """Return an observability with its modes and advice in words; existing texts are kept."""
    return replace(
        observability,
        modes=tuple(map(worded, observability.modes)),
        advice=tuple(map(worded, observability.advice)),
    )


def with_advice(error: NotIdentifiableError) -> NotIdentifiableError:
    """Return the error with the advice of its observability in its line, if it is not yet there."""
    observability = error.observability
    if not isinstance(observability, Observability) or all(
        advice.text for advice in observability.advice
    ):
        return error
    observability = worded_observability(observability)
    advice = "; ".join(advice.text for advice in observability.advice)
    return NotIdentifiableError(f"{error}: {advice}", observability)


def worded(finding: Finding) -> Finding:
    """Return a mode or an advice with its sentence; an existing one is kept."""
    return finding if finding.text else replace(finding, text=mode_text(finding))


def describe_view(view: View, artifact: Artifact) -> str:
    """Return a view in words: turn, shift in pitches (mm), kind of marks, repeats."""
    turn = math.degrees(view.rotation_rad) % 360
    if not view.grid:
        lines = view.on_stage(artifact).turn_lines or 0
        of_lines = "" if artifact.harmonics else f"{lines} line{'s' * (lines != 1)} ("
        description = (
            f"an angular view turned by {of_lines}{360 * lines / artifact.angular_count:g}°"
            + ")" * bool(of_lines)
        )
    elif 1e-6 < turn < 360 - 1e-6:
        description = f"a view turned by {turn:.6g}°"
    else:
        description = "an unturned view"
    unit, name = (
        (1 / MM_PER_M, "mm") if artifact.marks else (artifact.grid_pitch_m, "pitch")
    )
    steps = [round(shift / unit, 3) + 0.0 for shift in view.translation_m]
    shifted = [
        f"{step:+g} {name} along {axis}"
        for step, axis in zip(steps, "XY", strict=True)
        if step
    ]
    also = (
        " shifted by " if description.startswith("an unturned") else " and shifted by "
    )
    return description + (also + " and ".join(shifted) if shifted else "")


FIXED: dict[type[Finding], str] = {
    Nonorthogonality: "non-orthogonality of the axes: Gx = O y, Gy = O x",
    ScaleDifference: "scale difference of the axes: Gx = R x, Gy = -R y",
    BendingX: "steady turn from column to column: Gx = x y, Gy = -x^2/2",
    BendingY: "steady turn from row to row: Gx = y^2/2, Gy = -x y",
    EveryField: "everything: one view cannot separate the stage from the plate",
}
"""The sentence of each mode without data."""


@singledispatch
def mode_text(finding: Finding) -> str:
    """Return the sentence of a mode or an advice; KeyError if there is none."""
    return FIXED[type(finding)]


@mode_text.register
def _(mode: UndeterminedFields) -> str:
    return (
        f"{mode.count} fields whose standard uncertainty exceeds ten times the noise of a "
        "reading"
    )


@mode_text.register
def _(mode: SitesNeverVisited) -> str:
    return f"{mode.count} sites that no mark reaches, the first is {mode.first}"


@mode_text.register
def _(mode: MarksNeverRead) -> str:
    return f"{mode.count} marks of the plate that no view reads"


@mode_text.register
def _(mode: LineOffsets) -> str:
    opposite = f", opposite in opposite {mode.lines}" if mode.opposite else ""
    return f"offsets of the {mode.lines} against each other, in x and in y{opposite}"


@mode_text.register
def _(mode: RotationSymmetric) -> str:
    turn = "half" if mode.half else "quarter"
    return (
        f"rotation-symmetric fields: every field that a {turn} turn maps to itself "
        f"({mode.numbers} numbers beside the datum)"
    )


@mode_text.register
def _(mode: PeriodicFields) -> str:
    along = " and ".join(
        f"every {period} pitches along {axis}"
        for period, axis in zip(mode.period, "xy", strict=True)
        if period > 1
    )
    return f"patterns that repeat {along} ({mode.numbers} numbers beside the datum)"


@mode_text.register
def _(mode: GroupsOfSites) -> str:
    more = ["..."] * (len(mode.smallest) > NAMED)
    return (
        f"{mode.count} groups of sites that no reading connects: each may move independently; "
        f"the smallest is {', '.join([*map(str, mode.smallest[:NAMED]), *more])}"
    )


@mode_text.register
def _(mode: HarmonicsUnseen) -> str:
    *most, last = map(str, mode.harmonics)
    numbers = f"s {', '.join(most)} and {last}" if most else f" {last}"
    why = (
        "every turn between views is a whole number of their periods, or nearly so"
        if mode.turned
        else "no view turns the lines"
    )
    return f"angular map: harmonic{numbers}, as {why}"


@mode_text.register
def _(mode: PeriodicLines) -> str:
    if mode.period == mode.of:
        return "angular map: everything, as no view turns the lines"
    return f"angular map: patterns that repeat every {mode.period} lines"


@mode_text.register
def _(mode: GroupsOfLines) -> str:
    return f"angular map: {mode.count} groups of lines that no view connects"


@mode_text.register
def _(mode: LinesNeverVisited) -> str:
    return f"{mode.count} angles of the stage that no line reaches"


@mode_text.register
def _(mode: LooksLikeStage) -> str:
    return f"{mode.term}: {counted(mode.count, 'mode')} of the stage look like it"


@mode_text.register
def _(advice: SeparateTerm) -> str:
    cure = block_of(advice.term).cure
    return f"{advice.term}: {cure}, or give it a size, as in {advice.term}:SIZE"


@mode_text.register
def _(advice: MarksMissing) -> str:
    return (
        f"read the missing marks: only {advice.sites} of {advice.of_sites} sites and "
        f"{advice.lines} of {advice.of_lines} lines are determined"
    )


@mode_text.register
def _added(advice: AddViews) -> str:
    views = (describe_view(view, advice.plate) for view in advice.views)
    return f"add {' and '.join(views)}"


@mode_text.register
def _(advice: OrAddViews) -> str:
    return f"or {_added(advice)}"


@mode_text.register
def _(advice: AddViewsOrFewerNodes) -> str:
    return f"{_added(advice)}, or give the map fewer nodes"
