# SPDX-License-Identifier: Apache-2.0
"""From where a joint had come before an exposure: the last motion that is one."""

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from selfcal_ros.collection.encoder import TrackLimits
from test.support.encoder import JointTrack

MS = 1_000_000
LIMITS = TrackLimits(100 * MS, 1.0, 1e-9)
UM = 1e-6


def track(samples):
    """Return a track of (ms, position) samples."""
    joint = JointTrack(LIMITS)
    for at, position in samples:
        joint.add(round(at * MS), position, math.nan)
    return joint


def asked(joint, *at_ms, threshold=UM):
    stamps = np.array([round(t * MS) for t in at_ms], dtype=np.int64)
    return joint.approach(stamps, joint.query(stamps)[0], threshold=threshold).tolist()


def path(*positions, dwell=5):
    """Return samples every 10 ms of a stage that rests `dwell` samples at each position."""
    return [
        (10 * at, p) for at, p in enumerate(p for p in positions for _ in range(dwell))
    ]


def test_the_sign_is_that_of_the_last_motion_and_holds_while_the_axis_rests():
    joint = track(path(0.0, 0.01, 0.01, 0.004, 0.02))
    assert asked(joint, 20, 70, 120, 170, 220) == [0, 1, 1, -1, 1]
    assert asked(joint, 120, 130, 220) == [1, 1, 1]
    assert asked(joint, 20, 220) == [0, 1]


@pytest.mark.parametrize(
    ("over", "sign"), [(5 * UM, -1), (1.1 * UM, -1), (0.9 * UM, 1)]
)
@pytest.mark.parametrize("side", [1, -1])
def test_an_overshoot_beyond_the_threshold_is_the_last_motion(over, sign, side):
    joint = track(path(0.0, side * (0.01 + over), side * 0.01))
    assert asked(joint, 20, 120) == [0, side * sign]
    assert asked(joint, 20, 120, threshold=10 * UM) == [0, side]


@pytest.mark.parametrize(
    ("step", "found"), [(0.9 * UM, 0), (1.1 * UM, 1), (-1.1 * UM, -1)]
)
def test_a_displacement_counts_beyond_the_threshold(step, found):
    assert asked(track(path(0.0, step)), 20, 70) == [0, found]


@pytest.mark.parametrize(("step", "found"), [(4.0, 0), (14.0, 1), (-14.0, -1)])
def test_a_displacement_counts_beyond_the_noise_at_rest(step, found):
    noise = np.random.default_rng(4).normal(0, 1e-5, 200)
    samples = [(at, p + step * 1e-5 * (at >= 100)) for at, p in enumerate(noise)]
    assert asked(track(samples), 50.5, 150.5) == [0, found]


@pytest.mark.parametrize(("step_ms", "known"), [(10, True), (20, True), (50, False)])
def test_samples_of_a_stage_that_mostly_moves_tell_no_wrong_direction(step_ms, known):
    """An exposure every 200 ms, moves of 80 ms between: a slow encoder has few samples at rest."""
    stops = np.random.default_rng(2).permutation(60) * 1e-3
    times, course = (
        np.array([[-60.0, 60.0]]) + 200 * np.arange(60)[:, None],
        np.repeat(stops, 2),
    )
    at = np.arange(-60.0, 200 * 59 + 61, step_ms)
    joint = track(zip(at, np.interp(at, times.ravel(), course), strict=True))
    true = np.sign(np.diff(stops))
    said = np.array(asked(joint, *(200.0 * np.arange(60))))[1:]
    assert not np.any(said * true < 0)
    assert (said == true).all() if known else (said == 0).mean() > 0.3


def test_a_gap_leaves_unknown_what_happened_in_it():
    before, after = path(0.0, 0.01), [(t + 300, p) for t, p in path(0.01, 0.01, 0.0)]
    assert asked(track(before + after), 70, 320, 370, 420) == [1, 0, 0, -1]
    moved = [(t + 300, p) for t, p in path(0.03, 0.03)]
    assert asked(track(before + moved), 70, 320, 370) == [1, 0, 0]
    near = [(t + 190, p) for t, p in path(0.01, 0.01)]
    assert asked(track(before + near), 70, 220) == [1, 1]


@pytest.mark.parametrize(("rest_s", "found"), [(59.0, 1), (61.0, 0)])
def test_after_a_minute_without_exposure_or_motion_the_sign_is_not_known(rest_s, found):
    start = path(0.0, 0.01)
    rest = [(90 + 90 * k, 0.01) for k in range(1, 800)]
    assert asked(track(start + rest), 90, 90 + rest_s * 1e3) == [1, found]
    assert asked(track(start + rest), 90, 45_000, 90 + rest_s * 1e3) == [1, 1, 1]


def test_without_samples_or_questions_nothing_is_known():
    assert asked(track([]), 1.0) == [0]
    assert asked(track(path(0.0))) == []
    assert asked(track([(0, 0.0), (1, 0.5)]), -1, 0.5) == [0, 1]
    assert asked(track(path(0.0, 1.0)), -10, 20, 70, 1000) == [0, 0, 1, 0]


def looked_for(samples, stamps, positions):
    """Return the signs sample by sample, backwards from each exposure: the oracle."""
    signs = []
    for number, (stamp, position) in enumerate(zip(stamps, positions, strict=True)):
        before = stamps[number - 1] if number else -math.inf
        here = [(t, p) for t, p in samples if t <= stamp]
        sign = signs[-1] if number and math.isfinite(position) else 0
        for at in range(len(here) - 1, -1, -1):
            t, p = here[at]
            if t <= before:
                break
            if abs(p - position) > UM:
                sign = 1 if position > p else -1
                break
            if at == 0 or t - here[at - 1][0] > 100:
                sign = 0
                break
        signs.append(sign)
    return signs


STEPS, PLACES = (
    st.sampled_from([1, 10, 99, 101]),
    st.sampled_from([0.0] * 20 + [1e-3, -1e-3, 5e-7]),
)


@settings(max_examples=20)
@given(
    st.lists(st.tuples(STEPS, PLACES), min_size=40, max_size=80),
    st.lists(st.integers(0, 2000), min_size=1, max_size=12, unique=True),
)
def test_it_is_what_a_search_backwards_finds(steps, asked_at):
    at = np.cumsum([step for step, _ in steps]).tolist()
    samples = list(zip(at, (p for _, p in steps), strict=True))
    joint, stamps = track(samples), sorted(asked_at)
    positions = joint.query(np.array(stamps) * MS)[0]
    assume(not joint._all()._noise_near(np.array(stamps) * MS).any())
    found = asked(joint, *stamps)
    assert found == looked_for(samples, stamps, positions.tolist())
    assert asked(track(samples[::-1]), *stamps) == found
