# SPDX-License-Identifier: Apache-2.0
"""From which probability and which size of a field on the verdict changes its mind."""

from dataclasses import replace
from datetime import datetime

import numpy as np
import pytest

from selfcal_ros.estimation import api
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.checks.wiring import Turned, WiringError, turned_readings
from selfcal_ros.estimation.joint.problem import repeats_of
from selfcal_ros.estimation.joint.solve import solve_joint
from selfcal_ros.estimation.options import Options
from selfcal_ros.estimation.verdict import search
from selfcal_ros.estimation.verdict.judge import judged, provenance_of
from selfcal_ros.estimation.verdict.search import is_searched, search_causes
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.error_map import ThetaDatum
from selfcal_ros.model.findings import AxesNotMet, NoOffsets
from selfcal_ros.model.readings import Sense
from selfcal_ros.model.terms import ModelTerm, parse_terms
from selfcal_ros.model.verdict import Grade
from selfcal_ros.reporting.words.findings import worded
from selfcal_ros.simulation.cell import CellSettings
from selfcal_ros.simulation.machine import Spread, random_truth
from test.support.options import BARE
from test.support.truth import hu_plan, simulate_measurements

ARCSEC_RAD = np.pi / 648_000


@pytest.fixture(scope="module")
def readings():
    plan, rng = hu_plan(Artifact(5, 0.01, 8), repeats=2), np.random.default_rng(2)
    return simulate_measurements(
        random_truth(plan.artifact, 4, rng),
        plan,
        rng,
        sigma_m=2e-8,
        sigma_theta_rad=2e-6,
        linear=True,
    )


@pytest.mark.parametrize(
    ("p", "holds"),
    [(0.04, False), (0.0499, False), (0.05, True), (0.06, True), (0.9, True)],
)
def test_the_axis_conditions_are_tested_at_5_percent(readings, p, holds):
    options = Options(misalignment_model="linear", causes=False)
    solved = replace(solve_joint(readings, options), axes=(p, 3 * ARCSEC_RAD))
    verdict = judged(solved, readings, options).result.verdict
    assert verdict.grade is (Grade.GOOD if holds else Grade.NOT_QUALIFIED)
    assert verdict.failed == (
        () if holds else (AxesNotMet(size=3 * ARCSEC_RAD, unit="rad", p=p),)
    )


def test_axis_conditions_that_nobody_asked_for_hold(readings):
    linear = Options(misalignment_model="linear")
    assert solve_joint(readings, linear).axes == (1.0, 0.0)


@pytest.mark.parametrize("terms", [(), (ModelTerm("plate_scale", 1e-9),)])
def test_axes_that_the_stage_does_not_keep_are_found_without_an_uncertainty_map(
    readings, terms
):
    """The rotary encoder owes nothing to the axes: its map in their datum is wrong."""
    options = Options(
        misalignment_model="linear", datum_theta=ThetaDatum.XY_AXES, terms=terms
    )
    wanted, plain = (
        calibrate(readings, replace(options, uncertainty=uncertainty))
        for uncertainty in (None, False)
    )
    assert wanted.verdict.failed == plain.verdict.failed
    (found,) = plain.verdict.failed
    assert found.name == "axes_not_met" and found.size > 30 * ARCSEC_RAD
    assert plain.verdict.grade is wanted.verdict.grade is Grade.NOT_QUALIFIED
    for name in ("u_gx", "u_gy", "u_g_theta"):
        assert np.isnan(getattr(plain.error_map, name)).all()
    assert plain.kept.factors is None


@pytest.mark.parametrize(
    ("side", "asked", "failed", "wanted"),
    [
        (41, None, False, True),
        (43, None, False, False),
        (43, None, True, True),
        (43, True, False, True),
        (201, True, False, True),
        (201, None, True, True),
        (203, True, True, False),
        (41, False, True, False),
        (1, False, False, False),
    ],
)
def test_causes_are_looked_for_unasked_up_to_41_and_at_all_up_to_201_marks_a_side(
    side, asked, failed, wanted
):
    assert is_searched(side**2, Options(causes=asked), failed=failed) is wanted
    if side > 1:  # and no other number of sites lies between
        beyond = is_searched(side**2 + 1, Options(causes=asked), failed=failed)
        assert beyond is (
            wanted
            and (side, asked, failed)
            not in ((41, None, False), (201, True, False), (201, None, True))
        )


