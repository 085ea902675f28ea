# SPDX-License-Identifier: Apache-2.0
"""Plans by name and truths moved to the datum of what was found."""

from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
from math import pi
from typing import Any

import numpy as np

from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.error_map import datum_modes, remove_modes
from selfcal_ros.model.readings import Measurements
from selfcal_ros.model.view import Plan, View
from test.support.truth import Truth, random_truth, simulate_measurements

POSES = {
    "0": (0, 0, 0),
    "90": (1, 0, 0),
    "180": (2, 0, 0),
    "270": (3, 0, 0),
    "+tx": (0, 1, 0),
    "tx": (0, 1, 0),
    "-tx": (0, -1, 0),
    "ty": (0, 0, 1),
    "90+tx": (1, 1, 0),
    "270-2tx+ty": (3, -2, 1),
    "2ty": (0, 0, 2),
}


def plan_of(names: str, artifact: Artifact, *, lines: int | None = None) -> Plan:
    """Return the plan of comma-separated poses; `lines` adds an angular view turned so far."""
    pitch, angular = artifact.grid_pitch_m, artifact.angular_count > 0
    views = []
    for name in names.split(","):
        q, a, b = POSES[name]
        views.append(View(name, q * pi / 2, (a * pitch, b * pitch), True, angular))
    if lines is not None:
        views.append(
            View(
                "lines",
                lines * 2 * pi / artifact.angular_count,
                (0.0, 0.0),
                False,
                True,
            )
        )
    return Plan(names, artifact, tuple(views))


def measured_in_datum(
    plan: Plan, seed: int, calibrated: Callable[[Measurements], np.ndarray], **how: Any
) -> tuple[Truth, Measurements]:
    """Return readings with missing marks, of a stage in the datum over the sites that they tell.

    A stage that is turned or grown against that datum by d gives the same readings to d times
    the misalignments only, some 1e-10 m: offsets as the microscope tells them do not turn with it.

    Parameters
    ----------
    plan, seed
        What is measured, and the seed of truth, noise and missing marks.
    calibrated : callable
        Returns which sites readings tell, bool array (nx, ny).
    how
        As `simulate_measurements`.
    """
    rng = np.random.default_rng(seed)
    truth = random_truth(plan.artifact, len(plan.views), rng)
    again = deepcopy(rng)
    known = calibrated(simulate_measurements(truth, plan, rng, **how))
    g = np.where(known, in_datum(truth.g, known, plan.artifact, scale=True), truth.g)
    truth = replace(truth, g=g)
    return truth, simulate_measurements(truth, plan, again, **how)


def in_datum(
    field: np.ndarray, known: np.ndarray, artifact: Artifact, *, scale: bool
) -> np.ndarray:
    """Return `field` (2, nx, ny) in the datum over the known sites only."""
    return remove_modes(
        np.where(known, field, np.nan), datum_modes(artifact, scale=scale)
    )
