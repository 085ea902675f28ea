# SPDX-License-Identifier: Apache-2.0
"""Views of a known plate as generalised least squares (method eq. 13.1).

The plate's error is known with a covariance, the same in all readings of a mark: it is a prior on
the plate, dense and real. Readings less the known plate have the noise of the reading and that of
the plate, and the map is the best linear estimate under the covariance of both together. The
equations of a calibration, where plates are eliminated mark by mark, cannot hold such a prior.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import solve_triangular

from selfcal_ros.blocks import Block
from selfcal_ros.errors import InputError, NotIdentifiableError, NotSettledError
from selfcal_ros.estimation.joint.problem import FLOOR, MAX_STEPS, Moving, Problem
from selfcal_ros.estimation.joint.solve import MICROSCOPE_PARTS
from selfcal_ros.estimation.lattice.connectivity import Gauge
from selfcal_ros.estimation.lattice.maps import rotation_excess
from selfcal_ros.estimation.normal.angular import KNOWN, HarmonicSystem
from selfcal_ros.estimation.normal.equations import (
    CORE,
    VAGUE,
    Marks,
    PlacedSystem,
    lines_of,
)
from selfcal_ros.estimation.terms.columns import TermColumns
from selfcal_ros.model.readings import Measurements
from selfcal_ros.model.result import Observability

MOST_DATUMS = 12
"""Most datums from that of the core to that of the known nodes."""

NOISE, TERMS = "reading noise", "terms"
PLATE, TEMPERATURE = "known plate", "plate temperature"
"""Sources of the uncertainty of a map: of the readings, and of what is known of the plate."""


@dataclass(frozen=True, eq=False)
class ReadingNoise:
    """Noise of r readings, by its sources.

    Attributes
    ----------
    white : float array (r,)
        Variance of the noise that each reading has by itself.
    shared : dict of float array (r, s)
        What readings have in common, by source: the readings for each part, of variance 1.
    """

    white: np.ndarray
    shared: Mapping[str, np.ndarray]

    @cached_property
    def covariance(self) -> np.ndarray:
        """Covariance of the readings, (r, r)."""
        return np.diag(self.white) + sum(part @ part.T for part in self.shared.values())

    def variances(self, rows: np.ndarray) -> dict[str, np.ndarray]:
        """Return the variances of linear estimates, rows (q, r), by source, (q,) each."""
        out = {name: ((rows @ part) ** 2).sum(axis=1) for name, part in self.shared.items()}
        return out | {NOISE: rows**2 @ self.white + out.get(NOISE, 0.0)}


@dataclass(frozen=True, eq=False)
class NewMap:
    """A map of the stage from readings of a known plate, at what is known of it, stage frame.

    Attributes
    ----------
    known : bool array (n,)
        Which values of the whole map are known: Gx, then Gy of its nodes, or lines.
    values : float array (q,)
        Those, m or rad; of XY maps without translation and rotation, scale relative to the plate.
    rows : float array (q, r)
        What the map makes of a unit of each reading.
    noise : ReadingNoise
        Of the readings, without that of the plate.
    of_plate : float array (r, k)
        The readings for a unit of each quantity that the calibration knows: Ax, then Ay of the
        marks and the coefficients of the microscope, or Atheta of the lines.
    before : float array (j + k, j + k)
        Covariance of the earlier map, (j,), and of these quantities.
    dof : float
        Degrees of freedom of the noise of the readings.
    length : float array (r,) or float
        The readings for a relative expansion of the plate of 1, m.
    """

    known: np.ndarray
    values: np.ndarray
    rows: np.ndarray
    noise: ReadingNoise
    of_plate: np.ndarray
    before: np.ndarray
    dof: float
    length: np.ndarray | float = 0.0

    @cached_property
    def from_plate(self) -> np.ndarray:
        """What the map makes of a unit of each quantity of the plate, (q, k)."""
        return self.rows @ self.of_plate

    @cached_property
    def from_length(self) -> np.ndarray:
        """What it makes of a relative expansion of 1, (q,)."""
        return self.rows @ np.broadcast_to(self.length, len(self.of_plate))

    @property
    def of_noise(self) -> np.ndarray:
        """Covariance of the map due to the noise of the readings, (q, q)."""
        return self.rows @ self.noise.covariance @ self.rows.T

    @property
    def _cover_of_plate(self) -> np.ndarray:
        here = len(self.before) - self.of_plate.shape[1]
        return self.before[here:, here:]

    def without(self, modes: np.ndarray) -> "NewMap":
        """Return the map without its least-squares parts in modes, (n, d)."""
        basis = np.linalg.qr(modes[self.known])[0]
        values, rows = (part - basis @ (basis.T @ part) for part in (self.values, self.rows))
        return replace(self, values=values, rows=rows)

    def variances(self, variance_of_length: float) -> dict[str, np.ndarray]:
        """Return the variances of the map by their sources, (q,) each.

        `variance_of_length` is that of the plate's length beyond what `before` has of it.
        """
        parts = self.noise.variances(self.rows)
        of_plate = np.einsum("ij,ij->i", self.from_plate @ self._cover_of_plate, self.from_plate)
        return {NOISE: parts[NOISE], PLATE: np.maximum(of_plate, 0.0),
                TEMPERATURE: variance_of_length * self.from_length**2, TERMS: parts[TERMS]}

    def covariance(self, variance_of_length: float) -> np.ndarray:
        """Return the covariance of the map, (q, q); argument as of `variances`."""
        return (self.of_noise + self.from_plate @ self._cover_of_plate @ self.from_plate.T
                + variance_of_length * np.outer(self.from_length, self.from_length))

    def whole(self, values: np.ndarray) -> np.ndarray:
        """Return values (q,) at their places in the whole map, (n,), NaN elsewhere."""
        out = np.full(len(self.known), np.nan)
        out[self.known] = values
        return out


def least_squares(design: np.ndarray, covariance: np.ndarray, held: np.ndarray,
                  vague: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Return the generalised least squares with combinations `held` at 0.

    Unknowns on which no reading depends are 0.

    Parameters
    ----------
    design : float array (r, q)
        Readings for a unit of each unknown; a combination that is held changes none.
    covariance : float array (r, r)
        Of the readings.
    held : float array (q, k)
        Orthonormal combinations of the unknowns.
    vague : float
        Information on every unknown, relative to the mean. What the readings do not determine has
        no rows, as if it were 0.

    Returns
    -------
    rows : float array (q, r)
        What the estimate makes of a unit of each reading.
    free : float array (q,)
        Variance that `vague` leaves each unknown; 0 where the readings determine it.

    Raises
    ------
    InputError
        If the noise is none.
    """
    try:
        root = np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError as error:
        raise InputError("readings", "they or those of the calibration have no noise against which "
                         "to judge a change", "use measured readings") from error
    used = design.any(axis=0)
    white = solve_triangular(root, design[:, used], lower=True)
    normal = white.T @ white
    size = np.trace(normal) / len(normal)
    normal[np.diag_indices(len(normal))] += vague * size
    normal += size * held[used] @ held[used].T
    half = np.linalg.solve(normal, white.T)
    rows, free = np.zeros(design.T.shape), np.zeros(design.shape[1])
    rows[used] = solve_triangular(root, half.T, lower=True, trans="T").T
    if vague:
        free[used] = vague * size * (np.linalg.inv(normal) ** 2).sum(axis=1)
    return rows, free


