# SPDX-License-Identifier: Apache-2.0
"""Closures carry the uncertainty of what they are made of: derivatives by small differences."""

import numpy as np
import pytest

from selfcal_ros.applications.laser.data import DIAGONALS, StepDiagonal
from selfcal_ros.applications.laser.identify import jacobian
from selfcal_ros.applications.laser.noise import (
    length_closure,
    linear_covariance,
    linear_noise,
    reading_covariance,
    reading_noise,
)
from selfcal_ros.applications.laser.simulation import (
    LaserNoise,
    Measurement,
    random_machine,
    simulate_step_diagonal,
)


@pytest.mark.parametrize("steps", [(0.01, 0.006), (0.03, 0.04), (0.01, 0.008, 0.006)])
@pytest.mark.parametrize(
    ("distance_m", "linear_m"), [(2e-8, 0.0), (0.0, 2e-8), (1e-8, 3e-8)]
)
def test_the_uncertainty_of_the_lengths_is_that_of_readings_and_linear_errors(
    steps, distance_m, linear_m
):
    rng = np.random.default_rng(4)
    noise = LaserNoise(distance_m=distance_m, linear_m=linear_m, repeats=3)
    data = simulate_step_diagonal(
        random_machine(steps, 3, rng), Measurement({}, noise), rng
    )
    _, u = length_closure(data)

    def closure(readings, linear):
        one = StepDiagonal(
            data.steps_m, DIAGONALS[len(steps)], readings[None], linear[None]
        )
        return np.array([length_closure(one)[0]])

    by_readings = jacobian(lambda r: closure(r, data.linear_mean_m), data.readings_m)
    by_linear = jacobian(lambda e: closure(data.readings_m, e), data.linear_mean_m)
    variance = (
        by_readings @ reading_covariance(data, reading_noise(data)) @ by_readings.T
        + by_linear @ linear_covariance(data, linear_noise(data)) @ by_linear.T
    )
    assert u == pytest.approx(np.sqrt(variance[0, 0]), rel=1e-4, abs=1e-15)
