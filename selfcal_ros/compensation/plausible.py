# SPDX-License-Identifier: Apache-2.0
"""Ask whether a map is that of a stage, before a machine is corrected by it."""

import numpy as np
from numpy.typing import ArrayLike

from selfcal_ros.errors import InputError
from selfcal_ros.model.error_map import ErrorMap
from selfcal_ros.units import MM_PER_M, UM_PER_M

PLAUSIBLE, PLAUSIBLE_M = 0.01, 1e-6
"""Change of the error between neighbouring nodes, in their distance and in m, beyond both of which
it is asked about."""


def require_plausible(
    error_map: ErrorMap, where: str, accept: str = "add --steep"
) -> None:
    """Ask whether a step between neighbouring nodes is real that is larger than `PLAUSIBLE`.

    Raises
    ------
    InputError
        With the step, its place, and what accepts it.
    """
    plate = error_map.artifact
    pitch_m = plate.grid_pitch_m
    limit_m = max(PLAUSIBLE * pitch_m, PLAUSIBLE_M)
    for name, field in (("gx", error_map.gx), ("gy", error_map.gy)):
        for axis in (0, 1):
            steps = np.nan_to_num(np.abs(np.diff(field, axis=axis)))
            i, j = np.unravel_index(np.argmax(steps), steps.shape)
            if steps[i, j] <= limit_m:
                continue
            x, y = plate.x_m[i, j] * MM_PER_M, plate.y_m[i, j] * MM_PER_M
            raise InputError(
                where,
                f"{name} changes by {steps[i, j] * UM_PER_M:.4g} µm from the node at "
                f"({x:g}, {y:g}) mm to the next along {'xy'[axis]}, "
                f"{pitch_m * MM_PER_M:g} mm away: is it real?",
                f"check the readings there; if it is, {accept}",
            )


def require_plausible_line(
    positions_m: ArrayLike, corrections_m: ArrayLike, where: str
) -> None:
    """Ask whether a step of measured values along an axis is real, as `require_plausible`."""
    distances, steps = np.diff(positions_m), np.abs(np.diff(corrections_m))
    most = int(np.argmax(steps / np.maximum(PLAUSIBLE * distances, PLAUSIBLE_M)))
    distance, step = float(distances[most]), float(steps[most])
    if step > max(PLAUSIBLE * distance, PLAUSIBLE_M):
        raise InputError(
            where,
            f"the error changes by {step * UM_PER_M:.4g} µm within "
            f"{distance * MM_PER_M:.4g} mm: is it real?",
            "check the units; if it is, add --steep",
        )
