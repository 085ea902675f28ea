# SPDX-License-Identifier: Apache-2.0
"""What each visit has in the mean of its mark."""

import numpy as np
import pytest

from selfcal_ros.estimation.recheck.solve import SeenMicroscope
from selfcal_ros.model.readings import GridVisits, ViewReadings
from selfcal_ros.model.view import View

MARK = np.array([0, 0, 1, 1, 2])
COUNT = np.array([1, 3, 2, 2, 5])


def visits(u=()):
    nothing = np.zeros(len(MARK))
    return GridVisits(
        mark=MARK,
        dx=np.array([1.0, 2.0, 3.0, 5.0, 7.0]) * 1e-6,
        dy=np.array([0.0, 1.0, 0.0, 2.0, 4.0]) * 1e-6,
        count=COUNT,
        stamp_ns=np.arange(len(MARK)),
        offset_x=np.array([1.0, -1.0, 2.0, 4.0, 1.0]) * 1e-5,
        offset_y=nothing,
        approach_x=nothing.astype(np.int8),
        approach_y=nothing.astype(np.int8),
        u=np.array(u, dtype=float),
    )


@pytest.mark.parametrize(
    ("u", "shares"),
    [
        ((), (1 / 4, 3 / 4, 1 / 2, 1 / 2, 1.0)),
        ((2e-8, 1e-8, 1e-8, 3e-8, 1e-8), (1 / 5, 4 / 5, 9 / 10, 1 / 10, 1.0)),
        # a mark of which one visit states no u goes by its repeats, the others by u
        ((2e-8, np.nan, 1e-8, 3e-8, 0.0), (1 / 4, 3 / 4, 9 / 10, 1 / 10, 1.0)),
        # squares of the smallest numbers are 0
        ((2e-200, 1e-200, 1e-200, 3e-200, 1e-200), (1 / 5, 4 / 5, 9 / 10, 1 / 10, 1.0)),
    ],
)
def test_a_visit_counts_by_its_u_or_by_its_repeats(u, shares):
    assert visits(u).shares(3) == pytest.approx(shares)


def test_means_have_a_place_for_marks_without_visits():
    values = np.array([1.0, 2.0, 3.0, 5.0, 7.0]) * (1 + 2j)
    means = visits().means(values, 4)
    assert means == pytest.approx(np.array([1.75, 4.0, 7.0, 0.0]) * (1 + 2j))


def test_a_view_corrected_for_a_microscope_has_the_means_of_its_corrected_visits():
    stated = visits((2e-8, 1e-8, 1e-8, 3e-8, 1e-8))
    deviation = stated.dx + 1j * stated.dy
    of_marks = stated.means(deviation, 3)
    view = ViewReadings(
        view=View("a"),
        m=np.array([-1, 0, 1]),
        n=np.zeros(3, dtype=int),
        dx=of_marks.real,
        dy=of_marks.imag,
        count=np.array([4, 4, 5]),
        visits=stated,
    )
    seen = SeenMicroscope(np.array([1e-2, 2e-3, 0.0, 0.0]), np.zeros((4, 4)), 1e-8)
    corrected = seen.corrected(view)
    of_visits = corrected.visits.dx + 1j * corrected.visits.dy
    assert abs(of_visits - deviation).max() > 1e-8
    assert corrected.dx + 1j * corrected.dy == pytest.approx(
        stated.means(of_visits, 3), rel=1e-12
    )
