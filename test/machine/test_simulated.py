# SPDX-License-Identifier: Apache-2.0
"""The simulated machine as visits see it: time, stops, noise of visits, images, lines."""

from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.collection.inputs import Command, Detection, EncoderSample, Phase
from selfcal_ros.machine.cell import AXES, Cell, Settle
from selfcal_ros.machine.clock import SimulatedClock
from selfcal_ros.machine.interface import Placing
from selfcal_ros.machine.simulated import SimulatedMachine
from selfcal_ros.machine.visiting import Photo, Position, Visitor
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.readings import Sense
from selfcal_ros.model.view import Plan, View
from selfcal_ros.simulation.cell import CellSettings, plan_events
from selfcal_ros.simulation.machine import Spread
from selfcal_ros.simulation.rendering import Camera
from selfcal_ros.simulation.spec import Simulation
from test.support.cells import START_NS
from test.support.collecting import collect
from test.support.plans import plan_of

PLATE = Artifact(3, 0.001, 4)
EXACT = CellSettings(servo_sigma_m=0.0, servo_sigma_theta_rad=0.0)
AT_HOME = {"x": 0.0, "y": 0.0, "theta": 0.1}


def visited(
    plan: Plan,
    settings: CellSettings,
    *,
    spread: Spread | None = None,
    begin: Position = AT_HOME,
    **how,
):
    """Return the machine of a plan, and what it tells of each view, reached from `begin`."""
    camera, clock = how.pop("camera", None), SimulatedClock(START_NS)
    machine = SimulatedMachine.of(
        Simulation(plan, 3, spread or Spread(), settings, camera=camera), clock
    )
    cell = Cell(
        "cell",
        "simulated",
        {},
        dict.fromkeys(AXES, (-10.0, 10.0)),
        sense=settings.sense,
        settle=Settle(arrival=np.inf, arrival_theta=np.inf),
    )
    how = {"step_ns": 2_000_000} | how
    visitor, told = Visitor(machine, cell, clock, **how), []
    for index, view in enumerate(plan.views):
        command = Command(0, Phase.PLACE, plan.plan_id, index, view, plan.artifact, 1)
        machine.place(Placing(view.name, 0.0, 0.0, 0.0, command))
        visitor.go(begin)
        told.append(list(visitor.view(plan.artifact, view)))
    return machine, told


def of_kind(kind, events):
    return [event for event in events if isinstance(event, kind)]


@pytest.mark.parametrize(("period_s", "rate_hz"), [(0.01, 500.0), (0.1, 50.0)])
def test_exposures_come_in_their_period_with_samples_at_their_rate(period_s, rate_hz):
    """The stage rests 60 % of the period; two samples before and after an exposure are alike."""
    settings = replace(EXACT, exposure_period_s=period_s, encoder_rate_hz=rate_hz)
    _, [told] = visited(
        Plan("p", PLATE, (View("a", repeats=2),)),
        settings,
        step_ns=round(1e9 / rate_hz),
        of_a_move=0,
    )
    stamps = np.array([event.stamp_ns for event in told])
    assert (np.diff(stamps) > 0).all()
    exposed = np.array([event.stamp_ns for event in of_kind(Detection, told)])
    np.testing.assert_allclose(np.diff(exposed), period_s * 1e9, rtol=2e-3)
    samples = of_kind(EncoderSample, told)
    at = np.array([sample.stamp_ns for sample in samples])
    assert np.diff(at).max() <= 1e9 / rate_hz
    assert np.diff(at).mean() > 0.7e9 / rate_hz
    places = np.array([sample.positions for sample in samples])
    for index in np.searchsorted(at, exposed):
        assert (places[index - 2 : index + 2] == places[index]).all()


def test_all_repeats_of_a_mark_one_after_another_are_one_visit():
    """What a visit shares is the same in its exposures; the stage stays where it stopped."""
    settings = replace(EXACT, stop_sigma_m=3e-6, visit_xy_m=1e-7)
    view = View("a", repeats=3, angular=False)
    _, [told] = visited(Plan("p", PLATE, (view,)), settings, consecutive=True)
    seen = of_kind(Detection, told)
    marks = [(item.m, item.n) for item in seen]
    assert marks == [mark for mark in dict.fromkeys(marks) for _ in range(3)]
    offsets = np.array([(item.offset_x, item.offset_y) for item in seen]).reshape(
        9, 3, 2
    )
    assert (offsets == offsets[:, :1]).all()
    assert len(np.unique(offsets[:, 0], axis=0)) == 9


@pytest.mark.parametrize("sense", list(Sense))
def test_a_stage_that_follows_its_marks_has_them_on_the_axis(sense):
    """But for the check stops, which are as far aside as commanded."""
    settings = replace(EXACT, sense=sense, follow_mark=True)
    view = View("a", np.pi / 2, check_marks=2, check_offset_m=2e-5)
    spread = Spread(t_m=1e-4, phi_rad=1e-2)
    for follows in (True, False):
        _, [told] = visited(
            Plan("p", PLATE, (view,)),
            replace(settings, follow_mark=follows),
            spread=spread,
        )
        seen = of_kind(Detection, told)
        away = np.array(
            [np.hypot(item.offset_x, item.offset_y) for item in seen if not item.kind]
        )
        angle = np.array([item.offset_theta for item in seen if item.kind])
        if follows:
            aside = np.repeat([0.0, 2e-5, 0.0], [9, 8, 0])
            np.testing.assert_allclose(away, aside, atol=3e-8)
            np.testing.assert_allclose(angle, 0, atol=1e-6)
        else:
            assert away.max() > 5e-5
            assert np.abs(angle).min() > 5e-5


