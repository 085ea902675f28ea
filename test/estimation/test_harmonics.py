# SPDX-License-Identifier: Apache-2.0
"""Angular maps as Fourier series: any turn of the plate, any number of lines."""

import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.applications.papers.methods import calibrate_by_law
from selfcal_ros.apply import StageMap
from selfcal_ros.compensation.circle import fourier_basis
from selfcal_ros.errors import InputError
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.comparison.maps import compare
from selfcal_ros.estimation.joint.problem import noise_estimate
from selfcal_ros.estimation.joint.solve import solve_joint
from selfcal_ros.estimation.lattice.readings import angular_data
from selfcal_ros.estimation.normal.angular import AngularSystem, HarmonicSystem
from selfcal_ros.estimation.observability.plan_check import check_plan, predict_plan
from selfcal_ros.estimation.observability.rank import best_turn_deg
from selfcal_ros.estimation.options import Options
from selfcal_ros.estimation.quality.validation import line_errors
from selfcal_ros.estimation.recheck.views import Effects, map_of_lines
from selfcal_ros.estimation.terms.columns import LineColumns
from selfcal_ros.estimation.verdict.roughness import _fitted_lines
from selfcal_ros.estimation.verdict.uncertainty import budget_lines
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.error_map import ThetaDatum
from selfcal_ros.model.findings import CauseDetails, HarmonicsUntested
from selfcal_ros.model.readings import Sense
from selfcal_ros.model.result import result_from_dict, result_to_dict
from selfcal_ros.model.verdict import Grade
from selfcal_ros.reporting.figures.drawing import Path
from selfcal_ros.reporting.figures.maps import CENTRE, angular_map
from selfcal_ros.reporting.words.findings import worded
from selfcal_ros.simulation.cell import CellSettings
from selfcal_ros.simulation.machine import Spread, random_truth
from selfcal_ros.simulation.physics import encoder_error
from test.support.options import BARE
from test.support.plans import harmonic_plan as plan
from test.support.refusals import in_words, refused
from test.support.truth import simulate_measurements

SIGMA_RAD = 1e-6


def measured(
    views,
    seed=1,
    *,
    sigma_rad=SIGMA_RAD,
    lines=4.0,
    sense=Sense.MICROSCOPE_MOVES,
    missing=0.0,
):
    """Return a truth with an encoder of the correlation length `lines`, and its readings."""
    rng = np.random.default_rng(seed)
    truth = random_truth(
        views.artifact,
        len(views.views),
        rng,
        Spread(phi_rad=1e-3, correlation_pitches=lines, g_theta_rad=5e-5),
    )
    return truth, simulate_measurements(
        truth,
        views,
        rng,
        sigma_m=20e-9 * bool(sigma_rad),
        sigma_theta_rad=sigma_rad,
        sense=sense,
        missing=missing,
    )


def error_of(result, truth):
    error = result.error_map.g_theta - truth.g_theta
    return error - error.mean()


@pytest.mark.parametrize(
    ("count", "harmonics", "gain"), [(24, 11, 0.8321), (36, 8, 0.4667), (7, 3, 0.6579)]
)
def test_the_predicted_uncertainty_is_that_of_dense_equations(count, harmonics, gain):
    found = predict_plan(plan(count, harmonics), ThetaDatum.ZERO_MEAN)
    assert found.rms_theta == pytest.approx(gain, abs=5e-5)


@pytest.mark.parametrize(
    ("turns", "text"),
    [
        (
            (120,),
            "angular map: harmonics 3, 6 and 9, as every turn between views is a whole number",
        ),
        ((120, 240), "angular map: harmonics 3, 6 and 9, as every turn"),
        (
            (72,),
            "angular map: harmonics 5 and 10, as every turn between views is a whole number",
        ),
        (
            (45.001,),
            "angular map: harmonic 8, as every turn between views is a whole number",
        ),
        (
            (),
            "angular map: harmonics 1, 2, 3, 4, 5, 6, 7, 8, 9, 10 and 11, as no view turns the",
        ),
    ],
)
def test_missed_harmonics_are_named(turns, text):
    views = plan(24, 11, turns)
    found = check_plan(views)
    assert not found.observability.identifiable
    named = next(
        mode for mode in in_words(found.observability.modes) if "harmonic" in mode
    )
    assert named.startswith(text)
    assert found.observability.deficiency == 2 * len(re.findall(r"\d+", text))
    advice = found.observability.advice[0]
    cured = replace(views, views=(*views.views, *advice.views))
    assert check_plan(cured).observability.identifiable
    with refused("turned by"):
        calibrate(measured(views)[1], BARE)


