# SPDX-License-Identifier: Apache-2.0
"""What angular lines show: rotations that are not those of the marks, a reading that is off.

A view's rotation is one number for both (method eq. 2.2, 2.3). If the plate moved between them, or
offsets of lines have the other sign, both fit well alone, and not together. A single reading that
the others contradict is sought among the lines alone.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.special import fdtrc

from selfcal_ros.errors import InputError, NotIdentifiableError
from selfcal_ros.estimation.joint.model_fit import ModelFit
from selfcal_ros.estimation.joint.problem import FLOOR, Problem
from selfcal_ros.estimation.joint.solve import solve_joint
from selfcal_ros.estimation.joint.solved import Solved
from selfcal_ros.estimation.normal.equations import angular_residuals, grid_residuals
from selfcal_ros.estimation.options import Options
from selfcal_ros.estimation.verdict.enlarge import Effect
from selfcal_ros.estimation.verdict.fault_columns import MOST, READING
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.readings import Measurements, ViewReadings
from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.model.statistics import MANY_DOF, rms
from selfcal_ros.model.verdict import Cause

ROTATION = "rotation"


def rotation_cause(model: ModelFit, level: float) -> Cause | None:
    """Return the view in which marks and lines turn differently, None where they agree.

    What both together leave more than each alone, in units of their noises, is tested (F) for as
    many rotations as both tell.

    Parameters
    ----------
    model : ModelFit
        The joint fit.
    level : float
        Level of the test.
    """
    system, found = model.problem.system, model.found
    both = set(system.grid_index) & set(system.angular_index)
    dof = system.rank_schur + system.rank_turns - (system.size - system.nullity)
    noise = np.array([found.xy.sigma, found.theta.sigma])
    if len(both) < 2 or dof < 1 or not (noise > FLOOR).all():  # rounding is not tested
        return None
    alone = _squares(model, grid_residuals(system, model.y),
                     angular_residuals(system, model.problem.angular.y))
    more = (_squares(model, found.residuals, found.residuals_theta) - alone) / noise**2
    known = min(found.xy.dof, found.theta.dof, MANY_DOF)
    p = float(fdtrc(dof, known, max(float(more.sum()), 0.0) / dof))
    return _largest(model, p) if p < level else None


def _squares(model: ModelFit, grid: np.ndarray, lines: np.ndarray) -> np.ndarray:
    """Return the weighted squares of residuals, m^2 and rad^2, (2,)."""
    system = model.problem.system
    return np.array([float((system.grid.weight * abs(grid) ** 2).sum()),
                     float((system.angular.weight * lines**2).sum())])


def _largest(model: ModelFit, p: float) -> Cause:
    """Return the view whose lines are turned most against its marks, as a cause."""
    problem, found = model.problem, model.found
    system, length = problem.system, problem.half_width_m
    pairs = [(system.grid_index.index(i), row) for row, i in enumerate(system.angular_index)
             if i in system.grid_index]
    rows = np.array([row for row, _ in pairs])
    lines = np.array([row for _, row in pairs])
    of_marks = (system.grid_inverse @ system.grid.reduced(model.y)[1])[3 * rows] / length
    of_lines = (system.angular_inverse @ system.angular.reduced(problem.angular.y)[1])[lines]
    apart = of_lines - of_marks
    apart = apart - np.median(apart)  # a turn that all views share is the datum's
    worst = int(np.argmax(abs(apart)))
    row, line = 3 * rows[worst], lines[worst]
    variance = (system.grid_inverse[row, row] * (found.xy.sigma / length) ** 2
                + system.angular_inverse[line, line] * found.theta.sigma**2)
    return Cause(ROTATION, float(apart[worst]), float(np.sqrt(variance)), "rad", p,
                 problem.ground.names[rows[worst]])


def solved_apart(measurements: Measurements, options: Options) -> Solved | None:
    """Return the solution in which marks and lines of a view have rotations of their own.

    None where there is none: where lines tell rotations of the marks, or a model does not settle.
    """
    views: list[ViewReadings] = []
    for view in measurements.views:
        if not (len(view.m) and len(view.k)):
            views.append(view)
            continue
        lines = replace(view.view, name=f"{view.view.name} lines", grid=False)
        views += [
            replace(view, view=replace(view.view, angular=False), k=view.k[:0],
                    dtheta=view.dtheta[:0], count_theta=view.count_theta[:0],
                    u_theta=view.u_theta[:0], sigma_theta=float("nan"), dof_theta=0),
            ViewReadings(lines, k=view.k, dtheta=view.dtheta, count_theta=view.count_theta,
                         u_theta=view.u_theta, sigma_theta=view.sigma_theta,
                         dof_theta=view.dof_theta)]
    try:
        return solve_joint(replace(measurements, views=tuple(views)), options)
    except (NotIdentifiableError, InputError):
        return None


def bends(together: CalibrationResult, apart: CalibrationResult, part: float) -> bool:
    """Return whether common rotations move a map by more than a part of its uncertainty (rms).

    Also where the uncertainty is not known.

    Parameters
    ----------
    together, apart : CalibrationResult
        With rotations that marks and lines share, and with rotations of their own.
    part : float
        The part.
    """
    one, other = together.error_map, apart.error_map
    if not together.has_uncertainty:
        return True
    turned = one.g_theta - other.g_theta
    known = np.isfinite(turned)
    turned = turned - turned[known].mean() if known.any() else turned
    moved = np.stack([one.gx - other.gx, one.gy - other.gy])
    return bool(rms(moved) > part * rms(np.stack([one.u_gx, one.u_gy]))
                or rms(turned) > part * rms(one.u_g_theta))


def turns_apart(result: CalibrationResult, measurements: Measurements) -> float:
    """Return by how much the views of marks and lines are turned against one another, rad.

    Lines whose offsets have the other sign turn by twice that, and their map is bounded by nothing.
    """
    phi = [view.phi for view, readings in zip(result.views, measurements.views, strict=True)
           if len(readings.m) and len(readings.k)]
    return float(np.ptp(phi))


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
