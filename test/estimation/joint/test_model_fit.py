# SPDX-License-Identifier: Apache-2.0
"""Degrees of freedom of all residuals together, against the rank of one dense matrix."""

from math import pi

import numpy as np
import pytest

from selfcal_ros.errors import InputError, NotSettledError
from selfcal_ros.estimation.joint import model_fit
from selfcal_ros.estimation.joint.model_fit import fit_model, squares
from selfcal_ros.estimation.joint.problem import own_rotations
from selfcal_ros.estimation.joint.solve import prepare
from selfcal_ros.estimation.normal.grid import GridSystem
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.pose import LatticePose
from selfcal_ros.model.terms import parse_terms
from selfcal_ros.model.view import Plan, View
from test.support.lattice_plans import plan_of
from test.support.options import BARE, bare
from test.support.truth import random_truth, simulate_measurements

PITCH, LINES = 0.01, 8
ARTIFACT = Artifact(5, PITCH, LINES)


def plan_with(shared: int, alone: int) -> Plan:
    """Return grid views of which `shared` have lines too, and views of nothing but lines."""
    poses = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (3, 0, -2)]
    grids = [
        View(str(i), q * pi / 2, (a * PITCH, b * PITCH), True, i < shared)
        for i, (q, a, b) in enumerate(poses)
    ]
    return Plan(
        "p",
        ARTIFACT,
        (
            *grids,
            *(
                View(f"line{s}", s * 2 * pi / LINES, (0.0, 0.0), False, True)
                for s in range(1, alone + 1)
            ),
        ),
    )


def dense_dof(plan: Plan) -> int:
    """Return readings less the rank of their equations, every unknown a column."""
    sites, rows = 25, []
    views, lines = 4 * sites, 4 * sites + 3 * len(plan.views)
    for v, view in enumerate(plan.views):
        q = round(view.rotation_rad / (pi / 2)) if view.grid else 0
        turn = np.linalg.matrix_power(np.array([[0, -1], [1, 0]]), q)
        shift = np.round(np.array(view.translation_m) / PITCH).astype(int)
        marks = (
            [(m, n) for m in range(-2, 3) for n in range(-2, 3)] if view.grid else []
        )
        for m, n in marks:
            site = turn @ [m, n] + shift
            if np.abs(site).max() > 2:
                continue
            row = np.zeros((2, lines + 2 * LINES))
            row[:, 2 * (5 * (site[0] + 2) + site[1] + 2) :][:, :2] = np.eye(2)
            row[:, 2 * sites + 2 * (5 * (m + 2) + n + 2) :][:, :2] = turn
            x, y = turn @ [m, n]
            row[:, views + 3 * v :][:, :3] = [[-y, 1, 0], [x, 0, 1]]
            rows += list(row)
        for k in range(LINES if view.angular else 0):
            row = np.zeros(lines + 2 * LINES)
            row[lines + (k + round(view.rotation_rad / (2 * pi / LINES))) % LINES] = 1
            row[lines + LINES + k] = row[views + 3 * v] = 1
            rows.append(row)
    return len(rows) - int(np.linalg.matrix_rank(np.array(rows)))


@pytest.mark.parametrize(
    ("shared", "alone"), [(0, 0), (0, 2), (1, 1), (1, 2), (2, 1), (4, 2)]
)
def test_degrees_of_freedom_count_rotations_that_marks_and_lines_share_once(
    shared, alone
):
    plan, rng = plan_with(shared, alone), np.random.default_rng(6)
    readings = simulate_measurements(
        random_truth(ARTIFACT, len(plan.views), rng),
        plan,
        rng,
        sigma_m=2e-8,
        sigma_theta_rad=2e-6,
    )
    model = fit_model(prepare(readings, BARE)[0])
    assert squares(model.problem, model.fitted)[1] == dense_dof(plan)


@pytest.mark.parametrize(
    ("terms", "message"),
    [
        (
            "",
            "misalignment model 'rigid': the rotations do not converge; check the readings for "
            "misalignments of more than a few degrees",
        ),
        (
            "plate_scale,drift:1e-8",
            "model drift, plate_scale: the fit does not converge; leave a term out, "
            "or give plate_scale a size",
        ),
        (
            "plate_scale:1e-7,drift:1e-8",
            "model drift, plate_scale: the fit does not converge; leave a term out",
        ),
    ],
)
def test_what_does_not_settle_is_named(monkeypatch, terms, message):
    monkeypatch.setattr(model_fit, "MAX_STEPS", 1)
    plan, rng = plan_with(0, 0), np.random.default_rng(6)
    readings = simulate_measurements(
        random_truth(ARTIFACT, len(plan.views), rng),
        plan,
        rng,
        sigma_m=2e-8,
        visits=True,
    )
    with pytest.raises(InputError) as caught:
        fit_model(prepare(readings, bare(terms=parse_terms([terms], "")))[0])
    assert str(caught.value) == message