def test_the_advised_turn_is_the_best_one():
    of, lines = [math.radians(turn) for turn in (0, 120)], np.ones((3, 24))
    best = best_turn_deg(np.array(of), 11)

    def variance(turn_deg):
        system = HarmonicSystem((0, 8, turn_deg * 24 / 360), lines, 11)
        return np.inf if system.missed else system.mean_variance

    every = [variance(turn) for turn in range(1, 180)]
    assert variance(best) == pytest.approx(min(every), rel=1e-9)


@pytest.mark.parametrize("sense", Sense)
@pytest.mark.parametrize(
    ("count", "harmonics", "lines"),
    [(24, 8, 4.0), (7, 3, 2.5), (36, 17, 5.0), (10, 4, 3.0)],
)
def test_readings_without_noise_give_the_truth_on_lines_and_between(
    count, harmonics, lines, sense
):
    truth, readings = measured(
        plan(count, harmonics), sigma_rad=0.0, lines=lines, sense=sense
    )
    result = calibrate(readings, BARE)
    assert np.abs(error_of(result, truth)).max() < 1e-10
    assert result.artifact_map.a_theta == pytest.approx(
        truth.a_theta - truth.a_theta.mean() + result.artifact_map.a_theta.mean(),
        abs=1e-10,
    )
    angle = np.random.default_rng(0).uniform(-7, 7, 200)
    stage = StageMap(result)
    at, want = stage.error_theta(angle), encoder_error(truth, angle)
    want = want - encoder_error(truth, truth.artifact.theta_rad).mean()
    np.testing.assert_allclose(at, want, rtol=0, atol=1e-10)
    assert stage.correct_angle(float(angle[0])) == pytest.approx(
        float(stage.correct_theta(angle[0])), abs=1e-15
    )
    np.testing.assert_allclose(
        stage.command_theta(stage.correct_theta(angle)), angle, atol=1e-14
    )
    assert np.isnan(stage.error_theta(np.array([np.nan, np.inf]))).all()


@pytest.mark.parametrize("follow", [True, False])
@pytest.mark.parametrize("sense", Sense)
def test_the_axis_is_where_it_stood_not_where_it_was_to_stand(sense, follow):
    """Plates lie some degrees beside: the map is read there, or at the plan if the axis is."""
    views, rng = plan(24, 8), np.random.default_rng(4)
    truth = random_truth(
        views.artifact,
        len(views.views),
        rng,
        Spread(phi_rad=1e-3, correlation_pitches=3.0, g_theta_rad=5e-5),
    )
    beside = np.radians([0.0, 0.0, 0.0, 4.0, -3.0])  # those with lines alone
    truth = replace(truth, phi_rad=truth.phi_rad + beside)
    readings = simulate_measurements(
        truth,
        views,
        rng,
        settings=CellSettings(
            sense, servo_sigma_m=0.0, servo_sigma_theta_rad=0.0, follow_mark=follow
        ),
    )
    result = calibrate(readings, BARE)
    # the axis is taken where it stood for the mean line: lines scatter by some 2e-4 rad
    assert np.abs(error_of(result, truth)).max() < 3e-8
    lines = angular_data(readings)
    errors = line_errors(solve_joint(readings, BARE), lines)[lines.index.index(3)]
    assert np.abs(errors).max() < 1e-7
    nominal = replace(
        readings, views=tuple(replace(view, axis_theta=0.0) for view in readings.views)
    )
    if follow:
        assert np.abs(error_of(calibrate(nominal, BARE), truth)).max() > 1e-6


