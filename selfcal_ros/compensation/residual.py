# SPDX-License-Identifier: Apache-2.0
"""Residuals of a controller with loaded tables."""

from dataclasses import dataclass

import numpy as np

from selfcal_ros.errors import InputError


@dataclass(frozen=True, eq=False)
class Residual:
    """Residuals true - commanded before and after, without their common shift.

    The zero bias of the controller, and the home position itself, move all positions by one
    constant; the calibration does not determine this constant (datum), so it is removed.

    Attributes
    ----------
    place : str
        "sites", "between" or "lines".
    position : float array (axes, P)
        Commanded positions, m or rad.
    before, after : float array (axes, P)
        Residuals without their mean, m or rad.
    shift_before, shift_after : float array (axes,)
        The means that were removed.
    """

    place: str
    position: np.ndarray
    before: np.ndarray
    after: np.ndarray
    shift_before: np.ndarray
    shift_after: np.ndarray

    def rms(self, which: str) -> float:
        """Return the root mean square of the residual vectors `which`: before or after."""
        return float(np.sqrt(np.mean(np.sum(np.square(getattr(self, which)), axis=0))))

    def largest(self, which: str) -> float:
        """Return the length of the largest residual vector `which`: before or after."""
        return float(np.sqrt(np.max(np.sum(np.square(getattr(self, which)), axis=0))))


def residual_of(place: str, position: np.ndarray, reached: list[np.ndarray]) -> Residual:
    """Return the residuals from the positions reached before and after, (axes, P) each."""
    residuals = [true - position for true in reached]
    # A known site next to an unknown one cannot be inverted exactly: omit it.
    known = np.isfinite(residuals).all(axis=(0, 1))
    if not known.any():
        raise InputError("error map", "no site can be verified", "measure more sites")
    residuals = [residual[:, known] for residual in residuals]
    shifts = [residual.mean(axis=1) for residual in residuals]
    before, after = (r - s[:, None] for r, s in zip(residuals, shifts, strict=True))
    return Residual(place, position[:, known], before, after, *shifts)
