# SPDX-License-Identifier: Apache-2.0
"""What spoilt most detections is named, with numbers and what to set, each cause by itself."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from selfcal_ros.collection.diagnosis import (
    Evidence,
    _encoder_stopped,
    diagnose,
    main_reason,
)
from selfcal_ros.collection.inputs import REMEDY, Reason, rejections
from selfcal_ros.collection.marks.seen_poses import NamedMarks, SeenPose, _fitted, texts
from selfcal_ros.estimation.checks.placing import Misplaced
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.readings import Sense
from selfcal_ros.model.view import View
from selfcal_ros.simulation.cell import CellSettings, plan_events
from test.support.collecting import START_NS, gathered, scene
from test.support.misplaced import photographed
from test.support.plans import image_plan, placed_plan, plan_of
from test.support.truth import random_truth

S = 1_000_000_000


def findings(events, **parameters):
    """Return view_index (None = all) -> the line that is said."""
    collector = gathered(events, **parameters)
    return {
        index: str(finding)
        for index, finding in collector.findings(*collector.collect()).items()
    }


def with_positions(cell, change):
    """Let every encoder sample indicate change(x, y)."""
    cell.samples = [
        replace(s, positions=(*change(*s.positions[:2]), s.positions[2]))
        for s in cell.samples
    ]
    return cell.events


def with_changed_ids(cell, change, view=None):
    """Let the detections of a view (None = all) have the ids change(m, n)."""
    stamps = [*(c.stamp_ns for c in cell.commands[::2]), 1 << 62]
    begin, end = (0, stamps[-1]) if view is None else stamps[view : view + 2]
    for index, d in enumerate(cell.detections):
        if begin < d.stamp_ns < end:
            m, n = change(d.m, d.n)
            cell.spoil(index, m=m, n=n)
    return cell.events


def test_without_evidence_nothing_is_said():
    assert diagnose(Evidence({}, 0)) is None


def test_nothing_is_said_of_good_readings():
    assert findings(scene("0, 90", repeats=2).events) == {}
    assert findings(scene(with_ids=False).events) == {}


def test_joints_of_other_names_are_named():
    cell = scene(count=0)
    cell.samples = [replace(s, names=("X1", "Y1", "theta")) for s in cell.samples]
    assert findings(cell.events) == {
        None: (
            "25 of 25 detections were rejected as no_encoder_sample_near: no encoder sample of the "
            "joint 'x', 'y' arrived; joints received: 'theta', 'X1', 'Y1'; set joint_x, joint_y, "
            "joint_theta"
        )
    }
    cell.samples = [replace(s, names=("x", "Y1", "theta")) for s in cell.samples]
    assert (
        "'y' arrived; joints received: 'x', 'theta', 'Y1';"
        in findings(cell.events)[None]
    )
    cell.samples = []
    assert (
        "of the joint 'x', 'y' arrived; joints received: none;"
        in findings(cell.events)[None]
    )


def test_an_angle_that_is_not_there_is_missed_by_lines_alone():
    cell = scene("0", line=True)
    samples = cell.samples
    for names, came in ((("x", "y", "rz"), "'x', 'y', 'rz'"), (("x", "y"), "'x', 'y'")):
        cell.samples = [
            replace(s, names=names, positions=s.positions[: len(names)])
            for s in samples
        ]
        found = findings(cell.events)
        assert list(found) == [1]
        assert found[1].startswith(
            "8 of 8 detections were rejected as no_encoder_sample_near: no encoder sample of the "
            f"joint 'theta' arrived; joints received: {came};"
        )


@pytest.mark.parametrize("sense", list(Sense))
def test_the_other_sense(sense):
    other = next(s for s in Sense if s is not sense)
    assert findings(
        scene(count=0, sense=sense).events, measurement_sense=str(other)
    ) == {
        None: (
            "24 of 25 detections were rejected as stage_not_at_mark: the plate lies "
            "turned by 180°, not by 0° (or its ids are those of other marks); turn it "
            "as planned and measure this view again, or correct its pose in the plan; "
            "or, if it lies as planned: the stage is indicated at minus the marks' "
            f"sites; the sense is reversed: measurement_sense {sense} (--sense {sense})"
        )
    }


def test_the_only_view_asks_for_the_pose_before_the_joints():
    """A plate at 90 degrees looks like exchanged joints of which one has the wrong sign."""
    text = findings(with_positions(scene(count=0), lambda x, y: (-y, x)))[None]
    assert text.index("the plate lies turned by 90°, not by 0°") < text.index(
        "or, if it lies as planned: x and y are exchanged and y is indicated with the wrong sign"
    )


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda x, y: (y, x), "x and y are exchanged; exchange joint_x and joint_y"),
        (
            lambda x, y: (-x, y),
            "x is indicated with the wrong sign; reverse the sign of x",
        ),
        (
            lambda x, y: (x, -y),
            "y is indicated with the wrong sign; reverse the sign of y",
        ),
        (
            lambda x, y: (1e3 * x, 1e3 * y),
            "the indicated positions are 1000 times those of the marks: they are in "
            "mm; publish joint positions in metres",
        ),
        (
            lambda x, y: (1e6 * x, 1e6 * y),
            "a million times those of the marks: they are in µm",
        ),
        (lambda x, y: (1e-3 * x, 1e-3 * y), "a thousandth of those of the marks"),
        (
            lambda x, y: (1e3 * y, 1e3 * x),
            "they are in mm and x and y are exchanged; publish joint positions in "
            "metres, and exchange joint_x and joint_y",
        ),
    ],
)
def test_positions_that_are_not_what_they_should_be(change, text):
    found = findings(with_positions(scene(count=0, servo_sigma_m=0.0), change))[None]
    assert text in found
    assert "of 25 detections were rejected as stage_not_at_mark" in found


def test_a_placed_plate_is_diagnosed_as_one_on_the_lattice():
    cell = scene(placed_plan(5), servo_sigma_m=0.0)
    assert findings(cell.events) == {}
    found = findings(with_positions(cell, lambda x, y: (-x, y)))[None]
    assert found.endswith("x is indicated with the wrong sign; reverse the sign of x")


@pytest.mark.parametrize(
    ("deg", "shift", "text"),
    [
        (
            -37,
            (0.013, -0.007),
            "the plate lies turned by 323°, not by 37° {ids}; turn it counter-",
        ),
        (
            127,
            (0.013, -0.007),
            "the plate lies turned by 127°, not by 37° {ids}; turn it as planned ",
        ),
        (
            307.6,
            (0.013, -0.007),
            "the plate lies turned by 307°, not by 37° {ids}; turn it as ",
        ),
        (
            0,
            (0.013, -0.007),
            "the plate lies turned by 0°, not by 37° {ids}; turn it as planned ",
        ),
        (
            37,
            (0.0, 0.0),
            "the plate lies shifted by (+0, +0) pitches, not by (+1.3, -0.7) pitches {ids}; ",
        ),
        (
            37,
            (-0.013, 0.007),
            "the plate lies shifted by (-1.3, +0.7) pitches, not by (+1.3, -0.7)",
        ),
    ],
)
def test_ids_show_how_a_placed_plate_lies(deg, shift, text):
    """In one view; the others are placed as planned."""
    plan = placed_plan(7)
    lies = (None, None, View("37", np.deg2rad(deg), shift), None)
    rng = np.random.default_rng(3)
    truth = replace(random_truth(plan.artifact, 4, rng), placed=lies)
    found = findings(
        plan_events(
            truth,
            plan,
            settings=CellSettings(follow_mark=True),
            rng=rng,
            start_ns=START_NS,
        )
    )
    assert list(found) == [2]
    ids = "(or its ids are those of other marks)"
    assert f": {text.format(ids=ids)}" in found[2]
    assert found[2].endswith(
        "other views are as planned: leave the joints and the sense as they are"
    )


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (
            lambda m, n: (n, m),
            "the ids have m and n exchanged, or the plate lies upside down",
        ),
        (lambda m, n: (-n, -m), "the ids have m and n exchanged and both reversed, or"),
        (
            lambda m, n: (-m, n),
            "the ids have m reversed, or the plate lies upside down",
        ),
        (
            lambda m, n: (m, -n),
            "the ids have n reversed, or the plate lies upside down",
        ),
        (
            lambda m, n: (-m, -n),
            "the plate lies turned by 270°, not by 90° (or its ids are those of",
        ),
        (
            lambda m, n: (m + 1, n),
            "the plate lies shifted by (+0, -1) pitches, not by (+0, +0)",
        ),
    ],
)
def test_ids_of_one_view_do_not_blame_the_joints(change, text):
    """The joints are right in the other views: to change them would break these."""
    cell = scene("0, 90, tx", count=0)
    found = findings(with_changed_ids(cell, change, 1))
    assert list(found) == [1]
    assert text in found[1]
    assert (
        "joint_x" not in found[1]
        and "leave the joints and the sense as they are" in found[1]
    )


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 1e300])
def test_offsets_that_are_no_numbers_do_not_hide_the_ids_of_a_view(value):
    cell = scene("0, 90, tx", count=0)
    with_changed_ids(cell, lambda m, n: (n, m), 1)
    for index in range(0, len(cell.detections), 7):
        cell.spoil(index, offset_x=value)
    found = findings(cell.events)
    assert list(found) == [1] and "the ids have m and n exchanged" in found[1]


@pytest.mark.parametrize(
    ("lies", "size", "said"),
    [
        ({1: 1}, 7, "(+1, +0) pitches, not by (+0, +0)"),
        ({0: -1j}, 7, "(+0, -1) pitches, not by (+0, +0)"),
        ({1: 1 - 1j}, 6, "(+1, -1) pitches, not by (+0, +0)"),
        ({2: -1}, 7, "(+0, +0) pitches, not by (+1, +0)"),
        # that it lies by one more along x shows a row that no image shows
        ({2: 1 + 1j}, 7, "(+2, +1) pitches, not by (+1, +0)"),
        ({1: 0.7}, 7, "(+0.7, +0) pitches, not by (+0, +0)"),
        ({}, 7, ""),
        ({}, 6, ""),
    ],
)
def test_images_without_ids_show_by_how_many_pitches_a_plate_lies_beside_its_place(
    lies, size, said
):
    found = findings(photographed(in_images(size), lies).events)
    assert list(found) == list(lies)
    for line in found.values():
        assert f"the plate lies shifted by {said} pitches; shift it as planned" in line
        assert (
            "leave the joints and the sense as they are" in line and "ids" not in line
        )


@pytest.mark.parametrize(
    ("lies", "named", "sense"),
    [((-1, 0), False, True), ((0, 0), False, False), ((-1, 0), True, False)],
)
def test_reversed_shifts_without_ids_may_also_be_the_sense(lies, named, sense):
    """Of images without ids it turns all places by 180°, which shifted views alone show."""
    still = Misplaced("a", 0, 0, (0, 0), (0, 0))
    moved = Misplaced("tx", 0, 0, (1, 0), lies)
    poses = {
        index: SeenPose(pose, planned=not index, mirrored=False, named=named)
        for index, pose in enumerate((still, moved))
    }
    ((index, line),) = texts(poses).items()
    assert index == 1 and f"the plate lies shifted by ({lies[0]:+}, +0) pitches" in line
    assert ("correct measurement_sense (--sense)" in line) is sense
    assert ("leave the joints and the sense as they are" in line) is not sense


def test_plates_that_lie_beside_their_places_in_all_views_do_not_clear_the_joints():
    found = findings(photographed(in_images(7), dict.fromkeys(range(3), 1)).events)
    assert "by (+1, +0) pitches, not by (+0, +0)" in found[0]
    assert not any("leave the joints" in line for line in found.values())


@pytest.mark.parametrize(
    "change", [lambda x, y: (y, x), lambda x, y: (-x, y), lambda x, y: (-x, -y)]
)
def test_images_of_wrong_joints_show_no_plate_beside_its_place(change):
    cell = photographed(in_images(7), {})
    assert "shifted" not in " ".join(findings(with_positions(cell, change)).values())


@pytest.mark.parametrize("unit", [1e6, 1e9])
def test_images_of_joints_in_another_unit_are_diagnosed_in_little_memory(unit):
    cell = photographed(in_images(5), {})
    found = findings(with_positions(cell, lambda x, y: (unit * x, unit * y)))
    assert found and "shifted" not in " ".join(found.values())


def test_a_view_that_is_not_measured_yet_is_not_late():
    cell = photographed(in_images(5), {1: 1})
    stamps = sorted(detection.stamp_ns for detection in cell.detections)
    end = stamps[len(stamps) * 2 // 3]
    cell.detections = [d for d in cell.detections if d.stamp_ns < end]
    assert "plate lies shifted" in findings(cell.events)[1]


@pytest.mark.parametrize("by", [1, -1, 2])
@pytest.mark.parametrize("size", [6, 7])
def test_images_of_another_exposure_are_named(size, by):
    """A camera gives the image before: each shows other marks on the lattice, which fit."""
    cell = photographed(in_images(size), {})
    rng = np.random.default_rng(1)
    cell.detections = [d for d in cell.detections if rng.uniform() > 0.02]
    stamps = np.unique([detection.stamp_ns for detection in cell.detections])
    exposure = int(np.median(np.diff(stamps)))
    late = stamped_late(cell, by * exposure / S)
    measured = gathered(late.events).collect()[0]
    assert not any(view.used for view in measured.views)
    taken = f"taken {abs(by)} exposure{'s' * (abs(by) > 1)} {'before' if by > 0 else 'after'}"
    about = f"about {abs(by) * exposure / S:.2g} s"
    assert f"each image was {taken} its stamp, {about}" in findings(late.events)[None]


def in_images(size):
    """Return a cell of which each image shows nine marks, the last view shifted by a pitch."""
    plan = image_plan(size, turns=(0, 90, 180))
    shifted = replace(plan.views[0], name="tx", translation_m=(1e-3, 0.0))
    return scene(replace(plan, views=(*plan.views[:2], shifted)), with_ids=False)


def test_ids_mirrored_in_all_views_may_be_the_joints():
    found = findings(with_changed_ids(scene("0, 90, tx", count=0), lambda m, n: (n, m)))
    assert list(found) == [None]
    assert (
        "the ids have m and n exchanged, or the plate lies upside down; correct the ids"
        in (found[None])
    )


def test_exchanged_views_are_named_in_both():
    plan = placed_plan(7)
    lies = (None, plan.views[2], plan.views[1], None)
    rng = np.random.default_rng(3)
    truth = replace(random_truth(plan.artifact, 4, rng), placed=lies)
    found = findings(
        plan_events(
            truth,
            plan,
            settings=CellSettings(follow_mark=True),
            rng=rng,
            start_ns=START_NS,
        )
    )
    assert sorted(found) == [1, 2]
    for index, other in ((1, "37"), (2, "90")):
        assert f"as planned for view '{other}'" in found[index]
        assert (
            "the views are exchanged; measure them in the order of the plan"
            in found[index]
        )


def test_mm_are_named_though_the_stage_seems_to_jump():
    rng = np.random.default_rng(1)
    found = findings(
        with_positions(
            scene(count=0),
            lambda x, y: tuple(1e3 * np.array([x, y]) + rng.normal(0, 2e-4, 2)),
        )
    )[None]
    assert (
        "rejected as encoder_contradiction: the indicated positions are 1000 times"
        in found
    )
    assert "they are in mm" in found


def test_a_parked_stage():
    found = findings(with_positions(scene(count=0), lambda x, y: (0.0301, -0.002)))[
        None
    ]
    assert found == (
        "25 of 25 detections were rejected as stage_not_at_mark: the stage did not move: it is "
        "indicated at x = 0.0301 m, y = -0.002 m at all of them; name the joints that move, in "
        "joint_x and joint_y"
    )


@pytest.mark.parametrize("sense", list(Sense))
def test_an_encoder_that_stands_still_within_a_view(sense):
    """The first marks agree with the plan, so that the ids and the plate are not to blame."""
    cell = scene(count=0, repeats=3, sense=sense)
    last = cell.detections[30].stamp_ns
    place = next(s.positions for s in cell.samples if s.stamp_ns > last)
    cell.samples = [
        s if s.stamp_ns < last else replace(s, positions=place, velocities=())
        for s in cell.samples
    ]
    found = findings(cell.events, measurement_sense=str(sense))[None]
    where = f"x = {place[0]:.6g} m, y = {place[1]:.6g} m"
    assert (
        f"stage_not_at_mark: the stage has stopped: it is indicated at {where} at each"
        in found
    )
    assert (
        "of the last 20 marks; check the encoder and what publishes its joints" in found
    )


@pytest.mark.parametrize("ahead_s", [-0.3, 0.3])
def test_an_encoder_of_another_clock_is_not_taken_for_a_stage_that_has_stopped(ahead_s):
    """The stage waits where the lines are, while the last marks of the view are detected."""
    cell = scene(size=7, count=40, repeats=3)
    shift_ns = round(ahead_s * 1e9)
    cell.samples = [replace(s, stamp_ns=s.stamp_ns + shift_ns) for s in cell.samples]
    found = findings(cell.events)[None]
    side = "before" if ahead_s < 0 else "after"
    assert f"the stage rests at the marks about {abs(ahead_s)} s {side} their" in found


def test_a_clock_that_stepped_back_is_not_taken_for_a_stage_elsewhere():
    """Positions between samples of two times are none."""
    cell = scene(count=0, repeats=4)
    middle = cell.detections[50].stamp_ns
    cell.samples = [
        s if s.stamp_ns < middle else replace(s, stamp_ns=s.stamp_ns - S // 2)
        for s in cell.samples
    ]
    cell.detections = [
        d if d.stamp_ns < middle else replace(d, stamp_ns=d.stamp_ns - S // 2)
        for d in cell.detections
    ]
    assert findings(cell.events)[None].endswith(
        "rejected as encoder_contradiction: " + REMEDY[Reason.CONTRADICTION]
    )


REST = "the stage rests at the marks about"
"""Beginning of what is said of detections that are stamped at another time."""


def stamped_late(cell, late_s, *, varying=0.0, first=0):
    """Stamp the detections from the `first` that much later, all or with some scatter."""
    rng = np.random.default_rng(1)
    for index, detection in enumerate(cell.detections[first:], start=first):
        late = late_s + varying * rng.normal()
        cell.spoil(index, stamp_ns=detection.stamp_ns + round(late * S))
    return cell


@pytest.mark.parametrize("sense", list(Sense))
@pytest.mark.parametrize(
    ("late_s", "said"),
    [
        (0.015, "stage_moving: {} 0.018 s before their"),
        (0.03, "stage_moving: {} 0.033 s before their"),
        (-0.03, "stage_moving: {} 0.028 s after their"),
        (0.05, "stage_not_at_mark: {} 0.053 s before their"),
        (0.15, "stage_not_at_mark: {} 0.15 s before their"),
        (-0.1, "stage_not_at_mark: {} 0.098 s after their"),
    ],
)
def test_stamps_of_another_time(late_s, said, sense):
    """By less than the time between two exposures, and by more."""
    cell = scene(count=0, repeats=3, sense=sense, exposure_period_s=0.05)
    found = findings(stamped_late(cell, late_s).events, measurement_sense=str(sense))
    assert (
        f"were rejected as {said.format(REST)} detections are stamped;" in found[None]
    )
    assert "not of their arrival" in found[None] and "by one clock" in found[None]


def test_stamps_that_are_late_by_sixty_marks_of_a_fast_cell():
    cell = scene(count=0, size=13, exposure_period_s=0.05)
    found = findings(stamped_late(cell, 3.0).events)
    assert f"stage_not_at_mark: {REST} 3 s before their" in found[None]


@pytest.mark.parametrize("repeats", [1, 3])
def test_stamps_that_are_late_by_times_that_vary(repeats):
    cell = scene(plan_of("0, 90", 7, count=0, repeats=repeats), exposure_period_s=0.05)
    found = findings(stamped_late(cell, 0.2, varying=0.03).events)
    assert f"{REST} 0.19 s before" in found[None]
    assert "are stamped, by times that vary; stamp detections" in found[None]


def test_stamps_that_are_late_from_the_middle_of_a_view_on():
    cell = scene(count=0, repeats=4, exposure_period_s=0.05)
    found = findings(stamped_late(cell, 0.1, first=40).events)
    assert (
        f"58 of 100 detections were rejected as stage_not_at_mark: {REST} 0.1 s before their "
        "detections are stamped; stamp" in found[None]
    )


def test_late_stamps_of_marks_without_ids():
    """The stage moves at the stamps; which mark is which is not needed."""
    cell = scene(count=0, with_ids=False, exposure_period_s=0.05)
    found = findings(stamped_late(cell, 0.018).events)
    assert f"rejected as stage_moving: {REST} 0.018 s before their" in found[None]


@pytest.mark.parametrize("late", [False, True])
def test_a_raster_seen_late_is_not_one_on_a_plate_shifted_by_a_pitch(late):
    """All marks but those at one side look alike."""
    cell = scene(plan_of("0, 90, tx", 13, count=0), visit_order="raster")
    if late:
        stamped_late(cell, 0.01)
    else:
        with_changed_ids(cell, lambda m, n: (m, n + 1), 1)
        cell.detections = [d for d in cell.detections if d.n <= 6]
    found = findings(cell.events)
    assert list(found) == ([None] if late else [1])
    said = REST if late else "the plate lies shifted by (+1, +0) pitches"
    assert said in "".join(found.values())


@pytest.mark.parametrize(
    ("positions", "said"),
    [
        (
            (),
            "25 of 25 detections were rejected as no_encoder_sample_near: no encoder sample came "
            "that can be used, {} were rejected as "
            "encoder_sample_malformed; give each name of a joint "
            "state its position",
        ),
        (
            (np.nan, np.inf, np.nan),
            "25 of 25 detections were rejected as no_encoder_sample_near: no "
            "encoder sample came that can be used, {} were rejected as encoder_sample_not_finite; "
            "publish positions that are finite",
        ),
    ],
)
def test_joint_states_that_cannot_be_used(positions, said):
    cell = scene(count=0)
    cell.samples = [
        replace(s, positions=positions, velocities=()) for s in cell.samples
    ]
    assert findings(cell.events) == {None: said.format(len(cell.samples))}


def test_positions_that_nothing_explains():
    found = findings(with_positions(scene(count=0), lambda x, y: (x + 0.05, 2 * y)))[
        None
    ]
    assert "the stage stands 0.0" in found
    assert "m from the sites of the detected marks (median); check joint_x" in found


@pytest.mark.parametrize(
    ("ahead_s", "side"), [(5.0, "after"), (37.0, "after"), (-3600.0, "before")]
)
def test_a_clock_of_its_own(ahead_s, side):
    cell = scene(count=0)
    shift = round(ahead_s * S)
    cell.samples = [replace(s, stamp_ns=s.stamp_ns - shift) for s in cell.samples]
    assert findings(cell.events) == {
        None: (
            "25 of 25 detections were rejected as no_encoder_sample_near: the "
            f"detections are stamped about {abs(ahead_s):g} s {side} the encoder "
            "samples; stamp both by one clock"
        )
    }


@pytest.mark.parametrize(
    ("ahead_s", "side"), [(37.0, "after the last"), (-37.0, "before the first")]
)
def test_commands_by_another_clock(ahead_s, side):
    cell = scene(count=0)
    cell.commands = [
        replace(c, stamp_ns=c.stamp_ns - round(ahead_s * S)) for c in cell.commands
    ]
    found = findings(cell.events)[None]
    assert found.startswith(
        "25 of 25 detections were rejected as outside_every_view: all detections are "
        f"stamped {side} view command, about 37 s off; sync"
    )


def test_the_clock_of_what_lies_between_the_commands_is_not_doubted():
    """All was exposed while the plate was placed for the second view."""
    cell = scene("0, 90", count=0)
    _, _, begin, end, _ = (command.stamp_ns for command in cell.commands)
    cell.detections = [
        replace(d, stamp_ns=begin + 1 + at) for at, d in enumerate(cell.detections)
    ]
    assert cell.detections[-1].stamp_ns < end
    found = str(findings(cell.events)[None])
    assert "rejected as outside_every_view" in found
    assert "view command" not in found


def test_an_encoder_that_sends_too_seldom():
    cell = scene(count=0, exposure_period_s=0.2)
    cell.samples = cell.samples[::75]
    assert findings(cell.events)[None].endswith(
        "the encoder sends a sample every 0.15 s, and max_encoder_gap is 0.1 s; send them more "
        "often, or raise max_encoder_gap"
    )


def test_a_view_is_named_where_the_session_as_a_whole_is_good():
    cell = scene("0, 90, 180", count=0)
    begin = cell.commands[2].stamp_ns
    end = cell.commands[4].stamp_ns
    for index, d in enumerate(cell.detections):
        if begin < d.stamp_ns < end:
            cell.spoil(index, m=77)
    assert findings(cell.events) == {
        1: "25 of 25 detections were rejected as unknown_mark: "
        + REMEDY[Reason.UNKNOWN_MARK]
    }


def test_what_is_no_fault_does_not_count():
    rejected = {
        "superseded_by_redo": 90,
        "other_run": 50,
        "duplicate": 70,
        "stage_moving": 6,
    }
    assert main_reason(rejected, 6) is None
    assert main_reason(rejected, 5) == ("stage_moving", 6, 11)
    assert main_reason({"stage_moving": 4}, 0) is None
    assert main_reason({"stage_moving": 5}, 0) == ("stage_moving", 5, 5)
    assert main_reason({"encoder_sample_not_finite": 50}, 0) is None
    assert diagnose(Evidence(rejected, 6)) is None


@pytest.mark.parametrize(
    ("reason", "name", "said"),
    [
        (
            "outside_every_view",
            "detections_ns",
            "the detections are stamped 0: fill in",
        ),
        (
            "outside_every_view",
            "commands_ns",
            "the view commands are stamped 0: fill in",
        ),
        ("no_encoder_sample_near", "encoder_ns", "the encoder samples are stamped 0"),
    ],
)
def test_stamps_that_nobody_filled_in_are_not_asked_to_be_synchronised(
    reason, name, said
):
    spans = dict.fromkeys(
        ("detections_ns", "commands_ns", "encoder_ns"), (10**18, 10**18)
    )
    told = diagnose(Evidence({reason: 9}, 1, **(spans | {name: (0, 0)})))
    assert told.text.startswith(said)


@pytest.mark.parametrize("reason", list(REMEDY))
def test_every_reason_has_its_remedy_without_further_evidence(reason):
    finding = diagnose(Evidence({str(reason): 9}, 1))
    assert (
        str(finding)
        == f"9 of 10 detections were rejected as {reason}: {REMEDY[reason]}"
    )
    assert "\n" not in str(finding)


def test_marks_on_one_line_do_not_tell_x_from_y():
    marks = np.arange(-5, 6).astype(complex)
    named = NamedMarks(
        "0",
        View("0", 0.0, (0.0, 0.0)).on_stage(Artifact(11, 0.01, 0)),
        marks,
        -marks,
        0 * marks,
        0 * marks,
    )
    assert named.away(-marks) > 1
    told = diagnose(
        Evidence(
            {"stage_not_at_mark": 10}, 0, marks=(named,), pitch_m=0.01, limit_m=0.006
        )
    )
    assert told.text == REMEDY[Reason.NOT_AT_MARK]


def test_the_pose_of_a_plate_is_fitted_through_marks_taken_for_others():
    """Six of 81 marks, all on one side, seem to be four pitches away."""
    m, n = (each.ravel() for each in np.meshgrid(np.arange(-4, 5), np.arange(-4, 5)))
    marks, turn = m + 1j * n, np.exp(0.3j)
    at = turn * marks + (0.5 - 0.2j)
    at[(m == 4) & (n > -2)] += 4
    found, shift, left = _fitted(marks, at, False)
    assert (found, shift) == (
        pytest.approx(turn, abs=1e-3),
        pytest.approx(0.5 - 0.2j, abs=1e-3),
    )
    assert left < 0.01


def test_an_encoder_that_ends_early_is_not_another_clock():
    cell = scene(count=0, repeats=3)
    last = cell.detections[len(cell.detections) // 3].stamp_ns
    cell.samples = [s for s in cell.samples if s.stamp_ns < last]
    said = " ".join(findings(cell.events).values())
    assert "no_encoder_sample_near" in said and "clock" not in said


def declared(cell, *size):
    """Return the messages with another number of marks in the plan, e.g. 8 or 8, 5."""
    commands = [
        c
        if c.artifact is None
        else replace(
            c,
            artifact=replace(c.artifact, grid_size=size[0], grid_size_y=(*size, 0)[1]),
        )
        for c in cell.commands
    ]
    return [*commands, *cell.samples, *cell.detections]


def test_a_mark_that_is_read_many_times_is_not_a_stage_that_has_stopped():
    places = np.array([0j] * 5 + [3 + 1j] * 20)
    marks = SimpleNamespace(stage=places, sites=places, cells=np.zeros(25))
    seen = SimpleNamespace(
        marks=[marks], pitch_m=0.01, limit_m=1e-3, sense=Sense.MICROSCOPE_MOVES
    )
    assert _encoder_stopped(seen) is None
    marks.sites = places + np.where(np.arange(25) < 5, 0.0, np.linspace(0, 2, 25))
    assert (
        "the stage has stopped: it is indicated at x = 0.03 m, y = 0.01 m"
        in _encoder_stopped(seen)
    )


def test_an_encoder_that_stands_still_in_the_middle_of_a_small_plate():
    """It never was farther than a pitch along either axis from where it stopped."""
    cell = scene(count=0, repeats=4, size=3)
    stop = cell.detections[13]  # of the second pass over nine marks, the fifth
    place = next(s.positions for s in cell.samples if s.stamp_ns > stop.stamp_ns)
    assert (stop.m, stop.n) == (0, 0)
    cell.samples = [
        s if s.stamp_ns < stop.stamp_ns else replace(s, positions=place, velocities=())
        for s in cell.samples
    ]
    assert "the stage has stopped: it is indicated at" in findings(cell.events)[None]


@pytest.mark.parametrize(
    ("plate", "size", "said"),
    [
        (
            (7,),
            (5,),
            "the ids are those of 7 x 7 marks (m -3 to 3, n -3 to 3), not of 5 x 5; corr",
        ),
        (
            (7,),
            (9,),
            "the ids are those of 7 x 7 marks (m -3 to 3, n -3 to 3), not of 9 x 9; corr",
        ),
        (
            (6,),
            (7,),
            "the ids are those of 6 x 6 marks (m -3 to 2, n -3 to 2), not of 7 x 7; corr",
        ),
        (
            (7, 5),
            (5, 7),
            "those of 7 x 5 marks (m -3 to 3, n -2 to 2), not of 5 x 7 (the sides are "
            "exchanged); correct grid_size in the plan",
        ),
    ],
)
def test_a_plate_of_another_size_is_named_by_its_ids(plate, size, said):
    plan = plan_of("0, 180, tx, ty", plate[0], size_y=(*plate, 0)[1])
    events = declared(scene(plan), *size)
    (found,) = findings(events).values()
    assert said in found


@pytest.mark.parametrize("text", ["0, 90", "0, 90, 180, tx, ty", "tx, tx2"])
def test_a_plate_of_the_declared_size_is_not_suspected(text):
    """Not either if single ids are misread, or a view is still being measured."""
    cell = scene(plan_of(text, 7, repeats=2))
    for index in range(0, len(cell.detections), 9):
        cell.spoil(index, m=cell.detections[index].m + 9)
    for part in (len(cell.detections), len(cell.detections) // 3):
        events = [*cell.commands, *cell.samples, *cell.detections[:part]]
        assert not any(
            "the ids are those" in found for found in findings(events).values()
        )


def test_few_stray_ids_among_other_rejections_are_no_other_plate():
    """All others have no ids: the strays alone would be a plate of one mark."""
    cell = scene(plan_of("0, 90, tx", 7, repeats=2), with_ids=False)
    for index in range(0, len(cell.detections) - 1, 9):
        cell.spoil(
            index, **({"has_id": True, "m": 9999} if index % 2 else {"score": 1e-3})
        )
        cell.spoil(index + 1, score=1e-3)
    rejected = gathered(cell.events).collect()[0].all_rejected()
    assert 5 <= rejected["unknown_mark"] < rejected["low_score"]
    assert findings(cell.events) == {}


def test_the_cause_of_many_rejections_is_stated_with_a_result():
    assert (
        rejections({"unknown_mark": 10, "duplicate": 500, "stage_moving": 99}, 90) == []
    )
    assert rejections({"low_score": 4, "unknown_mark": 8}, 90) == [
        f"12 of 102 detections were rejected, 8 of them as unknown_mark: "
        f"{REMEDY[Reason.UNKNOWN_MARK]}"
    ]
    (line,) = rejections({"from_the_future": 50}, 50)
    assert line.startswith("50 detections rejected as from_the_future")
