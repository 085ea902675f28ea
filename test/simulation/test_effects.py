# SPDX-License-Identifier: Apache-2.0
"""What real machines do beside the model, against numbers worked out by hand, in both senses.

The plate of `test_physics`: 3 x 3 marks 0.1 m apart and 4 lines; all is 0 but what the test sets.
Simulator and estimator share where a view puts a mark (`View.lattice_pose`), the visiting orders
and the modes of the datum, and nothing else: these are compared with hand-worked places here and
in test/model.
"""

from math import cos, pi, sin

import numpy as np
import pytest

from selfcal_ros.collection.inputs import Detection, Kind
from selfcal_ros.model.pose import ImageCells
from selfcal_ros.model.readings import Sense
from selfcal_ros.model.view import Plan, View
from selfcal_ros.simulation import physics
from selfcal_ros.simulation.cell import CellSettings, plan_events
from selfcal_ros.simulation.machine import AXES, Spread, random_truth
from selfcal_ros.simulation.rendering import Camera, Exposure, exposures
from test.simulation.test_physics import (
    PLATE,
    QUARTER,
    SENSES,
    UM,
    at,
    deviation,
    measured,
    one_view,
    truth_with,
)
from test.support.collecting import START_NS, collect


@SENSES
@pytest.mark.parametrize(
    ("axes", "told"),
    [
        ("xy", (30, 7)),
        ("-x-y", (-30, -7)),
        ("-xy", (-30, 7)),
        ("x-y", (30, -7)),
        ("yx", (7, 30)),
        ("-y-x", (-7, -30)),
        ("y-x", (7, -30)),
        ("-yx", (-7, 30)),
    ],
)
def test_axes_of_the_microscope_point_elsewhere(sense, axes, told):
    wiring = Spread(microscope_axes=axes, microscope_pixels=2.0).wiring
    found = measured(truth_with(t_m=one_view(30 * UM, 7 * UM), wiring=wiring), sense)
    assert deviation(found, 1, -1) == pytest.approx(2 * UM * np.array(told))
    assert set(AXES) >= {axes} and len(AXES) == 8


@SENSES
def test_lines_are_told_with_another_sign(sense):
    truth = truth_with(phi_rad=np.array([3e-5]), line_factor=-1.0)
    np.testing.assert_allclose(measured(truth, sense).dtheta, -3e-5, rtol=1e-10)
    # what the encoder says is as it is: only offsets are told wrongly
    stops = measured(truth_with(line_factor=-1.0), sense, servo_sigma_theta_rad=1e-6)
    still = measured(truth_with(), sense, servo_sigma_theta_rad=1e-6)
    np.testing.assert_allclose(still.dtheta, 0, atol=1e-15)
    assert np.abs(stops.dtheta).max() > 1e-6


@SENSES
def test_a_camera_distorts_with_the_cube_of_the_offset(sense):
    # 300, 400 um: half a millimetre from the axis, 1 % too long at 0.25 mm: 4 % there
    truth = truth_with(
        t_m=one_view(300 * UM, -400 * UM), distortion=0.01 / (250 * UM) ** 2
    )
    assert deviation(measured(truth, sense), 0, 0) == pytest.approx(
        [312 * UM, -416 * UM]
    )
    drawn = random_truth(
        PLATE, 1, np.random.default_rng(1), Spread(microscope_distortion=0.01)
    )
    assert drawn.distortion == truth.distortion


@SENSES
def test_a_tilted_plate_is_shorter_across_the_axis_of_its_tilt(sense):
    tilt = 0.01  # about stage y: what lies along x is shorter by 5e-5, and +x goes down
    truth = truth_with(plate_tilt_rad=one_view(0.0, tilt))
    found = measured(truth, sense)
    assert deviation(found, 1, 1) == pytest.approx(
        [0.1 * (cos(tilt) - 1), 0], abs=1e-15
    )
    # the axis is the stage's: a plate turned by 90 deg is shorter along stage x all the same
    turned = measured(truth, sense, view=QUARTER)
    assert deviation(turned, 0, -1) == pytest.approx(
        [0.1 * (cos(tilt) - 1), 0], abs=1e-15
    )


