# SPDX-License-Identifier: Apache-2.0
"""The collector: a function of the set of messages; stamps decide, never arrival."""

import math
import random
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from selfcal_ros.collection.collector import Collector
from selfcal_ros.collection.expected import ViewProgress
from selfcal_ros.collection.inputs import (
    Command,
    Detection,
    EncoderSample,
    Phase,
    Reason,
)
from selfcal_ros.errors import InputError, NoDataError
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.readings import Sense, ViewReadings
from selfcal_ros.model.view import View
from selfcal_ros.settings.nodes import CollectorSettings
from selfcal_ros.simulation.spec import Faults, apply_faults
from test.support.collecting import START_NS, collect, digest, gathered, scene, table
from test.support.truth import angular_deviation, grid_deviation

MS = 1_000_000
ROUNDING_M = 1e-16


def mark_of(d: Detection) -> tuple:
    return ("line", d.k) if d.kind else ("grid", d.m, d.n)


def lost_marks(events, **parameters):
    """Return what is rejected, and the marks gone; all other marks keep every bit."""
    before = table(collect(scene().events)[0].views[0])
    found, _ = collect(events, **parameters)
    after = table(found.views[0])
    assert after.items() <= before.items()
    return found.all_rejected(), before.keys() - after.keys()


@pytest.mark.parametrize("sense", list(Sense))
def test_the_readings_are_the_deviations_of_the_truth(sense):
    cell = scene(
        "0, 90, tx, 270",
        line=True,
        sense=sense,
        servo_sigma_m=0.0,
        servo_sigma_theta_rad=0.0,
    )
    found, progress = collect(cell.events, measurement_sense=str(sense))
    assert found.sense is sense
    assert all(item.complete and item.coverage == 1.0 for item in progress.values())
    assert len(found.views) == 5
    for index, (view, readings) in enumerate(
        zip(cell.plan.views, found.views, strict=True)
    ):
        assert readings.view == view
        if view.grid:
            expected = grid_deviation(cell.truth, index, view, sense=sense)
            at = np.stack([readings.m, readings.n]) + 2
            assert len(readings.m) == np.isfinite(expected[0]).sum()
            np.testing.assert_allclose(
                np.stack([readings.dx, readings.dy]),
                expected[:, *at],
                rtol=0,
                atol=ROUNDING_M,
            )
        expected = angular_deviation(cell.truth, index, view, sense=sense)
        assert readings.k.tolist() == list(range(8))
        np.testing.assert_allclose(readings.dtheta, expected, rtol=0, atol=2e-15)


def test_the_other_sense_is_not_taken_for_this_one():
    cell = scene(sense=Sense.PLATE_MOVES)
    found, _ = collect(cell.events)
    assert len(found.views[0].m) <= 1  # at most the centre mark can be where it should


@pytest.mark.parametrize("number", [8, 12, 25])
def test_a_gap_in_the_encoder_stream(number):
    cell = scene()
    d = cell.detections[number]
    cell.samples = [s for s in cell.samples if abs(s.stamp_ns - d.stamp_ns) > 52 * MS]
    rejected, lost = lost_marks(cell.events)
    assert mark_of(d) in lost
    assert rejected == {"no_encoder_sample_near": len(lost)}
    assert 10 <= len(lost) <= 11  # one exposure in 10 ms
    wide, _ = collect(cell.events, max_encoder_gap=0.12)
    assert "no_encoder_sample_near" not in wide.all_rejected()


@pytest.mark.parametrize("late", [False, True])
def test_no_encoder_sample_before_or_after(late):
    cell = scene()
    d = cell.detections[-1 if late else 0]
    cell.samples = [s for s in cell.samples if (s.stamp_ns < d.stamp_ns) == late]
    rejected, lost = lost_marks(cell.events)
    assert lost == {mark_of(d)}
    assert rejected == {"no_encoder_sample_near": 1}


def test_without_any_encoder_sample_nothing_is_read():
    cell = scene()
    cell.samples = []
    found, progress = collect(cell.events)
    assert found.all_rejected() == {"no_encoder_sample_near": 33}
    assert progress[0].coverage == 0.0


