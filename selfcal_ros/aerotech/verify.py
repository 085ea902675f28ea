# SPDX-License-Identifier: Apache-2.0
"""Residuals of a simulated controller with loaded tables."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from selfcal_ros.aerotech.evaluate import CalEvaluator
from selfcal_ros.aerotech.machine import SimulatedController, setup_of
from selfcal_ros.aerotech.model import Table
from selfcal_ros.compensation.compensator import Compensator
from selfcal_ros.compensation.frame import MachineFrame
from selfcal_ros.compensation.residual import Residual, residual_of
from selfcal_ros.errors import InputError
from selfcal_ros.model.error_map import ErrorMap


@dataclass(frozen=True, eq=False)
class Verification:
    """Residuals at the sites, between them, and at the angular lines; None if not requested."""

    frame: MachineFrame
    sites: Residual | None = None
    between: Residual | None = None
    lines: Residual | None = None

    @property
    def residuals(self) -> list[Residual]:
        """Return the available residuals."""
        return [r for r in (self.sites, self.between, self.lines) if r is not None]

    @property
    def worse(self) -> bool:
        """Whether the tables make the machine worse at its sites or lines."""
        return any(r.rms("after") > (1 + 1e-6) * r.rms("before")
                   for r in (self.sites, self.lines) if r is not None)


def verify_tables(error_map: ErrorMap, tables: Sequence[Table],
                  frame: MachineFrame) -> Verification:
    """Return the residuals of a stage with this error map and `tables`.

    At the sites the map is the truth. Between them the truth is unknown: it is substituted by the
    cubic spline through the sites at the centres of the cells, so that the residual there is
    the error of the controller's linear interpolation.

    Raises
    ------
    InputError
        If a table corrects or needs an axis outside the frame.
    """
    stage: set[int | None] = {frame.x_axis, frame.y_axis}
    xy = [table for table in tables if stage & set(table.outputs)]
    theta = [table for table in tables if frame.theta_axis in table.outputs]
    for table in tables:
        if not set(table.inputs) <= (stage if table in xy else {frame.theta_axis}):
            raise InputError(f"the table of line {table.line}", f"it corrects {list(table.outputs)}"
                             f" from the positions of {list(table.inputs)}",
                             f"name the axes of the stage (now x={frame.x_axis}, "
                             f"y={frame.y_axis}, theta={frame.theta_axis or 'none'})")
    sites = between = lines = None
    if xy:
        plane = _without_theta(error_map)
        evaluator = CalEvaluator(xy, setup_of(frame))
        sites = _at_sites(plane, frame, evaluator)
        between = _between_sites(plane, frame, evaluator) if plane.valid.all() else None
    if theta:
        lines = _at_lines(error_map, frame, CalEvaluator(theta, setup_of(frame)))
    return Verification(frame, sites, between, lines)


def _without_theta(error_map: ErrorMap) -> ErrorMap:
    none = np.zeros(0)
    return replace(error_map, artifact=replace(error_map.artifact, angular_count=0), g_theta=none,
                   u_g_theta=none)


def _at_sites(error_map: ErrorMap, frame: MachineFrame, evaluator: CalEvaluator) -> Residual:
    artifact, known = error_map.artifact, error_map.valid
    points = np.stack([artifact.x_m[known], artifact.y_m[known]])
    stage = Compensator(error_map)
    moves = [SimulatedController(stage, frame, tables).move for tables in (None, evaluator)]
    return residual_of("sites", points, [np.stack(move(*points)) for move in moves])


def _between_sites(error_map: ErrorMap, frame: MachineFrame, evaluator: CalEvaluator) -> Residual:
    artifact = error_map.artifact
    centres = np.stack([along[:-1, :-1].ravel() + artifact.grid_pitch_m / 2
                        for along in (artifact.x_m, artifact.y_m)])
    stage = Compensator(error_map, method="bicubic")
    moves = [SimulatedController(stage, frame, tables).move for tables in (None, evaluator)]
    return residual_of("between", centres, [np.stack(move(*centres)) for move in moves])


def _at_lines(error_map: ErrorMap, frame: MachineFrame, evaluator: CalEvaluator) -> Residual:
    angles = error_map.artifact.theta_rad[np.isfinite(error_map.g_theta)]
    if not len(angles):
        raise InputError("error map", "it knows no angular line", "leave out the theta axis")
    stage = Compensator(error_map)
    turns = [SimulatedController(stage, frame, tables).turn for tables in (None, evaluator)]
    return residual_of("lines", angles[None], [turn(angles)[None] for turn in turns])
