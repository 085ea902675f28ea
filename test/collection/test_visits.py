# SPDX-License-Identifier: Apache-2.0
"""Visits: successive exposures of one mark, with their instant, offset and approach."""

import random
from dataclasses import replace
from itertools import groupby

import numpy as np
import pytest

from selfcal_ros.collection.inputs import Kind
from selfcal_ros.collection.marks.repeats import grid_visits, reduce_repeats
from selfcal_ros.model.readings import Sense, readings_digest
from test.support.collecting import collect, digest, scene

US = 1_000
NOISE = {"sigma_xy_m": 2e-8, "servo_sigma_m": 3e-8}


def in_pairs(cell, *, size=1e-7):
    """Let every mark be exposed twice in each dwell; the second 1 ms later and off by `size`."""
    again = [
        replace(
            d,
            stamp_ns=d.stamp_ns + 1000 * US,
            offset_x=d.offset_x + size,
            offset_y=d.offset_y - 2 * size,
        )
        for d in cell.detections
    ]
    cell.detections = sorted(cell.detections + again, key=lambda d: d.stamp_ns)
    return cell


def runs(cell):
    """Return the successive detections of one mark, as lists, from a session of one view."""
    grid = sorted(
        (d for d in cell.detections if d.kind == Kind.GRID), key=lambda d: d.stamp_ns
    )
    return [list(group) for _, group in groupby(grid, key=lambda d: (d.m, d.n))]


def approaches(cell, axis):
    """Return the sign of the last step of an axis before each exposure: the oracle."""
    samples = sorted(cell.samples, key=lambda s: s.stamp_ns)
    signs, last, sign = {}, samples[0].positions[axis], 0
    stamps = np.array([s.stamp_ns for s in samples])
    for d in sorted(cell.detections, key=lambda d: d.stamp_ns):
        at = samples[np.searchsorted(stamps, d.stamp_ns) - 1].positions[axis]
        if abs(at - last) > 1e-6:
            sign = 1 if at > last else -1
        signs[d.stamp_ns], last = sign, at
    return signs


@pytest.mark.parametrize("sense", list(Sense))
def test_every_visit_has_its_means_instant_offset_and_approach(sense):
    cell = in_pairs(scene(repeats=3, sense=sense, **NOISE))
    readings = collect(cell.events, measurement_sense=str(sense))[0].views[0]
    visits, came = readings.visits, [approaches(cell, axis) for axis in (0, 1)]
    rows = {}
    for v in range(len(visits.mark)):
        mark = visits.mark[v]
        rows.setdefault((readings.m[mark], readings.n[mark]), []).append(v)
    groups = {}
    for run in runs(cell):
        groups.setdefault((run[0].m, run[0].n), []).append(run)
    assert rows.keys() == groups.keys()
    for mark, expected in groups.items():
        assert len(expected) == 3
        for v, run in zip(rows[mark], expected, strict=True):
            assert visits.count[v] == len(run) == 2
            assert visits.stamp_ns[v] == run[0].stamp_ns + 500 * US
            assert visits.offset_x[v] == pytest.approx(
                (run[0].offset_x + run[1].offset_x) / 2
            )
            assert visits.offset_y[v] == pytest.approx(
                (run[0].offset_y + run[1].offset_y) / 2
            )
            assert visits.approach_x[v] == came[0][run[0].stamp_ns]
            assert visits.approach_y[v] == came[1][run[0].stamp_ns]
    for signs in (visits.approach_x, visits.approach_y):
        assert set(signs.tolist()) >= {-1, 1}
    for name in ("dx", "dy"):
        sums = np.bincount(visits.mark, visits.count * getattr(visits, name))
        np.testing.assert_allclose(
            sums / readings.count, getattr(readings, name), atol=1e-15
        )


def test_the_repeatability_within_visits_is_that_of_their_differences():
    cell = in_pairs(scene(repeats=3, sigma_xy_m=5e-8, servo_sigma_m=0.0), size=1e-7)
    readings = collect(cell.events)[0].views[0]
    assert readings.visits.dof == 2 * 75
    assert readings.visits.sigma_m == pytest.approx(
        np.sqrt((1e-7**2 + 2e-7**2) / 4), rel=1e-6
    )
    assert readings.dof_xy == 2 * 25 * 5
    passes = collect(scene(repeats=3, **NOISE).events)[0].views[0]
    assert passes.visits.dof == 0
    assert np.isnan(passes.visits.sigma_m)
    assert len(passes.visits.mark) == 75


def test_visits_are_sorted_by_mark_and_stamp():
    visits = collect(in_pairs(scene(repeats=4)).events)[0].views[0].visits
    order = np.lexsort((visits.stamp_ns, visits.mark))
    assert order.tolist() == list(range(100))
    assert visits.stamp_ns.dtype == np.int64
    assert visits.approach_x.dtype == np.int8


