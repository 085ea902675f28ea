# SPDX-License-Identifier: Apache-2.0
"""The noise of marks where lines are read as well, whose noise it weighs against."""

from collections import Counter

import numpy as np
import pytest

from selfcal_ros.estimation.api import calibrate
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.error_map import datum_modes, remove_modes
from selfcal_ros.model.verdict import Grade
from selfcal_ros.simulation.cell import CellSettings
from selfcal_ros.simulation.machine import Spread, random_truth
from test.support.truth import hu_plan, simulate_measurements

NOISE = 10e-9
PLATE = Artifact(6, 0.01, 24, 4)


def calibrated(seed, artifact=PLATE, repeats=2):
    plan, rng = hu_plan(artifact, repeats), np.random.default_rng(seed)
    truth = random_truth(
        plan.artifact,
        4,
        rng,
        Spread(rotation="finite", phi_rad=1e-3, t_m=2e-5, microscope_rotation_rad=0.01),
    )
    settings = CellSettings(sigma_xy_m=NOISE, sigma_theta_rad=2e-6, servo_sigma_m=3e-7)
    return calibrate(
        simulate_measurements(truth, plan, rng, settings=settings, visits=True)
    )


def test_residuals_of_few_marks_show_their_own_noise_and_not_that_of_lines():
    results = [calibrated(seed) for seed in range(10)]
    grades = Counter(result.verdict.grade for result in results)
    # 3 of them with the residuals of lines counted
    assert not grades[Grade.NOT_QUALIFIED]
    noises = [result.noise for result in results]
    dof = np.array([noise.dof_xy_residuals for noise in noises])
    found = np.array([noise.sigma_xy_residuals for noise in noises]) ** 2 / NOISE**2
    assert abs(dof @ found / dof.sum() - 1) < 4 * np.sqrt(2 / dof.sum())
    # as scattered as they say
    assert abs(np.mean(dof * (found - 1) ** 2) / 2 - 1) < 0.8


def test_the_noise_of_very_few_marks_is_that_of_lines_as_well():
    """Marks alone would have 4 to 7 degrees of freedom."""
    for lines in (8, 12, 24):
        result = calibrated(1, Artifact(3, 0.01, lines), 1)
        assert result.noise.dof_xy_residuals > 10 and result.verdict.grade is Grade.GOOD
        assert 0.5 < result.noise.sigma_xy_residuals / NOISE < 3


@pytest.mark.parametrize("phi_rad", [1e-6, 1e-5, 1e-4])
@pytest.mark.parametrize(
    ("plate", "repeats", "step_rad"),
    [
        (Artifact(11, 0.01, 24), 3, 0.0),
        (Artifact(5, 0.01, 36), 1, 0.0),  # neither repeats nor many marks
        (Artifact(5, 0.01, 24), 5, 1e-6),  # the repeats of a line are all the same
    ],
)
def test_lines_without_noise_neither_stop_the_fit_nor_contradict_anything(
    phi_rad, plate, repeats, step_rad
):
    """Plates that lie almost straight hardly show the microscope's scale."""
    exact = CellSettings(
        sigma_xy_m=20e-9,
        sigma_theta_rad=0.0,
        servo_sigma_m=20e-9,
        servo_sigma_theta_rad=1e-7 * (step_rad == 0),
        resolution_theta_rad=step_rad,
    )
    for seed in range(4):
        plan, rng = hu_plan(plate, repeats), np.random.default_rng(seed)
        truth = random_truth(plate, 4, rng, Spread(rotation="finite", phi_rad=phi_rad))
        result = calibrate(
            simulate_measurements(truth, plan, rng, settings=exact, visits=True)
        )
        assert result.verdict.failed == () and result.verdict.causes == ()
        error = np.stack([result.error_map.gx, result.error_map.gy]) - truth.g
        error = remove_modes(error, datum_modes(plate, scale=True))
        u = np.stack([result.error_map.u_gx, result.error_map.u_gy])
        assert (abs(error) < 2 * u).mean() > 0.9
        # what is assumed of the machine, and hardly anything else
        assert u.max() < 100e-9
