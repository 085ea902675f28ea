# SPDX-License-Identifier: Apache-2.0
"""Directions and home of a machine's axes, by hand: tables and their checks share the frame."""

import numpy as np
import pytest

from selfcal_ros.compensation.frame import MachineFrame


@pytest.mark.parametrize(
    ("reverse", "want"),
    [
        ((False, False, False), (50.0, 15.0, 20.0)),
        ((True, False, False), (-50.0, 15.0, 20.0)),
        ((False, True, False), (50.0, -15.0, 20.0)),
        ((False, False, True), (50.0, 15.0, -20.0)),
    ],
)
def test_a_reversed_encoder_counts_from_home_the_other_way(reverse, want):
    """The stage at (20, 20) mm and 50 deg, home at (-30, 5) mm and 30 deg."""
    frame = MachineFrame(
        unit="mm",
        home_x_m=-0.03,
        home_y_m=0.005,
        home_theta_rad=np.deg2rad(30),
        reverse_x=reverse[0],
        reverse_y=reverse[1],
        reverse_theta=reverse[2],
    )
    x, y = frame.to_machine(0.02, 0.02)
    assert (x, y, frame.theta_to_machine(np.deg2rad(50))) == pytest.approx(
        want, rel=1e-12
    )
    back = (*frame.from_machine(want[0], want[1]), frame.theta_from_machine(want[2]))
    assert back == pytest.approx((0.02, 0.02, np.deg2rad(50)), rel=1e-12)
