# SPDX-License-Identifier: Apache-2.0
"""The maps of a set of views: from fields over nodes to fields over marks, and back.

On a lattice the nodes are the sites.

Vectors are complex numbers, z = x + iy, so that a quarter turn is a multiplication by i. In the
plate frame the model (method eq. 2.4, Hu 12-15) reads, for view v with q quarter turns,
    y_v(m) = i^-q G(X_v(m)) + A(m) + phi_v i z(m) + tau_v,     y_v = i^-q V_v,  tau_v = i^-q t_v.
A finite rotation adds (R(phi) - 1 - phi J) R^q m + (R(phi) - 1) R^q A to it (method eq. 2.6), with
R(phi) = exp(i phi).

At any pose it reads, for view v turned by alpha_v (method eqs. 12.1, 12.2),
    y_v(m) = e^(-i alpha_v) G(X_v(m)) + A(m) + phi_v i z(m) + tau_v,
    G(X) = sum_j w_j(X) G_j,   w real, sum w = 1,
with G_j the error at node j. On the lattice w is 1 at one site.

Of a spline the unknowns are coefficients of B-splines: a place has only (degree + 1)^2 of them, so
that its row is sparse; one matrix along each axis leads from node values to coefficients. The
bicubic spline is that of `selfcal_ros.compensation.cells`: not-a-knot ends, a parabola through
three nodes.
"""

from dataclasses import dataclass
from functools import cached_property
from math import ceil
from typing import cast

import numpy as np
from scipy.sparse import csr_matrix

from selfcal_ros.estimation.lattice.readings import GridData
from selfcal_ros.model.artifact import Artifact, Interpolation
from selfcal_ros.model.pose import EDGE, LatticePose, PlacedPose

PHASES = np.array([1, 1j, -1, -1j])
"""i^q for q = 0..3, exact."""


class LatticeViews:
    """The maps between sites and marks for the grid views of one calibration.

    Parameters
    ----------
    shape : tuple of int
        Marks (and sites) along x and y.
    poses : tuple of LatticePose
        One per view.
    """

    bilinear = False
    """Whether the map is bilinear between its nodes; on a lattice the nodes are the sites."""
    node_pitch = 1.0
    """Distance of neighbouring nodes, in pitches of the plate."""

    def __init__(self, shape: tuple[int, int], poses: tuple[LatticePose, ...]) -> None:
        self.shape, self.plate_shape, self.poses = shape, shape, poses
        self.half = (shape[0] - 1) / 2, (shape[1] - 1) / 2
        self.unit = max(self.half)

    @property
    def reach(self) -> int:
        """Largest distance, in pitches, of two sites visited by one mark, rounded up.

        Each turned back as its view turns the mark.
        """
        turned_back = self.phases.conj() * self.shifts
        apart = turned_back[:, None] - turned_back
        return ceil(np.maximum(apart.real, apart.imag).max(initial=0))  # of either sign

    def mark_at(self, i: int, j: int) -> tuple[int, int]:
        """Return the m and n of a mark by its index."""
        return int(i) - self.shape[0] // 2, int(j) - self.shape[1] // 2

    def index_of(self, m: int, n: int) -> tuple[int, int]:
        """Return the index of a mark."""
        return m + self.shape[0] // 2, n + self.shape[1] // 2

    @cached_property
    def phases(self) -> np.ndarray:
        """Factor of every view from the plate frame to the stage frame, complex (views,)."""
        return np.array([pose.phase for pose in self.poses], dtype=complex)

    @cached_property
    def shifts(self) -> np.ndarray:
        """Position of the plate's centre in every view, in pitches, complex (views,)."""
        return np.array([complex(*pose.shift) for pose in self.poses], dtype=complex)

    @cached_property
    def z_sites(self) -> np.ndarray:
        """Node positions in the unit, complex (cx, cy)."""
        return self.z

    @cached_property
    def places(self) -> np.ndarray:
        """Mark positions, in pitches, complex (nx, ny)."""
        x, y = (
            np.arange(size) - half
            for size, half in zip(self.shape, self.half, strict=True)
        )
        return x[:, None] + 1j * y

    @property
    def z(self) -> np.ndarray:
        """Mark positions in the unit, complex (nx, ny)."""
        return self.places / self.unit

    @cached_property
    def from_corner(self) -> tuple[np.ndarray, np.ndarray]:
        """Places of the marks in the pitch of the map from its first node, (views, nx, ny) each."""
        turn, shift = (
            of_views[:, None, None] for of_views in (self.phases, self.shifts)
        )
        at = (turn * self.places + shift) / self.node_pitch
        return at.real + self.half[0], at.imag + self.half[1]

    @cached_property
    def in_field(self) -> np.ndarray:
        """Marks inside the field, bool (views, nx, ny)."""
        inside = [
            (place > -EDGE) & (place < 2 * half + EDGE)
            for place, half in zip(self.from_corner, self.half, strict=True)
        ]
        return inside[0] & inside[1]

    @cached_property
    def site_index(self) -> np.ndarray:
        """Flat index of the node nearest to every mark, int (views, nx, ny); -1 off the field."""
        i, j = (
            np.clip(np.rint(coordinate).astype(int), 0, size - 1)
            for coordinate, size in zip(self.from_corner, self.shape, strict=True)
        )
        return np.where(self.in_field, i * self.shape[1] + j, -1)

    def near(self, nodes: np.ndarray) -> np.ndarray:
        """Return the marks on sites of a bool array (nx, ny), (views, nx, ny)."""
        return self.in_field & nodes.reshape(-1)[self.site_index]

    def gather(self, field: np.ndarray) -> np.ndarray:
        """Return i^-q G(X_v(m)), complex (..., views, nx, ny), 0 where the mark is off the field.

        Parameters
        ----------
        field : complex array (..., nx, ny)
            G, or several fields.
        """
        out = _at_indices(field, self.site_index)
        out *= self.phases.conj()[:, None, None]
        return out

    @cached_property
    def _mark_on(self) -> np.ndarray:
        """Flat index of the one mark on every site in each view, int (views, nx, ny); -1 = none."""
        out = np.full((len(self.poses), self.shape[0] * self.shape[1]), -1)
        for mark_on, site in zip(out, self.site_index.reshape(out.shape), strict=True):
            marks = np.flatnonzero(site >= 0)
            mark_on[site[marks]] = marks
        return out.reshape(-1, *self.shape)

    def add_scattered(self, out: np.ndarray, index: int, marks: np.ndarray) -> None:
        """Add the scatter of one view's fields over the marks to `out`, (..., nx, ny) both."""
        out += _at_indices(marks, self._mark_on[index]) * self.phases[index]

    def scatter(self, marks: np.ndarray) -> np.ndarray:
        """Return the adjoint of `gather`: sums over views at every site, complex (..., nx, ny)."""
        out = np.zeros((*marks.shape[:-3], *self.shape), dtype=complex)
        for index in range(len(self.poses)):
            self.add_scattered(out, index, marks[..., index, :, :])
        return out


