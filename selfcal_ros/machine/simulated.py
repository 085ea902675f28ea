# SPDX-License-Identifier: Apache-2.0
"""The machine ``simulated``: a stage and a plate with known truth, as a SIM.yaml describes them.

Truth and physics are those of `selfcal_ros.simulation`; here is what depends on the order of the
calls: where the stage stands, how it came there, and how often it was exposed.
"""

from pathlib import Path

import numpy as np

from selfcal_ros.collection.inputs import Command, Phase
from selfcal_ros.machine.clock import SimulatedClock
from selfcal_ros.machine.interface import Image, MachineError, Offset, Placing
from selfcal_ros.model.readings import Sense
from selfcal_ros.simulation import physics
from selfcal_ros.simulation.cell import (
    DWELL,
    flicker_noise,
    normal,
    quantised,
    white_noise,
)
from selfcal_ros.simulation.machine import Truth
from selfcal_ros.simulation.spec import Simulation, read_simulation
from selfcal_ros.units import NS_PER_S

LEAST_VIEWS = 64
"""Number of placings that are drawn at least."""
SAME = 1e-12
"""Largest difference of equal positions, m or rad."""


class SimulatedMachine:
    """A stage, a plate and a microscope or camera.

    Moves and exposures take no time, or with a clock that of SIM.yaml.

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

    axes: tuple[str, ...] = ("x", "y", "theta")

    def __init__(self, simulation: str, folder: str = "") -> None:
        self._begin(read_simulation(Path(folder) / simulation))

    @classmethod
    def of(
        cls, simulation: Simulation, clock: SimulatedClock | None = None
    ) -> "SimulatedMachine":
        """Return the machine of a simulation that has been read."""
        machine = cls.__new__(cls)
        machine._begin(simulation, clock)
        return machine

    def _begin(
        self, simulation: Simulation, clock: SimulatedClock | None = None
    ) -> None:
        self._given, self._settings, self._clock = (
            simulation,
            simulation.settings,
            clock,
        )
        self._camera, self._plan = simulation.camera, simulation.plan
        self.truth: Truth = simulation.draw(max(LEAST_VIEWS, len(self._plan.views)))[0]
        self._position, self._servo, self._encoder = np.zeros((3, 3))
        self._approach, self._sign = np.zeros((2, 2))
        self._rested = self._n_placed = self._free_ns = 0
        self._lay(
            Command(
                stamp_ns=0,
                phase=Phase.PLACE,
                plan_id=self._plan.plan_id,
                view_index=0,
                view=self._plan.views[0],
                artifact=self._plan.artifact,
                views_planned=len(self._plan.views),
            )
        )

    def place(self, placing: Placing) -> None:
        """Lay the plate as a view commands, with the errors of a hand."""
        if not isinstance(placing.command, Command):
            raise MachineError(
                "a simulation needs the command of the view", "simulated"
            )
        if placing.command.plate() != self._plan.artifact:
            raise MachineError(
                "the plan has another plate than the simulation",
                "simulated",
                "name the same plan in SIM.yaml",
            )
        self._lay(placing.command)

    def _lay(self, command: Command) -> None:
        index = command.view_index
        view = command.placed()
        artifact = command.plate()
        self._index = index
        m, n = physics.all_marks(artifact)
        self._marks = np.stack([m, n])
        pose = self.truth.placed_as(index, view)
        self._angle = float(pose.rotation_rad + self.truth.phi_rad[index])
        self._places = self._sites = np.zeros((2, 0))
        if view.grid:  # else it may lie at any turn
            self._places, self._sites = physics.mark_places(
                self.truth, index, pose, (m, n)
            )
        self._lines = physics.line_directions(self.truth, index, view)
        self._cells = [sub.cell_m for sub in view.sub_views]
        n_in_field = view.on_stage(artifact).n_in_field(artifact) if view.grid else 0
        self._n_expected = max(1, n_in_field * view.repeats + 4 * view.check_marks)
        self._n_exposed = 0
        self._n_placed += 1
        self._rng = np.random.default_rng(
            (self._given.seed, self._given.noise_seed or 0, index, self._n_placed)
        )
        self._flicker = flicker_noise(self._rng, (3, 4 * self._n_expected))
        self._visit_noise = np.zeros(2)
        self._commanded = np.full(3, np.nan)

    def position(self) -> tuple[float, ...]:
        """Return the indicated position."""
        return tuple((self._position + self._encoder).tolist())

    def move_to(self, position: tuple[float, ...]) -> None:
        """Move, and stop beside the target as the settings say.

        To the same target again the stage only scatters: another exposure of a visit.
        """
        settings = self._settings
        target = np.array(position)
        if self._clock is not None:
            self._free_ns = self._clock.now_ns() + settings.period_ns
            self._clock.sleep((1 - DWELL) * settings.exposure_period_s)
        stays = np.abs(target - self.position()) <= SAME
        before = stop = self._position - self._servo
        if not (stays | (np.abs(target - self._commanded) <= SAME)).all():
            error = self._scattered(
                settings.stop_sigma_m, settings.stop_sigma_theta_rad
            )
            stop = np.where(stays, before, self._followed(target) + error)
            self._commanded = np.where(stays, self._commanded, target)
            self._sign = physics.motion_sign((stop - before)[:2])
            self._approach = np.where(self._sign, self._sign, self._approach)
            self._visit_noise = normal(self._rng, settings.visit_xy_m, 2)
            self._rested = 0
        self._servo = np.where(
            stays,
            self._servo,
            self._scattered(settings.servo_sigma_m, settings.servo_sigma_theta_rad),
        )
        self._encoder = np.where(
            stays,
            self._encoder,
            self._scattered(settings.encoder_sigma_m, settings.encoder_sigma_theta_rad),
        )
        self._position = stop + self._servo

    def _scattered(self, sigma_m: float, sigma_rad: float) -> np.ndarray:
        return self._rng.normal(0, 1, 3) * np.array([sigma_m, sigma_m, sigma_rad])

    def _followed(self, target: np.ndarray) -> np.ndarray:
        """Return the position in which mark and line, if followed, are as intended there, (3,)."""
        truth = self.truth
        goal = target.copy()
        if not self._settings.follow_mark:
            return goal
        sign = -1 if self._settings.sense is Sense.PLATE_MOVES else 1
        if self._sites.size:
            away = np.hypot(*(sign * self._sites - target[:2, None]))
            nearest = slice(np.argmin(away), np.argmin(away) + 1)
            place = sign * (
                self._places[:, nearest]
                + physics.drift(truth, self._index, self._tau())
            )
            at = place + physics.stage_error(truth, place, self._index)
            goal[:2] += (at - sign * self._sites[:, nearest])[:, 0]
        direction, nominal, _ = self._lines
        if len(direction):
            away = np.remainder(target[2] - sign * nominal + np.pi, 2 * np.pi) - np.pi
            at = sign * direction + physics.encoder_error(truth, sign * direction)
            goal[2] += (at - sign * nominal)[np.argmin(np.abs(away))]
        return goal

    def image(self) -> Image | None:
        """Expose; None without a camera."""
        if self._camera is None:
            return None
        offsets = self._measured_offsets()
        near = np.hypot(*offsets) < self._camera.reach_m
        return Image(
            self._camera.image(offsets[:, near], self._rng, angles=self._angle)
        )

    def offsets(self) -> list[Offset]:
        """Return the line nearest to the optical axis, and without a camera the marks in sight.

        One mark, or one in each cell of a view of images.
        """
        settings = self._settings
        seen_offsets = []
        declared = settings.declare_sigma
        offsets = self._measured_offsets()
        for cell in self._cells if offsets.size and self._camera is None else []:
            away = np.hypot(offsets[0] - cell.real, offsets[1] - cell.imag)
            nearest = int(np.argmin(away))
            x, y = quantised(offsets[:, nearest], settings.resolution_xy_m).tolist()
            mark = (
                tuple(self._marks[:, nearest].tolist()) if settings.with_ids else None
            )
            if away[nearest] < self.truth.artifact.grid_pitch_m / 2:
                seen_offsets.append(
                    Offset(
                        x,
                        y,
                        mark=mark,
                        score=0.95,
                        sigma=settings.sigma_xy_m if declared else 0.0,
                    )
                )
        direction, _, line = self._lines
        if len(direction):
            away = physics.line_offset(
                self.truth, settings.sense, direction, self._position[2:]
            )
            away = np.remainder(away + np.pi, 2 * np.pi) - np.pi
            nearest = int(np.argmin(np.abs(away)))
            indicated_rad = (
                self.truth.line_factor * away[nearest]
                + settings.sigma_theta_rad * self._rng.normal()
                + settings.flicker_theta_rad * self._flicker[2, self._at()]
            )
            theta = float(quantised(indicated_rad, settings.resolution_theta_rad))
            seen_offsets.append(
                Offset(
                    theta=theta,
                    score=0.95,
                    line=int(line[nearest]) if settings.with_ids else None,
                    sigma=settings.sigma_theta_rad if declared else 0.0,
                )
            )
        return seen_offsets

    def _at(self) -> int:
        """Return the number of the exposure within the view."""
        return self._n_exposed % self._flicker.shape[1]

    def _tau(self) -> np.ndarray:
        """Return the time, 0..1 of the view, (1,)."""
        return np.array([min(1.0, self._n_exposed / max(self._n_expected - 1, 1))])

    def _measured_offsets(self) -> np.ndarray:
        """Expose; return the offsets of all marks as the microscope measures them, (2, V), m.

        A mark beyond the field has an offset, too.
        """
        if self._clock is not None:
            self._clock.sleep(max(0, self._free_ns - self._clock.now_ns()) / NS_PER_S)
        truth = self.truth
        settings = self._settings
        tau = self._tau()
        position = self._position[:2, None]
        stage = physics.true_position(
            truth,
            self._index,
            position,
            tau=tau,
            approach=self._approach[:, None],
            sign=self._sign[:, None],
            rested_s=np.array([self._rested * settings.exposure_period_s]),
        )
        place = self._places + physics.drift(truth, self._index, tau)
        count = place.shape[1]
        offsets = physics.offset_seen(
            truth,
            settings.sense,
            np.repeat(position, count, axis=1),
            np.repeat(stage, count, axis=1),
            place,
        )
        shared = (
            self._visit_noise
            + settings.flicker_xy_m * self._flicker[:2, self._at()]
            + normal(self._rng, settings.image_xy_m, 2)
        )
        self._n_exposed += 1
        self._rested += 1
        return offsets + white_noise(self._rng, settings, count) + shared[:, None]

    def stop(self) -> None:
        """Do nothing: a move has ended when `move_to` returns."""

    def close(self) -> None:
        """Do nothing."""
