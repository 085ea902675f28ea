# SPDX-License-Identifier: Apache-2.0
"""Repeats: clean Gaussian readings stay, outliers go, means and repeatability as by hand."""

import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binom

from selfcal_ros.collection.marks import repeats as repeats_module
from selfcal_ros.collection.marks.repeats import (
    distances,
    median,
    reduce_repeats,
    row_medians,
    without_turning,
)

SIGMA = 2e-8
LIMIT = 6.0


def readings(marks, repeats, rng, *, components=2):
    key = np.tile(np.arange(marks), repeats)
    return (
        key,
        rng.normal(0, SIGMA, (components, marks * repeats)),
        np.zeros(marks * repeats),
    )


def rejected_of_clean(marks, repeats, views, *, components=2, limit=LIMIT):
    """Return how many of all clean readings of many views are rejected, and how many there are."""
    rng = np.random.default_rng([marks, repeats])
    bad = sum(
        int(
            reduce_repeats(
                *readings(marks, repeats, rng, components=components), limit=limit
            ).outlier.sum()
        )
        for _ in range(views)
    )
    return bad, marks * repeats * views


def test_of_clean_readings_fewer_than_one_in_100000_are_rejected():
    """Already at a limit of 5, where one in 150,000 goes: at 6 no draws of a second would tell.

    A scale that is a tenth too small takes 1 in 20,000, which is seen.
    """
    found = [
        rejected_of_clean(marks, repeats, views, limit=5.0)
        for repeats in range(2, 8)
        for marks, views in ((40_000 // repeats, 2), (121, 30))
    ]
    bad, total = np.sum(found, axis=0)
    assert bad <= binom.ppf(0.999, total, 1e-5)


@pytest.mark.parametrize(
    ("marks", "repeats", "components", "views"),
    [
        (6, 2, 2, 500),
        (8, 2, 2, 300),
        (9, 2, 2, 150),
        (9, 3, 2, 100),
        (9, 7, 2, 50),
        (24, 2, 1, 100),
        (24, 5, 1, 50),
    ],
)
def test_views_with_few_pairs_of_repeats_reject_no_more(
    marks, repeats, components, views
):
    """The limit grows with few pairs: even one of 4.5 is then as safe as 6 is with many."""
    bad, total = rejected_of_clean(
        marks, repeats, views, components=components, limit=4.5
    )
    assert bad <= binom.ppf(0.999, total, 1e-5)


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize(
    ("marks", "cut"),
    [  # limit / 0.6745 sqrt(2) (1 + 4/sqrt(2n) + 8/2n)
        (6, 6 / 0.9538725524 * (1 + 4 / 12**0.5 + 8 / 12)),
        (9, 6 / 0.9538725524 * (1 + 4 / 18**0.5 + 8 / 18)),
        (100, 6 / 0.9538725524 * (1 + 4 / 200**0.5 + 8 / 200)),
    ],
)
def test_where_an_outlier_begins_is_as_by_hand(marks, cut, side):
    """Marks read at -1, 0 and 1: half of their pairs differ by no more than 1."""
    key, values = np.repeat(np.arange(marks), 3), np.tile([-1.0, 0.0, 1.0], marks)
    for off, expected in ((cut - 1e-6, []), (cut + 1e-6, [5])):
        values[3:6] = [-side, 0.0, side * off]
        found = reduce_repeats(
            key, values[None] * SIGMA, np.zeros(len(key)), limit=LIMIT
        )
        assert np.flatnonzero(found.outlier).tolist() == expected


@pytest.mark.parametrize("repeats", range(3, 8))
@pytest.mark.parametrize("marks", [121, 441])
def test_every_outlier_of_1_to_20_um_is_caught(repeats, marks):
    rng = np.random.default_rng(repeats)
    spoilt_total = 0
    for _ in range(25):
        key, values, sigma = readings(marks, repeats, rng)
        spoilt = rng.random(len(key)) < 0.01
        angle, size = (
            rng.uniform(0, 2 * np.pi, len(key)),
            rng.uniform(1e-6, 20e-6, len(key)),
        )
        values += spoilt * size * np.stack([np.cos(angle), np.sin(angle)])
        outlier = reduce_repeats(key, values, sigma, limit=LIMIT).outlier
        assert outlier[spoilt].all()
        alone = np.bincount(key, spoilt)[key] <= (repeats - 1) // 2
        assert not outlier[~spoilt & alone].any()
        spoilt_total += spoilt.sum()
    assert spoilt_total > 0.005 * marks * repeats * 25


def one_spoilt_mark(repeats, offsets, *, marks=100):
    """Return which repeats of mark 0 are outliers when `offsets` (x) are added to the first."""
    key, values, sigma = readings(marks, repeats, np.random.default_rng(4))
    at = np.flatnonzero(key == 0)
    values[0, at[: len(offsets)]] += offsets
    means = reduce_repeats(key, values, sigma, limit=LIMIT)
    assert not means.outlier[key != 0].any()
    return means.outlier[at].tolist(), means.key.tolist()


def test_two_repeats_that_contradict_each_other_are_both_rejected():
    outlier, marks = one_spoilt_mark(2, [1e-6])
    assert outlier == [True, True]
    assert marks == list(range(1, 100))


@pytest.mark.parametrize("offsets", [[1e-6, 7e-6], [-1e-6, 7e-6], [5e-6, 2e-6]])
def test_three_repeats_that_all_differ_are_all_rejected(offsets):
    assert one_spoilt_mark(3, offsets)[0] == [True, True, True]


def test_one_of_three_and_two_of_five_are_told_from_the_rest():
    assert one_spoilt_mark(3, [1e-6])[0] == [True, False, False]
    assert one_spoilt_mark(5, [1e-6, -2e-6])[0] == [True, True, False, False, False]
    assert one_spoilt_mark(5, [1e-6, 9e-6])[0] == [True, True, False, False, False]
    assert one_spoilt_mark(5, [1e-6, 5e-6, 9e-6])[0] == [True] * 5


def test_a_limit_of_zero_keeps_all():
    key, values, sigma = readings(50, 3, np.random.default_rng(1))
    values[0, 0] += 1e-3
    assert not reduce_repeats(key, values, sigma, limit=0.0).outlier.any()
    assert reduce_repeats(key, values, sigma, limit=LIMIT).outlier.sum() == 1


def test_outliers_are_told_in_units_of_the_declared_sigma():
    key, values, _ = readings(50, 4, np.random.default_rng(1))
    coarse = key < 10
    values[:, coarse] *= 50
    sigma = np.where(coarse, 50 * SIGMA, SIGMA)
    assert not reduce_repeats(key, values, sigma, limit=LIMIT).outlier.any()
    assert (
        reduce_repeats(key, values, 0 * sigma, limit=LIMIT).outlier[coarse].sum() > 10
    )


def test_marks_with_declared_sigmas_far_apart_are_held_to_their_own():
    rng, marks = np.random.default_rng(3), 200
    sigma = np.repeat(np.where(np.arange(marks) % 2, 30 * SIGMA, SIGMA), 4)
    values = rng.normal(0, 1, (2, 4 * marks)) * sigma
    values[0, 9] += 12 * SIGMA  # of a mark read well; nothing among those of the others
    for size in (1.0, 1e3):  # declared in whatever unit
        means = reduce_repeats(
            np.repeat(np.arange(marks), 4), values, size * sigma, limit=LIMIT
        )
        assert np.flatnonzero(means.outlier).tolist() == [9]


def test_mean_count_repeatability_and_degrees_of_freedom_as_by_hand():
    rng = np.random.default_rng(2)
    key = rng.permutation(np.repeat([3, 5, 8, 9], [4, 1, 2, 5]))
    values = rng.normal(1e-6, SIGMA, (2, len(key)))
    means = reduce_repeats(key, values, np.zeros(len(key)), limit=0.0)
    assert means.key.tolist() == [3, 5, 8, 9]
    assert means.count.tolist() == [4, 1, 2, 5]
    assert means.dof == 2 * (3 + 0 + 1 + 4)
    groups = [values[:, key == k] for k in (3, 5, 8, 9)]
    np.testing.assert_allclose(
        means.mean.T, [g.mean(axis=1) for g in groups], rtol=1e-14
    )
    squares = sum(((g - g.mean(axis=1, keepdims=True)) ** 2).sum() for g in groups)
    assert means.sigma == pytest.approx(np.sqrt(squares / means.dof), rel=1e-12)
    assert means.u.shape == (0,)


def test_without_repeats_there_is_no_repeatability():
    means = reduce_repeats(np.arange(4), np.ones((2, 4)), np.zeros(4), limit=LIMIT)
    assert np.isnan(means.sigma)
    assert means.dof == 0
    empty = reduce_repeats(np.zeros(0, int), np.zeros((2, 0)), np.zeros(0), limit=LIMIT)
    assert (empty.mean.shape, empty.count.tolist(), empty.dof) == ((2, 0), [], 0)


def test_declared_sigmas_weigh_the_mean_and_tell_its_uncertainty():
    key = np.array([0, 0, 0, 1, 1, 2])
    values = np.array([[1.0, 2.0, 4.0, 5.0, 7.0, 9.0]])
    sigma = np.array([1.0, 2.0, 0.5, 1.0, 0.0, 3.0])
    means = reduce_repeats(key, values, sigma, limit=0.0)
    weights = 1 / sigma[:3] ** 2
    assert means.mean[0, 0] == pytest.approx(
        np.average(values[0, :3], weights=weights), rel=1e-14
    )
    assert means.mean[0, 1] == 6.0  # one of its repeats declares none: not weighted
    np.testing.assert_allclose(
        means.u, [1 / np.sqrt(weights.sum()), np.nan, 3.0], rtol=1e-14
    )


@given(st.floats(-1e-3, 1e-3), st.integers(1, 9), st.floats(1e-12, 1e-3))
def test_equal_repeats_give_back_the_same_bits(value, repeats, sigma):
    key = np.repeat(np.arange(5), repeats)
    for declared in (0.0, sigma):
        means = reduce_repeats(
            key, np.full((2, len(key)), value), np.full(len(key), declared), limit=LIMIT
        )
        assert (means.mean == value).all()
        assert not means.outlier.any()
        assert means.sigma == 0 or repeats == 1


def test_the_pooled_repeatability_is_unbiased():
    key, values, sigma = readings(20_000, 3, np.random.default_rng(9))
    means = reduce_repeats(key, values, sigma, limit=LIMIT)
    # a standard deviation with n degrees of freedom scatters by 1/sqrt(2 n)
    assert abs(means.sigma / SIGMA - 1) < 4 / np.sqrt(2 * means.dof)


@pytest.mark.parametrize("step", [1e-9, 1e-7])
def test_a_sensor_that_resolves_no_finer_than_its_step_has_no_outliers_of_one_step(
    step,
):
    rng = np.random.default_rng(3)
    key = np.tile(np.arange(121), 6)
    values = step * np.rint(rng.normal(0, 0.22, (2, len(key)))) + 0.01 * np.stack(
        [key, -key]
    )
    means = reduce_repeats(key, values, np.zeros(len(key)), limit=LIMIT, extent=1.21)
    assert (
        0.02 < (np.abs(values - 0.01 * np.stack([key, -key])) > step / 2).mean() < 0.25
    )
    assert not means.outlier.any()
    values[0, 77] += 4.2 * step
    assert np.flatnonzero(
        reduce_repeats(
            key, values, np.zeros(len(key)), limit=LIMIT, extent=1.21
        ).outlier
    ).tolist() == [77]


def test_repeats_equal_to_the_bit_keep_their_degrees_of_freedom():
    key = np.tile(np.arange(9), 4)
    means = reduce_repeats(key, np.full((2, 36), 1e-7), np.zeros(36), limit=LIMIT)
    assert (means.sigma, means.dof) == (0.0, 2 * 9 * 3)


def test_outliers_of_exact_readings_are_no_steps_of_a_sensor():
    key = np.tile(np.arange(50), 4)
    values = np.zeros((2, 200))
    values[0, [3, 60, 130]] = [1e-6, 2.3e-6, 4.1e-6]
    assert np.flatnonzero(
        reduce_repeats(key, values, np.zeros(200), limit=LIMIT, extent=0.1).outlier
    ).tolist() == [3, 60, 130]


def test_a_thousand_repeats_do_not_cost_their_square():
    key, values, sigma = readings(25, 1000, np.random.default_rng(7))
    values[0, 12_345] += 1e-6
    tracemalloc.start()
    means = reduce_repeats(key, values, sigma, limit=LIMIT)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 60e6  # all pairs of one mark alone would be 8 MB, of 25 marks 200 MB
    assert np.flatnonzero(means.outlier).tolist() == [12_345]
    assert means.sigma == pytest.approx(SIGMA, rel=0.02)


@pytest.mark.parametrize("part", [1, 7, 64, 10**6])
def test_outliers_are_found_in_every_part_of_the_marks(monkeypatch, part):
    """Marks of two to six repeats in mixed order; first and last of each number have an outlier."""
    monkeypatch.setattr(repeats_module, "PART", part)
    rng, count = np.random.default_rng(8), np.repeat([2, 3, 4, 5, 6], 9)
    key = rng.permutation(np.repeat(np.arange(len(count)), count))
    values = rng.normal(0, SIGMA, (2, len(key)))
    spoilt = np.zeros(len(key), dtype=bool)
    for mark in np.flatnonzero(
        (np.arange(len(count)) % 9 == 0) | (np.arange(len(count)) % 9 == 8)
    ):
        spoilt[np.flatnonzero(key == mark)[-1]] = True
    values[:, spoilt] += 50 * SIGMA
    found = reduce_repeats(key, values, np.zeros(len(key)), limit=LIMIT)
    pairs = spoilt | ((count[key] == 2) & np.isin(key, key[spoilt]))  # of two both go
    assert found.outlier.tolist() == pairs.tolist()
    assert found.count.sum() == (~pairs).sum()


@pytest.mark.parametrize("count", [1, 2, 3, 4, 12, 13, 100, 101])
@pytest.mark.parametrize("of", [1.0, 1e-9, 3e5])
def test_medians_are_those_of_numpy_to_the_bit(count, of):
    rng = np.random.default_rng(count)
    table = rng.normal(of, of, (20, 3, count))
    table[rng.random(table.shape) < 0.3] = of  # ties
    for row in table[:, 0]:
        before = row.copy()
        assert median(row) == np.median(row)
        np.testing.assert_array_equal(row, before)  # untouched unless it may be
        assert median(row, overwrite=True) == np.median(before)
    rest = table[:, 1:]
    np.testing.assert_array_equal(
        row_medians(rest), np.median(rest, axis=-1, keepdims=True)
    )


def test_distances():
    np.testing.assert_array_equal(
        distances(np.array([[3e-9, -5.0, 0.0], [4e-9, 12.0, 0.0]])), [5e-9, 13.0, 0.0]
    )


def lines_read(
    turning, *, lines=24, passes=3, consecutive=False, seed=0, sigma_rad=2e-6
):
    """Return readings of lines of a plate that turns by `turning` (in -1..1 of the view), rad."""
    key = np.arange(lines * passes)
    key = key // passes if consecutive else key % lines
    noise = np.random.default_rng(seed).normal(0, sigma_rad, (1, len(key)))
    return key, noise + turning(np.linspace(-1, 1, len(key))), np.zeros(len(key))


def means_of_lines(*read):
    key, values, sigma = read
    return without_turning(reduce_repeats(*read, limit=0), key, values, sigma=sigma)


@pytest.mark.parametrize("passes", [2, 3, 5])
def test_a_plate_that_turns_slowly_is_no_noise_of_its_lines(passes):
    def turning(part):
        return 2e-5 * part - 3e-5 * part**2

    means = means_of_lines(*lines_read(turning, passes=passes))
    assert means.sigma == pytest.approx(2e-6, rel=0.3)
    assert means.dof == 24 * (passes - 1) - 2
    away = means.mean[0] - means.mean[0].mean()
    assert away.std() < 1.3 * 2e-6 / np.sqrt(passes)


def test_lines_of_a_plate_that_rests_keep_their_means():
    changed = 0
    for seed in range(300):
        read = lines_read(np.zeros_like, passes=2, lines=8, seed=seed)
        changed += means_of_lines(*read).dof != reduce_repeats(*read, limit=0).dof
    assert changed <= 15  # 6 expected at 2 %


def test_successive_repeats_of_lines_do_not_determine_a_turning():
    read = lines_read(lambda part: 1e-3 * part, consecutive=True)
    assert means_of_lines(*read).dof == 48
