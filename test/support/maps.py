# SPDX-License-Identifier: Apache-2.0
"""Error maps and results with known content."""

import numpy as np

from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.error_map import ErrorMap, datum_modes
from selfcal_ros.model.result import (
    ArtifactMap,
    CalibrationResult,
    Noise,
    Observability,
)
from test.support.truth import random_truth


def random_map(
    artifact: Artifact, seed: int, *, unknown: tuple = (), gain: float = 1.0
) -> ErrorMap:
    """Return a random error map, with NaN at the sites (i, j) in `unknown`."""
    rng = np.random.default_rng(seed)
    truth = random_truth(artifact, 0, rng)
    gx, gy = truth.g * gain
    for i, j in unknown:
        gx[i, j] = gy[i, j] = np.nan
    u = rng.uniform(1e-9, 5e-9, (2, *artifact.shape))
    count = artifact.angular_count
    return ErrorMap(artifact, gx, gy, *u, truth.g_theta, rng.uniform(1e-6, 2e-6, count))


def result_of(
    error_map: ErrorMap, *, sense: str = "microscope_moves"
) -> CalibrationResult:
    """Return a result that holds `error_map` and little else."""
    shape, count = error_map.artifact.shape, error_map.artifact.angular_count
    return CalibrationResult(
        "demo",
        error_map,
        ArtifactMap(np.zeros(shape), np.zeros(shape), np.zeros(count)),
        (),
        Observability(1, 1, 0, True),
        Noise(1e-9, 1e-7),
        input={"file": "demo.mcap", "sha256": "ab" * 32},
        sense=sense,
    )


def first_order(artifact, gx_m, gy_m):
    """Return non-orthogonality O and scale difference R of a map (Hu eq. 6).

    Gx = O y + R x + Fx, Gy = O x - R y + Fy, with F free of first-order parts: the
    least-squares coefficients over the known sites.
    """
    x, y = artifact.x_m, artifact.y_m
    shear = np.array([[(y, x), (x, -y)]])[0]
    modes = np.concatenate([datum_modes(artifact, scale=True), shear])
    known = np.isfinite(gx_m) & np.isfinite(gy_m)
    basis = modes[:, :, known].reshape(len(modes), -1).T
    norms = np.linalg.norm(basis, axis=0)
    values = np.concatenate([gx_m[known], gy_m[known]])
    fit = np.linalg.lstsq(basis / norms, values, rcond=None)[0] / norms
    return float(fit[4]), float(fit[5])
