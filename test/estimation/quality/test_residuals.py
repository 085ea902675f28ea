# SPDX-License-Identifier: Apache-2.0
"""Noise of single views and how well it is known, against one dense least squares."""

from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.estimation.options import Options
from selfcal_ros.estimation.quality import outliers
from selfcal_ros.estimation.quality.outliers import residuals_of, view_noise
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.view import Plan, View
from test.support.truth import random_truth, simulate_measurements

LINEAR = Options(misalignment_model="linear")
TURNS = {0.0: ((1, 0), (0, 1)), np.pi / 2: ((0, -1), (1, 0)), np.pi: ((-1, 0), (0, -1))}


def measured():
    """Views of a rectangular plate; one with more repeats, one three times as noisy."""
    artifact, rng = Artifact(5, 0.01, grid_size_y=3), np.random.default_rng(3)
    plan = Plan(
        "p",
        artifact,
        (
            View("start"),
            View("rot90", np.pi / 2),
            View("rot180", np.pi, repeats=4),
            View("shift_x", 0.0, (0.01, 0.0)),
            View("shift_y", 0.0, (0.0, 0.01)),
        ),
    )
    readings = simulate_measurements(
        random_truth(artifact, 5, rng),
        plan,
        rng,
        sigma_m=2e-8,
        sigma_theta_rad=0.0,
        linear=True,
    )
    noisy = readings.views[3]
    more = rng.normal(size=(2, len(noisy.m))) * 2e-8 * np.sqrt(8)
    noisy = replace(noisy, dx=noisy.dx + more[0], dy=noisy.dy + more[1])
    return replace(readings, views=(*readings.views[:3], noisy, readings.views[4]))


def dense(readings):
    """Return what is left of weighted readings (rows, rows), the readings, and their views."""
    (hx, hy), (nx, ny) = readings.artifact.half, readings.artifact.shape
    sites, rows, right, of_view = nx * ny, [], [], []
    for v, view in enumerate(readings.views):
        turn = np.array(TURNS[view.view.rotation_rad])
        shift = np.round(np.array(view.view.translation_m) / 0.01).astype(int)
        for m, n, count, *offset in zip(
            view.m, view.n, view.count, view.dx, view.dy, strict=True
        ):
            at = turn @ (m, n) + shift
            for axis in range(2):
                row = np.zeros(4 * sites + 3 * len(readings.views))
                row[2 * ((at[0] + hx) * ny + at[1] + hy) + axis] = 1
                mark = 2 * (sites + (m + hx) * ny + n + hy)
                row[mark : mark + 2] = turn[axis]
                place = turn @ (m, n)
                row[4 * sites + 3 * v :][:3] = ((-place[1], 1, 0), (place[0], 0, 1))[
                    axis
                ]
                rows.append(np.sqrt(count) * row)
                right.append(np.sqrt(count) * offset[axis])
                of_view.append(v)
    design = np.array(rows)
    left = np.eye(len(design)) - design @ np.linalg.pinv(design, rcond=1e-10)
    return left, np.array(right), np.array(of_view)


def two_variances(left, of_view, v):
    """Return the forms A (rows, rows) whose y' A y are the variances of view `v` and of others."""
    own = of_view == v
    parts = [
        left * np.where(own, 1.0, 0.0) @ left,
        left * np.where(own, 0.0, 1.0) @ left,
    ]
    mixing = np.array(
        [[np.trace(left * a @ left * b) for b in (own, ~own)] for a in (own, ~own)]
    )
    return np.tensordot(np.linalg.inv(mixing), np.array(parts), axes=1)


def test_the_noise_of_a_view_and_its_degrees_of_freedom(monkeypatch):
    """The degrees of freedom are those of a variance that scatters as the estimates do: 2/dof.

    A form y' A y of unit noise has the variance 2 tr(A A).
    """
    monkeypatch.setattr(outliers, "FEW_DRAWS", 1000)
    readings = measured()
    found = view_noise(residuals_of(readings, LINEAR))
    left, y, of_view = dense(readings)
    for v in range(5):
        forms = two_variances(left, of_view, v)
        scatter = 2 * np.sum(forms[0] ** 2)
        assert found[v, 2] == pytest.approx(2 / scatter, rel=0.06)
        assert found[v, 2] < 16  # one more or less is not within 6 %
        variances = y @ forms @ y
        np.testing.assert_allclose(
            found[v, :2], np.sqrt(np.maximum(variances, 0)), rtol=0.05, atol=1e-9
        )
    assert found[3, 0] > 2 * found[3, 1]


def test_what_is_left_over_is_that_of_the_dense_fit():
    readings = measured()
    found = residuals_of(readings, LINEAR)
    left, y, of_view = dense(readings)
    weight = found.problem.grid.weight
    squares = (abs(found.marks.residual) ** 2 * weight).sum(axis=(1, 2))
    wanted = [((left @ y)[of_view == v] ** 2).sum() for v in range(5)]
    np.testing.assert_allclose(squares, wanted, rtol=1e-9)
