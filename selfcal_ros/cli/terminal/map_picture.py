# SPDX-License-Identifier: Apache-2.0
"""A small picture of an error map in letters, for a terminal."""

import numpy as np

from selfcal_ros.cli.screen import SHADES
from selfcal_ros.model.error_map import ErrorMap
from selfcal_ros.units import UM_PER_M

MOST = 27
"""Sites along a side; of larger fields every second, third, ... is shown."""


def map_picture(emap: ErrorMap) -> list[str]:
    """Return the length of the error at the sites as shades, y upwards; ``?`` = not known."""
    artifact = emap.artifact
    step = max(1, -(-max(artifact.shape) // MOST))
    sites = tuple(slice(half % step, None, step) for half in artifact.half)
    length = np.hypot(emap.gx, emap.gy)[sites] * UM_PER_M
    known = np.isfinite(length)
    most = float(length[known].max()) if known.any() else 0.0
    part = np.where(known, length, 0.0) / (most or 1.0)
    level = np.minimum((part * len(SHADES)).astype(int), len(SHADES) - 1)
    rows = [" ".join(SHADES[k] if good else "?" for k, good in zip(levels, goods, strict=True))
            for levels, goods in zip(level.T[::-1].tolist(), known.T[::-1].tolist(), strict=True)]
    return [f"  {row}" for row in rows] + [
        f"  length of the error: from ' ' = 0 to '{SHADES[-1]}' = {most:.3g} µm; x to the right, "
        "y upwards"]
