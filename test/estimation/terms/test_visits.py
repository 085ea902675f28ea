# SPDX-License-Identifier: Apache-2.0
"""Means over the visits of a mark, and what they hide: by hand."""

import numpy as np
import pytest

from selfcal_ros.estimation.terms.visits import ViewVisits


def visits(marks, weights):
    n = len(marks)
    nothing = np.zeros(n)
    return ViewVisits(np.array(marks, dtype=int), np.array(weights, dtype=float), nothing + 0j,
                      nothing, nothing + 0j, nothing, nothing, 1 + 0j)


def test_a_mark_that_was_visited_twice_has_the_weighted_mean_of_both():
    twice = visits([2, 0, 2], [1, 5, 3])
    values = np.array([[4 + 4j, 7j, 8 - 4j], [1, 2, 1]])
    assert twice.repeated
    assert twice.means(values, 4) == pytest.approx(np.array([[7j, 0, 7 - 2j, 0], [2, 0, 1, 0]]))
    assert twice.about_means(values, 4) == pytest.approx(np.array(
        [[-3 + 6j, 0, 1 - 2j], [0, 0, 0]]))


def test_a_visit_that_is_the_only_one_of_its_mark_is_its_mean():
    once = visits([2, 0, 3], [1, 5, 3])
    values = np.array([[4 + 4j, 7j, 8 - 4j]])
    assert not once.repeated
    assert np.array_equal(once.means(values, 4), [[7j, 0, 4 + 4j, 8 - 4j]])
    assert np.array_equal(once.about_means(values, 4), [[0, 0, 0]])


def test_a_view_without_visits_has_no_means():
    none = visits([], [])
    assert not none.repeated
    assert np.array_equal(none.means(np.zeros((2, 0), dtype=complex), 3), np.zeros((2, 3)))
