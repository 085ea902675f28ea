# SPDX-License-Identifier: Apache-2.0
"""What readings or a plan do not determine, and the views that would, in words."""

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from selfcal_ros.blocks import block_of
from selfcal_ros.errors import NotIdentifiableError
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.result import Observability
from selfcal_ros.model.verdict import Finding
from selfcal_ros.model.view import View
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
    return (
        finding
        if finding.text
        else replace(finding, text=SENTENCES[finding.name](finding.details))
    )


def describe_view(view: View, artifact: Artifact) -> str:
    """Return a view in words: turn, shift in pitches (mm), kind of marks, repeats."""
    turn = math.degrees(view.rotation_rad) % 360
    if not view.grid:
        lines = view.on_stage(artifact).turn_lines or 0
        of_lines = "" if artifact.harmonics else f"{lines} line{'s' * (lines != 1)} ("
        description = (
            f"an angular view turned by {of_lines}{360 * lines / artifact.angular_count:g} deg"
            + ")" * bool(of_lines)
        )
    elif 1e-6 < turn < 360 - 1e-6:
        description = f"a view turned by {turn:.6g} deg"
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


def _add(of: Mapping[str, Any]) -> str:
    return "add " + " and ".join(
        describe_view(view, of["plate"]) for view in of["views"]
    )


def _line_offsets(of: Mapping[str, Any]) -> str:
    opposite = f", opposite in opposite {of['lines']}" if of["opposite"] else ""
    return f"offsets of the {of['lines']} against each other, in x and in y{opposite}"


def _periodic(of: Mapping[str, Any]) -> str:
    along = " and ".join(
        f"every {period} pitches along {axis}"
        for period, axis in zip(of["period"], "xy", strict=True)
        if period > 1
    )
    return f"patterns that repeat {along} ({of['numbers']} numbers beside the datum)"


def _groups(of: Mapping[str, Any]) -> str:
    smallest = [f"({m}, {n})" for m, n in of["smallest"]]
    more = ["..."] * (len(smallest) > NAMED)
    return (
        f"{of['count']} groups of sites that no reading connects: each may move "
        f"independently; the smallest is {', '.join([*smallest[:NAMED], *more])}"
    )


def _harmonics(of: Mapping[str, Any]) -> str:
    *most, last = map(str, of["harmonics"])
    numbers = f"s {', '.join(most)} and {last}" if most else f" {last}"
    why = (
        "every turn between views is a whole number of their periods, or nearly so"
        if of["turned"]
        else "no view turns the lines"
    )
    return f"angular map: harmonic{numbers}, as {why}"


def _periodic_lines(of: Mapping[str, Any]) -> str:
    if of["period"] == of["of"]:
        return "angular map: everything, as no view turns the lines"
    return f"angular map: patterns that repeat every {of['period']} lines"


SENTENCES: dict[str, Callable[[Mapping[str, Any]], str]] = {
    "nonorthogonality": lambda of: "non-orthogonality of the axes: Gx = O y, Gy = O x",
    "scale_difference": lambda of: "scale difference of the axes: Gx = R x, Gy = -R y",
    "bending_x": lambda of: "steady turn from column to column: Gx = x y, Gy = -x^2/2",
    "bending_y": lambda of: "steady turn from row to row: Gx = y^2/2, Gy = -x y",
    "undetermined_fields": lambda of: (
        f"{of['count']} fields whose standard uncertainty exceeds ten times the noise of a reading"
    ),
    "sites_never_visited": lambda of: (
        f"{of['count']} sites that no mark reaches, the first is "
        f"({of['first'][0]}, {of['first'][1]})"
    ),
    "marks_never_read": lambda of: (
        f"{of['count']} marks of the plate that no view reads"
    ),
    "every_field": lambda of: (
        "everything: one view cannot separate the stage from the plate"
    ),
    "line_offsets": _line_offsets,
    "rotation_symmetric": lambda of: (
        f"rotation-symmetric fields: every field that a {'half' if of['half'] else 'quarter'} "
        f"turn maps to itself ({of['numbers']} numbers beside the datum)"
    ),
    "periodic_fields": _periodic,
    "groups_of_sites": _groups,
    "harmonics_unseen": _harmonics,
    "periodic_lines": _periodic_lines,
    "groups_of_lines": lambda of: (
        f"angular map: {of['count']} groups of lines that no view connects"
    ),
    "lines_never_visited": lambda of: (
        f"{of['count']} angles of the stage that no line reaches"
    ),
    "looks_like_stage": lambda of: (
        f"{of['term']}: {of['count']} mode{'s' * (of['count'] != 1)} of the stage look like it"
    ),
    "separate_term": lambda of: (
        f"{of['term']}: {block_of(of['term']).cure}, or give it a size, as in {of['term']}:SIZE"
    ),
    "marks_missing": lambda of: (
        f"read the missing marks: only {of['sites']} of {of['of_sites']} sites and "
        f"{of['lines']} of {of['of_lines']} lines are determined"
    ),
    "add_views": _add,
    "or_add_views": lambda of: f"or {_add(of)}",
    "add_views_or_fewer_nodes": lambda of: f"{_add(of)}, or give the map fewer nodes",
}
"""The sentence of each mode and advice."""
