# SPDX-License-Identifier: Apache-2.0
"""Check stops through the collector: extra readings, none an outlier, and never a repeat."""

from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.collection.collector import view_progress
from selfcal_ros.collection.inputs import Command, Detection, EncoderSample
from selfcal_ros.collection.marks.stops import stage_aside, without_aside
from selfcal_ros.model.artifact import MapGrid
from selfcal_ros.model.readings import Sense
from selfcal_ros.model.view import View
from selfcal_ros.simulation.cell import CellSettings, plan_events
from test.support.collecting import START_NS, Scene, collect, gathered
from test.support.plans import plan_of
from test.support.truth import random_truth

OFFSET = 20e-6
NOISE = 20e-9
ORDINARY = 25
MARKS = 5
PLACED = 37
FIRST = 2 * ORDINARY  # check stop: after two of three repeats


def checked(*, repeats=3, microscope=((0, 0), (0, 0)), turn=0, **settings):
    """Return the scene of one view of 25 marks, 5 of them checked."""
    plan = plan_of("90" if turn else "0", 5, repeats=repeats)
    if turn == PLACED:  # the map reaches beyond the corners of the plate
        plate = replace(plan.artifact, map_grid=MapGrid(5, 0.02))
        plan = replace(plan, artifact=plate, views=(View("37", np.deg2rad(37), repeats=repeats),))
    view = replace(plan.views[0], check_marks=MARKS, check_offset_m=OFFSET)
    plan, rng = replace(plan, views=(view,)), np.random.default_rng(4)
    truth = random_truth(plan.artifact, 1, rng)
    truth = replace(truth, microscope=np.array(microscope, dtype=float))
    how = CellSettings(**({"sigma_xy_m": NOISE} | settings))
    events = list(plan_events(truth, plan, settings=how, rng=rng, start_ns=START_NS))
    return Scene(plan, truth, *([event for event in events if isinstance(event, kind)]
                                for kind in (Command, EncoderSample, Detection)))


def progress_of(scene, **parameters):
    measurements, progress = collect(scene.events, **parameters)
    return measurements.views[0], progress[0]


@pytest.mark.parametrize("sense", list(Sense))
@pytest.mark.parametrize("turn", [0, 1, PLACED])
def test_check_stops_are_visits_with_the_opposite_offset(sense, turn):
    scene = checked(sense=sense, turn=turn, with_ids=False)
    readings, progress = progress_of(scene, measurement_sense=str(sense))
    assert readings.rejected == {}
    assert (progress.complete, progress.check_done, progress.needed) == (True, MARKS, 0)
    visits = readings.visits
    last = np.argsort(visits.stamp_ns)[FIRST:FIRST + 4 * MARKS]
    assert visits.count[last].tolist() == [1] * 4 * MARKS
    mark = visits.mark[last].reshape(4, MARKS)
    assert (mark == mark[0]).all()
    usual = np.stack([np.median(row.reshape(-1)[visits.mark == k]) for k in mark[0]
                      for row in (visits.offset_x, visits.offset_y)]).reshape(MARKS, 2)
    seen = np.stack([visits.offset_x, visits.offset_y], axis=1)[last].reshape(4, MARKS, 2)
    # the microscope stops at +x of the mark and sees it at -x; the plate at +x carries it to +x
    sign = 1 if sense is Sense.PLATE_MOVES else -1
    want = sign * OFFSET * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])[:, None]
    np.testing.assert_allclose(seen - usual, np.broadcast_to(want, seen.shape), atol=3e-7)


@pytest.mark.parametrize("microscope", [
    ((0.01, -0.003), (0.007, 0.01)), ((-2, 0), (0, -2)), ((-0.5, 0), (0, -0.5)),
    ((1, 0), (0, 1)), ((-1, 1), (1, -1))],
    ids=["scale and turn", "other sign", "pixels doubled", "pixels halved", "axes exchanged"])
def test_no_microscope_makes_outliers_or_noise_of_check_stops(microscope):
    readings, progress = progress_of(checked(microscope=microscope, servo_sigma_m=0.0))
    assert readings.rejected == {}
    assert progress.complete
    assert readings.sigma_xy == pytest.approx(NOISE, rel=4 / np.sqrt(2 * readings.dof_xy))
    assert readings.dof_xy == 2 * (readings.used - ORDINARY) - 4  # two numbers an axis are fitted


def test_an_outlier_among_check_stops_is_one_and_leaves_the_mark_unchecked():
    scene = checked(microscope=((0.01, 0), (0, 0.01)))
    index = scene.grid(FIRST + 7)
    scene.spoil(index, offset_x=scene.detections[index].offset_x + 2e-6)
    readings, progress = progress_of(scene)
    assert readings.rejected == {"outlier_among_repeats": 1}
    assert (progress.complete, progress.check_done, progress.grid_done) == (False, 4, 25)
    assert progress.coverage == 29 / 30


