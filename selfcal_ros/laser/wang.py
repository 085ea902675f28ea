# SPDX-License-Identifier: Apache-2.0
"""The conventional formulation (Wang): nominal laser directions, eqs. 1 and 2 of the source.

Valid only if the laser lies along the nominal diagonals and the mirror stands square to it.
*Erratum*: eq. 1 is printed with its rows for R_y,pp and R_y,np exchanged.
"""

from collections.abc import Callable, Collection

import numpy as np

from selfcal_ros.errors import InputError
from selfcal_ros.estimation.blas_threads import one_thread
from selfcal_ros.laser.data import (
    Closure,
    Form,
    Method,
    StepDiagonal,
    StepDiagonalResult,
    step_vectors,
    turn_to_first_step,
)
from selfcal_ros.laser.published_equations import Erratum
from selfcal_ros.laser.readings.noise import reading_covariance, reading_noise
from selfcal_ros.model.statistics import rms

EQUAL_RELATIVE = 1e-12
"""Readings closer than this are the same number."""


def laser_directions(data: StepDiagonal) -> np.ndarray:
    """Return the nominal laser directions (eq. 2), (K, D): +-step_j over the diagonal."""
    steps = np.array(data.steps_m)
    return data.signs * steps / np.linalg.norm(steps)


EQUAL_READINGS = ("the readings of all axes are equal in every block: either the linear errors of "
                  "the axes are the same, or the mirror is parallel to the other diagonal and they "
                  "hold only the length of the diagonal")


def readings_are_equal(data: StepDiagonal) -> bool:
    """Return whether all axes read the same in each of two or more blocks, with equal steps.

    A mirror adjusted parallel to the other diagonal does that, and the step diagonal then tells
    only diagonal lengths (source, "Misalignment of mirror directions"); so do axes with the same
    linear errors (source, Table 1 b).
    """
    r = data.readings_m
    same = np.ptp(r, axis=1) <= EQUAL_RELATIVE * np.abs(r).max()
    return bool(data.n_blocks > 1 and np.ptp(data.steps_m) == 0 and same.all())


def block_gain(data: StepDiagonal) -> np.ndarray:
    """Return what takes the readings of an axis in a block to its step, (D, n, D, K).

    Eq. 1 splits into one small system for each axis: 2D two readings for two components, 3D
    four for three, by least squares weighted by the repeats.
    """
    directions = data.signs[:, :, None] * laser_directions(data)[:, None, :]
    weights = np.sqrt(data.counts).transpose(1, 2, 0)
    weighted = directions.transpose(1, 0, 2)[:, None] * weights[..., None]
    return np.linalg.pinv(weighted) * weights[:, :, None, :]


def solve_blocks(data: StepDiagonal, readings_m: np.ndarray, gain: np.ndarray,
                 errata: Collection[Erratum] = ()) -> np.ndarray:
    """Return the errors (D, n, D) that solve eq. 1 block by block, turned to the first X step."""
    if Erratum.EQ1_ROWS in errata:
        readings_m = readings_m.copy()
        readings_m[:, 1] = readings_m[::-1, 1]
    vectors = np.einsum("jick,kji->jic", gain, readings_m)
    return turn_to_first_step(vectors) - step_vectors(data.steps_m, np.zeros_like(vectors))


@one_thread()
def identify_wang(data: StepDiagonal, *, errata: Collection[Erratum] = ()) -> StepDiagonalResult:
    """Identify all errors from the readings alone, trusting the nominal laser directions.

    Parameters
    ----------
    data : StepDiagonal
        All diagonals; linear errors are not used.
    errata : collection of Erratum
        Errors of the printed equations to put back, for comparison.

    Returns
    -------
    StepDiagonalResult
        ``closure`` has the least squares' residual in 3D; in 2D nothing is redundant.

    Raises
    ------
    InputError
        If a diagonal is missing.
    """
    if len(data.diagonals) < 2 ** (data.dim - 1):
        raise InputError("diagonals", f"only {', '.join(data.diagonals)} measured",
                         "the conventional formulation needs every diagonal; measure the others")
    readings, gain = data.readings_m, block_gain(data)
    errors = solve_blocks(data, readings, gain, errata)
    covariance = None
    noise = reading_noise(data)
    if noise.dof:
        jac = jacobian(lambda r: solve_blocks(data, r, gain, errata), readings)
        covariance = jac @ reading_covariance(data, noise) @ jac.T
    return StepDiagonalResult(data.steps_m, errors, covariance, Method.CONVENTIONAL,
                              Form.PRINTED, {}, Closure(residual_rms_m=_residual(data, readings)))


def _residual(data: StepDiagonal, readings_m: np.ndarray) -> float | None:
    if data.dim == 2:
        return None
    directions = data.signs[:, :, None] * laser_directions(data)[:, None, :]
    misfit = [readings_m[:, j] - directions[:, j] @ np.linalg.lstsq(
        directions[:, j], readings_m[:, j], rcond=None)[0] for j in range(data.dim)]
    return rms(np.array(misfit))


def jacobian(function: Callable[[np.ndarray], np.ndarray], x: np.ndarray,
             step_m: float = 1e-7) -> np.ndarray:
    """Return d function / d x by central differences, (outputs, inputs) in C order.

    The formulations are linear but for terms of (error / step)^2, so that the differences are
    exact to far below what an uncertainty needs.
    """
    columns = []
    for index in range(x.size):
        shift = np.zeros(x.size)
        shift[index] = step_m
        up, down = (function(x + sign * shift.reshape(x.shape)) for sign in (1, -1))
        columns.append((up - down).ravel() / (2 * step_m))
    return np.array(columns).T