def test_encoder_noise_is_that_of_an_exposure_and_moves_nothing():
    settings = replace(EXACT, encoder_sigma_m=1e-7)
    view = View("a", repeats=40, angular=False)
    machine, [told] = visited(
        Plan("p", PLATE, (view,)), settings, spread=Spread(t_m=0.0)
    )
    seen = of_kind(Detection, told)
    marks = np.array([item.m * 10 + item.n for item in seen])
    offsets = np.array([item.offset_x for item in seen])
    assert all(np.ptp(offsets[marks == mark]) < 1e-15 for mark in marks)
    samples = of_kind(EncoderSample, told)
    at = np.searchsorted(
        [sample.stamp_ns for sample in samples], [item.stamp_ns for item in seen]
    )
    read = np.array([samples[index].positions[0] for index in at]) - marks // 10 * 0.001
    assert np.std([x - round(x, 3) for x in read]) == pytest.approx(1e-7, rel=0.1)
    assert machine.position() == machine.position()


NEAR = Spread(t_m=5e-6)
"""Marks whole in the image."""


def test_a_camera_shows_marks_in_images_and_lines_by_an_own_sensor():
    camera = Camera(pixel_size_m=2e-6, mark_size_m=50e-6)
    plan = Plan("p", PLATE, (View("a", repeats=2),))
    _, [told] = visited(plan, EXACT, spread=NEAR, camera=camera, detects=False)
    shown = [type(event) for event in told if not isinstance(event, EncoderSample)]
    assert shown == [Photo] * 18 + [Detection] * 8
    assert all(event.kind for event in of_kind(Detection, told))
    dark = of_kind(Photo, told)[0].pixels
    v, u = np.argwhere(dark < 120).T
    offset = np.array([u.mean() - 47.5, 47.5 - v.mean()]) * 2e-6
    _, [told] = visited(plan, EXACT, spread=NEAR)
    first = of_kind(Detection, told)[0]
    np.testing.assert_allclose(offset, [first.offset_x, first.offset_y], atol=5e-7)


SPREAD = Spread(
    microscope_scale=5e-3,
    microscope_rotation_rad=2e-3,
    microscope_axes="y-x",
    line_factor=-1.0,
    microscope_distortion=1e-3,
    optical_tilt_x_rad=5e-3,
    backlash_x_m=4e-8,
    backlash_y_m=-3e-8,
    backlash_growth_m=3e-8,
    settling_m=1e-8,
    stage_bend_m=1e-8,
    stage_yaw_rad=1e-5,
    plate_scale=1e-6,
    plate_shape_m=3e-8,
    plate_strain=1e-6,
    plate_tilt_rad=1e-3,
    plate_bow_m=5e-6,
    line_eccentricity_rad=1e-5,
    drift_linear_m=1e-7,
    drift_walk_m=1e-7,
)


@pytest.mark.parametrize("sense", list(Sense))
@pytest.mark.parametrize(
    "how", [{}, {"consecutive": True}, {"follow_mark": True}], ids=str
)
def test_a_visited_machine_reads_as_its_bag_without_noise(how, sense):
    """The stage comes to each view from below, as that of a bag does."""
    plan = plan_of("0, 90, -tx", 5, size_y=3, count=8, line=True, repeats=3)
    plan = replace(
        plan,
        views=tuple(
            replace(view, check_marks=2 * view.grid, check_offset_m=2e-5 * view.grid)
            for view in plan.views
        ),
    )
    settings = replace(EXACT, sense=sense, **how)
    machine, told = visited(
        plan,
        settings,
        spread=SPREAD,
        consecutive=settings.consecutive,
        begin={"x": -0.5, "y": -0.5, "theta": 0.1},
    )
    bag = plan_events(
        machine.truth,
        plan,
        settings=settings,
        rng=np.random.default_rng(4),
        start_ns=START_NS,
    )
    offline, _ = collect(bag, measurement_sense=str(sense), outlier_limit=0.0)
    live = []
    for index, events in enumerate(told):
        live.append(
            Command(
                events[0].stamp_ns - 1,
                Phase.MEASURE,
                plan.plan_id,
                index,
                plan.views[index],
                plan.artifact,
                len(plan.views),
            )
        )
        live += events
    found, _ = collect(live, measurement_sense=str(sense), outlier_limit=0.0)
    for one, other in zip(offline.views, found.views, strict=True):
        assert (one.view, one.used) == (other.view, other.used)
        for name in ("m", "n", "count", "k", "count_theta"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
        np.testing.assert_allclose([one.dx, one.dy], [other.dx, other.dy], atol=2e-15)
        np.testing.assert_allclose(one.dtheta, other.dtheta, atol=4e-15)
        if one.view.grid:
            for name in ("approach_x", "approach_y"):
                np.testing.assert_array_equal(
                    getattr(one.visits, name), getattr(other.visits, name)
                )
