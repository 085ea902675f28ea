# SPDX-License-Identifier: Apache-2.0
"""The turn of lines and offsets in `selfcal cell check`."""

import numpy as np
import pytest

from selfcal_ros.model.readings import RepeatMotion, ViewReadings
from selfcal_ros.sessions.cell_check import CellCheck, _turned_deg
from test.support.ports import Hands, settings_of
from test.support.sessions import small_plan


@pytest.mark.parametrize(("turn", "lines", "passed"), [
    (5e-4, 5.1e-4, True), (5e-4, -5.1e-4, False), (-5e-4, 5.1e-4, False), (-5e-4, -5.1e-4, True),
    (5e-4, -3e-3, True),  # another zero of the encoder
    (1e-5, -1e-5, True)])  # too small to tell
def test_lines_show_the_turn_of_the_plate_or_its_opposite(turn, lines, passed):
    check = CellCheck(small_plan(), settings_of("measurement_collector"), Hands().ports)
    m, n = (np.array(row).ravel() for row in np.meshgrid((-1, 0, 1), (-1, 0, 1)))
    pitch = check.plate.grid_pitch_m
    check._judge_theta(ViewReadings(
        check.view, m, n, dx=1e-5 - turn * n * pitch, dy=2e-5 + turn * m * pitch,
        dtheta=lines + np.array([1e-6, -1e-6])))
    [item] = check.items
    assert (item.name, item.passed) == ("theta", passed)
    assert ("other sign" in item.figure) is not passed
    assert ("too little to tell the sign" in item.figure) is (abs(turn) < 2e-4)


@pytest.mark.parametrize("deg", [0.0, 30.0, 90.0, -135.0])
def test_offsets_turned_by_any_angle_are_measured(deg):
    c, s = np.cos(np.deg2rad(deg)), np.sin(np.deg2rad(deg))
    moved = np.random.default_rng(1).normal(0, 2e-5, (2, 40))
    both = np.concatenate([moved, -np.array([[c, -s], [s, c]]) @ moved])
    assert _turned_deg(RepeatMotion(both @ both.T, 39)) == pytest.approx(deg, abs=1e-6)
    both[3] *= -1
    assert _turned_deg(RepeatMotion(both @ both.T, 39)) is None  # mirrored
