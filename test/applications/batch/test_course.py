# SPDX-License-Identifier: Apache-2.0
"""Trends and changes: a published series, an oracle by brute force, the rate of false alarms."""

from itertools import permutations
from statistics import median

import numpy as np
import pytest
from scipy import stats

from selfcal_ros.applications.batch import course
from selfcal_ros.applications.batch.course import (
    COURSE_LEVEL,
    FEWEST,
    CourseKind,
    course_of,
    courses,
    pettitt,
    step_of,
)

NILE = [
    1120,
    1160,
    963,
    1210,
    1160,
    1160,
    813,
    1230,
    1370,
    1140,
    995,
    935,
    1110,
    994,
    1020,
    960,
    1180,
    799,
    958,
    1140,
    1100,
    1210,
    1150,
    1250,
    1260,
    1220,
    1030,
    1100,
    774,
    840,
    874,
    694,
    940,
    833,
    701,
    916,
    692,
    1020,
    1050,
    969,
    831,
    726,
    456,
    824,
    702,
    1120,
    1100,
    832,
    764,
    821,
    768,
    845,
    864,
    862,
    698,
    845,
    744,
    796,
    1040,
    759,
    781,
    865,
    845,
    944,
    984,
    897,
    822,
    1010,
    771,
    676,
    649,
    846,
    812,
    742,
    801,
    1040,
    860,
    874,
    848,
    890,
    744,
    749,
    838,
    1050,
    918,
    986,
    797,
    923,
    975,
    815,
    1020,
    906,
    901,
    1170,
    912,
    746,
    919,
    718,
    714,
    740,
]
"""Yearly flow of the Nile, 1871 to 1970: the change of 1898 that every text on the subject has."""


def rng(seed: int = 1) -> np.random.Generator:
    return np.random.default_rng(seed)


def test_the_change_of_the_nile_is_found():
    p = pettitt(np.array(NILE, dtype=float), rng())
    assert p == pytest.approx(1e-4)  # none of 9,999 random orders comes near it
    days = 365.25 * np.arange(100)
    course = courses(days, {"flow": np.array(NILE, dtype=float)})["flow"]
    assert (course.finding, 1871 + course.change) == (CourseKind.CHANGE, 1899)
    assert (course.before, course.after) == (median(NILE[:28]), median(NILE[28:]))


def u_of(values) -> float:
    """His definition: max over t of |sum over i <= t < j of sgn(x_i - x_j)|, in plain loops."""
    n = len(values)
    return max(
        abs(
            sum(
                (values[i] > values[j]) - (values[i] < values[j])
                for i in range(t)
                for j in range(t, n)
            )
        )
        for t in range(1, n)
    )


@pytest.mark.parametrize(
    "values", [(1, 2, 3, 6, 4, 5), (2, 2, 3, 1, 4, 4), (3, 1, 4, 2, 6, 5)]
)
def test_the_probability_is_that_of_pettitts_statistic_in_all_orders(values):
    exact = np.mean([u_of(order) >= u_of(values) for order in permutations(values)])
    found = pettitt(np.array(values, dtype=float), rng(), orders=40_000)
    assert found == pytest.approx(exact, abs=0.008)


@pytest.mark.parametrize("n", [FEWEST - 1, FEWEST])
def test_a_course_needs_eight_values(n):
    days, values = np.arange(n) * 2.0, np.arange(n) * 3.0 + 5.0
    course = course_of(days, values, rng(), orders=99)
    assert FEWEST == 8
    slopes = (1.5, 1.5, 1.5) if n == 8 else (0.0, 0.0, 0.0)
    assert (course.n, course.slope_per_day) == (n, pytest.approx(slopes))
    # 2 of 8! orders are as steep as a series that rises all the time
    assert course.p_trend == pytest.approx(2 / 40320 if n == 8 else 1.0)


def test_a_step_near_the_end_is_placed_where_it_is():
    values = rng(8).normal(0, 0.1, 30)
    values[26:] += 1
    assert step_of(values) == 26


@pytest.fixture
def probabilities_alone(monkeypatch):
    """Leave out slopes and places of steps: whether anything is named does not depend on them."""
    monkeypatch.setattr(stats, "theilslopes", lambda *_: (0.0, 0.0, 0.0, 0.0))
    monkeypatch.setattr(course, "step_of", lambda _: 1)


