# SPDX-License-Identifier: Apache-2.0
"""solver: readings of the views in, calibrated error map out."""

import sys
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from selfcal_msgs.srv import LoadMap, SaveMap
from visualization_msgs.msg import Marker

from selfcal_ros.nodes import names
from selfcal_ros.nodes.filling import map_markers, rejected_marker
from selfcal_ros.nodes.managed import ManagedNode, WhileConfigured, stop
from selfcal_ros.nodes.running import run
from selfcal_ros.nodes.sessions.solving import (
    SolvingOutcome,
    SolvingSession,
    solve,
    warm_up,
)
from selfcal_ros.settings.nodes import SolverSettings

READY_FOR = 21
"""Marks per side of the plate for which the worker prepares memory."""

SWEEP_S = 0.5
"""Period of checks for work without an event, such as a solution that was ready while
the node was not active, or a map to be saved again. A solution itself wakes the executor."""


class Solver(ManagedNode[SolverSettings]):
    """Solve whenever a view's readings arrive; publish ErrorMap and CalibrationSummary.

    Solving runs in a separate thread; readings that arrive meanwhile are solved next, together.
    Requests for the newest readings wait for their solution without blocking the executor.
    """

    session = WhileConfigured[SolvingSession]()
    _worker = WhileConfigured[ThreadPoolExecutor]()
    _running = WhileConfigured[Future[SolvingOutcome] | None]()

    def __init__(self, **kwargs: Any) -> None:
        self._begun = 0  # jobs, including the running one
        self._waiting: list[
            tuple[int, Callable[[], None]]
        ] = []  # for a job, by its number
        super().__init__(SolverSettings, **kwargs)

    def configure(self) -> None:
        """Create the session, the worker and the publishers."""
        self.session = SolvingSession(self.settings, self.ports(self._publish))
        self._worker = self.own(
            ThreadPoolExecutor(1, thread_name_prefix="solver"), stop
        )
        self._running = None
        warm_up()
        self._worker.submit(warm_up, READY_FOR)
        self._outputs = {
            "map": self.output(names.ERROR_MAP),
            "summary": self.output(names.SUMMARY),
        }
        self._markers = self.publisher(names.MAP_MARKERS)
        self._rejected: dict[int, Marker] = {}  # by view
        self._rejected_in = ("", "")  # plan and run
        self._solved = self.publisher(names.private(names.SOLVED))
        self._told: Any = None  # the last message on it
        self.alone_on += [names.ERROR_MAP.name, names.MEASUREMENT.name]

    def activate(self) -> None:
        """Subscribe to the collector and to the commands."""
        self.subscribe(names.MEASUREMENT, self._on_measurement)
        self.subscribe(names.COMMAND, self._on_command)
        self.every(SWEEP_S, self._sweep)
        self.service(
            LoadMap, "~/load_map", lambda request: self.session.load(request.path)
        )
        self._waiting.clear()
        self.service_later(SaveMap, "~/save_map", self._save, self._once_solved)

    def _publish(self, output: str, fields: dict[str, Any]) -> None:
        if output == "markers":
            array = map_markers(**fields, frame_id=self.settings.frame_id)
            array.markers = [*array.markers, *self._rejected.values()]
            self._markers.publish(array)
        else:
            self._outputs[output](fields)

    def _on_measurement(self, message: Any) -> None:
        self.session.take_measurement(message)
        self._begin()  # shown when it is solved, later
        if message.image_x == message.image_y == 0:  # the rejections of all cells
            self._mark_rejected(message)

    def _mark_rejected(self, message: Any) -> None:
        """Keep the marker of a view's rejected detections; those of another run are deleted."""
        of_run = (message.plan_id, message.run_id)
        if of_run != self._rejected_in:
            self._rejected_in = of_run
            for before in self._rejected.values():
                before.action = Marker.DELETE
        marker = rejected_marker(message, self.settings.frame_id)
        view = message.view_index
        if view in self._rejected or marker.action == Marker.ADD:
            self._rejected[view] = marker

    def _on_command(self, message: Any) -> None:
        self.session.take_command(message)
        self._begin()

    def _begin(self) -> None:
        """Solve new readings; while the worker is busy, they wait."""
        job = self.session.next_job() if self._running is None else None
        if job is not None:
            self._begun += 1
            self._running = self._worker.submit(solve, job)
            self._running.add_done_callback(self._wake)

    def _wake(self, _: Future[SolvingOutcome]) -> None:
        """Wake the executor for a solution; called in the worker's thread."""
        executor = self.executor
        if executor is not None:
            executor.create_task(self.guarded(self._advance))

    def _advance(self) -> None:
        """Take a finished solution, continue with new readings and waiting requests."""
        if self.state != "active":
            return
        try:
            if self._running is not None and self._running.done():
                self._take(self._running)
        finally:
            try:
                self._begin()
            finally:
                self._go_on()

    def _sweep(self) -> None:
        self._advance()
        self.session.save_again()
        if self._told is not None:  # again, for who missed the only one
            self._solved.publish(self._told)

    def _take(self, running: Future[SolvingOutcome]) -> None:
        """Take a solution."""
        outcome = running.result()
        self._running = None
        try:
            self.session.take(outcome)
        finally:
            self._told = names.SOLVED.type(data=self.session.digest())
            self._solved.publish(self._told)

    def _once_solved(self, then: Callable[[], None]) -> None:
        """Call `then` once the readings received so far are solved."""
        self._waiting.append((self._begun + self.session.stale, then))
        self.guarded(self._advance)()

    def _go_on(self) -> None:
        n_done = self._begun - (self._running is not None)
        idle = self._running is None and not self.session.stale
        due = [item for item in self._waiting if idle or item[0] <= n_done]
        self._waiting = [item for item in self._waiting if item not in due]
        for _, then in due:
            then()

    def _save(self, request: Any, response: Any) -> str:
        message, response.path = self.session.save(request.path)
        return message


def main() -> None:
    """Run the node."""
    sys.exit(run(Solver))


if __name__ == "__main__":
    main()