@pytest.mark.parametrize(
    ("sites", "noise_m", "wanted"),
    [(25, None, True), (24, None, False), (25, 0.0, False), (24, 0.0, False)],
)
def test_a_search_needs_a_field_that_is_not_large_and_noise(
    readings, monkeypatch, sites, noise_m, wanted
):
    searched = []
    monkeypatch.setattr(search, "ALWAYS_SITES", sites)
    monkeypatch.setattr(
        search.Search, "add_shown", lambda _, *, failed: searched.append(failed)
    )
    options = Options(misalignment_model="linear")
    solved = solve_joint(readings, options)
    if noise_m is not None:
        solved = replace(solved, xy=replace(solved.xy, sigma=noise_m))
    search_causes(solved, readings, options, failed=False)
    assert searched == [False] * wanted


def test_a_size_that_is_contradicted_has_causes_sought_in_a_large_field(
    readings, monkeypatch
):
    searched = []
    monkeypatch.setattr(search, "ALWAYS_SITES", 24)
    monkeypatch.setattr(
        search.Search, "add_shown", lambda _, *, failed: searched.append(failed)
    )
    options = Options(terms=parse_terms(["plate_scale:1e-3"], ""))
    solved = solve_joint(readings, options)
    assert [test.name for test in solved.model.sizes if test.contradicted] == []
    search_causes(solved, readings, options, failed=False)
    assert searched == []
    sizes = tuple(replace(test, p=0.0) for test in solved.model.sizes)
    contradicted = replace(solved, model=replace(solved.model, sizes=sizes))
    search_causes(contradicted, readings, options, failed=False)
    assert searched == [True]


REVERSED = Turned(-np.eye(2), -1, "all signs are opposite")


def offsets_of(
    stop_sigma_m,
    servo_sigma_theta_rad,
    phi_rad=1e-7,
    repeats=5,
    sense=Sense.MICROSCOPE_MOVES,
    seed=3,
    **how,
):
    """Return readings whose offsets have so much scatter, of plates that lie nearly straight."""
    plan, rng = hu_plan(Artifact(7, 0.01, 24), repeats), np.random.default_rng(seed)
    spread = Spread(encoder="independent", rotation="finite", phi_rad=phi_rad)
    settings = CellSettings(
        sense,
        sigma_xy_m=20e-9,
        sigma_theta_rad=2e-5,
        servo_sigma_m=0.0,
        servo_sigma_theta_rad=servo_sigma_theta_rad,
        stop_sigma_m=stop_sigma_m,
        **how,
    )
    return simulate_measurements(
        random_truth(plan.artifact, 4, rng, spread),
        plan,
        rng,
        settings=settings,
        visits=True,
    )


@pytest.mark.parametrize(
    ("scatter", "how", "asked"),
    [
        ((0.0, 0.0), {}, ["sign_not_shown", "lines_sign_not_shown"]),
        ((20e-6, 0.0), {}, ["lines_sign_not_shown"]),
        ((0.0, 1e-4), {}, ["sign_not_shown"]),
        ((20e-6, 1e-4), {}, []),
        ((0.0, 0.0), {"terms": parse_terms(["microscope:1e-2"], "")}, []),
        ((0.0, 0.0), {"assumed": ()}, []),
    ],
)
def test_the_sign_of_offsets_is_shown_by_their_scatter_or_declared(scatter, how, asked):
    verdict = calibrate(offsets_of(*scatter), Options(**how)).verdict
    assert [found.name for found in verdict.failed] == asked
    assert verdict.grade is (Grade.NOT_QUALIFIED if asked else Grade.GOOD)


def visited(readings, change):
    """Return the readings with each view that has visits changed."""
    views = (
        view if view.visits is None else change(view, view.visits)
        for view in readings.views
    )
    return replace(readings, views=tuple(views))


def centred(readings, rng, *, within_m=0.0):
    """Return the readings of a stage that is driven until each mark is centred to `within_m`."""

    def change(view, visits):
        x, y = rng.normal(0, within_m, (2, len(visits.mark)))
        motion = replace(view.motion, products=np.diag([1.0, 1.0, 0.0, 0.0]) * 4e-14)
        visits = replace(visits, offset_x=x, offset_y=y)
        return replace(view, visits=visits, motion=motion)

    return visited(readings, change)


@pytest.mark.parametrize("within_m", [0.0, 2e-9])
def test_repeats_of_centred_marks_show_their_noise(within_m):
    """It was 1.5 times as large: as a column, the noise taken off offsets of 0 was the noise."""
    readings = centred(
        offsets_of(0.0, 1e-4), np.random.default_rng(5), within_m=within_m
    )
    options = Options(terms=parse_terms(["microscope:1e-2"], ""))
    result = calibrate(readings, options)
    assert result.verdict.grade is Grade.GOOD
    ratio = result.noise.sigma_xy_repeats / repeats_of(readings)[0][0]
    assert ratio == pytest.approx(1, abs=0.05)


