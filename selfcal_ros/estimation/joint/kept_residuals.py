# SPDX-License-Identifier: Apache-2.0
"""Residuals that a result keeps, so that a report can show them without the bag."""

from typing import Any

import numpy as np

from selfcal_ros.estimation.joint.fit import JointFit
from selfcal_ros.estimation.joint.problem import Problem
from selfcal_ros.estimation.lattice.maps import PHASES
from selfcal_ros.model.readings import Measurements, ViewReadings
from selfcal_ros.units import NS_PER_S

KEY = "residuals"
"""Name among the extras of a result."""

MAX_READINGS = 60_000
"""Grid readings up to which residuals are kept: a plate of 121 x 121 marks in four views."""

DECIMALS_M, DECIMALS_RAD, DECIMALS_S = 13, 12, 3
"""Decimals that are kept: 0.1 pm, 1 prad, 1 ms."""


def kept_residuals(measurements: Measurements, problem: Problem, found: JointFit) -> dict[str, Any]:
    """Return the residuals of all readings for `CalibrationResult.extra`; empty for large fields.

    Each view has `dx`, `dy` [i][j] (m, stage axes, mark m = i - h, n = j - h of the plate),
    `time_s` [i][j] (mean instant of the readings of the mark, from the first reading of the run),
    and `dtheta` [k] (rad, counter-clockwise); NaN where not read or not known.

    Parameters
    ----------
    measurements : Measurements
        The readings.
    problem : Problem
        What was fitted.
    found : JointFit
        The solution, with its residuals in the plate frame.
    """
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
            rest = np.where(read, found.residuals[row], np.nan) * PHASES[problem.grid.poses[row].q]
            entry |= {"dx": np.round(rest.real, DECIMALS_M), "dy": np.round(rest.imag, DECIMALS_M)}
            if starts:
                entry["time_s"] = _times(view, measurements.artifact.half, read.shape, min(starts))
        if index in problem.angular.index:
            row = problem.angular.index.index(index)
            rest = np.where(problem.angular.weight[row] > 0, found.residuals_theta[row], np.nan)
            entry["dtheta"] = np.round(rest, DECIMALS_RAD)
        views.append(entry)
    return {KEY: {"views": views}}


def _times(view: ViewReadings, half: tuple[int, int], shape: tuple[int, ...],
           start_ns: int) -> np.ndarray:
    """Return the mean time of the visits of every mark, s, (nx, ny); NaN where not known."""
    out = np.full(shape, np.nan)
    visits = view.visits
    if visits is None or not len(visits.mark):
        return out
    since_s = (visits.stamp_ns - start_ns) / NS_PER_S
    count = np.bincount(visits.mark, visits.count, len(view.m))
    total = np.bincount(visits.mark, visits.count * since_s, len(view.m))
    known = count > 0
    out[view.m[known] + half[0], view.n[known] + half[1]] = np.round(
        total[known] / count[known], DECIMALS_S)
    return out