def test_the_solution_is_that_of_one_dense_least_squares():
    """Weights and lines differ from view to view; lines of the views share no rotation with marks.

    All unknowns together: coefficients, lines of the plate, rotations.
    """
    rng, count, harmonics = np.random.default_rng(3), 12, 4
    turns = (0.0, 37 * count / 360, 101 * count / 360)
    weight = rng.integers(0, 4, (3, count)).astype(float)
    y = rng.normal(0, 1, weight.shape)
    system = HarmonicSystem(turns, weight, harmonics)
    view, line = np.nonzero(weight)
    places = (line + np.array(turns)[view]) * 2 * np.pi / count
    h = np.arange(1, harmonics + 1)
    columns = np.hstack(
        [
            np.cos(np.outer(places, h)),
            np.sin(np.outer(places, h)),
            np.eye(count)[line],
            np.eye(3)[view],
        ]
    )
    root = np.sqrt(weight[view, line])
    cover = np.linalg.pinv(
        (columns * root[:, None]).T @ (columns * root[:, None]), rcond=1e-10
    )
    solved = cover @ columns.T @ (root**2 * y[view, line])
    lines = np.arange(count) * 2 * np.pi / count
    rows = np.hstack([np.cos(np.outer(lines, h)), np.sin(np.outer(lines, h))])
    free, d = system.reduced(y)
    phi = np.linalg.pinv(system.schur, rcond=1e-9) @ d
    field = free - system.response @ phi
    np.testing.assert_allclose(
        field - field.mean(), rows @ solved[: 2 * harmonics], atol=1e-10
    )
    spread = (
        system.solve(np.eye(count))
        + system.response @ np.linalg.pinv(system.schur, rcond=1e-9) @ system.response.T
    )
    centre = np.eye(count) - 1 / count
    np.testing.assert_allclose(
        centre @ spread @ centre,
        rows @ cover[: 2 * harmonics, : 2 * harmonics] @ rows.T,
        atol=1e-9,
    )
    rest = system.plate(y, field, phi)[1]
    np.testing.assert_allclose(
        rest[view, line], y[view, line] - columns @ solved, atol=1e-10
    )
    assert system.rank + np.linalg.matrix_rank(
        system.schur, tol=1e-8
    ) == np.linalg.matrix_rank(columns * root[:, None])


def test_rows_gather_adjoint_and_covariance_are_of_one_matrix():
    rng, turns = np.random.default_rng(5), (0.0, 2.4, 7.9)
    for system in (
        HarmonicSystem(turns, np.ones((3, 9)), 4),
        AngularSystem((0, 2, 7), np.ones((3, 9))),
    ):
        rows = np.stack([view @ np.eye(9) for view in system.rows])
        field, y, matrix = (
            rng.normal(size=9),
            rng.normal(size=(2, 3, 9)),
            rng.normal(size=(9, 9)),
        )
        np.testing.assert_allclose(system.gather(field), rows @ field, atol=1e-12)
        sums = np.einsum("vkl,cvk->lc", rows, y)
        np.testing.assert_allclose(system.adjoint(y)[0], sums, atol=1e-12)
        np.testing.assert_allclose(
            system.covariance(matrix, 1, 2),
            np.einsum("kl,lm,km->k", rows[1], matrix, rows[2]),
            atol=1e-12,
        )