@dataclass(frozen=True, eq=False)
class PlateReadings:
    """Readings of known marks, r of them, each with two coordinates.

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

    def of_each(self, grids: np.ndarray) -> np.ndarray:
        """Return columns (p, views, nx, ny) at the readings, complex (r, p)."""
        view, row, column = self.at
        return grids[:, view, row, column].T

    def of_field(self) -> np.ndarray:
        """Return the readings for a unit of the stage's error at each node, complex (r, n)."""
        views = self.problem.system.grid.views
        nodes = np.eye(views.z_sites.size, dtype=complex).reshape(-1, *views.z_sites.shape)
        return self.problem.frames[self.at[0], None] * self.of_each(views.gather(nodes))

    def of_misalignments(self) -> np.ndarray:
        """Return the readings for a unit of phi, Re tau, Im tau of each view, complex (r, 3 v).

        Without differences of rotations that are one.
        """
        grid = self.problem.system.grid
        units = np.eye(3 * grid.n_views) - grid.differences @ grid.differences.T
        return self.of_each(grid.misaligned(units))

    def of_terms(self, trait: Callable[[Block], bool]) -> np.ndarray:
        """Return the readings for terms with a trait, each of its size, complex (r, p)."""
        rows = self.columns.having(trait)
        return self.of_each(self.columns.grid[rows]) * self.columns.size[rows]

    def of_offsets(self) -> np.ndarray:
        """Return the readings for a unit of each coefficient of the microscope, complex (r, 4)."""
        out = np.zeros((len(self.at[0]), len(MICROSCOPE_PARTS)), dtype=complex)
        rows = np.flatnonzero(self.columns.having(lambda block: block.of_offsets))
        parts = [MICROSCOPE_PARTS.index(self.columns.columns[row].component) for row in rows]
        out[:, parts] = self.of_each(self.columns.grid[rows])
        return out

    def of_images(self) -> np.ndarray:
        """Return the readings for the noise of one reading in each image, (2 r, 2 stops)."""
        if not len(self.stop):
            return np.zeros((2 * len(self.at[0]), 0))
        same = self.stop[:, None] == np.arange(self.stop.max() + 1)
        return np.kron(np.eye(2), same / np.sqrt(self.weight)[:, None])

    @cached_property
    def marks(self) -> np.ndarray:
        """Which marks were read, bool (nx, ny)."""
        return (self.problem.grid.weight > 0).any(axis=0)

    def of_marks(self) -> np.ndarray:
        """Return the readings for a unit of Ax, then Ay of the marks read, (2 r, 2 m)."""
        number = (np.cumsum(self.marks) - 1).reshape(self.marks.shape)[self.at[1:]]
        return np.kron(np.eye(2), number[:, None] == np.arange(self.marks.sum()))


