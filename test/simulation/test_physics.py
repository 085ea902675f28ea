# SPDX-License-Identifier: Apache-2.0
"""Each effect of the simulated machine against numbers worked out by hand, in both senses.

The plate has 3 x 3 marks 0.1 m apart and 4 lines; everything is 0 but what the test sets.
"""

from dataclasses import replace
from math import asin, pi

import numpy as np
import pytest

from selfcal_ros.model.artifact import Artifact, Interpolation, MapGrid
from selfcal_ros.model.readings import Sense
from selfcal_ros.model.view import Plan, View
from selfcal_ros.model.visit_order import visit_sequence
from selfcal_ros.simulation.cell import (
    CellSettings,
    flicker_noise,
    grid_exposures,
    quantised,
)
from selfcal_ros.simulation.machine import Spread, Truth, random_truth
from selfcal_ros.simulation.physics import encoder_error, line_directions, stage_error
from test.support.truth import (
    angular_deviation,
    differs_by_visit,
    grid_deviation,
    simulate_measurements,
)

PLATE = Artifact(3, 0.1, 4)
SENSES = pytest.mark.parametrize("sense", list(Sense))
UM = 1e-6


def truth_with(**fields):
    """Return a perfect machine, but for some fields of its truth."""
    nothing = np.zeros((2, 3, 3))
    perfect = Truth(
        PLATE, nothing, nothing, np.zeros(4), np.zeros(4), np.zeros(1), np.zeros((1, 2))
    )
    return replace(perfect, **fields)


def measured(truth, sense=Sense.MICROSCOPE_MOVES, *, view=None, **settings):
    """Return the readings of one view in raster order without noise."""
    view = view or View("v")
    how = CellSettings(
        sense,
        **{
            "servo_sigma_m": 0.0,
            "servo_sigma_theta_rad": 0.0,
            "visit_order": "raster",
            **settings,
        },
    )
    plan = Plan("p", truth.artifact, (view,))
    return simulate_measurements(
        truth, plan, np.random.default_rng(1), settings=how
    ).views[0]


def deviation(readings, m, n):
    """Return the mean deviation of a mark, m."""
    (at,) = np.flatnonzero((readings.m == m) & (readings.n == n))
    return [readings.dx[at], readings.dy[at]]


def at(m, n, x, y):
    """Return a field that is 0 but at one site."""
    field = np.zeros((2, 3, 3))
    field[:, m + 1, n + 1] = x, y
    return field


def one_view(x, y):
    return np.array([[x, y]])


QUARTER = View("quarter", pi / 2)
PHI = asin(0.28)
"""A rotation whose cosine is 0.96."""


@SENSES
def test_the_plate_turns_by_a_rotation_about_its_centre(sense):
    truth = truth_with(phi_rad=np.array([PHI]))
    found = measured(truth, sense)
    # (0.1, 0) comes to (0.096, 0.028); (0, 0.1) to (-0.028, 0.096); the centre stays
    assert deviation(found, 1, 0) == pytest.approx([-0.004, 0.028], rel=1e-12)
    assert deviation(found, 0, 1) == pytest.approx([-0.028, -0.004], rel=1e-12)
    assert deviation(found, 0, 0) == [0, 0]
    np.testing.assert_allclose(found.dtheta, PHI, rtol=1e-12)
    # after a quarter turn mark (1, 0) is the one along +y
    turned = measured(truth, sense, view=QUARTER)
    assert deviation(turned, 1, 0) == pytest.approx([-0.028, -0.004], rel=1e-12)
    # a shifted plate turns about its own centre: mark (0, 0), now at (0.1, 0), stays
    shifted = measured(truth, sense, view=View("s", 0.0, (0.1, 0.0)))
    assert deviation(shifted, 0, 0) == pytest.approx([0, 0], abs=1e-16)
    assert deviation(shifted, -1, 0) == pytest.approx([0.004, -0.028], rel=1e-12)


