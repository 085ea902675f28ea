# SPDX-License-Identifier: Apache-2.0
"""The draws behind the limit of a held-out part have the noise of readings of their weights."""

import numpy as np
import pytest

from selfcal_ros.estimation.quality.prediction_limit import noise_of


def test_the_noise_that_is_drawn_is_that_of_the_weights_on_either_axis():
    weight = np.array([[0.0, 0.04, 0.25], [1.0, 4.0, 9.0]])
    found = noise_of(np.random.default_rng(3), (20_000, 2, 3), weight)
    expected = np.array([[0.0, 5.0, 2.0], [1.0, 0.5, 1 / 3]])
    for part in (found.real, found.imag):
        assert np.std(part, axis=0) == pytest.approx(expected, rel=0.02)  # 4 sigma
    # the axes are independent: real and imaginary part of the mean square are noise
    assert (np.abs((found**2).mean(axis=0)) <= 0.05 * expected**2).all()
