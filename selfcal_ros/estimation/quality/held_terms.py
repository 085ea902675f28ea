# SPDX-License-Identifier: Apache-2.0
"""What the terms of a model make of readings that were held out of its fit.

Microscope and direction of approach are shared by all views; drift, plate scale and plate shape
belong to one view each, and are known of a view only if some of its readings were fitted.
"""

from dataclasses import dataclass, replace

import numpy as np

from selfcal_ros.estimation.joint.model_fit import ModelFit
from selfcal_ros.estimation.lattice.maps import PHASES
from selfcal_ros.estimation.lattice.readings import GridData, grid_data
from selfcal_ros.estimation.terms.columns import term_columns
from selfcal_ros.estimation.terms.ground import Ground, ground_of
from selfcal_ros.estimation.terms.visits import ViewVisits
from selfcal_ros.model.readings import Measurements
from selfcal_ros.model.terms import OF_PLATE, TermName

OF_A_VIEW = (TermName.DRIFT, *OF_PLATE)
"""Terms of which each view has its own."""


@dataclass(frozen=True, eq=False)
class HeldReadings:
    """Grid readings that were held out, and the columns of the fitted terms at them.

    Attributes
    ----------
    grid : GridData
        The readings; `index` are positions in the whole measurement.
    columns : complex array (p, views, nx, ny)
        What a unit of each fitted coefficient does to them, plate frame.
    rows : tuple of int
        Row of each of their views in the fit; -1 where it has none.
    """

    grid: GridData
    columns: np.ndarray
    rows: tuple[int, ...]


def held_readings(model: ModelFit, kept: Measurements, held: Measurements) -> HeldReadings:
    """Return the grid readings `held` with the columns of the terms that `kept` was fitted with."""
    problem, grid = model.problem, grid_data(held)
    rows = tuple(problem.grid.index.index(i) if i in problem.grid.index else -1
                 for i in grid.index)
    equations = model.equations
    n = 0 if equations is None else equations.n
    out: np.ndarray = np.zeros((n, *grid.y.shape), dtype=complex)
    if equations is not None:
        ground = _in_time_of(ground_of(held, grid, problem.half_width_m), grid, kept, held)
        made = term_columns(ground, problem.terms, problem.drift_degree)
        at = {(c.term, c.view, c.component): k for k, c in enumerate(equations.columns.columns)}
        for column, block in zip(made.columns, made.grid, strict=True):
            if column.term == TermName.LINE_ECCENTRICITY:
                continue  # its views are those with lines, and no mark has a part of it
            row = -1 if column.view == -1 else rows[column.view]
            shared = column.view == -1
            if (row >= 0 or shared) and (key := (column.term, row, column.component)) in at:
                out[at[key]] += block
    return HeldReadings(grid, out, rows)


def _in_time_of(ground: Ground, grid: GridData, kept: Measurements, held: Measurements) -> Ground:
    """Return the ground with the visits in the time of the views that were fitted, -1 to 1."""
    visits: list[ViewVisits | None] = []
    for index, view in zip(grid.index, ground.visits, strict=True):
        fitted, own = kept.views[index].visits, held.views[index].visits
        if view is None or fitted is None or own is None or not len(fitted.mark):
            visits.append(view)
            continue
        first, last = int(fitted.stamp_ns.min()), int(fitted.stamp_ns.max())
        time = 2 * (own.stamp_ns - first) / max(last - first, 1) - 1
        visits.append(replace(view, time=time))
    return replace(ground, visits=tuple(visits))


def of_terms(model: ModelFit, held: HeldReadings, index: int,
             view_marks: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Return what the terms make of the held readings of one view, complex (P,), stage frame.

    Parameters
    ----------
    model : ModelFit
        The fit.
    held : HeldReadings
        What was held out.
    index : int
        Position of the view in the measurement.
    view_marks : tuple of int array (P,)
        Lattice indices of its marks, from 0.
    """
    if model.equations is None or index not in held.grid.index:
        return np.zeros(len(view_marks[0]), dtype=complex)
    row = held.grid.index.index(index)
    plate = np.tensordot(model.coefficients, held.columns[:, row], axes=1)
    return plate[view_marks] * PHASES[held.grid.poses[row].q]
