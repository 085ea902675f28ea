# SPDX-License-Identifier: Apache-2.0
"""The circles around arrow heads: U along x and along y, each of its own size."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.collections import EllipseCollection
from matplotlib.figure import Figure

from selfcal_ros.model.artifact import Artifact
from selfcal_ros.reporting.maps.xy import draw_error_map
from test.support.maps import random_map


def test_an_ellipse_is_as_wide_as_u_along_x_and_as_high_as_u_along_y():
    emap = random_map(Artifact(5, 0.01, 0, 7), 2)
    wide, high = np.full((5, 7), 3e-7), np.full((5, 7), 1e-7)
    axes = Figure().add_subplot()
    draw_error_map(axes, replace(emap, u_gx=wide, u_gy=high))
    found, = (c for c in axes.collections if isinstance(c, EllipseCollection))
    widths, heights = 2 * found._widths, 2 * found._heights  # get_widths: since matplotlib 3.9
    assert widths == pytest.approx(3 * heights)
    offsets = found.get_offsets()
    at = np.stack([emap.artifact.x_m.ravel(), emap.artifact.y_m.ravel()], axis=1) * 1e3
    gain = (offsets - at) / np.stack([emap.gx.ravel(), emap.gy.ravel()], axis=1)
    assert gain == pytest.approx(np.full_like(gain, gain[0, 0]))  # heads of the enlarged arrows
    assert widths == pytest.approx(np.full(35, 4 * 3e-7 * gain[0, 0]))  # two U across, k = 2
