# SPDX-License-Identifier: Apache-2.0
"""A calibrated stage in your own program: commands, true positions, their uncertainty.

>>> stage = load("RESULT.json")
>>> x_command, y_command = stage.command(0.010, -0.020)   # to be truly at (10, -20) mm
>>> x_true, y_true = stage.correct(x_indicated, y_indicated)
"""

import os

import numpy as np
from numpy.typing import ArrayLike

from selfcal_ros.compensation.cells import Interpolation, Outside
from selfcal_ros.compensation.compensator import Compensator
from selfcal_ros.errors import InputError, NotIdentifiableError
from selfcal_ros.estimation.comparison.covariance import xy_covariance
from selfcal_ros.files import read_json
from selfcal_ros.model.result import CalibrationResult, result_from_dict

MAX_POINTS = 2000
"""Largest number of points of a covariance matrix: 128 MB."""


class StageMap(Compensator):
    """The error map of a result, with the covariance of any set of points.

    Parameters
    ----------
    result : CalibrationResult
        The calibration; `result.verdict` states whether it is qualified.
    method, outside : str
        As for `Compensator`.

    Raises
    ------
    NotIdentifiableError
        If the measured plan does not identify the stage.
    InputError
        As `Compensator`.
    """

    def __init__(self, result: CalibrationResult, *, method: Interpolation = "bilinear",
                 outside: Outside = "clamp") -> None:
        if not result.observability.identifiable:
            raise NotIdentifiableError("the measured plan does not identify the stage; measure "
                                       "the missing views", result.observability)
        super().__init__(result.error_map, method=method, outside=outside)
        self.result = result

    def covariance(self, x_m: ArrayLike, y_m: ArrayLike) -> np.ndarray:
        """Return the covariance of Gx at all points, then Gy at all points, (2P, 2P), m^2.

        That of the bilinear interpolation at true positions; outside the field, that of the nearest
        point of its edge. The variance of any combination a . (Gx, Gy), such as the distance of
        two points, is a' C a. The stage error between its sites is not included.

        Raises
        ------
        InputError
            For more than `MAX_POINTS` points, a point that needs an unknown site, or a result that
            does not contain the correlations of its sites.
        """
        self._refuse_outside(x_m, y_m)
        x, y = (np.ravel(p) for p in np.broadcast_arrays(np.asarray(x_m, dtype=float),
                                                         np.asarray(y_m, dtype=float)))
        if len(x) > MAX_POINTS:
            raise InputError("covariance", f"{len(x)} points", f"give at most {MAX_POINTS}")
        weights = self._weights(x, y)
        used = weights.any(axis=0)
        if not self.error_map.valid.ravel()[used].all():
            raise InputError("covariance", "a point lies next to an unknown site",
                             "leave the point out, or measure the site")
        sites, is_full = xy_covariance(self.result, used.reshape(self.error_map.artifact.shape))
        if not is_full:
            raise InputError("covariance", "the result does not contain the correlations of its "
                             "sites", "solve again with uncertainties; fields beyond 31 x 31 "
                             "marks have none")
        both = np.kron(np.eye(2), weights[:, used])
        return both @ sites @ both.T

    def _weights(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return the bilinear weights of the sites at points, (P, sites)."""
        out = np.zeros((len(x), *self.error_map.artifact.shape))
        places = []
        for p, count in zip((x, y), out.shape[1:], strict=True):
            s = np.clip(p / self._pitch + (count - 1) / 2, 0, count - 1)
            if np.isnan(s).any():
                raise InputError("covariance", "a position is not a number", "give numbers")
            s = np.where(np.abs(s - np.round(s)) < 1e-9, np.round(s), s)
            i = np.minimum(s.astype(int), count - 2)
            places.append((i, s - i))
        (i, u), (j, v) = places
        row = np.arange(len(x))
        for a, wx in ((0, 1 - u), (1, u)):
            for b, wy in ((0, 1 - v), (1, v)):
                out[row, i + a, j + b] += wx * wy
        return out.reshape(len(x), -1)


def load(path: str | os.PathLike, *, method: Interpolation = "bilinear",
         outside: Outside = "clamp") -> StageMap:
    """Return the calibrated stage of a RESULT.json.

    Raises
    ------
    InputError
        If the file is not a result.
    NotIdentifiableError
        If its plan does not identify the stage.
    """
    return StageMap(result_from_dict(read_json(path), str(path)), method=method, outside=outside)
