# SPDX-License-Identifier: Apache-2.0
"""Yaw of the stage: what its rotation at a stop does to the marks of the image (method eq. 4.17).

A mark at d from the optical axis is read at d - i yaw d. The yaw has a coefficient at each node of
a grid over the field, with bilinear interpolation between them.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.view import View

MOST_NODES = 11
"""Largest number of nodes along each axis; up to it they are the sites."""

MOST_VALUES = 16_000_000
"""Largest number of values of all columns, 256 MB, to which fewer nodes are due."""


@dataclass(frozen=True, eq=False)
class StageYaw:
    """Nodes of the yaw, and how marks in the cells of images depend on it.

    Attributes
    ----------
    shape : tuple of int
        Number of nodes along x and y.
    half_m : tuple of float
        Half the sides of the field that they cover, m.
    arms : complex array (views,)
        Place of the cell of each view in the image, stage axes, m.
    places : complex array (views, marks)
        Where the stage stands for each mark of each view, in the sense of (1.6), m.
    phases : complex array (views,)
        From the stage frame to the plate frame.
    """

    shape: tuple[int, int]
    half_m: tuple[float, float]
    arms: np.ndarray
    places: np.ndarray
    phases: np.ndarray

    @property
    def nodes(self) -> np.ndarray:
        """Places of the nodes, in the sense of (1.6), complex (nodes,), m."""
        x, y = (np.linspace(-half, half, n) for half, n in zip(
            self.half_m, self.shape, strict=True))
        return (x[:, None] + 1j * y).ravel()

    def columns(self, phases: Sequence[complex] | None = None,
                beside: np.ndarray | None = None) -> Iterator[dict[int, np.ndarray]]:
        """Yield the readings of all marks for a yaw of 1 rad at each node, by view, plate frame.

        `phases` replace those of the nominal poses; `beside`, (views, marks), is where the marks
        are beside the places of their cells, stage axes, m: a constant yaw, a turn of the camera,
        does not act on it.
        """
        nx, ny = self.shape
        x, y = (np.clip((part / half + 1) / 2, 0, 1) * (n - 1) for part, half, n in zip(
            (self.places.real, self.places.imag), self.half_m, self.shape, strict=True))
        unit = -1j * (self.phases if phases is None else np.array(phases))[:, None]
        turned = unit * (self.arms[:, None] + (0 if beside is None else beside))
        constant = unit * (0 if beside is None else beside) / (nx * ny)
        seen = np.flatnonzero(turned.any(axis=1))
        for i in range(nx):
            along = np.maximum(1 - np.abs(x - i), 0)
            for j in range(ny):
                weight = along * np.maximum(1 - np.abs(y - j), 0)
                yield {view: turned[view] * weight[view] - constant[view] for view in seen.tolist()}


def stage_yaw(artifact: Artifact, views: Sequence[View]) -> StageYaw | None:
    """Return the yaw behind the grid views of a measurement; None without images."""
    arms = np.array([view.cell_m for view in views])
    if not arms.any():
        return None
    sites = artifact.field.shape
    most = int(np.sqrt(MOST_VALUES / (len(views) * artifact.m.size)))
    nx, ny = (min(n, max(most, 2), MOST_NODES) for n in sites)
    return StageYaw((nx, ny), artifact.field_half_m, arms, np.stack([
        view.pose.places(artifact, artifact.m, artifact.n).ravel() for view in views]),
        np.array([view.pose.phase for view in views]).conj())
