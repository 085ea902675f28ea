# SPDX-License-Identifier: Apache-2.0
"""A simulated controller to test tables, and its settings."""

import numpy as np
from numpy.typing import ArrayLike

from selfcal_ros.aerotech.evaluate import AxisSetup, CalEvaluator, MachineSetup
from selfcal_ros.compensation.compensator import Compensator
from selfcal_ros.compensation.frame import MachineFrame


def setup_of(frame: MachineFrame) -> MachineSetup:
    """Return the controller's settings for the axes of a frame."""
    if frame.theta_axis is None or frame.theta_counts_per_unit is None:
        return MachineSetup()
    return MachineSetup({frame.theta_axis: AxisSetup(frame.theta_counts_per_unit)})


class SimulatedController:
    """A controller with tables loaded that drives a stage with a known error.

    The command is a position in the stage frame. The controller looks up the correction at the
    commanded position, adds it, and drives until the encoder shows the sum; the true
    position of the stage follows from its error G = indicated - true.

    Parameters
    ----------
    stage : Compensator
        The stage's error, including between its sites.
    frame : MachineFrame
        Wiring of the axes.
    tables : CalEvaluator or None
        Loaded tables; None: nothing.
    """

    def __init__(self, stage: Compensator, frame: MachineFrame,
                 tables: CalEvaluator | None = None) -> None:
        self._stage, self._frame, self._tables = stage, frame, tables

    def move(self, x_m: ArrayLike, y_m: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """Return the true position, m, after a command to `x_m`, `y_m`."""
        frame = self._frame
        px, py = frame.to_machine(x_m, y_m)
        if self._tables is not None:
            add = self._tables.corrections({frame.x_axis: px, frame.y_axis: py})
            px, py = px + add.get(frame.x_axis, 0.0), py + add.get(frame.y_axis, 0.0)
        return self._stage.correct(*frame.from_machine(px, py))

    def turn(self, theta_rad: ArrayLike) -> np.ndarray:
        """Return the true angle, rad, after a command to `theta_rad`."""
        frame = self._frame
        position = frame.theta_to_machine(theta_rad)
        if self._tables is not None:
            axis = frame.theta_axis
            add = self._tables.corrections({} if axis is None else {axis: position})
            position = position + (0.0 if axis is None else add.get(axis, 0.0))
        return self._stage.correct_theta(frame.theta_from_machine(position))
