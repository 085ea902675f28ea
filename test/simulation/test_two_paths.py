# SPDX-License-Identifier: Apache-2.0
"""Messages through the collector and the direct readings of one truth are the same readings."""

from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.collection.marks import repeats
from selfcal_ros.model.readings import Sense
from selfcal_ros.model.view import View
from selfcal_ros.simulation.cell import CellSettings, plan_events
from selfcal_ros.simulation.machine import Spread, random_truth
from test.support.collecting import START_NS, collect
from test.support.mark_lists import listed_plan, rings, scatter
from test.support.plans import harmonic_plan, placed_plan, plan_of
from test.support.truth import simulate_measurements

EVERYTHING = Spread(
    rotation="finite",
    encoder="independent",
    microscope_scale=5e-3,
    microscope_rotation_rad=2e-3,
    microscope_shear=1e-3,
    backlash_x_m=4e-8,
    backlash_y_m=-3e-8,
    plate_scale=1e-6,
    plate_shape_m=3e-8,
    drift_linear_m=1e-7,
    drift_quadratic_m=1e-7,
    drift_cubic_m=1e-7,
    drift_walk_m=1e-7,
)
CASES = {
    "plain": (Spread(rotation="finite"), {}),
    "everything": (
        EVERYTHING,
        {
            "stop_sigma_m": 3e-5,
            "stop_sigma_theta_rad": 1e-5,
            "visit_order": "x_back_y_back",
            "resolution_xy_m": 1e-9,
            "flicker_xy_m": 1e-8,
            "visit_xy_m": 1e-8,
        },
    ),
    "consecutive": (
        EVERYTHING,
        {
            "consecutive": True,
            "visit_order": "random",
            "flicker_theta_rad": 1e-6,
            "resolution_theta_rad": 1e-7,
        },
    ),
    "beside the model": (
        Spread(
            microscope_axes="y-x",
            microscope_pixels=2.0,
            line_factor=-1.0,
            microscope_distortion=1e-3,
            optical_tilt_x_rad=5e-3,
            backlash_growth_m=3e-8,
            settling_m=1e-8,
            stage_bend_m=1e-8,
            plate_strain=1e-6,
            plate_tilt_rad=1e-3,
            plate_bow_m=5e-6,
            line_eccentricity_rad=1e-5,
            phi_common_rad=1e-3,
        ),
        {"noise_ratio": 0.25, "encoder_sigma_m": 2e-8, "encoder_sigma_theta_rad": 1e-7},
    ),
    "followed": (
        EVERYTHING,
        {"follow_mark": True, "visit_order": "there_and_back@plate"},
    ),
}


PLANS = {
    "on the lattice": plan_of(
        "0, 90, -tx, 90tx", 7, size_y=5, count=8, line=True, repeats=3
    ),
    "harmonics": harmonic_plan(),
    "placed": placed_plan(7, size_y=5, count=8, repeats=3),
    "a list of marks": listed_plan(
        scatter(40, half_m=0.02, angular_count=8), repeats=3
    ),
}


