# SPDX-License-Identifier: Apache-2.0
"""Lattices of even sides: as one dense least squares, true without noise, and covered by U."""

from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.applications.papers.methods import calibrate_by, calibrate_by_law
from selfcal_ros.errors import InputError
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.joint.solve import solve_joint
from selfcal_ros.estimation.observability.plan_check import check_plan
from selfcal_ros.estimation.options import Options
from selfcal_ros.model.error_map import ThetaDatum
from selfcal_ros.model.readings import Sense
from test.support.collecting import collect, scene
from test.support.dense_lattice import solve
from test.support.options import BARE
from test.support.plans import image_plan, plan_of
from test.support.refusals import in_words
from test.support.truth import random_truth, simulate_measurements

PLANS = ("0, 90, tx", "0, 90, 180, 270, tx, ty", "0, 90, -tx")


def mixed_plan(text, nx, ny, **how):
    """Return a plan whose quarter turns are shifted by half a pitch if one side is even."""
    plan = plan_of(text, nx, size_y=ny, **how)
    beside = plan.artifact.quarter_shift * plan.artifact.grid_pitch_m
    return replace(
        plan,
        views=tuple(
            view
            if round(view.rotation_rad / (np.pi / 2)) % 2 == 0 or not view.grid
            else replace(
                view,
                translation_m=tuple(along + beside for along in view.translation_m),
            )
            for view in plan.views
        ),
    )


def measured(plan, seed, *, sigma_m=20e-9, **how):
    rng = np.random.default_rng(seed)
    truth = random_truth(plan.artifact, len(plan.views), rng)
    return truth, simulate_measurements(truth, plan, rng, sigma_m=sigma_m, **how)


@pytest.mark.parametrize("finite", [False, True])
@pytest.mark.parametrize("text", PLANS)
@pytest.mark.parametrize("size", [4, 6, 8])
def test_the_dense_solution_is_the_same(size, text, finite):
    """Map, plate, misalignments and u, in the datum of the product."""
    _, readings = measured(plan_of(text, size), size, linear=not finite)
    result = calibrate(
        readings,
        Options(assumed=(), misalignment_model="rigid" if finite else "linear"),
    )
    want, emap = solve(readings, finite=finite), result.error_map
    assert np.abs(emap.gx + 1j * emap.gy - want.field).max() < 1e-13
    plate = result.artifact_map
    assert np.abs(plate.ax + 1j * plate.ay - want.plate).max() < 1e-13
    assert [view.phi for view in result.views] == pytest.approx(
        want.phi, rel=0, abs=1e-11
    )
    lies = np.array([complex(view.tx, view.ty) for view in result.views])
    assert np.abs(lies - want.t).max() < 1e-13
    u = np.stack([emap.u_gx, emap.u_gy]) / result.noise.sigma_xy
    assert u == pytest.approx(want.u_field, rel=1e-6)


@pytest.mark.parametrize(
    "text",
    [
        "0, 90, tx",
        "0, tx, ty",
        "0, 90, tx2",
        "0, tx2, ty2",
        "0, 180, tx",
        "0, 90, 180",
        "0, 180, -tx, tx",
        "0, 90",
        "0, tx",
        "0",
    ],
)
@pytest.mark.parametrize("size", [(4, 0), (6, 0), (4, 6), (5, 4)])
def test_the_rank_is_that_of_the_dense_matrix(size, text):
    """Of plans that identify the stage and of those that do not."""
    plan = mixed_plan(text, *size)
    _, readings = measured(plan, 1)
    assert check_plan(plan).observability.rank == solve(readings, finite=False).rank + 7


@pytest.mark.parametrize("sense", Sense)
@pytest.mark.parametrize("size", [(4, 0), (10, 0), (8, 6), (8, 5)])
def test_readings_without_noise_give_the_truth(size, sense):
    plan = mixed_plan("0, 90, -tx", *size, count=8, line=True)
    truth, readings = measured(plan, 2, sigma_m=0.0, sense=sense)
    result = calibrate(readings)
    emap = result.error_map
    assert np.abs([emap.gx - truth.g[0], emap.gy - truth.g[1]]).max() < 1e-15
    assert (
        np.abs(
            [result.artifact_map.ax - truth.a[0], result.artifact_map.ay - truth.a[1]]
        ).max()
        < 1e-15
    )


