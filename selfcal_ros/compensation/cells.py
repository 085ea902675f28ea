# SPDX-License-Identifier: Apache-2.0
"""Piecewise polynomials on a uniform grid, evaluated fast: bilinear cells and bicubic splines.

The coefficients of every cell are contiguous in memory, so one evaluation is one
gather of a row and a short Horner scheme; positions are processed in blocks that fit in cache.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

Interpolation = Literal["bilinear", "bicubic"]
Outside = Literal["clamp", "refuse"]

BLOCK = 16384
"""Bilinear positions per block: their coefficients fill the second-level cache."""
SMALL = 1 << 20
"""Bytes of coefficients that fit in cache."""
MAX_ITERATIONS = 60
REST = 4 * float(np.finfo(float).eps)
"""Step, in pitches, below which a fixed point has converged."""
SNAP = 1e-9
"""Distance to a node, in pitches, below which a position is taken to be on it."""


def cubic_pieces(
    values: np.ndarray, *, periodic: bool = False, local: bool = False
) -> np.ndarray:
    """Return the cubic spline through `values` (n, ...) one apart, (4, intervals, ...).

    Coefficients of 1, u, u^2, u^3 with u from 0 to 1 in each interval. Not-a-knot ends; a parabola
    through three values. A periodic spline has n intervals, the last of which leads to the first
    value. A local one has the slopes of parabolas through three neighbours (Catmull and Rom).
    """
    if periodic:
        slope = _slopes_of_circle(values)
    else:
        slope = np.gradient(values, axis=0, edge_order=2) if local else _slopes(values)
    if periodic:
        values, slope = (np.concatenate([rows, rows[:1]]) for rows in (values, slope))
    low = values[:-1]
    left = slope[:-1]
    right = slope[1:]
    step = np.diff(values, axis=0)
    return np.stack([low, left, 3 * step - 2 * left - right, left + right - 2 * step])


def _slopes(values: np.ndarray) -> np.ndarray:
    """Return the slopes of the not-a-knot spline through `values` (n, ...), n at least 3."""
    n = len(values)
    slope = np.empty_like(values)  # first the right-hand side
    slope[1:-1] = 3 * (values[2:] - values[:-2])
    for end, inward in ((0, 1), (-1, -1)):
        f0, f1, f2 = (values[end + k * inward] for k in range(3))
        slope[end] = inward * (4 * f1 - 5 * f0 + f2) / 2
    before, diagonal = [0.0, *[1.0] * (n - 2), 2.0], [1.0, *[4.0] * (n - 2), 1.0]
    after = [2.0, *[1.0] * (n - 2), 0.0]
    # both ends give the same condition: the parabola has no third derivative
    if n == 3:
        before[2] = 0.0
        slope[2] = (values[0] - 4 * values[1] + 3 * values[2]) / 2
    for i in range(1, n):  # each row minus the previous one
        factor = 1 / (diagonal[i] - before[i] * after[i - 1])
        after[i] *= factor
        slope[i] = (slope[i] - before[i] * slope[i - 1]) * factor
    for i in range(n - 2, -1, -1):
        slope[i] -= after[i] * slope[i + 1]
    return slope


def _slopes_of_circle(values: np.ndarray) -> np.ndarray:
    """Return the slopes of the periodic spline through `values` (n, ...)."""
    turn = (
        2 * np.pi * np.fft.rfftfreq(len(values)).reshape(-1, *[1] * (values.ndim - 1))
    )
    spectrum = np.fft.rfft(values, axis=0) * (3j * np.sin(turn) / (2 + np.cos(turn)))
    return np.fft.irfft(spectrum, len(values), axis=0)


@dataclass(frozen=True, eq=False)
class Cells:
    """Two fields on a uniform grid as one polynomial per cell.

    Attributes
    ----------
    shape : tuple of int
        Number of nodes (nx, ny).
    degree : int
        Largest power along each direction: 1 or 3.
    coefficients : float array ((nx-1)(ny-1), 2, degree+1, degree+1)
        Of u^p v^q at [cell, field, p, q]; u, v in 0..1 inside the cell.
    nodes : float array (2, nx, ny)
        Values at the nodes.
    by_power : float array (coefficients, cells) or None
        The transposed coefficients, for a grid so small that all of them fit in cache.
    """

    shape: tuple[int, int]
    degree: int
    coefficients: np.ndarray
    nodes: np.ndarray
    by_power: np.ndarray | None = None

    @property
    def block(self) -> int:
        """Positions per block, so that their coefficients fit in cache."""
        return BLOCK * 8 // self.coefficients[0].size

    @cached_property
    def largest_step(self) -> float:
        """Largest difference between neighbouring known nodes."""
        steps = [np.abs(np.diff(self.nodes, axis=axis)) for axis in (1, 2)]
        return max(
            float(step.max(initial=0.0, where=np.isfinite(step))) for step in steps
        )

    def steepest(self) -> float:
        """Return the largest |df/du| + |df/dv| of either field at 5 x 5 points of every cell.

        Unknown nodes are ignored.
        """
        powers = np.arange(self.degree + 1)
        places = np.linspace(0, 1, 5)[:, None]
        value = places**powers
        slope = powers * places ** np.maximum(powers - 1, 0)
        largest = 0.0
        for along, along_slope in zip(value, slope, strict=True):
            size = np.abs((along_slope @ self.coefficients) @ value.T) + np.abs(
                (along @ self.coefficients) @ slope.T
            )
            largest = max(largest, np.nan_to_num(size).max(initial=0.0))
        return float(largest)

    def at(self, s: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return both fields at grid coordinates `s`, `t` (0..nx-1, 0..ny-1; clamped), (P,).

        A bilinear value that needs an unknown (NaN) node with a weight other than zero is NaN.
        """
        (i, j), (u, v) = self._locate(s, t)
        first, second = self._polynomials(self._rows(i, j), u, v)
        unknown = np.isnan(first) | np.isnan(second)
        if unknown.any():
            for out, field in zip((first, second), self.nodes, strict=True):
                out[unknown] = _known_corners(
                    field, (i[unknown], j[unknown]), (u[unknown], v[unknown])
                )
        return first, second

    def beyond(self, s: np.ndarray, t: np.ndarray) -> np.ndarray:
        """Return both fields at grid coordinates `s`, `t` (P,), not clamped, (2, P).

        The polynomials of the outermost cells go on beyond the grid. All nodes are to be known.
        """
        out = np.empty((2, len(s)))
        for start in range(0, len(s), self.block):
            block = slice(start, start + self.block)
            i, j = (
                np.clip(np.floor(w[block]), 0, size - 2).astype(np.int64)
                for w, size in zip((s, t), self.shape, strict=True)
            )
            out[:, block] = self._polynomials(
                self._rows(i, j), s[block] - i, t[block] - j
            )
        return out

    def solve_in_cell(
        self, s: np.ndarray, t: np.ndarray, scale: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the (a, b) with (a, b) + scale * fields(a, b) = (s, t), by fixed point.

        The solution is nearly always in the cell of (s, t) itself, so each cell's polynomial
        is fetched once. If it is not, or (s, t) is outside the grid, both are NaN.
        """
        (i, j), (u, v) = self._locate(s, t)
        us, vt = u, v
        rows = self._rows(i, j, often=True)
        # Each step reduces the error by the slope of the fields (two directions, and twice for
        # the spline between its nodes).
        shrink = min(1.0, 4 * scale * self.largest_step)
        for _ in range(MAX_ITERATIONS):
            first, second = self._polynomials(rows, u, v)
            un, vn = us - scale * first, vt - scale * second
            change = max(_largest(un - u), _largest(vn - v))
            u, v = un, vn
            if not change * shrink > REST:
                break
        with np.errstate(invalid="ignore"):
            stayed = (
                (u >= 0)
                & (u <= 1)
                & (v >= 0)
                & (v <= 1)
                & (i + us == s)
                & (j + vt == t)
            )
        return np.where(stayed, i + u, np.nan), np.where(stayed, j + v, np.nan)

    def solve_point(self, s: float, t: float, scale: float) -> tuple[float, float]:
        """Return `solve_in_cell` of one finite position, bit for bit, without NumPy's 200 us."""
        nx, ny = self.shape
        i, j = min(max(int(s), 0), nx - 2), min(max(int(t), 0), ny - 2)
        us, vt = u, v = s - i, t - j
        side = self.degree + 1
        first, second = self.coefficients[i * (ny - 1) + j].tolist()
        shrink = min(1.0, 4 * scale * self.largest_step)
        for _ in range(MAX_ITERATIONS):
            un = us - scale * _horner_point(first, u, v, side)
            vn = vt - scale * _horner_point(second, u, v, side)
            change = max(abs(un - u), abs(vn - v))
            u, v = un, vn
            if not change * shrink > REST:
                break
        if 0 <= us <= 1 and 0 <= vt <= 1 and 0 <= u <= 1 and 0 <= v <= 1:
            return i + u, j + v
        return math.nan, math.nan

    def solve(
        self, s: np.ndarray, t: np.ndarray, scale: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the same as `solve_in_cell`, with the solution in any cell."""
        a, b = s, t
        for _ in range(MAX_ITERATIONS):
            first, second = self.at(a, b)
            an, bn = s - scale * first, t - scale * second
            with np.errstate(invalid="ignore"):
                resting = ~(np.abs(an - a) + np.abs(bn - b) > REST * max(self.shape))
            a, b = an, bn
            if resting.all():
                break
        return a, b

    def solve_point_anywhere(
        self, s: float, t: float, scale: float
    ) -> tuple[float, float]:
        """Return `solve` of one finite position, bit for bit, faster; NaN next to unknown nodes."""
        nx, ny = self.shape
        side = self.degree + 1
        a = s
        b = t
        tolerance = REST * max(self.shape)
        for _ in range(MAX_ITERATIONS):
            at_a, at_b = min(max(a, 0.0), nx - 1.0), min(max(b, 0.0), ny - 1.0)
            i, j = min(int(at_a), nx - 2), min(int(at_b), ny - 2)
            first, second = self.coefficients[i * (ny - 1) + j].tolist()
            an = s - scale * _horner_point(first, at_a - i, at_b - j, side)
            bn = t - scale * _horner_point(second, at_a - i, at_b - j, side)
            change = abs(an - a) + abs(bn - b)
            if math.isnan(change):
                return math.nan, math.nan
            a, b = an, bn
            if not change > tolerance:
                break
        return a, b

    def _locate(self, s: np.ndarray, t: np.ndarray) -> tuple[tuple, tuple]:
        """Return cell indices and coordinates inside the cell, 0..1; NaN stays NaN."""
        nx, ny = self.shape
        s, t = np.clip(s, 0, nx - 1), np.clip(t, 0, ny - 1)
        with np.errstate(invalid="ignore"):
            # A NaN position becomes some integer; u stays NaN and so does the result.
            i = np.clip(s.astype(np.int64), 0, nx - 2)
            j = np.clip(t.astype(np.int64), 0, ny - 2)
        return (i, j), (s - i, t - j)

    def _rows(self, i: np.ndarray, j: np.ndarray, *, often: bool = False) -> np.ndarray:
        """Return the coefficients of cells, (coefficients, P); contiguous if used `often`."""
        cell = i * (self.shape[1] - 1) + j
        if self.by_power is not None:
            return self.by_power.take(cell, axis=1)
        rows = (
            self.coefficients.reshape(len(self.coefficients), -1).take(cell, axis=0).T
        )
        return np.ascontiguousarray(rows) if often else rows

    def _polynomials(
        self, rows: np.ndarray, u: np.ndarray, v: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        side = self.degree + 1
        return (
            _horner(rows[: side * side], u, v, side),
            _horner(rows[side * side :], u, v, side),
        )


def _largest(step: np.ndarray) -> float:
    """Return the largest magnitude in `step`, ignoring NaN (unknown nodes, NaN positions)."""
    size = np.abs(step)
    largest = size.max(initial=0.0)
    return (
        size.max(initial=0.0, where=~np.isnan(size)) if np.isnan(largest) else largest
    )


def _horner(rows: np.ndarray, u: np.ndarray, v: np.ndarray, side: int) -> np.ndarray:
    """Return the sum of rows[p * side + q] u^p v^q, in place if possible."""
    out = np.zeros(0)
    for p in reversed(range(side)):
        inner = rows[p * side + side - 1] * v
        for q in reversed(range(1, side - 1)):
            inner += rows[p * side + q]
            inner *= v
        inner += rows[p * side]
        if p == side - 1:
            out = inner
        else:
            out *= u
            out += inner
    return out


def _horner_point(rows: list[list[float]], u: float, v: float, side: int) -> float:
    """Return the same as `_horner`, by the same operations on floats."""
    out = 0.0
    for p in reversed(range(side)):
        inner = rows[p][-1] * v
        for q in reversed(range(1, side - 1)):
            inner = (inner + rows[p][q]) * v
        inner += rows[p][0]
        out = inner if p == side - 1 else out * u + inner
    return out


def _known_corners(
    field: np.ndarray,
    cell: tuple[np.ndarray, np.ndarray],
    inside: tuple[np.ndarray, np.ndarray],
) -> np.ndarray:
    """Return bilinear values that ignore corners of zero weight, (P,)."""
    (i, j), (u, v) = cell, inside
    u, v = (np.where(abs(w - np.round(w)) < SNAP, np.round(w), w) for w in (u, v))
    out = np.zeros(len(u))
    for di, wx in ((0, 1 - u), (1, u)):
        for dj, wy in ((0, 1 - v), (1, v)):
            weight = wx * wy
            out += np.where(weight == 0, 0.0, weight * field[i + di, j + dj])
    return out


def bilinear_cells(fields: np.ndarray) -> Cells:
    """Return the bilinear interpolant of `fields` (2, nx, ny); NaN nodes are allowed."""
    f00 = fields[:, :-1, :-1]
    f10 = fields[:, 1:, :-1]
    f01 = fields[:, :-1, 1:]
    f11 = fields[:, 1:, 1:]
    c = np.stack([f00, f01 - f00, f10 - f00, f11 - f10 - f01 + f00], axis=-1)
    return _cells(c, 2, fields)


def bicubic_cells(fields: np.ndarray, *, local: bool = False) -> Cells:
    """Return the interpolating bicubic spline of `fields` (2, nx, ny), without NaN.

    See `cubic_pieces`.
    """
    along_x = cubic_pieces(fields.swapaxes(0, 1), local=local)  # p, i, field, j
    # q, j, p, i, field
    along_xy = cubic_pieces(along_x.transpose(3, 0, 1, 2), local=local)
    return _cells(along_xy.transpose(4, 3, 1, 2, 0), 4, fields)


def _cells(c: np.ndarray, side: int, fields: np.ndarray) -> Cells:
    """Return cells from coefficients (field, i, j, p, q)."""
    count = c.shape[1] * c.shape[2]
    by_cell = np.ascontiguousarray(
        c.reshape(2, count, side, side).transpose(1, 0, 2, 3)
    )
    by_power = None
    if by_cell.nbytes <= SMALL:
        by_power = np.ascontiguousarray(by_cell.reshape(count, -1).T)
    return Cells(fields.shape[1:], side - 1, by_cell, fields, by_power)
