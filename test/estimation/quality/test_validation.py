# SPDX-License-Identifier: Apache-2.0
"""Held-out readings are predicted as well as noise allows, and badly where the model is wrong."""

from dataclasses import replace
from math import pi

import numpy as np
import pytest

from selfcal_ros.errors import InputError, NotIdentifiableError
from selfcal_ros.estimation.options import Options
from selfcal_ros.estimation.quality.validation import validate, validation_json, validation_text
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.readings import Sense
from selfcal_ros.model.view import View
from selfcal_ros.simulation.truth import hu_plan, random_truth, simulate_measurements

ARTIFACT = Artifact(9, 0.01, 24)
SIGMA_M, SIGMA_RAD = 2e-8, 2e-5


def measured(*, more=True, sense=Sense.MICROSCOPE_MOVES, sigma=SIGMA_M, repeats=1):
    plan = hu_plan(ARTIFACT, repeats)
    if more:
        plan = replace(plan, views=(*plan.views, View("both", pi / 2, (0.0, 0.01), True, True,
                                                      repeats)))
    rng = np.random.default_rng(3)
    truth = random_truth(ARTIFACT, len(plan.views), rng)
    return simulate_measurements(truth, plan, rng, sense=sense, sigma_m=sigma,
                                 sigma_theta_rad=SIGMA_RAD * bool(sigma))


@pytest.mark.parametrize("sense", list(Sense))
def test_exact_readings_are_predicted_exactly(sense):
    found = {item.name: item for item in validate(measured(sense=sense, sigma=0.0), folds=1)}
    assert len(found) == 6
    for name in ("a random tenth (1)", "view 'identity'", "view 'rot90'", "view 'shift_x'",
                 "view 'both'"):
        assert found[name].n_grid > 20
        assert found[name].max_m < 1e-16 and found[name].rms_rad < 1e-13


@pytest.mark.parametrize("repeats", [1, 4])
def test_noise_is_predicted_within_noise_and_leverage(repeats):
    found = validate(measured(repeats=repeats), folds=5)
    for item in found:
        if item.n_grid:
            # deletion residuals have sigma / sqrt(1 - h), h about 2/3 and below
            assert 1.0 < item.ratio < 2.3
            assert item.rms_m == pytest.approx(item.ratio * SIGMA_M / np.sqrt(repeats), rel=0.15)
    assert sum(item.n_grid > 0 for item in found) >= 8


def test_a_spoiled_view_is_predicted_badly():
    readings = measured()
    right = {item.name: item for item in validate(readings, folds=1)}
    view = readings.views[4]
    swapped = replace(view, dx=view.dy, dy=view.dx)
    wrong = {item.name: item for item in validate(
        replace(readings, views=(*readings.views[:4], swapped)), folds=1)}
    for name in ("a random tenth (1)", "view 'both'"):
        assert wrong[name].rms_m > 3 * right[name].rms_m
    with pytest.raises(NotIdentifiableError):
        validate(replace(readings, views=readings.views[:2]))


def test_views_that_are_needed_cannot_be_held_out():
    notes = {item.name: item.note for item in validate(measured(more=False), folds=1)}
    assert notes["a random tenth (1)"] == ""
    for name in ("identity", "rot90", "line", "shift_x"):
        assert "does not identify the stage" in notes[f"view '{name}'"]


def test_seeds_and_folds():
    readings = measured()
    assert validate(readings, folds=1) == validate(readings, folds=1)
    assert validate(readings, folds=1)[0] != validate(readings, folds=1, seed=1)[0]
    tenths = [item for item in validate(readings, folds=10) if "tenth" in item.name]
    assert sum(item.n_grid for item in tenths) <= sum(len(v.m) for v in readings.views)
    for folds in (0, 11):
        with pytest.raises(InputError, match="number from 1 to 10"):
            validate(readings, folds=folds)


def test_text_and_json():
    found = validate(measured(), Options(datum_theta="zero_mean"), folds=1)
    text = validation_text(found)
    assert "marks predicted within" in text[0] and "arcsec rms" in text[0]
    assert len(validation_json(found)) == len(text) == 6
    assert validation_json(found)[0]["rms_m"] == found[0].rms_m
