# SPDX-License-Identifier: Apache-2.0
"""Readings asked for at any time, messages late and in any order: the bits of the whole set."""

import random
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from selfcal_ros.collection import view_readings
from selfcal_ros.collection.collector import Collector
from selfcal_ros.collection.encoder import JointTrack, TrackLimits
from selfcal_ros.collection.exposures import Exposures, Tracks
from selfcal_ros.collection.inputs import (
    DETECTION,
    Command,
    Detection,
    EncoderBlock,
    EncoderSample,
)
from selfcal_ros.collection.marks import identify, repeats
from selfcal_ros.collection.samples import Limits
from selfcal_ros.errors import NoDataError
from selfcal_ros.model.readings import readings_digest, session_digest
from selfcal_ros.settings.nodes import CollectorSettings
from selfcal_ros.simulation.spec import Faults, apply_faults
from test.support.collecting import collect, digest, scene

FAULTS = Faults(
    lost=0.02,
    duplicated=0.03,
    outliers=0.02,
    low_score=0.01,
    not_finite=0.01,
    unknown_mark=0.01,
    clock_step_s=0.1555,
    encoder_gap_s=0.3,
)
SMALL = Limits(block=32, in_memory=2)


def a_session(repeats=2):
    cell = scene(
        "0, 90, tx", line=True, repeats=repeats, sigma_xy_m=2e-8, sigma_theta_rad=2e-6
    )
    arrivals, _ = apply_faults(
        sorted(cell.events, key=lambda e: e.stamp_ns), FAULTS, np.random.default_rng(5)
    )
    redo = [replace(c, stamp_ns=c.stamp_ns + 70_000_000) for c in cell.commands[:2]]
    return [*(event for _, event in arrivals), *redo]


EVENTS = a_session()
WANTED = digest(EVENTS)


def fresh(store=SMALL, **parameters):
    return Collector(CollectorSettings.checked(parameters, "test"), store)


def add(collector, event):
    (
        collector.add_command
        if isinstance(event, Command)
        else collector.add_detection
        if isinstance(event, Detection)
        else collector.add_encoder
    )(event)


def digest_of(collector):
    measurements, progress = collector.collect()
    return session_digest(
        {
            index: readings_digest(item.readings, measurements.rejected)
            for index, item in progress.items()
        }
    )


def late(seed, spread):
    """Return the session with every message late by up to `spread` places."""
    draw = random.Random(seed)
    return [
        event
        for _, event in sorted(
            ((at + draw.uniform(0, spread), at), event)
            for at, event in enumerate(EVENTS)
        )
    ]


def test_commands_of_a_run_with_another_plate_that_come_after_its_detections():
    """What lay in the first view lies in the first view again, of another plate."""
    cell = scene("0", repeats=1)
    begin = cell.commands[0].stamp_ns
    place, measure = (
        replace(command, run_id=str(begin)) for command in cell.commands[:2]
    )
    wide = replace(
        cell.plan.artifact, grid_pitch_m=1.5 * cell.plan.artifact.grid_pitch_m
    )
    later = [
        replace(
            command, stamp_ns=command.stamp_ns + 1, run_id=str(begin + 1), artifact=wide
        )
        for command in (place, measure)
    ]
    events = [
        place,
        measure,
        *(e for e in cell.events if not isinstance(e, Command)),
        *later,
    ]
    collector = fresh()
    for event in events:
        if event is later[0]:
            before = digest_of(collector)
        add(collector, event)
    assert digest_of(collector) == digest(events) != before


@settings(max_examples=8)
@given(
    seed=st.integers(0, 2**32),
    spread=st.sampled_from([0, 5, 200, 10**6]),
    asked=st.sets(st.integers(0, len(EVENTS)), max_size=8),
)
def test_what_is_asked_on_the_way_changes_nothing(seed, spread, asked):
    collector = fresh()
    for at, event in enumerate(late(seed, spread)):
        add(collector, event)
        if at in asked:
            try:
                so_far = digest_of(collector)
            except NoDataError:
                continue
            assert so_far == digest(late(seed, spread)[: at + 1])
    assert digest_of(collector) == WANTED


@pytest.mark.parametrize("size", [1, 7, 100])
def test_how_many_are_looked_at_together_changes_nothing(monkeypatch, size):
    for module, name in (
        (view_readings, "TOGETHER"),
        (identify, "PART"),
        (repeats, "PART"),
    ):
        monkeypatch.setattr(module, name, size)
    assert digest(EVENTS) == digest(late(4, 10**6)) == WANTED


def blocks(events, size):
    """Return the events in blocks of messages of one form, in the order of their arrival."""
    out = []
    for start in range(0, len(events), size):
        part = events[start : start + size]
        samples: dict[tuple, list[EncoderSample]] = {}
        for event in part:
            if isinstance(event, EncoderSample):
                samples.setdefault((event.names, bool(event.velocities)), []).append(
                    event
                )
        out += [("encoder", names, group) for (names, _), group in samples.items()]
        out += [("detection", None, [e for e in part if isinstance(e, Detection)])]
        out += [("command", None, [e for e in part if isinstance(e, Command)])]
    return out