def test_an_exposure_while_the_stage_moves():
    cell = scene()
    index = cell.grid(6)
    mark = mark_of(cell.detections[index])
    cell.spoil(index, stamp_ns=cell.detections[index].stamp_ns + 4 * MS)
    rejected, lost = lost_marks(cell.events)
    assert (rejected, lost) == ({"stage_moving": 1}, {mark})


def test_an_exposure_while_theta_turns():
    cell = scene()
    index = cell.angular(6)
    cell.spoil(index, stamp_ns=cell.detections[index].stamp_ns + 4 * MS)
    assert lost_marks(cell.events) == ({"stage_moving": 1}, {("line", 6)})


@pytest.mark.parametrize(
    ("rate", "moving"), [(4e-4, False), (6e-4, True), (-6e-4, True)]
)
def test_an_encoder_that_tells_of_motion_in_its_velocity(rate, moving):
    cell = scene()
    d = cell.detections[cell.grid(6)]
    cell.samples = [
        replace(
            s,
            velocities=(
                0.0,
                rate if abs(s.stamp_ns - d.stamp_ns) < 3 * MS else 0.0,
                0.0,
            ),
        )
        for s in cell.samples
    ]
    rejected, lost = lost_marks(cell.events)
    assert lost == ({mark_of(d)} if moving else set())
    assert rejected == ({"stage_moving": 1} if moving else {})


def test_samples_that_contradict_each_other_at_one_stamp():
    cell = scene()
    d = cell.detections[cell.grid(6)]
    sample = max(
        (s for s in cell.samples if s.stamp_ns < d.stamp_ns), key=lambda s: s.stamp_ns
    )
    x, y, theta = sample.positions
    cell.samples.append(replace(sample, positions=(x + 1e-6, y, theta)))
    rejected, lost = lost_marks(cell.events)
    assert rejected == {"encoder_contradiction": len(lost)}
    near = {
        mark_of(o)
        for o in cell.detections
        if abs(o.stamp_ns - sample.stamp_ns) <= 50 * MS
    }
    assert lost == near
    cell.samples[-1] = replace(sample, positions=(x + 1e-10, y, theta))
    assert lost_marks(cell.events, encoder_agreement=1e-9)[0] == {}


def test_a_clock_that_steps_back_makes_samples_interleave():
    cell = scene()
    d = cell.detections[cell.grid(12)]
    echo = [
        EncoderSample(s.stamp_ns + MS, s.names, (0.0499, 0.0499, 1.0))
        for s in cell.samples
        if abs(s.stamp_ns - d.stamp_ns) < 30 * MS
    ]
    rejected, lost = lost_marks([*cell.events, *echo])
    assert rejected == {"encoder_contradiction": len(lost)}
    assert len(lost) == 6
    assert mark_of(d) in lost


def test_a_stepped_clock_is_never_used_silently():
    cell = scene("0, 90", repeats=3)
    arrivals, _ = apply_faults(
        sorted(cell.events, key=lambda e: e.stamp_ns),
        Faults(clock_step_s=0.1555),
        np.random.default_rng(1),
    )
    found, _ = collect([event for _, event in arrivals])
    assert found.all_rejected()["encoder_contradiction"] > 3
    for index, readings in enumerate(found.views):
        expected = grid_deviation(cell.truth, index, readings.view)
        at = np.stack([readings.m, readings.n]) + 2
        np.testing.assert_allclose(
            np.stack([readings.dx, readings.dy]), expected[:, *at], rtol=0, atol=2e-11
        )


@pytest.mark.parametrize("phase", [Phase.DONE, Phase.ABORT])
def test_detections_outside_of_views(phase):
    cell = scene()
    place, measure, done = cell.commands
    cell.commands[2] = replace(done, phase=phase)
    before = replace(cell.detections[0], stamp_ns=place.stamp_ns - 1)
    placing = replace(cell.detections[1], stamp_ns=measure.stamp_ns - 1)
    after = replace(cell.detections[2], stamp_ns=done.stamp_ns)
    found, _ = collect([*cell.events, before, placing, after])
    assert found.rejected == {"outside_every_view": 3}
    assert found.views[0].rejected == {}
    assert table(found.views[0]) == table(collect(scene().events)[0].views[0])


