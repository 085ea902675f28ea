# SPDX-License-Identifier: Apache-2.0
"""Check stops through the collector: extra readings, none an outlier, and never a repeat."""

from dataclasses import MISSING, fields, replace

import numpy as np
import pytest

from selfcal_ros.collection.collector import view_progress
from selfcal_ros.collection.inputs import Command, Detection, EncoderSample
from selfcal_ros.collection.marks.stops import (
    beside,
    cells_of,
    count_stops,
    marks_shown,
    middles,
    numbers_of,
    places_of_cells,
    stage_aside,
    without_aside,
)
from selfcal_ros.model.artifact import Artifact, MapGrid
from selfcal_ros.model.pose import ImageCells
from selfcal_ros.model.readings import GridVisits, Sense
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
        plan = replace(
            plan, artifact=plate, views=(View("37", np.deg2rad(37), repeats=repeats),)
        )
    view = replace(plan.views[0], check_marks=MARKS, check_offset_m=OFFSET)
    plan, rng = replace(plan, views=(view,)), np.random.default_rng(4)
    truth = random_truth(plan.artifact, 1, rng)
    truth = replace(truth, microscope=np.array(microscope, dtype=float))
    how = CellSettings(**({"sigma_xy_m": NOISE} | settings))
    events = list(plan_events(truth, plan, settings=how, rng=rng, start_ns=START_NS))
    return Scene(
        plan,
        truth,
        *(
            [event for event in events if isinstance(event, kind)]
            for kind in (Command, EncoderSample, Detection)
        ),
    )


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
    last = np.argsort(visits.stamp_ns)[FIRST : FIRST + 4 * MARKS]
    assert visits.count[last].tolist() == [1] * 4 * MARKS
    mark = visits.mark[last].reshape(4, MARKS)
    assert (mark == mark[0]).all()
    usual = np.stack(
        [
            np.median(row.reshape(-1)[visits.mark == k])
            for k in mark[0]
            for row in (visits.offset_x, visits.offset_y)
        ]
    ).reshape(MARKS, 2)
    seen = np.stack([visits.offset_x, visits.offset_y], axis=1)[last].reshape(
        4, MARKS, 2
    )
    # the microscope stops at +x of the mark and sees it at -x; the plate at +x carries it to +x
    sign = 1 if sense is Sense.PLATE_MOVES else -1
    want = sign * OFFSET * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])[:, None]
    np.testing.assert_allclose(
        seen - usual, np.broadcast_to(want, seen.shape), atol=3e-7
    )


@pytest.mark.parametrize(
    "microscope",
    [
        ((0.01, -0.003), (0.007, 0.01)),
        ((-2, 0), (0, -2)),
        ((-0.5, 0), (0, -0.5)),
        ((1, 0), (0, 1)),
        ((-1, 1), (1, -1)),
    ],
    ids=[
        "scale and turn",
        "other sign",
        "pixels doubled",
        "pixels halved",
        "axes exchanged",
    ],
)
def test_no_microscope_makes_outliers_or_noise_of_check_stops(microscope):
    readings, progress = progress_of(checked(microscope=microscope, servo_sigma_m=0.0))
    assert readings.rejected == {}
    assert progress.complete
    assert readings.sigma_xy == pytest.approx(
        NOISE, rel=4 / np.sqrt(2 * readings.dof_xy)
    )
    # two numbers an axis are fitted
    assert readings.dof_xy == 2 * (readings.used - ORDINARY) - 4


def test_an_outlier_among_check_stops_is_one_and_leaves_the_mark_unchecked():
    scene = checked(microscope=((0.01, 0), (0, 0.01)))
    index = scene.grid(FIRST + 7)
    scene.spoil(index, offset_x=scene.detections[index].offset_x + 2e-6)
    readings, progress = progress_of(scene)
    assert readings.rejected == {"outlier_among_repeats": 1}
    assert (progress.complete, progress.check_done, progress.grid_done) == (
        False,
        4,
        25,
    )
    assert progress.coverage == 79 / 80


