# SPDX-License-Identifier: Apache-2.0
"""Figures of the step-diagonal measurement: profiles with U, curves over logarithms."""

from pathlib import Path

import numpy as np
import pytest
from scipy.stats import t

from selfcal_ros.laser.data import DIAGONALS, Form, Method
from selfcal_ros.laser.identify import Choice, identify
from selfcal_ros.laser.noise import linear_noise, reading_noise
from selfcal_ros.laser.profiles import profile_m, u_profile_m
from selfcal_ros.laser.report import profiles_figure, sensitivity_figure
from selfcal_ros.laser.table import Columns, read_table
from selfcal_ros.reporting.figures.drawing import Discs, Label
from selfcal_ros.reporting.figures.drawing import Path as Line

EXAMPLE = Path(__file__).parents[2] / "config" / "step_diagonal" / "case_study.csv"


def test_bars_are_as_long_as_u_with_the_k_of_the_repeats():
    data, _ = read_table(EXAMPLE, Columns((0.01, 0.01), DIAGONALS[2], True))
    found = identify(data, Choice(Method.NEW, Form.EXACT))
    drawing = profiles_figure(found, data)
    dots = [item.centres for item in drawing.items if isinstance(item, Discs)]
    bars = [item.lines for item in drawing.items if isinstance(item, Line)
            and item.stroke == "c0" and len(item.lines) == found.n_blocks + 1]
    assert len(dots) == len(bars) == 4
    profile, u = profile_m(found, 0, 1), u_profile_m(found, 0, 1)
    up = dots[1][0][1] - np.array([y for _, y in dots[1]])  # from the start, upwards
    gain = up[-1] / profile[-1]
    assert gain > 0 and up == pytest.approx(profile * gain, abs=1e-6)
    dof = min(reading_noise(data).dof, linear_noise(data).dof)
    k = t.ppf(0.5 + 0.9545 / 2, dof)
    assert [low[1] - high[1] for low, high in bars[1]] == pytest.approx(2 * k * u * gain, rel=1e-3)
    title = next(item.text for item in drawing.items if isinstance(item, Label))
    assert title == f"Step diagonal, new formulation; bars: U, k = {k:.3g}"


def test_curves_stand_over_powers_of_ten():
    effect = dict.fromkeys(("linear_m", "transverse_m", "squareness_m"), 1e-9)
    nothing = dict.fromkeys(effect, 0.0)
    curves = [{"fault": "mirror off", "size": [1e-4, 1e-3, 1e-2],
               "conventional": [nothing, effect, dict.fromkeys(effect, 1e-6)],
               "new": [nothing] * 3}]
    drawing = sensitivity_figure(curves)
    low, middle, high = next(item.lines[0] for item in drawing.items if isinstance(item, Line)
                             and item.dash)
    assert middle[0] - low[0] == pytest.approx(high[0] - middle[0])
    assert low[1] - middle[1] == pytest.approx(middle[1] - high[1])  # 1 pm, 1 nm, 1 um
    words = {item.text for item in drawing.items if isinstance(item, Label)}
    assert {"10⁻⁴", "10⁻²", "10⁻⁶", "10⁰", "mirror off"} <= words
