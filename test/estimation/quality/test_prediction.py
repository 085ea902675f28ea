# SPDX-License-Identifier: Apache-2.0
"""The draws behind the limit of a held-out part: their noise, and how it is predicted."""

from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.estimation.joint.model_fit import ModelFit
from selfcal_ros.estimation.lattice.readings import GridData, grid_data
from selfcal_ros.estimation.normal.equations import noise_of
from selfcal_ros.estimation.quality import validation
from selfcal_ros.estimation.quality.validation import HeldReadings, PredictionLimit
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.readings import Measurements
from selfcal_ros.model.terms import ModelTerm
from test.support.lattice_plans import plan_of
from test.support.options import bare
from test.support.truth import random_truth, simulate_measurements

UNIT_M = 1e-10
"""What a unit of noise is in readings: what is of second order in it is a millionth here."""


def test_the_noise_that_is_drawn_is_that_of_the_weights_on_either_axis():
    weight = np.array([[0.0, 0.04, 0.25], [1.0, 4.0, 9.0]])
    found = noise_of(np.random.default_rng(3), (20_000, 2, 3), weight)
    expected = np.array([[0.0, 5.0, 2.0], [1.0, 0.5, 1 / 3]])
    for part in (found.real, found.imag):
        assert np.std(part, axis=0) == pytest.approx(expected, rel=0.02)  # 4 sigma
    # the axes are independent: real and imaginary part of the mean square are noise
    assert (np.abs((found**2).mean(axis=0)) <= 0.05 * expected**2).all()


def with_visits(readings: Measurements, rng: np.random.Generator) -> Measurements:
    """Return the readings, one visit a mark, with offsets and instants of their own."""
    views = []
    for view in readings.views:
        n = len(view.visits.mark)
        offset = rng.normal(0, 3e-5, n) + 1j * rng.normal(0, 3e-5, n)
        visits = replace(
            view.visits,
            offset_x=offset.real,
            offset_y=offset.imag,
            stamp_ns=rng.permutation(n) * 10**9,
        )
        views.append(replace(view, visits=visits))
    return replace(readings, views=tuple(views))


def with_values(
    readings: Measurements, values: np.ndarray, grid: GridData
) -> Measurements:
    """Return the readings with `values` (views, nx, ny) of the plate frame in place of theirs."""
    views = []
    for row, view in enumerate(readings.views):
        half = readings.artifact.half
        value = (
            values[row][view.m + half[0], view.n + half[1]] * 1j ** grid.poses[row].q
        )
        visits = replace(
            view.visits,
            dx=value.real[view.visits.mark],
            dy=value.imag[view.visits.mark],
        )
        views.append(replace(view, dx=value.real, dy=value.imag, visits=visits))
    return replace(readings, views=tuple(views))


@pytest.mark.parametrize("of_view", [False, True])
def test_each_draw_is_predicted_as_such_readings_are(monkeypatch, of_view):
    """The same noise, given as readings to the estimate: the same mean square of predictions.

    Terms are free and each mark is visited once, so that no other draw has a part in it. A drift
    is of each view, a turned microscope common to all; only with that can a view be held out.
    """
    monkeypatch.setattr(validation, "N_DRAWS", 4)
    plan = plan_of("0,90,180,tx,ty", Artifact(5, 0.01))
    rng = np.random.default_rng(8)
    readings = with_visits(
        simulate_measurements(
            random_truth(plan.artifact, len(plan.views), rng),
            plan,
            rng,
            linear=True,
            sigma_m=UNIT_M,
            visits=True,
        ),
        rng,
    )
    terms = [ModelTerm("microscope"), *[ModelTerm("drift")] * of_view]
    options = bare(
        misalignment_model="linear", terms=tuple(terms), drift_degree=1, at_places=False
    )
    seen, limit_of = [], validation.prediction_limit

    def judged(
        model: ModelFit, held: HeldReadings, known: np.ndarray, weight: np.ndarray
    ) -> PredictionLimit:
        limit = limit_of(model, held, known, weight)
        seen.append((model, held, known, weight, limit))
        return limit

    monkeypatch.setattr(validation, "prediction_limit", judged)
    first = validation.validate(readings, options, folds=1)
    number = 0 if of_view else 1  # a random tenth of all views, or a whole view
    model, held, known, weight, limit = seen[number]
    assert known.sum() == first[number].n_grid > 10
    size, fit = len(model.equations.columns.columns), model.problem.system.grid
    draws = np.random.default_rng(0)
    noise = noise_of(draws, (4, *fit.weight.shape), fit.weight)
    # of visits within marks, of the position and of sizes: not used here
    draws.standard_normal((3, size, 4))
    own = noise_of(draws, (4, *weight.shape), weight)
    everywhere = grid_data(readings)
    squares = []
    for fitted, alone in zip(noise, own, strict=True):
        values = np.zeros(everywhere.y.shape, dtype=complex)
        values[list(model.problem.grid.index)] = fitted
        values[list(held.grid.index)] += alone  # a reading is either fitted or held out
        again = with_values(readings, UNIT_M * values, everywhere)
        found = validation.validate(again, options, folds=1)
        squares.append((found[number].rms_m / UNIT_M) ** 2)
    assert limit.mean == pytest.approx(np.mean(squares), rel=1e-4)
    assert limit.dof == pytest.approx(
        2 * np.mean(squares) ** 2 / np.var(squares, ddof=1), rel=1e-4
    )
