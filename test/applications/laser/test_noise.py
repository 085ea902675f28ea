# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.applications.laser.data import DIAGONALS, StepDiagonal
from selfcal_ros.applications.laser.noise import (
    linear_covariance,
    linear_noise,
    reading_covariance,
    reading_noise,
    time_order,
)
from selfcal_ros.applications.laser.simulation import (
    LaserNoise,
    Measurement,
    case_study_machine,
    simulate_step_diagonal,
)

NM = 1e-9


def simulated(noise, seed=3):
    return simulate_step_diagonal(
        case_study_machine(), Measurement({}, noise), np.random.default_rng(seed)
    )


def test_time_order_of_np_starts_with_the_last_block_of_x():
    np.testing.assert_array_equal(
        time_order(np.array([1.0, 1.0]), 3), [0, 3, 1, 4, 2, 5]
    )
    np.testing.assert_array_equal(
        time_order(np.array([-1.0, 1.0]), 3), [2, 3, 1, 4, 0, 5]
    )


def test_noise_of_distances_shows_as_a_correlation_of_minus_one_half():
    noise = reading_noise(simulated(LaserNoise(distance_m=10 * NM, repeats=40)))
    assert noise.sigma_m == pytest.approx(np.sqrt(2) * 10 * NM, rel=0.05)
    assert noise.correlation == pytest.approx(-0.5, abs=0.01)
    assert noise.dof == 39 * 24


def test_noise_of_readings_shows_no_correlation():
    noise = reading_noise(simulated(LaserNoise(reading_m=10 * NM, repeats=40)))
    assert noise.sigma_m == pytest.approx(10 * NM, rel=0.06)
    assert noise.correlation > -0.1


def test_the_covariance_is_that_of_the_mean_readings():
    """A covariance of 2000 measurements has a standard error of 2.2 % of the variances."""
    drawn = simulated(LaserNoise(10 * NM, 5 * NM, 8 * NM, repeats=2000), seed=4)
    many = simulated(LaserNoise(10 * NM, 5 * NM, 8 * NM, repeats=200))
    for samples, model in (
        (drawn.samples_m, reading_covariance(many, reading_noise(many))),
        (drawn.linear_m, linear_covariance(many, linear_noise(many))),
    ):
        expected = np.cov(samples.reshape(2000, -1).T) / 200
        np.testing.assert_allclose(model, expected, atol=0.12 * expected.max())


def test_without_repeats_nothing_is_known():
    noise = reading_noise(simulated(LaserNoise(distance_m=1 * NM)))
    assert np.isnan(noise.sigma_m) and noise.dof == 0


def test_diagonals_with_fewer_complete_runs_keep_their_correlation():
    full = simulated(LaserNoise(distance_m=10 * NM, linear_m=5 * NM, repeats=40))
    samples = full.samples_m.copy()
    samples[25:, 1] = np.nan
    fewer = replace(full, samples_m=samples)
    noise = reading_noise(fewer)
    assert noise.sigma_m == pytest.approx(np.sqrt(2) * 10 * NM, rel=0.06)
    assert noise.correlation == pytest.approx(-0.5, abs=0.01)
    assert noise.dof == 39 * 12 + 24 * 12
    # The sum of a run is the difference of two distances, however many steps it has.
    sums = [
        np.ones(12)
        @ reading_covariance(fewer, noise)[k : k + 12, k : k + 12]
        @ np.ones(12)
        for k in (0, 12)
    ]
    np.testing.assert_allclose(
        sums, [2 * (10 * NM) ** 2 / 40, 2 * (10 * NM) ** 2 / 25], rtol=0.2
    )


def test_rows_that_only_others_have_filled_change_nothing():
    full = simulated(LaserNoise(distance_m=10 * NM, linear_m=5 * NM, repeats=4))
    rows = np.full((3, *full.samples_m.shape[1:]), np.nan)
    padded = replace(
        full,
        samples_m=np.concatenate([full.samples_m, rows]),
        linear_m=np.concatenate([full.linear_m, rows[:, 0]]),
    )
    assert reading_noise(padded) == reading_noise(full)
    assert linear_noise(padded) == linear_noise(full)


def test_partly_repeated_blocks_are_pooled_without_correlation():
    samples = np.full((3, 2, 2, 2), 7e-3)
    samples[1:, :, :, 1] = np.nan
    samples[1, :, :, 0] += 6 * NM
    data = StepDiagonal((0.01, 0.01), DIAGONALS[2], samples)
    noise = reading_noise(data)
    # Block 1: 7, 7 + 6 nm, 7; mean +2 nm; squares 4 + 16 + 4 = 24 nm^2 on 2 degrees of freedom.
    assert noise.sigma_m == pytest.approx(np.sqrt(12) * NM)
    assert (noise.correlation, noise.dof) == (0.0, 8)
    variance = np.diag(reading_covariance(data, noise))
    np.testing.assert_allclose(variance[:2], [4 * NM**2, 12 * NM**2])
