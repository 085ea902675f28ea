# SPDX-License-Identifier: Apache-2.0
"""Plans by name and truths moved to the datum of what was found."""

from math import pi

import numpy as np

from selfcal_ros.estimation.datum.modes import datum_modes, remove_modes
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.view import Plan, View

POSES = {"0": (0, 0, 0), "90": (1, 0, 0), "180": (2, 0, 0), "270": (3, 0, 0), "+tx": (0, 1, 0),
         "tx": (0, 1, 0), "-tx": (0, -1, 0), "ty": (0, 0, 1), "90+tx": (1, 1, 0),
         "270-2tx+ty": (3, -2, 1), "2ty": (0, 0, 2)}


def plan_of(names: str, artifact: Artifact, *, lines: int | None = None) -> Plan:
    """Return the plan of comma-separated poses; `lines` adds an angular view turned so far."""
    pitch, angular = artifact.grid_pitch_m, artifact.angular_count > 0
    views = []
    for name in names.split(","):
        q, a, b = POSES[name]
        views.append(View(name, q * pi / 2, (a * pitch, b * pitch), True, angular))
    if lines is not None:
        views.append(View("lines", lines * 2 * pi / artifact.angular_count, (0.0, 0.0), False,
                          True))
    return Plan(names, artifact, tuple(views))


def in_datum(field: np.ndarray, known: np.ndarray, artifact: Artifact, *,
             scale: bool) -> np.ndarray:
    """Return `field` (2, nx, ny) in the datum over the known sites only."""
    return remove_modes(np.where(known, field, np.nan), datum_modes(artifact, scale=scale))
