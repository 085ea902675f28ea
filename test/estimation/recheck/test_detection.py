# SPDX-License-Identifier: Apache-2.0
"""Tests of a change of a map: their level, what they find, and that it is as large as stated."""

from functools import cache

import numpy as np
import pytest
from scipy.stats import binom, chi2

from selfcal_ros.estimation.recheck.change import POWER, ChangeTests
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.error_map import datum_modes

PLATE = Artifact(7, 0.01)
DRAWS = 400


@cache
def change_tests(dof: float) -> ChangeTests:
    """Return tests of a map whose nodes are correlated, with noise of some degrees of freedom."""
    z = (PLATE.x_m + 1j * PLATE.y_m).ravel()
    near = np.exp(-np.abs(z[:, None] - z) / 0.02)
    modes = datum_modes(PLATE, scale=True).reshape(4, -1).T
    return ChangeTests(np.kron(np.diag([1.0, 4.0]), near) * 1e-16, modes, dof, z)


def noise(tests: ChangeTests, rng, number=DRAWS) -> np.ndarray:
    """Return changes of unchanged stages: their noise was estimated too small or too large."""
    drawn = np.linalg.cholesky(tests.covariance) @ rng.normal(
        size=(len(tests.u), number)
    )
    scale = rng.chisquare(tests.dof, number) / tests.dof if tests.dof < 1e9 else 1.0
    return tests.without(drawn) / np.sqrt(scale)


@pytest.mark.parametrize("dof", [12.0, np.inf])
def test_the_level_is_the_nominal_one(dof):
    tests = change_tests(dof)
    p = np.array([tests.p(one) for one in noise(tests, np.random.default_rng(5)).T])
    for level in (0.05, 0.5):
        low, high = binom.ppf([1e-3, 1 - 1e-3], DRAWS, level)
        assert low <= (p < level).sum() <= high


@pytest.mark.parametrize("kind", ["one_node", "smooth"])
@pytest.mark.parametrize("level", [0.05, 0.025])
def test_nine_of_ten_changes_of_the_stated_size_are_found(kind, level):
    tests, rng, n = change_tests(np.inf), np.random.default_rng(6), PLATE.m.size
    size, shape = getattr(tests.detectable(level), kind), np.zeros((2, n, DRAWS))
    if kind == "one_node":
        at, turn = rng.integers(n, size=DRAWS), rng.uniform(0, 2 * np.pi, DRAWS)
        shape[:, at, np.arange(DRAWS)] = np.cos(turn), np.sin(turn)
    else:  # any polynomial of the second degree
        x, y = tests.places.real * 30, tests.places.imag * 30
        columns = np.stack([0 * x + 1, x, y, x * x, x * y, y * y], axis=1)
        shape = columns @ rng.normal(size=(2, 6, DRAWS))
    shape = shape.reshape(2 * n, DRAWS)
    if kind == "smooth":
        shape = tests.without(shape)
        shape /= np.sqrt((shape**2).mean(axis=0))
    changed = noise(tests, rng) + tests.without(size * shape)
    found = np.mean([tests.p(one) < level for one in changed.T])
    assert found == pytest.approx(POWER, abs=0.06)


def test_smooth_changes_and_those_of_few_nodes_are_found_better_than_by_one_sum_of_squares():
    """Independent nodes, one by 5.5 u, or a bend of 0.5 u rms: the sum finds two of three."""
    modes = datum_modes(PLATE, scale=True).reshape(4, -1).T
    tests, rng = (
        ChangeTests(np.eye(98), modes, np.inf, change_tests(12.0).places),
        (np.random.default_rng(7)),
    )
    bend = tests.without(np.concatenate([tests.places.real**2, 0 * tests.places.real]))
    limit = chi2.ppf(0.95, 94)
    for shape in (
        0.5 * bend / np.sqrt((bend**2).mean()),
        tests.without(5.5 * np.eye(98)[24]),
    ):
        changed = noise(tests, rng) + shape[:, None]
        ours = np.mean([tests.p(one) < 0.05 for one in changed.T])
        assert ours > 0.88 > 0.75 > np.mean((changed**2).sum(axis=0) > limit)


def test_large_changes_have_a_small_probability():
    tests = change_tests(20.0)
    bend = tests.without(np.concatenate([tests.places.real**2, 0 * tests.places.real]))
    p = [tests.p(bend / np.abs(bend).max() * size) for size in (1e-7, 2e-7, 1e-6)]
    assert 0.005 > p[0] > p[1] > p[2] > 0


def test_the_probability_of_a_large_change_is_at_most_three_times_the_least_of_three_tests():
    """The sum of squares is the most significant where all nodes have changed."""
    tests, rng = change_tests(np.inf), np.random.default_rng(8)
    change = noise(tests, rng, 1)[:, 0]
    own, rank = tests.without(tests.without(tests.covariance).T), 98 - 4
    inverse = np.linalg.pinv(own, 1e-12, hermitian=True)
    change *= np.sqrt(chi2.isf(1e-8, rank) / (change @ inverse @ change))
    assert tests.p(change) == pytest.approx(3e-8, rel=1e-6)
