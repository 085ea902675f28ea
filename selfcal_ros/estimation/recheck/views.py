# SPDX-License-Identifier: Apache-2.0
"""Views of a plate that is known with a covariance (method eq. 13.1).

The equations are those of a calibration, of which no mark is eliminated: the plate is at its known
place. How far off it may be is an effect on the readings as a term of the model is, a column for
each of its coordinates, with the covariance of the calibration in place of sizes.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from selfcal_ros.errors import NotIdentifiableError, NotSettledError
from selfcal_ros.estimation.comparison.covariance import unit_rows
from selfcal_ros.estimation.joint.model_fit import placed
from selfcal_ros.estimation.joint.problem import Moving, NoiseEstimate, Problem
from selfcal_ros.estimation.normal.angular import FLOOR, GAP, MAX_STEPS, AngularSystem
from selfcal_ros.estimation.normal.eliminated import PlateEliminated
from selfcal_ros.estimation.normal.equations import pseudo_inverse
from selfcal_ros.estimation.terms.columns import LineColumns, Shapes, TermColumns
from selfcal_ros.estimation.terms.equations import lines_eliminated, reduce_columns
from selfcal_ros.model.budget import READING_NOISE
from selfcal_ros.model.readings import Sense, lines_turned_over, turned_over
from selfcal_ros.model.result import Observability

NOISE, TERMS = READING_NOISE, "terms"
PLATE, TEMPERATURE = "known plate", "plate temperature"
"""Sources of the uncertainty of a map: of the readings, and of what is known of the plate."""


@dataclass(frozen=True, eq=False)
class Effects:
    """Effects on readings, p of them, and what is known of them before.

    Attributes
    ----------
    source : str array (p,)
        What each is: `PLATE`, what the calibration knows, `NOISE` that the marks of an image share,
        or `TERMS` of the model.
    at : int array (p,)
        Which of the k values that the calibration knows each is; -1 if it is none of them.
    mean : float array (p,)
        Their values.
    covariance : float array (p, p)
        Of these.
    before : float array (j + k, j + k)
        Covariance of the earlier map, (j,), and of the k values.
    length : float array (k,)
        What a relative expansion of the plate of 1 makes of these.
    """

    source: np.ndarray
    at: np.ndarray
    mean: np.ndarray
    covariance: np.ndarray
    before: np.ndarray
    length: np.ndarray

    @classmethod
    def of(
        cls,
        size: np.ndarray,
        at: np.ndarray,
        *,
        plate: np.ndarray,
        before: np.ndarray,
        length: np.ndarray,
        noise: np.ndarray | bool = False,
        others: Iterable[tuple[np.ndarray, np.ndarray]] = (),
    ) -> "Effects":
        """Return effects with sizes (p,), of which the calibration knows values `plate` (k,).

        Those that are `noise`, bool (p,), are of readings. `others` are known by themselves: rows,
        bool (p,), and their covariance.
        """
        known = at >= 0
        rows_of_plate = len(before) - len(plate) + at[known]
        of_plate = before[np.ix_(rows_of_plate, rows_of_plate)]
        mean, covariance = np.zeros(len(at)), np.diag(size**2)
        mean[known] = plate[at[known]]
        for rows, of_rows in ((known, of_plate), *others):
            covariance[np.ix_(rows, rows)] = of_rows
        return cls(
            source=np.where(known, PLATE, np.where(noise, NOISE, TERMS)),
            at=at,
            mean=mean,
            covariance=covariance,
            before=before,
            length=length,
        )


@dataclass(frozen=True, eq=False)
class NewMap:
    """A map of the stage from readings of a known plate, at what is known of it, stage frame.

    Attributes
    ----------
    known : bool array (n,)
        Which values of the whole map are known: Gx, then Gy of its nodes, or lines.
    values : float array (q,)
        Those, m or rad; of XY maps without translation and rotation, scale relative to the plate.
    white : float array (q, q)
        Their covariance by the noise that each reading has by itself.
    of_effects : float array (q, p)
        What a unit of each effect makes of them.
    effects : Effects
        The effects.
    dof : float
        Degrees of freedom of the noise of the readings.
    """

    known: np.ndarray
    values: np.ndarray
    white: np.ndarray
    of_effects: np.ndarray
    effects: Effects
    dof: float

    @property
    def from_plate(self) -> np.ndarray:
        """What a unit of each value that the calibration knows makes of the map, (q, k)."""
        known = self.effects.at >= 0
        out = np.zeros((len(self.values), len(self.effects.length)))
        out[:, self.effects.at[known]] = self.of_effects[:, known]
        return out

    @property
    def from_length(self) -> np.ndarray:
        """What a relative expansion of the plate of 1 makes of the map, (q,)."""
        return self.from_plate @ self.effects.length

    def without(self, modes: np.ndarray) -> "NewMap":
        """Return the map without its least-squares parts in modes, (n, d)."""
        basis = np.linalg.qr(modes[self.known])[0]
        values, white, of_effects = (
            values_of - basis @ (basis.T @ values_of)
            for values_of in (self.values, self.white, self.of_effects)
        )
        return replace(
            self,
            values=values,
            of_effects=of_effects,
            white=white - (white @ basis) @ basis.T,
        )

    def covariances(self, variance_of_length: float) -> dict[str, np.ndarray]:
        """Return the covariances of the map by their sources, which add up, (q, q) each.

        `variance_of_length` is that of the plate's length beyond what the calibration has of it.
        """
        out = {}
        for source in (NOISE, PLATE, TERMS):
            of_source = self.effects.source == source
            response = self.of_effects[:, of_source]
            out[source] = (
                response
                @ self.effects.covariance[np.ix_(of_source, of_source)]
                @ response.T
            )
        out[NOISE] = out[NOISE] + self.white
        out[TEMPERATURE] = variance_of_length * np.outer(
            self.from_length, self.from_length
        )
        return out

    def on_whole_map(self, values: np.ndarray) -> np.ndarray:
        """Return values (q,) at their places in the whole map, (n,), NaN elsewhere."""
        out = np.full(len(self.known), np.nan)
        out[self.known] = values
        return out


@dataclass(frozen=True, eq=False)
class Estimate:
    """Least squares of readings of one kind of a known plate, with effects on them.

    Attributes
    ----------
    system : PlateEliminated
        Their equations, of which no mark is eliminated.
    inverse : float array (size, size)
        Covariance of the misalignments for unit noise.
    columns : tuple of array (sites, p), (size, p) and (p, p)
        Those of the effects with the sites eliminated: their solution for known misalignments,
        right-hand side and inner products.
    against : callable
        Returns the products of the columns with weighted residuals, (p,).
    effects : Effects
        What is known of them.
    variance : float
        Of the noise that each reading has by itself.
    """

    system: PlateEliminated
    inverse: np.ndarray
    columns: tuple[np.ndarray, np.ndarray, np.ndarray]
    against: Callable[[np.ndarray], np.ndarray]
    effects: Effects
    variance: float

    @cached_property
    def misalignments(self) -> np.ndarray:
        """Those that are found for a unit of each effect if that is not known, (size, p)."""
        return self.inverse @ self.columns[1]

    @cached_property
    def fields(self) -> np.ndarray:
        """The map that is found for a unit of each effect if that is not known, (sites, p)."""
        return self.columns[0] - self.system.response @ self.misalignments

    @cached_property
    def remaining(self) -> np.ndarray:
        """What an estimate of the effects leaves of a unit of each, (p, p)."""
        _, right, gram = self.columns
        information = (gram - right.T @ self.misalignments) / self.variance
        return np.linalg.inv(
            np.eye(len(information)) + self.effects.covariance @ information
        )

    def solved(self, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """Return map and misalignments for readings less the known effects, in no datum.

        And the sum of squares of the residuals in units of their covariance.
        """
        system = self.system
        field, parameters = system.fitted(y, self.inverse)
        residuals = system.plate(y, field, parameters)[1]
        right = self.against(system.weight * residuals)
        estimated = self.remaining @ (self.effects.covariance @ right) / self.variance
        total = system.squares(residuals)
        return (
            field - self.fields @ estimated,
            parameters - self.misalignments @ estimated,
            float(total - estimated @ right) / self.variance,
        )

    def new_map(
        self, field: np.ndarray, rows: np.ndarray, known: np.ndarray, dof: float
    ) -> NewMap:
        """Return the map whose values are functionals, rows (sites, q), of a field (sites,).

        `known` and `dof` are those of `NewMap`.
        """
        fields = np.real(rows.conj().T @ self.fields)
        of_effects = fields @ self.remaining
        sites, misalignments = self.system.functionals(rows, np.zeros(0))
        of_noise = np.real(sites.conj().T @ self.system.solve(sites))
        of_noise += misalignments.T @ self.inverse @ misalignments
        by_estimate = of_effects @ self.effects.covariance @ (fields - of_effects).T
        return NewMap(
            known=known,
            values=np.real(rows.conj().T @ field),
            white=self.variance * of_noise + by_estimate,
            of_effects=of_effects,
            effects=self.effects,
            dof=dof,
        )


def known_nodes(problem: Problem) -> np.ndarray:
    """Return the nodes of the map that readings determine, frame of the equations, bool (nx, ny).

    Raises
    ------
    NotIdentifiableError
        If less than half of the nodes near the readings are.
    """
    system = problem.system
    known_sites = system.known_sites
    n = system.grid.n_sites
    read = np.count_nonzero(system.grid.components.of_site >= 0)
    if known_sites.sum() >= max(3, read / 2):
        return known_sites
    unknown = int((~known_sites).sum())
    fewer = ", or give the map fewer nodes" * (placed(problem) is not None)
    raise NotIdentifiableError(
        f"a view of the known plate that leaves {unknown} of {n} nodes of the map "
        f"unknown: measure more of its marks{fewer}",
        Observability(2 * int(known_sites.sum()), 2 * n, 2 * unknown, False),
    )


def dof_of_residuals(problem: Problem) -> int:
    """Return the degrees of freedom of the residuals of marks, the effects known."""
    system, on_map = problem.system, placed(problem)
    rank = (
        system.rank_grid
        if on_map is None
        else (round(on_map.determined_coefficients) + on_map.rank_schur)
    )
    return 2 * system.grid.n_readings - rank


def estimate_of_marks(
    problem: Problem, shapes: Shapes, effects: Effects, variance: float
) -> Estimate:
    """Return the least squares of marks, each with noise of a variance, m^2, by itself."""
    grid = problem.system.grid
    columns = reduce_columns(grid, shapes)
    return Estimate(
        grid,
        problem.system.grid_inverse,
        (columns.free, columns.right, columns.gram),
        lambda weighted: shapes.against(shapes.sums(weighted)),
        effects,
        variance,
    )


def solve_marks(
    problem: Problem, columns: TermColumns, estimate: Estimate
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the map of the stage, (nodes,), the misalignments, and the squares of residuals.

    In the frame of the equations, m; map and misalignments in the datum, the squares in units of
    the residuals' covariance.

    With finite rotations, at the places of the stage: what the linear equations lack is taken off
    the readings until it stands still (Gauss-Newton).

    Raises
    ------
    NotIdentifiableError
        If too little is known.
    NotSettledError
        If the rotations of the plate do not converge.
    """
    system = problem.system
    grid = problem.system.grid
    mean = estimate.effects.mean
    linear = problem.grid.y - columns.shapes.combined(mean)
    plate = columns.shapes.combined(mean, columns.rows([PLATE]))
    moving, known_sites = Moving(problem), known_nodes(problem)
    lacking = np.zeros(grid.read.shape, dtype=complex)
    for _ in range(MAX_STEPS):
        before = lacking
        y = np.where(grid.read, linear - lacking, 0.0)
        free, parameters, square = estimate.solved(y)
        field = free.reshape(grid.views.shape)
        modes = system.gauge.coefficients(field)
        field = system.gauge.remove(field, modes)
        parameters = parameters - modes @ system.rigid[:3]
        lacking = grid.read * (
            moving.change_of_readings(np.where(known_sites, field, 0.0))
            + problem.excess(parameters, plate, grid.views.gather(field))
        )
        if np.abs(lacking - before).max() <= FLOOR:
            return field.ravel(), parameters, square
    raise NotSettledError(
        "recheck",
        "the rotations of the plate do not converge",
        "check the readings for misalignments of more than a few degrees",
    )


