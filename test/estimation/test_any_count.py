# SPDX-License-Identifier: Apache-2.0
"""Circles of any number of lines: none need lie on the y axis, nor be read in turned views."""

import math
from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.applications.papers.methods import calibrate_by_law
from selfcal_ros.errors import InputError
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.observability.plan_check import check_plan, predict_plan
from selfcal_ros.estimation.observability.suggest import rank_next
from selfcal_ros.estimation.options import Options
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.error_map import ThetaDatum
from selfcal_ros.model.plan_form import plan_from_dict, plan_to_dict
from selfcal_ros.model.readings import Sense
from selfcal_ros.model.view import Plan, View
from test.support.options import BARE, bare
from test.support.refusals import refused
from test.support.truth import Spread, random_truth, simulate_measurements

SIGMA_RAD = 2e-5


def plan(count, lines=1):
    pitch = 0.01
    return Plan(
        "any",
        Artifact(5, pitch, count),
        (
            View("first", repeats=3),
            View("quarter", math.pi / 2, angular=not count % 4, repeats=3),
            View("shift", 0.0, (pitch, 0.0), repeats=3),
            View("lines", lines * math.tau / count, grid=False, repeats=3),
        ),
    )


def measured(count, seed=1, sigma_rad=SIGMA_RAD, lines=1, sense=Sense.MICROSCOPE_MOVES):
    rng, views = np.random.default_rng(seed), plan(count, lines)
    truth = random_truth(views.artifact, 4, rng, Spread(phi_rad=1e-3))
    return truth, simulate_measurements(
        truth,
        views,
        rng,
        sigma_m=20e-9 * bool(sigma_rad),
        sigma_theta_rad=sigma_rad,
        sense=sense,
    )


def error_of(result, truth):
    error = result.error_map.g_theta - truth.g_theta
    return error - error.mean()


@pytest.mark.parametrize("sense", Sense)
@pytest.mark.parametrize("count", [3, 7, 10, 30, 90])
def test_readings_without_noise_give_the_truth(count, sense):
    truth, readings = measured(count, sigma_rad=0.0, sense=sense)
    result = calibrate(readings, BARE)
    assert np.abs(error_of(result, truth)).max() < 1e-12
    assert result.artifact_map.a_theta == pytest.approx(
        truth.a_theta - truth.a_theta.mean() + result.artifact_map.a_theta.mean(),
        abs=1e-12,
    )


@pytest.mark.parametrize("count", [7, 10])
def test_u_is_that_of_the_errors(count):
    """30 measurements: chi^2 of the errors over u within its 0.1 % limits."""
    z = []
    for seed in range(30):
        truth, readings = measured(count, seed)
        result = calibrate(readings, BARE)
        z.append(error_of(result, truth) / result.error_map.u_g_theta)
    assert 0.8 < np.sqrt(np.mean(np.square(z))) < 1.2
    predicted = predict_plan(plan(count), ThetaDatum.ZERO_MEAN).rms_theta
    assert result.error_map.u_g_theta.mean() == pytest.approx(
        predicted * SIGMA_RAD / math.sqrt(3), rel=0.3
    )


def test_lines_with_a_common_divisor_hide_harmonics():
    with refused("turned by 1 line"):
        calibrate(measured(9, lines=3)[1], BARE)
    seen = check_plan(plan(9, lines=3)).observability
    assert not seen.identifiable and seen.deficiency == 2
    assert check_plan(plan(9, lines=2)).observability.identifiable


def test_views_off_the_lines_measure_the_grid_alone():
    found = plan_from_dict(plan_to_dict(plan(10)), "plan")
    assert [view.angular for view in found.views] == [True, False, True, True]
    artifact = found.artifact
    assert found.views[1].lattice_pose(artifact).turn_lines is None
    assert (
        found.views[1].lattice_pose(replace(artifact, angular_count=12)).turn_lines == 3
    )
    with pytest.raises(InputError, match=r"2\.5 is not a whole number of angular line"):
        replace(found.views[1], angular=True).lattice_pose(artifact)
    _, ranked = rank_next(found)
    turned = [
        item.view
        for item in ranked
        if item.view
        and item.view.grid
        and round(math.degrees(item.view.rotation_rad)) % 180
    ]
    assert turned and not any(view.angular for view in turned)


def test_what_needs_lines_on_both_axes_is_refused():
    _, readings = measured(10)
    with pytest.raises(
        InputError, match="xy_axes: of 10 lines, none lies on the y axis"
    ):
        calibrate(readings, bare(datum_theta=ThetaDatum.XY_AXES))
    with pytest.raises(
        InputError, match=r"Hu's law needs a square plate with 4, 8, 12"
    ):
        calibrate_by_law(readings, Options())
    with pytest.raises(InputError, match="encoder xy_axes: of 10 lines, none"):
        random_truth(
            readings.artifact, 4, np.random.default_rng(1), Spread(encoder="xy_axes")
        )
