# SPDX-License-Identifier: Apache-2.0
"""Noise of its own along x and along y, against one dense least squares and the truth."""

import numpy as np
import pytest

from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.joint import solve
from selfcal_ros.estimation.joint.noise_effects import axis_contrast
from selfcal_ros.estimation.joint.solve import solve_joint
from selfcal_ros.estimation.normal.equations import MAX_NODES
from selfcal_ros.estimation.options import Options
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.readings import Sense
from selfcal_ros.model.terms import parse_terms
from selfcal_ros.simulation.cell import CellSettings
from selfcal_ros.simulation.machine import Spread, random_truth
from test.support.dense_fit import DenseFit
from test.support.options import STILL
from test.support.truth import hu_plan, simulate_measurements

SIZED = "plate_scale:1e-7,plate_shape:5e-9"


def measured(
    ratio, *, size=5, lines=8, repeats=4, sense=Sense.MICROSCOPE_MOVES, seed=0
):
    """Return truth and readings with noise of 40 nm along x and `ratio` times that along y."""
    plan, rng = (
        hu_plan(Artifact(size, 0.01, lines), repeats),
        np.random.default_rng(seed),
    )
    truth = random_truth(plan.artifact, len(plan.views), rng, Spread(phi_rad=5e-4))
    settings = CellSettings(sense, 40e-9, 2e-6, noise_ratio=ratio)
    return truth, simulate_measurements(
        truth, plan, rng, settings=settings, visits=True, missing=0.1
    )


@pytest.mark.parametrize("sense", Sense)
@pytest.mark.parametrize(("text", "lines"), [("", 8), ("", 0), (SIZED, 8)])
def test_each_axis_has_the_uncertainty_of_its_noise(text, lines, sense):
    _, readings = measured(0.2, lines=lines, sense=sense)
    terms = parse_terms([text], "") if text else ()
    options = Options(
        terms=terms, assumed=(), causes=False, misalignment_model="linear"
    )
    solved = solve_joint(readings, options)
    contrast = axis_contrast(solved.model)
    assert contrast == pytest.approx((1 - 0.04) / (1 + 0.04), abs=0.02)
    emap, noise = solved.result.error_map, solved.result.noise
    dense = DenseFit(
        readings, terms, (noise.sigma_xy, noise.sigma_theta), contrast=contrast
    )
    _, (u_x, u_y) = dense.grid(np.isfinite(emap.gx))
    assert np.allclose(emap.u_gx, u_x, rtol=1e-6, atol=0, equal_nan=True)
    assert np.allclose(emap.u_gy, u_y, rtol=1e-6, atol=0, equal_nan=True)
    assert np.nanmean(emap.u_gx) > 1.2 * np.nanmean(emap.u_gy)


@pytest.mark.parametrize("repeats", [5, 1])
def test_either_coordinate_lies_within_its_own_uncertainty(repeats):
    inside = []
    for seed in range(6):
        truth, readings = measured(0.25, size=11, repeats=repeats, seed=seed)
        result = calibrate(
            readings, Options(terms=(*STILL, *parse_terms(["plate_shape:0"], "")))
        )
        k, emap = result.noise.k_xy, result.error_map
        known = np.isfinite(emap.gx)
        error = np.stack([emap.gx, emap.gy]) - truth.g
        error -= np.mean(error[:, known], axis=1)[:, None, None]
        x, y = truth.artifact.x_m[known], truth.artifact.y_m[known]
        turn = (error[1, known] @ x - error[0, known] @ y) / (x @ x + y @ y)
        grown = (error[0, known] @ x + error[1, known] @ y) / (x @ x + y @ y)
        error[:, known] -= turn * np.stack([-y, x]) + grown * np.stack([x, y])
        inside.append(
            [
                (abs(e) <= k * u)[known].mean()
                for e, u in zip(error, (emap.u_gx, emap.u_gy), strict=True)
            ]
        )
    # a size that chance makes doubtful widens U
    assert np.mean(inside, axis=0) == pytest.approx([0.96, 0.96], abs=0.03)


def test_equal_noises_are_not_told_apart():
    _, readings = measured(1.0)
    assert axis_contrast(solve_joint(readings, Options(causes=False)).model) == 0.0


def test_above_a_size_both_axes_have_one_uncertainty(monkeypatch):
    _, readings = measured(0.2)
    options = Options(assumed=(), causes=False)
    told = solve_joint(readings, options).result.error_map
    monkeypatch.setattr(solve, "MAX_NODES", 24)
    common = solve_joint(readings, options).result.error_map
    assert np.nanmean(told.u_gx) > np.nanmean(common.u_gx) > np.nanmean(told.u_gy)
    assert MAX_NODES >= 21**2
