# SPDX-License-Identifier: Apache-2.0
"""Readings of noise: calibrated as any others, so that a process is ready for the first."""

import numpy as np
import pytest

from selfcal_ros.estimation.api import calibrate
from selfcal_ros.nodes.sessions.solving import pure_noise


@pytest.mark.parametrize("marks", [5, 21])
def test_noise_gives_a_whole_map(marks):
    result = calibrate(pure_noise(marks))
    assert result.observability.identifiable
    assert np.isfinite(result.error_map.u_gx).all()
    assert np.abs(result.error_map.gx).max() < 2e-6