def test_check_stops_are_no_repeats():
    """A mark with four check stops and one repeat too few is missing, named, and not done."""
    scene = checked()
    mark = scene.detections[FIRST]
    lost = next(d for d in scene.detections if (d.m, d.n) == (mark.m, mark.n))
    scene.detections.remove(lost)
    readings, progress = progress_of(scene)
    at = (readings.m == mark.m) & (readings.n == mark.n)
    assert readings.count[at].tolist() == [2 + 4]
    assert (progress.grid_done, progress.check_done, progress.complete) == (
        24,
        MARKS,
        False,
    )
    assert (progress.missing.m, progress.missing.n) == ((mark.m,), (mark.n,))
    assert progress.needed == 1
    assert collect([*scene.events, lost])[1][0].complete


@pytest.mark.parametrize("lost", range(4))
def test_a_mark_that_lacks_one_side_is_not_checked(lost):
    scene = checked()
    scene.detections.pop(FIRST + lost * MARKS)
    _, progress = progress_of(scene)
    assert (progress.grid_done, progress.check_done, progress.complete) == (
        25,
        4,
        False,
    )


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
    del scene.detections[FIRST : FIRST + 4 * MARKS]
    readings, progress = progress_of(scene)
    assert (progress.grid_done, progress.check_done, progress.complete) == (
        25,
        0,
        False,
    )
    assert progress.needed == MARKS
    timeline = gathered(
        [
            replace(
                c, view=c.view and replace(c.view, check_marks=0, check_offset_m=0.0)
            )
            for c in scene.commands
        ]
    ).timeline
    assert view_progress(timeline, 0, readings).complete


def test_stops_that_scatter_like_check_stops_ask_for_none():
    """Nobody can count there, and the scatter itself shows the microscope."""
    scene = checked(stop_sigma_m=10e-6)
    del scene.detections[FIRST : FIRST + 4 * MARKS]
    _, progress = progress_of(scene)
    assert (progress.complete, progress.check_done) == (True, MARKS)


def test_a_check_stop_may_be_further_off_than_the_stage_limit():
    assert progress_of(checked(), max_stage_distance=1e-5)[1].complete
    scene = checked(stop_sigma_m=2e-4)  # ordinary stops may not
    assert (
        "stage_not_at_mark" in progress_of(scene, max_stage_distance=1e-5)[0].rejected
    )


def test_which_stops_are_aside():
    key = np.array([0, 0, 0, 0, 0, 1, 1, 2])
    place = (
        np.array([[0, 20, -20, 0, 0, 3, 3, 20], [0, 0, 0, 20, -20, 4, 4, 20]]) * 1e-6
    )
    aside = stage_aside(key, place, OFFSET)
    np.testing.assert_allclose(
        aside,
        np.array([[0, 20, -20, 0, 0, 0, 0, 0], [0, 0, 0, 20, -20, 0, 0, 0]]) * 1e-6,
    )
    assert not stage_aside(key[:0], place[:, :0], OFFSET).any()
    assert not stage_aside(key, place / 2.5, OFFSET).any()  # too near
    assert not stage_aside(key, place * 1.6, OFFSET).any()  # too far
    both = place.copy()
    both[1, 1] = 20e-6  # along both axes: no check stop of either
    assert not stage_aside(key, both, OFFSET)[:, 1].any()
    assert (
        stage_aside(np.zeros(6, int), np.tile(np.arange(6) * 5e-6, (2, 1)), OFFSET)
        is None
    )


