# SPDX-License-Identifier: Apache-2.0
"""Inputs of a plan's terms before measurement: the planned visits.

Visits are equally spaced in time, each approached from the previous one. The microscope's offsets
are not known yet: misalignments and stop errors are drawn, always the same for the same plan.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.special import ndtri

from selfcal_ros.blocks import block_of
from selfcal_ros.estimation.lattice.readings import (
    angular_data,
    grid_data,
    planned_readings,
)
from selfcal_ros.estimation.normal.equations import NormalEquations, lines_of
from selfcal_ros.estimation.terms.columns import (
    Column,
    LineColumns,
    TermColumns,
    WithinMarks,
    term_columns,
)
from selfcal_ros.estimation.terms.equations import (
    ProjectedColumns,
    TermEquations,
    equations_of_columns,
)
from selfcal_ros.estimation.terms.visits import TermInputs, term_inputs
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.readings import GridVisits, Measurements, ViewReadings
from selfcal_ros.model.terms import DRIFT_DEGREE, ModelTerm
from selfcal_ros.model.view import DEFAULT_ORDER, Plan, View, parse_order, placings_of
from selfcal_ros.model.visit_order import VisitSequence, approach_signs, visit_sequence

SPREAD = ((0.56, 0.0941), (0.40, 0.0741), (0.48, 0.4291))
"""First quantile and step of rotation and position along x and y from view to view. They are the
same in a view whatever views come after it. What the microscope costs depends on them by a factor
of ten: with these it is 1.3 times the median of random placings."""


@dataclass(frozen=True)
class Assumed:
    """Assumptions of a plan on the future measurement.

    Attributes
    ----------
    sigma_m : float
        Noise of one grid reading, m.
    stop_error_m : float
        Standard deviation of the stop error of the stage at a mark, per axis, m.
    drift_degree : int
        Degree of a drift's polynomial.
    order : str
        Visiting order of all views; empty = that of each view.
    sigma_rad : float
        Noise of one reading of a line, rad.
    turn_rad : float
        Rotation by which plates are placed, standard deviation, rad.
    away_m : float
        Position in which plates are placed, standard deviation along each axis, m.
    error_m : float
        Standard deviation of the errors of stage and plate, each and per axis, m. They are offsets
        of marks at which a stage stops exactly on its targets.
    error_rad : float
        Standard deviation of the errors of rotary encoder and lines, each, rad.
    """

    sigma_m: float = 20e-9
    stop_error_m: float = 100e-9
    drift_degree: int = DRIFT_DEGREE
    order: str = ""
    sigma_rad: float = math.radians(1e-3)
    turn_rad: float = math.radians(0.3)
    away_m: float = 30e-6
    error_m: float = 1e-6
    error_rad: float = 10e-6


def planned_inputs(
    artifact: Artifact, views: Sequence[View], assumed: Assumed
) -> TermInputs:
    """Return the inputs for planned views.

    Parameters
    ----------
    artifact : Artifact
        The plate.
    views : sequence of View
        The plan.
    assumed : Assumed
        Visiting order, placings, errors.
    """
    rng = np.random.default_rng(1)
    x, y = assumed.error_m * np.random.default_rng([1, 1]).normal(
        size=(2, 2, *artifact.shape)
    )
    stage, plate = assumed.error_rad * np.random.default_rng([1, 2]).normal(
        size=(2, artifact.angular_count)
    )
    planned = planned_readings(artifact, views)
    lines = angular_data(planned)
    of_lines = dict(
        zip(lines.index, lines_of(lines).gather(stage) + plate, strict=True)
    )
    expected = []
    for index, (view, number) in enumerate(
        zip(planned.views, _placings(planned), strict=True)
    ):
        turn, *away = (ndtri((first + step * number) % 1) for first, step in SPREAD)
        lies = assumed.turn_rad * turn, assumed.away_m * complex(*away)
        if len(view.m):
            visits = _visits(artifact, view, assumed, rng, lies=lies, errors=x + 1j * y)
            view = replace(
                view, visits=visits, count=np.bincount(visits.mark, visits.count)
            )
        if index in of_lines:
            view = replace(view, dtheta=of_lines[index] + lies[0])
        expected.append(view)
    readings = replace(planned, views=tuple(expected))
    return term_inputs(readings, grid_data(readings), drift_degree=assumed.drift_degree)


def _placings(planned: Measurements) -> list[int]:
    """Return the number of the placing of the plate in each view; those of lines alone last.

    The cells of an image see one plate.
    """
    placings = placings_of(view.view for view in planned.views)
    number: dict[int, int] = {}
    marks_first = sorted(
        range(len(placings)), key=lambda row: not planned.views[row].view.grid
    )
    for row in marks_first:
        number.setdefault(placings[row], len(number))
    return [number[placing] for placing in placings]


def _visits(
    artifact: Artifact,
    readings: ViewReadings,
    assumed: Assumed,
    rng: np.random.Generator,
    *,
    lies: tuple[float, complex],
    errors: np.ndarray,
) -> GridVisits:
    """Return the visits of a view.

    Given rotation, rad, and position, m, of the plate, and the errors of stage and plate,
    (2, nx, ny), m.
    """
    view = readings.view
    turn, away = lies
    order = assumed.order or view.visit_order or DEFAULT_ORDER
    sequence = (
        visit_sequence(artifact, view, order=order, rng=rng)
        if parse_order(order).name == "random"
        else _sequence(artifact, replace(view, name=""), order)
    )
    n = len(sequence)
    sites = (sequence.i + 1j * sequence.j) * artifact.grid_pitch_m
    aside = sequence.aside_m[0] + 1j * sequence.aside_m[1]
    stops = assumed.stop_error_m * (rng.normal(size=n) + 1j * rng.normal(size=n))
    phase = complex(view.pose.phase)
    mark = artifact.flat(sequence.m, sequence.n)
    near = (
        mark
        if artifact.marks
        else artifact.flat(
            *(
                np.clip(at, *ends).astype(int)  # the nearest, off the lattice
                for at, ends in zip(
                    artifact.nearest(sequence.i, sequence.j),
                    artifact.limits,
                    strict=True,
                )
            )
        )
    )
    stage = errors[0].ravel()[near]
    plate = errors[1].ravel()[mark] * phase
    u, v = artifact.places(sequence.m, sequence.n)
    arm = (u + 1j * v) * artifact.grid_pitch_m * phase
    offset = np.exp(-1j * turn) * (
        np.expm1(1j * turn) * arm + away + plate - stage - stops - aside
    )
    # the sense of measurement does not matter: the stage's motion and its part of a reading
    # both change sign
    return GridVisits(
        mark=np.searchsorted(artifact.flat(readings.m, readings.n), mark),
        dx=np.zeros(n),
        dy=np.zeros(n),
        count=sequence.count,
        stamp_ns=np.rint(2 * sequence.time).astype(int),
        offset_x=offset.real,
        offset_y=offset.imag,
        approach_x=approach_signs((sites + aside).real),
        approach_y=approach_signs((sites + aside).imag),
    )


@lru_cache(maxsize=256)
def _sequence(artifact: Artifact, view: View, order: str) -> VisitSequence:
    """Return the visits of a view: the hundreds of plans of a search share their views."""
    return visit_sequence(artifact, view, order=order)


def planned_equations(
    plan: Plan, system: NormalEquations, terms: Iterable[ModelTerm], assumed: Assumed
) -> TermEquations:
    """Return the equations of terms with the readings of a plan.

    Without terms of the lines rotations are those from the grid, as in `predict`: lines add little
    to them.
    """
    inputs = planned_inputs(plan.artifact, plan.views, assumed)
    columns = term_columns(inputs, terms)
    n = 3 * system.grid.n_views
    length = inputs.half_width_m
    inverse = np.zeros((system.size, system.size))
    ratio = 0.0
    inverse[:n, :n] = system.grid_inverse
    if len(columns.lines.at):
        ratio = (assumed.sigma_m / (assumed.sigma_rad * length)) ** 2  # method eq. 4.2
        inverse = system.inverse(ratio)
    return equations_of_columns(
        system,
        columns,
        inverse,
        ratio=ratio,
        half_width_m=length,
        noise_m=assumed.sigma_m,
    )


def with_terms(equations: TermEquations, terms: Iterable[ModelTerm]) -> TermEquations:
    """Return the equations of some of the terms of `equations`, with their own sizes.

    Parameters
    ----------
    equations : TermEquations
        Sized terms: columns of the plate exist for all views.
    terms : iterable of ModelTerm
        Free ones have no columns of the plate in the first view, as in `term_columns`.
    """
    sizes: dict[str, float] = {term.name: term.size for term in terms}
    all_columns = equations.columns
    rows = rows_of(all_columns, terms)
    columns = tuple(
        replace(column, size=sizes[column.term])
        for column, is_chosen in zip(all_columns.columns, rows, strict=True)
        if is_chosen
    )
    inner = all_columns.within
    within = WithinMarks(
        inner.gram[np.ix_(rows, rows)], inner.right[rows], inner.total, inner.dof
    )
    projected = equations.projected
    of_lines = rows[all_columns.lines.at]
    lines = LineColumns(
        np.cumsum(rows)[all_columns.lines.at[of_lines]] - 1,
        all_columns.lines.values[of_lines],
    )
    return TermEquations(
        equations.system,
        TermColumns(
            columns, all_columns.shapes.chosen(rows), within, all_columns.at, lines
        ),
        ProjectedColumns(
            lambda: projected.fields[:, rows],
            projected.parameters[:, rows],
            projected.gram[np.ix_(rows, rows)],
            projected.turned[:, rows],
        ),
        equations.noise_m,
        equations.line_weight,
    )


def rows_of(columns: TermColumns, terms: Iterable[ModelTerm]) -> np.ndarray:
    """Return the columns of the terms, bool (p,)."""
    free: dict[str, bool] = {term.name: term.free for term in terms}
    return np.array(
        [
            column.term in free and not (free[column.term] and _first(column))
            for column in columns.columns
        ],
        dtype=bool,
    )


def _first(column: Column) -> bool:
    block = block_of(column.term)
    return column.view == 0 and (block.of_plate or block.of_lines)
