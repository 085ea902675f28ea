# SPDX-License-Identifier: Apache-2.0
"""The factor against the dense matrix of the same readings, marks eliminated."""

import numpy as np
import pytest

from selfcal_ros.estimation.multifrontal import factor
from selfcal_ros.estimation.normal.grid import GridSystem
from selfcal_ros.model.pose import LatticePose

SETS = [
    ((0, 0, 0), (1, 0, 0), (0, 1, 0)),
    ((0, 0, 0), (2, 0, 0), (3, 1, -1)),
    ((0, 0, 0), (0, 1, 0), (0, 0, 2)),
    ((1, 0, 0), (2, 1, 0), (3, 0, 0), (0, 0, 0)),
    ((0, 2, 0), (1, 0, 2), (3, -1, 0)),
    ((0, 0, 0), (1, 0, 0)),
]


def grid_of(poses, shape, seed):
    """Return readings of uneven weights, a fifth of them missing, as far as sites are there."""
    rng = np.random.default_rng(seed)
    views = tuple(LatticePose(q, shift, None) for q, *shift in poses)
    weight = rng.integers(1, 6, (len(poses), *shape)) * (
        rng.random((len(poses), *shape)) > 0.2
    )
    field = GridSystem(views, np.zeros((len(poses), *shape))).views.in_field
    return GridSystem(views, weight * field * 1.0)


def dense(grid):
    """Return the matrix of sites with every mark's own error eliminated, from the design.

    A reading of mark m at a site X in a view turned by q quarters is i^-q G(X) + A(m).
    """
    (nx, ny), rows = grid.weight.shape[1:], []
    half = (nx - 1) // 2, (ny - 1) // 2
    n = nx * ny
    for pose, weights in zip(grid.views.poses, grid.weight, strict=True):
        for i, j in np.argwhere(weights > 0):
            m, k = i - half[0], j - half[1]
            for _ in range(pose.q):
                m, k = -k, m
            row = np.zeros(2 * n, dtype=complex)
            row[(m + pose.a + half[0]) * ny + k + pose.b + half[1]] = (-1j) ** pose.q
            row[n + i * ny + j] = 1.0
            rows.append(np.sqrt(weights[i, j]) * row)
    full = np.array(rows).conj().T @ np.array(rows)
    marks, both = full[n:, n:], full[:n, n:]
    matrix = full[:n, :n] - both @ np.linalg.pinv(marks) @ both.conj().T
    matrix[grid.pins, grid.pins] += grid.weight.sum() / grid.n_readings
    return matrix


def mean_at_sites(grid):
    """Return the mean of i^-q G(X) over the readings of each mark, as rows over the sites."""
    out = np.zeros((grid.n_marks, grid.n_sites), dtype=complex)
    for pose, index, part in zip(
        grid.views.poses,
        grid.views.site_index,
        grid.weight / np.maximum(grid.weight.sum(axis=0), 1),
        strict=True,
    ):
        read = np.flatnonzero(part)
        np.add.at(
            out, (read, index.ravel()[read]), (-1j) ** pose.q * part.ravel()[read]
        )
    return out


@pytest.mark.parametrize("shape", [(7, 7), (9, 5), (15, 11)])
@pytest.mark.parametrize("poses", SETS)
@pytest.mark.parametrize("leaf", [4, 12, factor.LEAF])
def test_solution_and_diagonal_of_the_inverse_are_those_of_the_dense_matrix(
    poses, shape, leaf, monkeypatch
):
    """With small leaves there are fronts on many levels, as on large fields."""
    monkeypatch.setattr(factor, "LEAF", leaf)
    grid = grid_of(poses, shape, 3)
    if (leaf, poses, shape) == (4, SETS[0], (15, 11)):
        assert len(grid.factor.dissection.fronts) > 6
    inverse = np.linalg.inv(dense(grid))
    size = np.abs(inverse).max()
    sites, means = grid.factor.variances
    np.testing.assert_allclose(sites, np.real(np.diag(inverse)), atol=1e-10 * size)
    rows = mean_at_sites(grid)
    np.testing.assert_allclose(
        means, np.real(np.diag(rows @ inverse @ rows.conj().T)), atol=1e-10 * size
    )
    rng = np.random.default_rng(1)
    right = rng.normal(size=(grid.n_sites, 3)) + 1j * rng.normal(size=(grid.n_sites, 3))
    np.testing.assert_allclose(
        grid.factor.solve(right), inverse @ right, atol=1e-9 * size
    )
    np.testing.assert_allclose(
        grid.factor.solve(right[:, 0]), (inverse @ right)[:, 0], atol=1e-9 * size
    )


def test_the_factor_of_a_field_has_few_values_a_site():
    """Folded into an eighth of the plane, where two sides lie on each other, it had 250."""
    views = tuple(LatticePose(q, shift, None) for q, *shift in SETS[0])
    weight = GridSystem(views, np.zeros((3, 61, 61))).views.in_field * 1.0
    grid = GridSystem(views, weight)
    assert grid.factor.dissection.storage.size < 150 * grid.n_sites