def test_check_stops_are_no_repeats():
    """A mark with four check stops and one repeat too few is missing, named, and not done."""
    scene = checked()
    mark = scene.detections[FIRST]
    lost = next(d for d in scene.detections if (d.m, d.n) == (mark.m, mark.n))
    scene.detections.remove(lost)
    readings, progress = progress_of(scene)
    at = (readings.m == mark.m) & (readings.n == mark.n)
    assert readings.count[at].tolist() == [2 + 4]
    assert (progress.grid_done, progress.check_done, progress.complete) == (24, MARKS, False)
    assert (progress.missing.m, progress.missing.n) == ((mark.m,), (mark.n,))
    assert progress.needed == 1
    assert collect([*scene.events, lost])[1][0].complete


@pytest.mark.parametrize("lost", range(4))
def test_a_mark_that_lacks_one_side_is_not_checked(lost):
    scene = checked()
    scene.detections.pop(FIRST + lost * MARKS)
    _, progress = progress_of(scene)
    assert (progress.grid_done, progress.check_done, progress.complete) == (25, 4, False)


def test_the_order_of_arrival_changes_nothing_on_the_way():
    scene = checked(repeats=1)
    rng, seen = np.random.default_rng(2), set()
    for _ in range(4):
        rng.shuffle(scene.detections)
        collector = gathered([*scene.commands, *scene.samples])
        for number, detection in enumerate(scene.detections):
            collector.add_detection(detection)
            if number % 9 == 0:
                seen.add(collector.collect()[1][0].complete)
        assert collector.collect()[1][0].complete
    assert seen == {False}


def test_a_view_without_check_stops_asks_for_none_and_one_with_them_waits():
    scene = checked()
    del scene.detections[FIRST:FIRST + 4 * MARKS]
    readings, progress = progress_of(scene)
    assert (progress.grid_done, progress.check_done, progress.complete) == (25, 0, False)
    assert progress.needed == MARKS
    timeline = gathered([replace(c, view=c.view and replace(
        c.view, check_marks=0, check_offset_m=0.0)) for c in scene.commands]).timeline
    assert view_progress(timeline, 0, readings).complete


def test_stops_that_scatter_like_check_stops_ask_for_none():
    """Nobody can count there, and the scatter itself shows the microscope."""
    scene = checked(stop_sigma_m=10e-6)
    del scene.detections[FIRST:FIRST + 4 * MARKS]
    _, progress = progress_of(scene)
    assert (progress.complete, progress.check_done) == (True, MARKS)


def test_a_check_stop_may_be_further_off_than_the_stage_limit():
    assert progress_of(checked(), max_stage_distance=1e-5)[1].complete
    scene = checked(stop_sigma_m=2e-4)  # ordinary stops may not
    assert "stage_not_at_mark" in progress_of(scene, max_stage_distance=1e-5)[0].rejected


def test_which_stops_are_aside():
    key = np.array([0, 0, 0, 0, 0, 1, 1, 2])
    place = np.array([[0, 20, -20, 0, 0, 3, 3, 20], [0, 0, 0, 20, -20, 4, 4, 20]]) * 1e-6
    aside = stage_aside(key, place, OFFSET)
    np.testing.assert_allclose(aside, np.array([[0, 20, -20, 0, 0, 0, 0, 0],
                                                [0, 0, 0, 20, -20, 0, 0, 0]]) * 1e-6)
    assert not stage_aside(key[:0], place[:, :0], OFFSET).any()
    assert not stage_aside(key, place / 2.5, OFFSET).any()  # too near
    assert not stage_aside(key, place * 1.6, OFFSET).any()  # too far
    both = place.copy()
    both[1, 1] = 20e-6  # along both axes: no check stop of either
    assert not stage_aside(key, both, OFFSET)[:, 1].any()
    assert stage_aside(np.zeros(6, int), np.tile(np.arange(6) * 5e-6, (2, 1)), OFFSET) is None


def test_what_is_taken_off_is_exactly_what_the_stops_show():
    key = np.repeat([0, 1], 5)
    place = np.tile(np.array([[0, 20, -20, 0, 0], [0, 0, 0, 20, -20]]) * 1e-6, 2)
    response = np.array([[0.01, -0.2], [0.03, 2.0]])
    base = np.array([[1e-6, -2e-6], [3e-6, 4e-6]])[:, key]
    deviation = base + response @ place
    steady, fitted = without_aside(key, deviation, deviation - place, OFFSET)
    np.testing.assert_allclose(steady, base, rtol=0, atol=1e-20)
    assert fitted == 4
    same, none = without_aside(key, deviation, deviation - place, 0.0)
    assert same is deviation
    assert none == 0