def feed_block(collector, kind, names, group):
    if kind == "encoder":
        collector.add_encoder_block(EncoderBlock.of(group))
    elif kind == "detection":
        rows = [
            (
                d.stamp_ns,
                d.kind,
                d.has_id,
                d.m,
                d.n,
                d.k,
                d.offset_x,
                d.offset_y,
                d.offset_theta,
                d.sigma,
                d.score,
            )
            for d in group
        ]
        collector.add_detection_block(np.array(rows, dtype=DETECTION))
    else:
        for command in group:
            collector.add_command(command)


@pytest.mark.parametrize("size", [7, 333, 10**6])
@pytest.mark.parametrize("speeds", [False, True])
def test_blocks_give_what_single_messages_give(size, speeds):
    rng = np.random.default_rng(2)
    events = [
        replace(e, velocities=tuple(rng.normal(0, 1e-5, 3).tolist()))
        if speeds and isinstance(e, EncoderSample)
        else e
        for e in EVENTS
    ]
    single, blocked = fresh(), fresh()
    for event in events:
        add(single, event)
    for kind, names, group in blocks(events, size):
        feed_block(blocked, kind, names, group)
    assert digest_of(blocked) == digest_of(single)
    assert blocked.received == single.received
    assert blocked.unusable == single.unusable


@pytest.mark.parametrize(
    ("names", "positions", "velocities", "reasons"),
    [
        (("a", "b"), [[0.0, 0.0]] * 3, None, {"encoder_sample_unknown_joint": 3}),
        ((), np.zeros((3, 0)), None, {"encoder_sample_unknown_joint": 3}),
        (("x", "y"), [[0.0]] * 3, None, {"encoder_sample_malformed": 3}),
        (("x",), [[0.0]] * 3, [[0.0, 0.0]] * 3, {"encoder_sample_malformed": 3}),
        (
            ("x", "y"),
            [[0.0, np.nan], [np.inf, np.nan], [1.0, 2.0]],
            None,
            {"encoder_sample_not_finite": 2},
        ),
    ],
)
def test_blocks_that_cannot_be_used_are_counted(names, positions, velocities, reasons):
    collector = fresh()
    positions = np.array(positions)
    speeds = None if velocities is None else np.array(velocities)
    collector.add_encoder_block(EncoderBlock(np.arange(3), names, positions, speeds))
    assert collector.unusable == reasons
    assert collector.received == {"encoder": 3, "detection": 0, "command": 0}
    finite = (
        np.isfinite(positions) if "not_finite" in str(reasons) else np.zeros((3, 2))
    )
    assert [len(collector.tracks.x), len(collector.tracks.y)] == finite.sum(
        axis=0
    ).tolist()


def looks(monkeypatch):
    """Return a list that fills with the number of exposures of each look at the encoder."""
    looked_up: list = []
    plain = Exposures._look_up
    monkeypatch.setattr(
        Exposures,
        "_look_up",
        lambda self, group: (looked_up.append(len(group)), plain(self, group)),
    )
    return looked_up


def without_theta(events, after_ns):
    """Return the events with no sample of theta after a stamp."""
    return [
        replace(e, names=e.names[:2], positions=e.positions[:2])
        if isinstance(e, EncoderSample) and e.stamp_ns > after_ns
        else e
        for e in events
    ]


@pytest.mark.parametrize("at_once", [True, False])
def test_a_motion_long_before_an_exposure_is_found_back_to_the_exposure_before(at_once):
    """At 1 kHz x steps forward soon after the exposure at 1 s, y back; the next is at 4 s."""
    limits, s = TrackLimits(100_000_000, 1.0, 1e-9), 1_000_000_000
    tracks = Tracks(*(JointTrack(limits) for _ in range(3)))
    ms = np.arange(6000)
    for track, step in zip(tracks, (1e-3, -1e-3, 0.0), strict=True):
        track.store.add_block(ms * 1_000_000, step * (ms > 1200))
    exposures = Exposures(tracks, approach_threshold_m=1e-6)
    stamps = np.array([1 * s, 4 * s, 5 * s])
    for some in (stamps,) if at_once else (stamps[:1], stamps[1:2], stamps[2:]):
        exposures.update(some)
    assert exposures.at(stamps).approach.tolist() == [[0, 1, 1], [0, -1, -1]]