@pytest.mark.parametrize("count", [7, 9])
def test_all_harmonics_of_an_odd_number_of_lines_are_the_lines_themselves(count):
    """On whole lines nothing differs from a value at each line."""
    turns = (360 / count, 3 * 360 / count)
    series = plan(count, (count - 1) // 2, turns)
    each = plan(count, 0, turns)
    _, readings = measured(each)
    one = calibrate(readings, Options())
    other = calibrate(replace(readings, artifact=series.artifact), Options())
    for name in ("g_theta", "u_g_theta", "gx", "u_gx"):
        np.testing.assert_allclose(
            getattr(other.error_map, name),
            getattr(one.error_map, name),
            rtol=1e-9,
            atol=1e-16,
        )
    for name in ("a_theta", "u_a_theta"):
        np.testing.assert_allclose(
            getattr(other.artifact_map, name),
            getattr(one.artifact_map, name),
            rtol=1e-9,
            atol=1e-16,
        )
    assert other.noise.sigma_theta == pytest.approx(one.noise.sigma_theta, rel=1e-9)
    assert other.noise.dof_theta == pytest.approx(one.noise.dof_theta, rel=1e-9)
    assert other.verdict.grade == one.verdict.grade


@pytest.mark.parametrize("missing", [0.0, 0.15])
def test_u_is_that_of_the_errors(missing):
    """40 measurements: mean square of errors over u, share in U.

    By noise alone the first is 1 with a standard deviation of 0.07; of 120 measurements it was
    1.02 and 1.06, and 0.85 with the lack of fit, which is never negative, in u.
    """
    ratios, inside = [], []
    for seed in range(40):
        truth, readings = measured(plan(24, 5), seed, missing=missing, lines=6.0)
        result = calibrate(readings, BARE)
        error, u = error_of(result, truth), result.error_map.u_g_theta
        ratios.append((error**2).mean() / (u**2).mean())
        inside.append((np.abs(error) < result.noise.k_theta * u).mean())
        assert result.verdict.qualified
    assert 0.63 < np.mean(ratios) < 1.1
    assert 0.92 < np.mean(inside) < 0.985


def test_an_encoder_rougher_than_its_harmonics_is_named_and_covered():
    found, inside = [], []
    for seed in range(12):
        truth, readings = measured(plan(24, 4), seed, lines=2.2)
        result = calibrate(readings, BARE)
        found += [cause for cause in result.verdict.causes if cause.name == "roughness"]
        inside.append(
            (
                np.abs(error_of(result, truth))
                < result.noise.k_theta * result.error_map.u_g_theta
            ).mean()
        )
        assert result.verdict.grade is Grade.ENLARGED
    assert len(found) == 12 and np.mean(inside) > 0.9
    cause = found[-1]
    assert (cause.unit, cause.details) == ("rad", CauseDetails(harmonics=4))
    assert (
        "a rotary encoder rougher than the 4 harmonics of its map can follow, by"
        in json.dumps(result_to_dict(worded(result)), ensure_ascii=False)
    )
    enough = [
        calibrate(measured(plan(24, 6), seed, lines=5.0)[1], BARE) for seed in range(12)
    ]
    assert not [cause for one in enough for cause in one.verdict.causes]


@pytest.mark.parametrize(
    ("count", "harmonics", "turns_deg", "said"),
    [
        (7, 3, (37,), True),
        (24, 8, (37,), True),
        (24, 4, (37,), False),
        (7, 3, (37, 101), False),
        (24, 11, (37, 101), False),
    ],
)
def test_a_series_that_two_views_cannot_contradict_says_so(
    count, harmonics, turns_deg, said
):
    _, readings = measured(plan(count, harmonics, turns_deg))
    result = calibrate(readings, BARE)
    assert (HarmonicsUntested() in result.verdict.failed) is said
    assert (result.verdict.grade is Grade.NOT_QUALIFIED) is said
    text = "whether the harmonics of the angular map suffice for the rotary encoder"
    assert (text in json.dumps(result_to_dict(worded(result)))) is said


def test_a_result_keeps_its_harmonics_and_is_compared_with_its_covariance():
    views = plan(24, 5)
    truth, readings = measured(views, 1, lines=6.0)
    rng = np.random.default_rng(8)
    again = simulate_measurements(
        truth, views, rng, sigma_m=20e-9, sigma_theta_rad=SIGMA_RAD
    )
    one, other = (
        result_from_dict(result_to_dict(worded(calibrate(part, BARE))), "f")
        for part in (readings, again)
    )
    assert one.plate.harmonics == one.error_map.artifact.harmonics == 5
    found = compare(one, other)
    assert found.theta.correlated and found.theta.dof == 10
    assert not found.theta.significant
    changed = replace(
        other.error_map,
        g_theta=other.error_map.g_theta
        + 10 * SIGMA_RAD * np.cos(2 * truth.artifact.theta_rad),
    )
    assert compare(one, replace(other, error_map=changed)).theta.significant


def test_readings_held_out_are_predicted_between_the_lines():
    readings = measured(plan(24, 8), sigma_rad=0.0)[1]
    errors = line_errors(solve_joint(readings, BARE), angular_data(readings))
    assert errors.shape == (3, 24)
    for theta in errors:
        assert np.abs(theta - theta.mean()).max() < 1e-10


@pytest.mark.parametrize(
    ("count", "harmonics", "message"),
    [
        (
            24,
            12,
            "map harmonics: 12 harmonics cannot be told with 24 lines; give 1 to 11",
        ),
        (
            24,
            -1,
            "map harmonics: -1 harmonics cannot be told with 24 lines; give 1 to 11",
        ),
        (
            0,
            3,
            "map harmonics: 3 harmonics cannot be told with 0 lines; leave them out for a plate",
        ),
        (7, 4, "map harmonics: 4 harmonics cannot be told with 7 lines; give 1 to 3"),
    ],
)
def test_harmonics_that_lines_cannot_tell_are_refused(count, harmonics, message):
    with pytest.raises(InputError) as caught:
        Artifact(5, 0.01, count, harmonics=harmonics)
    assert str(caught.value).startswith(message)


def test_the_axes_fix_the_constant_of_a_series_too():
    views = plan(24, 8)
    readings = measured(views)[1]
    result = calibrate(readings, replace(BARE, datum_theta=ThetaDatum.XY_AXES))
    at_lines = replace(
        result,
        error_map=replace(
            result.error_map, artifact=replace(views.artifact, harmonics=0)
        ),
    )
    # known between the lines, or not
    for one, positive in ((result, False), (at_lines, True)):
        between = next(
            line
            for line in budget_lines(one)
            if line.component == "interpolation" and line.quantity == "theta"
        )
        assert (between.effect_rms > 0) is positive
    series = fourier_basis(views.artifact.theta_rad, 8)
    rest = (
        result.error_map.g_theta
        - series @ np.linalg.lstsq(series, result.error_map.g_theta, rcond=None)[0]
    )
    assert np.abs(rest).max() < 1e-15
    with pytest.raises(InputError, match="Hu's law needs"):
        calibrate_by_law(readings, Options())


def test_a_recheck_of_a_known_plate_finds_the_series():
    """One view of the known lines: without noise the truth, with a change of it that change."""
    turns, harmonics, count = (3.3,), 3, 9
    rng, weight = np.random.default_rng(2), np.ones((1, count))
    weight[0, 4] = 0
    of = rng.normal(size=2 * harmonics + 1) * [0, *[1] * 6]
    line = np.flatnonzero(weight[0])
    y = np.zeros((1, count))
    y[0, line] = fourier_basis((line + 3.3) * math.tau / count, harmonics) @ of + 0.7
    plate = np.eye(count)[:, None]

    def found(weight):
        effects = Effects.of(
            np.ones(count),
            np.arange(count),
            plate=np.zeros(count),
            before=np.zeros((2 * count, 2 * count)),
            length=np.zeros(count),
        )
        noise = noise_estimate((1.0, 99), (math.nan, 0), math.nan)
        return map_of_lines(
            HarmonicSystem(turns, weight, harmonics, known_plate=True),
            y,
            LineColumns(np.arange(count), plate),
            effects,
            sense="microscope_moves",
            noise=noise,
        )

    lines = np.arange(count) * math.tau / count
    np.testing.assert_allclose(
        found(weight).values, fourier_basis(lines, harmonics) @ of, atol=1e-12
    )
    weight[0, :4] = 0  # 4 lines for 7 numbers
    assert not found(weight).known.any()


def test_the_picture_follows_the_series_between_the_lines():
    result = calibrate(measured(plan(7, 3), sigma_rad=0.0, lines=2.5)[1], BARE)
    measured_curve = max(
        (
            item
            for item in angular_map(result).items
            if isinstance(item, Path) and item.stroke == "ink"
        ),
        key=lambda item: len(item.lines),
    )
    angle = math.tau / 720
    (x, y), _ = measured_curve.lines[100]
    assert math.atan2(CENTRE[1] - y, x - CENTRE[0]) == pytest.approx(100 * angle)
    radius = [
        math.hypot(x - CENTRE[0], y - CENTRE[1]) for (x, y), _ in measured_curve.lines
    ]
    error = StageMap(result).error_theta(np.arange(720) * angle)
    np.testing.assert_allclose(
        radius, np.polyval(np.polyfit(error, radius, 1), error), atol=1e-6
    )


def test_the_mean_variance_is_that_of_maps_of_noise():
    lines = HarmonicSystem((0.0, 8.0, 5.0), np.ones((3, 24)), 4)
    rng = np.random.default_rng(1)
    maps = [_fitted_lines(lines, rng.standard_normal((3, 24)))[1] for _ in range(1000)]
    assert np.mean(np.square(maps)) == pytest.approx(lines.mean_variance, rel=0.05)
