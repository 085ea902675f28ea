# SPDX-License-Identifier: Apache-2.0
"""What readings say of themselves where nothing was read."""

import math
from dataclasses import replace

from selfcal_ros.model.artifact import Artifact, Interpolation, MapGrid
from selfcal_ros.model.readings import ViewReadings, placing_digest
from selfcal_ros.model.view import View


def test_a_view_of_which_nothing_was_read_holds_nothing():
    nothing = ViewReadings(View("v"))
    assert (nothing.used, nothing.dof_xy, nothing.dof_theta, nothing.rejected) == (
        0,
        0,
        0,
        {},
    )
    assert math.isnan(nothing.sigma_xy) and math.isnan(nothing.sigma_theta)
    assert nothing.visits is None
    for values in (
        nothing.m,
        nothing.n,
        nothing.dx,
        nothing.dy,
        nothing.count,
        nothing.u,
        nothing.k,
        nothing.dtheta,
        nothing.count_theta,
        nothing.u_theta,
    ):
        assert values.shape == (0,)


def test_what_a_view_is_placed_for_depends_on_the_map():
    """A resumed run is another one if only the nodes of the map differ."""
    plate, view = Artifact(5, 0.01, 8), View("v")
    digests = {
        placing_digest(replace(plate, map_grid=grid), view)
        for grid in (
            None,
            MapGrid(3, 0.02),
            MapGrid(5, 0.02),
            MapGrid(3, 0.01),
            MapGrid(3, 0.02, size_y=5),
            MapGrid(3, 0.02, Interpolation.BILINEAR),
        )
    }
    assert len(digests) == 6
    # of a plan on the lattice, as journals know it
    assert "f943b89aa4fe758a" in digests
