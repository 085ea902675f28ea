# SPDX-License-Identifier: Apache-2.0
"""Noise of its own along each stage axis: what it makes of the map's uncertainty (method eq. 4.11).

The estimate weights both coordinates alike. If their noises differ it remains unbiased, and the
variance of each node follows from the sensitivities of the map to the readings.
"""

from collections.abc import Callable

import numpy as np
from scipy.special import fdtrc

from selfcal_ros.estimation.datum.covariance import FieldCovariance
from selfcal_ros.estimation.joint.model_fit import ModelFit
from selfcal_ros.estimation.joint.noise import F_LEVEL, MIN_REPEAT_DOF, SAME
from selfcal_ros.estimation.joint.problem import noise_excess

MAX_SITES = 51 * 51
"""Largest field in which the axes are told apart: the time grows with the square of the sites."""

CHUNK = 128
"""Nodes whose sensitivities are computed together."""


def axis_contrast(model: ModelFit) -> float:
    """Return (sx^2 - sy^2) / (sx^2 + sy^2) of the noises along the stage axes.

    By the repeats, or by the residuals if there are few. 0 unless the noises differ (F-test).
    """
    problem = model.problem
    known = [] if model.equations is None else model.equations.columns.at_visits(
        model.coefficients)
    squares, dof = np.zeros(2), 0.0
    for row, visits in enumerate(problem.ground.visits):
        if visits is not None and visits.repeated:
            y = visits.y - (known[row] if known else 0.0)
            rest = visits.about_means(y[None], problem.system.grid.n_marks)[0] / visits.phase
            squares += visits.weight @ np.stack([rest.real, rest.imag], axis=1) ** 2
            dof += len(visits.mark) - len(np.unique(visits.mark))
    if 2 * dof < MIN_REPEAT_DOF:
        rest = model.found.residuals * model.problem.to_stage[:, None, None]
        weight = problem.system.grid.weight
        squares = np.array([(weight * part**2).sum() for part in (rest.real, rest.imag)])
        dof = model.found.xy.dof_residuals / 2
    dof /= noise_excess(problem, model.found.residuals)
    small, large = sorted(squares)
    if not (dof >= 1 and small > 0 and large > SAME**2 * small
            and 2 * float(fdtrc(dof, dof, large / small)) < F_LEVEL):
        return 0.0
    return float((squares[0] - squares[1]) / squares.sum())


def axis_variances(model: ModelFit, cover: FieldCovariance) -> np.ndarray:
    """Return what noise along x in place of y adds to the variances, (2, nx, ny), for unit noise.

    The variance of a node is then that of equal noises plus `axis_contrast` times this.
    """
    turn = model.problem.to_stage[:, None, None] ** 2
    weight = model.problem.system.grid.weight
    return added_variances(model, cover, lambda rest: np.einsum(
        "vij,kvij->k", weight, (turn * rest**2).real))


def added_variances(model: ModelFit, cover: FieldCovariance,
                    of: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """Return `of` the sensitivities of each coordinate of the map, (2, nx, ny).

    Parameters
    ----------
    model, cover : ModelFit, FieldCovariance
        The fit, and the covariance of its map.
    of : callable
        Sensitivities of k coordinates to the readings, over their weights, plate frame, complex
        (k, views, nx, ny) -> k variances for unit noise.
    """
    grid = model.problem.system.grid
    columns = None if model.equations is None else model.equations.columns.grid
    out = np.zeros((2, grid.n_sites))
    for values, unit in zip(out, (1, 1j), strict=True):
        for start in range(0, grid.n_sites, CHUNK):
            rows = unit * np.eye(CHUNK, grid.n_sites, start)[:grid.n_sites - start]
            field, parameters, terms = cover.solved(rows.T)
            y = np.zeros(1) if columns is None else np.tensordot(terms.T, columns, axes=1)
            rest = grid.plate(-y, field.T.reshape(-1, *grid.views.shape), parameters.T)[1]
            values[start:start + CHUNK] = of(rest)
    return out.reshape(2, *grid.views.shape)
