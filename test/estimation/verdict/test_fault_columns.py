# SPDX-License-Identifier: Apache-2.0
"""Columns of a slip: what moves, from which visit on, in which frame."""

import numpy as np
import pytest

from selfcal_ros.estimation.lattice.readings import grid_data
from selfcal_ros.estimation.terms.columns import ColumnBuilder
from selfcal_ros.estimation.terms.visits import term_inputs
from selfcal_ros.estimation.verdict.causes import slip_columns
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.simulation.cell import CellSettings
from test.support.lattice_plans import plan_of
from test.support.truth import random_truth, simulate_measurements


@pytest.fixture(scope="module")
def inputs():
    """Return the inputs of two views of 7 x 7 marks, the second turned by 90 deg."""
    plan, rng = plan_of("0,90,tx", Artifact(7, 0.01)), np.random.default_rng(4)
    readings = simulate_measurements(
        random_truth(plan.artifact, 3, rng),
        plan,
        rng,
        settings=CellSettings(),
        visits=True,
    )
    return term_inputs(readings, grid_data(readings))


@pytest.mark.parametrize("view", [0, 1])
def test_twelve_instants_divide_the_visits_of_a_view_evenly(inputs, view):
    made = ColumnBuilder(inputs)
    rows = {part: at for at, number, part in slip_columns(made) if number == view}
    parts = list(rows)
    assert parts == pytest.approx([k / 13 for k in range(1, 13)], abs=1e-15)
    time, mark = inputs.visits[view].time, inputs.visits[view].mark
    unit = (1, -1j)[view]  # a stage axis in the frame of a plate turned by 90 deg
    for part in parts:
        x, y, phi = (
            made.unit[at] * made.at[made.of_column[at]][view] for at in rows[part]
        )
        after = time >= np.sort(time)[round(49 * part)]
        assert np.array_equal(x, unit * after) and np.array_equal(y, 1j * unit * after)
        assert np.array_equal(phi, 1j * inputs.z.ravel()[mark] * after)


def test_each_column_moves_its_own_view_alone(inputs):
    building = ColumnBuilder(inputs)
    found = list(slip_columns(building))
    made = building.build()
    for mine, view, _ in found:
        assert [made.columns[at].component for at in mine] == ["x", "y", "phi"]
        for at in mine:
            assert np.flatnonzero(np.abs(made.grid[at]).max(axis=(1, 2))).tolist() == [
                view
            ]
            assert made.columns[at].view == view