@pytest.mark.parametrize("theta", ["is told", "ends", "is not told"])
def test_a_settled_exposure_is_not_looked_up_again(monkeypatch, theta):
    looked_up = looks(monkeypatch)
    cell = scene("0, 90, 180", count=0, repeats=4)
    events = sorted(cell.events, key=lambda e: e.stamp_ns)
    if theta != "is told":
        events = without_theta(events, events[300 if theta == "ends" else 0].stamp_ns)
        assert events[-2].names == ("x", "y")
    collector, asked = fresh(), 0
    for at, event in enumerate(events):
        add(collector, event)
        if at > 400 and at % 50 == 0:
            collector.collect()
            asked += 1
    # 36 samples behind an exposure decide about it: those of the last 8 exposures, 10 to a status
    assert sum(looked_up) - len(cell.detections) <= 10 * asked
    assert asked > 20
    assert digest_of(collector) == digest(events)


def test_a_joint_that_is_told_late_is_looked_up_with_all_exposures(monkeypatch):
    cell = scene("0, 90", count=8, repeats=1)
    events = sorted(cell.events, key=lambda e: e.stamp_ns)
    bare = without_theta(events, 0)
    collector = fresh()
    for event in bare:
        add(collector, event)
    before = collector.collect()[0].all_rejected()
    assert before["no_encoder_sample_near"] == 2 * 8  # the lines need theta
    for sample in (e for e in events if isinstance(e, EncoderSample)):
        add(collector, EncoderSample(sample.stamp_ns, ("theta",), sample.positions[2:]))
    assert "no_encoder_sample_near" not in collector.collect()[0].all_rejected()
    assert digest_of(collector) == digest(events)


def test_views_that_have_not_changed_keep_their_readings():
    cell = scene("0, 90", count=0)
    begin = next(c.stamp_ns for c in cell.commands if c.view_index == 1)
    collector = fresh()
    for event in cell.events:
        if event.stamp_ns < begin + 50_000_000:
            add(collector, event)
    first = collector.collect()[0].views[0]
    for event in cell.events:
        if event.stamp_ns >= begin + 50_000_000:
            add(collector, event)
    views = collector.collect()[0].views
    assert views[0] is first
    assert collector.collect()[0].views[1] is views[1]
    late_one = replace(cell.detections[3], stamp_ns=cell.detections[3].stamp_ns + 100)
    add(collector, late_one)
    changed = collector.collect()[0].views
    assert changed[0] is not first and changed[1] is views[1]


def test_a_sample_that_comes_after_hours_finds_its_exposure():
    cell = scene(count=0)
    d = cell.detections[12]
    beside = [s for s in cell.samples if abs(s.stamp_ns - d.stamp_ns) < 60_000_000]
    collector = fresh()
    for event in cell.events:
        if event not in beside:
            add(collector, event)
    before = collector.collect()[0].all_rejected()
    assert before["no_encoder_sample_near"] >= 10
    hours = [
        EncoderSample(
            cell.samples[-1].stamp_ns + 2_000_000 * k,
            ("x", "y", "theta"),
            (0.0, 0.0, 0.0),
        )
        for k in range(200, 700)
    ]
    for event in [*hours, *beside]:
        add(collector, event)
    assert collector.collect()[0].all_rejected() == {}
    assert digest_of(collector) == digest([*cell.events, *hours])


def test_a_late_sample_finds_its_exposure_beside_one_that_is_new():
    cell = scene(count=0)
    at_ns = cell.detections[12].stamp_ns
    nearest = min(cell.samples, key=lambda s: abs(s.stamp_ns - at_ns))
    others = [event for event in cell.events if event is not nearest]
    x, y, theta = nearest.positions
    late_one = replace(nearest, positions=(x + 1e-7, y, theta))
    new = replace(
        cell.samples[-1], stamp_ns=cell.samples[-1].stamp_ns + 3_600_000_000_000
    )
    collector = fresh()
    for event in others:
        add(collector, event)
    collector.collect()
    add(collector, new)
    add(collector, late_one)
    assert (
        digest_of(collector)
        == digest([*others, late_one, new])
        != digest([*others, new])
    )


def test_scores_that_are_reported_late_count_for_all():
    cell = scene(count=0)
    for index in range(25):
        cell.spoil(index, score=0.0)
    collector = fresh()
    for event in cell.events:
        add(collector, event)
    assert collector.collect()[0].views[0].used == 25
    add(collector, replace(cell.detections[0], stamp_ns=1, score=0.9))
    assert collector.collect()[0].all_rejected() == {
        "low_score": 25,
        "outside_every_view": 1,
    }


def test_a_command_that_comes_late_moves_readings_to_their_view():
    cell = scene("0, 90", count=0)
    collector = fresh()
    for event in cell.events:
        if not (isinstance(event, Command) and event.view_index == 1):
            add(collector, event)
    collector.collect()
    for event in cell.commands:
        if event.view_index == 1:
            add(collector, event)
    assert digest_of(collector) == digest(cell.events)
    assert collect(cell.events)[0].run_id == collector.collect()[0].run_id