@pytest.mark.parametrize("sense", list(Sense))
@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("plan", PLANS.values(), ids=list(PLANS))
def test_both_give_the_same_readings_visit_by_visit(monkeypatch, plan, case, sense):
    # of readings without messages nobody knows in which order lines were read
    monkeypatch.setattr(repeats, "TURNS_LEVEL", 0.0)
    spread, how = CASES[case]
    truth = random_truth(
        plan.artifact, len(plan.views), np.random.default_rng(2), spread
    )
    settings = CellSettings(sense, 2e-8, 1e-6, **how)
    direct = simulate_measurements(
        truth, plan, np.random.default_rng(4), settings=settings
    )
    events = plan_events(
        truth, plan, settings=settings, rng=np.random.default_rng(4), start_ns=START_NS
    )
    collected, _ = collect(events, measurement_sense=str(sense), outlier_limit=0.0)
    assert collected.all_rejected() == {}
    for one, other in zip(direct.views, collected.views, strict=True):
        assert (one.view, one.used, one.dof_xy, one.dof_theta) == (
            other.view,
            other.used,
            other.dof_xy,
            other.dof_theta,
        )
        for name in ("m", "n", "count", "k", "count_theta"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
        for name in ("dx", "dy", "sigma_xy"):
            np.testing.assert_allclose(
                getattr(one, name), getattr(other, name), atol=2e-17
            )
        np.testing.assert_allclose(one.dtheta, other.dtheta, atol=4e-15)
        assert one.axis_theta == pytest.approx(other.axis_theta, abs=4e-15)
        np.testing.assert_allclose(one.sigma_theta, other.sigma_theta, rtol=1e-9)
        if one.view.grid:
            assert_same_visits(one.visits, other.visits)
        for name in ("motion", "motion_theta"):
            assert_same_motion(getattr(one, name), getattr(other, name))


def assert_same_motion(one, other):
    assert (one is None) == (other is None)
    if one is not None:
        assert one.dof == other.dof
        np.testing.assert_allclose(one.products, other.products, rtol=1e-6, atol=1e-26)


def test_both_read_the_marks_that_lie_there_where_they_have_no_ids():
    plan = plan_of("0, 90, tx", 7, count=8, repeats=2)
    spread = Spread(g_m=1e-7, a_m=1e-7, phi_rad=1e-5, t_m=1e-6)
    truth = random_truth(plan.artifact, 3, np.random.default_rng(2), spread)
    truth = replace(
        truth,
        placed=(
            None,
            View("turned back", -np.pi / 2),
            View("aside", 0.0, (0.0, plan.artifact.grid_pitch_m)),
        ),
    )
    settings = CellSettings(Sense.PLATE_MOVES, 2e-8, 1e-6, with_ids=False)
    direct = simulate_measurements(
        truth, plan, np.random.default_rng(4), settings=settings
    )
    events = plan_events(
        truth, plan, settings=settings, rng=np.random.default_rng(4), start_ns=START_NS
    )
    collected, _ = collect(events, measurement_sense="plate_moves", outlier_limit=0.0)
    assert [len(view.m) for view in direct.views] == [49, 49, 36]
    for one, other in zip(direct.views, collected.views, strict=True):
        for name in ("m", "n", "count", "k", "count_theta"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
        np.testing.assert_allclose([one.dx, one.dy], [other.dx, other.dy], atol=2e-17)
        np.testing.assert_allclose(one.dtheta, other.dtheta, atol=4e-15)


@pytest.mark.parametrize("sense", list(Sense))
@pytest.mark.parametrize(
    "plan",
    [
        placed_plan(11, count=24),
        listed_plan(repeats=1),
        listed_plan(rings(angular_count=24)),
    ],
    ids=["lattice", "scattered", "circles"],
)
def test_placed_plates_are_read_without_ids(plan, sense):
    """Turned by 17 mrad more than commanded, and 0.3 pitches beside."""
    spread = Spread(phi_rad=0.017, t_m=2e-3, correlation_pitches=4.0)
    truth = random_truth(
        plan.artifact, len(plan.views), np.random.default_rng(2), spread
    )
    settings = CellSettings(sense, 2e-8, 1e-6, with_ids=False)
    direct = simulate_measurements(
        truth, plan, np.random.default_rng(4), settings=settings
    )
    events = plan_events(
        truth, plan, settings=settings, rng=np.random.default_rng(4), start_ns=START_NS
    )
    collected, progress = collect(
        events, measurement_sense=str(sense), outlier_limit=0.0
    )
    assert collected.all_rejected() == {}
    assert all(found.complete for found in progress.values())
    for one, other in zip(direct.views, collected.views, strict=True):
        for name in ("m", "n", "count", "k", "count_theta"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
        np.testing.assert_allclose([one.dx, one.dy], [other.dx, other.dy], atol=2e-17)


def assert_same_visits(one, other):
    for name in ("mark", "count", "approach_x", "approach_y", "dof"):
        np.testing.assert_array_equal(
            getattr(one, name), getattr(other, name), err_msg=name
        )
    for name in ("dx", "dy", "offset_x", "offset_y", "sigma_m"):
        np.testing.assert_allclose(
            getattr(one, name), getattr(other, name), atol=2e-17, err_msg=name
        )
    since = [visits.stamp_ns - visits.stamp_ns.min() for visits in (one, other)]
    np.testing.assert_array_equal(*since)


def test_marks_that_are_missing_are_missing_as_a_whole():
    plan = plan_of("0, 90, tx", 11, count=24, repeats=3)
    truth = random_truth(plan.artifact, 3, np.random.default_rng(2))
    every = simulate_measurements(truth, plan, np.random.default_rng(4), visits=True)
    found = simulate_measurements(
        truth, plan, np.random.default_rng(4), visits=True, missing=0.3
    )
    for one, whole in zip(found.views, every.views, strict=True):
        assert 0.5 * len(whole.m) < len(one.m) < 0.9 * len(whole.m)
        assert 0.4 * len(whole.k) < len(one.k) < len(whole.k)
        assert set(one.count) == set(one.count_theta) == {3}
        np.testing.assert_array_equal(
            np.bincount(one.visits.mark, one.visits.count), one.count
        )
        at = np.searchsorted(100 * whole.m + whole.n, 100 * one.m + one.n)
        np.testing.assert_allclose(one.dx, whole.dx[at], atol=1e-17)
        assert one.used == one.count.sum() + one.count_theta.sum()


def test_means_of_visits_are_the_means_of_marks():
    plan = plan_of("0", 11, count=24, repeats=3)
    truth = random_truth(plan.artifact, 1, np.random.default_rng(2))
    (found,) = simulate_measurements(
        truth,
        plan,
        np.random.default_rng(4),
        sigma_m=1e-8,
        settings=CellSettings(sigma_xy_m=1e-8),
    ).views
    visits = found.visits
    mean = np.bincount(visits.mark, visits.dx * visits.count) / found.count
    np.testing.assert_allclose(mean, found.dx, atol=1e-17)
    assert (np.diff(visits.mark) >= 0).all()
    assert (np.diff(visits.stamp_ns)[np.diff(visits.mark) == 0] > 0).all()
