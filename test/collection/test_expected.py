# SPDX-License-Identifier: Apache-2.0
"""Which marks a view asks for, counted one by one, and which of them are missing."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from selfcal_ros.collection.expected import (
    NAMED_AT_MOST,
    Missing,
    expected_marks,
    first_missing,
    mark_rows,
    missing_marks,
)
from selfcal_ros.collection.inputs import Kind
from selfcal_ros.model.artifact import Artifact, MapGrid
from selfcal_ros.model.readings import ViewReadings
from selfcal_ros.model.view import View
from test.support.collecting import collect, scene

TURNS = st.integers(0, 3).map(lambda q: q * np.pi / 2)


@given(
    st.integers(1, 4), st.integers(1, 4), TURNS, st.integers(-9, 9), st.integers(-9, 9)
)
def test_the_marks_in_the_field_are_those_whose_sites_are_sites(hx, hy, turn, a, b):
    plate = Artifact(2 * hx + 1, 0.01, 0, 2 * hy + 1)
    view = View("v", turn, (a * 0.01, b * 0.01), angular=False)
    i, j = view.lattice_pose(plate).site_of(plate.m, plate.n)
    inside = (abs(i) <= hx) & (abs(j) <= hy)
    assert expected_marks(plate, view) == (inside.sum(), 0)
    assert view.lattice_pose(plate).n_in_field(plate) == inside.sum()
    first, count = mark_rows(plate, view)
    rows = (plate.n >= first[:, None]) & (plate.n < (first + count)[:, None])
    np.testing.assert_array_equal(rows, inside)
    assert not mark_rows(plate, replace(view, grid=False))[1].any()


@given(st.floats(0, 7), st.floats(-4, 4), st.floats(-4, 4), st.integers(0, 2**25 - 1))
def test_missing_marks_of_a_placed_plate_are_named(turn, a, b, read):
    """Of the marks in the field some were read."""
    plate = Artifact(5, 0.01, 0, 0, MapGrid(3, 0.02))
    view = View("v", turn, (a * 0.01, b * 0.01), angular=False)
    inside = view.pose.in_field(plate)
    done = inside & (read >> np.arange(25) & 1 > 0).reshape(5, 5)
    missing = missing_marks(
        plate,
        view,
        ViewReadings(
            view, plate.m[done], plate.n[done], count=np.ones(done.sum(), dtype=int)
        ),
    )
    lost = inside & ~done
    assert missing == Missing(
        tuple(plate.m[lost].tolist()), tuple(plate.n[lost].tolist())
    )
    assert expected_marks(plate, view) == (inside.sum(), 0)


@given(st.sets(st.integers(0, 300)), st.integers(0, 600))
def test_the_first_missing_numbers(done, total):
    done = np.array(sorted(number for number in done if number < total), dtype=int)
    want = [number for number in range(total) if number not in set(done)][
        :NAMED_AT_MOST
    ]
    assert first_missing(done, total).tolist() == want


def test_missing_marks_are_named_until_they_are_read_often_enough():
    cell = scene("90", repeats=2)
    lost = [cell.detections[i] for i in (cell.grid(3), cell.grid(30), cell.angular(5))]
    cell.detections = [d for d in cell.detections if d not in lost]
    _, progress = collect(cell.events)
    missing = progress[0].missing
    marks = sorted({(d.m, d.n) for d in lost if d.kind == 0})
    assert list(zip(missing.m, missing.n, strict=True)) == marks
    assert missing.k == (lost[2].k,)
    assert len(marks) == progress[0].grid_expected - progress[0].grid_done
    assert not progress[0].complete
    whole = collect([*cell.events, *lost])[1][0]
    assert (whole.complete, whole.missing.m, whole.missing.k) == (True, (), ())
    assert replace(whole, artifact=None).missing.m == ()


def test_a_large_plate_of_which_little_was_read_takes_no_room():
    plate, view = Artifact(401, 1e-4, 1_000_000), View("v", np.pi / 2, (3e-4, 0.0))
    three = np.array([-200, 0, 200])
    readings = ViewReadings(view, m=three, n=three // 2, count=np.ones(3, dtype=int))
    tracemalloc.start()
    missing = missing_marks(plate, view, readings)
    assert expected_marks(plate, view) == (401 * 398, 1_000_000)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1_000_000
    assert len(missing.m) == len(missing.n) == len(missing.k) == 200


def test_a_view_of_lines_alone_lacks_no_grid_marks():
    view = View("v", np.pi / 12, grid=False)
    plate = Artifact(5, 0.01, 24)
    missing = missing_marks(
        plate,
        view,
        ViewReadings(view, k=np.array([0, 2]), count_theta=np.array([1, 1])),
    )
    assert (missing.m, missing.n) == ((), ())
    assert missing.k == (1, *range(3, 24))


@pytest.mark.parametrize("shift", [5, -7, 100])
def test_a_view_beyond_the_field_lacks_nothing(shift):
    view = View("v", 0.0, (shift * 0.01, 0.0), angular=False)
    assert expected_marks(Artifact(5, 0.01), view) == (0, 0)
    assert missing_marks(Artifact(5, 0.01), view, ViewReadings(view)).m == ()


OFF_M = 1e-4
"""Of an outlier: within max_deviation, and far beyond the noise."""


def with_outliers(repeats, marks, lines=(), **settings):
    """Return a scene in which so many repeats of the first marks and lines are outliers."""
    cell = scene(repeats=repeats, sigma_xy_m=2e-8, sigma_theta_rad=2e-6)
    for field, kind, numbers, by in (
        ("offset_x", Kind.GRID, marks, OFF_M),
        ("offset_theta", Kind.ANGULAR, lines, 1e-2),
    ):
        for mark, count in enumerate(numbers):
            named = sorted(
                {(d.m, d.n, d.k) for d in cell.detections if d.kind == kind}
            )[mark]
            mine = [
                i
                for i, d in enumerate(cell.detections)
                if d.kind == kind and (d.m, d.n, d.k) == named
            ]
            for turn, index in enumerate(mine[:count]):
                cell.spoil(
                    index,
                    **{field: getattr(cell.detections[index], field) + by * (1 + turn)},
                )
    return cell


@pytest.mark.parametrize("least", [0, 1, 3, 4, 5, 9])
def test_outliers_do_not_keep_a_mark_open_where_enough_is_left(least):
    """Of five repeats one, two and three are outliers; of the last mark nothing is believed."""
    cell = with_outliers(5, (1, 2, 3))
    _, progress = collect(cell.events, min_repeats=least)
    found = progress[0]
    counts = dict(
        zip(
            zip(found.readings.m.tolist(), found.readings.n.tolist(), strict=True),
            found.readings.count.tolist(),
            strict=True,
        )
    )
    assert counts[-2, -2] == 4 and counts[-2, -1] == 3 and (-2, 0) not in counts
    wanted = [
        mark
        for mark, count in (((-2, -2), 4), ((-2, -1), 3), ((-2, 0), 0))
        if count < (least or 5) or count < 1
    ]
    assert list(zip(found.missing.m, found.missing.n, strict=True)) == wanted
    assert found.grid_done == 25 - len(wanted)
    assert not found.complete
    assert found.readings.outliers.sum() == 3


@pytest.mark.parametrize(
    ("least", "complete"), [(0, False), (1, True), (2, True), (3, False)]
)
def test_a_view_with_outliers_of_marks_and_lines_is_complete_with_min_repeats(
    least, complete
):
    cell = with_outliers(3, (1, 1), (0, 1))
    _, progress = collect(cell.events, min_repeats=least)
    assert progress[0].complete is complete
    assert (progress[0].needed == 0) is complete


def test_a_mark_that_was_not_read_often_enough_yet_is_not_done_with_min_repeats():
    """Or the view would be over after the first pass."""
    cell = scene(repeats=3, count=8)
    lost = cell.detections.pop(cell.grid(7))
    _, progress = collect(cell.events, min_repeats=1)
    assert (progress[0].missing.m, progress[0].missing.n) == ((lost.m,), (lost.n,))
    assert progress[0].needed == 1
