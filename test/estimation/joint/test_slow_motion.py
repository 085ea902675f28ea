# SPDX-License-Identifier: Apache-2.0
"""Slow motion that the marks of an image share: found in one pass, and in U."""

import numpy as np
import pytest

from selfcal_ros.estimation.comparison.covariance import first_order_u
from selfcal_ros.estimation.joint import noise_effects
from selfcal_ros.estimation.joint.slow_motion import slow_correlation, slow_motion
from selfcal_ros.estimation.joint.solve import fit_joint, solve_joint
from selfcal_ros.estimation.options import Options
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.error_map import first_order
from selfcal_ros.simulation.cell import CellSettings
from test.support.plans import image_plan
from test.support.results import covered
from test.support.truth import Spread, hu_plan, random_truth, simulate_measurements

MARK_M, IMAGE_M = 20e-9, 40e-9
ALONE = Options(assumed=(), causes=False)


def measured(seed, *, repeats=1, turns=(0, 90, 180), **motion):
    plan, rng = (
        image_plan(7, turns=turns, repeats=repeats),
        np.random.default_rng(seed),
    )
    truth = random_truth(
        plan.artifact,
        len(turns),
        rng,
        Spread(phi_rad=5e-4, correlation_pitches=4.0),
    )
    settings = CellSettings(sigma_xy_m=MARK_M, servo_sigma_m=0.0, **motion)
    return truth, simulate_measurements(truth, plan, rng, settings=settings)


def errors_over_u(result, truth):
    """Return the errors of O and R in standard uncertainties."""
    emap = result.error_map
    found = emap.nonorthogonality, emap.scale_difference
    true = first_order(emap.artifact, truth.g)
    return (np.array(found) - true) / first_order_u(result)


def test_slow_motion_is_found_with_its_size_and_is_in_the_uncertainty(monkeypatch):
    inside, unaware, covers, found = [], [], [], []
    for seed in range(4):
        truth, readings = measured(seed, flicker_xy_m=IMAGE_M)
        result = solve_joint(readings, ALONE).result
        inside.append(errors_over_u(result, truth))
        covers.append(covered(result, truth.g))
        motion = result.kept.images.motion
        found.append(
            [result.noise.sigma_xy**2 * v for v in (motion.slow, motion.white)]
        )
        with monkeypatch.context() as patch:
            patch.setattr(noise_effects, "slow_motion", lambda model: None)
            result = solve_joint(readings, ALONE).result
        unaware.append(errors_over_u(result, truth))
    assert np.sqrt(np.mean(np.square(inside))) < 1.3
    assert np.sqrt(np.mean(np.square(unaware))) > 1.5
    assert np.mean(covers) > 0.93
    slow, white = np.mean(found, axis=0) / IMAGE_M**2
    assert slow == pytest.approx(1, rel=0.15) and white < 0.25


def test_white_motion_of_images_is_not_slow():
    for seed in range(4):
        fitted = fit_joint(measured(seed, image_xy_m=IMAGE_M)[1], ALONE)
        assert slow_motion(fitted) is None


def test_marks_alone_have_no_motion_of_images():
    plan, rng = hu_plan(Artifact(5, 0.01), 1), np.random.default_rng(0)
    truth = random_truth(plan.artifact, len(plan.views), rng, Spread(phi_rad=5e-4))
    settings = CellSettings(flicker_xy_m=IMAGE_M, servo_sigma_m=0.0)
    readings = simulate_measurements(truth, plan, rng, settings=settings)
    assert slow_motion(fit_joint(readings, ALONE)) is None


@pytest.mark.parametrize("repeats", [1, 2])
def test_what_it_adds_is_the_product_with_its_covariance(repeats):
    readings = measured(0, repeats=repeats, flicker_xy_m=IMAGE_M)[1]
    model = fit_joint(readings, ALONE)
    motion = slow_motion(model)
    assert 0 < -motion.white < motion.slow
    rng = np.random.default_rng(1)
    shape = 5, *model.problem.system.grid.read.shape
    sensitivities = (
        rng.normal(size=(*shape, 2)) @ [1, 1j] + 3
    )  # alike: none is negative
    flat = sensitivities.reshape(*shape[:2], -1)
    expected = np.zeros(5)
    for of_placing in motion.exposures:
        gain = np.zeros((5, of_placing.number), dtype=complex)
        for row, visits in zip(of_placing.rows, of_placing.visits, strict=True):
            order = np.unique(np.concatenate([v.time for v in of_placing.visits]))
            at = np.searchsorted(order, visits.time)
            for mark, weight, place in zip(visits.mark, visits.weight, at, strict=True):
                gain[:, place] += np.sqrt(weight) * flat[:, row, mark]
        distance = np.abs(np.subtract.outer(*2 * [np.arange(of_placing.number)]))
        covariance = motion.slow * slow_correlation(of_placing.number)[distance]
        covariance += motion.white * np.eye(of_placing.number)
        expected += np.einsum("ki,ij,kj->k", gain, covariance, gain.conj()).real
    assert motion.added(sensitivities) == pytest.approx(expected, rel=1e-9)