@SENSES
def test_the_papers_plate_does_not_shorten(sense):
    truth = truth_with(phi_rad=np.array([PHI]), a=at(1, 0, 0.01, 0.0), linear=True)
    assert deviation(measured(truth, sense), 1, 0) == pytest.approx([0.01, 0.1 * PHI])
    assert deviation(measured(truth, sense, view=QUARTER), 1, 0) == pytest.approx(
        [-0.1 * PHI, 0.01]
    )


@SENSES
def test_the_plates_error_turns_with_it(sense):
    truth = truth_with(a=at(1, 0, 0.01, 0.0))
    assert deviation(measured(truth, sense), 1, 0) == pytest.approx([0.01, 0])
    assert deviation(measured(truth, sense, view=QUARTER), 1, 0) == pytest.approx(
        [0, 0.01]
    )
    truth = replace(truth, phi_rad=np.array([PHI]))  # 0.11 long: 0.1056, 0.0308
    assert deviation(measured(truth, sense), 1, 0) == pytest.approx(
        [0.0056, 0.0308], rel=1e-12
    )


@SENSES
def test_offsets_are_those_of_the_stage_frame(sense):
    truth = truth_with(t_m=one_view(3 * UM, -4 * UM))
    for view in (View("v"), QUARTER):
        assert deviation(measured(truth, sense, view=view), 1, -1) == pytest.approx(
            [3 * UM, -4 * UM]
        )


def test_the_stage_error_is_indicated_minus_true():
    truth = truth_with(
        g=at(1, 0, 2 * UM, -3 * UM),
        a_theta=np.array([0, 0, 5e-6, 0]),
        g_theta=np.array([1e-6, 2e-6, 3e-6, 5e-6]),
    )
    found = measured(truth)
    assert deviation(found, 1, 0) == pytest.approx([2 * UM, -3 * UM])
    assert deviation(found, -1, 0) == pytest.approx([0, 0], abs=1e-17)
    # mark (0, -1) lies on site (1, 0) after a quarter turn
    assert deviation(measured(truth, view=QUARTER), 0, -1) == pytest.approx(
        [2 * UM, -3 * UM]
    )
    np.testing.assert_allclose(found.dtheta, [1e-6, 2e-6, 8e-6, 5e-6])
    np.testing.assert_allclose(
        measured(truth, view=QUARTER).dtheta, [2e-6, 3e-6, 10e-6, 1e-6]
    )


def test_under_a_fixed_microscope_the_stage_stands_at_minus_the_mark():
    truth = truth_with(
        g=at(1, 0, 2 * UM, -3 * UM), g_theta=np.array([1e-6, 2e-6, 3e-6, 5e-6])
    )
    found = measured(truth, Sense.PLATE_MOVES)
    assert deviation(found, -1, 0) == pytest.approx([-2 * UM, 3 * UM])
    assert deviation(found, 1, 0) == pytest.approx([0, 0], abs=1e-17)
    # line 1 is read with the encoder at minus one line, which is line 3
    np.testing.assert_allclose(found.dtheta, [-1e-6, -5e-6, -3e-6, -2e-6])
    np.testing.assert_allclose(
        measured(truth, Sense.PLATE_MOVES, view=QUARTER).dtheta,
        [-5e-6, -3e-6, -2e-6, -1e-6],
    )


@SENSES
def test_what_is_read_by_a_perfect_cell_is_the_plain_deviation(sense):
    spread = Spread(
        rotation="finite", encoder="independent", plate_scale=1e-5, plate_shape_m=1e-7
    )
    truth = random_truth(PLATE, 2, np.random.default_rng(3), spread)
    view = View("v", pi / 2, (0.1, -0.1))
    plan = Plan("p", PLATE, (View("first"), view))
    found = simulate_measurements(
        truth, plan, np.random.default_rng(1), sense=sense, visits=True
    )
    plain = simulate_measurements(truth, plan, np.random.default_rng(1), sense=sense)
    want = grid_deviation(truth, 1, view, sense=sense)
    readings = found.views[1]
    assert np.isfinite(want).sum() == 2 * len(readings.m) == 8
    for one in (readings, plain.views[1]):
        at = one.m + 1, one.n + 1
        np.testing.assert_allclose([one.dx, one.dy], want[:, *at], rtol=0, atol=1e-16)
        np.testing.assert_allclose(
            one.dtheta,
            angular_deviation(truth, 1, view, sense=sense),
            rtol=0,
            atol=4e-15,
        )


