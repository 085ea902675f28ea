# SPDX-License-Identifier: Apache-2.0
"""Large fields: conjugate gradients with a cosine-transform preconditioner (method eq. 8.2).

The plate and the misalignments are eliminated exactly in every product; only the stage map is
iterated. Fields that a quarter turn maps to themselves are subject to differences over a shift
only, a Laplacian with free edges; all others to a turn as well, a Laplacian plus a constant.
Both are diagonal under the DCT-II, in whose basis a quarter turn is a transposition with signs.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
from scipy.fft import dct, dctn, idctn, next_fast_len

from selfcal_ros.errors import InputError
from selfcal_ros.estimation.joint.problem import (
    AngularPart,
    FreeNetworkSolution,
    Problem,
    grid_noise,
    weight_ratio,
)
from selfcal_ros.estimation.lattice.maps import PHASES
from selfcal_ros.estimation.normal.grid import GridSystem

TOLERANCE = 1e-12
"""Residual of the normal equations at which the iteration ends, relative to the right-hand side."""

DENSE_DCT = 600
"""Largest side for a cosine transform by matrix product."""

MAX_ITERATIONS = 2000


class GridIteration:
    """Matrix-free normal equations of the grid readings, misalignments eliminated.

    Parameters
    ----------
    grid : GridSystem
        The readings.
    inverse : float array (3 views, 3 views)
        Pseudo-inverse of the misalignments' block, including the angular readings.
    """

    def __init__(self, grid: GridSystem, inverse: np.ndarray) -> None:
        self.grid, self.inverse = grid, inverse
        self._diagonal = grid.views.scatter_weight(grid.weight)
        self._symbols = preconditioner_symbols(grid)
        self._missing = missing_mark_correction(grid)
        size = max(grid.views.shape)
        slow = next_fast_len(size, real=True) != size and size <= DENSE_DCT
        self._cosines = (dct(np.eye(size, dtype=np.float32), axis=0, norm="ortho") if slow
                         else None)
        self._pool = ThreadPoolExecutor(2) if slow else None
        self._x, self._y = grid.views.z[:, 0].real, grid.views.z[0].imag

    def spread(self, parameters: np.ndarray) -> np.ndarray:
        """Return C parameters as a field."""
        p = parameters.reshape(-1, 3)
        flat = np.stack([p[:, 0] + 0j, p[:, 1] + 1j * p[:, 2]], axis=1).ravel() @ self.grid.columns
        return flat.reshape(self.grid.views.shape)

    def product(self, field: np.ndarray) -> np.ndarray:
        """Return the normal matrix times a field."""
        grid = self.grid
        mean = grid.views.gather_mean(field, grid.relative_weight)
        out = self._diagonal * field
        grid.views.subtract_scattered(out, grid.weight, mean)
        out -= self.spread(self.inverse @ grid.coupled(field.ravel()))
        return out

    def remove_rigid(self, field: np.ndarray) -> None:
        """Remove the rigid modes, undetermined and fed by rounding, from a field."""
        rows, columns = field.sum(axis=1), field.sum(axis=0)
        mean = rows.sum() / field.size
        turn = (self._x @ rows - 1j * (self._y @ columns)) / (
            field.shape[1] * (self._x @ self._x) + field.shape[0] * (self._y @ self._y))
        field -= (mean + turn * self._x)[:, None]
        field -= 1j * turn * self._y

    def precondition(self, field: np.ndarray) -> np.ndarray:
        """Return an approximate inverse of the normal matrix times a field."""
        shape, size, loose = field.shape, max(field.shape), self._missing * field
        low = [(size - n) // 2 for n in shape]
        part = np.s_[low[0]:low[0] + shape[0], low[1]:low[1] + shape[1]]
        if shape != (size, size):
            square = np.zeros((size, size), dtype=complex)
            square[part] = field
            field = square
        turning, rest = self._symbols
        hat = self._transform(field.astype(np.complex64), dctn)
        turned = hat.T.copy()
        turned[::2] *= np.complex64(1j)
        turned[1::2] *= np.complex64(-1j)
        turned += hat
        turned *= turning
        hat *= rest
        hat += turned
        loose += self._transform(hat, idctn)[part]
        return loose

    def _transform(self, field: np.ndarray, transform: Callable) -> np.ndarray:
        """Return the DCT-II of a field or its inverse, in single precision.

        A fast transform is slow for lengths with large prime factors; up to `DENSE_DCT` a matrix
        product is faster.
        """
        if self._cosines is None or self._pool is None:
            return transform(field, type=2, norm="ortho", workers=-1)
        cosines = self._cosines if transform is dctn else self._cosines.T
        out = np.empty_like(field)

        def transform_part(name: str) -> None:
            part = np.ascontiguousarray(getattr(field, name))
            setattr(out, name, cosines @ part @ cosines.T)

        # two parts, two threads: neither depends on the other
        list(self._pool.map(transform_part, ("real", "imag")))
        return out

    def solve(self, b: np.ndarray, d: np.ndarray, *, start: np.ndarray | None = None,
              tolerance: float = TOLERANCE, before: int = 0) -> FreeNetworkSolution:
        """Return the solution of the normal equations.

        Parameters
        ----------
        b : complex array (nx, ny)
            Right-hand side of the sites.
        d : float array (3 views,)
            Right-hand side of the misalignments.
        start : complex array (nx, ny), optional
            Field to start from.
        tolerance : float
            Relative residual to reach.
        before : int
            Number of iterations to `start`.

        Raises
        ------
        InputError
            If the residual does not reach `tolerance`: weights differ by many orders of magnitude.
        """
        right = b - self.spread(self.inverse @ d)
        self.remove_rigid(right)
        target = tolerance * _norm(right)
        field = np.zeros_like(b) if start is None else start.copy()
        residual = right - self.product(field) if start is not None else right.copy()
        count, direction, rho = 0, np.zeros_like(b), 1.0
        while (size := _norm(residual)) > target:
            if count == MAX_ITERATIONS:
                raise InputError(
                    "weights", f"the residual stays at {size / target * tolerance:.1e} after "
                    f"{MAX_ITERATIONS} iterations, because repeats or declared uncertainties "
                    "differ too much", "leave out the weakest readings")
            z = self.precondition(residual)
            new = _dot(residual, z)
            direction *= new / rho if count else 0.0
            direction += z
            rho = new
            image = self.product(direction)
            step = rho / _dot(direction, image)
            field += step * direction
            image *= step
            residual -= image
            self.remove_rigid(residual)
            count += 1
        true = _norm(right - self.product(field)) / max(_norm(right), 1e-300)
        return FreeNetworkSolution(
            field, self.inverse @ (d - self.grid.coupled(field.ravel())), None, np.zeros((0, 0)),
            {"method": "conjugate gradients", "iterations": before + count,
             "relative_residual": true})


def preconditioner_symbols(grid: GridSystem) -> tuple[np.ndarray, np.ndarray]:
    """Return the diagonals for hat + T hat (turning fields) and for hat (all), (N, N).

    T is a quarter turn in the DCT basis; (hat + T hat) / 2 where kx + ky is odd is the part of a
    field that quarter turns map to itself.
    """
    size = max(grid.views.shape)
    k = np.arange(size) * (np.pi / size)
    laplace = np.zeros((size, size))
    other = np.zeros((size, size))
    pairs = [(i, j) for i in range(grid.n_views) for j in range(i)]
    for i, j in pairs:
        weight = np.vdot(grid.weight[i], grid.relative_weight[j])
        weight = weight / max(np.count_nonzero(grid.read[i]), 1)
        p, r = grid.views.poses[i], grid.views.poses[j]
        shift = (PHASES[-p.q % 4] * complex(p.a, p.b) - PHASES[-r.q % 4] * complex(r.a, r.b))
        a, b = round(shift.real), round(shift.imag)
        both = np.outer(np.cos(a * k), np.cos(b * k)) + np.outer(np.cos(b * k), np.cos(a * k))
        laplace += weight * (2 - both)
        same = (p.q - r.q) % 4 == 0
        other += weight * ((2 - both) if same else (2 + both / 3))
    odd = (np.arange(size)[:, None] + np.arange(size)) % 2 == 1
    floor = 1e-3 * laplace[laplace > 0].min(initial=1.0)
    inverse = 1 / np.maximum(other, floor)
    turning = np.where(odd, 0.5 * (1 / np.maximum(laplace, floor) - inverse), 0.0)
    return turning.astype(np.float32), inverse.astype(np.float32)


def missing_mark_correction(grid: GridSystem) -> np.ndarray:
    """Return the excess of the inverse's diagonal over that of a full plate.

    The transform assumes full plates; sites that lack readings are less constrained. This
    correction keeps the number of steps from growing with the number of missing marks.
    """
    views = grid.views
    mean = float(grid.weight.sum() / max(grid.n_readings, 1))
    full = GridSystem(views.poses, views.in_field * mean, views.unit)
    now, then = (views.scatter_weight(one.weight * (1 - one.relative_weight))
                 for one in (grid, full))
    good = (now > 0) & (then > 0)
    out = np.zeros(views.shape)
    out[good] = np.maximum(1 / now[good] - 1 / then[good], 0.0)
    return out


def _dot(a: np.ndarray, b: np.ndarray) -> float:
    """Return Re(a, b); with one BLAS thread the order of the sum is fixed."""
    return float(np.vdot(a, b).real)


def _norm(a: np.ndarray) -> float:
    return float(np.sqrt(_dot(a, a)))


ROUGH = 1e-6
"""Relative residual at which the noise of the grid readings is estimated, for the weights."""


def solve_iterated(problem: Problem, y: np.ndarray, theta: AngularPart) -> FreeNetworkSolution:
    """Return the solution of the joint equations by conjugate gradients.

    An approximate solution of the grid readings alone gives their noise; then the angular readings
    join, and the iteration continues to full accuracy.
    """
    system, grid = problem.system, problem.system.grid
    n, length = 3 * grid.n_views, problem.half_width_m
    plain = _block_inverse(problem, np.zeros((grid.n_views, grid.n_views)))
    _, d = grid.right_side(y)
    near = plain @ d
    # misalignments are far larger than errors: subtract first, or their rounding remains
    b, d = grid.right_side(np.where(grid.read, y - grid.misaligned(near), 0.0))
    b = b.reshape(grid.views.shape)
    kernel = GridIteration(grid, plain)
    if not system.angular.n_views:
        found = kernel.solve(b, d)
        return replace(found, parameters=near + found.parameters)

    rough = kernel.solve(b, d, tolerance=ROUGH)
    _, residual = grid.plate(y, rough.field, near + rough.parameters)
    sigma = grid_noise(problem, residual).sigma
    ratio = weight_ratio(problem, sigma, theta.noise.sigma, y)
    normal, right, rest = _angular_on_grid(problem, theta)
    phi_near = near[::3]
    kernel.inverse = _block_inverse(problem, ratio * normal)
    d = d.copy()
    d[::3] += ratio * (length * right - normal @ phi_near)
    found = kernel.solve(b, d, start=rough.field, before=rough.solver["iterations"])
    parameters = np.zeros(system.size)
    parameters[:n] = near + found.parameters
    at, matrix, offset = rest
    parameters[at] = length * offset - matrix @ parameters[:n:3]
    return replace(found, parameters=parameters)


def _block_inverse(problem: Problem, of_phi: np.ndarray) -> np.ndarray:
    """Return the pseudo-inverse of the misalignments' block plus `of_phi` on the rotations."""
    grid = problem.system.grid
    block = grid.block.copy()
    block[::3, ::3] += of_phi
    block = grid.tied(block)
    null = np.hstack([np.linalg.qr(grid.rigid[4:].T)[0], grid.differences])
    scale = float(np.trace(block))
    held = scale * (null @ null.T)
    return np.linalg.inv(block + held) - held / scale**2


