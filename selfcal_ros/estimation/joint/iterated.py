# SPDX-License-Identifier: Apache-2.0
"""The joint least squares of a large field, by iteration."""

import numpy as np

from selfcal_ros.estimation.joint.pcg import TOLERANCE, GridIteration, Iterated
from selfcal_ros.estimation.joint.problem import (
    AngularPart,
    FreeNetworkSolution,
    Problem,
    grid_noise,
    weight_ratio,
)

ROUGH = 1e-6
"""Relative residual at which the noise of the grid readings is estimated, for the weights."""


def solve_iterated(problem: Problem, y: np.ndarray, theta: AngularPart) -> FreeNetworkSolution:
    """Return the solution of the joint equations by conjugate gradients.

    An approximate solution of the grid readings alone gives their noise; then the angular readings
    join, and the iteration continues to full accuracy.
    """
    system, grid = problem.system, problem.system.grid
    n, length = 3 * grid.n_views, problem.half_width_m
    plain = _block_inverse(problem, np.zeros((grid.n_views, grid.n_views)))
    _, d = grid.right_side(y)
    near = plain @ d
    # misalignments are far larger than errors: subtract first, or their rounding remains
    b, d = grid.right_side(np.where(grid.read, y - grid.misaligned(near), 0.0))
    b = b.reshape(grid.views.shape)
    kernel = GridIteration(grid, plain)
    if not system.angular.n_views:
        found = kernel.solve(b, d)
        return _raw(found, near + found.parameters)

    rough = kernel.solve(b, d, tolerance=ROUGH)
    _, residual = grid.plate(y, rough.field, near + rough.parameters)
    sigma = grid_noise(problem, residual).sigma
    ratio = weight_ratio(problem, sigma, theta.noise.sigma, y)
    normal, right, rest = _angular_on_grid(problem, theta)
    phi_near = near[::3]
    kernel.inverse = _block_inverse(problem, ratio * normal)
    d = d.copy()
    d[::3] += ratio * (length * right - normal @ phi_near)
    found = kernel.solve(b, d, start=rough.field, tolerance=TOLERANCE)
    parameters = np.zeros(system.size)
    parameters[:n] = near + found.parameters
    at, matrix, offset = rest
    parameters[at] = length * offset - matrix @ parameters[:n:3]
    return _raw(found, parameters, rough.iterations)


def _raw(found: Iterated, parameters: np.ndarray, before: int = 0) -> FreeNetworkSolution:
    return FreeNetworkSolution(
        found.field, parameters, None, np.zeros((0, 0)),
        {"method": "conjugate gradients", "iterations": before + found.iterations,
         "relative_residual": found.relative_residual})


def _block_inverse(problem: Problem, of_phi: np.ndarray) -> np.ndarray:
    """Return the pseudo-inverse of the misalignments' block plus `of_phi` on the rotations."""
    grid = problem.system.grid
    block = grid.block.copy()
    block[::3, ::3] += of_phi
    null = np.linalg.qr(grid.rigid[4:].T)[0]
    scale = float(np.trace(block))
    held = scale * (null @ null.T)
    return np.linalg.inv(block + held) - held / scale**2


def _angular_on_grid(problem: Problem, theta: AngularPart) -> tuple:
    """Return the angular equations of phi of the grid views, and the relation to the other phi.

    Returns
    -------
    normal, right : arrays
        Over the grid views; phi of purely angular views eliminated.
    rest : tuple
        Indices of the other phi among the misalignments, and matrix and offset (rad) of
        phi = offset - matrix @ phi of the grid views.
    """
    system, schur = problem.system, problem.system.angular.schur
    n_views = system.grid.n_views
    shared = np.flatnonzero(system.phi_at < 3 * n_views)
    other = np.flatnonzero(system.phi_at >= 3 * n_views)
    inverse = np.linalg.pinv(schur[np.ix_(other, other)], hermitian=True)
    coupling = inverse @ schur[np.ix_(other, shared)]
    rows = system.phi_at[shared] // 3
    normal, right = np.zeros((n_views, n_views)), np.zeros(n_views)
    normal[np.ix_(rows, rows)] = (schur[np.ix_(shared, shared)]
                                  - schur[np.ix_(shared, other)] @ coupling)
    right[rows] = theta.d[shared] - coupling.T @ theta.d[other]
    matrix = np.zeros((len(other), n_views))
    matrix[:, rows] = coupling
    return normal, right, (system.phi_at[other], matrix, inverse @ theta.d[other])
