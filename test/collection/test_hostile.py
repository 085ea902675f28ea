# SPDX-License-Identifier: Apache-2.0
"""Clocks that step between views, stamps below zero, absurd sigmas, offsets and parameters."""

import random
from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.collection.inputs import Phase
from selfcal_ros.collection.marks.repeats import MIN_PAIRS, reduce_repeats
from selfcal_ros.errors import InputError
from test.support.collecting import START_NS, collect, digest, gathered, scene, table
from test.support.truth import angular_deviation, grid_deviation

MS = 1_000_000


def stepped_between_views(count, seed):
    """Return a session, the last detection of view 0, and all messages of a stepped clock.

    It steps back after that detection, so that MEASURE of view 1 is stamped 5 ms before it.
    """
    cell = scene("0, 0", count=count, seed=seed)
    place, measure = (
        c for c in cell.commands if c.view is not None and c.view_index == 1
    )
    last = [d for d in cell.detections if d.stamp_ns < place.stamp_ns][-1]
    step = measure.stamp_ns - last.stamp_ns + 5 * MS
    return (
        cell,
        last,
        [
            replace(e, stamp_ns=e.stamp_ns - step)
            if e.stamp_ns >= place.stamp_ns
            else e
            for e in cell.events
        ],
    )


@pytest.mark.parametrize("seed", [0, 5, 8])
@pytest.mark.parametrize("count", [0, 24])
def test_a_detection_that_a_stepped_clock_moves_to_the_next_view_is_an_outlier_there(
    count, seed
):
    cell, last, events = stepped_between_views(count, seed)
    found, _ = collect(events)
    assert found.views[1].rejected == {"outlier_among_repeats": 2}
    assert found.views[0].rejected == {}
    # stamped while the plate was placed
    assert found.rejected == {"outside_every_view": 2}
    mark = ("line", last.k) if count else ("grid", last.m, last.n)
    assert mark not in table(found.views[1])
    assert len(table(found.views[1])) == 25 + count - 1
    for index, readings in enumerate(found.views):
        at = np.stack([readings.m, readings.n]) + 2
        expected = grid_deviation(cell.truth, index, readings.view)[:, *at]
        # the servo's 20 nm and 0.1 urad off its place, the stage has the error of another place
        np.testing.assert_allclose([readings.dx, readings.dy], expected, atol=2e-11)
        lines = (
            angular_deviation(cell.truth, index, readings.view)[readings.k]
            if count
            else []
        )
        np.testing.assert_allclose(readings.dtheta, lines, atol=1e-9)
    shuffled = list(events)
    random.Random(3).shuffle(shuffled)
    assert digest(shuffled) == digest(events)


def test_few_repeats_of_clean_readings_are_kept_beside_the_scatter_of_marks():
    """Even at a limit of 4: below 1 in 100,000 of 30,000, three or more happen once in 300."""
    rng, rejected, total = np.random.default_rng(5), 0, 0
    for components in np.repeat([1, 2], 500):
        marks = int(rng.integers(MIN_PAIRS, 60))
        key = np.append(np.arange(marks), [0, 1])
        noise = rng.normal(0, 2e-8, (components, len(key)))
        values = (
            noise + rng.normal(0, rng.choice([0.0, 3e-7]), (components, marks))[:, key]
        )
        means = reduce_repeats(
            key, values, np.zeros(len(key)), limit=4.0, residual=values
        )
        rejected, total = rejected + int(means.outlier.sum()), total + len(key)
    assert 30_000 < total < 40_000
    assert rejected <= 2


def test_few_repeats_are_judged_only_beside_enough_marks():
    key, values = np.array([0, 1, 2, 0]), np.array([[1.0, -1.0, 1.0, 90.0]]) * 1e-7
    for residual in (None, values):
        assert not reduce_repeats(
            key, values, np.zeros(4), limit=6.0, residual=residual
        ).outlier.any()
    key = np.append(np.arange(20), 0)
    values = np.append(np.tile([1.0, -1.0], 10), 90.0)[None] * 1e-7
    found = reduce_repeats(key, values, np.zeros(21), limit=6.0, residual=values)
    assert np.flatnonzero(found.outlier).tolist() == [0, 20]
    assert not reduce_repeats(
        key, values, np.zeros(21), limit=0.0, residual=values
    ).outlier.any()


