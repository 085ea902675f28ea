# SPDX-License-Identifier: Apache-2.0
"""Noise of the indicated position is in offsets and readings alike, and is no scale."""

import numpy as np
import pytest

from selfcal_ros.estimation.api import calibrate
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.verdict import Grade
from selfcal_ros.simulation.cell import CellSettings
from selfcal_ros.simulation.machine import Spread, random_truth
from test.support.results import covered
from test.support.truth import hu_plan, simulate_measurements

NOISE = 20e-9


def measured(servo_m, seed=0, *, offsets_m=0.0, **spread):
    """Return truth and readings; by default the encoders have all the noise."""
    plan, rng = hu_plan(Artifact(7, 0.01, 8), repeats=5), np.random.default_rng(seed)
    truth = random_truth(plan.artifact, 4, rng, Spread(**spread))
    settings = CellSettings(
        sigma_xy_m=offsets_m,
        sigma_theta_rad=2e-6,
        encoder_sigma_m=NOISE,
        servo_sigma_m=servo_m,
    )
    return truth, simulate_measurements(
        truth, plan, rng, settings=settings, visits=True
    )


def scale_of(result):
    [term] = [term for term in result.model.terms if term.name == "microscope"]
    [scale] = [one for one in term.estimates if one.component == "scale"]
    return scale.value, scale.u


@pytest.mark.parametrize("seed", range(3))
def test_scatter_as_small_as_the_noise_of_the_encoders_shows_no_scale(seed):
    truth, readings = measured(NOISE, seed, phi_rad=5e-5)
    result = calibrate(readings)
    value, u = scale_of(result)
    # 0.5 by the scatter alone, 50 times its default uncertainty
    assert abs(value) < 3 * u < 0.03
    assert result.verdict.grade is Grade.GOOD
    assert covered(result, truth.g) > 0.85


@pytest.mark.parametrize("scale", [0.02, -0.02])
def test_larger_scatter_shows_the_scale_whatever_the_noise_is(scale):
    _, readings = measured(50 * NOISE, phi_rad=1e-6, microscope_scale=scale)
    value, u = scale_of(calibrate(readings))
    # all noise may be that of the position: 1/2500 of the scatter; that of 50 deviations from means
    assert abs(value - scale) < 2 * u
    assert 1 / 2500 < u < 2 / 2500


def test_to_measure_again_is_no_remedy_for_the_wrong_unit():
    _, readings = measured(NOISE, offsets_m=NOISE, phi_rad=5e-5, microscope_pixels=0.5)
    verdict = calibrate(readings).verdict
    assert verdict.grade is Grade.NOT_QUALIFIED
    assert "microscope" in [cause.name for cause in verdict.causes]
    assert all(
        remedy.kind != "view" for cause in verdict.causes for remedy in cause.remedies
    )
