# SPDX-License-Identifier: Apache-2.0
"""Where the stage was at an exposure: interpolation, gaps, motion, contradictions."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from selfcal_ros.collection.encoder import TrackLimits
from selfcal_ros.collection.inputs import Reason
from test.support.encoder import JointTrack

MS = 1_000_000
T0 = 1_700_000_000_000_000_000
SLOW = TrackLimits(100 * MS, 1.0, 1e-9)
NAN = math.nan


def track(samples, limits=SLOW):
    """Return a track of (ms, position[, speed]) samples."""
    out = JointTrack(limits)
    for at, position, *speed in samples:
        out.add(T0 + round(at * MS), position, *(speed or [NAN]))
    return out


def ask(joint, *at):
    positions, reasons = joint.query(
        np.array([T0 + round(t * MS) for t in at], dtype=np.int64)
    )
    return positions.tolist(), reasons.tolist()


def test_positions_are_interpolated_between_the_samples_around():
    joint = track([(0, 1.0), (10, 1.002), (20, 1.0)])
    positions, reasons = ask(joint, 2.5, 5, 10, 15, 17.5)
    assert positions == pytest.approx([1.0005, 1.001, 1.002, 1.001, 1.0005], abs=1e-15)
    assert reasons == [None] * 5


@given(st.floats(-1e3, 1e3), st.floats(-1e-4, 1e-4), st.integers(1, 10 * MS - 1))
def test_a_line_is_read_to_rounding_and_a_rest_to_the_bit(start, rise, at):
    joint = track([(0, start), (10, start + rise)])
    positions, _ = joint.query(np.array([T0 + at]))
    assert positions[0] == pytest.approx(start + rise * at / (10 * MS), abs=1e-12)
    rest, reasons = track([(0, start), (10, start)]).query(np.array([T0 + at]))
    assert rest[0] == start
    assert reasons[0] is None


def test_an_exact_stamp_gives_the_sample_itself():
    values = [0.1, 0.1 + 1e-5, 0.1 - 3e-6, 0.1]
    positions, reasons = ask(
        track(list(zip((0, 3, 7, 9), values, strict=True))), 0, 3, 7, 9
    )
    assert positions == values
    assert reasons == [None] * 4


def test_outside_the_samples_and_in_gaps_there_is_no_position():
    joint = track([(0, 0.0), (1, 0.0), (101.001, 0.0), (102, 0.0), (202, 0.0)])
    positions, reasons = ask(joint, -0.001, 0.5, 50, 101.5, 150, 202, 202.001)
    assert reasons == [
        Reason.NO_ENCODER,
        None,
        Reason.NO_ENCODER,
        None,
        None,
        None,
        Reason.NO_ENCODER,
    ]
    assert [math.isnan(p) for p in positions] == [
        True,
        False,
        True,
        False,
        False,
        False,
        True,
    ]


def test_without_samples_and_without_questions():
    assert ask(track([]), 1.0)[1] == [Reason.NO_ENCODER]
    positions, reasons = ask(track([(0, 1.0)]))
    assert (positions, reasons) == ([], [])
    assert len(track([(0, 1.0), (0, 1.0)])) == 2


@pytest.mark.parametrize("sign", [1, -1])
def test_a_fast_segment_moves_and_its_ends_rest(sign):
    joint = track([(0, 0.0), (10, 0.0), (20, sign * 0.011), (30, sign * 0.011)])
    assert ask(joint, 5, 10, 15, 20, 25)[1] == [None, None, Reason.MOVING, None, None]


def test_a_sample_in_the_middle_of_a_motion_moves():
    joint = track([(0, 0.0), (10, 0.011), (20, 0.022)])
    assert ask(joint, 5, 10, 15)[1] == [Reason.MOVING] * 3


def test_a_speed_just_below_the_limit_is_at_rest():
    assert ask(track([(0, 0.0), (10, 0.0099)]), 5)[1] == [None]
    assert ask(track([(0, 0.0), (10, 0.0101)]), 5)[1] == [Reason.MOVING]


@pytest.mark.parametrize(
    ("speeds", "reason"),
    [
        ((0.0, 0.0), None),
        ((1.1, 0.0), Reason.MOVING),
        ((0.0, -1.1), Reason.MOVING),
        ((NAN, 1.1), None),
        ((math.inf, 0.0), None),
    ],
)
def test_told_speeds_count_where_both_samples_tell_them(speeds, reason):
    joint = track([(0, 0.0, speeds[0]), (10, 0.0, speeds[1])])
    assert ask(joint, 5)[1] == [reason]


@pytest.mark.parametrize("sign", [1, -1])
def test_jumps_to_and_fro_are_contradictions(sign):
    joint = track([(t, sign * 0.05 * (t % 2)) for t in range(20)])
    assert ask(joint, 5.5, 8.5)[1] == [Reason.CONTRADICTION] * 2
    assert ask(joint, 9)[1] == [Reason.CONTRADICTION]


def test_a_contradicted_stamp_spoils_half_a_gap_around_it():
    joint = track([(t, 0.0) for t in range(0, 200, 2)] + [(100, 1e-6)])
    reasons = ask(joint, 49.9, 50, 99, 100, 101, 150, 150.1)[1]
    assert reasons == [None, *[Reason.CONTRADICTION] * 5, None]


def test_far_apart_samples_beside_a_contradicted_stamp_are_spoilt_too():
    joint = track([(0, 0.0), (90, 0.0), (90, 1e-6), (180, 0.0), (270, 0.0), (360, 0.0)])
    assert ask(joint, 10, 170, 350)[1] == [
        Reason.CONTRADICTION,
        Reason.CONTRADICTION,
        None,
    ]


def test_equal_and_agreeing_samples_of_one_stamp_are_no_contradiction():
    joint = track([(0, 0.0), (10, 0.0), (10, 0.0), (10, 9e-10), (20, 0.0)])
    assert ask(joint, 5, 10, 15)[1] == [None] * 3


CIRCLE = TrackLimits(100 * MS, 1.0, 1e-9, True)


def test_an_angle_is_interpolated_across_the_seam():
    joint = track([(0, math.pi - 1e-4), (10, -math.pi + 1e-4)], CIRCLE)
    positions, reasons = ask(joint, 5, 7.5)
    assert reasons == [None, None]
    assert positions == pytest.approx([math.pi, math.pi + 5e-5], abs=1e-12)
    straight = track([(0, math.pi - 1e-4), (10, -math.pi + 1e-4)])
    assert ask(straight, 5)[1] == [Reason.MOVING]


@pytest.mark.parametrize(
    ("angles", "reason"),
    [
        ((0.0, 2 * math.pi), None),
        ((0.0, math.pi), Reason.CONTRADICTION),
        ((0.0, math.pi, 2 * math.pi), Reason.CONTRADICTION),
    ],
)
def test_angles_of_one_stamp_agree_on_the_circle(angles, reason):
    joint = track([(0, 0.0), (20, 0.0), *((10, angle) for angle in angles)], CIRCLE)
    assert ask(joint, 10)[1] == [reason]


@given(
    st.permutations(
        [
            (0, 0.0),
            (10, 1e-3),
            (10, 1e-3),
            (20, 5e-2, 0.0),
            (20, 5e-2, 2.0),
            (30, 2e-3),
            (40, 2e-3),
            (40, 3e-3),
            (200, 0.0),
        ]
    )
)
def test_the_order_of_arrival_changes_nothing(samples):
    at = [-1, 0, 3, 10, 15, 20, 25, 35, 40, 41, 100, 200]
    want = track(sorted(samples))
    np.testing.assert_equal(ask(track(samples), *at), ask(want, *at))


def test_samples_that_come_after_a_question_are_heeded():
    joint = track([(0, 0.0), (10, 0.0)])
    assert ask(joint, 15)[1] == [Reason.NO_ENCODER]
    joint.add(T0 + 20 * MS, 0.0, NAN)
    assert ask(joint, 15) == ([0.0], [None])