def test_offsets_that_are_all_0_are_declared_or_not_qualified(monkeypatch):
    """A detector that is dead gives them as well. No other wiring is looked for."""
    monkeypatch.setattr(api, "_check_turned", None)
    readings = centred(offsets_of(0.0, 1e-4), np.random.default_rng(5))
    assert calibrate(readings).verdict.failed == (NoOffsets(),)


def repeated_to_the_bit(readings):
    """Return the readings of a detector that answers a second visit with its first answer."""

    def change(view, visits):
        first = np.searchsorted(visits.mark, np.arange(len(view.m)))
        same = {
            name: getattr(visits, name)[first[visits.mark]]
            for name in ("dx", "dy", "offset_x", "offset_y")
        }
        return replace(
            view,
            dx=visits.dx[first],
            dy=visits.dy[first],
            sigma_xy=0.0,
            motion=replace(view.motion, products=np.zeros((4, 4))),
            visits=replace(visits, **same),
        )

    return visited(readings, change)


@pytest.mark.parametrize("seed", range(3))
def test_identical_repeats_show_no_sign(seed):
    """Their noise is not known from them, and must not pass for offsets that the stage made."""
    readings = repeated_to_the_bit(offsets_of(0.0, 1e-4, repeats=2, seed=seed))
    for one in (readings, turned_readings(readings, Turned(-np.eye(2), 1, "opposite"))):
        assert "sign_not_shown" in [
            failed.name for failed in calibrate(one, Options()).verdict.failed
        ]


@pytest.mark.parametrize(
    ("scatter", "repeats", "by_lines"),
    [
        ((0.0, 0.0), 5, True),
        ((20e-6, 0.0), 5, False),
        ((0.0, 1e-4), 5, False),
        ((10e-9, 0.0), 1, False),
    ],
)
@pytest.mark.parametrize("sense", Sense)
def test_lines_alone_show_the_sign_of_offsets_only_if_theirs_is_right(
    scatter, repeats, by_lines, sense
):
    """Marks and lines turn alike with both signs opposite: nothing contradicts that.

    A stage that stands beside its targets contradicts it, in one visit of each mark as well.
    """
    readings = offsets_of(*scatter, phi_rad=1e-3, repeats=repeats, sense=sense)
    asked = ["sign_shown_by_lines"] * by_lines
    assert [
        found.name for found in calibrate(readings, Options()).verdict.failed
    ] == asked
    declared = calibrate(readings, Options(terms=parse_terms(["microscope:1e-2"], "")))
    assert declared.verdict.grade is Grade.GOOD
    reversed_all = turned_readings(readings, REVERSED)
    if by_lines or repeats == 1:
        assert not calibrate(reversed_all, Options()).verdict.qualified
    else:
        with pytest.raises(WiringError, match="offsets of the other sign"):
            calibrate(reversed_all, Options())


@pytest.mark.parametrize("moves_m", [0.0, 5e-9])
def test_noise_of_the_encoders_shows_no_sign(moves_m):
    """It is as large with either sign of the offsets: both fit alike, by chance one better."""
    for seed in range(4):
        readings = offsets_of(
            moves_m, 0.0, phi_rad=1e-3, repeats=1, seed=seed, encoder_sigma_m=50e-9
        )
        for one in (readings, turned_readings(readings, REVERSED)):
            (failed,) = calibrate(one, Options()).verdict.failed
            assert failed.name in ("sign_shown_by_lines", "sign_not_shown")


@pytest.mark.parametrize("sense", Sense)
@pytest.mark.parametrize(("turn_rad", "asked"), [(1e-7, True), (2e-5, False)])
def test_the_sign_of_lines_is_shown_by_the_turns_of_the_plate(turn_rad, asked, sense):
    """With the wrong sign the angular map is that of another stage: refused, or nobody knows."""
    plan, rng = hu_plan(Artifact(7, 0.01, 24), 5), np.random.default_rng(3)
    truth = random_truth(
        plan.artifact, 4, rng, Spread(rotation="finite", phi_rad=turn_rad)
    )
    readings = simulate_measurements(
        truth,
        plan,
        rng,
        visits=True,
        settings=CellSettings(
            sense,
            sigma_xy_m=20e-9,
            sigma_theta_rad=2e-5,
            servo_sigma_theta_rad=0.0,
            stop_sigma_m=20e-6,
        ),
    )
    reversed_lines = replace(
        readings,
        views=tuple(replace(view, dtheta=-view.dtheta) for view in readings.views),
    )
    names = [found.name for found in calibrate(readings, Options()).verdict.failed]
    assert ("lines_sign_not_shown" in names) is asked
    if asked:
        assert not calibrate(reversed_lines, Options()).verdict.qualified
    else:
        with pytest.raises(WiringError, match="offset_theta has the other sign"):
            calibrate(reversed_lines, Options())