@pytest.mark.usefixtures("probabilities_alone")
def test_clean_batches_name_nothing_as_often_as_promised():
    """Of 400 batches without a trend, of three quantities, 5 % name one: within 3 sigma."""
    draws, alarms = rng(7), 0
    for _ in range(400):
        days = np.cumsum(draws.exponential(1.0, 20))
        table = {
            "a": draws.normal(size=20),
            "b": draws.lognormal(size=20),
            "c": draws.integers(0, 4, 20).astype(float),
        }
        alarms += any(
            course.finding is not CourseKind.NONE
            for course in courses(days, table, orders=499).values()
        )
    low, high = stats.binom.interval(0.9973, 400, COURSE_LEVEL)
    assert 0.4 * low <= alarms <= high


@pytest.mark.usefixtures("probabilities_alone")
def test_each_test_alone_keeps_its_level():
    draws = rng(3)
    p = np.array(
        [
            [c.p_trend, c.p_change]
            for c in (
                course_of(np.arange(25.0), draws.normal(size=25), draws, orders=499)
                for _ in range(400)
            )
        ]
    )
    low, high = stats.binom.interval(0.9973, 400, COURSE_LEVEL)
    for column in (p <= COURSE_LEVEL).sum(axis=0):
        assert low <= column <= high


@pytest.mark.parametrize("sign", [1, -1])
def test_a_trend_is_a_trend_and_a_change_is_a_change(sign):
    days, noise = np.arange(40.0), rng(5).normal(0, 0.1, (3, 40))
    step = sign * np.where(days < 25, 0.0, 1.0)
    found = courses(
        days,
        {
            "line": noise[0] + sign * 0.02 * days,
            "step": noise[1] + step,
            "rest": noise[2],
        },
    )
    assert [course.finding for course in found.values()] == [
        CourseKind.TREND,
        CourseKind.CHANGE,
        CourseKind.NONE,
    ]
    slope, low, high = found["line"].slope_per_day
    assert low < sign * 0.02 < high and high - low < 0.02 and low <= slope <= high
    # Mann and Kendall's, not that of 9,999 orders
    assert found["line"].adjusted_p < 1e-6
    assert 1e-4 <= found["step"].adjusted_p < 1e-3
    assert found["step"].change == 25
    assert found["step"].after - found["step"].before == pytest.approx(
        sign * 1.0, abs=0.1
    )


@pytest.mark.parametrize(
    ("trend", "change", "kind"),
    [
        (0.01, 0.2, CourseKind.TREND),
        (0.2, 0.01, CourseKind.CHANGE),
        (0.01, 0.01, CourseKind.CHANGE),
        (0.2, 0.2, CourseKind.NONE),
    ],
)
def test_the_form_of_the_values_decides_only_between_two_significant_tests(
    monkeypatch, trend, change, kind
):
    monkeypatch.setattr(course, "_adjusted", lambda p: np.array([[trend, change]]))
    step = np.repeat([0.0, 1.0], FEWEST)
    [found] = courses(np.arange(2.0 * FEWEST), {"step": step}, orders=99).values()
    assert found.finding is kind


def test_a_wild_value_decides_nothing():
    values = rng(6).normal(size=30)
    values[29] = 1e9
    assert courses(np.arange(30.0), {"x": values})["x"].finding is CourseKind.NONE


def test_values_that_are_not_known_are_passed_over():
    days, values = np.arange(40.0), rng(5).normal(0, 0.1, 40)
    values[20:] += 1
    values[3:6] = np.nan
    assert courses(days, {"x": values})["x"].change == 20
    values[12:20] = np.nan  # nobody knows when it changed between
    course = courses(days, {"x": values})["x"]
    assert (course.finding, course.last_before, course.change) == (
        CourseKind.CHANGE,
        11,
        20,
    )
    steady = np.where(np.arange(40) < 5, np.nan, 1.0)
    nothing = courses(days, {"x": steady})["x"]
    assert (nothing.finding, nothing.last_before, nothing.change) == (
        CourseKind.NONE,
        0,
        0,
    )
    few = np.where(np.arange(40) < FEWEST - 1, values, np.nan)
    few[3:6] = 0.1
    assert courses(days, {"x": few}) == {}
    few[FEWEST] = 0.2
    assert courses(days, {"x": few})["x"].n == FEWEST


def test_what_never_changes_or_has_one_time_is_nothing():
    same = courses(np.arange(20.0), {"x": np.full(20, 3.0)})["x"]
    once = courses(np.zeros(20), {"x": np.arange(20.0)})["x"]
    assert (same.finding, once.finding) == (CourseKind.NONE, CourseKind.NONE)
    assert (same.p_trend, same.p_change, once.p_trend) == (1.0, 1.0, 1.0)