def _at_indices(fields: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return values of fields (..., nx, ny) at flat indices, complex (..., *at); 0 at -1."""
    *several, nx, ny = fields.shape
    flat = np.zeros((*several, nx * ny + 1), dtype=complex)
    flat[..., :-1] = fields.reshape(*several, nx * ny)
    return flat.take(at, axis=-1, mode="wrap")  # -1 is the 0 at its end


def rigid_parameters(views: LatticeViews) -> np.ndarray:
    """Return the misalignments of the 7 datum modes, (7, views, 3): phi, Re and Im tau.

    Modes: stage translation x, y, rotation, scale; plate translation x, y, rotation; unit
    length (or unit angle times the longer half width). A mode G, A with these misalignments
    changes no reading (method eq. 3.1).
    """
    out = np.zeros((7, len(views.poses), 3))
    for v, back in enumerate(views.phases.conj()):
        shift = back * views.shifts[v] / views.unit
        taus = (-back, -1j * back, -1j * shift, -shift, -1, -1j, 0)
        out[:, v, 0] = (0, 0, -1, 0, 0, 0, -1)
        out[:, v, 1], out[:, v, 2] = np.real(taus), np.imag(taus)
    return out


def rotation_excess(
    phi_rad: float | np.ndarray, marks: np.ndarray, plate: np.ndarray
) -> np.ndarray:
    """Return the contribution of the rotation beyond the linear model, complex (P,), m."""
    turn = np.expm1(1j * phi_rad)
    return (turn - 1j * phi_rad) * marks + turn * plate  # method eq. 2.6


@dataclass(frozen=True, eq=False)
class Axis:
    """The spline along one axis, in pitches of the map.

    Attributes
    ----------
    knots : float array
        Its knots; the first and the last come `degree` + 1 times.
    degree : int
        Degree of the polynomials.
    nodes : float array (n,)
        Where the unknowns are: places of node values, or of the coefficients of a refined spline.
    by_nodes : bool
        Whether the unknowns are values at the nodes, or the coefficients themselves.
    """

    knots: np.ndarray
    degree: int
    nodes: np.ndarray
    by_nodes: bool = True

    @classmethod
    def through(cls, half: float, interpolation: Interpolation) -> "Axis":
        """Return the spline through nodes at -half, ..., half; three of them have a parabola."""
        nodes = np.arange(-half, half + 1.0)
        degree = 1 if interpolation is Interpolation.BILINEAR else min(3, int(2 * half))
        # not-a-knot: the second and the last but one node are not knots of a cubic
        inner = {1: nodes[1:-1], 2: nodes[:0], 3: nodes[2:-2]}[degree]
        ends = nodes[[0, -1]].repeat(degree + 1)
        return cls(np.sort(np.concatenate([ends, inner])), degree, nodes)

    @property
    def refined(self) -> "Axis":
        """The spline with a further knot in the middle of each interval: it contains this one."""
        distinct = np.unique(self.knots)
        knots = np.sort(
            np.concatenate([self.knots, (distinct[:-1] + distinct[1:]) / 2])
        )
        nodes = np.array(
            [
                knots[i + 1 : i + self.degree + 1].mean()
                for i in range(len(knots) - self.degree - 1)
            ]
        )
        return Axis(knots, self.degree, nodes, by_nodes=False)

    def rows(self, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the B-splines at places: their values, and the index of the first, (P, degree+1).

        Places beyond the edge, which rounding moves there, count as on it.
        """
        from scipy.interpolate import (
            BSpline,
        )  # a tenth of a second, for marks off the sites alone

        knots, k = self.knots, self.degree
        at = np.clip(at, knots[0], knots[-1])
        cell = np.clip(np.searchsorted(knots, at, "right") - 1, k, len(knots) - k - 2)
        values = BSpline.design_matrix(at, knots, k).data.reshape(-1, k + 1)
        return values, cell[:, None] - k + np.arange(k + 1)

    @cached_property
    def from_nodes(self) -> np.ndarray:
        """Coefficients for a unit at each node, (n, n)."""
        if not self.by_nodes:
            return np.eye(len(self.nodes))
        return np.linalg.inv(self.matrix(self.nodes))

    def matrix(self, at: np.ndarray) -> np.ndarray:
        """Return the values of all B-splines at places, (P, n)."""
        values, first = self.rows(at)
        dense = np.zeros((len(at), len(self.nodes)))
        np.put_along_axis(dense, first, values, axis=1)
        return dense


@dataclass(frozen=True, eq=False)
class MapSpline:
    """The spline of a map.

    Attributes
    ----------
    axes : tuple of Axis
        Along x and y.
    pitch_m : float
        Unit of their nodes, m.
    """

    axes: tuple[Axis, Axis]
    pitch_m: float

    @classmethod
    def of(cls, field: Artifact, interpolation: Interpolation) -> "MapSpline":
        """Return the spline through the nodes of a lattice."""
        x, y = (Axis.through(half, interpolation) for half in field.half)
        return cls((x, y), field.grid_pitch_m)

    @property
    def shape(self) -> tuple[int, int]:
        """Unknowns along x and y."""
        return len(self.axes[0].nodes), len(self.axes[1].nodes)

    @property
    def refined(self) -> "MapSpline":
        """The spline with twice as many intervals along each axis: it contains this one."""
        return MapSpline((self.axes[0].refined, self.axes[1].refined), self.pitch_m)

    def within(self, finer: "MapSpline") -> np.ndarray:
        """Return the matrix to the coefficients of a refined spline, which contains this one."""
        axes = [
            np.linalg.solve(
                fine.matrix(fine.nodes), axis.matrix(fine.nodes) @ axis.from_nodes
            )
            for axis, fine in zip(self.axes, finer.axes, strict=True)
        ]
        return np.kron(*axes)

    @property
    def places_m(self) -> np.ndarray:
        """Places of the unknowns on the stage, complex (nx, ny), m."""
        return (self.axes[0].nodes[:, None] + 1j * self.axes[1].nodes) * self.pitch_m

    def rows(self, places_m: np.ndarray) -> csr_matrix:
        """Return the rows of places on the coefficients, real (P, nodes).

        Parameters
        ----------
        places_m : complex array (P,)
            Places on the stage, m.
        """
        at = places_m / self.pitch_m
        (bx, ix), (by, iy) = self.axes[0].rows(at.real), self.axes[1].rows(at.imag)
        values = bx[:, :, None] * by[:, None, :]
        index = ix[:, :, None] * self.shape[1] + iy[:, None, :]
        n_of_place = values[0].size if len(values) else 1
        ends = np.arange(0, len(at) * n_of_place + 1, n_of_place)
        return csr_matrix(
            (values.ravel(), index.ravel(), ends),
            shape=(len(at), self.shape[0] * self.shape[1]),
        )

    def coefficients(self, field: np.ndarray) -> np.ndarray:
        """Return the coefficients of fields (..., nx, ny), in the same shape."""
        return self.axes[0].from_nodes @ field @ self.axes[1].from_nodes.T

    def adjoint(self, coefficients: np.ndarray) -> np.ndarray:
        """Return the adjoint of `coefficients`, (..., nx, ny)."""
        return self.axes[0].from_nodes.T @ coefficients @ self.axes[1].from_nodes

    def on_nodes(self, matrix: np.ndarray) -> np.ndarray:
        """Return a Hermitian form over coefficients (n, n) as one over node values."""
        n = len(matrix)
        half = self.adjoint(matrix.T.reshape(n, *self.shape)).reshape(n, n)
        return self.adjoint(half.T.reshape(n, *self.shape)).reshape(n, n)


class PlacedViews(LatticeViews):
    """The maps between nodes and marks for the grid views of one calibration.

    Parameters
    ----------
    plate : Artifact
        The plate, with the grid of the map.
    poses : tuple of PlacedPose
        One per view.
    spline : MapSpline, optional
        Of the map; by default the one through its nodes.
    """

    poses: tuple[PlacedPose, ...]  # type: ignore[assignment]

    def __init__(
        self,
        artifact: Artifact,
        poses: tuple[PlacedPose, ...],
        spline: MapSpline | None = None,
    ) -> None:
        grid = artifact.map_grid
        self.poses, self.artifact = poses, artifact
        self.spline = spline or MapSpline.of(
            artifact.field, grid.interpolation if grid else Interpolation.BICUBIC
        )
        self.bilinear = self.spline.axes[0].degree == 1
        self.node_pitch = artifact.field.grid_pitch_m / artifact.grid_pitch_m
        self.shape, self.half = self.spline.shape, artifact.field.half
        self.plate_shape, self.unit = artifact.shape, max(artifact.reach)

    @cached_property
    def places(self) -> np.ndarray:
        """Mark positions, in pitches, complex (nx, ny)."""
        x, y = self.artifact.places(self.artifact.m, self.artifact.n)
        return x + 1j * y

    @cached_property
    def z_sites(self) -> np.ndarray:
        """Node positions in the unit, complex (cx, cy)."""
        return self.spline.places_m / (self.unit * self.artifact.grid_pitch_m)

    @cached_property
    def rows(self) -> tuple[csr_matrix, ...]:
        """Rows of each view's marks on the spline's coefficients, real (marks, nodes); 0 off it."""
        x, y = self.from_corner
        places = x - self.half[0] + 1j * (y - self.half[1])
        return tuple(
            self.spline.rows(of_view.ravel() * self.spline.pitch_m)
            .multiply(inside.reshape(-1, 1))
            .tocsr()
            for inside, of_view in zip(self.in_field, places, strict=True)
        )

    def gather(self, field: np.ndarray) -> np.ndarray:
        """Return e^(-i alpha) G(X_v(m)), complex (..., views, nx, ny); 0 off the field."""
        flat = self.spline.coefficients(field).reshape(-1, self.z_sites.size).T
        out = np.stack(
            [
                (phase.conjugate() * (rows @ flat)).T
                for phase, rows in zip(self.phases, self.rows, strict=True)
            ],
            axis=1,
        )
        return out.reshape(*field.shape[:-2], len(self.poses), *self.plate_shape)

    def add_scattered(self, out: np.ndarray, index: int, marks: np.ndarray) -> None:
        """Add the scatter of one view's fields (..., nx, ny) to `out` (..., cx, cy)."""
        flat = marks.reshape(-1, self.z.size).T
        summed = self.phases[index] * (self.rows[index].T @ flat)
        out += self.spline.adjoint(summed.T.reshape(out.shape))

    def mark_at(self, i: int, j: int) -> tuple[int, int]:
        """Return the m and n of a mark by its index."""
        m, n = self.artifact.marks_at(np.array(i), np.array(j))
        return int(m), int(n)

    def index_of(self, m: int, n: int) -> tuple[int, int]:
        """Return the index of a mark."""
        i, j = self.artifact.index(np.array(m), np.array(n))
        return int(i), int(j)

    def near(self, nodes: np.ndarray) -> np.ndarray:
        """Return the marks whose cell of the map has only `nodes` as corners, (views, nx, ny)."""
        i, j = (
            np.clip(np.floor(coordinate + EDGE).astype(int), 0, size - 2)
            for coordinate, size in zip(self.from_corner, self.shape, strict=True)
        )
        return self.in_field & (
            nodes[i, j] & nodes[i + 1, j] & nodes[i, j + 1] & nodes[i + 1, j + 1]
        )


def maps_of(grid: GridData) -> LatticeViews:
    """Return the maps of the views of readings."""
    if grid.plate is None:
        return LatticeViews(grid.y.shape[1:], cast(tuple[LatticePose, ...], grid.poses))
    return PlacedViews(grid.plate, cast(tuple[PlacedPose, ...], grid.poses))
