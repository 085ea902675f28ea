# SPDX-License-Identifier: Apache-2.0
"""The noise of readings, from their repeats.

A reading of a step is the difference of two laser distances. If the distances are noisy,
neighbouring readings in time share one distance and their correlation is -1/2; for independent
readings it is 0. The correlation is estimated from the repeats and used, because
profiles and squareness are sums of readings.
"""

from dataclasses import dataclass

import numpy as np
from scipy.fft import dst

from selfcal_ros.laser.data import StepDiagonal


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
    """

    sigma_m: float
    correlation: float = 0.0
    dof: int = 0


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
    runs = np.stack([deviation[:, k].reshape(len(deviation), -1)[:, order[k]]
                     for k in range(len(order))], axis=1)
    return _pooled(runs.reshape(len(deviation), len(order), -1))


def linear_noise(data: StepDiagonal) -> ReadingNoise:
    """Return the noise of the directly measured linear errors, from the scatter of repeats."""
    if data.linear_m is None:
        return ReadingNoise(float("nan"))
    return _pooled(data.linear_m - data.linear_mean_m)


def _pooled(runs: np.ndarray) -> ReadingNoise:
    """Return the noise of deviations from means, (repeats, series, time); NaN = not measured."""
    counts = np.isfinite(runs).sum(axis=0)
    dof = int((counts - 1).sum())
    if dof == 0:
        return ReadingNoise(float("nan"))
    variance = float(np.nansum(runs**2)) / dof
    # Neighbours in time can be paired only if every repeat is a complete run; the series may
    # have different numbers of repeats.
    complete = np.isfinite(runs).all(axis=2)
    if variance == 0 or np.any(np.isfinite(runs).any(axis=2) & ~complete) or runs.shape[2] < 2:
        return ReadingNoise(float(np.sqrt(variance)), 0.0, dof)
    correlation, variance = _likeliest(np.nan_to_num(runs), int((complete.sum(axis=0) - 1).sum()))
    return ReadingNoise(float(np.sqrt(variance)), correlation, dof)


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
        index = k * size + time_order(signs, data.n_blocks)
        out[np.ix_(index, index)] = _band(data.counts[k].ravel()[index - k * size], noise)
    return out


def linear_covariance(data: StepDiagonal, noise: ReadingNoise) -> np.ndarray:
    """Return the covariance of the mean linear errors in C order, (D*n, D*n), m^2."""
    assert data.linear_m is not None, "asked for where linear errors were not measured"
    counts = np.isfinite(data.linear_m).sum(axis=0)
    out = np.zeros((counts.size,) * 2)
    for j, count in enumerate(counts):
        rows = slice(j * data.n_blocks, (j + 1) * data.n_blocks)
        out[rows, rows] = _band(count, noise)
    return out


def _band(counts: np.ndarray, noise: ReadingNoise) -> np.ndarray:
    sigma = noise.sigma_m / np.sqrt(counts)
    band = np.eye(len(counts))
    band += noise.correlation * (np.eye(len(counts), k=1) + np.eye(len(counts), k=-1))
    return band * np.outer(sigma, sigma)