def test_between_sites_the_stage_error_is_bilinear_and_goes_on_straight_outside():
    g = np.zeros((2, 3, 3))
    # sites (0, 0), (0, 1); (1, 0), (1, 1)
    g[0, 1:, 1:] = [[1 * UM, 3 * UM], [5 * UM, 11 * UM]]
    truth = truth_with(g=g)
    places = np.array([[0.0, 0.1, 0.05, 0.025, 0.12], [0.0, 0.1, 0.0, 0.05, 0.0]])
    # 0.12 is a fifth of a pitch beyond (1, 0): 5 + 0.2 (5 - 1)
    want = np.array([1.0, 11.0, 3.0, 2 + 0.25 * (8 - 2), 5.8]) * UM
    np.testing.assert_allclose(stage_error(truth, places)[0], want, rtol=1e-12)
    assert not stage_error(truth, places)[1].any()


def test_between_lines_the_encoder_error_is_linear_and_the_circle_closes():
    truth = truth_with(g_theta=np.array([1e-6, 2e-6, 3e-6, 5e-6]))
    asked = np.array([0.0, 0.5, 3.0, 3.5, -0.25, 7.0]) * pi / 2
    np.testing.assert_allclose(
        encoder_error(truth, asked), [1e-6, 1.5e-6, 5e-6, 3e-6, 2e-6, 5e-6], rtol=1e-9
    )


@SENSES
@pytest.mark.parametrize(("column", "half_way"), [(0, 1 / 2), (1, 1 / 4), (2, 1 / 8)])
def test_the_drift_has_its_size_at_the_last_exposure(sense, column, half_way):
    drift = np.zeros((1, 2, 3))
    drift[0, :, column] = 8 * UM, -16 * UM
    found = measured(truth_with(drift_m=drift), sense)
    assert deviation(found, -1, -1) == pytest.approx([0, 0], abs=1e-16)
    assert deviation(found, 0, 0) == pytest.approx(
        [8 * UM * half_way, -16 * UM * half_way]
    )
    assert deviation(found, 1, 1) == pytest.approx([8 * UM, -16 * UM])
    # it is the plate that moves over the stage, however it was turned
    turned = measured(truth_with(drift_m=drift), sense, view=QUARTER)
    # on the last site
    assert deviation(turned, 1, -1) == pytest.approx([8 * UM, -16 * UM])


@SENSES
def test_a_random_walk_is_followed_step_by_step(sense):
    walk = np.array([[[0.0, 1 * UM, 4 * UM], [0.0, 0.0, -2 * UM]]])
    found = measured(truth_with(walk_m=walk), sense)
    # the third exposure of nine comes after a quarter of the time, the seventh after three
    assert deviation(found, -1, 1) == pytest.approx([0.5 * UM, 0])
    assert deviation(found, 1, -1) == pytest.approx([2.5 * UM, -1 * UM])


@SENSES
def test_the_plate_grows_about_its_centre(sense):
    truth = truth_with(plate_scale=np.array([1e-4]))
    assert deviation(measured(truth, sense), 1, -1) == pytest.approx(
        [10 * UM, -10 * UM]
    )
    assert deviation(measured(truth, sense, view=QUARTER), 1, 0) == pytest.approx(
        [0, 10 * UM]
    )


@SENSES
def test_the_plate_bends_with_the_square_of_the_place(sense):
    # x: 1 u^2 + 2 uv + 4 v^2, y: 8 u^2 + 16 uv + 32 v^2, in um at the edge
    shape = np.array([[[1, 2, 4], [8, 16, 32]]]) * UM
    found = measured(truth_with(plate_shape_m=shape), sense)
    assert deviation(found, 1, 0) == pytest.approx([1 * UM, 8 * UM])
    assert deviation(found, 0, -1) == pytest.approx([4 * UM, 32 * UM])
    assert deviation(found, 1, -1) == pytest.approx([3 * UM, 24 * UM])
    turned = measured(truth_with(plate_shape_m=shape), sense, view=QUARTER)
    assert deviation(turned, 1, 0) == pytest.approx([-8 * UM, 1 * UM])


