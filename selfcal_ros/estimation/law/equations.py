# SPDX-License-Identifier: Apache-2.0
"""Hu's law as linear maps on arrays, step by step (Hu eqs. 16-28, method eqs. 5.1-5.10).

Every array has a last axis of columns, so that the same code solves the readings (one column)
and propagates the noise of each reading (one column per reading).
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.error_map import ThetaDatum, half_axis_slopes


@dataclass(frozen=True, eq=False)
class HuReadings:
    """Deviations of Hu's four views: v0, v1 (2, N, N, C), v3 (2, N-1, N, C), vt (4, K, C)."""

    v0: np.ndarray
    v1: np.ndarray
    v3: np.ndarray
    vt: np.ndarray


@dataclass(frozen=True, eq=False)
class HuSolution:
    """Solution of the law, one column for each column of readings.

    `g`, `a` (2, N, N, C) in m; `g_theta`, `a_theta` (K, C) in rad; `phi` (4, C); `t` (4, 2, C),
    NaN for view 2; `o`, `r` (C,); `rest_xy`, `rest_theta`: residuals of eqs. 23, 25 and 28.
    """

    g: np.ndarray
    a: np.ndarray
    g_theta: np.ndarray
    a_theta: np.ndarray
    phi: np.ndarray
    t: np.ndarray
    o: np.ndarray
    r: np.ndarray
    rest_xy: np.ndarray
    rest_theta: np.ndarray


