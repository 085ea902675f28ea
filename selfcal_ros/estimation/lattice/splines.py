# SPDX-License-Identifier: Apache-2.0
"""Rows that lead from the nodes of a map to any place: bilinear, or the bicubic spline.

A spline on a uniform grid is a sum of B-splines. A place has only (degree + 1)^2 of them, so that
rows in their coefficients are sparse; one matrix along each axis leads from node values to
coefficients. The bicubic spline is that of `selfcal_ros.compensation.cells`: not-a-knot ends, a
parabola through three nodes.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.interpolate import BSpline
from scipy.sparse import csr_matrix

from selfcal_ros.model.artifact import Artifact, Interpolation


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
    def through(cls, half: int, interpolation: Interpolation) -> "Axis":
        """Return the spline through nodes at -half, ..., half; three of them have a parabola."""
        nodes = np.arange(-half, half + 1.0)
        degree = 1 if interpolation is Interpolation.BILINEAR else min(3, 2 * half)
        # not-a-knot: the second and the last but one node are no knots of a cubic
        inner = {1: nodes[1:-1], 2: nodes[:0], 3: nodes[2:-2]}[degree]
        ends = nodes[[0, -1]].repeat(degree + 1)
        return cls(np.sort(np.concatenate([ends, inner])), degree, nodes)

    @property
    def refined(self) -> "Axis":
        """The spline with a further knot in the middle of each interval: it contains this one."""
        each = np.unique(self.knots)
        knots = np.sort(np.concatenate([self.knots, (each[:-1] + each[1:]) / 2]))
        nodes = np.array([knots[i + 1:i + self.degree + 1].mean()
                          for i in range(len(knots) - self.degree - 1)])
        return Axis(knots, self.degree, nodes, by_nodes=False)

    def rows(self, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the B-splines at places: their values, and the index of the first, (P, degree+1).

        Places beyond the edge, which rounding moves there, count as on it.
        """
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
        values, first = self.rows(self.nodes)
        dense = np.zeros((len(self.nodes), len(self.nodes)))
        np.put_along_axis(dense, first, values, axis=1)
        return np.linalg.inv(dense)


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
        each = values[0].size if len(values) else 1
        ends = np.arange(0, len(at) * each + 1, each)
        return csr_matrix((values.ravel(), index.ravel(), ends),
                          shape=(len(at), self.shape[0] * self.shape[1]))

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
