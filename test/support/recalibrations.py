# SPDX-License-Identifier: Apache-2.0
"""How a calibration answers to each of its readings: the oracle of its uncertainties.

With a fixed plan and fixed weights the solution is linear in the readings. One solve for each
reading moved then tells the covariance exactly, where draws of noise would tell it to a few per
cent; and any number of draws is one product.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from selfcal_ros.model.readings import Measurements


def values_of(readings: Measurements) -> np.ndarray:
    """Return all readings in one row: dx, dy, dtheta of each view."""
    return np.concatenate(
        [part for v in readings.views for part in (v.dx, v.dy, v.dtheta)]
    )


def with_values(readings: Measurements, values: np.ndarray) -> Measurements:
    """Return the readings with other values, in the order of `values_of`."""
    views, at = [], 0
    for view in readings.views:
        n, k = len(view.m), len(view.k)
        dx, dy, dtheta = np.split(values[at : at + 2 * n + k], [n, 2 * n])
        views.append(replace(view, dx=dx, dy=dy, dtheta=dtheta))
        at += 2 * n + k
    return replace(readings, views=tuple(views))


def sizes_of(readings: Measurements, sigma_m: float, sigma_rad: float) -> np.ndarray:
    """Return the standard deviation of each reading, a mean over its repeats."""
    return np.concatenate(
        [
            part
            for v in readings.views
            for part in (
                *2 * [np.broadcast_to(sigma_m / np.sqrt(v.count), len(v.m))],
                np.broadcast_to(sigma_rad / np.sqrt(v.count_theta), len(v.k)),
            )
        ]
    )


def responses(
    solve: Callable[[Measurements], np.ndarray],
    readings: Measurements,
    steps: np.ndarray,
) -> np.ndarray:
    """Return what a step of each reading adds to the solution, (readings, numbers)."""
    values, start = values_of(readings), solve(readings)
    return np.array(
        [solve(with_values(readings, values + row)) - start for row in np.diag(steps)]
    )
