# SPDX-License-Identifier: Apache-2.0
"""The stage map alone is that of the whole calibration, and that of dense least squares."""

from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.errors import InputError
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.joint.map_only import MapSolver
from selfcal_ros.estimation.options import Options
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.readings import Sense
from selfcal_ros.simulation.truth import Spread, random_truth, simulate_measurements
from test.support.lattice_plans import plan_of

PLAN = plan_of("0,90,270,tx,ty", Artifact(7, 0.01, 0, 5))


def measured(seed, sense=Sense.MICROSCOPE_MOVES, plan=PLAN):
    rng = np.random.default_rng(seed)
    truth = random_truth(plan.artifact, len(plan.views), rng, Spread())
    readings = simulate_measurements(truth, plan, rng, sigma_m=1e-7, missing=0.1, sense=sense,
                                     linear=True)
    return replace(readings, views=tuple(
        replace(view, count=1 + (np.arange(len(view.m)) + i) % 5)
        for i, view in enumerate(readings.views)))


@pytest.mark.parametrize("sense", Sense)
def test_it_is_the_map_of_the_whole_calibration(sense):
    """Rectangular field, marks missing, unequal repeats, turns of both signs."""
    readings = measured(1, sense)
    wanted = calibrate(readings, Options(misalignment_model="linear")).error_map
    found = MapSolver(readings).solve(readings)
    assert np.nanmax(np.abs(wanted.gx)) > 1e-7
    assert np.allclose(found, [wanted.gx, wanted.gy], rtol=0, atol=1e-13, equal_nan=True)


def test_new_readings_of_the_same_marks():
    first = measured(1)
    rng = np.random.default_rng(9)
    views = tuple(replace(view, dx=view.dx + rng.normal(0, 1e-7, len(view.m)),
                          dy=view.dy + rng.normal(0, 1e-7, len(view.m))) for view in first.views)
    other = replace(first, views=views)
    wanted = calibrate(other, Options(misalignment_model="linear")).error_map
    found = MapSolver(first).solve(other)
    assert np.allclose(found, [wanted.gx, wanted.gy], rtol=0, atol=1e-13, equal_nan=True)
    with pytest.raises(InputError, match="not the marks of the first readings; make a new"):
        MapSolver(first).solve(measured(2))