class HuLaw:
    """The law for one artifact, with its two least-squares problems factorised once.

    Parameters
    ----------
    artifact : Artifact
        Square plate with angular lines.
    datum : ThetaDatum
        `xy_axes` uses Hu eq. 27; `zero_mean` replaces it by a zero sum.
    axis_lines : int array (4,)
        Lines whose angular error eq. 27 gives; -1 times the slope for the second sense.
    axis_sign : int
        +1, or -1 for the second sense.
    """

    def __init__(self, artifact: Artifact, datum: ThetaDatum, axis_lines: np.ndarray,
                 axis_sign: int) -> None:
        self.artifact, self.datum, self.axis_sign = artifact, datum, axis_sign
        self.x, self.y = artifact.x_m[..., None], artifact.y_m[..., None]
        self.sum_r2 = float((artifact.x_m**2 + artifact.y_m**2).sum())
        self.rows_xy = _rows_xy(artifact.grid_size)
        self.solve_xy = _bordered(self.rows_xy, _first_order_rows(artifact))
        self.rows_theta, ties = _rows_theta(artifact.angular_count, datum, axis_lines)
        self.solve_theta = _bordered(self.rows_theta, ties)
        self.phi3_rest = self._left_by_phi3()

    def solve(self, readings: HuReadings) -> HuSolution:
        """Return the solution for every column of `readings`."""
        x, y, d = self.x, self.y, self.sum_r2
        v0, v1, v3, vt = readings.v0, readings.v1, readings.v3, readings.vt
        t0, t1 = v0.mean(axis=(1, 2)), v1.mean(axis=(1, 2))                          # eq. 16
        phi0 = (v0[1] * x - v0[0] * y).sum(axis=(0, 1)) / d                          # eq. 16
        phi1 = -(v1[0] * x + v1[1] * y).sum(axis=(0, 1)) / d                         # eq. 16
        phi2 = vt[2].mean(axis=0) - vt[0].mean(axis=0) + phi0                        # eq. 17
        phi3 = vt[3].mean(axis=0) - vt[0].mean(axis=0) + phi0                        # eq. 17
        u0x, u0y = v0[0] - t0[0] + phi0 * y, v0[1] - t0[1] - phi0 * x                # eq. 18
        u1x, u1y = v1[0] - t1[0] + phi1 * x, v1[1] - t1[1] + phi1 * y                # eq. 19
        u3x, u3y = v3[0] + phi3 * y[:-1], v3[1] - phi3 * x[:-1]                      # eq. 21
        o = ((u0x * y + u0y * x) + (u1x * x - u1y * y)).sum(axis=(0, 1)) / (2 * d)   # eq. 22
        r = ((u0x * x - u0y * y) - (u1x * y + u1y * x)).sum(axis=(0, 1)) / (2 * d)   # eq. 22
        quarter = (u0x - u1y - 2 * o * y - 2 * r * x, u0y + u1x - 2 * o * x + 2 * r * y)  # eq. 23
        step = (u3x - u0x[:-1], u3y - u0y[:-1])                                      # eq. 24
        right = np.concatenate([_columns(part) for part in (
            *quarter, *(np.diff(part, axis=axis) for part in step for axis in (0, 1)))])  # eq. 25
        f, rest_xy = self.solve_xy(right, np.zeros((6, right.shape[1])))             # eq. 26
        rest_xy -= self.phi3_rest[:, None] * (self.phi3_rest @ rest_xy)
        f = f.reshape(v0.shape)
        g = np.stack([o * y + r * x + f[0], o * x - r * y + f[1]])                   # eq. 6
        phi = np.stack([phi0, phi1, phi2, phi3])
        g_theta, rest_theta = self._theta(vt - phi[:, None], g)
        a = np.stack([u0x, u0y]) - g                                                 # eq. 18
        t3 = v3 - g[:, 1:] - a[:, :-1] - phi3 * np.stack([-y, x])[:, :-1]            # eq. 15
        t = np.stack([t0, t1, np.full_like(t0, np.nan), t3.mean(axis=(1, 2))])
        return HuSolution(g, a, g_theta, vt[0] - phi0 - g_theta, phi, t, o, r, rest_xy, rest_theta)

    def _left_by_phi3(self) -> np.ndarray:
        """Return the residual of eq. 25 caused by an error of phi3, of unit length.

        phi3 comes from the angular lines alone (eq. 17), so its error is angular noise: it is
        removed from the residuals before the noise of the grid readings is estimated from them.
        """
        step = np.stack([np.broadcast_to(self.y, (*self.artifact.shape, 1)),
                         np.broadcast_to(-self.x, (*self.artifact.shape, 1))])[:, :-1]
        quarter = np.zeros((2 * self.x.size, 1))
        right = np.concatenate([quarter, *(_columns(np.diff(part, axis=axis))
                                           for part in step for axis in (0, 1))])
        rest = self.solve_xy(right, np.zeros((6, 1)))[1][:, 0]
        return rest / np.linalg.norm(rest)

    def _theta(self, u: np.ndarray, g: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return Gtheta from the axis slopes (eq. 27) and the circle's differences (eq. 28)."""
        right = np.concatenate([u[1] - u[0], u[2] - u[0]])
        if self.datum is ThetaDatum.ZERO_MEAN:
            return self.solve_theta(right, np.zeros((1, right.shape[1])))
        slopes = self.axis_sign * half_axis_slopes(self.artifact, g)
        return self.solve_theta(right, slopes)


def _columns(part: np.ndarray) -> np.ndarray:
    return part.reshape(-1, part.shape[-1])


def _diagonals(values: tuple[float, ...], shape: tuple[int, int]) -> sparse.csr_array:
    """Return a matrix of constant diagonals, the main one first; SciPy 1.11 lacks diags_array."""
    return sparse.dia_array((np.outer(values, np.ones(shape[1])), range(len(values))),
                            shape=shape).tocsr()


def _identity(size: int) -> sparse.csr_array:
    return _diagonals((1.0,), (size, size))


def _rows_xy(size: int) -> sparse.csr_array:
    """Return the left-hand sides of eqs. 23 and 25 for F as (2, N, N) flattened."""
    one = _identity(size)
    first = _diagonals((-1.0, 1.0), (size - 1, size))
    second = first[:-1, :-1] @ first
    curve = sparse.kron(second, one)                       # F(m+2,n) - 2 F(m+1,n) + F(m,n)
    twist = sparse.kron(first, first)                      # the mixed difference
    full = _identity(size * size)
    i, j = (index.ravel() for index in np.indices((size, size)))
    turned = full[(size - 1 - j) * size + i]               # value at (-n, m)
    return sparse.csr_array(sparse.bmat([[full, -turned], [turned, full], [curve, None],
                                         [twist, None], [None, curve], [None, twist]]))


def _first_order_rows(artifact: Artifact) -> np.ndarray:
    """Return the six sums of eq. 7 over F, in lattice units."""
    one = np.ones(artifact.shape)
    rows = np.zeros((6, 2, *artifact.shape))
    for index, weight in enumerate((one, *artifact.places(artifact.m, artifact.n))):
        rows[index, 0] = rows[index + 3, 1] = weight / np.linalg.norm(weight)
    return rows.reshape(6, -1)


def _rows_theta(count: int, datum: ThetaDatum, axis_lines: np.ndarray,
                ) -> tuple[sparse.csr_array, np.ndarray]:
    one = _identity(count)
    k = np.arange(count)
    rows = sparse.csr_array(sparse.vstack([one[(k + count // 4) % count] - one,
                                           one[(k + 1) % count] - one]))
    if datum is ThetaDatum.ZERO_MEAN:
        return rows, np.full((1, count), 1 / np.sqrt(count))
    return rows, one[axis_lines].toarray()


def _bordered(rows: sparse.csr_array, ties: np.ndarray,
              ) -> Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """Return a least-squares solver for `rows` together with the few dense rows `ties`.

    The dense rows border the normal matrix, so that it stays sparse. The solver takes the
    right-hand sides of both and returns the solution and the residuals of `rows`.
    """
    unknowns = rows.shape[1]
    bordered = sparse.csc_array(sparse.bmat(
        [[rows.T @ rows, sparse.csr_array(ties).T],
         [sparse.csr_array(ties), -_identity(len(ties))]]))
    factor = splu(bordered, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.01,
                  options={"SymmetricMode": True})

    def solve(right: np.ndarray, tied: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        found = factor.solve(np.concatenate([rows.T @ right, tied]))[:unknowns]
        rest, slack = right - rows @ found, tied - ties @ found
        more = factor.solve(np.concatenate([rows.T @ rest, slack]))[:unknowns]
        return found + more, rest - rows @ more            # one refinement: to rounding

    return solve
