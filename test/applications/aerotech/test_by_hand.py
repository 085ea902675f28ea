# SPDX-License-Identifier: Apache-2.0
"""Lines, digits and tracks with numbers worked out by hand, for fields wider than deep."""

from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.applications.aerotech.evaluate import EDGE, AxisSamples
from selfcal_ros.applications.aerotech.export import (
    DECIMALS,
    MAX_THETA_ROUNDING_M,
    AxisCorrection,
    line_table,
    map_line,
    map_orthogonality,
    theta_decimals,
    without_slope,
)
from selfcal_ros.compensation.frame import MachineFrame
from selfcal_ros.errors import InputError
from selfcal_ros.model.artifact import Artifact
from test.support.maps import random_map

ARCSEC = np.pi / 180 / 3600


@pytest.mark.parametrize("shape", [(7, 3), (3, 7)])
@pytest.mark.parametrize("along", ["x", "y"])
@pytest.mark.parametrize("corrected", ["x", "y"])
def test_the_middle_line_of_an_oblong_field(shape, along, corrected):
    plate = Artifact(shape[0], 0.01, 0, shape[1])
    i, j = np.indices(shape)
    emap = replace(
        random_map(plate, 1), gx=1e-9 * (10 * i + j), gy=-1e-9 * (10 * i + j)
    )
    line = map_line(emap, along, corrected)
    middle = (shape[0] // 2, shape[1] // 2)
    count = shape[0] if along == "x" else shape[1]
    wanted = [
        10 * n + middle[1] if along == "x" else 10 * middle[0] + n for n in range(count)
    ]
    np.testing.assert_allclose(
        line.positions_m, 0.01 * (np.arange(count) - count // 2), atol=1e-15
    )
    np.testing.assert_allclose(
        line.corrections_m,
        np.array(wanted) * (1e-9 if corrected == "x" else -1e-9),
        rtol=1e-12,
    )


@pytest.mark.parametrize("along", ["x", "y"])
def test_squareness_is_over_the_length_of_its_own_axis(along):
    """O = 2 urad: 4 urad over 30 mm of x and 10 mm of y to both sides."""
    emap = random_map(Artifact(7, 0.01, 0, 3), 1)
    line = map_orthogonality(replace(emap, nonorthogonality=2e-6), along)
    half = 0.03 if along == "x" else 0.01
    np.testing.assert_allclose(line.positions_m, [-half, half])
    np.testing.assert_allclose(
        line.corrections_m, [-4e-6 * half, 4e-6 * half], rtol=1e-9
    )


def test_a_slope_is_removed_about_the_middle_of_a_line_anywhere():
    """3 um at 0.4 m, rising by 2 um a step, with 1 um up and down: only that remains."""
    positions, wave = 0.4 + 0.01 * np.arange(4), np.array([1, -1, -1, 1]) * 1e-6
    line = without_slope(AxisCorrection(positions, 3e-6 + 2e-6 * np.arange(4) + wave))
    np.testing.assert_allclose(line.corrections_m, wave, rtol=0, atol=1e-18)


@pytest.mark.parametrize("side", [0.01, 0.2, 2.0])
def test_theta_has_the_digits_that_the_corner_of_the_field_needs(side):
    """Half a digit, times the distance of the corner, is at most a tenth of the rounding."""
    digits = theta_decimals(random_map(Artifact(3, side / 2, 8, 5), 1))
    corner = np.hypot(side / 2, side)

    def rounding(d):
        return 0.5 * 10.0**-d * ARCSEC * corner

    assert rounding(digits) <= 0.1 * MAX_THETA_ROUNDING_M * (1 + 1e-9)
    assert digits == DECIMALS or rounding(digits - 1) > 0.1 * MAX_THETA_ROUNDING_M


def test_zeros_of_a_reversed_axis_have_no_sign():
    line = AxisCorrection(np.array([0.0, 0.01]), np.array([0.0, 1e-6]))
    table = line_table(line, MachineFrame(reverse_x=True), along="x", corrected="x")
    assert not np.signbit(table.values[0]) and table.values[1] == -1
    assert not np.signbit(table.offset)


@pytest.mark.parametrize(
    ("first", "rollover", "covers"),
    [
        (100.0, 120.0, True),  # 100 to 140, and 0 is 120
        (-100.0, 360.0, False),
        (-100.0, 90.0, True),
        (100.0, None, False),
        (-40.0, None, True),
        (5 * EDGE, None, True),
        (20 * EDGE, None, False),  # a step of 10: the edge is 10 EDGE wide
        (-40 - 5 * EDGE, None, True),
        (-40 - 20 * EDGE, None, False),
    ],
)
def test_zero_is_covered_also_after_a_turn(first, rollover, covers):
    assert AxisSamples(1, first, 10.0, 5, rollover).covers_zero() == covers


def test_positions_between_the_last_entries_are_interpolated():
    """0, 10, 20 with a step of 10: 15 is half a step above entry 1; beyond, the last counts."""
    entry, part = AxisSamples(1, 0.0, 10.0, 3).locate(
        np.array([15.0, 20.0, 99.0, -5.0])
    )
    np.testing.assert_allclose(entry + part, [1.5, 2, 2, 0])
    assert entry.tolist() == [1, 1, 1, 0]


@pytest.mark.parametrize("axis", ["home_x_m", "home_y_m", "home_theta_rad"])
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_each_home_position_is_a_number(axis, value):
    with pytest.raises(InputError, match="is not a position"):
        MachineFrame(**{axis: value})


def test_a_reversed_theta_has_the_opposite_sign():
    assert (MachineFrame().sign_theta, MachineFrame(reverse_theta=True).sign_theta) == (
        1,
        -1,
    )