@SENSES
def test_height_moves_a_mark_under_a_tilted_optical_axis(sense):
    lean = np.array([0.02, 0.05])
    tilted = truth_with(plate_tilt_rad=one_view(0.01, 0.0), optical_tilt_rad=lean)
    # about stage x: +y rises by 0.1 sin 0.01
    assert deviation(measured(tilted, sense), 0, 1) == pytest.approx(
        [0.02 * 0.1 * sin(0.01), 0.1 * (cos(0.01) - 1) + 0.05 * 0.1 * sin(0.01)],
        rel=1e-9,
    )
    bowed = truth_with(plate_bow_m=10 * UM, optical_tilt_rad=lean)
    found = measured(bowed, sense)
    assert deviation(found, 0, 0) == pytest.approx([0.2 * UM, 0.5 * UM])
    assert deviation(found, 0, 1) == pytest.approx([0, 0], abs=1e-16)
    assert deviation(found, -1, 1) == pytest.approx([-0.2 * UM, -0.5 * UM])
    # bow and tilt together: the centre, 10 um high, goes towards +x when +x goes down
    both = truth_with(plate_bow_m=10 * UM, plate_tilt_rad=one_view(0.0, 0.01))
    assert deviation(measured(both, sense), 0, 0) == pytest.approx(
        [0.1 * UM, 0], rel=1e-4
    )


@SENSES
def test_a_plate_is_strained_along_its_own_axes(sense):
    truth = truth_with(plate_strain=np.array([[[1e-5, 2e-5], [2e-5, -4e-5]]]))
    found = measured(truth, sense)
    assert deviation(found, 1, 0) == pytest.approx([1 * UM, 2 * UM])
    assert deviation(found, 0, 1) == pytest.approx([2 * UM, -4 * UM])
    assert deviation(measured(truth, sense, view=QUARTER), 1, 0) == pytest.approx(
        [-2 * UM, 1 * UM]
    )


def test_a_stage_bends_where_it_stands_whatever_lies_on_it():
    # x: 1 u^2 + 2 uv + 4 v^2, y: 8 u^2 + 16 uv + 32 v^2, in um at the edge
    truth = truth_with(stage_bend_m=np.array([[[1, 2, 4], [8, 16, 32]]]) * UM)
    # both on site (1, -1)
    for view, mark in ((View("v"), (1, -1)), (QUARTER, (-1, -1))):
        assert deviation(measured(truth, view=view), *mark) == pytest.approx(
            [3 * UM, 24 * UM]
        )
        carried = measured(truth, Sense.PLATE_MOVES, view=view)
        assert deviation(carried, *mark) == pytest.approx([-3 * UM, -24 * UM])
    assert deviation(measured(truth), 1, 0) == pytest.approx([1 * UM, 8 * UM])


def test_a_stage_turns_what_it_carries():
    """Counter-clockwise: the image the other way, or the plate below it."""
    truth = truth_with(yaw=np.full(PLATE.shape, 1e-3))
    here, arm = np.zeros((2, 1)), np.array([[2e-4], [0.0]])
    for sense, y in ((Sense.MICROSCOPE_MOVES, -2e-7), (Sense.PLATE_MOVES, 2e-7)):
        seen = physics.offset_seen(truth, sense, here, here, arm)
        np.testing.assert_allclose(seen[:, 0], [2e-4 * np.cos(1e-3), y], rtol=1e-6)


