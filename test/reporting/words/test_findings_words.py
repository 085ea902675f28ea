# SPDX-License-Identifier: Apache-2.0
"""Every finding has its sentence, with its numbers in the units in which people read them."""

import math
from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.estimation import findings as f
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.result import Noise, result_to_dict
from selfcal_ros.model.verdict import Cause, Finding, Grade, Verdict
from selfcal_ros.reporting.words.causes import cause_text
from selfcal_ros.reporting.words.result import worded
from selfcal_ros.reporting.words.screening import warning
from selfcal_ros.reporting.words.verdict import reason, worded_verdict
from test.support.maps import random_map, result_of

TURN = Cause("microscope", "", 2e-3, 1e-5, "rad", 1e-6, f.MicroscopeCause("turn"))
UNTESTED = Noise(1e-8, 1e-6)
TESTED = Noise(1e-8, 1e-6, p_theta=0.4)

REASONS = {
    f.NoiseContradicted("grid", 4e-8, 2e-8, False): (
        "grid readings: residuals show a noise of 0.04 µm, repeats 0.02 µm; something beside "
        "random noise is in the readings"),
    f.NoiseContradicted("angular", math.radians(1 / 3600), math.radians(2 / 3600), True): (
        "angular readings: residuals show a noise of 1 arcsec, the detections' own sigma 2 arcsec; "
        "repeats share what single readings do not (drift between passes), or the stated noise is "
        "too large"),
    f.NoiseUnknown(): (
        "grid readings: neither repeats nor residuals determine the noise, so that the uncertainty "
        "is not known; read every mark twice"),
    f.FiniteRotation(5.126e-3, 2.04e-8): (
        "the model is linear, but the plate was turned by up to 5.13 mrad: solve jointly with "
        "finite rotations, the default, which leaves 0.0204 µm"),
    f.AxesNotMet(math.radians(3 / 3600), 0.0012): (
        "theta: the stage does not satisfy the axis conditions of the datum xy_axes (misclosure 3 "
        "arcsec, p = 0.0012); use zero_mean"),
    f.PredictionFailed("view 'ty'", 3.456, 1.2): (
        "view 'ty' is predicted with 3.46 times the noise, beyond the limit of 1.20"),
    TURN: "the readings show microscope turned by 2.000 ± 0.010 mrad"}

MANY = tuple(f.Removed("90", "grid", (i, -2), 5.04 + i, 0.1, 1e-6) for i in range(6))
WARNINGS = {
    f.NoUncertainty(): (
        "no uncertainty map, because of the size of the field: ask for it (--uncertainty always)"),
    f.VisitedOnce(): (
        "each mark was visited once in a view, its repeats one after the other: a drift that is "
        "alike in all views is a part of the map, and repeats do not show it; visit the marks "
        "there and back, along x and along y"),
    f.Unchecked(((5, -3),)): (
        "1 site (5, -3) of the map rests on a single reading that no other checks; what is wrong "
        "with it is in the map, and no residual shows it: measure the marks that are missing, or "
        "add a view"),
    f.Unchecked(tuple((m, 5) for m in range(7)), ((4,), (11,))): (
        "7 sites ((0, 5), (1, 5), (2, 5), (3, 5), (4, 5) and 2 more) and 2 lines (4, 11) of the "
        "map rest on single readings that no other checks; what is wrong with them is in the map, "
        "and no residual shows it: measure the marks that are missing, or add a view"),
    f.DrawnUncertainty(200): (
        "uncertainties of the law from 200 draws of unit noise: 5.0 % standard error"),
    f.OutliersRemoved((*MANY[:1], f.Removed("a", "angular", (7,), 9.0, 0.0, 1e-5))): (
        "removed 2 outliers: '90' grid (0, -2) (5.0 sigma), 'a' angular 7 (9.0 sigma)"),
    f.OutliersRemoved(MANY): (
        "removed 6 outliers: '90' grid (0, -2) (5.0 sigma), '90' grid (1, -2) (6.0 sigma), '90' "
        "grid (2, -2) (7.0 sigma), '90' grid (3, -2) (8.0 sigma), '90' grid (4, -2) (9.0 sigma) "
        "and 1 more"),
    f.NoisyView("90", 2.26): (
        "view '90' is 2.3 times as noisy as the others: measure it again"),
    f.TooManyOutliers(0.1): (
        "more than 10% of the readings contradict the others: none was removed; look for a wrong "
        "plan or a faulty view"),
    f.OutliersKept(): "removing more outliers would leave the stage undetermined",
    f.OutliersGivenUp(60): (
        "gave up on outliers after 60 rounds: more of them seem to be in the readings; look for a "
        "wrong plan or a faulty view"),
    f.SlipFound("90", ("before m = 2",), 3e-7, -4e-7, 5e-6, False): (
        "view '90': the plate slipped before m = 2 by (0.3, -0.4) µm and 5 µrad; treated as two "
        "placements"),
    f.SlipFound("90", ("before m = 2",), 3e-7, -4e-7, 5e-6, True): (
        "view '90': the plate slipped before m = 2 by (0.3, -0.4) µm and 5 µrad; treated as two "
        "placements; the map is spoiled by it: measure the view again"),
    f.SlipFound("90", ("before m = 2", "before n = 0"), 3e-7, 0.0, 0.0, False): (
        "view '90': the plate slipped by about (0.3, 0) µm and 0 µrad, before m = 2 or before "
        "n = 0; the readings do not tell which; the view is left out"),
    f.SlipFound("90", ("before m = 2", "before n = 0"), 3e-7, 0.0, 0.0, True): (
        "view '90': the plate slipped by about (0.3, 0) µm and 0 µrad, before m = 2 or before "
        "n = 0; the readings do not tell which; the map is spoiled by it: measure the view again"),
    f.TakenForSlip("+x", TURN): (
        "view '+x' looks as if the plate slipped, but the readings show microscope turned by "
        "2.000 ± 0.010 mrad, which explains them better: no view was split"),
    f.SlipsGivenUp(3): (
        "gave up on slips after 3: more of them seem to be in the readings; measure again")}


