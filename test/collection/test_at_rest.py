# SPDX-License-Identifier: Apache-2.0
"""A reading counts only where the whole stage rests, also joints that it does not need."""

import math
from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.collection.encoder import TrackLimits
from selfcal_ros.collection.inputs import EncoderSample, Kind, Reason
from test.support.collecting import collect, scene, table
from test.support.encoder import JointTrack

MS = 1_000_000
LIMITS = TrackLimits(100 * MS, 1.0, 1e-9)


def moved(cell, joint, about_ns, *, speed=None, drift=0.0):
    """Let one joint drift (per s) within 20 ms of an instant, or only say that it is fast."""
    index = ("x", "y", "theta").index(joint)
    for at, sample in enumerate(cell.samples):
        away = sample.stamp_ns - about_ns
        positions, told = list(sample.positions), [0.0] * 3
        positions[index] += drift * (20 * MS + min(max(away, -20 * MS), 20 * MS)) / 1e9
        told[index] = (speed or 0.0) * (abs(away) <= 20 * MS)
        cell.samples[at] = replace(
            sample,
            positions=tuple(positions),
            velocities=() if speed is None else tuple(told),
        )


@pytest.mark.parametrize(
    ("drift", "moving"), [(0.1, True), (-0.1, True), (0.004, False)]
)
def test_a_grid_reading_while_theta_turns(drift, moving):
    cell = scene()
    at = cell.detections[cell.grid(12)].stamp_ns
    moved(cell, "theta", at, drift=drift)
    found, _ = collect(cell.events)
    near = sum(abs(d.stamp_ns - at) <= 20 * MS for d in cell.detections)
    assert near == 5
    assert found.all_rejected() == ({"stage_moving": near} if moving else {})
    before, after = table(collect(scene().events)[0].views[0]), table(found.views[0])
    assert {m: v for m, v in after.items() if m[0] == "grid"}.items() <= before.items()


@pytest.mark.parametrize("joint", ["x", "y"])
@pytest.mark.parametrize(
    ("drift", "moving"), [(0.01, True), (-0.01, True), (4e-4, False)]
)
def test_an_angular_reading_while_x_or_y_moves(joint, drift, moving):
    cell = scene()
    at = cell.detections[cell.angular(4)].stamp_ns
    moved(cell, joint, at, drift=drift)
    found, _ = collect(cell.events)
    near = [
        d.k
        for d in cell.detections
        if d.kind == Kind.ANGULAR and abs(d.stamp_ns - at) <= 20 * MS
    ]
    assert found.all_rejected() == ({"stage_moving": len(near)} if moving else {})
    assert set(found.views[0].k) == set(range(8)) - set(near if moving else ())


@pytest.mark.parametrize(
    ("speed", "moving"), [(0.004, False), (0.006, True), (-0.006, True)]
)
def test_a_told_turn_rate_counts_for_a_grid_reading(speed, moving):
    cell = scene()
    moved(cell, "theta", cell.detections[cell.grid(12)].stamp_ns, speed=speed)
    found, _ = collect(cell.events)
    assert bool(found.all_rejected()) == moving
    assert set(found.all_rejected()) <= {"stage_moving"}


def test_a_detection_that_two_joints_reject_counts_once():
    cell = scene()
    at = cell.detections[cell.grid(12)].stamp_ns
    for joint in ("x", "theta"):
        moved(cell, joint, at, drift=0.006)
    assert collect(cell.events)[0].all_rejected() == {"stage_moving": 5}


def test_a_stage_without_theta_encoder_reads_the_grid():
    cell = scene(count=0)
    cell.samples = [
        EncoderSample(s.stamp_ns, ("x", "y"), s.positions[:2]) for s in cell.samples
    ]
    found, _ = collect(cell.events)
    assert found.all_rejected() == {}
    assert table(found.views[0]) == table(collect(scene(count=0).events)[0].views[0])


def test_a_theta_encoder_that_falls_silent_or_contradicts_itself_does_not_touch_the_grid():
    cell = scene(count=0)
    half = cell.detections[12].stamp_ns
    silent = [
        s
        if s.stamp_ns < half
        else EncoderSample(s.stamp_ns, ("x", "y"), s.positions[:2])
        for s in cell.samples
    ]
    echo = [EncoderSample(s.stamp_ns, ("theta",), (0.5,)) for s in cell.samples]
    for samples in (silent, [*cell.samples, *echo]):
        found, _ = collect([*cell.commands, *samples, *cell.detections])
        assert found.all_rejected() == {}


@pytest.mark.parametrize("size", [1e-5, 1e-3])
def test_noise_of_an_unneeded_joint_is_no_motion(size):
    cell, rng = scene(count=0), np.random.default_rng(1)
    told = rng.normal(0, 100 * size, len(cell.samples))
    for velocities in (False, True):
        noisy = [
            replace(
                s,
                positions=(*s.positions[:2], rng.normal(0, size)),
                velocities=(0.0, 0.0, rate) if velocities else (),
            )
            for s, rate in zip(cell.samples, told, strict=True)
        ]
        found, _ = collect([*cell.commands, *noisy, *cell.detections])
        assert found.all_rejected() == {}