def test_it_turns_as_at_its_place():
    yaw = np.zeros(PLATE.shape)
    yaw[PLATE.half[0] + 1, PLATE.half[1]] = 1e-3
    truth, pitch = truth_with(yaw=yaw), PLATE.grid_pitch_m
    arm = np.array([[0.0], [2e-4]])
    for x, part in ((pitch, 1.0), (0.5 * pitch, 0.5), (-pitch, 0.0)):
        seen = physics.offset_seen(
            truth, Sense.PLATE_MOVES, np.array([[x], [0.0]]), np.zeros((2, 1)), arm
        )
        assert seen[0, 0] == pytest.approx(-2e-7 * part, rel=1e-6, abs=1e-15)


@pytest.mark.parametrize("sense", Sense)
def test_marks_that_no_cell_is_declared_for_turn_like_the_others(sense):
    """Rendered around the one that is read, as if the plan had images of 3 x 3 marks."""
    truth = truth_with(yaw=np.linspace(-2e-3, 2e-3, PLATE.m.size).reshape(PLATE.shape))
    settings = CellSettings(sense, servo_sigma_m=0.0, stop_sigma_m=0.0, with_ids=True)
    camera = Camera(width=300, height=300, pixel_size_m=1e-3, mark_size_m=2e-2)
    found = []
    for image in (None, ImageCells(3, 3, PLATE.grid_pitch_m)):
        plan = Plan("yaw", PLATE, (View("v", angular=False, image=image),))
        events = plan_events(
            truth, plan, settings=settings, rng=np.random.default_rng(1), start_ns=0
        )
        found.append(
            [
                one.offsets
                for one in exposures(truth, plan, camera, events, sense=sense)
                if isinstance(one, Exposure)
            ]
        )
    assert len(found[0]) == len(found[1]) == PLATE.m.size
    turned = 0.0
    for alone, together in zip(*found, strict=True):
        np.testing.assert_allclose(alone, together, rtol=0, atol=1e-9)
        turned = max(turned, np.abs(together - np.round(together / 0.1) * 0.1).max())
    assert turned > 1e-4


def test_each_view_has_its_own_bend():
    bends = np.zeros((2, 2, 3))
    bends[1, 0, 0] = 5 * UM
    truth = truth_with(stage_bend_m=bends, phi_rad=np.zeros(2), t_m=np.zeros((2, 2)))
    plan = Plan("p", PLATE, (View("a"), View("b")))
    events = plan_events(
        truth,
        plan,
        settings=CellSettings(servo_sigma_m=0.0),
        rng=np.random.default_rng(1),
        start_ns=START_NS,
    )
    first, second = collect(events, outlier_limit=0.0)[0].views
    assert np.abs(first.dx).max() < 1e-15
    assert deviation(second, -1, 1) == pytest.approx([5 * UM, 0], abs=1e-15)


@SENSES
def test_backlash_grows_while_a_view_is_measured(sense):
    sign = 1 if sense is Sense.MICROSCOPE_MOVES else -1
    view = View("v", repeats=2)
    found = measured(
        truth_with(backlash_growth_m=17 * UM),
        sense,
        view=view,
        visit_order="there_and_back",
    ).visits
    order = np.argsort(found.stamp_ns)
    # 18 exposures, of which the two in the middle are one visit: 8.5 um, from plus along x
    first, middle, last = order[0], order[8], order[-1]
    assert found.dx[first] == pytest.approx(0, abs=1e-16)
    assert found.dx[middle] == pytest.approx(8.5 * UM)
    assert found.dx[last] == pytest.approx(-17 * UM)
    assert found.approach_x[middle] == sign and found.approach_x[last] == -sign


@SENSES
def test_an_axis_that_moved_settles_while_it_rests(sense):
    sign = 1 if sense is Sense.MICROSCOPE_MOVES else -1
    truth = truth_with(settling_m=8 * UM, settling_time_s=0.01 / np.log(2))
    found = measured(truth, sense, view=View("v", repeats=2), consecutive=True)
    # 8 um at the first exposure, 4 um a period later; along y, then along x and back in y
    assert deviation(found, -1, 0) == pytest.approx([0, 6 * UM])
    assert deviation(found, 0, -1) == pytest.approx([6 * UM, -6 * UM])
    first = deviation(found, -1, -1)  # it came from minus, in both
    assert first == pytest.approx([sign * 6 * UM] * 2)


