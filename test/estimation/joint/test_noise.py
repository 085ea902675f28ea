# SPDX-License-Identifier: Apache-2.0
"""Which noise counts, and when residuals contradict it."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom
from scipy.stats import f as f_distribution

from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.joint.problem import F_LEVEL, noise_estimate
from selfcal_ros.model.artifact import Artifact
from test.support.options import bare
from test.support.truth import hu_plan, random_truth, simulate_measurements

NAN = float("nan")


def test_one_noise_is_contradicted_once_in_a_thousand():
    rng = np.random.default_rng(5)
    draws, dofs = 4000, (40, 12)
    alarms = sum(
        noise_estimate((a * 1e-8, dofs[0]), (b * 1e-8, dofs[1]), NAN).contradicted
        for a, b in zip(
            *(np.sqrt(rng.chisquare(d, draws) / d) for d in dofs), strict=True
        )
    )
    assert (
        binom.ppf(1e-4, draws, F_LEVEL) <= alarms <= binom.ppf(1 - 1e-4, draws, F_LEVEL)
    )


@pytest.mark.parametrize(("ratio", "larger"), [(3.0, "residuals"), (1 / 3, "repeats")])
def test_the_larger_of_two_noises_that_contradict_each_other_counts(ratio, larger):
    found = noise_estimate((1e-8, 100), (ratio * 1e-8, 50), NAN)
    assert found.contradicted
    wanted = (
        f_distribution.sf(9, 50, 100)
        if ratio > 1
        else f_distribution.cdf(1 / 9, 50, 100)
    )
    assert found.p == pytest.approx(2 * wanted, rel=1e-6)
    assert found.sigma == max(1e-8, ratio * 1e-8)
    assert found.dof == {"residuals": 50, "repeats": 100}[larger]


@pytest.mark.parametrize(
    ("dof", "counts"), [(1e-13, False), (0.99, False), (1.01, True), (2, True)]
)
def test_residuals_without_degrees_of_freedom_contradict_nothing(dof, counts):
    """Terms with sizes leave a fraction of one, in which there is rounding alone."""
    found = noise_estimate((8e-7, 48), (2e-12, dof), NAN)
    assert (found.dof_residuals, found.sigma, found.dof) == (dof * counts, 8e-7, 48)
    assert np.isnan(found.p) is not counts and np.isnan(found.residuals) is not counts
    assert counts or not found.contradicted


@pytest.mark.parametrize(("dof", "used"), [(29, "residuals"), (30, "repeats")])
def test_repeats_count_from_thirty_degrees_of_freedom(dof, used):
    found = noise_estimate((1e-8, dof), (1.01e-8, 200), NAN)
    assert found.sigma == {"repeats": 1e-8, "residuals": 1.01e-8}[used]
    assert not found.contradicted


@pytest.mark.parametrize(("dof", "used"), [(8, "repeats"), (10, "residuals")])
def test_few_repeats_count_where_residuals_have_fewer_degrees_of_freedom(dof, used):
    """Of three lines in three views residuals have one or two: by chance a third of the noise."""
    found = noise_estimate((1e-8, 9), (0.5e-8, dof), NAN)
    assert not found.contradicted
    assert found.sigma == {"repeats": 1e-8, "residuals": 0.5e-8}[used]
    assert found.dof == {"repeats": 9, "residuals": dof}[used]


@pytest.mark.parametrize(
    ("ratio", "contradicted"),
    [(1.09, False), (1.11, True), (1 / 1.09, False), (1 / 1.11, True)],
)
def test_noises_within_a_tenth_are_the_same_for_every_purpose(ratio, contradicted):
    found = noise_estimate((1e-8, 1_000_000), (ratio * 1e-8, 1_000_000), NAN)
    assert found.p < F_LEVEL and found.contradicted is contradicted


def test_declared_noise_is_held_against_the_residuals():
    found = noise_estimate((5e-8, 400), (2e-8, 60), 1e-8)
    assert found.contradicted and found.sigma == 2e-8 and found.dof == 60
    fine = noise_estimate((5e-8, 400), (1.05e-8, 60), 1e-8)
    assert not fine.contradicted and fine.dof == 68  # a declaration counts as eight
    assert fine.sigma == pytest.approx(1e-8 * np.sqrt((8 + 60 * 1.05**2) / 68))
    smaller = noise_estimate((5e-8, 400), (0.95e-8, 60), 1e-8)
    assert not smaller.contradicted and smaller.sigma == 1e-8
    assert noise_estimate((NAN, 0), (NAN, 0), 1e-8).k == pytest.approx(2.37, abs=0.01)


@pytest.mark.parametrize(("dof", "known"), [(100, 3e-8), (4, 2e-8)])
def test_many_repeats_excuse_residuals_beyond_the_declared_noise_few_do_not(dof, known):
    found = noise_estimate((3e-8, dof), (3.1e-8, 60), 2e-8)
    assert found.contradicted and found.known == known
    residuals = (3.1e-8 / known) ** 2
    wanted = f_distribution.sf(residuals, 60, dof if known > 2e-8 else 1e9)
    assert found.p_of_known == pytest.approx(2 * wanted, rel=1e-3)


def test_nothing_to_compare_is_no_contradiction():
    for repeats, residuals in (
        ((NAN, 0), (1e-8, 9)),
        ((1e-8, 40), (NAN, 0)),
        ((0.0, 40), (1e-8, 9)),
        ((0.0, 40), (0.0, 9)),
    ):
        found = noise_estimate(repeats, residuals, NAN, floor=1e-13)
        assert np.isnan(found.p) and not found.contradicted
    assert noise_estimate((0.0, 40), (1e-8, 9), NAN, floor=1e-13).sigma == 1e-8
    assert noise_estimate((NAN, 0), (1e-8, 9), NAN).k == pytest.approx(2.32, abs=0.01)
    for repeats, residuals in ((0.0, 4e-14), (4e-14, 3e-14)):
        found = noise_estimate((repeats, 40), (residuals, 9), NAN, floor=1e-13)
        assert found.sigma == 4e-14


@pytest.mark.parametrize(("shared_rad", "is_compared"), [(3e-10, False), (3e-8, True)])
def test_noise_of_lines_that_counts_nowhere_contradicts_nothing(
    shared_rad, is_compared
):
    """What 20 nm beside the targets change in the angle is 1e-10 rad, the same in all repeats."""
    artifact = Artifact(7, 0.01, 24)
    rng = np.random.default_rng(1)
    readings = simulate_measurements(
        random_truth(artifact, 4, rng),
        hu_plan(artifact, 5),
        rng,
        sigma_m=2e-8,
        sigma_theta_rad=shared_rad / 3,
    )
    views = tuple(
        replace(view, dtheta=view.dtheta + rng.normal(0, shared_rad, len(view.dtheta)))
        for view in readings.views
    )
    result = calibrate(replace(readings, views=views), bare())
    assert bool(result.noise.p_theta < F_LEVEL) is is_compared
    assert math.isnan(result.noise.p_theta) is not is_compared
