# SPDX-License-Identifier: Apache-2.0
"""Residuals of a simulated controller with loaded tables."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from selfcal_ros.aerotech.evaluate import CalEvaluator
from selfcal_ros.aerotech.machine import plane_correction, setup_of, turned
from selfcal_ros.aerotech.model import Table
from selfcal_ros.compensation.compensator import Compensator
from selfcal_ros.compensation.frame import MachineFrame
from selfcal_ros.compensation.residual import Correction, Residual, plane_residuals, residual_of
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


def verify_tables(error_map: ErrorMap, tables: Sequence[Table], frame: MachineFrame,
                  active: Correction | None = None) -> Verification:
    """Return the residuals of a stage with this error map and `tables`.

    `active` is the table that was loaded during the calibration, if any; see `plane_residuals`.

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
        evaluator = CalEvaluator(xy, setup_of(frame))
        sites, *rest = plane_residuals(error_map, frame, plane_correction(evaluator, frame), active)
        between = rest[0] if rest else None
    if theta:
        lines = _at_lines(error_map, frame, CalEvaluator(theta, setup_of(frame)))
    return Verification(frame, sites, between, lines)


def _at_lines(error_map: ErrorMap, frame: MachineFrame, evaluator: CalEvaluator) -> Residual:
    angles = error_map.artifact.theta_rad[np.isfinite(error_map.g_theta)]
    if not len(angles):
        raise InputError("error map", "it knows no angular line", "leave out the theta axis")
    stage = Compensator(error_map)
    return residual_of("lines", angles[None], [turned(stage, frame, angles, tables)[None]
                                               for tables in (None, evaluator)])
