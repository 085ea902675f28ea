# SPDX-License-Identifier: Apache-2.0
"""Residuals stored in a result, so that a report can show them without the bag."""

from typing import Any

import numpy as np

from selfcal_ros.estimation.joint.model_fit import ModelFit
from selfcal_ros.estimation.lattice.maps import PHASES
from selfcal_ros.model.readings import GridVisits, Measurements
from selfcal_ros.units import NS_PER_S

KEY = "residuals"
"""Key among the extras of a result."""

MAX_READINGS = 60_000
"""Largest number of grid readings with stored residuals: 121 x 121 marks in four views."""

MAX_PARTS = 60
"""Number of intervals of a view's time with a stored mean residual."""

DECIMALS_M, DECIMALS_RAD, DECIMALS_S = 13, 12, 3
"""Decimals stored: 0.1 pm, 1 prad, 1 ms."""


def kept_residuals(measurements: Measurements, model: ModelFit) -> dict[str, Any]:
    """Return the residuals of all readings for `CalibrationResult.extra`; empty for large fields.

    Each view has `dx`, `dy` [i][j] (m, stage axes, mark m = i - h, n = j - h of the plate) and
    `dtheta` [k] (rad, counter-clockwise), NaN where not read; and, if the visits of its marks
    are known, `course`: `time_s` (from the first visit of the run), mean `dx`, `dy` (m) and
    `count` of the readings in each interval of the view's time.

    Parameters
    ----------
    measurements : Measurements
        The readings.
    model : ModelFit
        The solution, with its residuals in the plate frame.
    """
    problem, found = model.problem, model.found
    if problem.system.grid.n_readings > MAX_READINGS:
        return {}
    starts = [int(v.visits.stamp_ns.min()) for v in measurements.views
              if v.visits is not None and len(v.visits.stamp_ns)]
    views = []
    for index, view in enumerate(measurements.views):
        entry: dict[str, Any] = {"view": view.view.name}
        if index in problem.grid.index:
            row = problem.grid.index.index(index)
            read = problem.grid.weight[row] > 0
            rest = np.where(read, found.residuals[row], np.nan) * _to_stage(model, row)
            entry |= {"dx": np.round(rest.real, DECIMALS_M), "dy": np.round(rest.imag, DECIMALS_M)}
            if starts and view.visits is not None and len(view.visits.mark):
                entry["course"] = _course(view.visits, _at_visits(model, row), min(starts))
        if index in problem.angular.index:
            row = problem.angular.index.index(index)
            rest = np.where(problem.angular.weight[row] > 0, found.residuals_theta[row], np.nan)
            entry["dtheta"] = np.round(rest, DECIMALS_RAD)
        views.append(entry)
    return {KEY: {"views": views}}


def _at_visits(model: ModelFit, row: int) -> np.ndarray:
    """Return the residual of every visit of a grid view, complex (V,), stage axes, m."""
    problem = model.problem
    visits = problem.ground.visits[row] if problem.ground else None
    if visits is None:
        return np.zeros(0, dtype=complex)
    values = visits.y
    if model.equations is not None:
        values = values - model.equations.columns.at_visits(model.coefficients)[row]
    rest = model.found.residuals[row].reshape(-1)
    residual = visits.about_means(values[None], rest.size)[0] + rest[visits.mark]
    return residual * _to_stage(model, row)


def _to_stage(model: ModelFit, row: int) -> complex:
    """Return the factor from the frame of a grid view's readings to the stage frame."""
    problem = model.problem
    return complex(PHASES[problem.grid.poses[row].q] / problem.frames[row])


def _course(visits: GridVisits, rest: np.ndarray, start_ns: int) -> dict[str, np.ndarray]:
    """Return the mean residual in each interval of the view's time."""
    order = np.argsort(visits.stamp_ns, kind="stable")
    starts = _starts(len(order))
    counts = visits.count[order]
    count = np.add.reduceat(counts, starts)
    since_s = (visits.stamp_ns - start_ns) / NS_PER_S
    columns = {name: np.add.reduceat(values[order] * counts, starts) / count
               for name, values in (("time_s", since_s), ("dx", rest.real), ("dy", rest.imag))}
    return {"time_s": np.round(columns["time_s"], DECIMALS_S),
            "dx": np.round(columns["dx"], DECIMALS_M), "dy": np.round(columns["dy"], DECIMALS_M),
            "count": count}


def _starts(visits: int) -> np.ndarray:
    """Return the starts of `MAX_PARTS` intervals, or one per visit if fewer; none is empty."""
    parts = min(visits, MAX_PARTS)
    size, longer = divmod(visits, parts)
    number = np.arange(parts)
    return number * size + np.minimum(number, longer)
