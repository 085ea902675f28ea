# SPDX-License-Identifier: Apache-2.0
"""A growing table holds what a list would, wherever rows are added."""

import numpy as np
import pytest

from selfcal_ros.collection.samples import GrowingColumns, GrowingTable

PAIR = np.dtype([("a", np.int64), ("b", float)])


def rows_of(first, count):
    return np.array([(first + i, 0.5 * i) for i in range(count)], dtype=PAIR)


@pytest.mark.parametrize(
    "sizes", [(0,), (1,), (64,), (65,), (3, 61, 1), (60, 5, 500, 0, 2)]
)
def test_rows_appended_stay_in_their_order(sizes):
    table, want, at = GrowingTable(PAIR), [], 0
    for size in sizes:
        table.append(rows_of(at, size))
        want += rows_of(at, size).tolist()
        at += size
        assert table.rows.tolist() == want and len(table) == len(want)


def test_rows_are_inserted_as_into_a_list_and_nothing_is_lost():
    rng, table, want = np.random.default_rng(2), GrowingTable(PAIR), []
    for step in range(60):
        at = np.sort(rng.integers(0, len(want) + 1, rng.integers(0, 5)))
        new = rows_of(1000 * step, len(at))
        table.insert(at, new)
        for place, row in zip(at[::-1].tolist(), new[::-1].tolist(), strict=True):
            want.insert(place, row)
        table.append(rows_of(-step, 2))
        want += rows_of(-step, 2).tolist()
        assert table.rows.tolist() == want and len(table) == len(want)


def test_room_is_taken_ahead_but_never_more_than_twice_what_is_held():
    table, rooms = GrowingTable(PAIR), set()
    for at in range(5000):
        table.append(rows_of(at, 1))
        room = len(table.rows.base)
        rooms.add(room)
        assert len(table) <= room <= max(2 * len(table), 64)
    assert len(rooms) < 10  # a copy of all rows at each doubling, not at each row


def test_room_is_made_once_for_all_that_came_between_two_looks():
    table = GrowingTable(PAIR)
    for at in range(0, 1000, 10):
        table.append(rows_of(at, 10))
        assert len(table) == at + 10
    assert len(table.rows.base) == 1000  # doubled on the way it would be 1024 or more
    assert table.rows["a"].tolist() == list(range(1000))


def test_rows_may_be_changed_in_place():
    table = GrowingTable(PAIR)
    table.append(rows_of(0, 3))
    table.rows["a"][1] = 7
    assert table.rows["a"].tolist() == [0, 7, 2]


def test_columns_take_the_same_rows_each_with_its_own_value():
    columns = GrowingColumns({"a": "i8", "b": "f8", "c": "?"})
    columns.insert(np.zeros(3, dtype=int), {"a": 5, "b": 0.5})
    columns["b"][:] = [1.0, 2.0, 3.0]
    columns.insert(np.array([0, 2, 2, 3]), {"a": 7, "b": np.nan, "c": True})
    assert columns["a"].tolist() == [7, 5, 5, 7, 7, 5, 7]
    np.testing.assert_array_equal(
        columns["b"], [np.nan, 1, 2, np.nan, np.nan, 3, np.nan]
    )
    assert columns["c"].tolist() == [True, False, False, True, True, False, True]
    assert [columns[name].dtype for name in "abc"] == [np.int64, np.float64, np.bool_]