@pytest.mark.parametrize("sense", Sense)
@pytest.mark.parametrize("with_ids", [True, False])
@pytest.mark.parametrize("size", [(8, 0), (4, 6), (7, 6)])
def test_detections_give_the_truth(size, with_ids, sense):
    """With ids and without: the nearest mark to a place between marks is half a pitch away."""
    plan = mixed_plan("0, 90, 180, -tx, ty", *size)
    shot = scene(
        plan, sense=sense, with_ids=with_ids, servo_sigma_m=0.0, t_m=(3e-5, -2e-5)
    )
    readings, progress = collect(shot.events, measurement_sense=str(sense))
    assert all(view.grid_done == view.grid_expected for view in progress.values())
    found = calibrate(readings)
    np.testing.assert_allclose(
        [found.error_map.gx, found.error_map.gy], shot.truth.g, atol=2e-11
    )
    assert [view.phi for view in found.views] == pytest.approx(
        shot.truth.phi_rad, abs=1e-8
    )


@pytest.mark.parametrize("sense", Sense)
@pytest.mark.parametrize("with_ids", [True, False])
def test_images_of_nine_marks_give_the_map(sense, with_ids):
    shot = scene(image_plan(8), sense=sense, with_ids=with_ids, servo_sigma_m=0.0)
    readings, progress = collect(shot.events, measurement_sense=str(sense))
    assert all(view.grid_done == view.grid_expected for view in progress.values())
    found = calibrate(readings)
    np.testing.assert_allclose(
        [found.error_map.gx, found.error_map.gy], shot.truth.g, atol=2e-11
    )
    np.testing.assert_allclose(
        [found.artifact_map.ax, found.artifact_map.ay], shot.truth.a, atol=2e-11
    )


def test_errors_lie_in_u():
    """Over 40 machines, between the limits of a binomial count (alike within a machine)."""
    inside = squares = number = 0.0
    for seed in range(40):
        plan = mixed_plan(
            "0, 90, tx, ty",
            *((8, 0), (6, 4), (7, 6), (4, 0))[seed % 4],
            count=8,
            line=True,
        )
        truth, readings = measured(plan, seed, sigma_theta_rad=1e-6)
        result = solve_joint(readings, BARE).result
        emap, k = result.error_map, result.noise.k_xy
        error = np.stack([emap.gx, emap.gy]) - truth.g
        u = np.stack([emap.u_gx, emap.u_gy])
        inside += (np.abs(error) < k * u).sum()
        squares, number = squares + ((error / u) ** 2).sum(), number + error.size
    assert 0.935 < inside / number < 0.965
    assert squares / number == pytest.approx(1.0, abs=0.1)


def test_no_site_lies_on_an_axis():
    """The theta datum of the half axes and Hu's law with it are refused, zero_mean is not."""
    plan = plan_of("0, 90, tx", 4, count=8, line=True)
    truth, readings = measured(plan, 5, sigma_m=0.0)
    for method in ("joint", "law"):
        with pytest.raises(InputError, match=r"on the axes.*zero_mean"):
            calibrate_by(method, readings, Options(datum_theta=ThetaDatum.XY_AXES))
    _, linear = measured(plan, 5, sigma_m=0.0, linear=True)
    found = calibrate_by_law(linear, Options())
    assert (
        np.abs([found.error_map.gx - truth.g[0], found.error_map.gy - truth.g[1]]).max()
        < 1e-14
    )


def test_a_quarter_turn_of_mixed_sides_is_half_a_pitch_beside():
    plan = plan_of("0, 90, tx", 8, size_y=5)
    with pytest.raises(
        InputError,
        match=r"rows of 8 x 5 marks lie between rows at a shift of 0 "
        r"pitch; shift it by \[0.5, 0.5\] pitch",
    ):
        plan.views[1].on_stage(plan.artifact)
    seen = check_plan(replace(plan, views=(plan.views[0], plan.views[2]))).observability
    assert in_words(seen.advice)[0] == (
        "add a view turned by 90° and shifted by +0.5 pitch along X and +0.5 pitch along Y"
    )
    assert check_plan(mixed_plan("0, 90, tx", 8, 5)).observability.identifiable


@pytest.mark.parametrize("size", [(7, 6), (6, 7)])
def test_the_axis_conditions_need_sites_on_both_axes(size):
    _, readings = measured(
        mixed_plan("0, 90, 180, tx, ty", *size, count=8, line=True), 1
    )
    with pytest.raises(
        InputError, match=f"no sites of {size[0]} x {size[1]} lie on the axes"
    ):
        calibrate(readings, Options(datum_theta=ThetaDatum.XY_AXES))