def test_an_iteration_in_circles_is_given_up_and_a_slow_one_is_not(monkeypatch):
    plan, rng = plan_with(0, 0), np.random.default_rng(6)
    readings = simulate_measurements(
        random_truth(ARTIFACT, len(plan.views), rng), plan, rng
    )
    problem = prepare(readings, BARE)[0]
    step, steps = model_fit._State.step, []

    def run_with(changes):
        steps.clear()

        def told(state):
            step(state)
            change = changes(len(steps))
            steps.append(change)
            state.moved_m = np.full(state.problem.system.size, change)
            state.changed = np.full_like(state.y, change)
            return change

        monkeypatch.setattr(model_fit._State, "step", told)
        return fit_model(problem)

    with pytest.raises(NotSettledError):
        run_with(lambda number: (3e-6, 2e-6, 4e-6)[number % 3])
    assert len(steps) == 1 + 1 + model_fit.LATE
    run_with(lambda number: 1e-6 * 0.75**number)
    assert len(steps) > 2 * model_fit.LATE and steps[-1] < 1e-12


def test_in_a_linear_model_only_the_terms_change_what_is_taken_off_the_readings():
    """What finite rotations take off is another change, which coefficients do not explain."""
    plan, rng = plan_with(0, 0), np.random.default_rng(6)
    readings = simulate_measurements(
        random_truth(ARTIFACT, len(plan.views), rng),
        plan,
        rng,
        sigma_m=2e-8,
        visits=True,
    )
    terms = parse_terms(["plate_scale:1e-6"], "")
    for model, besides in (("linear", False), ("rigid", True)):
        options = bare(misalignment_model=model, terms=terms)
        state = model_fit._State(prepare(readings, options)[0])
        state.step()
        assert np.abs(state.changed).max() > 1e-10
        assert (state._changed_besides_m > 1e-12) is besides
        assert not state._terms_are_still(0.0) and state._terms_are_still(1.0)


def test_the_rotation_that_a_view_shows_of_its_own_is_that_of_its_marks_about_their_middle():
    rng = np.random.default_rng(2)
    poses = tuple(LatticePose(q, (0, 0), None) for q in (0, 1, 2))
    weight = rng.integers(1, 5, (3, 5, 7)) * (rng.random((3, 5, 7)) > 0.3) * 1.0
    weight[2] = 0.0
    weight[2, 1, 4] = 3.0  # a single mark shows no rotation
    grid = GridSystem(poses, weight)
    turned = np.array([2e-3, -5e-3, 1e-3])[:, None, None]
    y = (1e-4 - 2e-4j) + (1j * turned + 3e-3) * grid.views.z
    assert own_rotations(grid, y) == pytest.approx([2e-3, -5e-3, 0.0], abs=1e-15)


def test_rotations_settle_in_four_steps_from_what_the_views_show(monkeypatch):
    """From nothing, or with rotations of the other sense, five are needed."""
    artifact = Artifact(11, 0.01)
    rng = np.random.default_rng(3)
    readings = simulate_measurements(
        random_truth(artifact, 3, rng), plan_of("0,90,tx", artifact), rng, sigma_m=2e-8
    )
    fits, plain = [], model_fit.fit
    monkeypatch.setattr(model_fit, "fit", lambda *args: fits.append(1) or plain(*args))
    fit_model(prepare(readings, BARE)[0])
    assert len(fits) == 1 + 4


def test_without_noise_the_iteration_ends_at_rounding(monkeypatch):
    """A strain that all views share is the plate's: no reading tells it, and rounding moves it."""
    plan, rng = plan_of("0,90,tx", Artifact(21, 0.01)), np.random.default_rng(21)
    readings = simulate_measurements(random_truth(plan.artifact, 3, rng), plan, rng)
    steps, step = [], model_fit._State.step

    def counted(state):
        steps.append(step(state))
        return steps[-1]

    monkeypatch.setattr(model_fit._State, "step", counted)
    problem, _ = prepare(readings, bare(terms=parse_terms(["plate_strain:7e-8"], "")))
    found = fit_model(problem)
    assert len(steps) < 10 and steps[-1] < 1e-15
    assert np.abs(found.coefficients).max() < 1e-15