@SENSES
@pytest.mark.parametrize(
    ("matrix", "seen"),
    [
        (
            [[0.25, 0], [0, 0.25]],
            [800 * UM, 0],
        ),  # a true length is 1.25 of the seen one
        (
            [[0, -0.5], [0.5, 0]],
            [800 * UM, -400 * UM],
        ),  # turned left, it sees things turned right
        ([[0, 0], [0.5, 0]], [1000 * UM, -500 * UM]),
    ],
)
def test_the_microscope_tells_offsets_in_its_own_way(sense, matrix, seen):
    truth = truth_with(t_m=one_view(1000 * UM, 0), microscope=np.array(matrix))
    assert deviation(measured(truth, sense), 0, 0) == pytest.approx(seen, abs=1e-16)
    # what is under the microscope is read as it lies
    followed = measured(truth, sense, follow_mark=True)
    assert deviation(followed, 0, 0) == pytest.approx([1000 * UM, 0], abs=1e-16)


def test_the_parts_of_the_microscopes_matrix():
    np.testing.assert_array_equal(
        Spread(microscope_scale=3.0).microscope, [[3, 0], [0, 3]]
    )
    np.testing.assert_array_equal(
        Spread(microscope_stretch=3.0).microscope, [[3, 0], [0, -3]]
    )
    np.testing.assert_array_equal(
        Spread(microscope_rotation_rad=3.0).microscope, [[0, -3], [3, 0]]
    )
    np.testing.assert_array_equal(
        Spread(microscope_shear=3.0).microscope, [[0, 3], [3, 0]]
    )


def test_backlash_goes_with_the_last_motion_of_each_axis():
    truth = truth_with(backlash_m=np.array([2 * UM, 5 * UM]))
    found = measured(truth)
    # from minus, both
    assert deviation(found, -1, -1) == pytest.approx([2 * UM, 5 * UM])
    assert deviation(found, -1, 0) == pytest.approx([2 * UM, 5 * UM])
    # back to a line's first
    assert deviation(found, 0, -1) == pytest.approx([2 * UM, -5 * UM])
    assert deviation(found, 0, 0) == pytest.approx([2 * UM, 5 * UM])
    back = measured(
        truth, view=View("v", repeats=2), visit_order="there_and_back"
    ).visits
    # the first mark again, from plus in x; y from plus as well
    last = back.stamp_ns.argmax()
    assert (back.dx[last], back.dy[last]) == pytest.approx((-2 * UM, -5 * UM))
    assert (back.approach_x[last], back.approach_y[last]) == (-1, -1)


def test_backlash_of_a_stage_that_carries_the_plate():
    """From mark to mark with rising y the stage goes towards minus: it is read as too far."""
    truth = truth_with(backlash_m=np.array([2 * UM, 5 * UM]))
    found = measured(truth, Sense.PLATE_MOVES)
    # it came from minus
    assert deviation(found, -1, -1) == pytest.approx([-2 * UM, -5 * UM])
    assert deviation(found, -1, 0) == pytest.approx([-2 * UM, 5 * UM])
    assert deviation(found, 0, -1) == pytest.approx([2 * UM, -5 * UM])
    signs = {
        (int(m), int(n)): (int(x), int(y))
        for m, n, x, y in zip(
            found.m,
            found.n,
            found.visits.approach_x,
            found.visits.approach_y,
            strict=True,
        )
    }
    assert [signs[mark] for mark in ((-1, -1), (-1, 0), (0, -1))] == [
        (1, 1),
        (1, -1),
        (-1, 1),
    ]


@SENSES
def test_offsets_come_in_whole_steps(sense):
    truth = truth_with(
        t_m=one_view(2.6 * UM, -1.4 * UM), a_theta=np.array([2.6, -2.6, 0.4, 0])
    )
    found = measured(truth, sense, resolution_xy_m=1 * UM, resolution_theta_rad=1.0)
    assert deviation(found, 1, 0) == pytest.approx([3 * UM, -1 * UM])
    np.testing.assert_allclose(found.dtheta, [3, -3, 0, 0], atol=1e-15)
    assert quantised(np.array([0.3]), 0.0) == [0.3]


