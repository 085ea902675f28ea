# SPDX-License-Identifier: Apache-2.0
"""How lines weigh against marks, by hand, and where the ratio ends."""

import numpy as np
import pytest

from selfcal_ros.estimation.joint.problem import (
    LEAST_NOISE_RAD,
    MAX_WEIGHT,
    bounded_ratio,
    repeats_of,
    sigma_of,
    weight_ratio,
)
from selfcal_ros.estimation.joint.solve import prepare
from selfcal_ros.estimation.options import Options
from selfcal_ros.model.artifact import Artifact
from test.support.truth import hu_plan, random_truth, simulate_measurements


@pytest.fixture(scope="module")
def problem():
    plan, rng = hu_plan(Artifact(7, 0.01, 12), repeats=3), np.random.default_rng(0)
    readings = simulate_measurements(
        random_truth(plan.artifact, 4, rng),
        plan,
        rng,
        sigma_m=1e-8,
        sigma_theta_rad=1e-6,
    )
    return prepare(readings, Options())[0], readings


def test_a_line_weighs_by_its_noise_at_the_half_width(problem):
    """Half width 30 mm, 20 nm and 2 urad: a line's noise is 60 nm there, its weight 1/9."""
    found = weight_ratio(problem[0], 2e-8, 2e-6, problem[0].grid.y)
    assert problem[0].half_width_m == pytest.approx(0.03)
    assert found == pytest.approx(1 / 9, rel=1e-12)
    assert weight_ratio(problem[0], 4e-8, 2e-6, problem[0].grid.y) == pytest.approx(
        4 / 9
    )
    assert weight_ratio(problem[0], 2e-8, 1e-6, problem[0].grid.y) == pytest.approx(
        4 / 9
    )


def test_without_both_noises_a_line_counts_like_a_mark(problem):
    for noises in ((float("nan"), 1e-6), (1e-8, float("nan"))):
        assert weight_ratio(problem[0], *noises, problem[0].grid.y) == 1.0


def test_the_ratio_ends_where_the_lighter_kind_would_be_lost(problem):
    system = problem[0].system
    equal = system.grid_scale / system.angular_scale
    y = np.zeros_like(problem[0].grid.y)
    assert bounded_ratio(system, 1.0, 1e-15, problem[0].half_width_m) == pytest.approx(
        equal * MAX_WEIGHT
    )
    # lines have at least a hundredth of the noise of marks
    assert weight_ratio(problem[0], 1.0, 1e-15, y) == pytest.approx(1e4)
    assert weight_ratio(problem[0], 1e-15, 1.0, y) == pytest.approx(equal / MAX_WEIGHT)


def test_readings_without_any_noise_weigh_as_much_as_rounding_bears(problem):
    system, y = problem[0].system, np.zeros_like(problem[0].grid.y)
    equal = system.grid_scale / system.angular_scale
    least = (1e-9 / (LEAST_NOISE_RAD * problem[0].half_width_m)) ** 2
    assert least < equal * MAX_WEIGHT
    assert weight_ratio(problem[0], 1e-9, 0.0, y) == pytest.approx(least)
    assert weight_ratio(problem[0], 1e-5, 0.0, y) == pytest.approx(1e4)
    assert weight_ratio(problem[0], 0.0, 1e-6, y) == pytest.approx(equal / MAX_WEIGHT)


def test_repeats_are_pooled_over_the_views_that_have_them(problem):
    (sigma, dof), (sigma_theta, dof_theta) = repeats_of(problem[1])
    grid = [v for v in problem[1].views if len(v.m)]
    assert dof == sum(v.dof_xy for v in grid) > 0
    assert sigma**2 * dof == pytest.approx(sum(v.dof_xy * v.sigma_xy**2 for v in grid))
    assert dof_theta == sum(v.dof_theta for v in problem[1].views)
    assert sigma_theta == pytest.approx(1e-6, rel=0.3)


def test_sigma_of_sums():
    assert sigma_of(12.0, 3) == (2.0, 3)
    assert np.isnan(sigma_of(0.0, 0)[0]) and sigma_of(0.0, 0)[1] == 0
