# SPDX-License-Identifier: Apache-2.0
"""Figures of the step-diagonal measurement: profiles with U."""

from pathlib import Path

import numpy as np
import pytest
from scipy.stats import t

from selfcal_ros.applications.laser.data import DIAGONALS, Form, Method
from selfcal_ros.applications.laser.identify import Choice, identify
from selfcal_ros.applications.laser.noise import linear_noise, reading_noise
from selfcal_ros.applications.laser.profiles import profile_m, u_profile_m
from selfcal_ros.applications.laser.report import profiles_figure
from selfcal_ros.applications.laser.table import RequiredColumns, read_table
from selfcal_ros.reporting.figures.drawing import Discs, Label
from selfcal_ros.reporting.figures.drawing import Path as Line

EXAMPLE = Path(__file__).parents[3] / "config" / "step_diagonal" / "case_study.csv"


def test_bars_are_as_long_as_u_with_the_k_of_the_repeats():
    data, _ = read_table(EXAMPLE, RequiredColumns((0.01, 0.01), DIAGONALS[2], True))
    found = identify(data, Choice(Method.NEW, Form.EXACT))
    drawing = profiles_figure(found, data)
    dots = [item.centres for item in drawing.items if isinstance(item, Discs)]
    bars = [
        item.lines
        for item in drawing.items
        if isinstance(item, Line)
        and item.stroke == "c0"
        and len(item.lines) == found.n_blocks + 1
    ]
    assert len(dots) == len(bars) == 4
    profile, u = profile_m(found, 0, 1), u_profile_m(found, 0, 1)
    up = dots[1][0][1] - np.array([y for _, y in dots[1]])  # from the start, upwards
    gain = up[-1] / profile[-1]
    assert gain > 0 and up == pytest.approx(profile * gain, abs=1e-6)
    dof = min(reading_noise(data).dof, linear_noise(data).dof)
    k = t.ppf(0.5 + 0.9545 / 2, dof)
    assert [low[1] - high[1] for low, high in bars[1]] == pytest.approx(
        2 * k * u * gain, rel=1e-3
    )
    title = next(item.text for item in drawing.items if isinstance(item, Label))
    assert title == f"Step diagonal, new formulation; bars: U, k = {k:.3g}"
