# SPDX-License-Identifier: Apache-2.0
"""Effects that readings do not determine: when they are assumed, and that U then holds them."""

from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.comparison.covariance import covariance_of
from selfcal_ros.estimation.options import Options
from selfcal_ros.estimation.terms.planned import Assumed
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.error_map import datum_modes, remove_modes, rms
from selfcal_ros.model.readings import Sense
from selfcal_ros.model.terms import ModelTerm, parse_terms
from selfcal_ros.simulation.cell import CellSettings
from test.support.dense_terms import SIGMA, Dense
from test.support.options import BARE
from test.support.plans import plan_of
from test.support.truth import Spread, hu_plan, random_truth, simulate_measurements

PLATE = Artifact(9, 0.01, 24)
DRIFT = ModelTerm("drift", 25e-9)


def measured(
    seed=1,
    *,
    visits=True,
    consecutive=False,
    repeats=4,
    drift_m=0.0,
    alike=True,
    noise_m=20e-9,
    sense=Sense.MICROSCOPE_MOVES,
    plate=PLATE,
):
    """Return readings of Hu's views, which drift, as a rule all alike, and the truth."""
    rng = np.random.default_rng(seed)
    # from -drift to +drift in a view
    spread = Spread(phi_rad=5e-4, drift_linear_m=2 * drift_m)
    if not alike:
        spread = replace(
            spread, drift_quadratic_m=2 * drift_m, drift_cubic_m=2 * drift_m
        )
    truth = random_truth(plate, 4, rng, spread)
    if alike:
        first = truth.drift_m[:1]
        truth = replace(truth, drift_m=first.repeat(len(truth.drift_m), axis=0))
    plan = hu_plan(plate, repeats)
    plan = replace(
        plan,
        views=tuple(
            replace(
                view, visit_order="x_back_y_back" if view.grid and repeats == 4 else ""
            )
            for view in plan.views
        ),
    )
    how = CellSettings(
        sense, sigma_xy_m=noise_m, sigma_theta_rad=2e-5, consecutive=consecutive
    )
    return simulate_measurements(
        truth,
        plan,
        rng,
        sigma_m=noise_m,
        sigma_theta_rad=2e-5,
        visits=visits,
        settings=how if visits else None,
    ), truth


def u_of(result):
    return np.stack([result.error_map.u_gx, result.error_map.u_gy])


def lines(result):
    return {
        line.component.removeprefix("term "): line
        for line in result.budget
        if line.quantity == "xy"
    }


@pytest.mark.parametrize("sense", Sense)
def test_a_drift_that_the_order_hides_is_assumed(sense):
    """It is a term of the model, as if it were declared."""
    readings, _ = measured(consecutive=True, sense=sense)
    result = calibrate(readings, Options())
    line = lines(result)["drift"]
    assert (line.component, line.source) == ("term drift", "default")
    assert 0.5 * DRIFT.size < line.u <= DRIFT.size
    declared = calibrate(readings, Options(terms=(DRIFT,)))
    np.testing.assert_allclose(u_of(result), u_of(declared), rtol=1e-6)
    np.testing.assert_allclose(
        result.error_map.gx, declared.error_map.gx, rtol=0, atol=1e-13
    )
    none = calibrate(readings, Options(terms=(replace(DRIFT, size=0.0),)))
    assert rms(u_of(result)) > 1.05 * rms(u_of(none))
    assert "drift" not in lines(none) and result.verdict.causes == ()


def test_drifts_as_large_as_is_assumed_are_no_strain_of_the_plate():
    """Where each view drifts by itself in one pass; 7 of 24 were not qualified."""
    for seed in (0, 1, 2, 12):
        readings, truth = measured(seed, repeats=1, drift_m=DRIFT.size, alike=False)
        result = calibrate(readings, Options())
        assert result.verdict.grade == "good"
        error = remove_modes(
            np.stack([result.error_map.gx, result.error_map.gy]) - truth.g,
            datum_modes(PLATE, scale=True),
        )
        assert np.mean(np.abs(error) < 2 * u_of(result)) > 0.85


@pytest.mark.parametrize(("size", "in_model"), [(5, False), (6, True)])
def test_few_marks_leave_a_drift_in_u_alone(size, in_model):
    """Its coefficients would leave 5 x 5 marks too few degrees of freedom for their noise."""
    readings, _ = measured(repeats=1, plate=Artifact(size, 0.01, 24))
    result = calibrate(readings, Options())
    assert ("drift" in {term.name for term in result.model.terms}) is in_model
    assert lines(result)["drift"].effect_rms > 5e-9