def test_a_view_begins_at_its_stamp_and_ends_just_before_the_next_command():
    cell = scene()
    first, last = cell.detections[0], cell.detections[-1]
    cell.commands[1] = replace(cell.commands[1], stamp_ns=first.stamp_ns)
    cell.commands[2] = replace(cell.commands[2], stamp_ns=last.stamp_ns)
    assert lost_marks(cell.events) == ({"outside_every_view": 1}, {mark_of(last)})


def again(cell, *, place, after):
    """Command view 0 again after a detection: with a new PLACE, or only MEASURE."""
    at = cell.detections[after].stamp_ns + 1
    extra = [replace(cell.commands[0], stamp_ns=at)] if place else []
    return [*cell.events, *extra, replace(cell.commands[1], stamp_ns=at + 1)]


def test_a_view_placed_again_supersedes_what_was_read_before():
    cell = scene()
    rejected, lost = lost_marks(again(cell, place=True, after=9))
    assert rejected == {"superseded_by_redo": 10}
    assert lost == {mark_of(d) for d in cell.detections[:10]}


def test_a_second_measure_without_place_continues_the_view():
    assert lost_marks(again(scene(), place=False, after=9)) == ({}, set())


def test_a_view_placed_again_but_not_measured_keeps_its_readings():
    cell = scene()
    place = replace(cell.commands[0], stamp_ns=cell.detections[9].stamp_ns + 1)
    rejected, lost = lost_marks([*cell.events, place])
    assert rejected == {"outside_every_view": 23}
    assert len(lost) == 23


def test_views_of_another_plan():
    cell = scene("0, 90")
    other = [
        replace(c, plan_id="other", stamp_ns=c.stamp_ns)
        for c in cell.commands
        if c.view_index == 0
    ]
    cell.commands = [*other, *(c for c in cell.commands if c.view_index != 0)]
    found, progress = collect(cell.events)
    assert found.all_rejected() == {"other_plan": 33}
    assert list(progress) == [1]
    assert progress[1].complete


def test_one_plan_has_one_plate():
    cell = scene("0, 90")
    wider = [
        replace(c, artifact=Artifact(5, 0.011, 8))
        if c.view_index == 0 and c.view
        else c
        for c in cell.commands
    ]
    wider = [
        replace(c, view=replace(c.view, translation_m=(0.0, 0.0))) if c.view else c
        for c in wider
    ]
    with pytest.raises(
        InputError, match="a different plate from the rest of plan '0, 90'"
    ):
        collect([*wider, *cell.samples, *cell.detections])


@pytest.mark.parametrize("rotation", [0.1, math.nan, math.inf])
def test_a_command_off_the_lattice_is_refused_and_changes_nothing(rotation):
    cell = scene()
    collector = gathered(cell.events)
    bad = replace(
        cell.commands[1], view=replace(cell.commands[1].view, rotation_rad=rotation)
    )
    with pytest.raises(InputError, match="view '0'"):
        collector.add_command(bad)
    assert collector.received["command"] == 3
    assert table(collector.collect()[0].views[0]) == table(
        collect(cell.events)[0].views[0]
    )
    collector.refuse("command", Reason.COMMAND_BAD)
    assert collector.collect()[0].all_rejected() == {"command_unusable": 1}


def test_no_measure_command_is_no_data():
    cell = scene()
    text = "^selfcal/view_command: no MEASURE command; readings cannot be assigned"
    for commands in ([], cell.commands[:1]):
        with pytest.raises(NoDataError, match=text) as caught:
            collect([*commands, *cell.samples, *cell.detections])
        assert caught.value.exit_code == 4


