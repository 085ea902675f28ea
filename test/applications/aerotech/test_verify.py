# SPDX-License-Identifier: Apache-2.0
"""Where a table is verified, and against what: sites, centres of cells, lines."""

from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.applications.aerotech.export import table_theta, table_xy
from selfcal_ros.applications.aerotech.verify import verify_tables
from selfcal_ros.compensation.frame import MachineFrame
from selfcal_ros.model.artifact import Artifact
from test.support.maps import random_map

FRAME = MachineFrame(1, 2, theta_axis=3)


def test_tables_are_verified_at_sites_at_the_centres_of_all_cells_and_at_lines():
    """A rectangular field, 5 x 7 sites of 20 mm: 4 x 6 cells, the first centred at (-30, -50)."""
    emap = random_map(Artifact(5, 0.02, 12, 7), 3)
    found = verify_tables(
        emap, [table_xy(emap, FRAME), table_theta(emap, FRAME)], FRAME
    )
    centres = {(round(x * 1e3), round(y * 1e3)) for x, y in found.between.position.T}
    assert centres == {
        (x, y) for x in (-30, -10, 10, 30) for y in (-50, -30, -10, 10, 30, 50)
    }
    sites = {(round(x * 1e3), round(y * 1e3)) for x, y in found.sites.position.T}
    assert sites == {(x, y) for x in range(-40, 41, 20) for y in range(-60, 61, 20)}
    assert np.rad2deg(found.lines.position[0]) == pytest.approx(np.arange(12) * 30.0)


def test_before_is_the_error_itself_and_after_is_what_is_left():
    """At the sites: true - commanded is -G to first order without a table, nothing with one."""
    emap = random_map(Artifact(5, 0.02, 0, 7), 4)
    found = verify_tables(emap, [table_xy(emap, FRAME)], FRAME).sites
    g = np.stack([emap.gx.ravel(), emap.gy.ravel()])
    wanted = -(g - g.mean(axis=1, keepdims=True))
    assert found.before == pytest.approx(wanted, abs=1e-3 * np.abs(wanted).max())
    assert np.abs(found.after).max() < 1e-3 * np.abs(found.before).max()
    half = replace(table_xy(emap, FRAME), values=table_xy(emap, FRAME).values / 2)
    left = verify_tables(emap, [half], FRAME).sites
    assert left.rms("after") == pytest.approx(left.rms("before") / 2, rel=1e-2)