def stacked(values: np.ndarray) -> np.ndarray:
    """Return complex rows (r, ...) as real ones, (2 r, ...): x, then y."""
    return np.concatenate([values.real, values.imag])


@dataclass(frozen=True, eq=False)
class PlateSolution:
    """The map of the stage in views of a known plate, frame of the equations.

    Attributes
    ----------
    known : bool array (nx, ny)
        Nodes that are known.
    field : complex array (nx, ny)
        Their error, no translation and rotation, m; 0 elsewhere.
    parameters : float array (3 views,)
        Misalignments as in `NormalEquations`, m.
    rows : float array (2 nx ny + 3 views, 2 r)
        What x, then y of all nodes, and the misalignments make of a unit of each reading.
    square : float
        Sum of squares of the residuals, in units of their covariance.
    dof : int
        Degrees of freedom of the residuals.
    """

    known: np.ndarray
    field: np.ndarray
    parameters: np.ndarray
    rows: np.ndarray
    square: float
    dof: int


def plate_solution(readings: PlateReadings, covariance: np.ndarray, plate: np.ndarray,
                   of_offsets: np.ndarray) -> PlateSolution:
    """Return the map of the stage for a covariance of the readings.

    Parameters
    ----------
    readings : PlateReadings
        The readings.
    covariance : float array (2 r, 2 r)
        Of the readings less what is known, m^2.
    plate, of_offsets : complex array (r,)
        Known error of the plate, and effect of the microscope, m.

    Raises
    ------
    NotIdentifiableError
        If less than half of the nodes near the readings are known.
    NotSettledError
        If the rotations of the plate do not converge.
    """
    fields = readings.of_field()
    design = np.hstack([stacked(fields), stacked(1j * fields),
                        stacked(readings.of_misalignments())])
    read = fields.any(axis=0).reshape(readings.problem.system.grid.views.shape)
    known, rows = _known_nodes(readings, design, covariance, read)
    y = readings.problem.grid.y[readings.at] - plate - of_offsets
    unknowns, residual = _settled(readings, rows, design, known=known, y=y, plate=plate)
    n, rank = known.size, round(float(np.einsum("ij,ji->", rows, design)))
    field = np.where(known, (unknowns[:n] + 1j * unknowns[n:2 * n]).reshape(known.shape), 0.0)
    square = float(residual @ np.linalg.solve(covariance, residual))
    return PlateSolution(known, field, unknowns[2 * n:], rows, square, len(residual) - rank)