@pytest.mark.parametrize(
    ("sample", "reason"),
    [
        (
            EncoderSample(START_NS, ("a", "b"), (0.0, 0.0)),
            "encoder_sample_unknown_joint",
        ),
        (EncoderSample(START_NS, (), ()), "encoder_sample_unknown_joint"),
        (
            EncoderSample(START_NS, ("x", "y"), (0.0, math.nan)),
            "encoder_sample_not_finite",
        ),
        (EncoderSample(START_NS, ("x",), (-math.inf,)), "encoder_sample_not_finite"),
        (EncoderSample(START_NS, ("x", "y"), (0.0,)), "encoder_sample_malformed"),
        (
            EncoderSample(START_NS, ("x",), (0.0,), (0.0, 0.0)),
            "encoder_sample_malformed",
        ),
    ],
)
def test_encoder_samples_that_cannot_be_used(sample, reason):
    assert lost_marks([*scene().events, sample]) == ({reason: 1}, set())


def test_one_joint_in_each_message_and_joints_of_other_machines():
    cell = scene()
    apart = [
        EncoderSample(s.stamp_ns, (name, "gripper"), (position, 99.0))
        for s in cell.samples
        for name, position in zip(s.names, s.positions, strict=True)
    ]
    assert lost_marks([*cell.commands, *cell.detections, *apart]) == ({}, set())
    shuffled = [
        EncoderSample(
            s.stamp_ns,
            ("z", *s.names[::-1]),
            (7.0, *s.positions[::-1]),
            (5.0, 0.0, 0.0, 0.0),
        )
        for s in cell.samples
    ]
    assert lost_marks([*cell.commands, *cell.detections, *shuffled]) == ({}, set())


def test_names_of_joints_are_parameters():
    cell = scene()
    renamed = [replace(s, names=("ax1", "ax2", "c")) for s in cell.samples]
    assert lost_marks(
        [*cell.commands, *cell.detections, *renamed],
        joint_x="ax1",
        joint_y="ax2",
        joint_theta="c",
    ) == ({}, set())


@pytest.mark.parametrize("turns", [-1, 1, 3])
def test_theta_may_be_indicated_in_any_turn(turns):
    cell, plain = scene(), table(collect(scene().events)[0].views[0])
    cell.samples = [
        replace(s, positions=(*s.positions[:2], s.positions[2] + turns * 2 * math.pi))
        for s in cell.samples
    ]
    found, _ = collect(cell.events)
    assert found.all_rejected() == {}
    read = table(found.views[0])
    assert max(abs(read["line", k][0] - plain["line", k][0]) for k in range(8)) < 2e-14


def test_theta_that_wraps_between_two_samples_stands_still():
    cell = scene()
    at_zero = [
        s
        for s in cell.samples
        if s.positions[0] == s.positions[1] == 0.0 and abs(s.positions[2]) < 1e-6
    ]
    flipped = {id(s) for s in at_zero[::2]}
    cell.samples = [
        replace(s, positions=(*s.positions[:2], s.positions[2] + 2 * math.pi))
        if id(s) in flipped
        else s
        for s in cell.samples
    ]
    found, _ = collect(cell.events)
    assert len(flipped) >= 2
    assert found.all_rejected() == {}
    assert (
        abs(
            table(found.views[0])["line", 0][0]
            - angular_deviation(cell.truth, 0, cell.plan.views[0])[0]
        )
        < 1e-9
    )


NOISY = {"sigma_xy_m": 2e-8, "sigma_theta_rad": 2e-6}
EVERYTHING = Faults(
    lost=0.03,
    duplicated=0.05,
    outliers=0.02,
    low_score=0.02,
    not_finite=0.02,
    unknown_mark=0.02,
    clock_step_s=0.1555,
    encoder_gap_s=0.3,
)


def spoilt_events(**settings):
    cell = scene("0, 90, tx", line=True, repeats=3, **NOISY, **settings)
    arrivals, _ = apply_faults(
        sorted(cell.events, key=lambda e: e.stamp_ns),
        EVERYTHING,
        np.random.default_rng(8),
    )
    return [event for _, event in arrivals]


SPOILT = {ids: spoilt_events(with_ids=ids) for ids in (True, False)}
SPOILT_DIGEST = cache(lambda ids: digest(SPOILT[ids]))


@settings(max_examples=12)
@given(seed=st.integers(0, 2**32), ids=st.booleans())
def test_any_order_of_all_messages_gives_the_same_bits(seed, ids):
    events = list(SPOILT[ids])
    random.Random(seed).shuffle(events)
    assert digest(events) == SPOILT_DIGEST(ids)


