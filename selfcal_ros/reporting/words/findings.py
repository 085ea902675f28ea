# SPDX-License-Identifier: Apache-2.0
"""The sentence of each finding, made from its data: verdict, causes and warnings of a result.

Elsewhere findings are data. Lengths are in µm, ratios in µm/m, rotations in mrad or arcsec.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from functools import singledispatch
from typing import Any

from selfcal_ros.blocks import blocks
from selfcal_ros.errors import printable, some_of
from selfcal_ros.estimation.verdict.uncertainty import TERM, budgets
from selfcal_ros.model.budget import BudgetLine, OfAssumption, OfTerm
from selfcal_ros.model.findings import (
    ApproachUnknown,
    AxesNotMet,
    BetweenRuns,
    Cause,
    DrawnUncertainty,
    EnlargedRuns,
    Finding,
    FiniteRotation,
    Found,
    HarmonicsUntested,
    LinesSignNotShown,
    Magnification,
    NoiseContradicted,
    NoiseUnknown,
    NoisyView,
    NoOffsets,
    NotConverged,
    NothingToPredict,
    NotIdentified,
    NotInAll,
    NoUncertainty,
    OutliersGivenUp,
    OutliersKept,
    OutliersRemoved,
    OwnTermsUnknown,
    PlateHardlyMoved,
    PredictionFailed,
    ReferenceOff,
    Remedy,
    RestNotConverged,
    RoughnessUntested,
    ScaleNotCompared,
    ScaleOfOffsets,
    SignNotShown,
    SignShownByLines,
    SlipFound,
    SlipsGivenUp,
    TakenForSlip,
    TermWithoutReadings,
    TooManyOutliers,
    Unchecked,
    VisitedOnce,
    WarningOfRuns,
)
from selfcal_ros.model.parts import Combined
from selfcal_ros.model.result import COMBINED, CalibrationResult, Noise
from selfcal_ros.model.terms import TIMES
from selfcal_ros.model.verdict import Grade, Verdict
from selfcal_ros.reporting.summary.numbers import counted, p_text, with_u
from selfcal_ros.reporting.words import phrases
from selfcal_ros.reporting.words.observability import worded_observability
from selfcal_ros.reporting.words.phrases import line_text
from selfcal_ros.reporting.words.quantities import (
    ARCSEC,
    MRAD,
    PERCENT,
    RATIO,
    UM,
    URAD,
    DisplayUnit,
    size_text,
    unit_of,
)
from selfcal_ros.units import (
    ARCSEC_PER_RAD,
    MM_PER_M,
    MRAD_PER_RAD,
    UM_PER_M,
    URAD_PER_RAD,
)

NAMED = 5
"""Sites and lines that are named one by one; the others are counted."""


def plus_minus(finding: Found, unit: DisplayUnit, times: float = 1.0) -> str:
    """Return size without sign, uncertainty with two digits, and unit of a finding.

    Parameters
    ----------
    finding : Found
        Finding or cause with size and u.
    unit : Unit
        Display unit.
    times : float
        Factor of the size.
    """
    value, u = (
        times * unit.per_si * size_si for size_si in (abs(finding.size), finding.u)
    )
    return f"{with_u(value, u)} {unit.name}"


def _either(finding: Found, positive: str, negative: str) -> str:
    """Return one of two directions, by the sign of a size."""
    return positive if finding.size >= 0 else negative


def _slipped(x_m: float, y_m: float, phi_rad: float) -> str:
    return (
        f"({x_m * UM_PER_M:.3g}, {y_m * UM_PER_M:.3g}) µm and "
        f"{phi_rad * URAD_PER_RAD:.3g} µrad"
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

_CAUSES: dict[str, Callable[[Cause], str]] = {
    "microscope": lambda c: (
        _MICROSCOPE[c.details.part](c)
        + (
            f", or offsets of the lines too {_either(c, 'large', 'small')} by as much"
            if c.details.either
            else ""
        )
    ),
    "drift": lambda c: (
        f"a drift of {plus_minus(c, UM)} along {c.axis} during view '{c.view}'"
    ),
    "plate_scale": lambda c: (
        f"a plate {_either(c, 'larger', 'smaller')} by {plus_minus(c, RATIO)} in view '{c.view}' "
        f"than in view '{c.details.against}'"
    ),
    "plate_strain": lambda c: (
        f"a plate {_STRAIN[c.details.part](c)} by {plus_minus(c, RATIO)} in view '{c.view}' "
        f"relative to view '{c.details.against}'"
    ),
    "plate_shape": lambda c: (
        f"a plate bent by {plus_minus(c, UM)} at the middle of an edge in view '{c.view}' relative "
        f"to view '{c.details.against}'"
        + ("" if c.told else ", part of which cannot be separated from the stage")
    ),
    "line_eccentricity": lambda c: (
        f"a circle of lines off the axis of rotation by {plus_minus(c, URAD)} of its radius in "
        f"view '{c.view}'"
    ),
    "line_scale": lambda c: (
        f"offsets of the lines too {_either(c, 'small', 'large')} by {plus_minus(c, PERCENT)}"
        + (
            f", or a microscope that shows lengths too {_either(c, 'long', 'short')} by as much"
            if c.details.either
            else ""
        )
    ),
    "yaw": lambda c: (
        f"a stage that yaws by up to {plus_minus(c, URAD)} over its travel"
    ),
    "approach": lambda c: (
        f"an indicated {c.axis} that changes by ±({plus_minus(c, UM)}) with the direction of "
        "approach"
    ),
    "reversal": lambda c: (
        f"an indicated {c.axis} whose change with the direction of approach differs by up to "
        f"±({plus_minus(c, UM)}) from place to place"
    ),
    "slip": lambda c: (
        "a plate that slipped by "
        f"{_slipped(c.details.x, c.details.y, c.details.phi)} after about "
        f"{100 * c.details.after:.0f} % of view '{c.view}'"
    ),
    "rotation": lambda c: (
        f"lines turned {_either(c, 'counter-clockwise', 'clockwise')} by {plus_minus(c, ARCSEC)} "
        f"relative to the marks in view '{c.view}'"
    ),
    "reading": lambda c: (
        f"a reading of {f'mark {c.mark}' if len(c.mark) > 1 else f'line {c.mark[0]}'} in view "
        f"'{c.view}' that is off by {plus_minus(c, UM if len(c.mark) > 1 else ARCSEC)}"
    ),
    "off_sites": lambda c: (
        f"a stage that stood {c.details.away * MM_PER_M:.3g} mm off the sites, where its error "
        f"differs by {plus_minus(c, UM)}"
    ),
    "roughness": lambda c: (
        f"a rotary encoder rougher than the {c.details.harmonics} harmonics of its map can "
        f"follow, by {c.size * ARCSEC_PER_RAD:.3g} arcsec (rms)"
        if c.unit == "rad"
        else f"a stage rougher than the {' x '.join(map(str, c.details.nodes))} nodes of its "
        f"map can follow, by {c.size * UM_PER_M:.3g} µm (rms)"
    ),
    "noise": lambda c: (
        f"{c.size:.2f} times as much noise in view '{c.view}' as in the others"
    ),
}

_OF_DETAILS = {
    "microscope",
    "plate_scale",
    "plate_strain",
    "plate_shape",
    "slip",
    "off_sites",
    "roughness",
}
"""Causes whose sentences need their details."""

_ROBUST = {"slip": "measure the view again", "reading": "measure it again"}
"""What else to do about a cause that `--robust` leaves out."""

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
    "reversal": "approach each mark from the same side",
    "slip": f"{_ROBUST['slip']}, or solve with --robust",
    "rotation": "check whether the plate moved between marks and lines, and the sign of the "
    "lines' offsets",
    "reading": f"solve with --robust, or {_ROBUST['reading']}",
    "off_sites": "place the plate closer to its nominal pose, send the stage to the sites, or "
    "correct the stage by this map and measure again",
    "roughness": "give the map more nodes, or harmonics if it is the angular one (map in the "
    "plan), and views at other turns and shifts",
    "noise": "measure the view again, and look for a source of vibration",
}
"""What to do about a cause besides what was tried on the readings."""

FIXED: dict[type, str] = {
    NotIdentified: "the readings do not identify the stage",
    SignNotShown: (
        "nothing in the readings shows the sign of the microscope's offsets, and with the opposite "
        "sign the map would be that of a different stage: have the stage stop next to the marks "
        "deliberately (check_stops in the plan), or declare the microscope (--microscope 0.01)"
    ),
    NoOffsets: (
        "all offsets of marks are 0: if the stage was driven until each mark was centred, say so "
        "(--microscope 0.01); if not, the detector measures nothing, and the map is that of the "
        "stage's targets"
    ),
    SignShownByLines: (
        "only lines that turn with the marks show the sign of the microscope's offsets, and "
        "nothing shows that of the lines: if both are opposite, the map is that of a different "
        "stage: have the stage stop next to the marks deliberately (check_stops in the plan), or "
        "declare the microscope (--microscope 0.01)"
    ),
    LinesSignNotShown: (
        "nothing in the readings shows the sign of offset_theta, and with the other sign the "
        "angular map would be that of a different stage: read marks and lines together in two "
        "views, the plate turned by 0.1 mrad or more between them, or declare the microscope "
        "(--microscope 0.01)"
    ),
    NotConverged: (
        "the estimate converged only without the assumptions about the measurement, which the "
        "readings do not fit: check the sense, the axes and the pixel size of the microscope"
    ),
    NoiseUnknown: (
        "grid readings: neither repeats nor residuals determine the noise, so the uncertainty is "
        "not known; read every mark twice"
    ),
    NoUncertainty: (
        "no uncertainty map, because of the size of the field: ask for it (--uncertainty always)"
    ),
    RoughnessUntested: (
        "whether the nodes of the map suffice for the stage was not tested, and U has no "
        "contribution for it: they are too many (more than 17 x 17, bilinear 15 x 15), or the "
        "readings too few, for a finer map, and no repeats, or too few residuals, test the map; "
        "read every mark twice, add marks or views, or give the map fewer nodes"
    ),
    HarmonicsUntested: (
        "whether the harmonics of the angular map suffice for the rotary encoder was not tested, "
        "and U has no contribution for it: the readings are too few for more of them; read the "
        "lines in a further view at another turn"
    ),
    VisitedOnce: (
        "each mark was visited once in a view, its repeats one after the other: a drift that is "
        "the same in all views becomes part of the map, and repeats do not show it; visit the "
        "marks there and back, along x and along y"
    ),
    ApproachUnknown: (
        "the encoder was not recorded on the way to most marks: from which side the stage came is "
        "not known, and an error that depends on it (backlash, settling, late stamps) may be in "
        "the map; record the encoder throughout, with more than four samples from one exposure "
        "to the next and no gap above max_encoder_gap"
    ),
    OutliersKept: "removing more outliers would leave the stage undetermined",
    RestNotConverged: "cannot be held out: the rest does not converge",
    NothingToPredict: "nothing to predict: no held-out mark is known from the rest",
}
"""The sentence of each finding without data."""


@singledispatch
def sentence_of(finding: Finding | Cause) -> str:
    """Return the sentence of a finding, for a cause with its remedies.

    Raises
    ------
    KeyError
        If there are no words for it.
    """
    text = FIXED.get(type(finding))
    if text is None:
        raise KeyError(f"no words for {finding.name}")
    return text


for _text_of in (
    phrases.changed_or_drifted_text,
    phrases.changed_or_marks_text,
    phrases.changed_or_microscope_text,
    phrases.changed_text,
    phrases.few_read_text,
    phrases.microscope_off_text,
    phrases.misfit_text,
    phrases.other_plate_text,
    phrases.repeats_contradict_text,
    phrases.scale_changed_text,
    phrases.scale_not_compared_text,
    phrases.view_left_out_text,
):
    sentence_of.register(_text_of)


@sentence_of.register
def _(cause: Cause) -> str:
    return f"{what_it_is(cause)}: {advice(cause)}"


@sentence_of.register
def _(finding: ScaleOfOffsets) -> str:
    return (
        f"offsets along {finding.axis} are {finding.size:.3f} ± {finding.u:.3f} to "
        f"{finding.most:.3f} times what the stage moves among repeats, but the scale is taken as "
        f"1 ± {finding.u_scale:.3g}: correct the pixel size, or add check stops, which determine "
        "the scale"
    )


@sentence_of.register
def _(finding: FiniteRotation) -> str:
    return (
        "the model is linear, but the plate was turned by up to "
        f"{finding.size * MRAD_PER_RAD:.2f} mrad: leave out --misalignment linear (or --method "
        "law); solved jointly with finite rotations, the default, the readings leave "
        f"{finding.residuals * UM_PER_M:.3g} µm"
    )


@sentence_of.register
def _(finding: NoiseContradicted) -> str:
    kind, unit = ("grid", UM) if finding.unit == "m" else ("angular", ARCSEC)
    name = "the detections' own sigma" if finding.declared else "repeats"
    why = (
        "the readings contain something other than random noise"
        if finding.size > finding.stated
        else "repeats share what single readings do not (drift between passes), or the stated "
        "noise is too large"
    )
    return (
        f"{kind} readings: residuals show a noise of {finding.size * unit.per_si:.3g} "
        f"{unit.name}, {name} {finding.stated * unit.per_si:.3g} {unit.name}; {why}"
    )


@sentence_of.register
def _(finding: AxesNotMet) -> str:
    return (
        "theta: the stage does not satisfy the axis conditions of the datum xy_axes (misclosure "
        f"{finding.size * ARCSEC_PER_RAD:.3g} arcsec, {p_text(finding.p)}); use zero_mean"
    )


@sentence_of.register
def _(finding: PredictionFailed) -> str:
    return (
        f"{held_out_text(finding.view, finding.tenth)} is predicted with {finding.size:.2f} times "
        f"the noise, beyond the limit of {finding.limit:.2f}"
    )


@sentence_of.register
def _(finding: BetweenRuns) -> str:
    unit = UM if finding.unit == "m" else ARCSEC
    scale = (
        "; nearly all of it is their scale: compare the certificates, and the temperatures of "
        "plate and encoders"
        if finding.of_scale
        else ""
    )
    return (
        f"the {finding.runs} runs differ by more than their uncertainties: a variation of "
        f"{finding.size * unit.per_si:.3g} {unit.name} (rms) between runs, {p_text(finding.p)}, "
        f"is in U{scale}"
    )


@sentence_of.register
def _(finding: EnlargedRuns) -> str:
    return f"the uncertainty of {', '.join(finding.runs)} was enlarged"


@sentence_of.register
def _(finding: NotInAll) -> str:
    return (
        f"sites that are not known in all runs are unknown in the mean: {finding.sites}"
    )


@sentence_of.register
def _(finding: WarningOfRuns) -> str:
    return f"{', '.join(map(printable, finding.runs))}: {finding.warning}"


@sentence_of.register
def _(finding: TermWithoutReadings) -> str:
    return f"no reading depends on {finding.term}: it is not in the model; leave it out"


@sentence_of.register
def _(finding: Magnification) -> str:
    return (
        f"the encoders indicate the plate {_either(finding, 'larger', 'smaller')} than nominal by "
        f"{plus_minus(finding, RATIO)}, more than plate and encoders should differ: check the "
        "pitch in the plan (grid_pitch), and the scale of the encoders"
    )


@sentence_of.register
def _(finding: ReferenceOff) -> str:
    return (
        "by the reference length the encoders indicate lengths "
        f"{_either(finding, 'longer', 'shorter')} than they are by {plus_minus(finding, RATIO)}, "
        "more than encoders should: check its error and the unit of that (relative, not µm/m), "
        "and the pitch in the plan (grid_pitch)"
    )


@sentence_of.register
def _(finding: DrawnUncertainty) -> str:
    return (
        f"uncertainties of Hu's law from {finding.draws} draws of unit noise: "
        f"{100 / math.sqrt(2 * finding.draws):.1f} % standard error"
    )


@sentence_of.register
def _(finding: NoisyView) -> str:
    return (
        f"view '{finding.view}' is {finding.size:.1f} times as noisy as the others: measure it "
        "again"
    )


@sentence_of.register
def _(finding: TooManyOutliers) -> str:
    return (
        f"more than {100 * finding.limit:.0f} % of the readings contradict the others: none was "
        "removed; look for a wrong plan or a faulty view"
    )


@sentence_of.register
def _(finding: OutliersGivenUp) -> str:
    return (
        f"gave up on outliers after {finding.rounds} rounds: the readings seem to contain more; "
        "look for a wrong plan or a faulty view"
    )


@sentence_of.register
def _(finding: TakenForSlip) -> str:
    data = {item.name: getattr(finding, item.name) for item in fields(Found)}
    cause = Cause(
        **data, name=finding.cause, details=finding.of_cause, told=finding.told
    )
    return (
        f"view '{finding.slip_in}' looks as if the plate slipped, but the readings show "
        f"{what_it_is(cause)}, which explains them better: no view was split"
    )


@sentence_of.register
def _(finding: SlipsGivenUp) -> str:
    return (
        f"gave up on slips after {finding.slips}: the readings seem to contain more; measure "
        "again"
    )


@sentence_of.register
def _(finding: OwnTermsUnknown) -> str:
    return f"its own {' and '.join(finding.terms)} cannot be known: not judged"


def held_out_text(view: str, tenth: int) -> str:
    """Return the name of a held-out set: a random tenth by its number, or a view."""
    return f"a random tenth ({tenth})" if tenth else f"view '{view}'"


@sentence_of.register
def _(finding: Unchecked) -> str:
    subject = " and ".join(
        _counted(places, kind)
        for places, kind in ((finding.sites, "site"), (finding.lines, "line"))
        if places
    )
    predicate, them = (
        ("rests on a single reading", "it")
        if len(finding.sites) + len(finding.lines) == 1
        else ("rest on single readings", "them")
    )
    return (
        f"{subject} of the map {predicate} that no other checks; an error in {them} goes into "
        "the map, and no residual shows it: measure the missing marks, or add a view"
    )


def _counted(places: Sequence[Any], kind: str) -> str:
    if len(places) == 1:
        return f"1 {kind} {places[0]}"
    return f"{len(places)} {kind}s ({some_of(places, NAMED)})"


@sentence_of.register
def _(finding: OutliersRemoved) -> str:
    named = [
        f"'{reading.view}' {reading.kind} "
        f"{reading.mark if len(reading.mark) > 1 else reading.mark[0]} "
        f"({reading.standardised:.1f} sigma)"
        for reading in finding.first
    ]
    return (
        f"removed {counted(finding.number, 'outlier')}: "
        f"{some_of(named, len(named), finding.number)}"
    )


@sentence_of.register
def _(finding: PlateHardlyMoved) -> str:
    return (
        f"view '{finding.view}': the plate lies within {finding.size * UM_PER_M:.2g} µm of where "
        f"it lay in view '{finding.against}', and shows no errors of its own: if it was not placed "
        "anew, its errors are in the map; place it some µm elsewhere"
    )


@sentence_of.register
def _(finding: SlipFound) -> str:
    places = [
        f"before {place.axis} = {place.first}"
        + ("" if place.view == finding.view else f" in view '{place.view}'")
        for place in finding.places
    ]
    how_much = _slipped(finding.x, finding.y, finding.phi)
    spoils = "; this spoils the map: measure the view again"
    if len(places) > 1:
        return (
            f"view '{finding.view}': the plate slipped by about {how_much}, "
            f"{' or '.join(places)}; the readings do not determine which"
            f"{spoils if finding.spoils else '; the view is left out'}"
        )
    return (
        f"view '{finding.view}': the plate slipped {places[0]} by {how_much}; treated as two "
        f"placements{spoils if finding.spoils else ''}"
    )


def remedies(cause: Cause) -> tuple[Remedy, ...]:
    """Return the remedies of a cause: models and views to try, and the action that removes it."""
    if any(remedy.kind == "action" for remedy in cause.remedies):
        return cause.remedies
    return (*cause.remedies, Remedy("action", _action(cause)))


def _action(cause: Cause) -> str:
    """Return what to do about a cause; of a block of another package as that says."""
    name = cause.name
    block = blocks().get(name)
    if name not in _ACTIONS and block is not None and block.action:
        return block.action
    if cause.details.robust and name in _ROBUST:
        return _ROBUST[name]
    return _ACTIONS.get(name, f"remove what causes it, or declare a larger {name}:SIZE")


def _cause_words(cause: Cause) -> str:
    """Return the sentence of a cause; of a block of another package its own, if that is there."""
    if cause.name in _CAUSES:
        return _CAUSES[cause.name](cause)
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
    if cause.text and cause.name in _OF_DETAILS and not cause.details.to_dict():
        return cause.text
    try:
        if math.isfinite(cause.details.given):
            return _larger_term(cause, cause.details.given)
        declared = ", declared to be exactly zero" * (cause.details.declared == 0)
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
        verdict = replace(verdict, sentence=_agreement(result.parts.combined))
    if result.recheck is not None and verdict.qualified:
        sentence = phrases.recheck_sentence(
            result.recheck,
            without_scale=any(
                isinstance(finding, ScaleNotCompared) for finding in findings
            ),
        )
        verdict = replace(verdict, sentence=sentence)
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


def _agreement(mean: Combined | None) -> str:
    """Return the sentence of a mean whose runs scatter no more than by chance."""
    disagree = [
        printable(run.file)
        for run in (mean.runs if mean else ())
        if False in (run.agrees, run.agrees_theta)
    ]
    if not disagree:
        return "Good: the runs agree within their uncertainties"
    return (
        "Good: the runs scatter no more than by chance, though "
        f"{' and '.join(disagree)} {'disagrees' if len(disagree) == 1 else 'disagree'} with the "
        "others at 5 %"
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
    of = line.details
    size_si = of.given if isinstance(of, OfTerm | OfAssumption) else line.u
    size = f"{size_text(line, size_si)} (k=1)"
    return _ASSUMED.get(name, f"a {name} of {{}}").format(size)


def _with_text[Kind: (Finding, Cause)](finding: Kind) -> Kind:
    return finding if finding.text else replace(finding, text=sentence_of(finding))


def worded_verdict(verdict: Verdict, noise: Noise) -> Verdict:
    """Return a verdict with its sentence, its reasons and the texts of its findings.

    `noise` of the same result tells whether there was something to compare residuals with.
    """
    found: tuple[Finding | Cause, ...] = (*verdict.failed, *verdict.causes)
    new = [finding for finding in found if not finding.text]
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