@pytest.mark.parametrize(("found", "text"), REASONS.items(), ids=lambda x: type(x).__name__)
def test_reasons(found, text):
    assert reason(found) == text


@pytest.mark.parametrize(("found", "text"), WARNINGS.items(), ids=lambda x: type(x).__name__)
def test_warnings(found, text):
    assert warning(found) == text


LEFT = (f.NoisyView, f.TooManyOutliers, f.OutliersKept, f.OutliersGivenUp, f.SlipFound,
        f.SlipsGivenUp)


@pytest.mark.parametrize("found", WARNINGS, ids=lambda x: type(x).__name__)
def test_what_screening_leaves_is_a_reason_in_the_same_words(found):
    if isinstance(found, LEFT):
        assert reason(found) == WARNINGS[found]
    else:
        with pytest.raises(TypeError, match="no words for"):
            reason(found)


@pytest.mark.parametrize(("size", "text"), [
    (f.SizeCause(1e-6, 2.04e-3), "microscope up to 2 mrad, 2000 times the size assumed"),
    (f.SizeCause(8e-4, 2.04e-3), "microscope up to 2 mrad, 2.5 times the size assumed")])
def test_a_size_that_is_too_small_in_words(size, text):
    assert cause_text(replace(TURN, what=size)) == (
        f"{text}: align the microscope, or let the stage stop beside the marks on purpose "
        "(check_stops)")


def test_what_nobody_worded_is_an_error():
    for words in (reason, warning):
        with pytest.raises(TypeError, match="no words for Finding"):
            words(Finding())
    with pytest.raises(TypeError, match="no words for Finding of microscope"):
        cause_text(replace(TURN, what=Finding()))


def test_a_verdict_names_the_likeliest_cause_or_else_the_first_reason():
    drift = replace(TURN, name="drift", what=f.DriftCause("x", "90"), size=5e-7, u=1e-8)
    unknown = f.NoiseUnknown()
    found = worded_verdict(Verdict(Grade.NOT_QUALIFIED, causes=(TURN, drift),
                                   findings=(unknown, TURN, drift)), TESTED)
    assert found.sentence == ("Not qualified: most likely microscope turned by 2.000 ± 0.010 mrad: "
                              "align the microscope, or let the stage stop beside the marks on "
                              "purpose (check_stops)")
    assert found.reasons == tuple(map(reason, (unknown, TURN, drift)))
    assert [cause.text for cause in found.causes] == [cause_text(TURN), cause_text(drift)]
    assert not found.findings and not found.qualified
    alone = worded_verdict(Verdict(Grade.NOT_QUALIFIED, findings=(unknown,)), TESTED)
    assert alone.sentence == f"Not qualified: {reason(unknown)}"


def test_a_qualified_verdict_says_what_was_compared():
    assert worded_verdict(Verdict(Grade.GOOD), TESTED).sentence == (
        "Good: residuals and the noise of readings agree")
    assert worded_verdict(Verdict(Grade.GOOD), UNTESTED).sentence == (
        "Good: residuals show the noise; there are no repeats to compare it with")


def test_a_verdict_within_an_enlarged_uncertainty_names_what_enlarged_it():
    found = worded_verdict(Verdict(Grade.ENLARGED, causes=(TURN,), findings=(TURN,)), TESTED)
    assert found.sentence == f"Good within an enlarged U: {cause_text(TURN)}"
    assert found.qualified


def test_a_result_is_worded_once_and_only_then_written():
    plain = replace(result_of(random_map(Artifact(3, 0.01, 8), 1)), warnings=("as read",),
                    verdict=Verdict(Grade.NOT_QUALIFIED, causes=(TURN,), findings=(TURN,)),
                    findings=(f.OutliersKept(), f.SlipsGivenUp(3)))
    with pytest.raises(ValueError, match="2 findings of the result are not worded"):
        result_to_dict(plain)
    with pytest.raises(ValueError, match="1 findings of the verdict are not worded"):
        result_to_dict(replace(plain, findings=()))
    found = worded(plain)
    assert found.warnings == ("as read", warning(f.OutliersKept()), warning(f.SlipsGivenUp(3)))
    assert found.verdict.reasons == (reason(TURN),)
    written = result_to_dict(found)
    assert result_to_dict(worded(found)) == written
    assert written["verdict"]["causes"] == [{
        "name": "microscope", "text": cause_text(TURN), "view": "", "axis": "", "mark": [],
        "size": 2e-3, "u": 1e-5, "unit": "rad", "p": 1e-6, "effect_rms": None, "effect_max": None,
        "told": True, "remedies": [{"action": (
            "align the microscope, or let the stage stop beside the marks on purpose "
            "(check_stops)")}]}]
    assert np.array_equal(found.error_map.gx, plain.error_map.gx)
