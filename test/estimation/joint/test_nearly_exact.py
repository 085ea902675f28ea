# SPDX-License-Identifier: Apache-2.0
"""Residuals of some picometres: less is assumed if, and only if, that leaves nothing of them."""

from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.errors import NotSettledError
from selfcal_ros.estimation.joint import solve
from selfcal_ros.estimation.options import Options
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.simulation.cell import CellSettings
from test.support.truth import hu_plan, random_truth, simulate_measurements

EXACT_M, NEARLY_M, NOISY_M = 1e-17, 5e-11, 2e-8


def readings(*, beside_m):
    plan, rng = hu_plan(Artifact(5, 0.01), repeats=2), np.random.default_rng(3)
    truth = random_truth(plan.artifact, len(plan.views), rng)
    settings = CellSettings(sigma_xy_m=NOISY_M, servo_sigma_m=beside_m)
    return simulate_measurements(truth, plan, rng, settings=settings, visits=True)


def leaving(monkeypatch, residual_of):
    """Let fits leave `residual_of(assumes, moves)`, m; None does not converge; return the calls."""
    fit_model, calls = solve.fit_model, []

    def fitted(problem, check):
        calls.append((bool(problem.terms), problem.moves))
        sigma_m = residual_of(*calls[-1])
        if sigma_m is None:
            raise NotSettledError("model", "the fit does not converge", "leave it out")
        model = fit_model(problem, check)
        noise = replace(model.fitted.xy, sigma=sigma_m)
        return replace(model, fitted=replace(model.fitted, xy=noise))

    monkeypatch.setattr(solve, "fit_model", fitted)
    return calls


@pytest.mark.parametrize("beside_m", [0.0, 1e-4])
@pytest.mark.parametrize(
    ("assuming", "without", "used"),
    [
        (NOISY_M, EXACT_M, NOISY_M),
        (EXACT_M, NOISY_M, EXACT_M),
        (NEARLY_M, EXACT_M, EXACT_M),
        (NEARLY_M, NOISY_M, NEARLY_M),
        (NEARLY_M, NEARLY_M / 2, NEARLY_M),
        (NEARLY_M, None, NEARLY_M),
        (None, NOISY_M, NOISY_M),
    ],
)
def test_what_is_assumed_is_left_out_only_where_nothing_is_left(
    monkeypatch, beside_m, assuming, without, used
):
    """Whether the stage stood at the sites or beside them."""
    read = readings(beside_m=beside_m)
    at_sites = None if assuming is None else NOISY_M

    def residual_of(assumes, moves):
        if moves is not (beside_m > 0):
            return at_sites
        return assuming if assumes else without

    leaving(monkeypatch, residual_of)
    model, _, as_assumed = solve._fitted(read, Options())
    assert model.fitted.xy.sigma == used
    assert as_assumed is (used == assuming)
    assert model.problem.moves is (beside_m > 0)


def test_a_fit_that_counts_as_a_whole_is_taken_as_it_is(monkeypatch):
    """Without a try of less, whose failure would be taken for its own."""
    read = readings(beside_m=0.0)
    calls = leaving(monkeypatch, lambda assumes, moves: NEARLY_M if assumes else None)
    assert solve.solve_joint(read, Options(), whole_only=True).converged
    assert calls == [(True, False)]


def test_readings_count_for_their_sites_where_the_places_do_not_converge(monkeypatch):
    read = readings(beside_m=1e-4)
    leaving(monkeypatch, lambda assumes, moves: None if moves else NOISY_M)
    model, _, as_assumed = solve._fitted(read, Options())
    assert model.problem.terms and not model.problem.moves and not as_assumed
    with pytest.raises(NotSettledError):
        solve.solve_joint(read, Options(), whole_only=True)
