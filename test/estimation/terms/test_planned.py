# SPDX-License-Identifier: Apache-2.0
"""Assumed visits of a plan, on the lattice and on a map with nodes of its own."""

from dataclasses import replace

import numpy as np

from selfcal_ros.estimation.normal.systems import planned_system
from selfcal_ros.estimation.terms.planned import Assumed, planned_ground
from selfcal_ros.model.artifact import MapGrid
from test.support.plans import plan_of


def test_visits_do_not_depend_on_the_nodes_of_the_map():
    """A map whose nodes are the sites of the lattice is another one only by its equations."""
    plan = plan_of("0, 90, 270, tx", 5)
    placed = replace(plan.artifact, map_grid=MapGrid(5, plan.artifact.grid_pitch_m))
    assumed = Assumed(order="serpentine@plate")
    grounds = [planned_ground(artifact, plan.views, planned_system(artifact, plan.views), assumed)
               for artifact in (plan.artifact, placed)]
    for one, other in zip(*(ground.visits for ground in grounds), strict=True):
        for name in ("mark", "weight", "offset", "phase", "approach_x", "approach_y"):
            np.testing.assert_allclose(getattr(one, name), getattr(other, name), atol=1e-18)
