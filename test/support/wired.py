# SPDX-License-Identifier: Apache-2.0
"""Machines whose controllers have loaded a table rightly or wrongly, measured before and after."""

from dataclasses import replace

import numpy as np

from selfcal_ros.estimation.api import calibrate
from selfcal_ros.model.artifact import Artifact
from test.support.options import bare
from test.support.truth import hu_plan, random_truth, simulate_measurements

ARTIFACT = Artifact(7, 0.01, 12)
SIGMA_M, SIGMA_RAD = 2e-8, 2e-6
FACTORS = (25.4, 10.0, 0.1, 0.5, 2.0)

WRONG = ("sign", "exchanged", "unit", "another", "old", "off")


def smooth_error(rng):
    """Return a smooth error (2, 7, 7), about 0.5 um rms, of waves and of powers, m."""
    u = np.linspace(-1, 1, 7)
    x, y = np.meshgrid(u, u, indexing="ij")
    powers = np.stack([x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3])
    field = np.einsum("ck,kij->cij", rng.normal(0, 0.6e-6, (2, 7)), powers)
    for axis in range(2):
        for along in (x, y):
            field[axis] += rng.normal(0, 0.3e-6) * np.sin(
                rng.uniform(1, 2.5) * np.pi * along + rng.uniform(0, 6)
            )
    return field


def smooth_angle(rng):
    """Return an angular error (12,), rad."""
    angle = np.arange(12) * np.pi / 6
    return sum(
        rng.normal(0, 2e-5) * np.cos(k * angle + rng.uniform(0, 6)) for k in (1, 2, 3)
    )


def calibrated(truth, rng):
    readings = simulate_measurements(
        truth, hu_plan(ARTIFACT), rng, sigma_m=SIGMA_M, sigma_theta_rad=SIGMA_RAD
    )
    return calibrate(readings, bare(causes=False))


def machine(seed, wiring, *, size=1.0):
    """Return the calibrations before and after of a machine with another plate each time.

    `wiring`: "right", or one of `WRONG`; with "exchanged" and "unit" the seed chooses which. Or
    what the controller makes of the table (2, 7, 7). `size`: of the error of x and y.
    """
    rng = np.random.default_rng(seed)
    first = replace(
        random_truth(ARTIFACT, 4, rng),
        g=size * smooth_error(rng),
        g_theta=smooth_angle(rng),
    )
    before = calibrated(first, rng)
    table = np.stack([before.error_map.gx, before.error_map.gy])
    angle = before.error_map.g_theta
    factor = 1.0
    if callable(wiring):
        table = wiring(table)
    elif wiring == "sign":
        factor = -1.0
    elif wiring == "off":
        factor = 0.0
    elif wiring == "unit":
        factor = FACTORS[seed % len(FACTORS)]
    elif wiring == "exchanged":
        by_place = table.transpose(0, 2, 1)
        table = (table[::-1], by_place, by_place[::-1])[seed // 12 % 3]
    elif wiring == "another":
        table, angle = smooth_error(rng), smooth_angle(rng)
    elif wiring == "old":
        table = table + 0.5 * smooth_error(rng)
    after = replace(
        random_truth(ARTIFACT, 4, rng),
        g=first.g - factor * table,
        g_theta=first.g_theta - factor * angle,
    )
    return before, calibrated(after, rng), factor