def test_its_nodes_are_correlated_as_by_the_declared_term():
    readings, _ = measured(consecutive=True)
    one, other = (
        covariance_of(result, "xy", result.error_map.valid)
        for result in (
            calibrate(readings, Options()),
            calibrate(readings, Options(terms=(DRIFT,))),
        )
    )
    np.testing.assert_allclose(one, other, atol=0.05 * np.abs(other).max())


def test_a_drift_that_the_readings_determine_is_not():
    result = calibrate(measured()[0], Options())
    assert not {"drift", "approach"} & lines(result).keys()


@pytest.mark.parametrize(
    "options", [BARE, Options(misalignment_model="linear"), Options(uncertainty=False)]
)
def test_nothing_is_assumed_where_nothing_is_to_be_or_no_uncertainty_is_asked_for(
    options,
):
    assert not {"drift", "approach"} & {
        *lines(calibrate(measured(consecutive=True)[0], options))
    }


def test_without_visits_no_drift_can_be_weighed():
    readings, _ = measured(consecutive=True, visits=False)
    assert "drift" not in lines(calibrate(readings, Options()))


def test_a_drift_of_the_assumed_size_lies_in_u():
    """One pass a view: without the assumption errors are larger than u, with it they are u."""
    ratios = {}
    for seed in range(8):
        readings, truth = measured(seed, repeats=1, drift_m=DRIFT.size, noise_m=5e-9)
        for size in (DRIFT.size, 0.0):
            result = calibrate(
                readings,
                Options(assumed=(), causes=False, terms=(replace(DRIFT, size=size),)),
            )
            error = np.stack([result.error_map.gx, result.error_map.gy]) - truth.g
            error = remove_modes(error, datum_modes(PLATE, scale=True))
            ratios.setdefault(size, []).append((error / u_of(result)).ravel())
    with_it, without = (np.sqrt(np.mean(np.square(found))) for found in ratios.values())
    assert with_it < 1.1 < without


@pytest.mark.parametrize("sense", Sense)
def test_the_plate_has_its_share_of_a_drift_that_one_pass_hides(sense):
    """Its u is that of one dense least squares of all visits with the drift in its size."""
    readings, _ = measured(repeats=1, sense=sense)
    none = (
        *parse_terms(
            [
                "microscope:0",
                "plate_strain:0",
                "approach:0",
                "rotation:0",
                "line_eccentricity:0",
            ],
            "test",
        ),
        ModelTerm("plate_shape", 5e-9),
    )
    hidden, without = (
        calibrate(readings, Options(terms=(*none, *drift)))
        for drift in ((), (replace(DRIFT, size=0.0),))
    )
    dense = Dense(plan_of("0, 90, tx", 9), Assumed(SIGMA, order="serpentine"), sense)
    # against the noise of `Dense`
    sized = [
        replace(term, size=term.size * SIGMA / hidden.noise.sigma_xy)
        for term in (none[-1], DRIFT)
    ]
    stage, of_plate = np.split(dense.solver(sized)[0][: 4 * PLATE.m.size], 2)
    z = (PLATE.m + 1j * PLATE.n).ravel()
    modes = np.stack([np.ones(z.shape), 1j * np.ones(z.shape), 1j * z])
    modes = np.stack([modes.real, modes.imag], axis=-1).reshape(3, -1).T
    basis = np.linalg.qr(modes)[0]
    of_plate = of_plate - basis @ (basis.T @ of_plate)
    scale = np.stack([z.real, z.imag], axis=-1).ravel()
    # what the datum takes off the stage as its scale, the plate has
    of_plate = of_plate + np.outer(scale, scale @ stage / (scale @ scale))
    wanted = hidden.noise.sigma_xy * np.sqrt((of_plate**2).sum(axis=1)).reshape(
        *PLATE.m.shape, 2
    )
    found, less = (
        np.stack([each.artifact_map.u_ax, each.artifact_map.u_ay], axis=-1)
        for each in (hidden, without)
    )
    np.testing.assert_allclose(found, wanted, rtol=0.03)
    assert rms(less) < 0.95 * rms(found)
