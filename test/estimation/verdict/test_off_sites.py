# SPDX-License-Identifier: Apache-2.0
"""A stage that stood off the sites of the marks: its error there is taken, or told."""

from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.applications.papers.methods import calibrate_by
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.joint import model_fit
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.findings import NotConverged, SignNotShown
from selfcal_ros.model.readings import GridVisits, Measurements, Sense, ViewReadings
from selfcal_ros.model.terms import parse_terms
from selfcal_ros.model.verdict import Grade
from selfcal_ros.model.view import View
from selfcal_ros.reporting.words.findings import worded
from selfcal_ros.simulation.cell import CellSettings
from selfcal_ros.simulation.machine import Spread, random_truth
from test.support.options import BARE, bare, reference_length
from test.support.results import trusted
from test.support.truth import hu_plan, simulate_measurements

N, PITCH_M, SIGMA_M = 7, 0.01, 1e-8
HALF_M = (N - 1) // 2 * PITCH_M
BESIDE_M = np.array([1.5e-3, -0.8e-3])
"""Where every view lies beside its place."""
VIEWS = ((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, -1, 0))
STEPS = np.arange(N) - (N - 1) // 2


def stage_error(x, y, bend_m=5e-7, rough_m=0.0):
    """Indicated minus true position where the stage is, m: bent, and waves of 2.7 pitches."""
    (u, v), (p, q) = (
        np.array([x, y]) / HALF_M,
        np.array([x, y]) / PITCH_M * 2 * np.pi / 2.7,
    )
    return bend_m * np.array([u**2 + 0.5 * u * v, v**2 - u * v]) + rough_m * np.array(
        [np.cos(p) * np.cos(q + 0.3), np.sin(p + q)]
    )