def map_of_marks(
    problem: Problem, estimate: Estimate, field: np.ndarray, sense: Sense, dof: float
) -> NewMap:
    """Return the map of a solution `field` of marks, whose noise has degrees of freedom."""
    known_sites = turned_over(sense, known_nodes(problem), sign=1)
    rows = turned_over(sense, unit_rows(known_sites))
    rows = problem.system.gauge.without(rows.reshape(len(rows), -1).T)
    known_values = np.tile(known_sites.ravel(), 2)
    return estimate.new_map(field, rows, known_values, dof)


def map_of_lines(
    lines: AngularSystem,
    y: np.ndarray,
    columns: LineColumns,
    effects: Effects,
    *,
    sense: Sense,
    noise: NoiseEstimate,
) -> NewMap:
    """Return the angular map, its mean 0; nothing is known where the lines do not determine it.

    Parameters
    ----------
    lines : AngularSystem
        The lines read.
    y : float array (views, K)
        Their deviations, rad.
    columns, effects : LineColumns, Effects
        Effects on them.
    sense : Sense
        What moves.
    noise : NoiseEstimate
        Of a line.
    """
    scale = lines.weight.sum()
    values, vectors = np.linalg.eigh(lines.schur)
    determined = np.count_nonzero(values > GAP * scale) == lines.n_views - 1
    known_lines = lines_turned_over(
        sense, (lines.components.of_site >= 0) & determined, sign=1
    )
    if not known_lines.any():
        none = np.zeros((0, len(effects.mean)))
        return NewMap(known_lines, np.zeros(0), none @ none.T, none, effects, noise.dof)
    estimate = Estimate(
        lines,
        pseudo_inverse(values, vectors, scale),
        lines_eliminated(lines, columns),
        columns.sums,
        effects,
        noise.sigma**2,
    )
    y = y - np.tensordot(effects.mean, columns.values, axes=1)
    centre = np.eye(lines.n_lines)[:, known_lines]
    rows = lines_turned_over(sense, centre - centre.mean(axis=1, keepdims=True))
    return estimate.new_map(estimate.solved(y)[0], rows, known_lines, noise.dof)
