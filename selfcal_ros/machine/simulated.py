# SPDX-License-Identifier: Apache-2.0
"""The machine ``simulated``: a stage and a plate with known truth, as a SIM.yaml describes them."""

import math
from pathlib import Path

import numpy as np

from selfcal_ros.collection.inputs import Command, Phase
from selfcal_ros.machine.interface import Image, MachineError, Offset, Placing
from selfcal_ros.simulation import physics
from selfcal_ros.simulation.cell import flicker_noise, quantised
from selfcal_ros.simulation.machine import Truth, random_truth
from selfcal_ros.simulation.spec import Simulation, corrected, read_simulation

LEAST_VIEWS = 64
"""Number of placings that are drawn at least."""


class SimulatedMachine:
    """A stage, a plate and a microscope or camera; moves take no time.

    Parameters
    ----------
    simulation : str
        SIM.yaml: plan with the plate, truth, physics, noise, cell and camera.
    folder : str, optional
        Folder in which a relative name begins.

    Attributes
    ----------
    truth : Truth
        What a calibration shall find.
    """

    axes = ("x", "y", "theta")

    def __init__(self, simulation: str, folder: str = "") -> None:
        self._begin(read_simulation(Path(folder) / simulation))

    @classmethod
    def of(cls, simulation: Simulation) -> "SimulatedMachine":
        """Return the machine of a simulation that has been read."""
        machine = cls.__new__(cls)
        machine._begin(simulation)
        return machine

    def _begin(self, simulation: Simulation) -> None:
        self._given, self._settings = simulation, simulation.settings
        self._camera, self._plan = simulation.camera, simulation.plan
        views = max(LEAST_VIEWS, len(self._plan.views))
        rng = np.random.default_rng(simulation.seed)
        again = simulation.noise_seed
        placing = None if again is None else np.random.default_rng(again)
        self.truth: Truth = random_truth(self._plan.artifact, views, rng, simulation.spread,
                                         placing=placing)
        if simulation.correction is not None:
            self.truth = corrected(self.truth, simulation.correction, simulation.correction_times)
        self._position = np.zeros(3)
        self._approach = np.zeros(2)
        self._rested = 0
        self._n_placed = 0
        self._lay(Command(0, Phase.PLACE, self._plan.plan_id, 0, self._plan.views[0],
                          self._plan.artifact, len(self._plan.views)))

    def place(self, placing: Placing) -> None:
        """Lay the plate as a view commands, with the errors of a hand."""
        if not isinstance(placing.command, Command):
            raise MachineError("a simulation needs the command of the view", "simulated")
        if placing.command.plate() != self._plan.artifact:
            raise MachineError("the plan has another plate than the simulation", "simulated",
                               "name the same plan in SIM.yaml")
        self._lay(placing.command)

    def _lay(self, command: Command) -> None:
        index, view, artifact = command.view_index, command.placed(), command.plate()
        self._index = index
        m, n = physics.all_marks(artifact)
        self._marks = np.stack([m, n])
        pose = self.truth.placed_as(index, view)
        self._angle = float(pose.rotation_rad + self.truth.phi_rad[index])
        self._places = np.zeros((2, 0))
        if view.grid:  # else it may lie at any turn
            self._places = physics.mark_places(self.truth, index, pose, (m, n))[0]
        self._lines = physics.line_directions(self.truth, index, view)
        shown = view.on_stage(artifact).n_in_field(artifact) if view.grid else 0
        self._n_expected = max(1, shown * view.repeats + 4 * view.check_marks)
        self._n_exposed = 0
        self._n_placed += 1
        self._rng = np.random.default_rng(
            (self._given.seed, self._given.noise_seed or 0, index, self._n_placed))
        self._flicker = flicker_noise(self._rng, (3, 4 * self._n_expected))
        self._visit_noise = np.zeros(2)

    def position(self) -> tuple[float, ...]:
        """Return the indicated position."""
        sigma = self._settings.encoder_sigma_m, self._settings.encoder_sigma_theta_rad
        noise = self._rng.normal(0, 1, 3) * np.array([sigma[0], sigma[0], sigma[1]])
        return tuple((self._position + noise).tolist())

    def move_to(self, position: tuple[float, ...]) -> None:
        """Move, and stop beside the target as the settings say."""
        given = self._settings
        target = np.array(position)
        step = target - self._position
        moves = np.abs(step) > (physics.NO_MOTION_M, physics.NO_MOTION_M, 0.0)
        self._approach = np.where(moves[:2], np.sign(step[:2]), self._approach)
        scatter = np.array([math.hypot(given.stop_sigma_m, given.servo_sigma_m)] * 2 + [
            math.hypot(given.stop_sigma_theta_rad, given.servo_sigma_theta_rad)])
        self._position = np.where(moves, target + scatter * self._rng.normal(0, 1, 3),
                                  self._position)
        self._visit_noise = given.visit_xy_m * self._rng.normal(0, 1, 2)
        self._rested = 0

    def image(self) -> Image | None:
        """Expose; None without a camera."""
        if self._camera is None:
            return None
        offsets = self._seen()
        near = np.hypot(*offsets) < self._camera.reach_m
        shared = self._settings.image_xy_m * self._rng.normal(0, 1, (2, 1))
        return Image(self._camera.image(offsets[:, near] + shared, self._rng, angles=self._angle))

    def offsets(self) -> list[Offset]:
        """Return the mark and the line nearest to the optical axis."""
        given, found = self._settings, []
        declared = given.declare_sigma
        offsets = self._seen() if self._camera is None else np.zeros((2, 0))
        if offsets.size:
            nearest = int(np.argmin(np.hypot(*offsets)))
            x, y = quantised(offsets[:, nearest], given.resolution_xy_m).tolist()
            mark = tuple(self._marks[:, nearest].tolist()) if given.with_ids else None
            if math.hypot(x, y) < self.truth.artifact.grid_pitch_m / 2:
                found.append(Offset(x, y, mark=mark, score=0.95,
                                    sigma=given.sigma_xy_m if declared else 0.0))
        direction, _, line = self._lines
        if len(direction):
            turn = self._position[2:] - physics.encoder_error(self.truth, self._position[2:])
            away = physics.true_offset(given.sense, direction, turn)
            away = np.remainder(away + np.pi, 2 * np.pi) - np.pi
            nearest = int(np.argmin(np.abs(away)))
            told = self.truth.line_factor * away[nearest:nearest + 1]
            told = told + given.sigma_theta_rad * self._rng.normal(0, 1, 1)
            told = told + given.flicker_theta_rad * self._flicker[2, self._at()]
            theta = float(quantised(told, given.resolution_theta_rad)[0])
            found.append(Offset(theta=theta, score=0.95,
                                line=int(line[nearest]) if given.with_ids else None,
                                sigma=given.sigma_theta_rad if declared else 0.0))
        return found

    def _at(self) -> int:
        """Return the number of the exposure within the view."""
        return self._n_exposed % self._flicker.shape[1]

    def _seen(self) -> np.ndarray:
        """Return the offsets of all marks as the microscope measures them, with noise, (2, V), m.

        A mark beyond the field has an offset, too.
        """
        truth, given = self.truth, self._settings
        tau = min(1.0, self._n_exposed / self._n_expected)
        position = self._position[:2, None]
        lag = (truth.backlash_m + truth.backlash_growth_m * tau) * self._approach
        period_s = given.exposure_period_s
        lag = lag + truth.settling_m * self._approach * math.exp(
            -self._rested * period_s / truth.settling_time_s)
        stage = position - physics.stage_error(truth, position, self._index) - lag[:, None]
        place = self._places + physics.drift(truth, self._index, np.array([tau]))
        count = place.shape[1]
        offsets = physics.offset_seen(truth, given.sense, np.repeat(position, count, axis=1),
                                      np.repeat(stage, count, axis=1), place)
        white = given.sigma_xy_m * self._rng.normal(0, 1, offsets.shape)
        white *= np.array([[1.0], [given.noise_ratio]])
        shared = self._visit_noise + given.flicker_xy_m * self._flicker[:2, self._at()]
        self._n_exposed += 1
        self._rested += 1
        return offsets + white + shared[:, None]

    def stop(self) -> None:
        """Do nothing: a move has ended when `move_to` returns."""

    def close(self) -> None:
        """Do nothing."""
