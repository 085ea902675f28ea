# SPDX-License-Identifier: Apache-2.0
"""Least squares over all diagonals with the exact geometry of the new formulation, 2D and 3D.

Model: R[k, j, i] = s[k, j] w_k . d[j, i]. Assumptions, those of the source:

1. the linear errors E_j(j) are known;
2. the laser of diagonal k lies along the machine's own diagonal D_k = sum of its steps, so that
   w_k . D_k = |D_k| (eq. 3 for the whole run); any w_k with this property is D_k/|D_k| plus a
   vector t_k perpendicular to D_k: the mirror's tilt, unknown, D - 1 numbers per diagonal (eq. 4);
3. the mirror rotates in no block (no angular errors of the machine);
4. datum: the first X step has no transverse error; in 3D the first Y step has no Z error.

2D: 2n - 1 errors and one tilt per diagonal from 2n readings per diagonal: one diagonal suffices,
two leave 2n - 1 redundant readings. 3D: 6n - 3 errors and 8 tilts from 12n readings.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from selfcal_ros.applications.laser.data import StepDiagonal, step_vectors
from selfcal_ros.errors import InputError, NotIdentifiableError

MAX_ITERATIONS = 30
CONVERGED = 1e-12
"""Convergence: largest last correction, relative to the largest step."""


@dataclass(frozen=True, eq=False)
class Adjusted:
    """Solution of the adjustment.

    Attributes
    ----------
    errors_m : float array (D, n, D)
        All errors; the linear ones are the given ones.
    tilt : float array (K, D-1)
        Components of t_k along the rows of `Geometry.sideways`.
    by_readings, by_linear : float arrays (D*n*D, K*D*n) and (D*n*D, D*n)
        Derivatives of the errors with respect to readings and linear errors.
    residuals_m : float array (K, D, n)
        Readings minus model.
    residuals_by_readings, residuals_by_linear : float arrays (K*D*n, K*D*n) and (K*D*n, D*n)
        Their derivatives.
    """

    errors_m: np.ndarray
    tilt: np.ndarray
    by_readings: np.ndarray
    by_linear: np.ndarray
    residuals_m: np.ndarray
    residuals_by_readings: np.ndarray
    residuals_by_linear: np.ndarray


class Geometry:
    """Model readings and their derivatives for given steps, diagonals and number of blocks."""

    def __init__(self, data: StepDiagonal) -> None:
        self.steps = np.array(data.steps_m)
        self.signs = data.signs
        self.dim, self.n = data.dim, data.n_blocks
        self.shape = (len(data.diagonals), self.dim, self.n)

    @cached_property
    def free(self) -> np.ndarray:
        """Unknown errors, bool (D, n, D): all but the linear ones and the datum."""
        free = np.ones((self.dim, self.n, self.dim), dtype=bool)
        for j in range(self.dim):
            free[j, :, j] = False
            free[j, 0, j + 1 :] = False
        return free

    @cached_property
    def sideways(self) -> np.ndarray:
        """Unit vectors normal to the nominal diagonals, (K, D-1, D); 2D: counter-clockwise."""
        out = []
        for signs in self.signs:
            along = signs * self.steps / np.linalg.norm(self.steps)
            if self.dim == 2:
                out.append(np.array([[-along[1], along[0]]]))
                continue
            level = np.array([-along[1], along[0], 0.0]) / np.hypot(along[0], along[1])
            out.append(np.array([level, np.cross(along, level)]))
        return np.array(out)

    def readings(self, errors_m: np.ndarray, tilt: np.ndarray) -> np.ndarray:
        """Return the model readings, (K, D, n), m."""
        vectors = step_vectors(self.steps, errors_m)
        w, *_ = self._directions(vectors, tilt)
        return self.signs[:, :, None] * np.einsum("kc,jic->kji", w, vectors)

    def _directions(
        self, vectors: np.ndarray, tilt: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return w (K, D), dw/dD (K, D, D) and dw/dtilt (K, D, D-1)."""
        along = np.einsum("kj,jic->kc", self.signs, vectors)
        length = np.linalg.norm(along, axis=1)[:, None]
        unit = along / length
        project = np.eye(self.dim) - unit[:, :, None] * unit[:, None, :]
        t = np.einsum("km,kmc->kc", tilt, self.sideways)
        slip = np.einsum("kc,kc->k", unit, t)[:, None]
        w = unit + t - slip * unit
        # unit changes by P dD / |D|; w = unit + t - (unit . t) unit follows it.
        chain = (1.0 - slip)[:, :, None] * np.eye(self.dim) - unit[:, :, None] * t[
            :, None, :
        ]
        by_along = chain @ project / length[:, :, None]
        by_tilt = np.einsum("kce,kme->kcm", project, self.sideways)
        return w, by_along, by_tilt

    def derivatives(
        self, errors_m: np.ndarray, tilt: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return dR/dE (K*D*n, D*n*D) and dR/dtilt (K*D*n, K*(D-1))."""
        vectors = step_vectors(self.steps, errors_m)
        w, by_along, by_tilt = self._directions(vectors, tilt)
        n_k, dim, n = self.shape
        sign = self.signs
        by_errors = np.einsum(
            "kj,kJ,jikc->kjiJc",
            sign,
            sign,
            np.tensordot(vectors, by_along, axes=(2, 1)),
        )[:, :, :, :, None].repeat(n, axis=4)
        j, i = np.ogrid[:dim, :n]
        by_errors[:, j, i, j, i] += np.moveaxis(sign.T[:, None, :, None] * w, 2, 0)
        by_tilts = np.zeros((n_k, dim, n, n_k, dim - 1))
        k = np.arange(n_k)
        readings_by_tilt = np.tensordot(vectors, by_tilt, axes=(2, 1))  # (j, i, k, m)
        by_tilts[k, :, :, k] = sign[:, :, None, None] * np.moveaxis(
            readings_by_tilt, 2, 0
        )
        rows = n_k * dim * n
        return by_errors.reshape(rows, -1), by_tilts.reshape(rows, -1)


def adjust(data: StepDiagonal) -> Adjusted:
    """Return the errors and mirror tilts that fit all readings best, weighted by repeats.

    Raises
    ------
    NotIdentifiableError
        If the diagonals do not determine the errors.
    InputError
        If the least squares does not converge: readings and steps do not belong to the same
        machine.
    """
    geometry = Geometry(data)
    linear = data.linear_mean_m
    errors = np.zeros((data.dim, data.n_blocks, data.dim))
    for j in range(data.dim):
        errors[j, :, j] = linear[j]
    tilt = np.zeros((len(data.diagonals), data.dim - 1))
    weights = np.sqrt(data.counts).ravel()
    free = geometry.free.ravel()
    for _ in range(MAX_ITERATIONS):
        misfit = data.readings_m - geometry.readings(errors, tilt)
        by_errors, by_tilt = geometry.derivatives(errors, tilt)
        pinv = _solver(
            np.hstack([by_errors[:, free], by_tilt]) * weights[:, None], data
        )
        change = pinv @ (weights * misfit.ravel())
        errors[geometry.free] += change[: free.sum()]
        tilt += change[free.sum() :].reshape(tilt.shape)
        if np.abs(change[: free.sum()]).max() <= CONVERGED * max(data.steps_m):
            break
    else:
        raise InputError(
            "readings",
            "the least squares does not converge",
            "check units, steps and the order of the columns",
        )
    return _solution(data, geometry, (errors, tilt, pinv * weights))


def _solver(matrix: np.ndarray, data: StepDiagonal) -> np.ndarray:
    """Return the pseudo-inverse of a matrix of full column rank."""
    scale = np.linalg.norm(matrix, axis=0)
    scaled = matrix / np.maximum(scale, np.finfo(float).tiny)
    u, s, vt = np.linalg.svd(scaled, full_matrices=False)
    if matrix.shape[0] < matrix.shape[1] or s[-1] < 1e-9 * s[0]:
        raise NotIdentifiableError(
            f"diagonals {', '.join(data.diagonals)}: they do not determine the errors of "
            f"{data.dim} axes; measure the missing diagonals"
        )
    return (vt.T / s) @ u.T / scale[:, None]


def _solution(
    data: StepDiagonal,
    geometry: Geometry,
    estimate: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> Adjusted:
    errors, tilt, gain_of_all = estimate
    by_errors, by_tilt = geometry.derivatives(errors, tilt)
    is_linear = np.zeros(geometry.free.shape, dtype=bool)
    for j in range(data.dim):
        is_linear[j, :, j] = True
    is_linear = is_linear.ravel()
    free = geometry.free.ravel()
    gain = gain_of_all[: free.sum()]
    residual_by_reading = (
        np.eye(len(by_errors)) - np.hstack([by_errors[:, free], by_tilt]) @ gain_of_all
    )
    by_readings = np.zeros((free.size, gain.shape[1]))
    by_readings[free] = gain
    by_linear = np.zeros((free.size, int(is_linear.sum())))
    by_linear[is_linear] = np.eye(int(is_linear.sum()))
    by_linear[free] = -gain @ by_errors[:, is_linear]
    return Adjusted(
        errors_m=errors,
        tilt=tilt,
        by_readings=by_readings,
        by_linear=by_linear,
        residuals_m=data.readings_m - geometry.readings(errors, tilt),
        residuals_by_readings=residual_by_reading,
        residuals_by_linear=-residual_by_reading @ by_errors[:, is_linear],
    )