def test_noise_of_a_told_speed_is_no_motion_though_the_position_stands_still():
    cell, rng = scene(count=0), np.random.default_rng(1)
    noisy = [
        replace(s, velocities=(0.0, 0.0, rng.normal(0, 0.05))) for s in cell.samples
    ]
    found, _ = collect([*cell.commands, *noisy, *cell.detections])
    assert found.all_rejected() == {}


def test_the_noise_is_that_of_all_samples_whenever_it_is_asked_for():
    joint, noise = JointTrack(LIMITS), np.random.default_rng(3).normal(0, 1e-4, 300)
    for number in range(10):
        joint.add(number * 2 * MS, 1.0 * (number == 9), math.nan)
    assert joint.moving(np.array([17 * MS])).tolist() == [Reason.MOVING]
    for number, position in enumerate(noise, 10):
        joint.add(number * 2 * MS, 1.0 + 1e4 * position, math.nan)
    assert joint.moving(np.array([17 * MS])).tolist() == [None]


@pytest.mark.parametrize("n", range(2, 8))
def test_three_samples_tell_noise_from_motion_and_two_do_not(n):
    """Samples come unevenly; the limit is 1 unit per s, the first two are 5 per s apart."""
    stamps_ms = np.array([0, 2, 5, 6, 9, 11, 12])[:n]
    shaken = np.array([0.0, 10, 13, 20, 30, 33, 40])[:n] * 1e-3
    for positions, moves in ((shaken, n == 2), (5e-3 * stamps_ms, True)):
        joint = JointTrack(LIMITS)
        for at, position in zip(stamps_ms.tolist(), positions.tolist(), strict=True):
            joint.add(at * MS, position, math.nan)
        assert joint.moving(np.array([MS])).tolist() == [
            Reason.MOVING if moves else None
        ]


def steps(rng, motion, *, sigma, speeds=False):
    """Return a track of 400 samples, 2 ms apart: noise on a motion in units per s."""
    joint, position = JointTrack(LIMITS), 0.0
    for number in range(400):
        rate = motion(number)
        joint.add(
            number * 2 * MS,
            position + rng.normal(0, sigma),
            rate if speeds else math.nan,
        )
        position += rate * 2e-3
    return joint


@pytest.mark.parametrize("speeds", [False, True])
@pytest.mark.parametrize("sigma", [0.0, 1e-4])
def test_motion_is_found_beside_noise_and_noise_alone_is_not(sigma, speeds):
    between = np.arange(400) * 2 * MS + MS
    still = steps(
        np.random.default_rng(1), lambda number: 0.0, sigma=sigma, speeds=speeds
    )
    assert not (still.moving(between[:-1]) == Reason.MOVING).any()
    some = steps(
        np.random.default_rng(1),
        lambda number: 5.0 * (100 <= number < 300),
        sigma=sigma,
        speeds=speeds,
    )
    found = some.moving(between[:-1]) == Reason.MOVING
    assert found[100:300].all()
    assert not found[:99].any() and not found[301:].any()
    steady = steps(
        np.random.default_rng(1), lambda number: 5.0, sigma=sigma, speeds=speeds
    )
    assert (steady.moving(between[:-1]) == Reason.MOVING).all()
    at_samples = steady.moving(np.arange(1, 399) * 2 * MS)
    assert (at_samples == Reason.MOVING).all()


def test_a_joint_without_samples_near_does_not_move():
    joint = JointTrack(LIMITS)
    assert joint.moving(np.array([5])).tolist() == [None]
    joint.add(0, 0.0, math.nan)
    assert joint.moving(np.array([0, 5])).tolist() == [None, None]
    joint.add(200 * MS, 50.0, 9.0)
    assert joint.moving(np.array([100 * MS, 200 * MS])).tolist() == [
        None,
        Reason.MOVING,
    ]
    assert joint.moving(np.zeros(0, dtype=np.int64)).tolist() == []


def test_of_equal_samples_the_faster_tells_the_speed():
    for speeds in ((0.0, 5.0), (5.0, 0.0), (0.0, -5.0), (-5.0, 0.0)):
        joint = JointTrack(LIMITS)
        for stamp in (0, 10 * MS):
            for speed in speeds:
                joint.add(stamp, 0.0, speed)
        assert joint.query(np.array([5 * MS]))[1].tolist() == [Reason.MOVING]


def test_the_noise_is_that_beside_each_exposure_however_many_are_asked_for():
    """Displacements about as large as the noise tells: a sample further on some would turn."""
    rng = np.random.default_rng(5)
    stamps = np.arange(4000) * 10 * MS
    track = JointTrack(TrackLimits(100 * MS, 1e-9, 1e-9))
    track.store.add_block(stamps, 8.5e-9 * np.arange(4000) + rng.normal(0, 1e-9, 4000))
    asked = np.sort(rng.choice(stamps[100:-100], 3000, replace=False)) + 3 * MS
    series = track.between(stamps[0], stamps[-1])
    at_once = series.moving(asked, series.query(asked)[1])[::10]
    one_by_one = np.concatenate(
        [series.moving(one, series.query(one)[1]) for one in np.split(asked[::10], 300)]
    )
    assert 0.2 < at_once.mean() < 0.8
    np.testing.assert_array_equal(at_once, one_by_one)
