# SPDX-License-Identifier: Apache-2.0
"""Covariance of a calibration on request, and the uncertainty of its use between the nodes."""

from dataclasses import dataclass, replace

import numpy as np

from selfcal_ros.errors import InputError
from selfcal_ros.estimation.blas_threads import one_thread
from selfcal_ros.estimation.datum.covariance import FieldCovariance
from selfcal_ros.estimation.datum.scale import scale_datum
from selfcal_ros.estimation.joint.solve import fit_joint
from selfcal_ros.estimation.options import Options
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.readings import Measurements, Sense


@dataclass(frozen=True, eq=False)
class MapCovariance:
    """Covariance of the XY map of one calibration.

    Attributes
    ----------
    artifact : Artifact
        Lattice of the map.
    known : bool array (nx, ny)
        Sites whose error is known.
    field : FieldCovariance
        For unit noise, in the frame of the equations.
    sigma_m : float
        Noise of one grid reading, m.
    dof : float
        Degrees of freedom of `sigma_m`; infinite if declared.
    sense : Sense
        Who moved.
    """

    artifact: Artifact
    known: np.ndarray
    field: FieldCovariance
    sigma_m: float
    dof: float
    sense: Sense

    def of(self, rows: np.ndarray) -> np.ndarray:
        """Return the covariance (k, k) of linear functions of the map, m^2.

        Parameters
        ----------
        rows : float array (k, 2, nx, ny)
            Weight of Gx and Gy at every site; 0 where the map is not known.
        """
        flat = rows[:, 0] + 1j * rows[:, 1]
        if self.sense is Sense.PLATE_MOVES:
            flat = -flat[:, ::-1, ::-1]
        with one_thread():
            return self.field.of(flat) * self.sigma_m**2

    def nodes(self, i: np.ndarray, j: np.ndarray) -> np.ndarray:
        """Return the covariance (2k, 2k) of Gx, then Gy, at the sites [i, j], m^2."""
        count = len(i)
        rows = np.zeros((2, count, 2, *self.artifact.shape))
        for axis in range(2):
            rows[axis, np.arange(count), axis, i, j] = 1.0
        return self.of(rows.reshape(2 * count, 2, *self.artifact.shape))

    def between(self, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
        """Return standard uncertainties (k, 2) of the map's bilinear interpolation, m.

        What the stage does between the nodes beside that is not in it.

        Parameters
        ----------
        x_m, y_m : float arrays (k,)
            Positions in the stage frame, m.

        Raises
        ------
        InputError
            If a position lies off the field or beside an unknown site.
        """
        rows = self._bilinear(np.asarray(x_m, dtype=float), np.asarray(y_m, dtype=float))
        count, zero = len(rows), np.zeros_like(rows)
        both = np.concatenate([np.stack([rows, zero], axis=1), np.stack([zero, rows], axis=1)])
        variances = np.diag(self.of(both))
        return np.sqrt(np.maximum(variances, 0.0)).reshape(2, count).T

    def _bilinear(self, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
        at = [value / self.artifact.grid_pitch_m + half
              for value, half in zip((x_m, y_m), self.artifact.half, strict=True)]
        rows = np.zeros((len(x_m), *self.artifact.shape))
        count = np.arange(len(x_m))
        for value, size in zip(at, self.artifact.shape, strict=True):
            if not ((value >= -1e-9) & (value <= size - 1 + 1e-9)).all():
                raise InputError("position", "off the calibrated field", "stay inside the field")
        low = [np.clip(np.floor(v).astype(int), 0, size - 2)
               for v, size in zip(at, self.artifact.shape, strict=True)]
        part = [v - k for v, k in zip(at, low, strict=True)]
        for di in (0, 1):
            for dj in (0, 1):
                weight = (part[0] if di else 1 - part[0]) * (part[1] if dj else 1 - part[1])
                rows[count, low[0] + di, low[1] + dj] += weight
        if np.any(rows[:, ~self.known] != 0):
            raise InputError("position", "beside a site whose error is not known",
                             "stay where the map is known")
        return rows


def map_covariance(measurements: Measurements, options: Options | None = None) -> MapCovariance:
    """Return the covariance of the map that `calibrate` gives for the same arguments.

    Raises
    ------
    NoDataError, NotIdentifiableError, InputError
        As `selfcal_ros.estimation.api.calibrate`; also for a field too large to factorise, and
        for Hu's law, whose map has another covariance.
    """
    options = options or Options()
    if options.method != "joint":
        raise InputError("covariance", f"that of the method '{options.method}' is not known",
                         "calibrate with the method joint")
    wanted = replace(options, uncertainty=True)
    with one_thread():
        model = fit_joint(measurements, wanted)
        problem, found = model.problem, model.found
        scale = (scale_datum(problem.system, options.reference, problem.half_width_m)
                 if options.reference else None)
        field = FieldCovariance(problem.system, found.inverse, scale, found.xy.sigma,
                                model.spread)
    known = problem.system.known_sites
    if measurements.sense is Sense.PLATE_MOVES:
        known = known[::-1, ::-1]
    return MapCovariance(measurements.artifact, known, field, found.xy.sigma, found.xy.dof,
                         measurements.sense)
