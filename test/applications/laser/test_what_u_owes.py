# SPDX-License-Identifier: Apache-2.0
"""What u of the step diagonals owes to whole runs, and what is said where it cannot hold."""

import re
from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.applications.laser.identify import identify_ibaraki, identify_wang
from selfcal_ros.applications.laser.noise import reading_noise
from selfcal_ros.applications.laser.profiles import squareness, u_profile_m
from selfcal_ros.applications.laser.report import outcome
from test.support.laser import planar, random_errors

STEPS = (0.01, 0.008)


def repeated(exact, rng, *, runs_of_scale=0.0, distance_m=1e-9, repeats=3):
    """Return repeats of exact readings: distances are noisy, each run has a scale of its own."""
    n = exact.n_blocks
    readings = np.repeat(exact.samples_m, repeats, axis=0)
    linear = np.repeat(exact.linear_m, repeats, axis=0)
    readings += readings * rng.normal(0, runs_of_scale, (repeats, 2, 1, 1))
    linear += STEPS[0] * rng.normal(0, runs_of_scale, (repeats, 2, 1))
    distances = np.diff(rng.normal(0, distance_m, (repeats, 2, 2 * n + 1)))
    steps = distances.reshape(repeats, 2, n, 2).swapaxes(2, 3)
    steps[:, 1, 0] = steps[:, 1, 0, ::-1]  # X of np runs backwards
    readings += steps
    linear += np.diff(rng.normal(0, distance_m, (repeats, 2, n + 1)))
    return replace(exact, samples_m=readings, linear_m=linear)


def test_runs_of_different_scale_are_in_u_of_squareness():
    """Without their scale squareness lay within 2 u in 59 %."""
    rng = np.random.default_rng(1)
    scores = []
    for _ in range(40):
        errors = random_errors(6, rng)
        exact = planar(STEPS, errors, mirror_rad=(5e-4, -3e-4))
        truth = squareness(identify_ibaraki(exact)).value
        found = squareness(identify_ibaraki(repeated(exact, rng, runs_of_scale=2e-7)))
        scores.append((found.value - truth) / found.u)
    assert np.mean(np.abs(scores) < 2) > 0.9


def test_runs_that_their_readings_explain_have_no_scale():
    rng = np.random.default_rng(2)
    exact = planar(STEPS, random_errors(6, rng))
    noises = [reading_noise(repeated(exact, rng)) for _ in range(100)]
    assert np.mean([noise.run_dof == 0 for noise in noises]) > 0.8


def test_readings_that_contradict_each_other_are_named():
    rng = np.random.default_rng(3)
    data = repeated(planar(STEPS, random_errors(6, rng)), rng)
    assert identify_ibaraki(data).closure.contradiction == ""
    in_time = data.samples_m.copy()
    in_time[:, 1, 0] = in_time[:, 1, 0, ::-1]
    found = identify_ibaraki(replace(data, samples_m=in_time)).closure.contradiction
    assert "a block is a position on the axis, not a time" in found
    moved = data.samples_m.copy()
    moved[:, 0, 1, 2] += 1e-6
    found = identify_ibaraki(replace(data, samples_m=moved)).closure.contradiction
    assert found.startswith("the readings of the diagonals contradict each other by 0.")
    assert "the set-up changed between the runs" in found


def test_linear_errors_of_nominal_directions_have_no_u():
    """Their error is the mirror's, 5 um a block and mrad, where repeats scatter by nanometres."""
    rng = np.random.default_rng(4)
    data = repeated(
        planar((0.01, 0.01), random_errors(6, rng), mirror_rad=(1e-3, 0)), rng
    )
    found = identify_wang(data)
    result = outcome(found, data)
    assert result["u_ex_x"] is None and result["u_ey_y"] is None
    assert result["u_ex_y"][0] > 0
    assert u_profile_m(found, 0, 0) is None and u_profile_m(found, 0, 1) is not None
    assert abs(result["profiles"]["px_x"]["error"][-1]) > 0.025
    assert "1 mrad on one diagonal adds 30 µm to Px(x)" in result["warnings"][-1]


@pytest.mark.parametrize("steps", [(0.01, 0.01), (0.01, 0.008)])
@pytest.mark.parametrize("sense", [1, -1])
def test_what_a_mirror_makes_of_the_squareness_of_nominal_directions_is_said(
    steps, sense
):
    """Half the square of its angle, of which u of the squareness knows nothing."""
    exact = [
        planar(steps, np.zeros((2, 6, 2)), mirror_rad=(sense * 1e-3 * off, 0.0))
        for off in (0, 1)
    ]
    straight, tilted = (squareness(identify_wang(data)).value for data in exact)
    said = outcome(identify_wang(exact[1]), exact[1])["warnings"][-1]
    size_um = float(re.search(r"and (\S+) µm to the squareness", said)[1])
    assert size_um == pytest.approx(1e6 * abs(tilted - straight), rel=0.03)


def test_identical_repeats_show_no_uncertainty_although_their_mean_is_rounded():
    rng = np.random.default_rng(5)
    exact = planar(STEPS, random_errors(6, rng))
    data = repeated(exact, rng, distance_m=0.0)
    assert "an uncertainty of zero cannot be right" in "".join(
        outcome(identify_ibaraki(data), data)["warnings"]
    )


def test_a_mirror_far_off_the_laser_is_named_with_what_a_laser_off_its_diagonal_does():
    """Laser and mirror off by opposite products: lengths close, squareness errs by 0.5 um."""
    rng = np.random.default_rng(6)
    errors = random_errors(6, rng)
    truth = squareness(identify_ibaraki(planar(STEPS, errors))).value
    exact = planar(STEPS, errors, laser_rad=(1e-4, -1e-4), mirror_rad=(5e-3, 5e-3))
    data = repeated(exact, rng)
    found = identify_ibaraki(data)
    off_um = abs(squareness(found).value - truth) * 1e6
    warnings = outcome(found, data)["warnings"]
    assert off_um > 0.04
    assert len(warnings) == 1 and "squareness errs by 0.035 µm" in warnings[0]
