# SPDX-License-Identifier: Apache-2.0
"""Noise that is correlated in time, against one dense least squares and the truth."""

from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.estimation.comparison.covariance import first_order_u
from selfcal_ros.estimation.joint import noise_effects, solve
from selfcal_ros.estimation.joint.noise_effects import time_correlation
from selfcal_ros.estimation.joint.solve import fit_joint, solve_joint
from selfcal_ros.estimation.options import Options
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.readings import Sense
from selfcal_ros.model.terms import parse_terms
from selfcal_ros.simulation.cell import CellSettings
from selfcal_ros.simulation.machine import Spread, random_truth
from test.support.dense_fit import DenseFit
from test.support.results import covered
from test.support.truth import hu_plan, simulate_measurements

SIZED = "plate_scale:1e-7,plate_shape:5e-9"


def measured(size, seed=0, *, sense=Sense.MICROSCOPE_MOVES, slow_m=0.0):
    plan, rng = hu_plan(Artifact(size, 0.01, 8), 5), np.random.default_rng(seed)
    truth = random_truth(plan.artifact, len(plan.views), rng, Spread(phi_rad=5e-4))
    settings = CellSettings(
        sense, 5e-9 if slow_m else 20e-9, 2e-6, flicker_xy_m=slow_m, servo_sigma_m=0.0
    )
    return truth, simulate_measurements(
        truth, plan, rng, settings=settings, visits=True
    )


def u_of_first_order(dense, artifact):
    """Return the u of O and R by the least squares of the dense map on a whole square field."""
    x, y = artifact.x_m.ravel(), artifact.y_m.ravel()
    rows = np.stack([np.concatenate(pair) for pair in ((y, x), (x, -y))]) / (
        x @ x + y @ y
    )
    rows = rows @ dense.to_map
    return tuple(np.sqrt(np.diag(rows @ dense.covariance @ rows.T)))


@pytest.mark.parametrize("sense", Sense)
@pytest.mark.parametrize("text", ["", SIZED])
@pytest.mark.parametrize("correlation", [[0.6, 0.3, 0.1], [-0.4, 0.1]])
def test_each_node_has_the_uncertainty_of_such_noise(
    monkeypatch, text, correlation, sense
):
    monkeypatch.setattr(
        noise_effects, "time_correlation", lambda model: np.array(correlation)
    )
    _, readings = measured(5, sense=sense)
    terms = parse_terms([text], "") if text else ()
    result = solve_joint(
        readings,
        Options(terms=terms, assumed=(), causes=False, misalignment_model="linear"),
    ).result
    emap, noise = result.error_map, result.noise
    dense = DenseFit(
        readings, terms, (noise.sigma_xy, noise.sigma_theta), correlation=correlation
    )
    _, (u_x, u_y) = dense.grid(np.isfinite(emap.gx))
    assert np.allclose(emap.u_gx, u_x, rtol=1e-6, atol=0)
    assert np.allclose(emap.u_gy, u_y, rtol=1e-6, atol=0)
    white = first_order_u(replace(result, kept=replace(result.kept, added=None)))
    found = first_order_u(result)
    assert found == pytest.approx(u_of_first_order(dense, readings.artifact), rel=1e-5)
    assert found != pytest.approx(white, rel=0.02)


def test_slow_noise_is_in_the_uncertainty(monkeypatch):
    flat = Options(terms=parse_terms(["plate_shape:0"], ""), causes=False)
    inside, unaware = [], []
    for seed in range(4):
        truth, readings = measured(11, seed, slow_m=20e-9)
        inside.append(covered(solve_joint(readings, flat).result, truth.g))
        with monkeypatch.context() as patch:
            patch.setattr(solve, "MAX_NODES", 0)
            unaware.append(covered(solve_joint(readings, flat).result, truth.g))
    assert np.mean(inside) > max(0.93, np.mean(unaware) + 0.01)


def test_the_correlation_is_that_of_the_noise():
    """Slow noise alone: the correlation falls as the distance grows; white noise has none."""
    slow = time_correlation(fit_joint(measured(11, slow_m=20e-9)[1], Options()))
    assert len(slow) == 550 // 4  # 110 marks of the shifted view, five times
    assert slow[0] > 0.4 and slow[0] > slow[10] > slow[100]
    for seed in range(3):
        assert not len(time_correlation(fit_joint(measured(7, seed)[1], Options())))


@pytest.mark.parametrize("contrast", [-0.995, 0.995])
def test_what_correlation_takes_off_is_a_share_of_the_noise_of_each_axis(
    monkeypatch, contrast
):
    """Of their mean it would be more than the quiet axis has, and u of some nodes 0."""
    _, readings = measured(5)
    smooth = Options(assumed=(), causes=False, misalignment_model="linear")
    monkeypatch.setattr(noise_effects, "axis_contrast", lambda model: contrast)
    maps = []
    for correlation in ([], 0.92 ** np.arange(1, 12)):
        monkeypatch.setattr(
            noise_effects, "time_correlation", lambda model, c=correlation: c
        )
        emap = solve_joint(readings, smooth).result.error_map
        maps.append(np.minimum(emap.u_gx, emap.u_gy))
    assert (maps[1] > 0.3 * maps[0]).all()


def test_what_correlation_adds_is_a_share_of_the_noise_of_the_noisier_axis(monkeypatch):
    """And at least that of the mean of both on the quieter one."""
    _, readings = measured(5)
    smooth = Options(assumed=(), causes=False, misalignment_model="linear")
    monkeypatch.setattr(noise_effects, "axis_contrast", lambda model: 0.8)
    monkeypatch.setattr(
        noise_effects,
        "correlated_variances",
        lambda model, cover, correlation, rows: (
            0.5 * noise_effects._variances(cover, rows)
        ),
    )
    squares = []
    for correlation in ([], [0.3]):
        monkeypatch.setattr(
            noise_effects, "time_correlation", lambda model, c=correlation: c
        )
        emap = solve_joint(readings, smooth).result.error_map
        squares.append(np.stack([emap.u_gx, emap.u_gy]) ** 2)
    ratio = squares[1] / squares[0]
    assert ratio.min() == pytest.approx(1.5) and ratio.max() > 1.6