def _angular_on_grid(problem: Problem, theta: AngularPart) -> tuple:
    """Return the angular equations of phi of the grid views, and the relation to the other phi.

    Returns
    -------
    normal, right : arrays
        Over the grid views; phi of purely angular views eliminated.
    rest : tuple
        Indices of the other phi among the misalignments, and matrix and offset (rad) of
        phi = offset - matrix @ phi of the grid views.
    """
    system, schur = problem.system, problem.system.angular.schur
    n_views = system.grid.n_views
    shared = np.flatnonzero(system.phi_at < 3 * n_views)
    other = np.flatnonzero(system.phi_at >= 3 * n_views)
    inverse = np.linalg.pinv(schur[np.ix_(other, other)], hermitian=True)
    coupling = inverse @ schur[np.ix_(other, shared)]
    rows = system.phi_at[shared] // 3
    normal, right = np.zeros((n_views, n_views)), np.zeros(n_views)
    normal[np.ix_(rows, rows)] = (schur[np.ix_(shared, shared)]
                                  - schur[np.ix_(shared, other)] @ coupling)
    right[rows] = theta.d[shared] - coupling.T @ theta.d[other]
    matrix = np.zeros((len(other), n_views))
    matrix[:, rows] = coupling
    return normal, right, (system.phi_at[other], matrix, inverse @ theta.d[other])
