# SPDX-License-Identifier: Apache-2.0
"""Two maps of one stage differ as often as they should, and one bad node is found."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom, chi2, norm
from scipy.stats import f as f_distribution
from scipy.stats import t as student_t

from selfcal_ros.estimation.comparison.maps import (
    USUAL_LEVEL,
    ReducedNoise,
    _of_largest,
    compare,
    significance,
)
from selfcal_ros.estimation.joint.solve import solve_joint
from selfcal_ros.estimation.options import Options
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.result import result_from_dict, result_to_dict
from selfcal_ros.reporting.words.findings import worded
from test.support.lattice_plans import plan_of
from test.support.truth import random_truth, simulate_measurements

NOTHING = np.zeros((3, 0))
KNOWN = float("inf")


def test_the_distance_of_correlated_values_is_that_of_independent_ones_in_other_coordinates():
    """Values made from independent ones by a matrix: its inverse gives the distance."""
    rng = np.random.default_rng(1)
    mixing, unit = rng.normal(size=(3, 3)), np.array([1.0, -2.0, 0.5])
    cover = mixing @ mixing.T
    found = significance(mixing @ unit, ReducedNoise(cover, NOTHING, KNOWN))
    assert found.dof == 3 and found.correlated
    assert found.chi2_ratio == pytest.approx((unit @ unit) / 3)
    assert found.p == pytest.approx(chi2.sf(unit @ unit, 3))
    few = significance(mixing @ unit, ReducedNoise(cover, NOTHING, 7.0))
    assert few.p == pytest.approx(f_distribution.sf((unit @ unit) / 3, 3, 7))


def test_what_the_datum_takes_out_does_not_count():
    """Of three equal variances about their mean two degrees of freedom are left, each 2/3."""
    values = np.array([1.0, 1.0, -2.0])
    found = significance(values, ReducedNoise(np.eye(3), np.ones((3, 1)), KNOWN))
    assert found.dof == 2 and found.chi2_ratio == pytest.approx(3.0)
    assert found.largest_z == pytest.approx(2 / np.sqrt(2 / 3))


@pytest.mark.parametrize("k", [1, 2, 5])
def test_every_column_that_was_taken_out_costs_a_degree_of_freedom(k):
    """Of 12 unequal correlated values; the distance is that of 12 - k independent contrasts."""
    rng = np.random.default_rng(k)
    root, removed = rng.normal(size=(12, 12)), rng.normal(size=(12, k))
    contrasts = np.linalg.svd(removed)[0][:, k:].T
    values = contrasts.T @ rng.normal(size=12 - k)
    found = significance(values, ReducedNoise(root @ root.T, removed, KNOWN))
    own = contrasts @ values
    square = own @ np.linalg.solve(contrasts @ root @ root.T @ contrasts.T, own)
    assert found.dof == 12 - k
    assert found.chi2_ratio == pytest.approx(square / (12 - k), rel=1e-6)
    assert found.p == pytest.approx(chi2.sf(square, 12 - k), rel=1e-6)


def test_the_largest_of_independent_values_has_its_own_distribution():
    z, n = 3.0, 50
    values = np.zeros(n)
    values[7] = -z
    exact = 1 - (1 - 2 * norm.sf(z)) ** n
    for cover in (np.eye(n), np.ones(n)):
        found = significance(values, ReducedNoise(cover, np.zeros((n, 0)), KNOWN))
        assert found.largest_z == pytest.approx(z)
        assert found.p_z == pytest.approx(exact, rel=0.15)
        p = (1 - (1 - USUAL_LEVEL / 2) ** (1 / n)) / 2
        assert found.z_limit == pytest.approx(norm.isf(p), rel=0.05)
        assert not found.significant
    values[7] = -6
    found = significance(values, ReducedNoise(np.eye(n), np.zeros((n, 0)), KNOWN))
    assert found.p_z == pytest.approx(2 * n * norm.sf(6)) and found.significant


def test_values_that_move_together_count_once():
    n = 40
    cover = np.ones((n, n)) + 1e-12 * np.eye(n)
    found = significance(np.full(n, 2.0), ReducedNoise(cover, np.zeros((n, 0)), KNOWN))
    assert found.p_z == pytest.approx(2 * norm.sf(2.0), abs=0.015)
    assert found.z_limit == pytest.approx(norm.isf(USUAL_LEVEL / 4), rel=0.12)


PLAIN = Options(datum_theta="zero_mean", misalignment_model="linear")
PLAN = plan_of("0,90,180,tx,ty", Artifact(5, 0.01))


def pair_of(seed, *, missing=0.0):
    rng = np.random.default_rng(seed)
    truth = random_truth(PLAN.artifact, len(PLAN.views), rng)
    return [
        solve_joint(
            simulate_measurements(
                truth, PLAN, rng, sigma_m=2e-8, missing=missing, linear=True
            ),
            PLAIN,
        ).result
        for _ in range(2)
    ]


def test_missing_marks_do_not_make_maps_differ():
    """With correlations of full views one in eight pairs differed at the level of one in twenty."""
    found = [compare(*pair_of(seed, missing=0.2)) for seed in range(40)]
    for p in ([item.xy.p for item in found], [item.xy.p_z for item in found]):
        assert sum(value < 0.05 for value in p) <= binom.ppf(0.999, len(found), 0.05)
        assert sum(value < 0.5 for value in p) >= binom.ppf(0.001, len(found), 0.5)
    assert all(item.xy.correlated for item in found)
    significant = sum(bool(item.significant) for item in found)
    assert significant <= binom.ppf(0.999, len(found), USUAL_LEVEL)


def test_one_node_that_moved_is_found():
    caught = 0
    for seed in range(20):
        a, b = pair_of(1000 + seed)
        emap = b.error_map
        moved = emap.gx.copy()
        at = tuple(np.random.default_rng(seed).integers(0, 5, 2))
        moved[at] += 8 * emap.u_gx[at]
        found = compare(a, replace(b, error_map=replace(emap, gx=moved)))
        caught += found.significant
        if found.xy.p_z < USUAL_LEVEL / 2:
            z = abs(np.stack([found.dx, found.dy]))
            assert found.xy.largest_z > found.xy.z_limit and z.max() == found.max_m
    assert caught >= 18


def test_the_comparison_is_the_same_after_the_file():
    a, b = pair_of(5, missing=0.2)
    again = [
        result_from_dict(json.loads(json.dumps(result_to_dict(worded(r)))), "r")
        for r in (a, b)
    ]
    one, two = compare(a, b), compare(*again)
    assert two.xy.chi2_ratio == pytest.approx(one.xy.chi2_ratio, rel=1e-9)
    assert (two.xy.dof, two.xy.noise_dof) == (one.xy.dof, one.xy.noise_dof)
    assert two.xy.p_z == pytest.approx(one.xy.p_z, rel=1e-6)


@pytest.mark.parametrize("noise_dof", [np.inf, 12.0])
def test_nodes_that_move_together_are_as_one(noise_dof):
    """Of ten equal values the largest is Student's or normal itself, not one of ten."""
    alone = student_t(noise_dof) if np.isfinite(noise_dof) else norm
    limit = alone.isf(USUAL_LEVEL / 4)
    drawn = ReducedNoise(np.ones((10, 10)), np.zeros((10, 0)), noise_dof).drawn
    p, found = _of_largest(
        limit, 10, abs(drawn).max(axis=0), noise_dof, USUAL_LEVEL / 2
    )
    assert p == pytest.approx(USUAL_LEVEL / 2, abs=0.011)  # 3 sigma of 2000 draws
    assert found == pytest.approx(limit, rel=0.06)
    apart, bound = _of_largest(limit, 10, None, noise_dof, USUAL_LEVEL / 2)
    assert apart == pytest.approx(10 * USUAL_LEVEL / 2)
    assert bound == pytest.approx(alone.isf(USUAL_LEVEL / 40))
