# SPDX-License-Identifier: Apache-2.0
"""Tables on a simulated controller, and its settings."""

import numpy as np
from numpy.typing import ArrayLike

from selfcal_ros.aerotech.evaluate import AxisSetup, CalEvaluator, MachineSetup
from selfcal_ros.compensation.compensator import Compensator
from selfcal_ros.compensation.frame import MachineFrame
from selfcal_ros.compensation.residual import Correction


def setup_of(frame: MachineFrame) -> MachineSetup:
    """Return the controller's settings for the axes of a frame."""
    if frame.theta_axis is None or frame.theta_counts_per_unit is None:
        return MachineSetup()
    return MachineSetup({frame.theta_axis: AxisSetup(frame.theta_counts_per_unit)})


def plane_correction(tables: CalEvaluator, frame: MachineFrame) -> Correction:
    """Return what loaded tables add to x and y."""
    def correct(px: np.ndarray, py: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        add = tables.corrections({frame.x_axis: px, frame.y_axis: py})
        none = np.zeros(np.shape(px))
        return add.get(frame.x_axis, none), add.get(frame.y_axis, none)
    return correct


def turned(stage: Compensator, frame: MachineFrame, theta_rad: ArrayLike,
           tables: CalEvaluator | None = None) -> np.ndarray:
    """Return the true angle, rad, after a command to `theta_rad`, as `reached` for theta."""
    position = frame.theta_to_machine(theta_rad)
    if tables is not None:
        axis = frame.theta_axis
        add = tables.corrections({} if axis is None else {axis: position})
        position = position + (0.0 if axis is None else add.get(axis, 0.0))
    return stage.correct_theta(frame.theta_from_machine(position))
