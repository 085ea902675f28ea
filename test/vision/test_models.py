# SPDX-License-Identifier: Apache-2.0
"""Derivatives of the image models against differences, and the shapes against drawn ones."""

import numpy as np
import pytest
from scipy.special import ndtr

from selfcal_ros.vision.models import MODELS

STEP = 1e-6


@pytest.mark.parametrize("mark", MODELS)
def test_derivatives_are_those_of_the_shape(mark):
    model, rng = MODELS[mark], np.random.default_rng(1)
    p = model.start(20.0, 5.0, 0.3, 1.1)
    u, v = rng.uniform(-14, 14, (2, 300))
    _, by = model.shape(u, v, p)
    for column in range(2 + len(p)):
        change = np.zeros(2 + len(p))
        change[column] = STEP
        plus, minus = (
            model.shape(
                u - sign * change[0], v - sign * change[1], p + sign * change[2:]
            )[0]
            for sign in (1, -1)
        )
        assert by[column] == pytest.approx((plus - minus) / (2 * STEP), abs=3e-5)


def test_an_edge_is_a_step_blurred_by_a_gaussian_and_the_pixel():
    u = np.linspace(0.0, 20.0, 1001)
    shape, _ = MODELS["disc"].shape(u, np.zeros_like(u), np.array([20.0, 1.1]))
    assert shape == pytest.approx(ndtr((10 - u) / np.sqrt(1.1**2 + 1 / 12)), abs=1e-7)


@pytest.mark.parametrize(
    "mark, inside, outside",
    [
        ("disc", [(0, 0), (9, 0), (6, -6)], [(11, 0), (8, 8)]),
        ("ring", [(8, 0), (-5.5, 5.5)], [(0, 0), (4, 0), (11, 0)]),
        ("cross", [(0, 0), (9, 0), (0, -9), (2, 2)], [(4, 4), (11, 0), (9, 4)]),
        ("corner", [(3, 3), (-3, -3)], [(3, -3), (-3, 3)]),
    ],
)
def test_shapes_are_one_inside_and_zero_outside(mark, inside, outside):
    model = MODELS[mark]
    p = model.start(20.0, 5.0, 0.0, 0.1)
    for points, value in ((inside, 1), (outside, 0)):
        u, v = np.array(points, dtype=float).T
        assert model.shape(u, v, p)[0] == pytest.approx(value, abs=0.01)
