# SPDX-License-Identifier: Apache-2.0
"""Images that show several marks: each in its cell, a reading of the stage beside it."""

from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.collection.inputs import Kind, Reason
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.options import Options
from selfcal_ros.model.readings import Sense
from selfcal_ros.simulation import physics
from test.support.collecting import collect, digest, scene
from test.support.plans import image_plan

PLAN = image_plan(7, turns=(0, 90, 180), count=8, repeats=2)
QUIET = {"servo_sigma_m": 0.0, "servo_sigma_theta_rad": 0.0}


def rotated(turn: int, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return ((x, y), (-y, x), (-x, -y))[turn]


@pytest.mark.parametrize("sense", Sense)
def test_a_reading_has_the_error_of_the_stage_where_it_stands(sense):
    shot = scene(PLAN, sense=sense, **QUIET)
    measurements, _ = collect(shot.events, measurement_sense=str(sense))
    assert len(measurements.views) == 3 * 9 + 1
    assert not measurements.all_rejected()
    sign = -1 if sense is Sense.PLATE_MOVES else 1
    read = 0
    for number, view in enumerate(measurements.views[:-1]):
        turn, (cx, cy) = number // 9, view.view.cell
        assert (cx, cy) == (number % 9 // 3 - 1, number % 3 - 1)
        place, site = physics.mark_places(
            shot.truth, turn, PLAN.views[turn], (view.m, view.n)
        )
        x, y = rotated(turn, view.m, view.n)
        i, j = sign * (x - cx) + 3, sign * (y - cy) + 3  # where the stage stands
        error = sign * shot.truth.g[:, i, j]
        np.testing.assert_allclose([view.dx, view.dy], place - site + error, atol=1e-14)
        beside = np.array([[cx], [cy]]) * 1e-3  # seen from the place of the cell
        there = np.stack([(x - cx), (y - cy)]) * 1e-3 - sign * shot.truth.g[:, i, j]
        offset = place - beside - there
        at = view.visits.mark
        np.testing.assert_allclose(
            [view.visits.offset_x, view.visits.offset_y], offset[:, at], atol=1e-14
        )
        read += len(view.m)
        assert (view.count == 2).all()
        assert len(view.k) == (8 if (cx, cy) == (0, 0) else 0)
    assert read == 3 * 361  # 49 stops, 9 marks each, less at the edges


@pytest.mark.parametrize("sense", Sense)
def test_marks_of_an_image_need_no_ids(sense):
    told, free = (scene(PLAN, sense=sense, with_ids=ids) for ids in (True, False))
    settings = {"measurement_sense": str(sense)}
    assert digest(free.events, **settings) == digest(told.events, **settings)


def test_the_order_of_arrival_changes_nothing():
    shot = scene(PLAN, sigma_xy_m=2e-8)
    shuffled = [
        shot.events[i] for i in np.random.default_rng(1).permutation(len(shot.events))
    ]
    measurements, _ = collect(shot.events)
    again, _ = collect(shuffled)
    for one, other in zip(measurements.views, again.views, strict=True):
        assert one.view == other.view
        np.testing.assert_array_equal([one.dx, one.dy], [other.dx, other.dy])


def displaced(
    plan,
    t_m,
    *,
    ids,
    follow=False,
    sense=Sense.MICROSCOPE_MOVES,
    shown=lambda detection: True,
):
    """Return truth, readings and progress of plates at `t_m`, from the detections `shown`."""
    shot = scene(plan, with_ids=ids, follow_mark=follow, sense=sense, t_m=t_m, **QUIET)
    kept = [d for d in shot.detections if shown(d)]
    return shot, *collect(
        [*shot.commands, *shot.samples, *kept], measurement_sense=str(sense)
    )


@pytest.mark.parametrize("ids", [True, False])
@pytest.mark.parametrize("t_m", [(0.5e-3, 0.0), (0.6e-3, -0.7e-3), (-1.2e-3, 0.4e-3)])
@pytest.mark.parametrize("sense", Sense)
def test_a_plate_off_its_place_by_more_than_half_a_pitch_loses_no_mark(sense, t_m, ids):
    """The stage stops at the nominal sites: in all images the marks are displaced."""
    shot, measurements, progress = displaced(PLAN, t_m, ids=ids, sense=sense)
    assert not measurements.all_rejected()
    assert all(view.complete for view in progress.values())
    sign = -1 if sense is Sense.PLATE_MOVES else 1
    for number, view in enumerate(measurements.views[:-1]):
        turn, (cx, cy) = number // 9, view.view.cell
        place, site = physics.mark_places(
            shot.truth, turn, PLAN.views[turn], (view.m, view.n)
        )
        x, y = rotated(turn, view.m, view.n)
        error = sign * shot.truth.g[:, sign * (x - cx) + 3, sign * (y - cy) + 3]
        np.testing.assert_allclose([view.dx, view.dy], place - site + error, atol=1e-14)


@pytest.mark.parametrize("ids", [True, False])
def test_the_map_of_a_displaced_plate_is_that_of_the_one_in_place(ids):
    plan, maps = image_plan(5, turns=(0, 90), repeats=2), []
    for t_m in ((0.0, 0.0), (0.6e-3, -0.7e-3)):
        measurements = displaced(plan, t_m, ids=ids)[1]
        maps.append(calibrate(measurements, Options(causes=False)).error_map)
    for axis in "xy":
        np.testing.assert_allclose(
            *(getattr(found, f"g{axis}") for found in maps), atol=2e-10
        )


@pytest.mark.parametrize("pixels", [0.75, 1.2])
def test_a_camera_of_another_scale_loses_no_cell(pixels):
    shot = scene(PLAN, **QUIET)
    moved = [
        replace(d, offset_x=pixels * d.offset_x, offset_y=pixels * d.offset_y)
        for d in shot.detections
    ]
    measurements, _ = collect([*shot.commands, *shot.samples, *moved])
    assert not measurements.all_rejected()
    assert all(len(view.m) for view in measurements.views if view.view.grid)


def test_of_a_part_of_the_image_ids_tell_the_cells():
    """Only the two left columns of each image are visible: they could be the two right ones."""
    _, told, progress = displaced(
        PLAN, (0.6e-3, 0.0), ids=True, shown=lambda d: d.offset_x < 1.1e-3
    )
    assert not told.all_rejected()
    assert {
        view.view.cell[0] for view in told.views if view.used and view.view.grid
    } == {-1, 0}
    assert not any(view.complete for view in list(progress.values())[:3])


def test_a_stage_that_follows_a_plate_a_pitch_away_is_named_and_no_mark_misnamed():
    for ids in (True, False):
        _, measurements, _ = displaced(
            image_plan(7), (1.2e-3, 0.0), ids=ids, follow=True
        )
        assert measurements.all_rejected() == {str(Reason.NOT_AT_MARK): 722}


def test_four_columns_in_images_of_a_plan_of_three_are_counted():
    shot = scene(image_plan(7, marks=5), **QUIET)
    plan = image_plan(7, marks=3)
    commands = [
        replace(c, view=replace(c.view, image=plan.views[0].image)) if c.view else c
        for c in shot.commands
    ]
    kept = [d for d in shot.detections if d.offset_x > -1.5e-3]
    measurements, _ = collect([*commands, *shot.samples, *kept])
    rejected = measurements.all_rejected()
    assert set(rejected) == {str(Reason.OUTSIDE_IMAGE)}
    assert sum(view.used for view in measurements.views) == 722
    assert rejected[str(Reason.OUTSIDE_IMAGE)] == len(kept) - 722


def test_marks_beyond_the_image_of_the_plan_are_named():
    wide = scene(image_plan(7, marks=5), **QUIET)
    narrow = image_plan(7, marks=3)
    shown, _ = collect(scene(narrow, **QUIET).events)
    commands = [
        replace(c, view=replace(c.view, image=narrow.views[0].image)) if c.view else c
        for c in wide.commands
    ]
    measurements, _ = collect([*commands, *wide.samples, *wide.detections])
    rest = len(wide.detections) - sum(view.used for view in shown.views)
    assert measurements.all_rejected() == {str(Reason.OUTSIDE_IMAGE): rest}
    for one, other in zip(measurements.views, shown.views, strict=True):
        np.testing.assert_array_equal([one.dx, one.dy], [other.dx, other.dy])


def test_without_an_image_in_the_plan_other_marks_are_named():
    shot = scene(image_plan(7), **QUIET)
    commands = [
        replace(c, view=replace(c.view, image=None)) if c.view else c
        for c in shot.commands
    ]
    measurements, _ = collect([*commands, *shot.samples, *shot.detections])
    assert measurements.all_rejected() == {
        str(Reason.SEVERAL): len(shot.detections) - 2 * 49
    }


def test_a_wrong_id_in_an_image_is_not_called_one_mark_too_many():
    """The plan states how many marks an image shows: to state it was no advice."""
    shot = scene(image_plan(7), with_ids=True, **QUIET)
    wrong = [
        replace(d, m=-d.m, n=-d.n) if number % 9 == 0 and abs(d.m) > 2 else d
        for number, d in enumerate(shot.detections)
    ]
    measurements, _ = collect([*shot.commands, *shot.samples, *wrong])
    rejected = measurements.all_rejected()
    assert rejected[str(Reason.NOT_AT_MARK)] > 5
    assert str(Reason.SEVERAL) not in rejected


def test_progress_counts_the_marks_of_images_and_names_the_stops_to_repeat():
    shot = scene(image_plan(7, turns=(90,)))
    _, progress = collect(shot.events)
    assert (progress[0].grid_expected, progress[0].grid_done) == (361, 361)
    assert progress[0].complete
    assert progress[0].needed == 0
    stamps = sorted({d.stamp_ns for d in shot.detections})
    gone = [d for d in shot.detections if d.stamp_ns == stamps[10]]
    at_the_axis = next(d for d in gone if abs(d.offset_x) + abs(d.offset_y) < 5e-4)
    kept = [d for d in shot.detections if d not in gone[1:]]
    _, progress = collect([*shot.commands, *shot.samples, *kept])
    assert not progress[0].complete
    assert progress[0].needed == len(gone) - 1 == 361 - progress[0].grid_done
    assert (progress[0].missing.m, progress[0].missing.n) == (
        (at_the_axis.m,),
        (at_the_axis.n,),
    )
    assert 0 < progress[0].coverage < 1


def test_check_stops_of_images_are_recognised():
    plan = image_plan(7, repeats=2)
    views = tuple(
        replace(view, check_marks=5, check_offset_m=20e-6) for view in plan.views
    )
    _, progress = collect(scene(replace(plan, views=views), sigma_xy_m=2e-8).events)
    assert [view.check_done for view in progress.values()] == [5, 5]
    assert all(view.complete for view in progress.values())


def test_a_stage_away_from_its_image_is_named():
    shot = scene(image_plan(7), **QUIET)
    moved = [
        replace(s, positions=(s.positions[0] + 3e-3, *s.positions[1:]))
        for s in shot.samples
    ]
    measurements, _ = collect([*shot.commands, *moved, *shot.detections])
    assert set(measurements.all_rejected()) <= {Reason.TOO_FAR, Reason.NOT_AT_MARK}
    assert not any(view.used for view in measurements.views)


def test_lines_stay_with_the_optical_axis():
    shot = scene(PLAN)
    measurements, progress = collect(shot.events)
    lines = sum(d.kind == Kind.ANGULAR for d in shot.detections)
    assert sum(int(view.count_theta.sum()) for view in measurements.views) == lines
    assert [view.angular_done for view in progress.values()] == [8, 8, 8, 8]
