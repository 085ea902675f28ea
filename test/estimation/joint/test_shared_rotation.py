# SPDX-License-Identifier: Apache-2.0
"""The cells of an image see a plate placed once: one rotation, against dense linear algebra."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from selfcal_ros.estimation.comparison.covariance import system_behind
from selfcal_ros.estimation.joint.solve import solve_joint
from selfcal_ros.estimation.normal.equations import planned_system
from selfcal_ros.estimation.observability.rank import deficiency, unknowns_of
from selfcal_ros.estimation.options import Options
from selfcal_ros.model.readings import Sense
from selfcal_ros.model.view import rotations_of, with_sub_views
from selfcal_ros.simulation.cell import CellSettings
from test.estimation.joint.test_images import MARK, datum, dense, measured
from test.estimation.joint.test_yaw import PITCH, of_yaw
from test.support.plans import image_plan, plan_of
from test.support.truth import Spread, random_truth, simulate_measurements

LINEAR = Options(assumed=(), misalignment_model="linear", at_places=False)


@cache
def with_lines(missing: float = 0.0):
    """Return readings of marks and lines: 5 x 5 sites, 8 lines, of which one view has no marks."""
    plan, rng = image_plan(5, count=8), np.random.default_rng(4)
    truth = random_truth(plan.artifact, 3, rng, Spread(phi_rad=1e-4, t_m=1e-6))
    settings = CellSettings(sigma_xy_m=MARK, sigma_theta_rad=1e-5, servo_sigma_m=0.0)
    return simulate_measurements(truth, plan, rng, settings=settings, missing=missing)


def solution(measurements, ratio: float):
    """Return what one dense least squares makes of marks and lines, unknowns as in `dense`.

    `ratio` is the weight of the reading of a line, in (m/rad)^2.
    """
    grid = [view for view in measurements.views if len(view.m)]
    marks = dense(replace(measurements, views=tuple(grid)))[0]
    placed = list(dict.fromkeys(view.view.plan_view for view in grid))
    lines, n = measurements.artifact.angular_count, marks.shape[1]
    rows, y = [], []
    for view in measurements.views:
        for k, value in zip(view.k, view.dtheta, strict=True):
            row = np.zeros(n + 1 + 2 * lines)
            turn = round(view.view.rotation_rad * lines / (2 * np.pi))
            row[n + 1 + (k + turn) % lines] = row[n + 1 + lines + k] = 1
            at = (
                n - len(placed) + placed.index(view.view.plan_view)
                if view.view.grid
                else n
            )
            row[at] = 1 / PITCH if view.view.grid else 1  # the others are per pitch
            rows.append(np.sqrt(ratio) * row)
            y.append(np.sqrt(ratio) * value)
    matrix = np.vstack([np.pad(marks, ((0, 0), (0, 1 + 2 * lines))), rows])
    values = np.concatenate(
        [*(np.stack([v.dx, v.dy], axis=1).ravel() for v in grid), y]
    )
    return np.linalg.pinv(matrix, rcond=1e-10) @ values, slice(n - len(placed), n)


@pytest.mark.parametrize("missing", [0.0, 0.06])
def test_map_and_rotations_of_marks_and_lines_are_those_of_one_least_squares(missing):
    measurements = with_lines(missing)
    solved = solve_joint(measurements, LINEAR)
    length = solved.model.problem.half_width_m
    found, at = solution(measurements, solved.model.fitted.ratio * length**2)
    sites = np.prod(measurements.artifact.shape)
    emap = solved.result.error_map
    np.testing.assert_allclose(
        np.stack([emap.gx, emap.gy], axis=-1).ravel(),
        datum(measurements.artifact) @ found[: 2 * sites],
        atol=1e-14,
    )
    phi = {
        name: {
            round(view.phi, 15)
            for of, view in zip(measurements.views, solved.result.views, strict=True)
            if of.view.plan_view == name
        }
        for name in ("0", "90")
    }
    (first,), (second,) = phi["0"], phi["90"]
    assert second - first == pytest.approx(np.diff(found[at])[0] / PITCH, abs=1e-13)
    assert abs(second - first) > 1e-5


@pytest.mark.parametrize("missing", [0.0, 0.06])
def test_numbers_of_unknowns_and_of_degrees_of_freedom_are_those_of_the_matrix(missing):
    _, measurements = measured(MARK, 5, size=5, missing=missing)
    matrix = dense(measurements)[0]
    problem = solve_joint(measurements, LINEAR).model.problem
    rank = np.linalg.matrix_rank(matrix, tol=1e-9)
    assert problem.system.dof_grid == len(matrix) - rank
    assert problem.system.rank_grid == rank == matrix.shape[1] - 7
    assert unknowns_of(problem.system) == matrix.shape[1]


@pytest.mark.parametrize(("turns", "unseen"), [((0,), 2), ((0, 180), 2), ((0, 90), 0)])
def test_modes_that_a_plan_leaves_unseen_are_those_of_the_matrix(turns, unseen):
    plan = image_plan(5, turns=turns)
    system = planned_system(plan.artifact, plan.views)
    assert deficiency(system) == unseen
    if 180 not in turns:  # the matrix knows quarter turns up to one
        rng = np.random.default_rng(1)
        matrix = dense(
            simulate_measurements(
                random_truth(plan.artifact, len(turns), rng), plan, rng, sigma_m=MARK
            )
        )[0]
        assert matrix.shape[1] - np.linalg.matrix_rank(matrix, tol=1e-9) == 7 + unseen


@pytest.mark.parametrize("sense", list(Sense))
def test_every_cell_has_the_rotation_of_its_plate(sense):
    truth, measurements = measured(0.0, 2, sense=sense, size=5)
    result, found = solve_joint(measurements, Options(assumed=())).result, ([], [])
    for of, view in zip(measurements.views, result.views, strict=True):
        found[of.view.plan_view == "90"].append(view.phi)
    for phi, true in zip(found, truth.phi_rad, strict=True):
        assert abs(true) > 3e-4
        assert phi == pytest.approx([true] * 9, abs=5 * MARK / 2e-3)
        assert np.ptp(phi) < 1e-14


def test_a_cell_turned_by_itself_is_not_followed():
    """Readings of one cell as of a plate turned by itself are left in the residuals."""
    _, measurements = measured(0.0, 2, size=5, phi_rad=1e-5, t_m=1e-6)
    at = [view.view.cell for view in measurements.views].index((1, 1))
    view = measurements.views[at]
    turned = replace(
        view, dx=view.dx - 1e-3 * PITCH * view.n, dy=view.dy + 1e-3 * PITCH * view.m
    )
    views = (*measurements.views[:at], turned, *measurements.views[at + 1 :])
    before, after = (
        solve_joint(one, LINEAR).xy.residuals
        for one in (measurements, replace(measurements, views=views))
    )
    assert before < 1.3 * MARK
    assert after > 5 * before


def test_cells_in_one_line_and_views_without_images_turn_by_themselves():
    plan = image_plan(5)
    row = [replace(view, image=replace(view.image, ny=1)) for view in plan.views]
    assert rotations_of(with_sub_views(row)) == (0, 1, 2, 3, 4, 5)
    assert rotations_of(with_sub_views(plan.views)) == (0,) * 9 + (9,) * 9
    assert rotations_of(plan_of("0,90,tx", 5).views) == (0, 1, 2)
    assert planned_system(plan.artifact, row).grid.n_misalignments == 18


def test_a_saved_result_has_the_equations_of_its_readings():
    _, measurements = measured(MARK, 5, size=5)
    solved = solve_joint(measurements, LINEAR)
    kept = system_behind(solved.result)
    np.testing.assert_array_equal(
        kept.grid_inverse, solved.model.problem.system.grid_inverse
    )
    assert kept.grid.rotations == (0,) * 9 + (9,) * 9


def test_one_rotation_tells_a_linear_yaw_from_a_bent_plate():
    """A plate bent in its second view looks like a linear yaw only if its cells turn apart."""
    _, measurements = measured(0.0, 1, size=7)
    matrix, sites, views = dense(measurements)[0], 49, measurements.views
    turn = np.repeat(
        [(1, 1j)[v.view.plan_view == "90"] for v in views], [len(v.m) for v in views]
    )
    z = np.concatenate([view.m + 1j * view.n for view in views]) / 3
    forms = [
        turn * (turn == 1j) * unit * form
        for form in (z * z, abs(z) ** 2, z.conj() ** 2)
        for unit in (1, 1j)
    ]
    cell = np.repeat(np.arange(len(views)), [len(view.m) for view in views])
    apart = [1j * turn * z * (cell == number) for number in range(len(views))]
    bent, apart = (
        np.array([np.stack([one.real, one.imag], axis=1).ravel() for one in many]).T
        for many in (forms, apart)
    )
    slope, u = np.repeat(np.arange(7.0) - 3, 7) / 28 / 7, []
    for columns in (matrix, np.hstack([matrix, apart])):
        whole = np.hstack([columns, bent, of_yaw(measurements) / PITCH])
        values, vectors = np.linalg.eigh(whole.T @ whole)
        values = np.maximum(values, 1e-9 * values[-1])
        u.append(np.sqrt(((vectors[-sites:].T @ slope) ** 2 / values).sum()))
    assert 0.03 < u[0] < 0.05  # rad of the reading's noise over a pitch, per pitch
    assert u[1] > 100 * u[0]