@pytest.mark.parametrize("shift_ns", [-START_NS, -2 * START_NS, 2**62])
def test_stamps_may_lie_anywhere(shift_ns):
    cell = scene("0, 90", repeats=2)
    moved = [replace(e, stamp_ns=e.stamp_ns + shift_ns) for e in cell.events]
    again = [replace(c, stamp_ns=c.stamp_ns + shift_ns) for c in cell.commands[2:4]]
    want, _ = collect(cell.events)
    for events in (moved, [*moved, *again]):
        found, _ = collect(events)
        assert found.all_rejected() == {}
        assert [table(v) for v in found.views] == [table(v) for v in want.views]


@pytest.mark.parametrize("shift_ns", [0, -2 * START_NS])
def test_a_view_placed_and_moved_again_begins_anew_at_any_time(shift_ns):
    cell = scene()
    at = cell.detections[9].stamp_ns + 1
    other = replace(cell.commands[1].view, translation_m=(0.01, 0.0))
    place, measure, _ = cell.commands
    events = [
        *cell.events,
        replace(measure, stamp_ns=at, view=other),
        replace(place, stamp_ns=at + 1),
        replace(measure, stamp_ns=at + 2),
    ]
    found, progress = collect(
        [replace(e, stamp_ns=e.stamp_ns + shift_ns) for e in events]
    )
    assert found.all_rejected() == {"superseded_by_redo": 10}
    assert progress[0].view == cell.commands[1].view


@pytest.mark.parametrize("scale", [1e-300, 1e-160, 1e150, 1e300])
def test_absurd_sigmas_weigh_without_overflow(scale):
    key, values = np.array([0, 0, 0, 1, 1]), np.array([[1.0, 2.0, 4.0, 5.0, 7.0]])
    sigma = np.array([1.0, 2.0, 0.5, 1.0, 1.0])
    plain = reduce_repeats(key, values, sigma, limit=0.0)
    scaled = reduce_repeats(key, values, sigma * scale, limit=0.0)
    np.testing.assert_allclose(scaled.mean, plain.mean, rtol=1e-14)
    np.testing.assert_allclose(scaled.u, plain.u * scale, rtol=1e-14)
    mixed = reduce_repeats(
        key, values, np.array([1.0, scale, 1.0, 1.0, 1.0]), limit=6.0
    )
    assert np.isfinite(mixed.mean).all() and np.isfinite(mixed.u).all()


@pytest.mark.parametrize("with_ids", [True, False])
@pytest.mark.parametrize("offset", [1e9, -1e200, 1.7e308])
def test_huge_offsets_are_too_far_and_touch_nothing_else(with_ids, offset):
    cell = scene(with_ids=with_ids)
    before = table(collect(cell.events)[0].views[0])
    cell.spoil(cell.grid(7), offset_x=offset, offset_y=-offset)
    cell.spoil(cell.angular(2), offset_theta=offset)
    found, _ = collect(cell.events)
    assert found.all_rejected() == {"too_far_from_nominal": 2}
    assert table(found.views[0]).items() <= before.items()


def test_no_rotation_to_reckon_with_is_a_rotation_of_zero():
    cell = scene(with_ids=False)
    still = replace(cell.truth, phi_rad=0 * cell.truth.phi_rad)
    assert still.phi_rad.shape == (1,)
    found, _ = collect(cell.events, max_rotation=0.0)
    assert set(found.all_rejected()) <= {"rotation_not_known", "too_far_from_nominal"}
    named, _ = collect(scene().events, max_rotation=0.0)
    assert named.all_rejected() == {}


def test_two_joints_of_one_name_are_refused():
    with pytest.raises(
        InputError, match="two of them are the same joint; give each its own name"
    ):
        gathered([], joint_x="a", joint_y="a")


def test_an_id_below_zero_is_no_line():
    cell = scene()
    cell.spoil(cell.angular(2), k=-6)
    assert collect(cell.events)[0].all_rejected() == {"unknown_mark": 1}


def test_place_of_a_view_between_two_measures_of_another_changes_neither():
    cell = scene("0, 90")
    at = cell.detections[9].stamp_ns + 1
    place = next(
        c for c in cell.commands if c.phase == Phase.PLACE and c.view_index == 1
    )
    events = [
        *cell.events,
        replace(place, stamp_ns=at),
        replace(cell.commands[1], stamp_ns=at + 1),
    ]
    assert collect(events)[0].all_rejected() == {}
