# SPDX-License-Identifier: Apache-2.0
"""Assumed visits of a plan, on the lattice and on a map with nodes of its own."""

from dataclasses import replace

import numpy as np

from selfcal_ros.estimation.terms.planned import Assumed, planned_inputs
from selfcal_ros.model.artifact import MapGrid
from selfcal_ros.model.visit_order import visit_sequence
from test.support.plans import plan_of


def test_visits_do_not_depend_on_the_nodes_of_the_map():
    """A map whose nodes are the sites of the lattice is another one only by its equations."""
    plan = plan_of("0, 90, 270, tx", 5)
    placed = replace(plan.artifact, map_grid=MapGrid(5, plan.artifact.grid_pitch_m))
    assumed = Assumed(order="serpentine@plate")
    grounds = [
        planned_inputs(artifact, plan.views, assumed)
        for artifact in (plan.artifact, placed)
    ]
    for one, other in zip(*(inputs.visits for inputs in grounds), strict=True):
        for name in ("mark", "weight", "offset", "phase", "approach_x", "approach_y"):
            np.testing.assert_allclose(
                getattr(one, name), getattr(other, name), atol=1e-18
            )


def test_a_check_stop_is_approached_as_its_place_beside_the_mark_tells():
    plan = plan_of("0, 90, tx", 5)
    views = [replace(view, check_marks=1, check_offset_m=2e-5) for view in plan.views]
    inputs = planned_inputs(plan.artifact, views, Assumed())
    for view, visits in zip(views, inputs.visits, strict=True):
        off = np.flatnonzero(visit_sequence(plan.artifact, view).aside_m.any(axis=0))
        # from the mark in the last corner to +x of that in the middle, then to its -x, +y and -y
        assert len(off) == 4 and (np.diff(off) == 1).all()
        assert visits.approach_x[off[1:]].tolist() == [-1, 1, 1]
        assert visits.approach_y[off[2:]].tolist() == [1, -1]
