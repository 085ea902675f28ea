# SPDX-License-Identifier: Apache-2.0
"""The angular conditions against dense least squares with constraints."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.datum import covariance as covers
from selfcal_ros.estimation.datum.covariance import conditions_for, misclosure_test
from selfcal_ros.estimation.joint.problem import fit
from selfcal_ros.estimation.joint.solve import prepare
from selfcal_ros.estimation.normal.equations import planned_system
from selfcal_ros.estimation.options import Options
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.error_map import ThetaDatum
from selfcal_ros.model.readings import Sense, subset
from test.support.lattice_plans import plan_of
from test.support.truth import Spread, random_truth, simulate_measurements

ARTIFACT = Artifact(7, 0.01, 12, 5)
PLAN = plan_of("0,90,tx", ARTIFACT, lines=1)


@pytest.mark.parametrize("sense", Sense)
def test_the_conditions_are_met_and_the_free_rotations_follow(sense):
    """With misclosure: what remains of the lines is the constrained optimum of lines and phi.

    Lines of the last view are missing. Dense oracle: stage lines, plate lines and the one free
    rotation, those of the grid views held, under the four slopes as constraints.
    """
    rng = np.random.default_rng(3)
    readings = simulate_measurements(
        random_truth(ARTIFACT, 4, rng, Spread()),
        PLAN,
        rng,
        sigma_m=1e-7,
        sigma_theta_rad=1e-5,
        sense=sense,
        linear=True,
    )
    readings = replace(
        readings,
        views=(
            *readings.views[:3],
            subset(readings.views[3], np.zeros(0, dtype=bool), np.arange(12) % 5 != 0),
        ),
    )
    problem, _ = prepare(
        readings, Options(misalignment_model="linear", datum_theta=ThetaDatum.XY_AXES)
    )
    found = fit(problem, problem.grid.y)
    conditions, system = problem.conditions, problem.system
    assert len(conditions.rows) == 4 and np.ptp(found.misclosure) > 1e-6
    phi = found.parameters[system.phi_at] / problem.half_width_m
    slopes = np.einsum("cij,ij->c", conditions.slopes.conj(), found.field).real
    assert conditions.rows @ found.g_theta == pytest.approx(slopes, abs=1e-15)

    k, n_views = 12, 4
    rows, right = [], []
    for v in range(n_views):
        for line in np.flatnonzero(problem.angular.weight[v]):
            row = np.zeros(2 * k + 1)
            row[system.angular.site[v, line]] = row[k + line] = 1
            if v == 3:
                row[-1] = 1
            rows.append(row)
            right.append(problem.angular.y[v, line] - (phi[v] if v < 3 else 0.0))
    constraint = np.hstack([conditions.rows, np.zeros((4, k + 1))])
    normal = np.array(rows).T @ rows
    kkt = np.block([[normal, constraint.T], [constraint, np.zeros((4, 4))]])
    dense = np.linalg.lstsq(
        kkt, np.concatenate([np.array(rows).T @ right, slopes]), rcond=None
    )[0]
    assert found.g_theta == pytest.approx(dense[:k], abs=1e-12)
    assert phi[3] == pytest.approx(dense[2 * k], abs=1e-12)


def test_variances_do_not_depend_on_how_many_lines_are_computed_at_once(monkeypatch):
    rng = np.random.default_rng(3)
    readings = simulate_measurements(
        random_truth(ARTIFACT, 4, rng, Spread()),
        PLAN,
        rng,
        sigma_m=1e-7,
        sigma_theta_rad=1e-5,
    )
    whole = calibrate(readings).error_map.u_g_theta
    monkeypatch.setattr(covers, "BLOCK", 5)  # of 12
    assert calibrate(readings).error_map.u_g_theta == pytest.approx(whole, rel=1e-12)


def test_zero_mean_counts_the_known_lines_alone():
    system = planned_system(ARTIFACT, PLAN.views)
    found = conditions_for(system, ThetaDatum.ZERO_MEAN, Sense.MICROSCOPE_MOVES, 0.03)
    assert found.rows == pytest.approx(np.full((1, 12), 1 / 12))
    assert (
        not found.slopes.any() and (found.gain == 1).all() and not found.phi_gain.any()
    )


def test_the_misclosure_is_tested_without_its_free_constant():
    """Independent contrasts: differences to the first, with the covariance that belongs to them."""
    rng = np.random.default_rng(1)
    root = rng.normal(size=(4, 4)) * 1e-6
    covariance, misclosure = root @ root.T, rng.normal(size=4) * 1e-6
    c = np.array([[1, -1, 0, 0], [1, 0, -1, 0], [1, 0, 0, -1.0]])
    value = c @ misclosure @ np.linalg.solve(c @ covariance @ c.T, c @ misclosure)
    p, size = misclosure_test(misclosure, covariance)
    assert p == pytest.approx(chi2.sf(value, 3), rel=1e-5)
    shifted = misclosure_test(misclosure + 5e-3, covariance)
    assert shifted == (pytest.approx(p, rel=1e-5), pytest.approx(size, rel=1e-6))
    assert misclosure_test(misclosure[:1], covariance[:1, :1]) == (1.0, 0.0)
