# SPDX-License-Identifier: Apache-2.0
"""Effects that U does not contain: what they would add to it, when they are stated, and how."""

from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.options import Options
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.result import result_from_dict, result_to_dict
from selfcal_ros.model.terms import ModelTerm
from selfcal_ros.reporting.summary.sections import error_section
from selfcal_ros.reporting.words.findings import worded
from selfcal_ros.simulation.cell import CellSettings
from test.support.options import BARE, bare
from test.support.truth import Spread, hu_plan, random_truth, simulate_measurements

PLATE = Artifact(9, 0.01, 24)
SIZE_M = 10e-9


def measured(seed=1, *, visits=True, consecutive=False):
    """Return readings of Hu's views."""
    rng = np.random.default_rng(seed)
    truth = random_truth(PLATE, 4, rng, Spread(phi_rad=5e-4))
    plan = hu_plan(PLATE, 4)
    plan = replace(plan, views=tuple(replace(v, visit_order="x_back_y_back" if v.grid else "")
                                     for v in plan.views))
    how = CellSettings(sigma_xy_m=20e-9, sigma_theta_rad=2e-5, consecutive=consecutive)
    return simulate_measurements(truth, plan, rng, sigma_m=20e-9, sigma_theta_rad=2e-5,
                                 visits=visits, settings=how if visits else None)


def excluded(readings, options=BARE):
    return {line.component.removeprefix("term "): line
            for line in calibrate(readings, options).excluded}


def errors_of(result):
    emap = result.error_map
    return np.stack([emap.gx, emap.gy])


def test_the_effect_is_what_the_declared_term_adds_to_u():
    readings = measured(consecutive=True)
    line = excluded(readings)["drift"]
    without, declared = (calibrate(readings, options).error_map for options in (
        BARE, bare(terms=(ModelTerm("drift", SIZE_M),))))
    more = (np.stack([declared.u_gx, declared.u_gy]) ** 2
            - np.stack([without.u_gx, without.u_gy]) ** 2)
    assert line.u == SIZE_M and line.unit == "m" and line.source == "excluded"
    assert line.effect_rms == pytest.approx(np.sqrt(more.mean()), rel=0.03)
    assert line.effect_max == pytest.approx(np.sqrt(more.max()), rel=0.03)


def test_an_order_that_hides_a_drift_is_stated():
    passes, consecutive = excluded(measured()), excluded(measured(consecutive=True))
    assert not passes and "drift" in consecutive
    assert consecutive["drift"].effect_rms > 5e-9


@pytest.mark.parametrize("size", [0.0, 30e-9])
def test_what_is_declared_is_not_excluded(size):
    term = ModelTerm("drift", size)
    assert "drift" not in excluded(measured(consecutive=True), bare(terms=(term,)))


def test_without_visits_nothing_can_be_stated():
    assert not excluded(measured(consecutive=True, visits=False))


def test_nothing_is_stated_without_an_uncertainty():
    assert not excluded(measured(), replace(BARE, uncertainty=False))
    assert not excluded(measured(), replace(BARE, causes=False))


def test_effects_of_default_terms_are_lines_of_the_budget_instead():
    result = calibrate(measured(), Options())
    components = {line.component for line in result.budget}
    assert not components & {line.component for line in result.excluded}


def test_the_result_keeps_them_and_the_summary_states_them():
    result = worded(calibrate(measured(consecutive=True), BARE))
    line = result.excluded[0]
    read, *_ = result_from_dict(result_to_dict(result), "r").excluded
    assert replace(read, value=0.0) == replace(line, value=0.0)
    shown = dict(error_section(result).facts)["not in U"]
    assert shown.startswith("drift during each view: 0.01 µm would add u ")
    assert "(declare it: --model drift:SIZE)" in shown
    old = {key: value for key, value in result_to_dict(result).items() if key != "excluded"}
    assert result_from_dict(old, "r").excluded == ()
