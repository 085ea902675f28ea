# SPDX-License-Identifier: Apache-2.0
"""Residuals of the readings of one kind, grid or angular, fitted alone."""

import numpy as np

from selfcal_ros.estimation.normal.equations import NormalEquations


def grid_residuals(system: NormalEquations, y: np.ndarray) -> np.ndarray:
    """Return the residuals of the grid readings `y` (views, nx, ny), fitted alone."""
    grid = system.grid
    free, d = grid.reduced(y)
    parameters = system.grid_inverse @ d
    field = (free - grid.response @ parameters).reshape(grid.views.shape)
    return grid.plate(y, field, parameters)[1]


def angular_residuals(system: NormalEquations, y: np.ndarray) -> np.ndarray:
    """Return the residuals of the angular readings `y` (views, K), fitted alone."""
    angular = system.angular
    if not angular.n_views:
        return np.zeros(y.shape)
    free, d = angular.reduced(y)
    phi = system.angular_inverse @ d
    return angular.plate(y, free - angular.response @ phi, phi)[1]
