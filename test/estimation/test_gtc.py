# SPDX-License-Identifier: Apache-2.0
"""Budgets, effective degrees of freedom and references against the GUM Tree Calculator (GTC)."""

from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.comparison.combine import RunValues, mean_of
from selfcal_ros.estimation.joint.problem import coverage_factor
from selfcal_ros.estimation.verdict.uncertainty import budgets
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.reference import ReferenceLength
from test.support.options import bare
from test.support.truth import hu_plan, random_truth, simulate_measurements

gtc = pytest.importorskip("GTC")


@pytest.mark.parametrize("u_scale", [1e-7, 1e-6, 1e-5])
def test_the_budget_of_a_map_has_u_dof_and_k_of_gtc(u_scale):
    artifact, rng = Artifact(5, 0.01, 8), np.random.default_rng(1)
    readings = simulate_measurements(
        random_truth(artifact, 4, rng),
        hu_plan(artifact, 2),
        rng,
        sigma_m=2e-8,
        sigma_theta_rad=2e-5,
    )
    for budget in budgets(
        calibrate(
            readings,
            bare(causes=False, reference=ReferenceLength("artifact", 0.0, u_scale)),
        )
    ):
        total = sum(
            gtc.ureal(0, line.effect_rms, line.dof)
            for line in budget.lines
            if line.effect_rms > 0
        )
        assert budget.u_rms == pytest.approx(gtc.uncertainty(total), rel=1e-12)
        assert budget.dof == pytest.approx(gtc.dof(total), rel=0.02)
        assert budget.k == pytest.approx(
            gtc.rp.k_factor(gtc.dof(total), 95.45), rel=2e-3
        )


@pytest.mark.parametrize(
    ("u", "dof"),
    [((2.0, 1.0), (5.0, 8.0)), ((1.0, 1.0), (3.0, np.inf)), ((0.3, 4.0), (60.0, 2.5))],
)
def test_the_deviation_of_a_run_has_the_dof_of_gtc(u, dof):
    runs = [
        RunValues(
            np.array([9.0 * (i == 0), 0, 0, 0]),
            one**2 * np.eye(4),
            np.zeros((4, 4)),
            True,
            many,
        )
        for i, (one, many) in enumerate(zip(u, dof, strict=True))
    ]
    e_n = mean_of(runs, np.zeros((4, 0)), np.zeros((4, 0))).deviations[0].e_n[0]
    difference = gtc.ureal(9.0, u[0], dof[0]) - gtc.ureal(0.0, u[1], dof[1])
    assert e_n == pytest.approx(
        9.0 / (coverage_factor(gtc.dof(difference)) * gtc.uncertainty(difference)),
        rel=1e-6,
    )


@pytest.mark.parametrize("warmer", [-3.0, 0.0, 0.4])
def test_a_length_at_another_temperature_has_the_u_of_gtc(warmer):
    reference = ReferenceLength("artifact", 1.2e-6, 2e-7)
    moved = reference.at_temperature(f"{20 + warmer}:0.05:8e-6:4e-7")
    error, alpha = gtc.ureal(1.2e-6, 2e-7), gtc.ureal(8e-6, 4e-7)
    found = error + alpha * (gtc.ureal(20 + warmer, 0.05) - 20)
    assert moved.relative_error == pytest.approx(gtc.value(found), rel=1e-12)
    assert moved.u_relative == pytest.approx(gtc.uncertainty(found), rel=1e-9)
    axis = replace(reference, kind="stage_x").at_temperature(
        f"{20 + warmer}:0.05:8e-6:4e-7"
    )
    assert axis.relative_error == pytest.approx(
        gtc.value(error - (found - error)), rel=1e-9
    )


def test_the_distance_of_two_marks_has_the_u_of_gtc():
    """Scale of a map by marks that were read once, u of each coordinate of a mark 5 nm."""
    length, nominal = gtc.ureal(0.04000004, 8e-9), 0.04
    reference = ReferenceLength.between("-2,0:2,0:0.04000004:8e-9", Artifact(5, 0.01))
    found = (length - nominal) / nominal
    assert reference.relative_error == pytest.approx(gtc.value(found), rel=1e-12)
    assert reference.u_relative == pytest.approx(gtc.uncertainty(found), rel=1e-12)