def test_an_outlier_is_in_no_visit_and_still_ends_the_one_of_another_mark():
    cell = scene(repeats=4, count=0, **NOISE)
    index = 12
    d, before = cell.detections[index], cell.detections[index - 1]
    # the mark before is seen again once this one has been seen, in the same dwell: two visits
    again = replace(
        before,
        stamp_ns=d.stamp_ns + 100,
        offset_x=before.offset_x + (before.m - d.m) * 0.01,
        offset_y=before.offset_y + (before.n - d.n) * 0.01,
    )
    cell.detections.append(again)
    whole = collect(cell.events, max_stage_distance=0.02)[0].views[0]
    cell.spoil(index, offset_x=d.offset_x + 2e-6)
    spoilt = collect(cell.events, max_stage_distance=0.02)[0].views[0]
    assert spoilt.rejected == {"outlier_among_repeats": 1}
    assert len(whole.visits.mark) == 101
    assert len(spoilt.visits.mark) == 100
    assert d.stamp_ns not in spoilt.visits.stamp_ns
    assert spoilt.visits.count.sum() == spoilt.used == 100
    assert {before.stamp_ns, again.stamp_ns} <= set(spoilt.visits.stamp_ns.tolist())


def test_declared_sigmas_weigh_within_a_visit_as_within_a_mark():
    cell = in_pairs(scene(count=0, declare_sigma=True, sigma_xy_m=1e-8), size=1e-7)
    for index in range(1, len(cell.detections), 2):
        cell.spoil(index, sigma=2e-8)
    readings = collect(cell.events)[0].views[0]
    visits = readings.visits
    np.testing.assert_array_equal(visits.dx, readings.dx)
    np.testing.assert_array_equal(visits.u, readings.u)
    assert visits.u[0] == pytest.approx(1 / np.sqrt(1 / 1e-16 + 1 / 4e-16))
    first = runs(cell)[0][0]
    v = np.flatnonzero((readings.m == first.m) & (readings.n == first.n))[0]
    assert visits.offset_x[v] == pytest.approx(first.offset_x + 1e-7 / 5, abs=1e-15)
    assert visits.stamp_ns[v] == first.stamp_ns + 200 * US


def test_a_visit_whose_exposures_were_approached_differently_has_no_one_approach():
    key = np.array([7, 7, 4, 4, 4, 7])
    values = np.arange(12.0).reshape(2, 6)
    means = reduce_repeats(key, values, np.zeros(6), limit=0.0)
    visits = grid_visits(
        means,
        key,
        np.zeros(6),
        stamps_ns=np.arange(6) * 10,
        deviation=values,
        offset=-values,
        approach=np.array([[1, -1, 1, 1, 1, -1], [1, 1, 0, 0, -1, 0]], dtype=np.int8),
    )
    assert visits.mark.tolist() == [0, 1, 1]
    assert visits.stamp_ns.tolist() == [30, 5, 50]
    assert visits.count.tolist() == [3, 2, 1]
    assert visits.approach_x.tolist() == [1, 0, -1]
    assert visits.approach_y.tolist() == [0, 1, 0]
    assert visits.dx.tolist() == [3.0, 0.5, 5.0]
    assert visits.offset_y.tolist() == [-9.0, -6.5, -11.0]


def test_without_grid_marks_there_are_no_visits():
    cell = scene("0", line=True)
    views = collect(cell.events)[0].views
    assert views[1].visits is None
    assert views[0].visits is not None


def test_the_digest_covers_the_visits():
    readings = collect(in_pairs(scene(repeats=2)).events)[0].views[0]
    whole = readings_digest(readings, {})
    for name in (
        "mark",
        "dx",
        "dy",
        "count",
        "stamp_ns",
        "offset_x",
        "offset_y",
        "approach_x",
        "approach_y",
    ):
        column = getattr(readings.visits, name).copy()
        column[3] += 1
        changed = replace(readings, visits=replace(readings.visits, **{name: column}))
        assert readings_digest(changed, {}) != whole, name
    for name, value in (("sigma_m", 1.0), ("dof", 3), ("u", np.ones(50))):
        changed = replace(readings, visits=replace(readings.visits, **{name: value}))
        assert readings_digest(changed, {}) != whole, name
    assert readings_digest(replace(readings, visits=None), {}) != whole


@pytest.mark.parametrize("seed", range(4))
def test_the_order_of_arrival_changes_no_visit(seed):
    events = in_pairs(scene("0, 90", repeats=2, **NOISE)).events
    shuffled = list(events)
    random.Random(seed).shuffle(shuffled)
    assert digest(shuffled) == digest(events)
