# SPDX-License-Identifier: Apache-2.0
"""What angular lines show: a reading that is off, sought among the lines alone; wrong offsets."""

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.special import fdtrc

from selfcal_ros.estimation.joint.model_fit import ModelFit
from selfcal_ros.estimation.joint.problem import FLOOR, Problem
from selfcal_ros.estimation.normal.equations import angular_residuals
from selfcal_ros.estimation.verdict.cause_sizes import cause_of, held_by
from selfcal_ros.estimation.verdict.enlarge import Effect
from selfcal_ros.estimation.verdict.fault_columns import MOST, READING
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.readings import Measurements
from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.model.terms import TermName
from selfcal_ros.model.verdict import Cause


def turned_too_far(model: ModelFit, result: CalibrationResult,
                   measurements: Measurements) -> Cause | None:
    """Return lines that turn against marks by as much as the plates are turned, as a cause.

    That is no plate that moved: offsets of lines have the other sign, or those of marks are in
    wrong units. None where they do not, or where the model has them turn alike.
    """
    if TermName.ROTATION not in [term.name for term in model.problem.terms]:
        return None
    held = held_by(model, TermName.ROTATION)
    first = len(model.problem.ground.with_lines) - len(held.values)  # has none where it is free
    values, covariance = np.pad(held.values, (first, 0)), np.pad(held.covariance, (first, 0))
    apart, variance = abs(values[:, None] - values), np.diag(covariance)
    spread = variance[:, None] + variance - 2 * covariance
    of_u = apart / np.sqrt(np.maximum(spread, np.finfo(float).tiny))
    phi = [view.phi for view, readings in zip(result.views, measurements.views, strict=True)
           if len(readings.m) and len(readings.k)]
    if not apart[of_u > SURE].max(initial=0.0) > np.ptp(phi) / 2:
        return None
    p = math.erfc(float(of_u.max()) / math.sqrt(2))
    return replace(cause_of(held, model.problem.ground), p=p)


SURE = 3.0
"""Size over its standard uncertainty from which a rotation is that of its view."""

CHECKED = 1e-6
"""Smallest part of a reading that its residual must hold: what others check of it."""


class OffLine(NamedTuple):
    """A line's reading: row of its view, line, by what it is off with u, rad, and probability."""

    view: int
    k: int
    off_rad: float
    u_rad: float
    p: float


def line_cause(problem: Problem, measurements: Measurements, level: float) -> Cause | None:
    """Return the reading of a line that contradicts the others most, None if none does.

    Lines are fitted alone. By how much a reading is off is its residual over the part 1 - h of it
    that the fit does not follow; what it takes off the sum of squares is tested against what is
    left (F-test; the level holds for all lines together).

    Parameters
    ----------
    problem : Problem
        Plan and readings.
    measurements : Measurements
        The same, for the names of the views.
    level : float
        Level of the test.
    """
    worst = min(_suspects(problem), key=lambda line: line.p, default=None)
    if worst is None or not worst.p < level:
        return None
    view = measurements.views[problem.angular.index[worst.view]].view.name
    return Cause(READING, worst.off_rad, worst.u_rad, "rad", worst.p, view, mark=(worst.k,))


def _suspects(problem: Problem) -> Iterator[OffLine]:
    """Yield the lines with the largest residuals, each tested."""
    system, angular = problem.system, problem.system.angular
    dof = angular.n_readings - system.rank_angular
    if dof < 2:
        return
    residuals = angular_residuals(system, problem.angular.y)
    squares = angular.weight * residuals**2
    for at in np.argsort(squares, axis=None, kind="stable")[::-1][:MOST]:
        v, k = (int(i) for i in np.unravel_index(at, squares.shape))
        unit = np.zeros(squares.shape)
        unit[v, k] = 1.0
        left, weight = float(angular_residuals(system, unit)[v, k]), float(angular.weight[v, k])
        if weight <= 0 or left < CHECKED:
            continue
        off = float(residuals[v, k]) / left
        gained = weight * left * off**2
        variance = max(float(squares.sum()) - gained, 0.0) / (dof - 1)
        if variance <= FLOOR**2:
            continue
        p = float(fdtrc(1, dof - 1, gained / variance)) * angular.n_readings
        yield OffLine(v, k, off, float(np.sqrt(variance / (weight * left))), min(p, 1.0))


def effect_of_line(cause: Cause, artifact: Artifact) -> Effect:
    """Return the effect of a reading of a line that is off: at most what it is off by."""
    theta = np.zeros(artifact.angular_count)
    theta[:] = abs(cause.size) / np.sqrt(max(len(theta), 1))
    return Effect(cause.name, np.zeros((2, *artifact.shape)), theta)
