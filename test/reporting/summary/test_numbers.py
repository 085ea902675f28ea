# SPDX-License-Identifier: Apache-2.0
"""Figures against a truth, by hand, with uncertainties that differ from line to line."""

from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.reporting.summary.numbers import p_text, truth_figures
from test.support.results import known_result


def test_the_constant_of_an_angular_difference_is_weighted():
    """Differences 3, -1, 0, 0 with u = 1, 2, 1, 4: weights 1, 1/4, 1, 1/16."""
    result, truth = known_result(3, 4)
    difference, u = np.array([3.0, -1.0, 0.0, 0.0]), np.array([1.0, 2.0, 1.0, 4.0])
    emap = replace(
        result.error_map,
        g_theta=truth["g_theta"] + difference * 1e-6,
        u_g_theta=u * 1e-6,
    )
    mean = (3 - 1 / 4) / (1 + 1 / 4 + 1 + 1 / 16)
    rest = difference - mean
    found = truth_figures(emap, truth)
    assert found.rms_theta_rad == pytest.approx(
        1e-6 * np.sqrt(np.mean(rest**2)), rel=1e-9
    )
    assert found.largest_theta_rad == pytest.approx(1e-6 * (1 + mean), rel=1e-9)
    assert found.line == 1
    assert found.rms_theta_in_u == pytest.approx(
        np.sqrt(np.mean((rest / u) ** 2)), rel=1e-9
    )
    assert found.largest_theta_in_u == pytest.approx(3 - mean, rel=1e-9)
    assert found.theta_within_2u == 1.0


@pytest.mark.parametrize(("factor", "within"), [(1.999, 1.0), (2.001, 0.75)])
def test_two_u_is_the_limit(factor, within):
    """The last line has nearly all the weight, so that the first alone is off."""
    result, truth = known_result(3, 4)
    u = np.array([1e-3, 1e-3, 1e-3, 1e-9])
    g_theta = truth["g_theta"] + np.array([factor * 1e-3, 0.0, 0.0, 0.0])
    emap = replace(result.error_map, g_theta=g_theta, u_g_theta=u)
    assert truth_figures(emap, truth).theta_within_2u == within


@pytest.mark.parametrize(
    ("p", "text"), [(0.7243, "p = 0.72"), (0.0, "p < 1e-300"), (None, "p = –")]
)
def test_a_probability_is_never_0(p, text):
    assert p_text(p) == text