@SENSES
def test_where_the_stage_stops_changes_the_offset_and_not_the_reading(sense):
    truth = truth_with(t_m=one_view(30 * UM, 0.0), phi_rad=np.array([1e-4]))
    view = View("v", repeats=40)
    still = measured(truth, sense, view=view)
    found = measured(truth, sense, view=view, stop_sigma_m=50 * UM)
    np.testing.assert_allclose(
        [found.dx, found.dy], [still.dx, still.dy], rtol=0, atol=1e-16
    )
    apart = np.concatenate(
        [
            found.visits.offset_x - still.visits.offset_x,
            found.visits.offset_y - still.visits.offset_y,
        ]
    )
    assert apart.std() == pytest.approx(50 * UM, rel=4 / np.sqrt(2 * len(apart)))


def test_the_stage_error_is_that_of_the_place_where_the_stage_stops():
    slope = 1e-3  # Gx = 1e-3 x: 0.1 um for a stop that is 100 um too far
    g = np.stack([slope * PLATE.x_m, np.zeros((3, 3))])
    for sense, sign in ((Sense.MICROSCOPE_MOVES, 1), (Sense.PLATE_MOVES, -1)):
        visits = measured(truth_with(g=g), sense, stop_sigma_m=100 * UM).visits
        site = PLATE.m.ravel()[visits.mark] * 0.1
        position = sign * (site + visits.dx - visits.offset_x)
        np.testing.assert_allclose(
            visits.dx, sign * slope * position, rtol=0, atol=1e-16
        )
        assert np.abs(visits.dx - slope * site).max() > 0.05 * UM


@SENSES
def test_a_stage_that_follows_the_mark_sees_no_offset(sense):
    truth = truth_with(
        t_m=one_view(30 * UM, -7 * UM),
        phi_rad=np.array([1e-4]),
        a_theta=np.full(4, 5e-6),
        g_theta=np.array([1e-6, 2e-6, 3e-6, 5e-6]),
    )
    found = measured(truth, sense, follow_mark=True)
    assert np.abs([found.visits.offset_x, found.visits.offset_y]).max() < 1e-15
    plain = measured(truth, sense)
    np.testing.assert_allclose(
        [found.dx, found.dy], [plain.dx, plain.dy], rtol=0, atol=1e-15
    )
    # lines: the encoder's error 105 urad from a line differs by less than 1e-9 rad
    np.testing.assert_allclose(found.dtheta, plain.dtheta, rtol=0, atol=1e-9)


def test_noise_of_a_visit_is_shared_by_its_exposures():
    view = View("v", repeats=50)
    found = measured(truth_with(), view=view, visit_xy_m=1 * UM, consecutive=True)
    assert found.visits.sigma_m < 1e-15
    assert found.visits.count.tolist() == [50] * 9
    assert 0.2 * UM < np.std([found.dx, found.dy]) < 2 * UM
    passes = measured(truth_with(), view=view, visit_xy_m=1 * UM)
    assert passes.sigma_xy == pytest.approx(1 * UM, rel=4 / np.sqrt(2 * passes.dof_xy))
    assert (len(passes.visits.mark), passes.visits.dof) == (450, 0)


def test_flicker_has_its_variance_and_falls_with_frequency():
    wave = flicker_noise(np.random.default_rng(1), (4000, 512))
    assert wave.std() == pytest.approx(1, rel=0.02)
    power = (np.abs(np.fft.rfft(wave)) ** 2).mean(axis=0)
    low, high = power[8:16].mean(), power[64:128].mean()
    assert low / high == pytest.approx(8, rel=0.1)
    assert flicker_noise(np.random.default_rng(1), (2, 1)).shape == (2, 1)


