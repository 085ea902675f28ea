# SPDX-License-Identifier: Apache-2.0
"""Plates compared: their difference without datum, and its significance."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom

from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.comparison.covariance import covariance_of
from selfcal_ros.estimation.comparison.maps import compare
from selfcal_ros.estimation.joint.solve import solve_joint
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.error_map import datum_modes
from test.support import placed
from test.support.lattice_plans import plan_of
from test.support.options import BARE
from test.support.truth import random_truth, simulate_measurements

PLAN = plan_of("0,90,tx", Artifact(5, 0.01, 8), lines=1)
DRAWS = 40


def calibrated(truth, rng):
    return solve_joint(
        simulate_measurements(truth, PLAN, rng, sigma_m=2e-8, sigma_theta_rad=2e-6),
        BARE,
    ).result


def test_plates_measured_twice_agree_five_times_in_hundred():
    """On two machines, with lines: two maps that share the 5 %."""
    machines = [
        random_truth(PLAN.artifact, len(PLAN.views), np.random.default_rng(k))
        for k in (1, 2)
    ]
    machines[1] = replace(machines[1], a=machines[0].a, a_theta=machines[0].a_theta)
    below, differ = np.zeros(2), 0
    for seed in range(DRAWS):
        rng = np.random.default_rng(seed)
        found = compare(*(calibrated(truth, rng) for truth in machines), plates=True)
        assert found.xy.correlated and found.theta.correlated
        p = np.array([min(test.p, test.p_z) for test in (found.xy, found.theta)])
        below += p < 0.025
        differ += found.significant
        assert found.significant == bool(p.min() < 0.0125)
    assert below.min() >= 1 and below.max() <= binom.ppf(0.999, DRAWS, 0.05)
    assert differ <= binom.ppf(0.999, DRAWS, 0.05)


def test_a_map_that_is_compared_alone_has_all_of_the_five_percent():
    """Its limit of a node is lower than beside the map of the lines."""
    rng = np.random.default_rng(1)
    truth = random_truth(PLAN.artifact, len(PLAN.views), rng)
    pair = [calibrated(truth, rng) for _ in range(2)]
    emap = pair[1].error_map
    none = np.full(len(emap.g_theta), np.nan)
    alone = replace(pair[1], error_map=replace(emap, g_theta=none, u_g_theta=none))
    both, single = (compare(pair[0], other) for other in (pair[1], alone))
    assert single.theta is None and single.xy.p == both.xy.p
    assert single.xy.z_limit < both.xy.z_limit


def test_what_differs_is_found_without_motion_and_scale():
    rng, truth = (
        np.random.default_rng(1),
        random_truth(PLAN.artifact, len(PLAN.views), np.random.default_rng(3)),
    )
    moved = np.zeros((2, 5, 5))
    moved[0, 1, 3] = 4e-7
    modes = datum_modes(PLAN.artifact, scale=True)
    other = replace(
        truth, a=truth.a + moved + np.tensordot([2e-7, 0, 3e-6, 4e-6], modes, axes=1)
    )
    found = compare(calibrated(truth, rng), calibrated(other, rng), plates=True)
    flat = modes.reshape(4, -1).T
    wanted = moved.ravel() - flat @ np.linalg.lstsq(flat, moved.ravel(), rcond=None)[0]
    assert np.stack([found.dx, found.dy]).ravel() == pytest.approx(wanted, abs=1.2e-7)
    assert found.xy.significant and found.theta.significant is False
    assert found.scale == pytest.approx(4e-6, abs=1.5e-6)


def test_u_off_the_lattice_is_what_each_reading_does_to_the_plate():
    artifact = placed.plate(5, 3)
    whole, _ = placed.readings(
        artifact, placed.SIX[:4], np.random.default_rng(1), linear=True
    )
    options = replace(BARE, misalignment_model="linear", causes=False)
    result, maps = calibrate(whole, options), []
    for index, view in enumerate(whole.views):
        for name in ("dx", "dy"):
            for at in range(len(view.m)):
                views = list(whole.views)
                views[index] = replace(
                    view,
                    **{
                        name: getattr(view, name)
                        + 1e-7 * (np.arange(len(view.m)) == at)
                    },
                )
                plate = solve_joint(
                    replace(whole, views=tuple(views)),
                    replace(options, uncertainty=False),
                ).result.artifact_map
                maps.append(np.concatenate([plate.ax.ravel(), plate.ay.ravel()]))
    plate = result.artifact_map
    centre = np.concatenate([plate.ax.ravel(), plate.ay.ravel()])
    each = (np.array(maps) - centre) / 1e-7 * result.noise.sigma_xy
    wanted, known = each.T @ each, np.isfinite(plate.ax)
    u = np.concatenate([plate.u_ax.ravel(), plate.u_ay.ravel()])
    assert known.all()
    assert u == pytest.approx(np.sqrt(np.diag(wanted)), rel=1e-6)
    cover = covariance_of(result, "xy", known, plate=True)
    assert np.abs(cover - wanted).max() < 1e-5 * wanted.max()
