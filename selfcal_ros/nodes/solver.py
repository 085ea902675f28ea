# SPDX-License-Identifier: Apache-2.0
"""solver: readings of the views in, calibrated error map out."""

import sys
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from selfcal_msgs.srv import LoadMap, SaveMap

from selfcal_ros.collection.settings.nodes import SolverSettings
from selfcal_ros.nodes import names
from selfcal_ros.nodes.managed import ManagedNode, WhileConfigured, stop
from selfcal_ros.nodes.markers import map_markers
from selfcal_ros.nodes.running import run
from selfcal_ros.sessions.ports import Diagnosis
from selfcal_ros.sessions.solving import Outcome, SolvingSession, solve

TICK_S = 0.02


class Solver(ManagedNode[SolverSettings]):
    """Solves whenever a view's readings arrive; publishes ErrorMap and CalibrationSummary.

    Solving runs in a thread beside the executor; what arrives meanwhile is solved next, together.
    """

    session = WhileConfigured[SolvingSession]()
    _worker = WhileConfigured[ThreadPoolExecutor]()
    _running = WhileConfigured[Future[Outcome] | None]()

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(SolverSettings, **kwargs)

    def configure(self) -> None:
        """Make the session, the worker and the publishers."""
        self.session = SolvingSession(self.settings, self.ports(self._publish))
        self._worker = self.own(ThreadPoolExecutor(1, thread_name_prefix="solver"), stop)
        self._running = None
        self._outputs = {"map": self.output(names.ERROR_MAP),
                         "summary": self.output(names.SUMMARY)}
        self._markers = self.publisher(names.MAP_MARKERS)
        self._solved = self.publisher(names.private(names.SOLVED))
        self.alone_on += [names.ERROR_MAP.name, names.MEASUREMENT.name]

    def activate(self) -> None:
        """Listen to the collector and to the commands."""
        self.subscribe(names.MEASUREMENT, self._on_measurement)
        self.subscribe(names.COMMAND, self.session.take_command)
        self.every(TICK_S, self._on_timer)
        self.service(LoadMap, "~/load_map", lambda request: self.session.load(request.path))
        self.service(SaveMap, "~/save_map", self._save)

    def _publish(self, output: str, fields: dict[str, Any]) -> None:
        if output == "markers":
            self._markers.publish(map_markers(**fields, frame_id=self.settings.frame_id))
        else:
            self._outputs[output](fields)

    def _on_measurement(self, message: Any) -> None:
        self.session.take_measurement(message)
        if self._running is None:
            self._begin()

    def _on_timer(self) -> None:
        if self._running is not None and self._running.done():
            self._take(self._running)
        if self._running is None:
            self._begin()

    def _begin(self) -> None:
        job = self.session.next_job()
        self._running = self._worker.submit(solve, job) if job is not None else None

    def _take(self, running: Future[Outcome]) -> None:
        """Take what was solved; wait for it if need be."""
        outcome, self._running = running.result(), None
        try:
            self.session.take(outcome)
        finally:
            self._solved.publish(names.SOLVED.type(data=self.session.digest()))

    def _save(self, request: Any, response: Any) -> str:
        """Save the map of the newest readings: what runs or waits is solved first."""
        while True:
            if self._running is not None:
                self._take(self._running)
            self._begin()
            if self._running is None:
                break
        message, response.path = self.session.save(request.path)
        return message

    def diagnose_session(self) -> Diagnosis:
        """Return what the session says."""
        return self.session.diagnosis()


def main() -> None:
    """Run the node."""
    sys.exit(run(Solver))


if __name__ == "__main__":
    main()