@SENSES
def test_a_circle_off_the_axis_is_seen_at_another_angle(sense):
    """From the axis, a centre along +y moves lines along +x on and those along -x back."""
    found = measured(truth_with(line_eccentricity_rad=one_view(0.0, 1e-5)), sense)
    np.testing.assert_allclose(found.dtheta, [1e-5, 0, -1e-5, 0], atol=2e-10)
    along = measured(truth_with(line_eccentricity_rad=one_view(1e-5, 0.0)), sense)
    np.testing.assert_allclose(along.dtheta, [0, -1e-5, 0, 1e-5], atol=2e-10)
    # exactly: a line along +x of a circle one radius off along +y stands at 45 deg
    far = measured(truth_with(line_eccentricity_rad=one_view(0.0, 1.0)), sense)
    assert far.dtheta[0] == pytest.approx(pi / 4)


def test_noise_of_y_is_its_own():
    found = measured(
        truth_with(), view=View("v", repeats=400), sigma_xy_m=4 * UM, noise_ratio=0.25
    ).visits
    assert found.dx.std() == pytest.approx(4 * UM, rel=0.05)
    assert found.dy.std() == pytest.approx(1 * UM, rel=0.05)


@SENSES
def test_servo_scatter_is_motion_and_noise_of_the_encoder_is_none(sense):
    sign = 1 if sense is Sense.MICROSCOPE_MOVES else -1
    truth = truth_with(t_m=one_view(30 * UM, 0.0))
    view = View("v", repeats=400)
    moves = measured(truth, sense, view=view, servo_sigma_m=1 * UM).visits
    # offset and position cancel
    np.testing.assert_allclose(moves.dx, 30 * UM, rtol=1e-9)
    assert moves.offset_x.std() == pytest.approx(1 * UM, rel=0.05)
    reads = measured(truth, sense, view=view, encoder_sigma_m=1 * UM).visits
    assert np.ptp(reads.offset_x) < 1e-15
    assert (sign * reads.dx).std() == pytest.approx(1 * UM, rel=0.05)
    lines = measured(truth, sense, view=view, encoder_sigma_theta_rad=1e-6)
    assert lines.sigma_theta == pytest.approx(1e-6, rel=0.05)


@SENSES
@pytest.mark.parametrize(
    ("turn", "mark", "error", "line"),
    [
        (0.0, (0, 1), (2, 5), 1),
        (-pi / 2, (-1, 0), (5, -2), 2),
        (pi, (0, -1), (-2, -5), 3),
    ],
)
def test_a_plate_that_lies_otherwise_shows_another_mark(sense, turn, mark, error, line):
    """A quarter turn is commanded: mark (1, 0) is expected on site (0, 1), line 0 along +y."""
    truth = truth_with(
        a=at(*mark, 2 * UM, 5 * UM),
        placed=(View("v", turn),),
        a_theta=np.array([0, 1e-5, 2e-5, 3e-5]),
    )
    found = measured(truth, sense, view=QUARTER)
    assert deviation(found, 1, 0) == pytest.approx(UM * np.array(error))
    assert np.count_nonzero(np.abs(found.dx) > 1e-12) == 1
    assert found.dtheta[0] == pytest.approx(line * 1e-5)


