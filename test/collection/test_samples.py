# SPDX-License-Identifier: Apache-2.0
"""The store of samples beside a plain list of them: blocks, order, the file, what is near."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from selfcal_ros.collection import samples as module
from selfcal_ros.collection.samples import Limits, SampleStore

STAMPS = st.lists(st.integers(0, 300), max_size=30)


def rows(columns):
    return sorted(
        zip(*(np.nan_to_num(c, nan=-1.0).tolist() for c in columns), strict=True)
    )


def stored(parts, *, speeds):
    """Return a store and the list of all its samples; odd parts are added in pieces."""
    store, every = SampleStore(Limits(block=8, in_memory=1)), []
    for number, stamps in enumerate(parts):
        t = np.array(stamps, dtype=np.int64)
        p = t * 10.0 + number
        v = p + 0.5 if speeds and number % 3 else None
        if number % 2:
            for at in range(len(t)):
                store.add_block(
                    t[at : at + 1],
                    p[at : at + 1],
                    None if v is None else v[at : at + 1],
                )
        else:
            store.add_block(t, p, v)
        every += rows((t, p, np.full(len(t), -1.0) if v is None else v))
    return store, sorted(every)


@settings(max_examples=30)
@given(
    st.lists(STAMPS, max_size=12),
    st.integers(-5, 305),
    st.integers(0, 100),
    st.integers(1, 6),
    st.booleans(),
)
def test_what_is_near_is_all_of_it_and_its_neighbours(
    parts, start, width, beside, speeds
):
    store, every = stored(parts, speeds=speeds)
    end = start + width
    found = rows(store.near(start, end, beside))
    stamps = sorted({row[0] for row in every})
    before = [t for t in stamps if t < start][-beside:]
    after = [t for t in stamps if t > end][:beside]
    low, high = min([*before, start]), max([*after, end])
    assert [row for row in found if low <= row[0] <= high] == [
        row for row in every if low <= row[0] <= high
    ]
    assert set(found) <= set(every)
    assert len(store) == len(every)
    assert store.span() == ((stamps[0], stamps[-1]) if stamps else None)
    assert store.count_between(start, end) >= sum(
        start <= row[0] <= end for row in every
    )


@pytest.mark.parametrize("order", [1, -1])
@pytest.mark.parametrize("beside", [1, 4, 11])
def test_neighbours_come_from_as_many_blocks_as_they_lie_in(order, beside):
    """Of blocks of 8: the nearest ones, in whatever order they were filled, and no others."""
    store = SampleStore(Limits(block=8, in_memory=1))
    for block in range(8)[::order]:
        t = np.arange(8 * block, 8 * block + 8)
        store.add_block(t, 10.0 * t)
    for at in (24, 28, 31):  # at either end of a block, and within one
        found = store.near(at, at, beside)[0]
        assert set(range(at - beside, at + beside + 1)) <= set(found.tolist())
        assert len(found) <= 8 + 2 * beside + 16
        assert store.count_between(at, at) == 8


@given(st.lists(STAMPS, max_size=8))
def test_new_stamps_are_handed_out_once_in_their_order(parts):
    store = SampleStore(Limits(block=8, in_memory=1))
    assert store.new_stamps().tolist() == []
    for stamps in parts:
        store.add_block(np.array(stamps, dtype=np.int64), np.zeros(len(stamps)))
        assert store.new_stamps().tolist() == sorted(stamps)
        assert store.new_stamps().tolist() == []


def test_most_of_a_long_session_is_in_the_file():
    store = SampleStore(Limits(block=100, in_memory=2))
    store.add_block(np.arange(5000), np.arange(5000.0))
    held = sum(block.count for block in store._blocks if block.columns)
    assert held == 200
    t, p, v = store.near(1234, 1240, 2)
    assert p[(t >= 1232) & (t <= 1242)].tolist() == [
        float(k) for k in range(1232, 1243)
    ]
    assert np.isnan(v).all()


def test_speeds_that_are_told_come_back_from_the_file():
    store = SampleStore(Limits(block=10, in_memory=1))
    store.add_block(
        np.arange(40), np.zeros(40), np.where(np.arange(40) < 20, np.nan, 7.0)
    )
    assert rows(store.near(5, 6, 1))[1] == (5, 0.0, -1.0)
    assert rows(store.near(25, 26, 1))[1] == (25, 0.0, 7.0)


@pytest.mark.parametrize("beside", [1, 12])
def test_samples_that_came_in_order_are_in_order_from_whatever_blocks_they_come(beside):
    """Else each look at the end of a block and the beginning of the next one sorts them all."""
    store = SampleStore(Limits(block=8, in_memory=2))
    for start in range(0, 45, 5):
        store.add_block(np.arange(start, start + 5), np.zeros(5))
        for first in range(0, start + 5, 3):
            assert (np.diff(store.near(first, start + 4, beside)[0]) == 1).all()


def test_what_was_returned_stays_as_it_was_whatever_comes_later():
    store, rng = SampleStore(Limits(block=8, in_memory=1)), np.random.default_rng(2)
    kept, every = [], []
    for size in (3, 1, 6, 0, 9, 2, 20, 5):
        t = rng.integers(0, 100, size)
        store.add_block(t, t * 10.0)
        every += t.tolist()
        found = store.near(-1, 101, 1)
        assert rows(found) == sorted((stamp, stamp * 10.0, -1.0) for stamp in every)
        kept.append((found, rows(found)))
    for found, before in kept:
        assert rows(found) == before


def test_minus_zero_is_zero_and_the_arrays_given_are_not_kept():
    store = SampleStore()
    t, p = np.array([3, 1]), np.array([-0.0, 1.0])
    store.add_block(t, p)
    t[0], p[0] = 9, 9.0
    found = store.near(0, 5, 1)
    assert rows(found) == [(1, 1.0, -1.0), (3, 0.0, -1.0)]
    assert not np.signbit(found[1]).any()


@pytest.mark.parametrize("step", ["open", "write"])
def test_without_a_file_all_stays_in_memory_and_it_is_said(monkeypatch, step):
    class Full:
        def close(self):
            pass

        def seek(self, place):
            return place

        def write(self, data):
            raise OSError(28, "No space left on device")

    def opened(**more):
        if step == "open":
            raise OSError(28, "No space left on device")
        return Full()

    monkeypatch.setattr(module.tempfile, "TemporaryFile", opened)
    store = SampleStore(Limits(block=10, in_memory=1))
    store.add_block(np.arange(100), np.arange(100.0))
    assert store.problem == (
        "encoder samples stay in memory: no temporary file can be written (No space left on device)"
    )
    assert rows(store.near(0, 100, 1)) == [(k, float(k), -1.0) for k in range(100)]