def test_flicker_is_slower_than_a_visit():
    view = View("v", repeats=20)
    together = measured(truth_with(), view=view, flicker_xy_m=1 * UM, consecutive=True)
    passes = measured(truth_with(), view=view, flicker_xy_m=1 * UM)
    assert together.sigma_xy < 0.92 * passes.sigma_xy
    assert np.std(together.dx) > 2 * np.std(passes.dx)
    lines = measured(truth_with(), view=view, flicker_theta_rad=1.0)
    assert 0.3 < lines.sigma_theta < 1.5


def test_what_is_drawn_has_the_size_that_is_asked_for():
    spread = Spread(
        rotation="finite",
        plate_scale=1e-6,
        plate_shape_m=3e-8,
        drift_linear_m=1e-7,
        drift_quadratic_m=2e-7,
        drift_cubic_m=4e-7,
        drift_walk_m=5e-8,
        backlash_x_m=1e-8,
        backlash_y_m=-2e-8,
    )
    truth = random_truth(PLATE, 4001, np.random.default_rng(5), spread)
    assert truth.plate_scale[0] == 0 and not truth.plate_shape_m[0].any()
    assert truth.plate_scale.std() == pytest.approx(1e-6, rel=0.05)
    np.testing.assert_allclose(truth.plate_shape_m.std(axis=0), 3e-8, rtol=0.05)
    np.testing.assert_allclose(
        truth.drift_m.std(axis=0), [[1e-7, 2e-7, 4e-7]] * 2, rtol=0.05
    )
    assert not truth.walk_m[:, :, 0].any()
    np.testing.assert_allclose(
        truth.walk_m[:, :, [64, -1]].std(axis=0), [[2.5e-8, 5e-8]] * 2, rtol=0.05
    )
    np.testing.assert_array_equal(truth.backlash_m, [1e-8, -2e-8])
    assert differs_by_visit(truth)


def test_nothing_beyond_the_basic_model_is_drawn_unasked():
    truth = random_truth(PLATE, 4, np.random.default_rng(5))
    assert not differs_by_visit(truth)
    assert not (truth.plate_scale.size or truth.plate_shape_m.size)


def test_a_rotary_encoder_that_owes_nothing_to_the_axes():
    artifact = Artifact(11, 0.01, 24)
    draws = [
        random_truth(artifact, 4, np.random.default_rng(5), Spread(encoder=encoder))
        for encoder in ("independent", "xy_axes")
    ]
    assert abs(draws[0].g_theta.mean()) < 1e-19
    np.testing.assert_array_equal(draws[0].g, draws[1].g)
    moved = draws[0].g_theta - draws[1].g_theta
    # one constant, but on the axes
    assert np.ptp(np.delete(moved, [0, 6, 12, 18])) < 1e-18
    assert np.abs(np.diff(moved[::6])).min() > 1e-6


TURN = asin(0.6)
PLACED = replace(PLATE, map_grid=MapGrid(3, 0.1, Interpolation.BILINEAR))
ASKEW = View("askew", TURN, (0.02, -0.01), angular=False)
"""Mark (1, 0) lies at (0.08, 0.06) + (0.02, -0.01) = (0.1, 0.05), (0, 1) at (-0.04, 0.07)."""


@SENSES
def test_a_plate_lies_at_any_turn_and_shift(sense):
    truth = truth_with(
        artifact=PLACED, a=at(1, 0, 0.001, 0.002), t_m=one_view(3 * UM, -4 * UM)
    )
    found = measured(truth, sense, view=ASKEW)
    # the corners are off the field: (1, 1) at (0.04, 0.13), (-1, 1) at (-0.12, 0)
    assert list(zip(found.m, found.n, strict=True)) == [
        (-1, 0),
        (0, -1),
        (0, 0),
        (0, 1),
        (1, 0),
    ]
    assert deviation(found, 0, 1) == pytest.approx([3 * UM, -4 * UM])
    # 0.8 * 1 - 0.6 * 2, 0.6 * 1 + 0.8 * 2 mm
    assert deviation(found, 1, 0) == pytest.approx([-0.4e-3 + 3 * UM, 2.2e-3 - 4 * UM])
    turned = measured(
        replace(truth, a=at(0, 0, 0, 0), t_m=one_view(0, 0), phi_rad=np.array([PHI])),
        sense,
        view=ASKEW,
    )
    # (0.08, 0.06) comes to (0.06, 0.08): the cosine is 0.96, the sine 0.28
    assert deviation(turned, 1, 0) == pytest.approx([-0.02, 0.02], rel=1e-12)


