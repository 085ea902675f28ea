# SPDX-License-Identifier: Apache-2.0
"""A table that replaces an active one, by hand."""

import numpy as np
import pytest

from selfcal_ros.compensation.frame import MachineFrame
from selfcal_ros.compensation.residual import bends_between, combined
from selfcal_ros.model.artifact import Artifact
from test.support.maps import random_map

MAP = random_map(Artifact(5, 0.01, 0, 3), 3, gain=50.0)


@pytest.mark.parametrize(
    ("reverse_x", "reverse_y"), [(False, False), (True, False), (False, True)]
)
def test_an_active_table_is_added_in_the_senses_of_its_axes(reverse_x, reverse_y):
    """Corrections in mm of an encoder; G in m of the stage. Home at (-20, 10) mm."""
    frame = MachineFrame(
        unit="mm",
        home_x_m=-0.02,
        home_y_m=0.01,
        reverse_x=reverse_x,
        reverse_y=reverse_y,
    )
    sx, sy = -1 if reverse_x else 1, -1 if reverse_y else 1
    found = combined(MAP, frame, lambda px, py: (1e-3 + 2e-5 * px, 3e-5 * py * py))
    at = MAP.artifact
    px = sx * (at.x_m + MAP.gx + 0.02) * 1e3
    py = sy * (at.y_m + MAP.gy - 0.01) * 1e3
    np.testing.assert_allclose(
        found.gx, MAP.gx + sx * (1e-3 + 2e-5 * px) * 1e-3, rtol=0, atol=1e-18
    )
    np.testing.assert_allclose(
        found.gy, MAP.gy + sy * 3e-5 * py**2 * 1e-3, rtol=0, atol=1e-18
    )


@pytest.mark.parametrize(
    ("axis", "peak_mm"), [(0, 12.5), (0, 32.5), (1, 17.5), (1, 2.5)]
)
def test_what_an_active_table_bends_by_between_the_nodes(axis, peak_mm):
    """A peak of 4 um, 2.5 mm wide on either side, that no node of 10 mm sees; home at an edge."""
    frame = MachineFrame(unit="mm", home_x_m=-0.02, home_y_m=-0.01)

    def peak(*places):
        bent = 4e-3 * np.maximum(1 - abs(places[axis] - peak_mm) / 2.5, 0)
        return (bent, 0 * bent) if axis else (0 * bent, bent)

    assert bends_between(MAP, frame, peak) == pytest.approx(4e-6, rel=1e-9)
    assert bends_between(MAP, frame, lambda px, py: (2e-3 * px - py, 1 + py)) < 1e-15