def test_a_stop_on_one_side_alone_is_a_repeat():
    """Two marks with two repeats each, about one of them a third stop at +x; then one at -x too."""
    one_side = np.array([[0, 0, 20, 0, 0], [0, 0, 0, 0, 0]]) * 1e-6
    for place, mark, extra in (
        (one_side, [0, 0, 0, 1, 1], 0),
        (np.hstack([one_side, [[-20e-6], [0]]]), [0, 0, 0, 1, 1, 0], 2),
    ):
        n = len(mark)
        visits = GridVisits(
            **{
                field.name: np.zeros(n)
                for field in fields(GridVisits)
                if field.default is MISSING and field.default_factory is MISSING
            }
            | {
                "mark": np.array(mark),
                "count": np.ones(n, int),
                "dx": place[0],
                "dy": place[1],
                "offset_x": np.zeros(n),
                "offset_y": np.zeros(n),
            }
        )
        count = np.bincount(mark)
        readings = replace(
            progress_of(checked())[0],
            m=np.arange(2),
            n=np.arange(2),
            count=count,
            visits=visits,
        )
        view = View("0", check_marks=1, check_offset_m=OFFSET)
        stops, done = count_stops(view, readings)
        assert stops.tolist() == (count - [extra, 0]).tolist() and done == 0


WIDE = View("90", np.pi / 2, (0.01, 0.0), image=ImageCells(3, 5, 0.01))


def test_cells_are_numbered_in_their_order_and_what_lies_beyond_them_is_none():
    cells = {x + 1j * y: number for number, (x, y) in enumerate(WIDE.image.cells)}
    every = np.array(
        [
            x + 1j * y
            for x in (-(10**6), *range(-9, 10), 10**6)
            for y in (-(10**6), *range(-9, 10), 10**6)
        ]
    )
    assert numbers_of(WIDE, every).tolist() == [cells.get(cell, -1) for cell in every]


def test_the_place_of_a_cell_is_as_many_pitches_off_along_the_rows_of_the_plate():
    """A quarter turn leaves the rows along the axes, one by 10 deg does not."""
    cells, beside_m = (
        np.array([1 + 2j, -1j, 0]),
        np.array([3e-4 - 3e-4j, -2e-4 - 4e-4j, 4e-3j]),
    )
    for turn_deg, rows in ((90, 1.0), (10, np.exp(1j * np.deg2rad(10)))):
        view = replace(WIDE, rotation_rad=np.deg2rad(turn_deg))
        place = rows * 0.01 * cells
        offset = np.stack([(place + beside_m).real, (place + beside_m).imag])
        np.testing.assert_allclose(cells_of(view, offset), cells, atol=1e-12)
        np.testing.assert_allclose(
            places_of_cells(view, offset), [place.real, place.imag], atol=1e-15
        )


def test_displacements_are_medians_of_a_cell_less_that_on_the_axis():
    away = np.array([[1, 2, 9, 5, 5, 6, 40], [0, -1, -1, 3, 4, 9, 40]]) * 1e-6
    # on the axis, in cell 2, beyond the image
    number = np.array([7, 7, 7, 2, 2, 2, -1])
    np.testing.assert_allclose(
        middles(WIDE, number, away) * 1e6,
        [[0, 0, 0, 3, 3, 3, 0], [0, 0, 0, 5, 5, 5, 0]],
        atol=1e-12,
    )
    assert not middles(WIDE, np.array([1, 2]), away[:, :2]).any()  # none on the axis


def test_marks_that_the_cells_show_are_those_seen_from_each_stop():
    """One by one: stops where a mark of the plate lies in the field, and the cell that sees it."""
    plate = Artifact(7, 0.01, 0, 5)
    view = replace(WIDE, rotation_rad=0.0)
    for cell, sub, shown in zip(
        view.image.cells, view.sub_views, marks_shown(plate, view), strict=True
    ):
        stops = [(m, n) for m in range(-3, 4) for n in range(-2, 3) if -3 <= m + 1 <= 3]
        expected = {(m + cell[0], n + cell[1]) for m, n in stops}
        expected = {(m, n) for m, n in expected if abs(m) <= 3 and abs(n) <= 2}
        assert {(m - 3, n - 2) for m, n in np.argwhere(shown).tolist()} == expected, (
            cell
        )
        again = np.argwhere(beside(shown, plate, sub, -1)) - (3, 2)
        assert set(map(tuple, again.tolist())) == {
            (m - cell[0], n - cell[1]) for m, n in expected
        }, cell


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