def test_between_nodes_the_stage_is_off_by_their_means():
    """Mark (1, 0) of the askew plate lies half way between the nodes (0.1, 0) and (0.1, 0.1)."""
    truth = truth_with(
        artifact=PLACED, g=at(1, 0, 2 * UM, -6 * UM) + at(1, 1, 4 * UM, 0.0)
    )
    assert deviation(measured(truth, view=ASKEW), 1, 0) == pytest.approx(
        [3 * UM, -3 * UM]
    )
    # under a fixed microscope the stage stands at (-0.1, -0.05), and the mark is seen less
    assert deviation(
        measured(truth, Sense.PLATE_MOVES, view=ASKEW), 1, 0
    ) == pytest.approx([0, 0], abs=1e-17)
    truth = replace(truth, g=at(-1, -1, 2 * UM, -6 * UM))
    assert deviation(
        measured(truth, Sense.PLATE_MOVES, view=ASKEW), 1, 0
    ) == pytest.approx([-1 * UM, 3 * UM])


@SENSES
def test_without_visits_a_placed_plate_reads_the_same(sense):
    truth = random_truth(
        PLACED, 1, np.random.default_rng(3), Spread(correlation_pitches=2.0)
    )
    found, v = (
        measured(truth, sense, view=ASKEW),
        grid_deviation(truth, 0, ASKEW, sense=sense),
    )
    read = np.isfinite(v[0])
    np.testing.assert_allclose(v[:, read], [found.dx, found.dy], rtol=0, atol=1e-17)


def test_the_rows_of_a_placed_plate_are_visited_one_after_the_other():
    """Of the plate: lines of the stage's sites there are none."""
    visits = visit_sequence(PLACED, ASKEW, order="serpentine")
    assert list(zip(visits.m, visits.n, strict=True)) == [
        (-1, 0),
        (0, 1),
        (0, 0),
        (0, -1),
        (1, 0),
    ]
    np.testing.assert_allclose([visits.i[-1], visits.j[-1]], [1.0, 0.5])
    turned = visit_sequence(
        PLACED, replace(ASKEW, rotation_rad=TURN + pi / 2), order="raster"
    )
    assert (np.diff(turned.m) >= 0).all()


def test_of_a_plate_placed_askew_the_nearest_marks_are_found():
    """It lies 5 mm aside and 0.1 rad further than commanded: no mark moves by half a pitch."""
    truth = truth_with(
        artifact=PLACED, placed=(View("x", TURN + 0.1, (0.025, -0.01), angular=False),)
    )
    visits = grid_exposures(
        truth,
        0,
        ASKEW,
        settings=CellSettings(servo_sigma_m=0.0),
        rng=np.random.default_rng(0),
    )
    np.testing.assert_array_equal(visits.mark, [visits.visits.m, visits.visits.n])
    assert visits.there.all()
    place = truth.placed[0].pose.places(PLACED, *visits.mark) - ASKEW.pose.places(
        PLACED, *visits.mark
    )
    np.testing.assert_allclose(visits.offset, [place.real, place.imag], atol=1e-15)


def test_lines_of_a_plate_that_lies_a_part_of_a_line_off_its_turn():
    """The nearest line is found, and it is off by that part; the plate lies turned too far."""
    artifact = replace(PLATE, harmonics=1)
    commanded, lies = (
        View("x", np.deg2rad(turn), grid=False) for turn in (37.0, 37.0 + 90 + 2)
    )
    truth = truth_with(
        artifact=artifact, a_theta=np.array([1, 2, 3, 4]) * 1e-3, placed=(lies,)
    )
    direction, nominal, line = line_directions(truth, 0, commanded)
    np.testing.assert_array_equal(line, [3, 0, 1, 2])
    np.testing.assert_allclose(np.rad2deg(nominal), [37, 127, 217, 307])
    np.testing.assert_allclose(direction - nominal, np.deg2rad(2) + truth.a_theta[line])
