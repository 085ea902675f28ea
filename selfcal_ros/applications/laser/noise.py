# SPDX-License-Identifier: Apache-2.0
"""The noise of readings, from their repeats, and the closures of a redundant measurement.

A reading of a step is the difference of two laser distances. If the distances are noisy,
neighbouring readings in time share one distance and their correlation is -1/2; for independent
readings it is 0. The correlation is estimated from the repeats and used, because
profiles and squareness are sums of readings. What whole runs scatter by beyond that (the air, a
machine that grows) is a change of scale from run to run, which adds up over all blocks.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.fft import dst
from scipy.stats import f as f_distribution

from selfcal_ros.applications.laser.adjust import Adjusted
from selfcal_ros.applications.laser.data import DIAGONALS, StepDiagonal
from selfcal_ros.errors import InputError
from selfcal_ros.estimation.joint.problem import coverage_factor
from selfcal_ros.model.error_map import rms
from selfcal_ros.units import MM_PER_M


@dataclass(frozen=True)
class ReadingNoise:
    """Noise of one reading.

    Attributes
    ----------
    sigma_m : float
        Standard deviation, pooled over blocks; NaN without repeats.
    correlation : float
        Correlation of successive readings, -0.5 to 0.
    dof : int
        Degrees of freedom of sigma.
    run_m : float
        Standard deviation of the length of a run beyond that of its readings, as if well known.
    run_dof : int
        Degrees of freedom of `run_m`; 0 where readings explain the lengths.
    """

    sigma_m: float
    correlation: float = 0.0
    dof: int = 0
    run_m: float = 0.0
    run_dof: int = 0


def time_order(signs: np.ndarray, n_blocks: int) -> np.ndarray:
    """Return the flat index j*n + i of the readings of one diagonal in order of time.

    Parameters
    ----------
    signs : float array (D,)
        Running sense of the axes: where it is -1 the last block comes first.
    """
    i = np.arange(n_blocks)
    blocks = np.array([i if sign > 0 else i[::-1] for sign in signs])
    return (blocks + n_blocks * np.arange(len(signs))[:, None]).T.ravel()


def reading_noise(data: StepDiagonal) -> ReadingNoise:
    """Return the noise of the laser readings of a measurement, from the scatter of repeats."""
    deviation = data.samples_m - data.readings_m
    order = [time_order(signs, data.n_blocks) for signs in data.signs]
    runs = np.stack(
        [
            deviation[:, k].reshape(len(deviation), -1)[:, order[k]]
            for k in range(len(order))
        ],
        axis=1,
    )
    largest = float(np.abs(data.readings_m).max())
    return _pooled(runs.reshape(len(deviation), len(order), -1), largest)


def linear_noise(data: StepDiagonal) -> ReadingNoise:
    """Return the noise of the directly measured linear errors, from the scatter of repeats."""
    if data.linear_m is None:
        return ReadingNoise(float("nan"))
    largest = float(np.abs(data.linear_mean_m).max())
    return _pooled(data.linear_m - data.linear_mean_m, largest)


ROUNDING = 1e-14
"""Deviations from a mean below this, relative to the largest, are those of its rounding."""
RUN_DOUBT = 0.1
"""Probability of run lengths that scatter so much by the noise of readings; less tells a scale."""


def _pooled(runs: np.ndarray, largest_m: float) -> ReadingNoise:
    """Return the noise of deviations from means, (repeats, series, time); NaN = not measured."""
    runs = np.where(np.abs(runs) <= ROUNDING * largest_m, 0.0, runs)
    counts = np.isfinite(runs).sum(axis=0)
    dof = int((counts - 1).sum())
    if dof == 0:
        return ReadingNoise(float("nan"))
    variance = float(np.nansum(runs**2)) / dof
    # Neighbours in time can be paired only if every repeat is a complete run; the series may
    # have different numbers of repeats.
    complete = np.isfinite(runs).all(axis=2)
    if (
        variance == 0
        or np.any(np.isfinite(runs).any(axis=2) & ~complete)
        or runs.shape[2] < 2
    ):
        return ReadingNoise(float(np.sqrt(variance)), 0.0, dof)
    runs = np.nan_to_num(runs)
    run_dof = int((complete.sum(axis=0) - 1).sum())
    correlation, variance = _likeliest(runs, run_dof)
    length = float(np.sum(runs.sum(axis=2) ** 2)) / run_dof
    by_readings = variance * _sum_of_band(runs.shape[2], correlation)
    if f_distribution.sf(length / by_readings, run_dof, dof - run_dof) > RUN_DOUBT:
        return ReadingNoise(float(np.sqrt(variance)), correlation, dof)
    level = runs - runs.mean(axis=2, keepdims=True)
    correlation, variance = _likeliest(level, run_dof)
    size = runs.shape[2]
    variance *= size / (size - _sum_of_band(size, correlation) / size)
    by_readings = variance * _sum_of_band(size, correlation)
    few = coverage_factor(run_dof) / coverage_factor(math.inf)
    return ReadingNoise(
        float(np.sqrt(variance)),
        correlation,
        dof - run_dof,
        few * float(np.sqrt(max(length - by_readings, 0.0))),
        run_dof,
    )


def _sum_of_band(size: int, correlation: float) -> float:
    """Return the variance of the sum of readings of variance 1."""
    return size + 2 * correlation * (size - 1)


def _likeliest(runs: np.ndarray, dof: int) -> tuple[float, float]:
    """Return the maximum-likelihood correlation of neighbours and variance.

    `runs` are deviations from the mean of their series, with `dof` degrees of freedom at each time.
    The covariance is variance * (1 + correlation on both neighbouring diagonals); the sine
    transform (DST-I) diagonalises it, with eigenvalues 1 + 2 correlation cos(pi k / (N + 1)). Sums
    of many readings depend on the smallest of these, which the lag-1 moment estimates badly.
    """
    size = runs.shape[2]
    power = np.sum(dst(runs, type=1, norm="ortho") ** 2, axis=(0, 1)) / dof
    cosines = 2 * np.cos(np.pi * np.arange(1, size + 1) / (size + 1))
    grid = np.linspace(-0.5, 0.0, 501)[:, None]
    eigenvalues = 1 + grid * cosines
    variances = np.mean(power / eigenvalues, axis=1)
    cost = np.log(variances) + np.mean(np.log(eigenvalues), axis=1)
    best = int(np.argmin(cost))
    return float(grid[best, 0]), float(variances[best])


def reading_covariance(data: StepDiagonal, noise: ReadingNoise) -> np.ndarray:
    """Return the covariance of the mean readings in C order, (K*D*n, K*D*n), m^2."""
    size = data.dim * data.n_blocks
    out = np.zeros((len(data.diagonals) * size,) * 2)
    for k, signs in enumerate(data.signs):
        order = time_order(signs, data.n_blocks)
        index = k * size + order
        share = data.readings_m[k].ravel()[order] / data.readings_m[k].sum()
        out[np.ix_(index, index)] = _band(data.counts[k].ravel()[order], share, noise)
    return out


def linear_covariance(data: StepDiagonal, noise: ReadingNoise) -> np.ndarray:
    """Return the covariance of the mean linear errors in C order, (D*n, D*n), m^2."""
    assert data.linear_m is not None, "asked for where linear errors were not measured"
    counts = np.isfinite(data.linear_m).sum(axis=0)
    out = np.zeros((counts.size,) * 2)
    for j, count in enumerate(counts):
        rows = slice(j * data.n_blocks, (j + 1) * data.n_blocks)
        share = np.full(data.n_blocks, 1 / data.n_blocks)
        out[rows, rows] = _band(count, share, noise)
    return out


def _band(counts: np.ndarray, share: np.ndarray, noise: ReadingNoise) -> np.ndarray:
    """Return the covariance of means of `counts` readings, each its `share` of the run's length."""
    sigma = noise.sigma_m / np.sqrt(counts)
    band = np.eye(len(counts))
    band += noise.correlation * (np.eye(len(counts), k=1) + np.eye(len(counts), k=-1))
    run = noise.run_m * share / np.sqrt(counts)
    return band * np.outer(sigma, sigma) + np.outer(run, run)