def few_events():
    cell = scene(size=3, count=0)
    return [*cell.commands, *cell.samples[::2], *cell.detections, *cell.detections[:3]]


FEW = few_events()
FEW_DIGEST = cache(lambda: digest(FEW))


@settings(max_examples=20)
@given(st.permutations(FEW))
def test_any_order_of_few_messages_gives_the_same_bits(events):
    assert digest(events) == FEW_DIGEST()


@settings(max_examples=8)
@given(seed=st.integers(0, 2**32))
def test_repeated_samples_and_commands_change_nothing(seed):
    draw = random.Random(seed)
    events = SPOILT[True]
    again = [e for e in events if not isinstance(e, Detection) and draw.random() < 0.3]
    assert digest([*events, *again]) == SPOILT_DIGEST(True)


def test_the_digest_tells_readings_apart():
    cell = scene()
    before = digest(cell.events)
    index = cell.grid(0)
    cell.spoil(index, offset_x=cell.detections[index].offset_x + 1e-17)
    assert digest(cell.events) != before
    zeros = [scene(), scene()]
    for zero, sign in zip(zeros, (0.0, -0.0), strict=True):
        for field in ("offset_x", "offset_y", "sigma", "score"):
            zero.spoil(index, **{field: sign})
        zero.spoil(zero.angular(0), offset_theta=sign)
    assert len({digest(zero.events) for zero in zeros}) == 1
    outside = replace(cell.detections[0], stamp_ns=0)
    assert digest([*scene().events, outside]) != before


def test_collecting_early_does_not_change_what_is_collected_later():
    events = scene("0, 90").events
    collector = gathered(events[:1] + events[6:40])
    with pytest.raises(NoDataError):
        collector.collect()
    for event in events[1:6] + events[40:]:
        (
            collector.add_command
            if isinstance(event, Command)
            else collector.add_detection
            if isinstance(event, Detection)
            else collector.add_encoder
        )(event)
        if collector.timeline.artifact is not None and isinstance(event, Detection):
            collector.collect()
    found, _ = collector.collect()
    want, _ = collect(events)
    assert [table(v) for v in found.views] == [table(v) for v in want.views]


def test_a_view_that_asks_for_nothing_in_the_field_is_covered():
    readings = ViewReadings(View("off"))
    assert ViewProgress(0, readings.view, 0, 0, 0, 0, readings, 0).coverage == 1.0
    assert ViewProgress(0, readings.view, 3, 0, 5, 0, readings, 0).coverage == 0.0


def test_progress_counts_marks_and_repeats():
    cell = scene("tx", repeats=2)
    found, progress = collect(cell.events)
    assert (progress[0].grid_expected, progress[0].grid_done) == (20, 20)
    assert (progress[0].angular_expected, progress[0].angular_done) == (8, 8)
    assert progress[0].end_ns == cell.commands[2].stamp_ns
    del cell.detections[0]
    _, progress = collect(cell.events)
    assert progress[0].grid_done == 19
    assert not progress[0].complete
    assert progress[0].coverage == pytest.approx(55 / 56)
    assert found.views[0].used == 56


def test_the_first_of_two_passes_over_the_plate_is_half_of_the_view():
    """No mark is read as often as the plan asks, and the operator is to see that it goes on."""
    cell = scene(repeats=2)
    first = {mark_of(one): one for one in reversed(cell.detections)}
    cell.detections = list(first.values())
    _, progress = collect(cell.events)
    assert (progress[0].grid_done, progress[0].coverage) == (0, 0.5)


def test_the_encoder_was_heard_from_its_first_joint_to_its_last():
    collector = Collector(CollectorSettings())
    for stamp in range(100, 301, 50):
        collector.add_encoder(EncoderSample(stamp, ("x", "y"), (0.0, 0.0)))
    for stamp in range(40, 201, 40):
        collector.add_encoder(EncoderSample(stamp, ("theta",), (0.0,)))
    assert collector._facts().span_ns == (40, 300)
