# SPDX-License-Identifier: Apache-2.0
"""stage_simulator: a cell with known truth that follows view commands."""

import sys
from collections.abc import Collection, Iterator
from dataclasses import asdict, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from selfcal_ros.collection import inputs
from selfcal_ros.collection.settings.estimator import read_plan
from selfcal_ros.collection.settings.nodes import SimulatorSettings
from selfcal_ros.machine.duty import Duty
from selfcal_ros.messages import to_model
from selfcal_ros.model.view import Plan, View
from selfcal_ros.nodes import names
from selfcal_ros.nodes.base import SelfcalNode
from selfcal_ros.nodes.filling import fill
from selfcal_ros.nodes.running import run
from selfcal_ros.sessions.health import Diagnosis, Level
from selfcal_ros.simulation.bag import IMAGES, event_fields, image_fields, write_truth
from selfcal_ros.simulation.cell import JOINTS, Event, view_events
from selfcal_ros.simulation.machine import Truth, random_truth
from selfcal_ros.simulation.rendering import Camera, Exposure, exposures
from selfcal_ros.simulation.spec import camera_of, settings_of, spread_of

LEAD_NS = 20_000_000
"""Time between a MEASURE command, or its arrival if later, and the first encoder sample
of its view: no message is stamped in the past."""
IMAGES_KEPT = 100
"""Images that wait for a slow detector."""


class StageSimulator(SelfcalNode[SimulatorSettings]):
    """Publish encoder samples at a set rate, and detections while a view is measured.

    With a camera it publishes images instead of grid detections.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(SimulatorSettings, **kwargs)
        given = self.settings
        self._cell = settings_of(asdict(given) | {"sense": given.measurement_sense})
        self._rng = np.random.default_rng(given.seed)
        self._camera: Camera | None = None
        spread = None
        if given.camera:
            self._camera, spread = camera_of(given.camera)
        self._spread = spread_of(asdict(given), spread)
        self._grain = np.random.default_rng((given.seed, IMAGES))
        self._plan: Plan | None = read_plan(given.plan) if given.plan else None
        self.truth: Truth | None = None
        self._events: Iterator[Event | Exposure] = iter(())
        self._next: Event | Exposure | None = None
        self._idle_stamp = 0
        self._duty = Duty()
        self._free_ns = 0  # stamp from which it is idle
        self._encoder = self.publisher(names.ENCODER)
        self._detection = self.publisher(names.DETECTIONS)
        self._sent = {"encoder_sent": 0, "detection_sent": 0}
        if self._camera is not None:
            self._image = self.publisher(names.image_topics("raw", IMAGES_KEPT)[0])
            self._sent["image_sent"] = 0
        self.subscribe(names.COMMAND, self._on_command)
        self.subscribe(names.STATUS_AS_IT_COMES, self._on_status)
        self.every(0.005, self._on_timer)

    def diagnosis(self) -> Diagnosis:
        """Return its activity and the number of messages sent."""
        return Diagnosis(Level.OK, "at home" if self._next is None else "measuring", self._sent)

    def _on_command(self, message: Any) -> None:
        command = to_model.command(message)
        if not self._duty.take_command(command):
            return
        self._next, self._events = None, iter(())
        if self._duty.command is not None:
            self._measure(command)

    def _on_status(self, message: Any) -> None:
        """Measure missing marks again after all have been measured."""
        command = self._duty.command
        if command is None or self._next is not None:
            return
        again = self._duty.missing(message, self.get_clock().now().nanoseconds, self._free_ns)
        view = replace(command.placed(), repeats=1)
        if again.checks:  # check stops, and all marks once more
            self._measure(replace(command, view=view))
        elif again:
            self._measure(replace(command, view=replace(view, check_marks=0, check_offset_m=0.0)),
                          {*again.marks, *again.lines})

    def _measure(self, command: inputs.Command, missing: Collection[object] = ()) -> None:
        """Measure the commanded view, of its marks those that are `missing`, if any."""
        inputs.check_simulated(command)
        plan = self._plan_with(command)
        if self.truth is None or self.truth.artifact != plan.artifact:
            count = max(64, len(plan.views), command.views_planned)
            self.truth = random_truth(plan.artifact, count, np.random.default_rng(
                self.settings.seed), self._spread)
            if self.settings.truth_path:
                write_truth(Path(self.settings.truth_path), self.truth, seed=self.settings.seed,
                            cell=asdict(self._cell))
        start_ns = max(command.stamp_ns, self.get_clock().now().nanoseconds) + LEAD_NS
        cell = replace(self._cell, with_ids=self._cell.with_ids or self._camera is not None)
        events = (event for event in view_events(
            self.truth, plan, command.view_index, settings=cell, rng=self._rng, start_ns=start_ns)
            if not missing or not isinstance(event, inputs.Detection)
            or not event.has_id  # unknown which one: all of them
            or (event.k if event.kind else (event.m, event.n)) in missing)
        self._events = events if self._camera is None else self._exposed(command, plan, events)
        self._next = next(self._events, None)

    def _exposed(self, command: inputs.Command, plan: Plan,
                 events: Iterator[Event]) -> Iterator[Event | Exposure]:
        """Return the events of a view with images instead of grid detections."""
        assert self.truth is not None and self._camera is not None
        exposed = exposures(self.truth, plan, self._camera, chain(
            [replace(command, view=command.placed())], events), sense=self._cell.sense)
        next(exposed)  # the command itself
        return exposed

    def _plan_with(self, command: inputs.Command) -> Plan:
        """Return the plan with the commanded view inserted; commands describe themselves."""
        known = self._plan.views if self._plan else ()
        count = max(len(known), command.view_index + 1)
        views = [known[i] if i < len(known) else View(f"view {i}") for i in range(count)]
        views[command.view_index] = command.placed()
        self._plan = Plan(command.plan_id, command.plate(), tuple(views))
        return self._plan

    def _on_timer(self) -> None:
        now = self.get_clock().now().nanoseconds
        while self._next is not None and self._next.stamp_ns <= now:
            self._publish(self._next)
            self._next = next(self._events, None)
            self._free_ns = now
        if self._next is None:
            self._idle(now)

    def _idle(self, now_ns: int) -> None:
        """Keep the encoder alive between views, at a tenth of the rate, the stage at home."""
        step = round(1e10 / self.settings.encoder_rate)
        if now_ns - self._idle_stamp >= step:
            self._idle_stamp = now_ns
            self._publish(inputs.EncoderSample(now_ns, JOINTS, (0.0, 0.0, 0.0)))

    def _publish(self, event: Event | Exposure) -> None:
        if isinstance(event, Exposure):
            assert self._camera is not None
            _, fields = image_fields(event, self._camera, self._grain)
            self._sent["image_sent"] += 1
            self._image.publish(fill(names.IMAGE_TYPES["raw"](), fields))
            return
        _, fields = event_fields(event, self.settings.frame_id)
        is_detection = isinstance(event, inputs.Detection)
        self._sent["detection_sent" if is_detection else "encoder_sent"] += 1
        if is_detection:
            self._detection.publish(fill(names.DETECTIONS.type(), fields))
        else:
            self._encoder.publish(fill(names.ENCODER.type(), fields))


def main() -> None:
    """Run the node."""
    sys.exit(run(StageSimulator))


if __name__ == "__main__":
    main()