def readings(
    *,
    follow,
    sense=Sense.MICROSCOPE_MOVES,
    beside=BESIDE_M,
    seed=1,
    visits=True,
    sigma_m=SIGMA_M,
    indicated=False,
    **stage,
):
    """Return what a stage reads that goes to the marks as they lie, or to their sites.

    Truly, or as it indicates itself.
    """
    rng, views = np.random.default_rng(seed), []
    sign = -1 if sense is Sense.PLATE_MOVES else 1
    m, n = (array.ravel() for array in np.meshgrid(STEPS, STEPS, indexing="ij"))
    for quarter, a, b in VIEWS:
        turned = np.array([(m, n), (-n, m)][quarter]) + np.array([[a], [b]])
        here = (abs(turned) <= (N - 1) // 2).all(axis=0)
        site = turned[:, here] * PITCH_M
        # a plate without errors, laid down beside its place, each time a micrometre farther
        mark = site + beside[:, None] + 1e-6 * len(views)
        true = target = sign * (mark if follow else site)
        for _ in range(20 * indicated):
            true = target - stage_error(*true, **stage)
        indication = true + stage_error(*true, **stage)
        seen = mark - sign * true + rng.normal(0, sigma_m, mark.shape)
        dx, dy = sign * indication + seen - site
        count = np.ones(here.sum(), dtype=int)
        at = GridVisits(
            np.arange(here.sum()),
            dx,
            dy,
            count,
            np.arange(here.sum()) * 10**9,
            *seen,
            0 * count.astype("i1"),
            0 * count.astype("i1"),
        )
        view = View(
            f"{quarter} {a} {b}", quarter * np.pi / 2, (a * PITCH_M, b * PITCH_M)
        )
        views.append(
            ViewReadings(
                view, m[here], n[here], dx, dy, count, visits=at if visits else None
            )
        )
    return Measurements("beside", Artifact(N, PITCH_M, 0), tuple(views), sense)


def without_datum(field):
    """Return a field (2, N, N) without translation, rotation and magnification, flat."""
    x, y = (
        array.ravel() * PITCH_M for array in np.meshgrid(STEPS, STEPS, indexing="ij")
    )
    one, none = np.ones_like(x), np.zeros_like(x)
    modes = np.array([[*one, *none], [*none, *one], [*-y, *x], [*x, *y]]).T
    flat = field.reshape(-1)
    return flat - modes @ np.linalg.lstsq(modes, flat, rcond=None)[0]


def error_of(result, **stage):
    x, y = np.meshgrid(STEPS * PITCH_M, STEPS * PITCH_M, indexing="ij")
    emap = result.error_map
    return without_datum(np.stack([emap.gx, emap.gy]) - stage_error(x, y, **stage))


def covered(result, **stage):
    u = np.stack([result.error_map.u_gx, result.error_map.u_gy]).ravel()
    return np.mean(abs(error_of(result, **stage)) <= result.noise.k_xy * u)


@pytest.mark.parametrize("misalignment", ["rigid", "linear"])
@pytest.mark.parametrize("sense", Sense)
def test_a_stage_that_follows_plates_beside_their_places_has_the_error_of_its_places(
    sense, misalignment
):
    whole = readings(follow=True, sense=sense)
    result = calibrate(whole, bare(misalignment_model=misalignment))
    at_sites = calibrate(whole, bare(misalignment_model=misalignment, at_places=False))
    # residuals of either are nothing but noise
    assert at_sites.noise.sigma_xy_residuals == pytest.approx(SIGMA_M, rel=0.15)
    assert result.verdict.grade is Grade.GOOD and covered(result) >= 0.85
    assert abs(error_of(at_sites)).max() > 6 * result.error_map.u_gx.max()
    assert [cause.name for cause in at_sites.verdict.causes] == ["off_sites"]


@pytest.mark.parametrize("sense", Sense)
def test_without_noise_it_has_them_but_for_the_origin_that_nothing_tells(sense):
    """The datum moves the stage by 0.2 um, over which its slope changes by 1e-10."""
    result = calibrate(readings(follow=True, sense=sense, sigma_m=0.0), BARE)
    assert abs(error_of(result)).max() < 1e-11
    other = (
        Sense.PLATE_MOVES if sense is Sense.MICROSCOPE_MOVES else Sense.MICROSCOPE_MOVES
    )
    wrong = calibrate(
        replace(readings(follow=True, sense=sense, sigma_m=0.0), sense=other), BARE
    )
    assert abs(error_of(wrong)).max() > 1e-8


@pytest.mark.parametrize("sense", Sense)
def test_a_stage_at_the_sites_of_such_plates_is_good(sense):
    result = calibrate(readings(follow=False, sense=sense), BARE)
    assert result.verdict.grade is Grade.GOOD
    assert abs(error_of(result)).max() < 4 * result.error_map.u_gx.max()


@pytest.mark.parametrize("sense", Sense)
def test_a_stage_that_is_rough_there_has_a_larger_u(sense):
    rough = {"rough_m": 1e-7}
    whole = readings(follow=True, sense=sense, beside=BESIDE_M / 3, **rough)
    result, plain = worded(calibrate(whole, BARE)), calibrate(whole, bare(causes=False))
    assert result.verdict.grade is Grade.ENLARGED
    assert [item.name for item in result.verdict.enlarged_by] == ["off_sites"]
    u = np.stack([result.error_map.u_gx, result.error_map.u_gy])
    more = u**2 - np.stack([plain.error_map.u_gx, plain.error_map.u_gy]) ** 2
    cause = result.verdict.causes[0]
    assert (cause.name, cause.unit) == ("off_sites", "m") and cause.p < 5e-4
    assert cause.effect_rms == pytest.approx(np.sqrt(more.mean()), rel=1e-6)
    assert (
        cause.effect_max == cause.size == pytest.approx(np.sqrt(more.max()), rel=1e-6)
    )
    assert covered(result, **rough) >= 0.85
    assert cause.text.startswith(
        "a stage that stood 0.567 mm off the sites, where its error "
    )
    assert "place the plate closer to its nominal pose" in cause.text


@pytest.mark.parametrize("sense", Sense)
def test_a_stage_that_is_exactly_at_the_sites_by_its_own_indication_is_told(sense):
    """Its error of 10 um moves it off them, where it differs by 20 nm."""
    steep = {"rough_m": 1e-5}
    whole = readings(
        follow=False, sense=sense, beside=0 * BESIDE_M, indicated=True, **steep
    )
    result = calibrate(whole, BARE)
    assert abs(error_of(result, **steep)).max() > 2e-8
    assert result.verdict.grade is not Grade.GOOD
    assert [cause.name for cause in result.verdict.causes] == ["off_sites"]


def test_how_far_off_the_sites_is_where_the_stage_truly_stood():
    """It stands on them, indicated 84 um beside them by its error; the datum leaves 3 um."""
    result = calibrate(readings(follow=False, beside=0 * BESIDE_M, rough_m=1e-4), BARE)
    (cause,) = (c for c in result.verdict.causes if c.name == "off_sites")
    assert cause.details.away < 5e-6


def test_a_stage_too_rough_for_it_is_not_qualified():
    verdict = calibrate(readings(follow=True, rough_m=1e-7), BARE).verdict
    assert verdict.grade is Grade.NOT_QUALIFIED
    assert [cause.name for cause in verdict.causes] == ["off_sites"]


def test_a_little_beside_is_no_matter():
    verdict = calibrate(
        readings(follow=True, beside=BESIDE_M / 100, rough_m=1e-7), BARE
    ).verdict
    assert verdict.grade is Grade.GOOD


def test_with_a_microscope_that_nobody_knows_the_sign_of_its_offsets_is_not_shown():
    """All views lie beside their places alike: a microscope of any scale shows the same."""
    verdict = calibrate(readings(follow=True, rough_m=1e-7)).verdict
    assert verdict.grade is Grade.NOT_QUALIFIED
    assert verdict.failed[0] == SignNotShown() and verdict.causes[0].name == "off_sites"


@pytest.mark.parametrize("at_places", [True, False])
@pytest.mark.parametrize("seed", range(3))
def test_noise_of_the_map_is_no_roughness_of_the_stage(seed, at_places):
    verdict = calibrate(
        readings(follow=True, seed=seed, beside=2 * BESIDE_M, bend_m=0.0),
        bare(at_places=at_places),
    ).verdict
    assert verdict.grade is Grade.GOOD


def test_without_noise_a_stage_at_the_sites_is_at_the_sites():
    assert not calibrate(readings(follow=False, sigma_m=0.0), BARE).verdict.causes


def test_what_spoils_the_map_comes_before_places_that_residuals_do_not_show():
    whole = readings(follow=True, rough_m=1e-7)
    off = whole.views[0].visits.dx + np.where(np.arange(N * N) == 10, 5e-7, 0.0)
    first = replace(
        whole.views[0], dx=off, visits=replace(whole.views[0].visits, dx=off)
    )
    causes = calibrate(
        replace(whole, views=(first, *whole.views[1:])), BARE
    ).verdict.causes
    assert [cause.name for cause in causes] == ["reading", "off_sites"]


def test_where_visits_are_not_known_or_causes_not_wanted_nothing_is_said():
    for verdict in (
        calibrate(readings(follow=True, visits=False), BARE).verdict,
        calibrate(readings(follow=True, rough_m=1e-7), bare(causes=False)).verdict,
    ):
        assert verdict.grade is Grade.GOOD and not verdict.causes


@pytest.mark.parametrize(
    "options",
    [
        bare(uncertainty=False),
        bare(misalignment_model="linear"),
        bare(terms=parse_terms(["plate_scale:1e-7"], "")),
        bare(reference=reference_length("marks", 0.0, 1e-7)),
    ],
)
def test_it_is_found_whatever_else_is_asked_for(options):
    found = trusted(readings(follow=True, rough_m=1e-7), options).verdict
    assert found.causes[0].name == "off_sites"
    assert (
        calibrate(readings(follow=False, rough_m=1e-7), options).verdict.grade
        is Grade.GOOD
    )


def test_places_that_do_not_converge_are_given_up_and_named(monkeypatch):
    monkeypatch.setattr(model_fit, "MAX_STEPS", 5)
    whole = readings(follow=True)
    result = calibrate(whole, BARE)
    at_sites = calibrate(whole, bare(at_places=False))
    np.testing.assert_array_equal(result.error_map.gx, at_sites.error_map.gx)
    assert result.verdict.grade is Grade.NOT_QUALIFIED
    assert result.verdict.failed == (NotConverged(),)
    assert result.verdict.causes[0].name == "off_sites"


def test_the_same_readings_tell_the_same_in_either_sense():
    """The map is mirrored, and its uncertainty with it; what the places do to it is the same."""
    whole = readings(follow=True, rough_m=1e-7)
    views = tuple(
        replace(view, count=np.where(view.m < 0, 1, 9)) for view in whole.views
    )
    one, two = (
        trusted(replace(whole, views=views, sense=sense), BARE) for sense in Sense
    )
    assert not np.allclose(
        one.error_map.u_gx, one.error_map.u_gx[::-1], rtol=0.1, atol=0
    )
    (first, *_), (second, *_) = one.verdict.causes, two.verdict.causes
    assert (first.name, first.size, first.u) == (
        second.name,
        pytest.approx(second.size),
        pytest.approx(second.u),
    )


def test_the_law_which_takes_the_sites_for_the_places_is_told_so():
    plan = hu_plan(Artifact(N, PITCH_M, 24), 4)
    rng = np.random.default_rng(2)
    truth = random_truth(
        plan.artifact,
        4,
        rng,
        Spread(t_m=1e-3, phi_rad=1e-5, correlation_pitches=4, rotation="linear"),
    )
    cell = CellSettings(
        sigma_xy_m=SIGMA_M,
        sigma_theta_rad=1e-6,
        servo_sigma_m=0.0,
        servo_sigma_theta_rad=0.0,
        follow_mark=True,
    )
    made = simulate_measurements(truth, plan, rng, settings=cell)
    law, joint = (calibrate_by(method, made, bare()) for method in ("law", "joint"))
    assert joint.verdict.qualified and not law.verdict.qualified
    assert "off_sites" in [cause.name for cause in law.verdict.causes]
