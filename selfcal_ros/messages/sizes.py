# SPDX-License-Identifier: Apache-2.0
"""What a message may claim: refused before anything is allocated for it."""

import math
from collections.abc import Iterable

import numpy as np

from selfcal_ros.collection.messages import MAX_VIEWS, Command, check_command
from selfcal_ros.errors import InputError
from selfcal_ros.messages.topics import MEASUREMENT_TOPIC
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.readings import GridVisits, ViewReadings

SITES_A_MARK = 1000
"""Sites of the plate for each mark that was read, above which a plate cannot be calibrated."""
LARGEST = 1e3
"""Deviation or uncertainty, m or rad, beyond which nobody has measured anything."""
MAX_EXPOSURES = 5_000_000
"""Exposures of one view that the simulated cell holds: 240 MB."""


def check_view(readings: ViewReadings, artifact: Artifact, view_index: int) -> None:
    """Raise InputError for readings of a view that cannot be, or of marks that are not there."""
    where = f"{MEASUREMENT_TOPIC} of '{readings.view.name}'"
    if not 0 <= view_index <= MAX_VIEWS:
        raise InputError(where, f"a plan has at most {MAX_VIEWS} views", "correct the view_index")
    readings.view.lattice_pose(artifact)
    for name, index, least, most in (
            ("m", readings.m, -artifact.half[0], artifact.half[0]),
            ("n", readings.n, -artifact.half[1], artifact.half[1]),
            ("k", readings.k, 0, artifact.angular_count - 1)):
        if len(index) and not least <= np.min(index) <= np.max(index) <= most:
            raise InputError(where, f"{name} goes beyond {least} to {most}",
                             "correct the publisher")
    _check_values(where, readings, ("dx", "dy", "dtheta"), ("u", "u_theta", "sigma_xy",
                                                            "sigma_theta"))
    if readings.visits is not None:
        _check_values(f"{where}, visits", readings.visits, ("dx", "dy", "offset_x", "offset_y"),
                      ("u", "sigma_m"))
        if np.min(readings.visits.count) < 1:
            raise InputError(f"{where}, visits", "a count below 1", "correct the publisher")


def _check_values(where: str, table: ViewReadings | GridVisits, told: Iterable[str],
                  perhaps: Iterable[str]) -> None:
    """Raise InputError for values that are enormous, or NaN where they have to be told."""
    for name in (*told, *perhaps):
        size = np.abs(getattr(table, name))
        if np.any(size > LARGEST) or (name in told and np.isnan(size).any()):
            raise InputError(where, f"{name} is no number up to {LARGEST:g}", "give m and rad")


def check_plate(artifact: Artifact, views: Iterable[ViewReadings]) -> None:
    """Raise InputError for a plate that is enormous beside the marks that were read of it."""
    marks, sites = sum(len(view.m) for view in views), math.prod(artifact.shape)
    if sites > SITES_A_MARK * (1 + marks):
        raise InputError(MEASUREMENT_TOPIC, f"{marks} readings of a plate with {sites} marks",
                         "correct grid_size, or measure more of it")


def check_simulated(command: Command) -> None:
    """Raise InputError for a view that no cell can follow, or too large for a simulated one."""
    check_command(command)
    view, artifact = command.view, command.artifact
    if view is None or artifact is None:
        return  # DONE or ABORT: nothing is simulated
    exposures = max(math.prod(artifact.shape), artifact.angular_count) * view.repeats
    if exposures > MAX_EXPOSURES:
        raise InputError(f"view command {command.view_index}", f"{exposures} exposures are beyond "
                         f"the {MAX_EXPOSURES} of a simulated cell", "ask for fewer marks, repeats")
