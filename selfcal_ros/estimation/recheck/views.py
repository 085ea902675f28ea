# SPDX-License-Identifier: Apache-2.0
"""Views of a plate that is known with a covariance (method eq. 13.1).

The equations are those of a calibration, of which no mark is eliminated: the plate is at its known
place. How far off it may be is an effect on the readings as a term of the model is, a column for
each of its coordinates, with the covariance of the calibration in place of sizes.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from selfcal_ros.errors import NotIdentifiableError, NotSettledError
from selfcal_ros.estimation.comparison.covariance import unit_rows
from selfcal_ros.estimation.datum.covariance import MapsCovariance
from selfcal_ros.estimation.joint.model_fit import placed
from selfcal_ros.estimation.joint.problem import Moving, NoiseEstimate, Problem
from selfcal_ros.estimation.normal.angular import FLOOR, GAP, MAX_STEPS, AngularSystem
from selfcal_ros.estimation.normal.equations import pseudo_inverse
from selfcal_ros.estimation.terms.columns import LineColumns, TermColumns
from selfcal_ros.estimation.terms.equations import lines_eliminated, reduce_columns
from selfcal_ros.model.readings import Sense, lines_turned_over, turned_over
from selfcal_ros.model.result import Observability

NOISE, TERMS = "reading noise", "terms"
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
    mean : float array (p,)
        Their values.
    covariance : float array (p, p)
        Of these.
    before : float array (j + k, j + k)
        Covariance of the earlier map, (j,), and of the k effects that the calibration knows.
    length : float array (k,)
        What a relative expansion of the plate of 1 makes of these.
    """

    source: np.ndarray
    mean: np.ndarray
    covariance: np.ndarray
    before: np.ndarray
    length: np.ndarray

    @classmethod
    def of(
        cls,
        source: np.ndarray,
        size: np.ndarray,
        plate: np.ndarray,
        *,
        before: np.ndarray,
        length: np.ndarray,
    ) -> "Effects":
        """Return effects with sizes (p,), of which the calibration knows values `plate` (k,)."""
        of_plate = source == PLATE
        n_of_stage = len(before) - len(plate)
        mean = np.zeros(len(size))
        covariance = np.diag(size**2)
        mean[of_plate] = plate
        covariance[np.ix_(of_plate, of_plate)] = before[n_of_stage:, n_of_stage:]
        return cls(source, mean, covariance, before, length)

    def known_as(self, rows: np.ndarray, covariance: np.ndarray) -> "Effects":
        """Return the effects with those `rows`, bool (p,), known to be 0 by themselves."""
        mean = np.where(rows, 0.0, self.mean)
        all_known = self.covariance.copy()
        all_known[rows], all_known[:, rows] = 0.0, 0.0
        all_known[np.ix_(rows, rows)] = covariance
        return replace(self, mean=mean, covariance=all_known)

    def with_noise(self, covariance: np.ndarray) -> "Effects":
        """Return the effects with a covariance, (n, n), of those of noise along each axis."""
        of_noise = self.source == NOISE
        everything = self.covariance.copy()
        everything[np.ix_(of_noise, of_noise)] = np.kron(np.eye(2), covariance)
        return replace(self, covariance=everything)

    def projected(
        self,
        columns: tuple[np.ndarray, ...],
        response: np.ndarray,
        inverse: np.ndarray,
        variance: float,
    ) -> tuple[np.ndarray, ...]:
        """Return what an estimate makes of a unit of each if it is not known, and what is left.

        The map (nodes, p), the misalignments (size, p), and what an estimate of the effects leaves
        of each, (p, p).

        Parameters
        ----------
        columns : tuple of array (nodes, p), (size, p) and (p, p)
            Their solution for known misalignments, right-hand side and inner products.
        response, inverse : array (nodes, size) and (size, size)
            Response of the map to the misalignments, and their covariance for unit noise.
        variance : float
            Of the noise of a reading.
        """
        free, right, gram = columns
        misalignments = inverse @ right
        information = (gram - right.T @ misalignments) / variance
        return (
            free - response @ misalignments,
            misalignments,
            np.linalg.inv(np.eye(len(gram)) + self.covariance @ information),
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
        """What the effects that the calibration knows make of the map, (q, k)."""
        return self.of_effects[:, self.effects.source == PLATE]

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
class PlateReadings:
    """Readings of known marks and lines, and the effects on them.

    Attributes
    ----------
    problem : Problem
        The readings in the frame of the plate as placed.
    sense : Sense
        What moves.
    columns : TermColumns
        Effects on those of marks, and terms of lines.
    effects : Effects
        What is known of the former.
    variance : float
        Of the noise that each of those has by itself, m^2.
    shows_microscope : bool
        Whether visits of the same mark show the microscope, as check stops do.
    """

    problem: Problem
    sense: Sense
    columns: TermColumns
    effects: Effects
    variance: float
    shows_microscope: bool

    @cached_property
    def known(self) -> np.ndarray:
        """Nodes of the map that the readings determine, frame of the equations, bool (nx, ny).

        Raises
        ------
        NotIdentifiableError
            If less than half of the nodes near the readings are.
        """
        system = self.problem.system
        known_sites = system.known_sites
        n = system.grid.n_sites
        read = np.count_nonzero(system.grid.components.of_site >= 0)
        if known_sites.sum() >= max(3, read / 2):
            return known_sites
        unknown = int((~known_sites).sum())
        fewer = ", or give the map fewer nodes" * (placed(self.problem) is not None)
        raise NotIdentifiableError(
            f"a view of the known plate that leaves {unknown} of {n} nodes of the map "
            f"unknown: measure more of its marks{fewer}",
            Observability(2 * int(known_sites.sum()), 2 * n, 2 * unknown, False),
        )

    @property
    def dof(self) -> int:
        """Degrees of freedom of the residuals, the effects known."""
        system = self.problem.system
        on_map = placed(self.problem)
        rank = (
            system.rank_grid
            if on_map is None
            else (round(on_map.determined_coefficients) + on_map.rank_schur)
        )
        return 2 * system.grid.n_readings - rank


@dataclass(frozen=True, eq=False)
class PlateSolution:
    """The map of the stage in views of a known plate, frame of the equations.

    Attributes
    ----------
    field : complex array (nodes,)
        Error of the stage, no translation and rotation, m.
    parameters : float array (3 views,)
        Misalignments as in `NormalEquations`, m.
    square : float
        Sum of squares of the residuals, in units of their covariance.
    fields : complex array (nodes, p)
        Error of the stage that is found for a unit of each effect if that is not known.
    remaining : float array (p, p)
        What an estimate of the effects leaves of a unit of each.
    """

    field: np.ndarray
    parameters: np.ndarray
    square: float
    fields: np.ndarray
    remaining: np.ndarray


def solve_marks(readings: PlateReadings) -> PlateSolution:
    """Return the map of the stage.

    With finite rotations, at the places of the stage: what the linear equations lack is taken off
    the readings until it stands still (Gauss-Newton).

    Raises
    ------
    NotIdentifiableError
        If too little is known.
    NotSettledError
        If the rotations of the plate do not converge.
    """
    problem = readings.problem
    shapes = readings.columns.shapes
    effects = readings.effects
    system = problem.system
    grid = problem.system.grid
    gauge = problem.system.gauge
    reduced = reduce_columns(grid, shapes)
    fields, misalignments, remaining = effects.projected(
        (reduced.free, reduced.right, reduced.gram),
        grid.response,
        system.grid_inverse,
        readings.variance,
    )
    gain = remaining @ effects.covariance / readings.variance
    linear = problem.grid.y - shapes.combined(effects.mean)
    plate = shapes.combined(effects.mean, readings.columns.rows([PLATE]))
    moving = Moving(problem)
    lacking = np.zeros(grid.read.shape, dtype=complex)
    for _ in range(MAX_STEPS):
        y = np.where(grid.read, linear - lacking, 0.0)
        before = lacking
        field, parameters = system.grid_fit(y)
        residuals = grid.plate(y, field, parameters)[1]
        right = shapes.against(shapes.sums(grid.weight * residuals))
        estimated = gain @ right
        field = field - (fields @ estimated).reshape(field.shape)
        modes = gauge.coefficients(field)
        field = gauge.remove(field, modes)
        parameters = parameters - misalignments @ estimated - modes @ system.rigid[:3]
        lacking = grid.read * (
            moving.change_of_readings(np.where(readings.known, field, 0.0))
            + problem.excess(parameters, plate, grid.views.gather(field))
        )
        if np.abs(lacking - before).max() <= FLOOR:
            square = float(
                (grid.weight * np.abs(residuals) ** 2).sum() - estimated @ right
            )
            return PlateSolution(
                field.ravel(), parameters, square / readings.variance, fields, remaining
            )
    raise NotSettledError(
        "recheck",
        "the rotations of the plate do not converge",
        "check the readings for misalignments of more than a few degrees",
    )


def _map_of(
    rows: np.ndarray,
    field: np.ndarray,
    fields: np.ndarray,
    remaining: np.ndarray,
    *,
    effects: Effects,
    covariance: np.ndarray,
    known_values: np.ndarray,
    dof: float,
) -> NewMap:
    """Return the map whose values are functionals, rows (n, q), of a field (n,).

    `fields` and `remaining` are those of `PlateSolution`, `covariance` (q, q) is that of the values
    if all effects are known.
    """
    fields = np.real(rows.conj().T @ fields)
    of_effects = fields @ remaining
    return NewMap(
        known=known_values,
        values=np.real(rows.conj().T @ field),
        white=covariance + of_effects @ effects.covariance @ (fields - of_effects).T,
        of_effects=of_effects,
        effects=effects,
        dof=dof,
    )


def map_of_marks(
    readings: PlateReadings, solution: PlateSolution, dof: float
) -> NewMap:
    """Return the map of a solution."""
    system = readings.problem.system
    known_sites = turned_over(readings.sense, readings.known, sign=1)
    rows = (
        turned_over(readings.sense, unit_rows(known_sites))
        .reshape(-1, known_sites.size)
        .T
    )
    rows = system.gauge.without(rows)
    white = readings.variance * MapsCovariance(system, system.grid_inverse).of_free(
        rows, np.zeros((system.grid.n_marks, rows.shape[1]))
    )
    return _map_of(
        rows,
        solution.field,
        solution.fields,
        solution.remaining,
        effects=readings.effects,
        covariance=white,
        known_values=np.tile(known_sites.ravel(), 2),
        dof=dof,
    )


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
    spectrum = np.linalg.eigh(lines.schur)
    variance = noise.sigma**2
    determined = np.count_nonzero(spectrum[0] > GAP * scale) == lines.n_views - 1
    known_lines = lines_turned_over(
        sense, (lines.components.of_site >= 0) & determined, sign=1
    )
    if not known_lines.any():
        nothing = np.zeros((0, len(effects.mean)))
        return NewMap(
            known=known_lines,
            values=np.zeros(0),
            white=np.zeros((0, 0)),
            of_effects=nothing,
            effects=effects,
            dof=noise.dof,
        )
    inverse = pseudo_inverse(spectrum[0], spectrum[1], scale)
    fields, _, remaining = effects.projected(
        lines_eliminated(lines, columns), lines.response, inverse, variance
    )
    y = y - np.tensordot(effects.mean, columns.values, axes=1)
    field, phi = lines.fitted(y, inverse)
    estimated = (
        remaining
        @ effects.covariance
        @ columns.sums(lines.weight * lines.plate(y, field, phi)[1])
        / variance
    )
    centre = np.eye(lines.n_lines)[:, known_lines]
    rows = lines_turned_over(sense, centre - centre.mean(axis=1, keepdims=True))
    white = lines.solve(rows) + lines.response @ (inverse @ (lines.response.T @ rows))
    return _map_of(
        rows,
        field - fields @ estimated,
        fields,
        remaining,
        effects=effects,
        covariance=variance * rows.T @ white,
        known_values=known_lines,
        dof=noise.dof,
    )
