# SPDX-License-Identifier: Apache-2.0
"""The cases of `make reality`: how the plates lie, and how a result is compared with the truth."""

from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.estimation.api import calibrate
from selfcal_ros.simulation.machine import random_truth
from selfcal_ros.simulation.truth import simulate_measurements
from tools.reality.cases import (
    MODEL,
    Case,
    both,
    cases,
    compared,
    creeping,
    lines_turned,
    misread,
    resistant,
    run_case,
    scaled,
)


def test_the_plan_that_resists_turns_and_shifts_both_ways():
    plan = resistant()
    poses = {view.name: view.lattice_pose(plan.artifact) for view in plan.views}
    assert {name: (pose.quarter_turns, pose.shift) for name, pose in poses.items()
            if name != "line"} == {
        "identity": (0, (0, 0)), "rot90": (1, (0, 0)), "shift_x": (0, (1, 0)),
        "shift_-x": (0, (-1, 0)), "shift_y": (0, (0, 1))}
    assert (poses["line"].shift, poses["line"].turn_lines) == ((0, 0), 1)
    assert [view.grid for view in plan.views] == [True] * 5 + [False]
    assert all(view.angular for view in plan.views)


def test_a_site_that_is_wrong_by_more_than_its_u_is_counted_and_sized():
    plan, rng = resistant(1), np.random.default_rng(3)
    truth = random_truth(plan.artifact, len(plan.views), rng, MODEL)
    result = calibrate(simulate_measurements(truth, plan, rng, sigma_m=20e-9,
                                             sigma_theta_rad=1e-5))
    right = compared(replace(result, error_map=replace(
        result.error_map, gx=truth.g[0].copy(), gy=truth.g[1].copy(),
        g_theta=truth.g_theta + 1e-3)), truth)
    assert right.error_m < 1e-15 and right.within == 1.0
    assert right.z_theta < 1e-6  # a common angle is no error
    gx = truth.g[0].copy()
    gx[3, 4] += 2e-7
    wrong = compared(replace(result, error_map=replace(
        result.error_map, gx=gx, gy=truth.g[1].copy())), truth)
    assert wrong.error_m == pytest.approx(2e-7, rel=0.05)
    assert wrong.within == pytest.approx(1 - 1 / 242, abs=1e-9)


def test_cases_have_the_stop_errors_that_their_names_say():
    said = [(case.name, case.settings.stop_sigma_m) for case in cases()
            if "stop errors" in case.name]
    assert len(said) == 6
    for name, stop_m in said:
        assert stop_m == pytest.approx(float(name.split("stop errors ")[1].split(" um")[0]) * 1e-6)


def test_one_mark_of_the_second_view_is_misread():
    plan, rng = resistant(1), np.random.default_rng(3)
    truth = random_truth(plan.artifact, len(plan.views), rng, MODEL)
    readings = simulate_measurements(truth, plan, rng)
    spoilt = misread(3e-7)(readings, rng)
    away = [np.hypot(b.dx - a.dx, b.dy - a.dy)
            for a, b in zip(readings.views, spoilt.views, strict=True)]
    assert [np.count_nonzero(one > 1e-12) for one in away] == [0, 1, 0, 0, 0, 0]
    assert away[1].max() == pytest.approx(3e-7, rel=1e-6)


def test_lines_of_the_second_view_are_turned_and_no_mark():
    plan, rng = resistant(1), np.random.default_rng(3)
    truth = random_truth(plan.artifact, len(plan.views), rng, MODEL)
    readings = simulate_measurements(truth, plan, rng)
    turned = lines_turned(-2e-6)(readings, rng)
    moved = [b.dtheta - a.dtheta for a, b in zip(readings.views, turned.views, strict=True)]
    assert [float(np.abs(one).max()) for one in moved] == pytest.approx([0, 2e-6, 0, 0, 0, 0])
    assert moved[1] == pytest.approx(np.full(24, -2e-6))
    assert all(np.array_equal(a.dx, b.dx)
               for a, b in zip(readings.views, turned.views, strict=True))


def test_a_creep_is_alike_in_all_views_and_comes_to_rest():
    plan, rng = resistant(1), np.random.default_rng(3)
    truth = random_truth(plan.artifact, len(plan.views), rng, MODEL)
    crept = both(creeping(2e-7), scaled(1e-6))(truth, rng)
    assert crept.walk_m[:, 0, 0] == pytest.approx(np.full(6, 2e-7))
    assert crept.walk_m[:, 1, 0] == pytest.approx(np.full(6, -1e-7))
    assert np.abs(crept.walk_m[:, :, -1]).max() < 2e-9
    assert (np.ptp(crept.walk_m, axis=0) == 0).all()
    assert crept.plate_scale.std() > 1e-7 and not len(truth.plate_scale)


def test_what_is_spoilt_reaches_the_calibration():
    spoilt = Case("a mark off", plan=resistant(1), spoil=misread(2e-6))
    assert run_case(replace(spoilt, spoil=Case("clean").spoil), 1).qualified
    run = run_case(spoilt, 1)
    assert not run.qualified and run.causes[0] == "reading"
