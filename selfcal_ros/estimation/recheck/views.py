# SPDX-License-Identifier: Apache-2.0
"""Views of a known plate as generalised least squares (method eq. 13.1).

The plate's error is known with a covariance, the same in all readings of a mark. So the readings
less the known plate have the noise of the reading and that of the plate, and the map is the best
linear estimate under the covariance of both together: dense, over all readings.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

from selfcal_ros.blocks import block_of
from selfcal_ros.errors import InputError, NotIdentifiableError, NotSettledError
from selfcal_ros.estimation.joint.problem import Problem
from selfcal_ros.estimation.joint.solved import MICROSCOPE_PARTS
from selfcal_ros.estimation.lattice.connectivity import Gauge
from selfcal_ros.estimation.lattice.maps import LatticeViews
from selfcal_ros.estimation.normal.angular import HarmonicSystem
from selfcal_ros.estimation.normal.placed import CORE, KNOWN, VAGUE
from selfcal_ros.estimation.normal.systems import Marks, lines_of
from selfcal_ros.estimation.terms.columns import TermColumns
from selfcal_ros.model.readings import Measurements
from selfcal_ros.model.result import Observability

MOST_STEPS = 50
"""Most steps to the places of the stage and the rotations of the plate."""

MOST_DATUMS = 12
"""Most datums from that of the core to that of the known nodes."""

STILL = 1e-13
"""Change of a reading, m, that counts as zero."""


@dataclass(frozen=True, eq=False)
class Gain:
    """A linear estimate in its datum.

    Attributes
    ----------
    rows : float array (q, r)
        What the estimate makes of a unit of each reading.
    noise : float array (r, r)
        Covariance of the readings for which it is the best.
    free : float array (q,)
        Variance that the prior leaves each unknown; 0 where the readings determine it.
    """

    rows: np.ndarray
    noise: np.ndarray
    free: np.ndarray | float = 0.0

    @property
    def covariance(self) -> np.ndarray:
        """Covariance of the estimate, (q, q)."""
        return self.rows @ self.noise @ self.rows.T


def least_squares(design: np.ndarray, noise: np.ndarray, held: np.ndarray,
                  vague: float = 0.0) -> Gain:
    """Return the generalised least squares with combinations `held` at 0.

    Parameters
    ----------
    design : float array (r, q)
        Readings for a unit of each unknown, but for the combinations held, which change none.
    noise : float array (r, r)
        Covariance of the readings.
    held : float array (q, k)
        Orthonormal combinations of the unknowns.
    vague : float
        Information on every unknown, relative to the mean. What the readings do not determine has
        no rows, as if it were 0: `free` tells it.

    Raises
    ------
    InputError
        If the noise is none.
    """
    try:
        root = np.linalg.cholesky(noise)
    except np.linalg.LinAlgError as error:
        raise InputError("readings", "they or those of the calibration have no noise against which "
                         "to judge a change", "use measured readings") from error
    white = solve_triangular(root, design, lower=True)
    normal = white.T @ white
    size = np.trace(normal) / len(normal)
    normal[np.diag_indices(len(normal))] += vague * size
    normal += size * held @ held.T
    half = np.linalg.solve(normal, white.T)
    free = vague * size * (np.linalg.inv(normal)**2).sum(axis=1) if vague else 0.0
    return Gain(solve_triangular(root, half.T, lower=True, trans="T").T, noise, free)


@dataclass(frozen=True, eq=False)
class PlateReadings:
    """Readings of known marks.

    Attributes
    ----------
    measurements : Measurements
        The readings.
    problem : Problem
        The same in the frame of the plate as placed.
    columns : TermColumns
        Terms of the model.
    at : tuple of int arrays (r,)
        View, row and column of each reading of a known mark.
    stop : int array (r,)
        Index of the stop of the stage at which each was made; empty without images.
    """

    measurements: Measurements
    problem: Problem
    columns: TermColumns
    at: tuple[np.ndarray, ...]
    stop: np.ndarray

    @property
    def weight(self) -> np.ndarray:
        """Weight of each reading, (r,)."""
        return self.problem.grid.weight[self.at]

    def of_field(self) -> np.ndarray:
        """Return the readings for a unit of the stage's error at each node, complex (r, n)."""
        views, frames = self.problem.system.grid.views, self.problem.frames[self.at[0]]
        n, nodes = views.z_sites.size, views.z_sites.shape
        if isinstance(views, LatticeViews):
            out = np.zeros((len(frames), n), dtype=complex)
            out[np.arange(len(frames)), views.site_index[self.at]] = (
                frames * views.phases.conj()[self.at[0]])
            return out
        fields = views.gather(np.eye(n, dtype=complex).reshape(n, *nodes))
        return frames[:, None] * fields[(slice(None), *self.at)].T

    def of_misalignments(self) -> np.ndarray:
        """Return the readings for a unit of phi, Re tau, Im tau of each view, complex (r, 3 v).

        Without differences of rotations that are none.
        """
        grid = self.problem.system.grid
        out = np.zeros((len(self.at[0]), 3 * grid.n_views), dtype=complex)
        each = np.arange(len(out))
        for part, shape in enumerate((grid.views.z[self.at[1:]] * 1j, 1.0, 1j)):
            out[each, 3 * self.at[0] + part] = shape
        return out - (out @ grid.differences) @ grid.differences.T

    def of_terms(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the effect of terms on the readings, (r, p), and their sizes, (p,).

        But for the microscope's.
        """
        mine = [i for i, column in enumerate(self.columns.columns)
                if not (block_of(column.term).of_offsets or block_of(column.term).of_lines)]
        view, row, column = self.at
        return self.columns.grid[mine][:, view, row, column].T, self.columns.size[mine]

    def of_offsets(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the readings for a unit of each of its coefficients, (r, 4), and their sizes."""
        out, size = np.zeros((len(self.at[0]), 4), dtype=complex), np.zeros(4)
        for i, column in enumerate(self.columns.columns):
            if block_of(column.term).of_offsets:
                part = MICROSCOPE_PARTS.index(column.component)
                out[:, part], size[part] = self.columns.grid[(i, *self.at)], column.size
        return out, size

    def of_images(self) -> np.ndarray:
        """Return the readings for unit noise of each image, one reading's, (2 r, 2 stops)."""
        if not len(self.stop):
            return np.zeros((2 * len(self.at[0]), 0))
        one = (self.stop[:, None] == np.arange(self.stop.max() + 1)) / np.sqrt(
            self.weight)[:, None]
        return np.kron(np.eye(2), one)

    @property
    def marks_of_image(self) -> float:
        """Number of marks of an image, as a mean over its marks; 1 without images."""
        count = np.bincount(self.stop)
        return float((count**2).sum() / count.sum()) if len(count) else 1.0

    def of_marks(self) -> tuple[np.ndarray, np.ndarray]:
        """Return which marks were read, bool (nx, ny), and the readings for a unit of Ax, Ay."""
        marks = np.zeros(self.problem.grid.weight.shape[1:], dtype=bool)
        marks[self.at[1:]] = True
        number = (np.cumsum(marks) - 1).reshape(marks.shape)[self.at[1:]]
        own = np.zeros((len(number), int(marks.sum())), dtype=complex)
        own[np.arange(len(number)), number] = 1.0
        return marks, complex_design(own)


def stacked(values: np.ndarray) -> np.ndarray:
    """Return complex rows (r, ...) as real ones, (2 r, ...): x, then y."""
    return np.concatenate([values.real, values.imag])


def complex_design(values: np.ndarray) -> np.ndarray:
    """Return a matrix (r, n) between complex numbers as one between their parts, (2 r, 2 n)."""
    return np.block([[values.real, -values.imag], [values.imag, values.real]])


@dataclass(frozen=True, eq=False)
class Seen:
    """The map of the stage in views of a known plate, frame of the equations.

    Attributes
    ----------
    known : bool array (nx, ny)
        Nodes that are known.
    field : complex array (nx, ny)
        Their error, no translation and rotation, m; 0 elsewhere.
    parameters : float array (3 views,)
        Misalignments as in `NormalEquations`, m.
    gain : Gain
        Of all nodes, x then y, and the misalignments, m.
    rest : float array (2 r,)
        Residuals.
    dof : int
        Their degrees of freedom.
    """

    known: np.ndarray
    field: np.ndarray
    parameters: np.ndarray
    gain: Gain
    rest: np.ndarray
    dof: int


def seen_field(readings: PlateReadings, noise: np.ndarray, plate: np.ndarray,
               of_offsets: np.ndarray) -> Seen:
    """Return the map of the stage for a covariance of the readings.

    Parameters
    ----------
    readings : PlateReadings
        The readings.
    noise : float array (2 r, 2 r)
        Covariance of the readings less what is known, m^2.
    plate : complex array (r,)
        Known error of the plate, m.
    of_offsets : complex array (r,)
        Known effect of the microscope, m.

    Raises
    ------
    NotIdentifiableError
        If less than half of the nodes near the readings are known.
    NotSettledError
        If the rotations of the plate do not converge.
    """
    grid = readings.problem.system.grid
    views, fields = grid.views, readings.of_field()
    design = np.hstack([complex_design(fields), stacked(readings.of_misalignments())])
    touched = (np.abs(fields) > 0).any(axis=0).reshape(views.z_sites.shape)
    placed = not isinstance(views, LatticeViews)
    known, z, strict = touched, views.z_sites, 2 - 2 * placed
    if placed:
        known = touched & (np.maximum(abs(z.real), abs(z.imag)) < CORE)
    columns = np.concatenate([np.tile(touched.ravel(), 2), np.ones(
        design.shape[1] - 2 * z.size, dtype=bool)])
    spread = np.tile(1 / readings.weight, 2)
    unit = (np.diag(noise) / spread).min()
    for _ in range(MOST_DATUMS):
        if known.sum() < 3 or (strict == 2 and known.sum() < touched.sum() / 2):
            break
        held = np.zeros((design.shape[1], 3 + grid.differences.shape[1]))
        held[:2 * z.size, :3] = stacked(Gauge(z, known, scale=False).orthonormal)
        held[2 * z.size:, 3:] = grid.differences
        gain = _in_datum(design, noise, held, columns, VAGUE * placed)
        if strict == 2:
            return _converged(readings, design, gain, known, known_parts=(plate, of_offsets))
        u2 = (gain.rows ** 2 @ spread + gain.free / unit)[:2 * z.size].reshape(2, *z.shape)
        u2, best = u2.max(axis=0), u2.max(axis=0)[touched].min()
        strict += int(best < KNOWN**2)
        # if the core itself has nodes that are not determined: the datum of the better ones
        known = touched & (u2 < (KNOWN**2 if best < KNOWN**2 else 4 * best))
    left, fewer = int((~known).sum()), ", or give the map fewer nodes" * placed
    raise NotIdentifiableError(
        f"a view of the known plate that leaves {left} of {known.size} nodes of the map "
        f"unknown: measure more of its marks{fewer}", Observability(
            2 * int(known.sum()), 2 * known.size, 2 * left, False))


def _in_datum(design: np.ndarray, noise: np.ndarray, held: np.ndarray, columns: np.ndarray,
              vague: float) -> Gain:
    """Return the estimate of all unknowns, combinations `held` at 0, with all but `columns` 0."""
    found = least_squares(design[:, columns], noise, held[columns], vague)
    rows, free = np.zeros((design.shape[1], len(noise))), np.zeros(design.shape[1])
    rows[columns], free[columns] = found.rows, found.free
    return Gain(rows, noise, free)


def _converged(readings: PlateReadings, design: np.ndarray, gain: Gain, known: np.ndarray, *,
               known_parts: tuple[np.ndarray, np.ndarray]) -> Seen:
    """Return the solution with finite rotations, at the places of the stage (Gauss-Newton)."""
    problem, at, (plate, of_offsets) = readings.problem, readings.at, known_parts
    n, marks = known.size, problem.system.grid.views.z[at[1:]] * problem.half_width_m
    places = problem.places if problem.moves else None
    y, moved = problem.grid.y[at] - plate - of_offsets, None
    taken = np.zeros(len(y), dtype=complex)
    for _ in range(MOST_STEPS):
        right = stacked(y - taken)
        found = gain.rows @ right
        field = np.where(known, (found[:n] + 1j * found[n:2 * n]).reshape(known.shape), 0.0)
        phi = found[2 * n::3][at[0]] / problem.half_width_m
        turn, before = np.expm1(1j * phi), taken
        taken = np.zeros(len(plate), dtype=complex)
        if problem.rigid:
            taken = (turn - 1j * phi) * marks + turn * plate
        if places is not None:
            near = None if moved is None else places.errors(field, moved)
            moved = places.moved(field, near)
            taken = taken + places.changes(moved, problem.turn_rad)[at]
        if np.abs(taken - before).max() <= STILL:
            rank = round(float(np.einsum("ij,ji->", gain.rows, design)))
            return Seen(known, field, found[2 * n:], gain, right - design @ found,
                        len(right) - rank)
    raise NotSettledError("recheck", "the rotations of the plate do not converge",
                          "check the readings for misalignments of more than a few degrees")


def line_gain(turns: Sequence[float], weight: np.ndarray, noise: np.ndarray,
              harmonics: int = 0) -> Gain:
    """Return the estimate of the angular map from lines of a known plate, its mean 0.

    Nothing is known if the lines do not determine it.

    Parameters
    ----------
    turns : sequence of float
        Turn of each view in lines.
    weight : float array (views, K)
        Weight of each reading; 0 = not read.
    noise : float array (r, r)
        Covariance of the readings of weight > 0, in their order, less the known plate.
    harmonics : int
        Of the map, if it is a Fourier series.
    """
    count, lines = weight.shape[1], lines_of(Marks(tuple(turns), weight, (), harmonics))
    rows = np.concatenate([lines.rows(view, np.flatnonzero(one))
                           for view, one in enumerate(weight)])
    basis = lines.at_lines if isinstance(lines, HarmonicSystem) else np.eye(count)[
        :, rows.any(axis=0)]
    design = np.hstack([rows @ basis, np.eye(len(turns))[np.nonzero(weight)[0]]])
    if np.linalg.matrix_rank(design) < design.shape[1] - 1:
        return Gain(np.zeros((count, len(rows))), noise)
    held = np.zeros((design.shape[1], 1))
    constant = basis.sum(axis=0)
    held[:len(constant), 0] = constant / np.linalg.norm(constant)
    return Gain(basis @ least_squares(design, noise, held).rows[:len(constant)], noise)
