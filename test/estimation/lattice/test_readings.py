# SPDX-License-Identifier: Apache-2.0
"""Weights from counts and declared uncertainties, by hand, with unequal numbers of both."""

import numpy as np
import pytest

from selfcal_ros.errors import InputError
from selfcal_ros.estimation.lattice.readings import angular_data, grid_data
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.readings import Measurements, ViewReadings
from selfcal_ros.model.view import View

ARTIFACT = Artifact(3, 0.01, 4, 5)


def measurements(*views):
    return Measurements("p", ARTIFACT, tuple(views))


def test_a_declared_uncertainty_is_that_of_the_mean_not_of_one_reading():
    """Sigma of one reading is rms of u sqrt(count); the weight is (sigma / u)^2."""
    view = ViewReadings(
        View("a"),
        np.array([0, 1, -1]),
        np.array([2, 0, -2]),
        np.zeros(3),
        np.zeros(3),
        np.array([1, 4, 9]),
        u=np.array([3e-8, 1e-8, 2e-8]),
    )
    data = grid_data(measurements(view))
    variance = (9 * 1 + 1 * 4 + 4 * 9) / 3 * 1e-16
    assert data.sigma_declared == pytest.approx(np.sqrt(variance), rel=1e-12)
    marks = data.weight[0][[1, 2, 0], [4, 2, 0]]
    assert marks == pytest.approx(
        [variance / 9e-16, variance / 1e-16, variance / 4e-16]
    )
    assert np.count_nonzero(data.weight) == 3


def test_marks_without_a_declaration_count_as_readings_of_that_sigma():
    view = ViewReadings(
        View("a"),
        np.array([0, 1]),
        np.array([0, 0]),
        np.zeros(2),
        np.zeros(2),
        np.array([4, 7]),
        u=np.array([1e-8, np.nan]),
    )
    data = grid_data(measurements(view))
    assert data.sigma_declared == pytest.approx(2e-8)
    assert data.weight[0][1:, 2] == pytest.approx([4.0, 7.0])


def test_the_same_for_lines():
    view = ViewReadings(
        View("a", grid=False),
        k=np.array([3, 0]),
        dtheta=np.array([1e-5, 2e-5]),
        count_theta=np.array([2, 8]),
        u_theta=np.array([1e-6, 3e-6]),
    )
    data = angular_data(measurements(view))
    variance = (1 * 2 + 9 * 8) / 2 * 1e-12
    assert data.sigma_declared == pytest.approx(np.sqrt(variance))
    assert data.weight[0] == pytest.approx([variance / 9e-12, 0, 0, variance / 1e-12])
    assert data.y[0] == pytest.approx([2e-5, 0, 0, 1e-5])


@pytest.mark.parametrize(
    ("q", "m", "n", "fits"),
    [
        (0, 1, 2, True),
        (0, 1, -2, True),
        (0, 2, 0, False),
        (1, 1, 1, True),
        (1, 1, 2, False),
        (3, -1, -1, True),
        (3, 0, -2, False),
        (2, -1, 2, True),
    ],
)
def test_marks_off_a_rectangular_field_are_refused(q, m, n, fits):
    """A field of 3 x 5 sites: what lies along y before a quarter turn lies along x after it."""
    view = ViewReadings(
        View("a", q * np.pi / 2),
        np.array([m]),
        np.array([n]),
        np.ones(1),
        np.zeros(1),
        np.ones(1, dtype=int),
    )
    if fits:
        data = grid_data(measurements(view))
        assert data.y[0, m + 1, n + 2] == pytest.approx((-1j) ** q, abs=1e-15)
    else:
        with pytest.raises(InputError, match=rf"mark \({m}, {n}\) lies off the"):
            grid_data(measurements(view))


def test_a_line_on_a_plate_without_lines_is_refused():
    view = ViewReadings(
        View("a", angular=False),
        k=np.array([0]),
        dtheta=np.zeros(1),
        count_theta=np.ones(1, dtype=int),
    )
    with pytest.raises(
        InputError,
        match="view 'a' angular readings: a line that the plate does not have",
    ):
        angular_data(Measurements("p", Artifact(5, 0.01), (view,)))


@pytest.mark.parametrize("lines", [[0, 4], [-1, 2], [4], [-1]])
def test_lines_that_the_plate_does_not_have_are_refused(lines):
    nothing = np.zeros(len(lines))
    view = ViewReadings(
        View("a", grid=False),
        k=np.array(lines),
        dtheta=nothing,
        count_theta=np.ones(len(lines), dtype=int),
    )
    with pytest.raises(InputError) as raised:
        angular_data(measurements(view))
    assert str(raised.value) == (
        "view 'a' angular readings: a line that the plate does not have; lines are 0 to 3"
    )


def test_the_first_and_the_last_line_of_the_plate_are_read():
    view = ViewReadings(
        View("a", grid=False),
        k=np.array([0, 3]),
        dtheta=np.array([1e-6, 2e-6]),
        count_theta=np.array([1, 1]),
    )
    assert angular_data(measurements(view)).y.tolist() == [[1e-6, 0, 0, 2e-6]]


@pytest.mark.parametrize("lengths", [(2, 3, 3), (3, 2, 3), (3, 3, 2), (2, 2, 2)])
def test_marks_and_deviations_of_different_number_are_refused(lengths):
    dx, dy, count = (np.ones(length) for length in lengths)
    view = ViewReadings(
        View("a"), np.array([0, 1, -1]), np.array([2, 0, -2]), dx, dy, count
    )
    with pytest.raises(
        InputError, match=r"view 'a' grid readings: marks.* differ in length"
    ):
        grid_data(measurements(view))
