# SPDX-License-Identifier: Apache-2.0
"""The maps of views at any pose: from fields over nodes to fields over marks, and back.

In the plate frame the model reads, for view v turned by alpha_v (method eqs. 12.1, 12.2),
    y_v(m) = e^(-i alpha_v) G(X_v(m)) + A(m) + phi_v i z(m) + tau_v,
    G(X) = sum_j w_j(X) G_j,   w real, sum w = 1,
with G_j the error at node j. The same members as `selfcal_ros.estimation.lattice.maps.LatticeViews`
lead from nodes to marks; there w is 1 at one site.
"""

from functools import cached_property

import numpy as np
from scipy.sparse import csr_matrix

from selfcal_ros.estimation.lattice.poses import MapPose
from selfcal_ros.estimation.lattice.splines import MapSpline
from selfcal_ros.model.artifact import Interpolation
from selfcal_ros.model.pose import EDGE


class PlacedViews:
    """The maps between nodes and marks for the grid views of one calibration.

    Parameters
    ----------
    poses : tuple of MapPose
        One per view, all of one plate.
    spline : MapSpline, optional
        Of the map; by default the one through its nodes.
    """

    def __init__(self, poses: tuple[MapPose, ...], spline: MapSpline | None = None) -> None:
        artifact = poses[0].artifact
        grid = artifact.map_grid
        self.poses, self.artifact = poses, artifact
        self.spline = spline or MapSpline.of(
            artifact.field, grid.interpolation if grid else Interpolation.BICUBIC)
        self.shape, self.half = self.spline.shape, artifact.field.half
        self.plate_shape, self.plate_half = artifact.shape, artifact.half
        self.unit = max(artifact.half)

    @cached_property
    def phases(self) -> np.ndarray:
        """exp(i alpha) of every view, complex (views,)."""
        return np.array([pose.phase for pose in self.poses], dtype=complex)

    @cached_property
    def shifts(self) -> np.ndarray:
        """Position of the plate's centre in every view, in pitches, complex (views,)."""
        return np.array([complex(*pose.pose.shift) for pose in self.poses])

    @cached_property
    def z(self) -> np.ndarray:
        """Mark positions in the unit, complex (nx, ny)."""
        return (self.artifact.m + 1j * self.artifact.n) / self.unit

    @cached_property
    def z_sites(self) -> np.ndarray:
        """Node positions in the unit, complex (cx, cy)."""
        return self.spline.places_m / (self.unit * self.artifact.grid_pitch_m)

    @cached_property
    def in_field(self) -> np.ndarray:
        """Marks inside the field, bool (views, nx, ny)."""
        return np.array([pose.in_field for pose in self.poses])

    @cached_property
    def rows(self) -> tuple[csr_matrix, ...]:
        """Rows of each view's marks on the spline's coefficients, real (marks, nodes); 0 off it."""
        pitch_m = self.artifact.grid_pitch_m
        return tuple(self.spline.rows((x + 1j * y).ravel() * pitch_m).multiply(
            pose.in_field.reshape(-1, 1)).tocsr() for pose in self.poses for x, y in [pose.sites])

    def gather(self, field: np.ndarray) -> np.ndarray:
        """Return e^(-i alpha) G(X_v(m)), complex (..., views, nx, ny); 0 off the field."""
        flat = self.spline.coefficients(field).reshape(-1, self.z_sites.size).T
        out = np.stack([(phase.conjugate() * (rows @ flat)).T for phase, rows in zip(
            self.phases, self.rows, strict=True)], axis=1)
        return out.reshape(*field.shape[:-2], len(self.poses), *self.plate_shape)

    def add_scattered(self, out: np.ndarray, index: int, marks: np.ndarray) -> None:
        """Add the scatter of one view's fields (..., nx, ny) to `out` (..., cx, cy)."""
        flat = marks.reshape(-1, self.z.size).T
        summed = self.phases[index] * (self.rows[index].T @ flat)
        out += self.spline.adjoint(summed.T.reshape(out.shape))

    def scatter(self, marks: np.ndarray) -> np.ndarray:
        """Return the adjoint of `gather` for (views, nx, ny): complex (cx, cy)."""
        total = sum((phase * (rows.T @ one.ravel()) for phase, rows, one in zip(
            self.phases, self.rows, marks, strict=True)), start=np.zeros(1, dtype=complex))
        return self.spline.adjoint(np.broadcast_to(total, self.z_sites.size).reshape(self.shape))

    @cached_property
    def from_corner(self) -> tuple[np.ndarray, np.ndarray]:
        """Places of the marks in the pitch of the map from its first node, (views, nx, ny) each."""
        step = self.artifact.grid_pitch_m / self.artifact.field.grid_pitch_m
        x, y = np.array([pose.sites for pose in self.poses]).swapaxes(0, 1) * step
        return x + self.half[0], y + self.half[1]

    @cached_property
    def site_index(self) -> np.ndarray:
        """Flat index of the node nearest to every mark, int (views, nx, ny); -1 off the field."""
        i, j = (np.clip(np.rint(part).astype(int), 0, size - 1)
                for part, size in zip(self.from_corner, self.shape, strict=True))
        return np.where(self.in_field, i * self.shape[1] + j, -1)

    def near(self, nodes: np.ndarray) -> np.ndarray:
        """Return the marks whose cell of the map has only `nodes` as corners, (views, nx, ny)."""
        i, j = (np.clip(np.floor(part + EDGE).astype(int), 0, size - 2)
                for part, size in zip(self.from_corner, self.shape, strict=True))
        return self.in_field & (nodes[i, j] & nodes[i + 1, j] & nodes[i, j + 1]
                                & nodes[i + 1, j + 1])