@pytest.mark.parametrize(
    ("given", "is_declared"), [("plate_shape:0", True), ("plate_scale:0", False)]
)
def test_a_term_declared_to_be_zero_that_the_readings_show_is_named_so(
    given, is_declared
):
    rng, plan = np.random.default_rng(5), hu_plan(Artifact(7, 0.01), repeats=2)
    bent = replace(
        random_truth(plan.artifact, len(plan.views), rng),
        plate_shape_m=rng.normal(0, 2e-7, (len(plan.views), 2, 3)),
    )
    result = worded(
        calibrate(
            simulate_measurements(bent, plan, rng, sigma_m=5e-9),
            Options(terms=parse_terms([given], "")),
        )
    )
    [cause] = result.verdict.causes
    assert cause.name == "plate_shape" and (cause.details.declared == 0) is is_declared
    assert ("declared to be exactly zero" in result.verdict.sentence) is is_declared


@pytest.mark.parametrize(
    ("pixels", "how", "wanted"),
    [
        (1.0, {}, False),
        (1.3, {}, True),
        (0.77, {}, True),
        (1.3, {"terms": parse_terms(["microscope:0.3:0.01:0.002"], "")}, False),
    ],
)
def test_repeats_disqualify_a_scale_of_the_microscope_that_no_fit_corrects(
    pixels, how, wanted
):
    """Stops that scatter by five times the noise are too small for the fit."""
    plan, rng = hu_plan(Artifact(7, 0.01, 0), 4), np.random.default_rng(5)
    settings = CellSettings(sigma_xy_m=20e-9, servo_sigma_m=100e-9)
    spread = Spread(rotation="finite", phi_rad=1e-4, microscope_pixels=pixels)
    readings = simulate_measurements(
        random_truth(plan.artifact, 4, rng, spread),
        plan,
        rng,
        settings=settings,
        visits=True,
    )
    verdict = worded(calibrate(readings, Options(**how))).verdict
    assert [f.name for f in verdict.failed] == ["scale_of_offsets"] * wanted
    if wanted:
        (found,) = verdict.failed
        assert found.size == pytest.approx(pixels, abs=0.08) and found.unit == "m/m"
        assert (found.size > 1) == (pixels > 1) and found.size < found.most
        assert f"{found.size:.3f} ± {found.u:.3f} to" in verdict.sentence
        assert (
            "the scale is taken as 1 ± 0.01: correct the pixel size" in verdict.sentence
        )
        assert verdict.grade is Grade.NOT_QUALIFIED


def test_the_origin_is_from_the_first_exposure_to_the_last():
    plan, rng = hu_plan(Artifact(5, 0.01), repeats=2), np.random.default_rng(2)
    readings = simulate_measurements(
        random_truth(plan.artifact, 4, rng), plan, rng, visits=True
    )
    one = replace(readings, views=readings.views[1:2])
    stamps = one.views[0].visits.stamp_ns
    found = provenance_of(one, BARE)
    span_s = (int(stamps.max()) - int(stamps.min())) * 1e-9
    assert found.duration_s == pytest.approx(span_s) and span_s > 0
    begin, end = (
        datetime.fromisoformat(time).timestamp()
        for time in (found.first_exposure, found.last_exposure)
    )
    assert begin == pytest.approx(int(stamps.min()) * 1e-9, abs=1e-3)
    assert end - begin == pytest.approx(span_s, abs=2e-3)


@pytest.mark.parametrize("seed", range(2))
def test_a_microscope_of_an_implausible_scale_does_not_pass_for_a_turn_of_the_lines(
    seed,
):
    """Lines turn against marks in each view by as much as the plate: its scale is 20 % wrong."""
    rng, plan = np.random.default_rng(seed), hu_plan(Artifact(7, 0.01, 24), repeats=5)
    how = CellSettings(
        sigma_xy_m=20e-9,
        sigma_theta_rad=np.deg2rad(0.001),
        servo_sigma_m=20e-9,
        servo_sigma_theta_rad=1e-7,
    )
    spread = Spread(phi_rad=np.deg2rad(0.01), t_m=5e-6, microscope_scale=0.2)
    truth = random_truth(plan.artifact, 4, rng, spread)
    verdict = calibrate(
        simulate_measurements(truth, plan, rng, settings=how, visits=True)
    ).verdict
    assert verdict.grade is Grade.NOT_QUALIFIED
    assert "microscope" in [cause.name for cause in verdict.causes]