LENGTH_TOLERANCE = 1e-3
"""Largest relative disagreement of diagonals and linear errors from the set-up: laser
or mirror misaligned by about 30 mrad."""


def propagated(
    data: StepDiagonal, by_readings: np.ndarray, by_linear: np.ndarray
) -> np.ndarray | None:
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
    mean = rms(diagonals)
    side = float(np.linalg.norm(sides))
    by_readings = np.repeat(
        diagonals / (len(diagonals) * mean), data.dim * data.n_blocks
    )
    by_linear = -np.repeat(sides / side, data.n_blocks)
    variance = propagated(data, by_readings[None], by_linear[None])
    return mean - side, None if variance is None else float(np.sqrt(variance[0, 0]))


def between_diagonals(
    data: StepDiagonal, by_diagonal: list[Adjusted]
) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the errors from pp alone minus those from np alone, and their uncertainties.

    Parameters
    ----------
    data : StepDiagonal
        Both diagonals.
    by_diagonal : list of Adjusted
        Solutions of the single diagonals, in the order of `data`.
    """
    first, second = by_diagonal
    difference = first.errors_m - second.errors_m
    by_readings = np.hstack([first.by_readings, -second.by_readings])
    covariance = propagated(data, by_readings, first.by_linear - second.by_linear)
    if covariance is None:
        return difference, None
    return difference, np.sqrt(np.maximum(np.diag(covariance), 0.0)).reshape(
        difference.shape
    )


CONTRADICTION = 1e-4
"""Probability of residuals that noise does not explain."""


def residuals_by_noise(
    data: StepDiagonal, adjusted: Adjusted
) -> tuple[float, float] | None:
    """Return the rms residual that noise leaves, m, and the probability of those found.

    None without repeats.
    """
    covariance = propagated(
        data, adjusted.residuals_by_readings, adjusted.residuals_by_linear
    )
    if covariance is None or not covariance.any():
        return None
    expected = float(np.trace(covariance))
    dof = expected**2 / float(np.sum(covariance**2))
    squares = float(np.sum(adjusted.residuals_m**2))
    noises = (reading_noise(data), linear_noise(data))
    dof_noise = min(noise.dof for noise in noises if noise.dof)
    probability = float(f_distribution.sf(squares / expected, dof, dof_noise))
    return float(np.sqrt(expected / adjusted.residuals_m.size)), probability


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
    disagreement = (
        f"diagonals and linear errors disagree by "
        f"{excess[worst] * np.linalg.norm(steps) * MM_PER_M:.4g} mm"
    )
    if abs(smaller) < 0.1 * abs(excess[worst]):
        raise InputError(
            f"block {worst + 1}",
            disagreement + "; the linear errors look like micrometres",
            "give ex_x, ey_y in mm",
        )
    raise InputError(
        f"block {worst + 1}",
        disagreement,
        "check the steps, the units, and that both are of one machine",
    )


def _excess(square: np.ndarray, sides: np.ndarray) -> np.ndarray:
    return np.sqrt(square / np.sum(sides**2, axis=0)) - 1.0
