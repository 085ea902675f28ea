# SPDX-License-Identifier: Apache-2.0
"""Poses of views as the maps between nodes and marks take them."""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.pose import LatticePose, PlacedPose
from selfcal_ros.model.view import View


@dataclass(frozen=True)
class MapPose:
    """The pose of a view together with the plate and the grid of the map.

    Attributes
    ----------
    artifact : Artifact
        The plate, with `map_grid`.
    pose : PlacedPose
        Where it lies.
    """

    artifact: Artifact
    pose: PlacedPose

    @property
    def phase(self) -> complex:
        """exp(i turn): the factor from the plate frame to the stage frame."""
        return self.pose.phase

    @property
    def turn_lines(self) -> int | None:
        """Its turn in angular lines; None where that is not a whole number."""
        return self.pose.turn_lines

    @cached_property
    def sites(self) -> np.ndarray:
        """Nominal places of the marks, (2, nx, ny), pitches of the plate."""
        return np.stack(self.pose.site_of(self.artifact.m, self.artifact.n))

    @cached_property
    def in_field(self) -> np.ndarray:
        """Marks in the stage's field, bool (nx, ny)."""
        return ~self.pose.beyond_field(self.sites, self.artifact)


AnyPose = LatticePose | MapPose


@lru_cache(maxsize=1024)
def pose_of(view: View, artifact: Artifact) -> AnyPose:
    """Return the pose of a view: on the lattice unless the map has a grid of its own.

    Raises
    ------
    InputError
        As `View.on_stage`.
    """
    pose = view.on_stage(artifact)
    return MapPose(artifact, pose) if isinstance(pose, PlacedPose) else view.lattice_pose(artifact)


def in_field(pose: AnyPose, artifact: Artifact) -> np.ndarray:
    """Return the marks of a view that lie in the field, bool (nx, ny)."""
    if isinstance(pose, MapPose):
        return pose.in_field
    return ~pose.beyond_field(np.stack(pose.site_of(artifact.m, artifact.n)), artifact)
