# SPDX-License-Identifier: Apache-2.0
"""The turn of lines and offsets in `selfcal cell check`."""

import numpy as np
import pytest

from selfcal_ros.model.readings import Measurements, RepeatMotion, ViewReadings
from selfcal_ros.nodes.sessions.cell_check import CellCheck, _response, _turned_deg
from test.support.ports import Hands, settings_of
from test.support.sessions import small_plan

STRAIGHT = "turn the plate by 1 mrad and check again"
ZERO = "lay the plate straight, set theta to 0"
REVERSED = "reverse the sign of offset_theta"


@pytest.mark.parametrize(
    ("turn", "lines", "stops", "said", "remedy"),
    [
        (5e-4, 5.1e-4, 0, "", ""),
        (-5e-4, -5.1e-4, 0, "", ""),
        (1e-3, 1.2e-3, 0, "", ""),
        (5e-4, -5.1e-4, 0, "offset_theta has the other sign", REVERSED),
        (-5e-4, 5.1e-4, 0, "offset_theta has the other sign", REVERSED),
        (5e-4, -5.1e-4, -1, "offset_theta has the other sign", REVERSED),
        (
            5e-4,
            -3e-3,
            0,
            "neither the same nor the opposite turn",
            ZERO,
        ),  # another zero, or no offset
        (5e-4, 0.0, 0, "neither the same nor the opposite turn", ZERO),
        (5e-4, -3e-3, 1, "neither the same nor the opposite turn", ZERO),
        (5e-4, -3e-3, -1, "", ""),
        (1e-5, 1e-5, 0, "too little to tell the sign", STRAIGHT),
        (1e-5, -1e-5, 0, "too little to tell the sign", STRAIGHT),
        (1e-5, 1e-5, 1, "too little to tell the sign", STRAIGHT),
        (1e-5, 1e-5, -1, "", ""),
    ],
)
def test_what_does_not_show_the_sign_of_the_lines_does_not_pass(
    turn, lines, stops, said, remedy
):
    """`stops`: slope of the offsets of lines that scatter by 1 urad, 0 = no scatter."""
    check = CellCheck(small_plan(), settings_of("measurement_collector"), Hands().ports)
    m, n = (np.array(row).ravel() for row in np.meshgrid((-1, 0, 1), (-1, 0, 1)))
    pitch = check.plate.grid_pitch_m
    motion = RepeatMotion(8e-12 * np.array([[1, stops], [stops, stops**2]]), 8)
    check._judge_theta(
        Measurements(
            "cell_check",
            check.plate,
            (
                ViewReadings(
                    check.view,
                    m,
                    n,
                    dx=1e-5 - turn * n * pitch,
                    dy=2e-5 + turn * m * pitch,
                    dtheta=lines + np.array([1e-6, -1e-6]),
                    motion_theta=motion,
                ),
            ),
        )
    )
    [item] = check.items
    assert (item.name, item.passed) == ("theta", not said)
    assert item.figure.endswith(said or " mrad")
    assert item.remedy.startswith(remedy) and bool(item.remedy) is bool(remedy)


@pytest.mark.parametrize("deg", [0.0, 30.0, 90.0, -135.0])
def test_offsets_turned_by_any_angle_are_measured(deg):
    c, s = np.cos(np.deg2rad(deg)), np.sin(np.deg2rad(deg))
    moved = np.random.default_rng(1).normal(0, 2e-5, (2, 40))
    both = np.concatenate([moved, -np.array([[c, -s], [s, c]]) @ moved])
    response = _response(RepeatMotion(both @ both.T, 39))
    assert _turned_deg(response) == pytest.approx(deg, abs=1e-6)
    both[2:] = np.random.default_rng(2).normal(0, 2e-5, (2, 40))
    assert _response(RepeatMotion(both @ both.T, 39)) is None
