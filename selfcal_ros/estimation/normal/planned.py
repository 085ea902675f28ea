# SPDX-License-Identifier: Apache-2.0
"""Normal equations of a plan before measurement: every mark in the field is read."""

from collections.abc import Sequence

import numpy as np

from selfcal_ros.estimation.normal.angular import AngularSystem
from selfcal_ros.estimation.normal.equations import NormalEquations
from selfcal_ros.estimation.normal.grid import GridSystem
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.view import View


def planned_system(artifact: Artifact, views: Sequence[View], *,
                   rank_only: bool = False) -> NormalEquations:
    """Return the system of the planned views: every mark in the field, unit repeats.

    Parameters
    ----------
    artifact : Artifact
        The plate.
    views : sequence of View
        The plan.
    rank_only : bool
        Whether only the rank is needed.
    """
    grid_views = [(i, v) for i, v in enumerate(views) if v.grid]
    poses = tuple(view.lattice_pose(artifact) for _, view in grid_views)
    angular = [(i, v) for i, v in enumerate(views) if v.angular and artifact.angular_count]
    turns = tuple(v.lattice_pose(artifact).s for _, v in angular)
    empty = np.zeros((len(poses), *artifact.shape))
    field = GridSystem(poses, empty).views.in_field
    repeats = np.array([v.repeats for _, v in grid_views], dtype=float)
    lines = np.array([v.repeats for _, v in angular], dtype=float)
    return NormalEquations(
        GridSystem(poses, field * repeats[:, None, None]),
        AngularSystem(turns, np.ones((len(turns), artifact.angular_count)) * lines[:, None]),
        tuple(i for i, _ in grid_views), tuple(i for i, _ in angular), rank_only=rank_only)
