# SPDX-License-Identifier: Apache-2.0
"""The sentence of each finding, made from its data: verdict, causes and warnings of a result.

Elsewhere findings are data. Lengths are in µm, ratios in µm/m, rotations in mrad or arcsec.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

from selfcal_ros.blocks import blocks
from selfcal_ros.estimation.verdict.uncertainty import TERM, budgets
from selfcal_ros.model.result import COMBINED, CalibrationResult, Noise
from selfcal_ros.model.terms import TIMES
from selfcal_ros.model.verdict import BudgetLine, Cause, Finding, Grade, Remedy, Verdict
from selfcal_ros.reporting.words import phrases
from selfcal_ros.reporting.words.observability import worded_observability
from selfcal_ros.reporting.words.phrases import line_text
from selfcal_ros.units import (
    ARCSEC_PER_RAD,
    MM_PER_M,
    MRAD_PER_RAD,
    PPM_PER_ONE,
    UM_PER_M,
    URAD_PER_RAD,
)

NAMED = 5
"""Sites and lines that are named one by one; the others are counted."""


class DisplayUnit(NamedTuple):
    """Display unit of a quantity: factor from SI, and name."""

    per_si: float
    name: str


UM, RATIO = DisplayUnit(UM_PER_M, "µm"), DisplayUnit(PPM_PER_ONE, "µm/m")
MRAD = DisplayUnit(MRAD_PER_RAD, "mrad")
PERCENT = DisplayUnit(100.0, "%")
ARCSEC, URAD = DisplayUnit(ARCSEC_PER_RAD, "arcsec"), DisplayUnit(URAD_PER_RAD, "µrad")


def unit_of(name: str, si: str) -> DisplayUnit:
    """Return the display unit of the estimates of a term, or of the size of a cause.

    Small angles of axes and lines are in µrad, rotations of plate and microscope in mrad.
    """
    block = blocks().get(name)
    if si == "rad" and block is not None and (block.of_lines or block.of_images):
        return URAD
    return {"m": UM, "rad": MRAD, "m/m": RATIO}.get(si, DisplayUnit(1.0, si))


def plus_minus(finding: Finding, unit: DisplayUnit, times: float = 1.0) -> str:
    """Return size without sign, uncertainty with two digits, and unit of a finding.

    Parameters
    ----------
    finding : Finding
        Finding with size and u.
    unit : Unit
        Display unit.
    times : float
        Factor of the size.
    """
    value, u = (
        times * unit.per_si * size_si for size_si in (abs(finding.size), finding.u)
    )
    digits = 3
    if math.isfinite(u) and u > 0:
        digits = min(max(1 - math.floor(math.log10(u)), 0), 9)
    return f"{value:.{digits}f} ± {u:.{digits}f} {unit.name}"


def _either(finding: Finding, positive: str, negative: str) -> str:
    """Return one of two directions, by the sign of a size."""
    return positive if finding.size >= 0 else negative


def _slipped(of: dict[str, Any]) -> str:
    return (
        f"({of['x'] * UM_PER_M:.3g}, {of['y'] * UM_PER_M:.3g}) µm and "
        f"{of['phi'] * URAD_PER_RAD:.3g} µrad"
    )


_MICROSCOPE: dict[str, Callable[[Cause], str]] = {
    "turn": lambda c: (
        f"a microscope turned {_either(c, 'counter-clockwise', 'clockwise')} by "
        f"{plus_minus(c, MRAD)}"
    ),
    "scale": lambda c: (
        f"a microscope that shows lengths too {_either(c, 'short', 'long')} by "
        f"{plus_minus(c, PERCENT)}"
    ),
    "stretch": lambda c: (
        f"a microscope that shows lengths along x {_either(c, 'shorter', 'longer')} than along y "
        f"by {plus_minus(c, PERCENT, 2)}"
    ),
    "shear": lambda c: f"microscope axes out of square by {plus_minus(c, MRAD, 2)}",
}

_STRAIN: dict[str, Callable[[Cause], str]] = {
    "scale": lambda c: _either(c, "enlarged", "shrunk"),
    "stretch": lambda c: _either(
        c,
        "stretched along x and compressed along y",
        "stretched along y and compressed along x",
    ),
    "shear": lambda c: (
        f"stretched along its diagonal at {_either(c, '45', '135')}° and compressed along the other"
    ),
}

Words = Callable[[Any, dict[str, Any]], str]
"""A finding and its details -> its sentence."""

_CAUSES: dict[str, Words] = {
    "microscope": lambda c, of: (
        _MICROSCOPE[of["part"]](c)
        + (
            f", or offsets of the lines too {_either(c, 'large', 'small')} by as much"
            if of.get("either")
            else ""
        )
    ),
    "drift": lambda c, of: (
        f"a drift of {plus_minus(c, UM)} along {c.axis} during view '{c.view}'"
    ),
    "plate_scale": lambda c, of: (
        f"a plate {_either(c, 'larger', 'smaller')} by {plus_minus(c, RATIO)} in view '{c.view}' "
        f"than in view '{of['against']}'"
    ),
    "plate_strain": lambda c, of: (
        f"a plate {_STRAIN[of['part']](c)} by {plus_minus(c, RATIO)} in view '{c.view}' relative "
        f"to view '{of['against']}'"
    ),
    "plate_shape": lambda c, of: (
        f"a plate bent by {plus_minus(c, UM)} at the middle of an edge in view '{c.view}' relative "
        f"to view '{of['against']}'"
        + ("" if c.told else ", part of which cannot be separated from the stage")
    ),
    "line_eccentricity": lambda c, of: (
        f"a circle of lines off the axis of rotation by {plus_minus(c, URAD)} of its radius in "
        f"view '{c.view}'"
    ),
    "line_scale": lambda c, of: (
        f"offsets of the lines too {_either(c, 'small', 'large')} by {plus_minus(c, PERCENT)}"
        + (
            f", or a microscope that shows lengths too {_either(c, 'long', 'short')} by as much"
            if of.get("either")
            else ""
        )
    ),
    "yaw": lambda c, of: (
        f"a stage that yaws by up to {plus_minus(c, URAD)} over its travel"
    ),
    "approach": lambda c, of: (
        f"an indicated {c.axis} that changes by ±({plus_minus(c, UM)}) with the direction of "
        "approach"
    ),
    "slip": lambda c, of: (
        f"a plate that slipped by {_slipped(of)} after about {of['after']:.0%} of view '{c.view}'"
    ),
    "rotation": lambda c, of: (
        f"lines turned {_either(c, 'counter-clockwise', 'clockwise')} by {plus_minus(c, ARCSEC)} "
        f"relative to the marks in view '{c.view}'"
    ),
    "reading": lambda c, of: (
        f"a reading of {f'mark {c.mark}' if len(c.mark) > 1 else f'line {c.mark[0]}'} in view "
        f"'{c.view}' that is off by {plus_minus(c, UM if len(c.mark) > 1 else ARCSEC)}"
    ),
    "off_sites": lambda c, of: (
        f"a stage that stood {of['away'] * MM_PER_M:.3g} mm off the sites, where its error differs "
        f"by {plus_minus(c, UM)}"
    ),
    "roughness": lambda c, of: (
        f"a rotary encoder rougher than the {of['harmonics']} harmonics of its map can follow, by "
        f"{c.size * ARCSEC_PER_RAD:.3g} arcsec (rms)"
        if c.unit == "rad"
        else f"a stage rougher than the {of['nodes'][0]} x {of['nodes'][1]} nodes of its map can "
        f"follow, by {c.size * UM_PER_M:.3g} µm (rms)"
    ),
    "noise": lambda c, of: (
        f"{c.size:.2f} times as much noise in view '{c.view}' as in the others"
    ),
}

_ACTIONS = {
    "microscope": "align the microscope, or have the stage stop next to the marks deliberately "
    "(check_stops)",
    "drift": "visit the marks there and back",
    "plate_scale": "let the plate reach thermal equilibrium",
    "plate_shape": "support the plate without strain",
    "plate_strain": "support the plate without strain",
    "line_eccentricity": "centre the circle of lines on the axis of rotation in each view",
    "line_scale": "compare the offset of a line at two angles of the rotary axis",
    "yaw": "declare a larger yaw:SIZE",
    "approach": "approach each mark from the same side",
    "slip": "measure the view again, or solve with --robust",
    "rotation": "check whether the plate moved between marks and lines, and the sign of the "
    "lines' offsets",
    "reading": "solve with --robust, or measure it again",
    "off_sites": "place the plate closer to its nominal pose, or send the stage to the sites",
    "roughness": "give the map more nodes, or harmonics if it is the angular one (map in the "
    "plan), and views at other turns and shifts",
    "noise": "measure the view again, and look for a source of vibration",
}
"""What to do about a cause besides what was tried on the readings."""

SENTENCES: dict[str, Words] = {
    # tests that failed
    "not_identified": lambda f, of: "the readings do not identify the stage",
    "sign_not_shown": lambda f, of: (
        "nothing in the readings shows the sign of the microscope's offsets, and with the opposite "
        "sign the map would be that of a different stage: have the stage stop next to the marks "
        "deliberately (check_stops in the plan), or declare the microscope (--microscope 0.01)"
    ),
    "sign_shown_by_lines": lambda f, of: (
        "only lines that turn with the marks show the sign of the microscope's offsets, and "
        "nothing shows that of the lines: if both are opposite, the map is that of a different "
        "stage: have the stage stop next to the marks deliberately (check_stops in the plan), or "
        "declare the microscope (--microscope 0.01)"
    ),
    "lines_sign_not_shown": lambda f, of: (
        "nothing in the readings shows the sign of offset_theta, and with the other sign the "
        "angular map would be that of a different stage: turn the plate by 0.1 mrad or more "
        "between the views, or declare the microscope (--microscope 0.01)"
    ),
    "scale_of_offsets": lambda f, of: (
        f"offsets along {f.axis} are {f.size:.3f} ± {f.u:.3f} to {of['most']:.3f} times what the "
        f"stage moves among repeats, but the scale is taken as 1 ± {of['u_scale']:.3g}: correct "
        "the pixel size, or add check stops, which determine the scale"
    ),
    "not_converged": lambda f, of: (
        "the estimate converged only without the assumptions about the measurement, which the "
        "readings do not fit: check the sense, the axes and the pixel size of the microscope"
    ),
    "finite_rotation": lambda f, of: (
        f"the model is linear, but the plate was turned by up to {f.size * MRAD_PER_RAD:.2f} mrad: "
        "leave out --misalignment linear (or --method law); solved jointly with finite rotations, "
        f"the default, the readings leave {of['residuals'] * UM_PER_M:.3g} µm"
    ),
    "view_left_out": phrases.view_left_out_text,
    "noise_contradicted": lambda f, of: _noise_contradicted(f, of),
    "noise_unknown": lambda f, of: (
        "grid readings: neither repeats nor residuals determine the noise, so the uncertainty is "
        "not known; read every mark twice"
    ),
    "axes_not_met": lambda f, of: (
        "theta: the stage does not satisfy the axis conditions of the datum xy_axes (misclosure "
        f"{f.size * ARCSEC_PER_RAD:.3g} arcsec, p = {f.p:.2g}); use zero_mean"
    ),
    "changed": phrases.changed_text,
    "changed_or_drifted": phrases.changed_or_drifted_text,
    "microscope_off": phrases.microscope_off_text,
    "changed_or_microscope": phrases.changed_or_microscope_text,
    "plate_misfit": phrases.misfit_text,
    "scale_changed": phrases.scale_changed_text,
    "other_plate": phrases.other_plate_text,
    "prediction_failed": lambda f, of: (
        f"{held_out_text(f.view, of['tenth'])} is predicted with {f.size:.2f} times the noise, "
        f"beyond the limit of {of['limit']:.2f}"
    ),
    "between_runs": lambda f, of: (
        f"the {of['runs']} runs differ by more than their uncertainties: a variation of "
        f"{f.size * (UM if f.unit == 'm' else ARCSEC).per_si:.3g} "
        f"{(UM if f.unit == 'm' else ARCSEC).name} (rms) between runs, p = {f.p:.2g}, is in U"
    ),
    "enlarged_runs": lambda f, of: (
        f"the uncertainty of {', '.join(of['runs'])} was enlarged"
    ),
    # what was left out, or could not be done
    "not_in_all": lambda f, of: (
        f"sites that are not known in all runs are unknown in the mean: {of['sites']}"
    ),
    "no_uncertainty": lambda f, of: (
        "no uncertainty map, because of the size of the field: ask for it (--uncertainty always)"
    ),
    "roughness_untested": lambda f, of: (
        "whether the nodes of the map suffice for the stage was not tested, and U has no "
        "contribution for it: they are too many (more than 17 x 17, bilinear 15 x 15), or the "
        "readings too few, for a finer map; solve with fewer nodes once, or add a view"
    ),
    "term_without_readings": lambda f, of: (
        f"no reading depends on {of['term']}: it is not in the model; leave it out"
    ),
    "visited_once": lambda f, of: (
        "each mark was visited once in a view, its repeats one after the other: a drift that is "
        "the same in all views becomes part of the map, and repeats do not show it; visit the "
        "marks there and back, along x and along y"
    ),
    "few_read": phrases.few_read_text,
    "repeats_contradict": phrases.repeats_contradict_text,
    "unchecked": lambda f, of: _unchecked(of["sites"], of["lines"]),
    "magnification": lambda f, of: (
        f"the encoders indicate the plate {_either(f, 'larger', 'smaller')} than nominal by "
        f"{plus_minus(f, RATIO)}, more than plate and encoders should differ: check the pitch in "
        "the plan (grid_pitch), and the scale of the encoders"
    ),
    "reference_off": lambda f, of: (
        f"by the reference length the encoders indicate lengths "
        f"{_either(f, 'longer', 'shorter')} than they are by {plus_minus(f, RATIO)}, more than "
        "encoders should: check its error and the unit of that (relative, not µm/m), and the "
        "pitch in the plan (grid_pitch)"
    ),
    "drawn_uncertainty": lambda f, of: (
        f"uncertainties of Hu's law from {of['draws']} draws of unit noise: "
        f"{100 / math.sqrt(2 * of['draws']):.1f} % standard error"
    ),
    "outliers_removed": lambda f, of: _outliers_removed(of["number"], of["first"]),
    "noisy_view": lambda f, of: (
        f"view '{f.view}' is {f.size:.1f} times as noisy as the others: measure it again"
    ),
    "too_many_outliers": lambda f, of: (
        f"more than {of['limit']:.0%} of the readings contradict the others: none was removed; "
        "look for a wrong plan or a faulty view"
    ),
    "outliers_kept": lambda f, of: (
        "removing more outliers would leave the stage undetermined"
    ),
    "outliers_given_up": lambda f, of: (
        f"gave up on outliers after {of['rounds']} rounds: the readings seem to contain more; look "
        "for a wrong plan or a faulty view"
    ),
    "slip_found": lambda f, of: _slip_found(f, of),
    "taken_for_slip": lambda f, of: (
        f"view '{of['slip_in']}' looks as if the plate slipped, but the readings show "
        + what_it_is(
            Cause(**{**vars(f), "name": of["cause"], "told": of.get("told", True)})
        )
        + ", which explains them better: no view was split"
    ),
    "slips_given_up": lambda f, of: (
        f"gave up on slips after {of['slips']}: the readings seem to contain more; measure again"
    ),
    # why readings held out were not predicted, or not judged
    "rest_not_converged": lambda f, of: (
        "cannot be held out: the rest does not converge"
    ),
    "nothing_to_predict": lambda f, of: (
        "nothing to predict: no held-out mark is known from the rest"
    ),
    "own_terms_unknown": lambda f, of: (
        f"its own {' and '.join(of['terms'])} cannot be known: not judged"
    ),
}


def _noise_contradicted(finding: Finding, of: dict[str, Any]) -> str:
    kind, unit = ("grid", UM) if finding.unit == "m" else ("angular", ARCSEC)
    name = "the detections' own sigma" if of["declared"] else "repeats"
    return (
        f"{kind} readings: residuals show a noise of {finding.size * unit.per_si:.3g} "
        f"{unit.name}, {name} {of['stated'] * unit.per_si:.3g} {unit.name}; "
        + (
            "the readings contain something other than random noise"
            if finding.size > of["stated"]
            else "repeats share what single readings do not (drift between passes), or the stated "
            "noise is too large"
        )
    )


def held_out_text(view: str, tenth: int) -> str:
    """Return the name of a held-out set: a random tenth by its number, or a view."""
    return f"a random tenth ({tenth})" if tenth else f"view '{view}'"


def _unchecked(sites: list[list[int]], lines: list[int]) -> str:
    subject = " and ".join(
        _counted(places, kind)
        for places, kind in (([tuple(site) for site in sites], "site"), (lines, "line"))
        if places
    )
    predicate, them = (
        ("rests on a single reading", "it")
        if len(sites) + len(lines) == 1
        else ("rest on single readings", "them")
    )
    return (
        f"{subject} of the map {predicate} that no other checks; an error in {them} goes into "
        "the map, and no residual shows it: measure the missing marks, or add a view"
    )


def _counted(places: list, kind: str) -> str:
    if len(places) == 1:
        return f"1 {kind} {places[0]}"
    more = f" and {len(places) - NAMED} more" if len(places) > NAMED else ""
    return f"{len(places)} {kind}s ({', '.join(map(str, places[:NAMED]))}{more})"


def _outliers_removed(number: int, first: list[dict[str, Any]]) -> str:
    named = ", ".join(
        f"'{item['view']}' {item['kind']} "
        f"{tuple(item['mark']) if len(item['mark']) > 1 else item['mark'][0]} "
        f"({item['standardised']:.1f} sigma)"
        for item in first
    )
    more = f" and {number - len(first)} more" if number > len(first) else ""
    return f"removed {number} outlier{'s' * (number != 1)}: {named}{more}"


def _slip_found(finding: Finding, of: dict[str, Any]) -> str:
    places = [
        f"before {place['axis']} = {place['first']}"
        + ("" if place["view"] == finding.view else f" in view '{place['view']}'")
        for place in of["places"]
    ]
    spoils = "; this spoils the map: measure the view again"
    if len(places) > 1:
        return (
            f"view '{finding.view}': the plate slipped by about {_slipped(of)}, "
            f"{' or '.join(places)}; the readings do not determine which"
            f"{spoils if of['spoils'] else '; the view is left out'}"
        )
    return (
        f"view '{finding.view}': the plate slipped {places[0]} by {_slipped(of)}; treated as two "
        f"placements{spoils if of['spoils'] else ''}"
    )


def remedies(cause: Cause) -> tuple[Remedy, ...]:
    """Return the remedies of a cause: models and views to try, and the action that removes it."""
    if any(remedy.kind == "action" for remedy in cause.remedies):
        return cause.remedies
    return (*cause.remedies, Remedy("action", _action(cause.name)))


def _action(name: str) -> str:
    """Return what to do about a cause; of a block of another package as that says."""
    block = blocks().get(name)
    if name not in _ACTIONS and block is not None and block.action:
        return block.action
    return _ACTIONS.get(name, f"remove what causes it, or declare a larger {name}:SIZE")


def _cause_words(cause: Cause) -> str:
    """Return the sentence of a cause; of a block of another package its own, if that is there."""
    if cause.name in _CAUSES:
        return _CAUSES[cause.name](cause, cause.details)
    block = blocks().get(cause.name)
    if block is not None and block.sentence is not None:
        return block.sentence(cause)
    if not (cause.text or cause.unit):
        raise KeyError(f"no words for {cause.name}")
    where = f" in view '{cause.view}'" if cause.view else ""
    return cause.text or (
        f"an effect '{cause.name}' of {plus_minus(cause, unit_of(cause.name, cause.unit))}{where}"
    )


def advice(cause: Cause) -> str:
    """Return what to do about a cause."""
    return ", or ".join(
        f"solve with --{remedy.kind} {remedy.value}"
        if remedy.kind in ("model", "map")
        else remedy.value
        for remedy in remedies(cause)
        if remedy.kind != "view"
    )


def what_it_is(cause: Cause) -> str:
    """Return the description of a cause without its remedies.

    For a cause from a file without its data this is the whole text.
    """
    try:
        if "given" in cause.details:
            return _larger_term(cause, cause.details["given"])
        declared = ", declared to be exactly zero" * ("declared" in cause.details)
        return _cause_words(cause) + declared
    except (KeyError, TypeError, ValueError):
        if not cause.text:
            raise
        return cause.text


def _larger_term(cause: Cause, assumed_si: float) -> str:
    name = cause.name
    unit = unit_of(name, cause.unit)
    ratio = cause.size / assumed_si
    where = f" in view '{cause.view}'" if cause.view else ""
    return (
        f"a term '{name}' as large as {cause.size * unit.per_si:.3g} {unit.name}{where}, "
        f"{f'{ratio:.3g}' if ratio < 1e3 else f'{ratio:.0f}'} times the size assumed"
    )


def sentence_of(finding: Finding) -> str:
    """Return the sentence of a finding, for a cause with its remedies."""
    if finding.name in SENTENCES:
        return SENTENCES[finding.name](finding, finding.details)
    if not isinstance(finding, Cause):
        raise KeyError(f"no words for {finding.name}")
    return f"{what_it_is(finding)}: {advice(finding)}"


def worded(result: CalibrationResult) -> CalibrationResult:
    """Return a result with the texts of its findings; existing texts are kept."""
    findings = tuple(map(_with_text, result.findings))
    new = (
        finding.text
        for finding, old in zip(findings, result.findings, strict=True)
        if not old.text
    )
    verdict = worded_verdict(result.verdict, result.noise)
    assumed = (
        assumption_text(result)
        if verdict.qualified and not result.verdict.sentence
        else ""
    )
    if assumed:
        verdict = replace(verdict, sentence=f"{verdict.sentence}; {assumed}")
    if result.method == COMBINED and verdict.grade is Grade.GOOD:
        verdict = replace(
            verdict, sentence="Good: the runs agree within their uncertainties"
        )
    if result.recheck is not None and verdict.qualified:
        verdict = replace(verdict, sentence=phrases.recheck_sentence(result.recheck))
    return replace(
        result,
        verdict=verdict,
        findings=findings,
        observability=worded_observability(result.observability),
        warnings=(*result.warnings, *new),
        budget=tuple(
            replace(line, text=line.text or line_text(line)) for line in result.budget
        ),
    )


_ASSUMED = {
    "microscope": "a microscope known to {}",
    "drift": "a drift of {} within a view",
    "plate_shape": "a plate that bends by {} from view to view",
    "plate_strain": "a plate strained by {} from view to view",
    "approach": "an indicated position that changes by {} with the direction of approach",
    "line_eccentricity": "a circle of lines {} of its radius off the axis",
    "line_scale": "offsets of the lines known to {}",
    "rotation": "lines that turn by {} against the marks from view to view",
    "yaw": "a stage that yaws by {}",
}
"""What is assumed of a term, given its size."""


def assumption_text(result: CalibrationResult) -> str:
    """Return what U owes to sizes that are assumed and not shown by the readings; or nothing."""
    texts = []
    for budget in budgets(result) if result.budget else []:
        if budget.anywhere or not budget.assumptions:
            continue
        assumptions = " and ".join(map(_assumed, budget.assumptions))
        unit, of = (UM, "U") if budget.quantity == "xy" else (ARCSEC, "U of θ")
        texts.append(
            f"{of} assumes {assumptions}, which the readings do not show: {TIMES} times as much "
            f"would make it up to {budget.U_max_if_larger * unit.per_si:.3g} {unit.name}"
        )
    return "; ".join(texts)


def _assumed(line: BudgetLine) -> str:
    name = line.component.removeprefix(TERM)
    unit = PERCENT if name in ("microscope", "line_scale") else unit_of(name, line.unit)
    stated_si = line.details.get("given")  # a file may have lost it
    size_si = stated_si if isinstance(stated_si, float) else line.u
    size = f"{size_si * unit.per_si:.3g} {unit.name} (k=1)"
    return _ASSUMED.get(name, f"a {name} of {{}}").format(size)


def _with_text[Kind: Finding](finding: Kind) -> Kind:
    return finding if finding.text else replace(finding, text=sentence_of(finding))


def worded_verdict(verdict: Verdict, noise: Noise) -> Verdict:
    """Return a verdict with its sentence, its reasons and the texts of its findings.

    `noise` of the same result tells whether there was something to compare residuals with.
    """
    new = [
        finding for finding in (*verdict.failed, *verdict.causes) if not finding.text
    ]
    if verdict.sentence and not new:
        return verdict
    reasons = (
        *verdict.reasons,
        *(
            f"the readings show {what_it_is(finding)}"
            if isinstance(finding, Cause)
            else sentence_of(finding)
            for finding in new
        ),
    )
    causes = tuple(
        replace(_with_text(cause), remedies=remedies(cause)) for cause in verdict.causes
    )
    return replace(
        verdict,
        failed=tuple(map(_with_text, verdict.failed)),
        causes=causes,
        reasons=reasons,
        sentence=_sentence(verdict.grade, reasons, causes, noise),
    )


def _sentence(
    grade: Grade, reasons: tuple[str, ...], causes: tuple[Cause, ...], noise: Noise
) -> str:
    if grade is Grade.GOOD:
        tested = math.isfinite(noise.p_xy) or math.isfinite(noise.p_theta)
        return (
            "Good: residuals and the noise of readings agree"
            if tested
            else "Good: residuals show the noise; there are no repeats to compare it with"
        )
    if grade is Grade.ENLARGED:
        return f"Good within an enlarged U: {causes[0].text if causes else reasons[0]}"
    return f"Not qualified: {f'most likely {causes[0].text}' if causes else reasons[0]}"
