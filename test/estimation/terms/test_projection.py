# SPDX-License-Identifier: Apache-2.0
"""What the estimate leaves of columns, and makes of them: as one dense least squares has it."""

import numpy as np
import pytest

from selfcal_ros.estimation.normal.angular import AngularSystem
from selfcal_ros.estimation.normal.equations import NormalEquations
from selfcal_ros.estimation.normal.grid import GridSystem
from selfcal_ros.estimation.terms.columns import NO_LINES, shapes_of
from selfcal_ros.estimation.terms.equations import project, reduce_columns
from selfcal_ros.model.pose import LatticePose

POSES = ((0, 0, 0), (1, 0, 0), (0, 1, 0), (2, 0, -1))
SHAPE = (5, 7)
OF_COLUMN, UNIT = [0, 0, 1, 2, 2, 3], [1, 1j, 1j, 1, 1j, 1]


@pytest.fixture(scope="module")
def system():
    """Return readings of uneven weights, some of them missing."""
    rng = np.random.default_rng(3)
    poses = tuple(LatticePose(q, shift, None) for q, *shift in POSES)
    field = GridSystem(poses, np.zeros((len(POSES), *SHAPE))).views.in_field
    weight = (
        rng.integers(1, 5, field.shape) * (rng.random(field.shape) > 0.1) * field * 1.0
    )
    return NormalEquations(
        GridSystem(poses, weight),
        AngularSystem((), np.zeros((0, 0))),
        tuple(range(len(POSES))),
        (),
    )


@pytest.fixture(scope="module")
def shapes(system):
    """Return six columns of four shapes: of one view, of all, of two views."""
    rng = np.random.default_rng(4)
    values = rng.normal(size=(4, len(POSES), SHAPE[0] * SHAPE[1], 2)) @ [1, 1j]
    read = system.grid.read.reshape(len(POSES), -1)
    return shapes_of(
        [
            {view: values[at, view] * read[view] for view in views}
            for at, views in enumerate(([1], [0, 1, 2, 3], [3], [0, 2]))
        ],
        OF_COLUMN,
        UNIT,
        system.grid.weight,
    )


def design(grid):
    """Return rows of the model, real and imaginary part of each reading, times root weight.

    y_v(m) = i^-q G(X) + A(m) + phi i z(m) + tau (method eq. 2.4); and the place of each reading.
    """
    (nx, ny), rows, places = SHAPE, [], []
    half, n = (nx // 2, ny // 2), nx * ny
    for v, pose in enumerate(grid.views.poses):
        for i, j in np.argwhere(grid.weight[v] > 0):
            m, k = i - half[0], j - half[1]
            z = complex(m, k) / max(half)
            for _ in range(pose.q):
                m, k = -k, m
            site = (m + pose.a + half[0]) * ny + k + pose.b + half[1]
            row = np.zeros(4 * n + 3 * len(POSES), dtype=complex)
            row[2 * site], row[2 * site + 1] = (-1j) ** pose.q, 1j * (-1j) ** pose.q
            mark = 2 * n + 2 * (i * ny + j)
            row[mark], row[mark + 1] = 1, 1j
            row[4 * n + 3 * v : 4 * n + 3 * v + 3] = 1j * z, 1, 1j
            rows.append(np.sqrt(grid.weight[v, i, j]) * row)
            places.append((v, i, j))
    return np.array(rows), tuple(np.array(places).T)


def parts(values):
    return np.concatenate([values.real, values.imag])


def test_what_is_left_of_columns_and_their_maps_are_those_of_a_dense_solution(
    system, shapes
):
    grid = system.grid
    rows, places = design(grid)
    dense = np.concatenate([rows.real, rows.imag])
    columns = np.array(
        [parts(np.sqrt(grid.weight[places]) * one[places]) for one in shapes.grid]
    ).T
    found = np.linalg.pinv(dense, rcond=1e-12) @ columns
    left = columns - dense @ found
    reduced = reduce_columns(grid, shapes)
    projected = project(
        system, reduced, system.grid_inverse, NO_LINES, ratio=0.0, half_width_m=1.0
    )
    assert projected.gram == pytest.approx(left.T @ left, abs=1e-9)
    for mine, wanted in zip(
        projected.fields.T, found[: 2 * grid.n_sites].T, strict=True
    ):
        moved = mine - (wanted[::2] + 1j * wanted[1::2])
        rest = system.gauge.remove(
            moved.reshape(SHAPE), system.gauge.coefficients(moved.reshape(SHAPE))
        )
        assert np.abs(rest[system.known_sites]).max() < 1e-9
