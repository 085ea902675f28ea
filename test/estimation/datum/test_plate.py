# SPDX-License-Identifier: Apache-2.0
"""The uncertainty of the plate's map, against what each single reading does to the map."""

from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.estimation.api import calibrate
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.error_map import ThetaDatum
from selfcal_ros.model.readings import Sense
from selfcal_ros.model.reference import ReferenceKind
from selfcal_ros.simulation.machine import Spread, random_truth
from test.support.lattice_plans import plan_of
from test.support.options import bare, reference_length
from test.support.truth import simulate_measurements

STEP_M = 1e-7


def linear(**how):
    return bare(misalignment_model="linear", causes=False, **how)


def readings(sense=Sense.MICROSCOPE_MOVES, size=3, lines=0):
    plan = plan_of(
        "0,90,tx,ty", Artifact(size, 0.01, lines), lines=1 if lines else None
    )
    rng = np.random.default_rng(1)
    plan = replace(
        plan,
        views=tuple(replace(view, repeats=2 + i) for i, view in enumerate(plan.views)),
    )
    truth = random_truth(plan.artifact, len(plan.views), rng, Spread(rotation="linear"))
    return simulate_measurements(
        truth, plan, rng, linear=True, sense=sense, sigma_m=1e-8, sigma_theta_rad=1e-6
    )


def plate_of(measurements, options):
    plate = calibrate(measurements, replace(options, uncertainty=False)).artifact_map
    return np.stack([plate.ax, plate.ay])


@pytest.mark.parametrize("sense", Sense)
@pytest.mark.parametrize("kind", [None, *ReferenceKind])
def test_each_reading_adds_what_it_does_to_the_plate(kind, sense):
    whole, u_scale = readings(sense), 0.0 if kind is None else 2e-6
    options = linear(
        reference=None if kind is None else reference_length(kind, 0.0, u_scale)
    )
    result, centre = calibrate(whole, options), plate_of(whole, options)
    power = (u_scale * np.stack([whole.artifact.x_m, whole.artifact.y_m])) ** 2
    for index, view in enumerate(whole.views):
        for name in ("dx", "dy"):
            for at, count in enumerate(view.count):
                changed = getattr(view, name) + STEP_M * (np.arange(len(view.m)) == at)
                views = list(whole.views)
                views[index] = replace(view, **{name: changed})
                moved = plate_of(replace(whole, views=tuple(views)), options) - centre
                power += (moved / STEP_M * result.noise.sigma_xy) ** 2 / count
    found = np.stack([result.artifact_map.u_ax, result.artifact_map.u_ay])
    np.testing.assert_allclose(found, np.sqrt(power), rtol=1e-5)


@pytest.mark.parametrize("sense", Sense)
def test_each_reading_adds_what_it_does_to_the_lines_of_the_plate(sense):
    """With declared noise, more than residuals show: then no weight changes."""
    whole, options, power = readings(sense, lines=8), linear(), 0.0
    whole = replace(
        whole,
        views=tuple(
            replace(
                view,
                u=1.5e-8 / np.sqrt(view.count),
                u_theta=1.5e-6 / np.sqrt(view.count_theta),
            )
            for view in whole.views
        ),
    )
    least = replace(options, uncertainty=False)
    centre = calibrate(whole, least).artifact_map.a_theta
    for index, view in enumerate(whole.views):
        for name, each in (("dx", view.u), ("dy", view.u), ("dtheta", view.u_theta)):
            for at, u in enumerate(each):
                views = list(whole.views)
                views[index] = replace(
                    view,
                    **{
                        name: getattr(view, name)
                        + u / 10 * (np.arange(len(each)) == at)
                    },
                )
                moved = calibrate(
                    replace(whole, views=tuple(views)), least
                ).artifact_map.a_theta
                power = power + (10 * (moved - centre)) ** 2
    result = calibrate(whole, options)
    np.testing.assert_allclose(result.artifact_map.u_a_theta, np.sqrt(power), rtol=1e-5)


def test_without_an_uncertainty_or_with_tied_axes_there_is_none():
    found = calibrate(readings(size=5, lines=8), linear(uncertainty=False)).artifact_map
    assert np.isnan(found.u_ax).all() and np.isnan(found.u_a_theta).all()
    tied = calibrate(
        readings(size=5, lines=8), linear(datum_theta=ThetaDatum.XY_AXES)
    ).artifact_map
    assert np.isfinite(tied.u_ay).all() and np.isnan(tied.u_a_theta).all()
