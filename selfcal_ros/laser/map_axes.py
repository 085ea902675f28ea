# SPDX-License-Identifier: Apache-2.0
"""The axes of an error map beside the straightness that the laser found.

Both are seen as E = actual - nominal (a map's G is the opposite), along the middle line of the map,
and without their least-squares line: what is left does not depend on the datum of either.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from selfcal_ros.errors import InputError
from selfcal_ros.model.error_map import ErrorMap

MM = 1e-3
_PROFILES = {"x": "py_x", "y": "px_y"}


@dataclass(frozen=True, eq=False)
class AxisComparison:
    """Straightness of one axis by the map and by the laser, at the laser's positions.

    Attributes
    ----------
    axis : str
        "x" (error in Y along X) or "y" (error in X along Y).
    position_m : float array (P,)
        Positions in the stage frame, m.
    of_map_m, of_laser_m : float array (P,)
        Transverse errors without their lines, m.
    """

    axis: str
    position_m: np.ndarray
    of_map_m: np.ndarray
    of_laser_m: np.ndarray

    @property
    def straightness_map_m(self) -> float:
        """Peak to valley by the map, m."""
        return float(np.ptp(self.of_map_m))

    @property
    def straightness_laser_m(self) -> float:
        """Peak to valley by the laser, m."""
        return float(np.ptp(self.of_laser_m))

    @property
    def rms_m(self) -> float:
        """Root mean square of laser less map, m."""
        return float(np.sqrt(np.mean((self.of_laser_m - self.of_map_m) ** 2)))


def compare_axes(error_map: ErrorMap, laser: Mapping[str, Any], where: str, *,
                 start_m: tuple[float, float] | None = None) -> list[AxisComparison]:
    """Compare the straightness of X and Y of a map with a step-diagonal measurement.

    Parameters
    ----------
    error_map : ErrorMap
        The map.
    laser : mapping
        OUT.json of `selfcal step-diagonal`; its ``profiles`` are read, mm.
    where : str
        Name of that file, for messages.
    start_m : tuple of float, optional
        Place of the start of the first block in the stage frame; None: the measured range is
        centred on the field.

    Raises
    ------
    InputError
        If the profiles are missing, reach beyond the field, or the map is unknown there.
    """
    out = []
    for index, (axis, name) in enumerate(_PROFILES.items()):
        try:
            profile = laser["profiles"][name]
            position = np.array(profile["position"], dtype=float) * MM
            error = np.array(profile["error"], dtype=float) * MM
        except (KeyError, TypeError, ValueError) as fault:
            raise InputError(where, f"no profile {name}", "give an OUT.json that `selfcal "
                             "step-diagonal` wrote") from fault
        place = position + (-position[-1] / 2 if start_m is None else start_m[index])
        out.append(AxisComparison(axis, place, _straight(place, _along(error_map, axis, place)),
                                  _straight(place, error)))
    return out


def _along(error_map: ErrorMap, axis: str, place_m: np.ndarray) -> np.ndarray:
    """Return -G across the middle line of the map, between its sites by straight lines."""
    artifact = error_map.artifact
    hx, hy = artifact.half
    sites, g = ((artifact.x_m[:, hy], error_map.gy[:, hy]) if axis == "x"
                else (artifact.y_m[hx], error_map.gx[hx]))
    edge = 1e-6 * artifact.grid_pitch_m
    if place_m.min() < sites[0] - edge or place_m.max() > sites[-1] + edge:
        raise InputError(f"{axis} axis", f"the laser's range of {np.ptp(place_m) / MM:g} mm "
                         "reaches beyond the field of the map",
                         "say where the first block starts")
    values = np.interp(place_m, sites, -g)
    if not np.isfinite(values).all():
        raise InputError(f"{axis} axis", "sites on the middle line of the map are unknown",
                         "measure them")
    return values


def _straight(place_m: np.ndarray, values_m: np.ndarray) -> np.ndarray:
    x = place_m - place_m.mean()
    return values_m - values_m.mean() - x * (x @ values_m) / (x @ x)
