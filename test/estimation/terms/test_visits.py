# SPDX-License-Identifier: Apache-2.0
"""Means over the visits of a mark, and what they hide: by hand."""

from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.errors import InputError
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.terms.visits import ViewVisits
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.readings import GridVisits, Measurements, ViewReadings
from selfcal_ros.model.view import View


def visits(marks, weights):
    n = len(marks)
    nothing = np.zeros(n)
    return ViewVisits(
        np.array(marks, dtype=int),
        np.array(weights, dtype=float),
        nothing + 0j,
        nothing,
        nothing + 0j,
        nothing,
        nothing,
        1 + 0j,
    )


def test_a_mark_that_was_visited_twice_has_the_weighted_mean_of_both():
    twice = visits([2, 0, 2], [1, 5, 3])
    values = np.array([[4 + 4j, 7j, 8 - 4j], [1, 2, 1]])
    assert twice.repeated
    assert twice.means(values, 4) == pytest.approx(
        np.array([[7j, 0, 7 - 2j, 0], [2, 0, 1, 0]])
    )
    assert twice.about_means(values, 4) == pytest.approx(
        np.array([[-3 + 6j, 0, 1 - 2j], [0, 0, 0]])
    )


@pytest.mark.filterwarnings("error")
def test_visits_of_a_mark_that_does_not_count_have_its_plain_mean():
    """As a mark of a recheck that the calibration has not determined, weight 0."""
    twice = visits([2, 0, 2, 0], [0, 5, 0, 15])
    values = np.array([[4 + 4j, 7j, 8 - 4j, 3j]])
    assert twice.means(values, 3) == pytest.approx(np.array([[4j, 0, 6]]))
    assert twice.about_means(values, 3) == pytest.approx(
        np.array([[-2 + 4j, 3j, 2 - 4j, -1j]])
    )


def test_a_visit_that_is_the_only_one_of_its_mark_is_its_mean():
    once = visits([2, 0, 3], [1, 5, 3])
    values = np.array([[4 + 4j, 7j, 8 - 4j]])
    assert not once.repeated
    assert np.array_equal(once.means(values, 4), [[7j, 0, 4 + 4j, 8 - 4j]])
    assert np.array_equal(once.about_means(values, 4), [[0, 0, 0]])


def test_a_view_without_visits_has_no_means():
    none = visits([], [])
    assert not none.repeated
    assert np.array_equal(
        none.means(np.zeros((2, 0), dtype=complex), 3), np.zeros((2, 3))
    )


def with_visits(**changed):
    """Return readings of two views whose visits have other columns than they should."""
    m, n = (array.ravel() - 1 for array in np.indices((3, 3)))
    zero, one = np.zeros(9), np.ones(9, dtype=int)
    at = GridVisits(
        np.arange(9), zero, zero, one, np.arange(9), zero, zero, 0 * one, 0 * one
    )
    plain = ViewReadings(
        View("a", angular=False), m, n, zero, zero, one, visits=replace(at, **changed)
    )
    turned = replace(plain, view=View("b", np.pi / 2, angular=False), visits=None)
    here = m < 1
    moved = ViewReadings(
        View("c", translation_m=(0.01, 0.0), angular=False),
        m[here],
        n[here],
        zero[here],
        zero[here],
        one[here],
    )
    return Measurements("p", Artifact(3, 0.01, 0), (plain, turned, moved))


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        (
            {"offset_x": np.full(9, np.nan)},
            "a deviation or offset is not a finite number",
        ),
        ({"offset_y": np.full(9, 1e6)}, "a deviation or offset is not a finite number"),
        ({"dy": np.full(9, -np.inf)}, "a deviation or offset is not a finite number"),
        (
            {"mark": np.arange(1, 10)},
            "a visit belongs to none of the marks that were read",
        ),
        (
            {"mark": np.arange(-1, 8)},
            "a visit belongs to none of the marks that were read",
        ),
        ({"count": np.arange(9)}, "a count below 1"),
        ({"approach_y": np.zeros(8)}, "differ in length"),
    ],
)
def test_visits_that_cannot_be_are_refused_in_one_line(changed, reason):
    with pytest.raises(InputError, match=f"view 'a' visits of grid marks: .*{reason}"):
        calibrate(with_visits(**changed))
    assert calibrate(with_visits()).observability.identifiable
