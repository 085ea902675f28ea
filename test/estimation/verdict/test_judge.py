# SPDX-License-Identifier: Apache-2.0
"""From which probability and which size of a field on the verdict changes its mind."""

from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.findings import AxesNotMet
from selfcal_ros.estimation.joint.solve import solve_joint
from selfcal_ros.estimation.law.solve import solve_law
from selfcal_ros.estimation.options import Options
from selfcal_ros.estimation.verdict.judge import are_looked_for, judged
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.error_map import ThetaDatum
from selfcal_ros.model.terms import ModelTerm, TermName
from selfcal_ros.simulation.truth import hu_plan, random_truth, simulate_measurements

ARCSEC_RAD = np.pi / 648_000


@pytest.fixture(scope="module")
def readings():
    plan, rng = hu_plan(Artifact(5, 0.01, 8), repeats=2), np.random.default_rng(2)
    return simulate_measurements(random_truth(plan.artifact, 4, rng), plan, rng, sigma_m=2e-8,
                                 sigma_theta_rad=2e-6, linear=True)


@pytest.mark.parametrize(("p", "holds"), [(0.04, False), (0.0499, False), (0.05, True),
                                          (0.06, True), (0.9, True)])
def test_the_axis_conditions_are_tested_at_5_percent(readings, p, holds):
    options = Options(misalignment_model="linear", causes=False)
    solved = replace(solve_joint(readings, options), axes=(p, 3 * ARCSEC_RAD))
    verdict = judged(solved, readings, options).verdict
    assert verdict.qualified == holds
    assert verdict.findings == (() if holds else (AxesNotMet(3 * ARCSEC_RAD, p),))


def test_axis_conditions_that_nobody_asked_for_hold(readings):
    assert solve_law(readings, Options(method="law")).axes == (1.0, 0.0)
    linear = Options(misalignment_model="linear")
    assert solve_joint(readings, linear).axes == (1.0, 0.0)


@pytest.mark.parametrize("terms", [(), (ModelTerm(TermName.PLATE_SCALE, 1e-9),)])
def test_axes_that_the_stage_does_not_keep_are_found_without_an_uncertainty_map(readings, terms):
    """The rotary encoder owes nothing to the axes: its map in their datum is wrong."""
    options = Options(misalignment_model="linear", datum_theta=ThetaDatum.XY_AXES, terms=terms)
    wanted, plain = (calibrate(readings, replace(options, uncertainty=uncertainty))
                     for uncertainty in (None, False))
    assert wanted.verdict.findings == plain.verdict.findings
    (found,) = plain.verdict.findings
    assert isinstance(found, AxesNotMet) and found.misclosure_rad > 30 * ARCSEC_RAD
    assert not plain.verdict.qualified
    for name in ("u_gx", "u_gy", "u_g_theta"):
        assert np.isnan(getattr(plain.error_map, name)).all()
    assert "covariance_terms" not in plain.extra


@pytest.mark.parametrize(("side", "asked", "failed", "wanted"), [
    (41, None, False, True), (43, None, False, False), (43, None, True, True),
    (43, True, False, True), (201, True, False, True), (201, None, True, True),
    (203, True, True, False), (41, False, True, False), (1, False, False, False)])
def test_causes_are_looked_for_unasked_up_to_41_and_at_all_up_to_201_marks_a_side(
        side, asked, failed, wanted):
    assert are_looked_for(side**2, Options(causes=asked), failed=failed) is wanted
    if side > 1:  # and no other number of sites lies between
        beyond = are_looked_for(side**2 + 1, Options(causes=asked), failed=failed)
        assert beyond is (wanted and (side, asked, failed) not in (
            (41, None, False), (201, True, False), (201, None, True)))