def _known_nodes(readings: PlateReadings, design: np.ndarray, covariance: np.ndarray,
                 read: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the nodes that are known, bool (nx, ny), and the estimate in the datum over them.

    On a lattice these are the sites `read`. Else the datum of the core shows which nodes are known,
    and that of those shows it again.
    """
    grid = readings.problem.system.grid
    z, n, lattice = grid.views.z_sites, read.size, not isinstance(grid, PlacedSystem)
    core = read & (np.maximum(abs(z.real), abs(z.imag)) < CORE)
    known = read if lattice or core.sum() < 3 else core  # three nodes a side have one in the core
    spread = np.tile(1 / readings.weight, 2)
    unit = (np.diag(covariance) / spread).min()
    settled = 2 if lattice else 0
    for _ in range(MOST_DATUMS):
        if known.sum() < 3 or (settled == 2 and known.sum() < read.sum() / 2):
            break
        held = np.zeros((design.shape[1], 3 + grid.differences.shape[1]))
        held[:2 * n, :3] = stacked(Gauge(z, known, scale=False).orthonormal)
        held[2 * n:, 3:] = grid.differences
        rows, free = least_squares(design, covariance, held, 0.0 if lattice else VAGUE)
        if settled == 2:
            return known, rows
        variance = (rows**2 @ spread + free / unit)[:2 * n].reshape(2, *z.shape).max(axis=0)
        best = variance[read].min()
        settled += int(best < KNOWN**2)
        # if the core itself has nodes that are not determined: the datum of the better ones
        known = read & (variance < (KNOWN**2 if best < KNOWN**2 else 4 * best))
    unknown, fewer = int((~known).sum()), "" if lattice else ", or give the map fewer nodes"
    raise NotIdentifiableError(
        f"a view of the known plate that leaves {unknown} of {n} nodes of the map "
        f"unknown: measure more of its marks{fewer}", Observability(
            2 * int(known.sum()), 2 * n, 2 * unknown, False))


def _settled(readings: PlateReadings, rows: np.ndarray, design: np.ndarray, *, known: np.ndarray,
             y: np.ndarray, plate: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return unknowns and residuals with finite rotations, at the places of the stage.

    Gauss-Newton: what the linear equations lack is taken off the readings until it stands still.
    """
    problem, at, n = readings.problem, readings.at, known.size
    marks = problem.system.grid.views.z[at[1:]] * problem.half_width_m
    moving, nonlinear = Moving(problem), np.zeros(len(y), dtype=complex)
    for _ in range(MAX_STEPS):
        right, before = stacked(y - nonlinear), nonlinear
        unknowns = rows @ right
        field = (unknowns[:n] + 1j * unknowns[n:2 * n]).reshape(known.shape)
        moved = moving.taken(np.where(known, field, 0.0))
        nonlinear = np.broadcast_to(moved, problem.grid.y.shape)[at]
        if problem.rigid:
            phi = unknowns[2 * n::3][at[0]] / problem.half_width_m
            nonlinear = nonlinear + rotation_excess(phi, marks, plate)
        if np.abs(nonlinear - before).max() <= FLOOR:
            return unknowns, right - design @ unknowns
    raise NotSettledError("recheck", "the rotations of the plate do not converge",
                          "check the readings for misalignments of more than a few degrees")


def line_rows(turns: Sequence[float], weight: np.ndarray, covariance: np.ndarray,
              harmonics: int = 0) -> np.ndarray:
    """Return what the angular map, its mean 0, makes of a unit of each reading, (K, r).

    All 0 if the lines do not determine it.

    Parameters
    ----------
    turns : sequence of float
        Turn of each view in lines.
    weight : float array (views, K)
        Weight of each reading; 0 = not read.
    covariance : float array (r, r)
        Of the readings of weight > 0, in their order, less the known plate.
    harmonics : int
        Of the map, if it is a Fourier series.
    """
    lines = lines_of(Marks(tuple(turns), weight, (), harmonics))
    at_lines = np.concatenate([lines.rows(view, np.flatnonzero(of_view))
                               for view, of_view in enumerate(weight)])
    basis = lines.at_lines if isinstance(lines, HarmonicSystem) else np.eye(weight.shape[1])[
        :, at_lines.any(axis=0)]
    design = np.hstack([at_lines @ basis, np.eye(len(turns))[np.nonzero(weight)[0]]])
    if np.linalg.matrix_rank(design) < design.shape[1] - 1:
        return np.zeros(at_lines.T.shape)
    constant = basis.sum(axis=0)
    held = np.zeros((design.shape[1], 1))
    held[:len(constant), 0] = constant / np.linalg.norm(constant)
    return basis @ least_squares(design, covariance, held)[0][:len(constant)]
