# SPDX-License-Identifier: Apache-2.0
"""The covariance of a map from the fit itself, as an oracle of what a result saves of it."""

from dataclasses import dataclass, replace

import numpy as np

from selfcal_ros.estimation.datum.covariance import MapsCovariance as Covariance
from selfcal_ros.estimation.joint.solve import fit_joint
from selfcal_ros.estimation.options import Options
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.readings import Measurements, Sense


@dataclass(frozen=True, eq=False)
class MapCovariance:
    """Covariance of the XY map of one calibration; `field` is for a noise of 1."""

    artifact: Artifact
    field: Covariance
    sigma_m: float
    sense: Sense

    def of(self, rows: np.ndarray) -> np.ndarray:
        """Return the covariance (k, k), m^2, of linear functions (k, 2, nx, ny) of the map."""
        flat = rows[:, 0] + 1j * rows[:, 1]
        if self.sense is Sense.PLATE_MOVES:
            flat = -flat[:, ::-1, ::-1]
        return self.field.of(flat) * self.sigma_m**2

    def nodes(self, i: np.ndarray, j: np.ndarray) -> np.ndarray:
        """Return the covariance (2k, 2k) of Gx, then Gy, at the sites [i, j], m^2."""
        count = len(i)
        rows = np.zeros((2, count, 2, *self.artifact.shape))
        for axis in range(2):
            rows[axis, np.arange(count), axis, i, j] = 1.0
        return self.of(rows.reshape(2 * count, 2, *self.artifact.shape))


def map_covariance(measurements: Measurements, options: Options) -> MapCovariance:
    """Return the covariance of the map that `calibrate` gives for the same arguments."""
    model = fit_joint(measurements, replace(options, uncertainty=True))
    problem, found = model.problem, model.fitted
    field = Covariance(
        problem.system,
        found.inverse,
        options.reference,
        terms=model.equations,
        half_width_m=problem.half_width_m,
        sigma_m=found.xy.sigma,
    )
    return MapCovariance(
        measurements.artifact, field, found.xy.sigma, measurements.sense
    )
