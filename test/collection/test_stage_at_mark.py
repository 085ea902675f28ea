# SPDX-License-Identifier: Apache-2.0
"""The indicated position belongs to the site of the mark that is seen there."""

from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.collection.marks import identify
from selfcal_ros.model.readings import Sense
from test.support.collecting import collect, gathered, scene, table

REASON = "stage_not_at_mark"
PITCH = 0.01


def led_astray(cell, index, shift_m):
    """Let the stage stand elsewhere at one exposure, the mark being seen where it is."""
    d = cell.detections[index]
    cell.spoil(index, offset_x=d.offset_x - shift_m)
    near = 4_900_000
    cell.samples = [
        replace(s, positions=(s.positions[0] + shift_m, *s.positions[1:]))
        if abs(s.stamp_ns - d.stamp_ns) <= near
        else s
        for s in cell.samples
    ]
    return cell


@pytest.mark.parametrize("with_ids", [True, False])
@pytest.mark.parametrize(
    ("shift", "kept"),
    [(0.55, True), (-0.55, True), (0.62, False), (-0.62, False), (2.0, False)],
)
def test_a_stage_that_stands_beside_the_mark(with_ids, shift, kept):
    # half a pitch, and 0.035 rad times the radius of 2.83 pitches: 0.599 pitches
    whole = table(collect(scene(count=0, with_ids=with_ids).events)[0].views[0])
    cell = led_astray(scene(count=0, with_ids=with_ids), 12, shift * PITCH)
    found, _ = collect(cell.events)
    assert found.all_rejected() == ({} if kept else {REASON: 1})
    assert len(whole) - len(table(found.views[0])) == (not kept)


@pytest.mark.parametrize("part", [1, 4, 7, 25])
def test_a_stage_beside_any_of_many_marks_is_seen(monkeypatch, part):
    monkeypatch.setattr(identify, "PART", part)
    for index in (0, 3, 4, 24):
        found, _ = collect(led_astray(scene(count=0), index, 2 * PITCH).events)
        assert found.all_rejected() == {REASON: 1}


def test_the_limit_is_a_parameter_and_grows_with_the_rotation_reckoned_with():
    cell = led_astray(scene(count=0), 12, 0.62 * PITCH)
    assert collect(cell.events, max_stage_distance=0.0063)[0].all_rejected() == {}
    assert collect(cell.events, max_stage_distance=0.0061)[0].all_rejected() == {
        REASON: 1
    }
    assert collect(cell.events, max_rotation=0.05)[0].all_rejected() == {}


@pytest.mark.parametrize("sense", list(Sense))
def test_a_stage_that_never_moved_is_not_calibrated(sense):
    cell = scene(count=0, sense=sense)
    sign = -1 if sense is Sense.PLATE_MOVES else 1
    where = {}
    for s in cell.samples:
        where[s.stamp_ns] = s.positions
    stamps = np.array(sorted(where))
    for index, d in enumerate(cell.detections):
        x, y, _ = where[stamps[np.searchsorted(stamps, d.stamp_ns) - 1]]
        cell.spoil(
            index, offset_x=d.offset_x + sign * x, offset_y=d.offset_y + sign * y
        )
    cell.samples = [
        replace(s, positions=(0.0, 0.0, s.positions[2])) for s in cell.samples
    ]
    found, _ = collect(cell.events, measurement_sense=str(sense))
    assert found.all_rejected() == {REASON: 24}
    # the mark at the centre, where the stage is parked
    assert len(found.views[0].m) == 1
    told, _ = collect(cell.events, measurement_sense=str(sense), max_stage_distance=1.0)
    assert len(told.views[0].m) == 25


def test_the_other_sense_is_told_by_the_stage_that_stands_elsewhere():
    found, _ = collect(scene(count=0, sense=Sense.PLATE_MOVES).events)
    assert found.all_rejected() == {REASON: 24}


def test_marks_at_whose_sites_the_stage_does_not_stand_do_not_move_the_others():
    cell = scene(count=0)
    whole = table(collect(cell.events)[0].views[0])
    for index in range(0, 25, 2):
        led_astray(cell, index, 1.5 * PITCH)
        cell.spoil(index, offset_y=cell.detections[index].offset_y + 3e-3)
    found, _ = collect(cell.events)
    assert found.all_rejected() == {REASON: 13}
    assert table(found.views[0]).items() <= whole.items()


@pytest.mark.parametrize("limit_m", [0.0, 2 * PITCH])
@pytest.mark.parametrize("with_ids", [True, False])
@pytest.mark.parametrize("sense", Sense)
def test_of_an_image_of_many_marks_the_one_at_which_the_stage_stands_is_read(
    with_ids, sense, limit_m
):
    """At each stop the microscope sees the whole plate; the other marks are named as that.

    Also those beside which the stage might stand, as on a list of marks close together.
    """
    cell = scene(count=0, sense=sense)
    limits = {"measurement_sense": str(sense), "max_stage_distance": limit_m}
    plain, _ = collect(cell.events, **limits)
    seen = []
    for at in cell.detections:
        for other in cell.detections:
            away = [0.01 * (getattr(other, k) - getattr(at, k)) for k in "mn"]
            seen.append(
                replace(
                    other,
                    stamp_ns=at.stamp_ns,
                    has_id=with_ids,
                    offset_x=at.offset_x + away[0],
                    offset_y=at.offset_y + away[1],
                )
            )
    events = [*cell.commands, *cell.samples, *seen]
    collector = gathered(events, **limits)
    found, progress = collector.collect()
    assert found.all_rejected() == {"other_mark_of_one_exposure": 600}
    assert table(found.views[0]) == table(plain.views[0])
    assert progress[0].complete
    (line,) = [str(item) for item in collector.findings(found, progress).values()]
    assert line.startswith(
        "600 of 625 detections were rejected as other_mark_of_one_exposure: an "
        "exposure shows several marks, but the plan expects one; state in the"
    )


def test_two_marks_of_one_exposure_with_the_stage_at_neither_are_not_at_their_mark():
    cell = scene(count=0)
    first, second = cell.grid(3), cell.grid(4)
    led_astray(cell, first, 2 * PITCH)
    cell.spoil(second, stamp_ns=cell.detections[first].stamp_ns)
    led_astray(cell, second, 2 * PITCH)
    assert collect(cell.events)[0].all_rejected() == {REASON: 2}
