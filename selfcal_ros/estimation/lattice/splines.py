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


@dataclass(frozen=True)
class Axis:
    """The spline along one axis: nodes at -half, ..., half, one apart."""

    half: int
    interpolation: Interpolation

    @property
    def nodes(self) -> np.ndarray:
        """Positions of the nodes, (n,)."""
        return np.arange(-self.half, self.half + 1.0)

    @property
    def degree(self) -> int:
        """Degree of the polynomials; three nodes have a parabola."""
        return 1 if self.interpolation is Interpolation.BILINEAR else min(3, 2 * self.half)

    @cached_property
    def _knots(self) -> np.ndarray:
        nodes, end = self.nodes, self.degree + 1
        # not-a-knot: the second and the last but one node are no knots of a cubic
        inner = nodes[1:-1] if self.degree == 1 else nodes[2:-2] if self.degree == 3 else nodes[:0]
        return np.concatenate([nodes[:1].repeat(end), inner, nodes[-1:].repeat(end)])

    def rows(self, at: np.ndarray, slope: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """Return the B-splines at places: their values, and the index of the first, (P, degree+1).

        With `slope` 1 their derivatives.
        """
        knots, k = self._knots, self.degree
        cell = np.clip(np.searchsorted(knots, at, "right") - 1, k, len(knots) - k - 2)
        first = cell[:, None] - k + np.arange(k + 1)
        if not slope:
            clipped = np.clip(at, knots[0], knots[-1])
            design = BSpline.design_matrix(clipped, knots, k)
            values = design.data.reshape(-1, k + 1)
            beyond = at - clipped
            if beyond.any():  # continued straight on
                values = values + beyond[:, None] * self.rows(clipped, 1)[0]
            return values, first
        unit = np.eye(len(knots) - k - 1)
        spline = BSpline(knots, unit, k).derivative()
        return np.take_along_axis(spline(np.clip(at, knots[0], knots[-1])), first, axis=1), first

    @cached_property
    def from_nodes(self) -> np.ndarray:
        """Coefficients for a unit at each node, (n, n)."""
        values, first = self.rows(self.nodes)
        dense = np.zeros((len(self.nodes), len(self.nodes)))
        np.put_along_axis(dense, first, values, axis=1)
        return np.linalg.inv(dense)


class MapSpline:
    """The spline of a map.

    Parameters
    ----------
    field : Artifact
        Lattice of its nodes.
    interpolation : Interpolation
        Between them.
    """

    def __init__(self, field: Artifact, interpolation: Interpolation) -> None:
        self.shape, self.pitch_m = field.shape, field.grid_pitch_m
        self.axes = tuple(Axis(half, interpolation) for half in field.half)

    def rows(self, places_m: np.ndarray, slope: tuple[int, int] = (0, 0)) -> csr_matrix:
        """Return the rows of places on the coefficients, real (P, nodes).

        Parameters
        ----------
        places_m : complex array (P,)
            Places on the stage, m.
        slope : tuple of int
            1 for the derivative along x or y, in 1/m.
        """
        at = places_m / self.pitch_m
        (bx, ix), (by, iy) = (axis.rows(part, one) for axis, part, one in zip(
            self.axes, (at.real, at.imag), slope, strict=True))
        values = bx[:, :, None] * by[:, None, :] / self.pitch_m ** sum(slope)
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

    def at(self, field: np.ndarray, places_m: np.ndarray) -> np.ndarray:
        """Return a field (nx, ny) at places (P,), m."""
        return self.rows(places_m) @ self.coefficients(field).ravel()
