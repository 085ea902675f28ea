# SPDX-License-Identifier: Apache-2.0
"""The cells of an image see one plate: its strain, bending and drift are those of the placing."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from selfcal_ros.estimation.joint.solve import prepare, solve_joint
from selfcal_ros.estimation.quality import validation
from selfcal_ros.estimation.quality.validation import validate
from selfcal_ros.estimation.terms.columns import term_columns
from selfcal_ros.model.error_map import datum_modes, remove_modes
from selfcal_ros.model.terms import ModelTerm
from selfcal_ros.model.view import placings_of, with_sub_views
from selfcal_ros.simulation.cell import CellSettings, plan_events
from selfcal_ros.simulation.machine import Spread
from test.support.collecting import START_NS, collect
from test.support.options import BARE, bare
from test.support.plans import image_plan, plan_of
from test.support.truth import random_truth, simulate_measurements

PLAN = image_plan(5, repeats=2)
SETTINGS = CellSettings(sigma_xy_m=10e-9, servo_sigma_m=0.0)


def machine(seed=1, plan=PLAN, strain=0.0):
    """Return a machine whose plate is strained in each view, and what its noise is drawn from."""
    rng = np.random.default_rng(seed)
    truth = random_truth(plan.artifact, len(plan.views), rng, Spread(phi_rad=1e-3))
    scale, stretch, shear = rng.normal(0, strain, (3, len(plan.views)))
    return replace(
        truth,
        plate_strain=np.stack(
            [scale + stretch, shear, shear, scale - stretch], axis=1
        ).reshape(-1, 2, 2),
    ), rng


@cache
def measured(plan=PLAN, strain=0.0):
    """Return the readings of a machine; views are the cells of the images."""
    truth, rng = machine(plan=plan, strain=strain)
    return collect(
        plan_events(truth, plan, settings=SETTINGS, rng=rng, start_ns=START_NS)
    )[0]


def columns_of(measurements, name, size):
    problem, _ = prepare(measurements, BARE)
    inputs = replace(problem.inputs, drift_degree=2)
    return inputs, term_columns(inputs, [ModelTerm(name, size)])


def test_cells_belong_to_the_placing_of_their_view():
    assert placings_of(with_sub_views(PLAN.views)) == (0,) * 9 + (9,) * 9
    assert placings_of(plan_of("0, 90, tx", 5).views) == (0, 1, 2)


@pytest.mark.parametrize(
    ("name", "size", "count"),
    [
        ("plate_strain", 1e-6, 6),
        ("plate_strain", np.inf, 3),
        ("plate_shape", 1e-8, 12),
        ("drift", 1e-8, 8),
    ],
)
def test_a_placing_has_its_columns_in_all_cells(name, size, count):
    inputs, columns = columns_of(measured(), name, size)
    assert len(columns.columns) == count
    rows = {column.view for column in columns.columns}
    assert rows == ({0, 9} if np.isfinite(size) else {9})
    for column, block in zip(columns.columns, columns.grid, strict=True):
        there = np.abs(block).reshape(18, -1).max(axis=1) > 0
        assert there.tolist() == [
            column.view <= row < column.view + 9 for row in range(18)
        ]
        assert inputs.name_of(name, column.view) == ("0", "90")[column.view // 9]


def test_marks_of_one_image_have_one_time():
    """The first and the last exposure of the placing are its ends, not those of each cell."""
    measurements = measured()
    inputs, _ = columns_of(measurements, "drift", 1e-8)
    times = {}
    for row, visits in enumerate(inputs.visits[:9]):
        stamps = measurements.views[row].visits.stamp_ns
        for stamp, time in zip(stamps.tolist(), visits.time.tolist(), strict=True):
            assert times.setdefault(stamp, time) == time
    assert min(times.values()) == -1 and max(times.values()) == 1
    assert min(max(visits.time) for visits in inputs.visits[:9]) < 1


def test_u_holds_a_strain_that_all_cells_share():
    """Errors over u in 15 machines: six coefficients each, so that their rms scatters by 7 %."""
    term, z = ModelTerm("plate_strain", 1e-5), []
    for seed in range(15):
        truth, rng = machine(seed, strain=1e-5)
        measurements = simulate_measurements(truth, PLAN, rng, settings=SETTINGS)
        emap = solve_joint(measurements, bare(terms=(term,))).result.error_map
        error = remove_modes(
            np.stack([emap.gx, emap.gy]) - truth.g,
            datum_modes(truth.artifact, scale=True),
        )
        z.append(error / np.stack([emap.u_gx, emap.u_gy]))
    assert 0.7 < np.sqrt(np.mean(np.square(z))) < 1.3


def test_a_held_out_cell_is_predicted_with_the_terms_of_its_placing(monkeypatch):
    monkeypatch.setattr(validation, "N_DRAWS", 16)
    measurements = measured(strain=1e-5)
    found = validate(
        measurements, bare(terms=(ModelTerm("plate_strain", 1e-5),)), folds=1
    )
    assert not [item for item in found if item.exceeds]
    assert max(item.ratio for item in found if np.isfinite(item.ratio)) < 2


def test_views_without_images_are_placings_of_their_own():
    plan = replace(
        plan_of("0, 90, tx", 5, count=0),
        views=tuple(
            replace(view, repeats=2) for view in plan_of("0, 90, tx", 5, count=0).views
        ),
    )
    measurements = measured(plan)
    inputs, columns = columns_of(measurements, "plate_strain", 1e-6)
    assert [column.view for column in columns.columns] == [0] * 3 + [1] * 3 + [2] * 3
    assert inputs.members == {0: [0], 1: [1], 2: [2]}
