# SPDX-License-Identifier: Apache-2.0
"""stage_simulator: a simulated machine that follows view commands, visited as every machine is.

Its time is simulated, too: a visit is computed at once, and told when its stamps have come.
"""

import math
import sys
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from selfcal_ros.bagio.messages import to_model
from selfcal_ros.collection.inputs import Command, EncoderSample, check_simulated
from selfcal_ros.machine.cell import AXES, Cell, Settle
from selfcal_ros.machine.clock import SimulatedClock
from selfcal_ros.machine.duty import Again, Duty
from selfcal_ros.machine.interface import Placing
from selfcal_ros.machine.simulated import SimulatedMachine
from selfcal_ros.machine.visiting import Event, Visitor
from selfcal_ros.model.view import Plan
from selfcal_ros.nodes import names
from selfcal_ros.nodes.running import run
from selfcal_ros.nodes.sessions.cell_check import PLAN_ID as CHECK_ID
from selfcal_ros.nodes.sessions.health import Diagnosis, Level
from selfcal_ros.nodes.telling import CellNode
from selfcal_ros.settings.estimator import read_plan
from selfcal_ros.settings.nodes import SimulatorSettings
from selfcal_ros.simulation.bag import write_truth
from selfcal_ros.simulation.spec import Simulation, camera_of, settings_of, spread_of
from selfcal_ros.units import NS_PER_S

LEAD_NS = 20_000_000
"""Time between a MEASURE command, or its arrival if later, and the first encoder sample
of its view: no message is stamped in the past."""
IDLE_STEPS = 10
"""Time between two encoder samples while nothing is measured, over that in a view."""
ANYWHERE = (-math.inf, math.inf)
CHECK_TURN_RAD = 1e-3
"""Least turn of the plate while the cell is checked: a straighter one does not show the sign of
offset_theta."""


class StageSimulator(CellNode[SimulatorSettings]):
    """Publish encoder samples at a set rate, and detections while a view is measured.

    With a camera it publishes images instead of grid detections.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(SimulatorSettings, **kwargs)
        settings = self.settings
        self._settings = settings_of(
            asdict(settings) | {"sense": settings.measurement_sense}
        )
        camera, spread = camera_of(settings.camera) if settings.camera else (None, None)
        self._camera, self._spread = camera, spread_of(asdict(settings), spread)
        self.publish(images=camera is not None)
        self._time, self._step_ns = (
            SimulatedClock(),
            round(NS_PER_S / settings.encoder_rate),
        )
        self.machine: SimulatedMachine | None = None
        self._visitor: Visitor | None = None
        self._events: Iterator[Event] = iter(())
        self._next: Event | None = None
        self._duty = Duty()
        self._free_ns = self._seen_ns = 0  # from when it is idle; the time as last seen
        if settings.plan:
            self._prepare(read_plan(settings.plan))
        self.subscribe(names.COMMAND, self._on_command)
        self.subscribe(names.STATUS_AS_IT_COMES, self._on_status)
        self.every(0.005, self._on_timer)

    def _prepare(self, plan: Plan) -> None:
        """Draw a machine with the plate of a plan, and a placing for each of its views."""
        settings = self.settings
        self.machine = SimulatedMachine.of(
            Simulation(
                plan, settings.seed, self._spread, self._settings, camera=self._camera
            ),
            self._time,
        )
        cell = Cell(
            Path("stage_simulator"),
            "simulated",
            {},
            dict.fromkeys(AXES, ANYWHERE),
            sense=self._settings.sense,
            settle=Settle(arrival=math.inf, arrival_theta=math.inf),
        )
        self._visitor = Visitor(
            self.machine,
            cell,
            self._time,
            settings.seed,
            consecutive=settings.consecutive,
            step_ns=self._step_ns,
            of_a_move=0,
            detects=self._camera is None,
        )
        if plan.plan_id == CHECK_ID:
            truth = self.machine.truth
            self.machine.truth = replace(
                truth,
                phi_rad=np.copysign(
                    np.maximum(abs(truth.phi_rad), CHECK_TURN_RAD), truth.phi_rad
                ),
            )
        if settings.truth_path:
            write_truth(
                Path(settings.truth_path),
                self.machine.truth,
                seed=settings.seed,
                cell=asdict(self._settings),
            )

    def diagnosis(self) -> Diagnosis:
        """Return its activity and the number of messages sent."""
        return Diagnosis(
            Level.OK, "at rest" if self._next is None else "measuring", self.sent
        )

    def _on_command(self, message: Any) -> None:
        command = to_model.command(message)
        if not self._duty.take_command(command):
            return
        self._next, self._events = None, iter(())
        if self._duty.command is not None:
            self._measure(command, None)

    def _on_status(self, message: Any) -> None:
        """Visit again what is missing, once all has been visited."""
        if self._next is not None:
            return
        now_ns = self.get_clock().now().nanoseconds
        again = self._duty.missing(message, now_ns, self._free_ns)
        if again and self._duty.command is not None:
            self._measure(self._duty.command, again)

    def _measure(self, command: Command, again: Again | None) -> None:
        """Visit the commanded view, or what is missing of it."""
        check_simulated(command)
        view = command.placed()
        plate = command.plate()
        index = command.view_index
        if (
            self.machine is None
            or self.machine.truth.artifact != plate
            or (index >= len(self.machine.truth.phi_rad))
        ):
            n_views = max(command.views_planned, index + 1)
            self._prepare(Plan(command.plan_id, plate, (view,) * n_views))
        assert self.machine is not None and self._visitor is not None
        if again is None:
            self.machine.place(
                Placing(view.name, *view.translation_m, view.rotation_rad, command)
            )
        start_ns = max(command.stamp_ns, self.get_clock().now().nanoseconds) + LEAD_NS
        self._time.ns = start_ns  # before its time, if the clock was set back
        order = view.visit_order or self.settings.visit_order
        self._events = self._visitor.view(
            plate, replace(view, visit_order=order), again
        )
        self._next = next(self._events, None)

    def _on_timer(self) -> None:
        now_ns = self.get_clock().now().nanoseconds
        was_set_back = now_ns < self._seen_ns - NS_PER_S
        self._seen_ns = now_ns
        if was_set_back:  # what is stamped later would be told after that time
            self._next, self._events = None, iter(())
        while self._next is not None and self._next.stamp_ns <= now_ns:
            # whatever is raised now, it is told once
            event, self._next = (self._next, None)
            self.tell(event)
            self._next, self._free_ns = next(self._events, None), now_ns
        idle_ns = now_ns - self._time.ns
        if self._next is None and (
            was_set_back or idle_ns >= IDLE_STEPS * self._step_ns
        ):
            self._time.ns = now_ns
            self.tell(
                self._visitor.sample()
                if self._visitor
                else EncoderSample(now_ns, AXES, (0.0, 0.0, 0.0))
            )


def main() -> None:
    """Run the node."""
    sys.exit(run(StageSimulator))


if __name__ == "__main__":
    main()
