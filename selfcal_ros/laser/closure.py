# SPDX-License-Identifier: Apache-2.0
"""Redundancy of a step-diagonal measurement: closures and their uncertainties."""

import numpy as np

from selfcal_ros.errors import InputError
from selfcal_ros.laser.adjust import Adjusted
from selfcal_ros.laser.data import DIAGONALS, StepDiagonal
from selfcal_ros.laser.noise import (
    linear_covariance,
    linear_noise,
    reading_covariance,
    reading_noise,
)
from selfcal_ros.model.statistics import rms
from selfcal_ros.units import MM_PER_M

LENGTH_TOLERANCE = 1e-3
"""Largest relative disagreement of diagonals and linear errors from the set-up: laser
or mirror misaligned by about 30 mrad."""


def propagated(data: StepDiagonal, by_readings: np.ndarray,
               by_linear: np.ndarray) -> np.ndarray | None:
    """Return the covariance of values with these derivatives; None if readings have no repeats.

    Linear errors without repeats are taken as exact.
    """
    noise, linear = reading_noise(data), linear_noise(data)
    if not noise.dof:
        return None
    out = by_readings @ reading_covariance(data, noise) @ by_readings.T
    if linear.dof:
        out += by_linear @ linear_covariance(data, linear) @ by_linear.T
    return out


def is_complete(data: StepDiagonal) -> bool:
    """Return whether all diagonals and the linear errors are present."""
    return data.linear_m is not None and set(data.diagonals) == set(DIAGONALS[data.dim])


def length_closure(data: StepDiagonal) -> tuple[float, float | None] | None:
    """Return the rms of measured minus computed diagonals, m, and its u.

    Parallelogram law: the squares of all diagonals sum to those of the sides, whatever the
    squareness. None if a diagonal or the linear errors are missing; u None without repeats.
    """
    if not is_complete(data):
        return None
    diagonals = data.readings_m.sum(axis=(1, 2))
    sides = data.linear_mean_m.sum(axis=1) + data.n_blocks * np.array(data.steps_m)
    mean, side = rms(diagonals), float(np.linalg.norm(sides))
    by_readings = np.repeat(diagonals / (len(diagonals) * mean), data.dim * data.n_blocks)
    by_linear = -np.repeat(sides / side, data.n_blocks)
    variance = propagated(data, by_readings[None], by_linear[None])
    return mean - side, None if variance is None else float(np.sqrt(variance[0, 0]))


def between_diagonals(data: StepDiagonal,
                      alone: list[Adjusted]) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the errors from pp alone minus those from np alone, and their uncertainties.

    Parameters
    ----------
    data : StepDiagonal
        Both diagonals.
    alone : list of Adjusted
        Solutions of the single diagonals, in the order of `data`.
    """
    one, other = alone
    difference = one.errors_m - other.errors_m
    by_readings = np.hstack([one.by_readings, -other.by_readings])
    covariance = propagated(data, by_readings, one.by_linear - other.by_linear)
    if covariance is None:
        return difference, None
    return difference, np.sqrt(np.maximum(np.diag(covariance), 0.0)).reshape(difference.shape)


def check_lengths(data: StepDiagonal) -> None:
    """Refuse linear errors that do not fit the diagonals, block by block.

    Raises
    ------
    InputError
        If they are missing, or diagonals and sides of a block disagree by more than
        `LENGTH_TOLERANCE`; the message says if micrometres instead of millimetres
        explain it.
    """
    linear = data.linear_mean_m
    if not is_complete(data):
        return
    square = np.mean(data.readings_m.sum(axis=1) ** 2, axis=0)
    steps = np.array(data.steps_m)[:, None]
    excess = _excess(square, steps + linear)
    worst = int(np.argmax(np.abs(excess)))
    if abs(excess[worst]) <= LENGTH_TOLERANCE:
        return
    smaller = _excess(square, steps + 1e-3 * linear)[worst]
    what = (f"diagonals and linear errors disagree by "
            f"{excess[worst] * np.linalg.norm(steps) * MM_PER_M:.4g} mm")
    if abs(smaller) < 0.1 * abs(excess[worst]):
        raise InputError(f"block {worst + 1}", what + "; the linear errors look like micrometres",
                         "give ex_x, ey_y in mm")
    raise InputError(f"block {worst + 1}", what,
                     "check the steps, the units, and that both are of one machine")


def _excess(square: np.ndarray, sides: np.ndarray) -> np.ndarray:
    return np.sqrt(square / np.sum(sides**2, axis=0)) - 1.0