@SENSES
def test_where_the_plate_has_no_mark_none_is_read(sense):
    lies = View("v", 0.0, (-0.1, 0.0))
    truth = truth_with(placed=(lies,), a=at(0, 0, 3 * UM, 0))
    found = measured(truth, sense, view=View("v", 0.0, (0.1, 0.0)))
    # marks -1 and 0 are expected on sites 0 and 1 of x; site 0 has mark 1, site 1 has none
    assert sorted(set(found.m.tolist())) == [-1]
    assert len(found.m) == 3 and found.visits.mark.tolist() == [0, 1, 2]
    assert deviation(found, -1, 0) == pytest.approx([0, 0], abs=1e-16)
    moved = truth_with(placed=(lies,), a=at(1, 0, 3 * UM, 0))
    assert deviation(
        measured(moved, sense, view=View("v", 0.0, (0.1, 0.0))), -1, 0
    ) == pytest.approx([3 * UM, 0], abs=1e-16)


def test_detections_name_the_mark_that_lies_there():
    plan = Plan("p", PLATE, (QUARTER,))
    truth = truth_with(placed=(View("v"),))
    events = plan_events(
        truth,
        plan,
        settings=CellSettings(),
        rng=np.random.default_rng(1),
        start_ns=START_NS,
    )
    seen = [event for event in events if isinstance(event, Detection)]
    # the stage goes along the sites line by line from (-1, -1): so do the marks that lie there
    assert [(d.m, d.n) for d in seen[:4]] == [(-1, -1), (-1, 0), (-1, 1), (0, 1)]
    # line 0 is expected a quarter on, where line 1 lies
    assert [d.k for d in seen if d.kind == Kind.ANGULAR] == [1, 2, 3, 0]


def test_views_share_what_pins_make_of_them():
    spread = Spread(phi_rad=0.0, t_m=0.0, phi_common_rad=1e-3, t_common_m=50 * UM)
    draws = [
        random_truth(PLATE, 3, np.random.default_rng(seed), spread)
        for seed in range(400)
    ]
    assert all(
        np.ptp(one.phi_rad) == 0 and not np.ptp(one.t_m, axis=0).any() for one in draws
    )
    assert np.std([one.phi_rad[0] for one in draws]) == pytest.approx(1e-3, rel=0.1)
    assert np.std([one.t_m[0] for one in draws]) == pytest.approx(50 * UM, rel=0.1)


def test_a_wrong_pitch_is_an_error_of_the_plate():
    plain, wrong = (
        random_truth(PLATE, 1, np.random.default_rng(3), Spread(pitch_error=size))
        for size in (0.0, 8e-4)
    )
    np.testing.assert_allclose(
        wrong.a[:, 2, 0] - plain.a[:, 2, 0], [8e-5, -8e-5], rtol=1e-9
    )
    np.testing.assert_array_equal(wrong.g, plain.g)


def test_effects_of_views_are_drawn_with_their_sizes():
    spread = Spread(
        plate_strain=1e-6,
        plate_tilt_rad=1e-3,
        stage_bend_m=1e-8,
        line_eccentricity_rad=1.5e-5,
    )
    truth = random_truth(PLATE, 4001, np.random.default_rng(5), spread)
    assert not truth.plate_strain[0].any()
    np.testing.assert_array_equal(
        truth.plate_strain, truth.plate_strain.transpose(0, 2, 1)
    )
    for values, size in (
        (truth.plate_strain, 1e-6),
        (truth.plate_tilt_rad, 1e-3),
        (truth.stage_bend_m, 1e-8),
        (truth.line_eccentricity_rad, 1.5e-5),
    ):
        np.testing.assert_allclose(values.std(axis=0), size, rtol=0.05)


def test_one_machine_is_measured_twice():
    spread = Spread(drift_linear_m=1e-7, plate_scale=1e-6)
    one, other = (
        random_truth(
            PLATE,
            3,
            np.random.default_rng(1),
            spread,
            placing=np.random.default_rng(seed),
        )
        for seed in (2, 3)
    )
    for name in ("g", "a", "g_theta", "a_theta"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    for name in ("phi_rad", "t_m", "drift_m", "plate_scale"):
        assert not np.array_equal(getattr(one, name), getattr(other, name))
