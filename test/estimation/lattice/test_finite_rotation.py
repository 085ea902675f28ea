# SPDX-License-Identifier: Apache-2.0
"""The linear model and its excess together are a plate that turns by an angle."""

import numpy as np
import pytest

from selfcal_ros.estimation.lattice.maps import rotation_excess


def turn(angle):
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


@pytest.mark.parametrize("phi", [5e-3, -5e-3, 0.0])
@pytest.mark.parametrize("q", [0, 2])
def test_a_mark_lies_where_a_turned_rectangular_plate_has_it(q, phi):
    rng = np.random.default_rng(1)
    ax, ay = rng.normal(0, 1e-6, (2, 5, 9))
    m, n = np.array([-2, 0, 1, 2, 2]), np.array([4, -3, 0, -4, 2])
    nominal = np.stack([m, n]) * 0.01
    own = np.stack([ax[m + 2, n + 4], ay[m + 2, n + 4]])
    x, y = (
        turn(phi) @ turn(q * np.pi / 2) @ (nominal + own)
        - turn(q * np.pi / 2) @ nominal
    )
    marks, plate = ((part[0] + 1j * part[1]) * 1j**q for part in (nominal, own))
    linear = plate + 1j * phi * marks
    assert rotation_excess(phi, marks, plate) == pytest.approx(
        x + 1j * y - linear, abs=1e-16
    )
