# SPDX-License-Identifier: Apache-2.0
"""Step-diagonal readings from the formula of the method, and tables with a fault."""

import numpy as np

from selfcal_ros.laser.data import DIAGONALS, StepDiagonal, signs_of, step_vectors

MM = 1e-3


def linear_of(errors_m):
    """Return E_j(j) of every block, (D, n)."""
    return np.array([errors_m[j, :, j] for j in range(len(errors_m))])


def planar(steps_m, errors_m, *, laser_rad=(0.0, 0.0), mirror_rad=(0.0, 0.0)):
    """Return the 2D readings d . n/(l . n), laser off the machine's own diagonals by an angle."""
    vectors, signs = step_vectors(steps_m, errors_m), signs_of(DIAGONALS[2])
    readings = np.empty((2, 2, errors_m.shape[1]))
    for k in range(2):
        diagonal = np.einsum("j,jic->c", signs[k], vectors)
        laser = np.arctan2(diagonal[1], diagonal[0]) + laser_rad[k]
        mirror = laser + mirror_rad[k]
        normal = np.array([np.cos(mirror), np.sin(mirror)])
        w = normal / (np.cos(laser) * normal[0] + np.sin(laser) * normal[1])
        readings[k] = signs[k][:, None] * np.einsum("c,jic->ji", w, vectors)
    return StepDiagonal(tuple(steps_m), DIAGONALS[2], readings[None], linear_of(errors_m)[None])


def one_block(ex_x, ey_x, ex_y, ey_y):
    """Return the errors of one block, arguments in mm, as (2, 1, 2) in m."""
    return np.array([[[ex_x, ey_x]], [[ex_y, ey_y]]]) * MM


def random_errors(n, rng, sigma_m=1e-7):
    """Return 2D errors (2, n, 2) in the datum: no transverse error of the first X step."""
    errors = rng.normal(0, sigma_m, (2, n, 2))
    errors[0, 0, 1] = 0.0
    return errors
