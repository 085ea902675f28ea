# SPDX-License-Identifier: Apache-2.0
"""Error maps and results with known content."""

import numpy as np

from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.error_map import ErrorMap
from selfcal_ros.model.result import ArtifactMap, CalibrationResult, Noise, Observability
from selfcal_ros.simulation.truth import random_truth


def random_map(artifact: Artifact, seed: int, *, unknown: tuple = (),
               gain: float = 1.0) -> ErrorMap:
    """Return a random error map, with NaN at the sites (i, j) in `unknown`."""
    rng = np.random.default_rng(seed)
    truth = random_truth(artifact, 0, rng)
    gx, gy = truth.g * gain
    for i, j in unknown:
        gx[i, j] = gy[i, j] = np.nan
    u = rng.uniform(1e-9, 5e-9, (2, *artifact.shape))
    count = artifact.angular_count
    return ErrorMap(artifact, gx, gy, *u, truth.g_theta, rng.uniform(1e-6, 2e-6, count))


def result_of(error_map: ErrorMap, *, sense: str = "microscope_moves") -> CalibrationResult:
    """Return a result that holds `error_map` and little else."""
    shape, count = error_map.artifact.shape, error_map.artifact.angular_count
    return CalibrationResult(
        "demo", error_map, ArtifactMap(np.zeros(shape), np.zeros(shape), np.zeros(count)), (),
        Observability(1, 1, 0, True), Noise(1e-9, 1e-7),
        input={"file": "demo.mcap", "sha256": "ab" * 32}, sense=sense)
