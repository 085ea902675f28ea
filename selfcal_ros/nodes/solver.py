# SPDX-License-Identifier: Apache-2.0
"""solver: readings of the views in, calibrated error map out."""

import sys
from typing import Any

from selfcal_msgs.srv import LoadMap, SaveMap

from selfcal_ros.errors import SelfcalError
from selfcal_ros.nodes import names
from selfcal_ros.nodes.base import SelfcalNode, fill
from selfcal_ros.nodes.markers import map_markers
from selfcal_ros.nodes.running import run
from selfcal_ros.sessions.solving import SolvingSession


class Solver(SelfcalNode):
    """Solves whenever a view's readings arrive; publishes ErrorMap and CalibrationSummary."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("solver", **kwargs)
        self.session = SolvingSession(self.values, self.ports(self._publish))
        self._outputs = {"map": self.publisher(names.ERROR_MAP),
                         "summary": self.publisher(names.SUMMARY)}
        self._markers = self.publisher(names.MAP_MARKERS)
        self.subscribe(names.MEASUREMENT, self.session.take_measurement)
        self.subscribe(names.COMMAND, self.session.take_command)
        self.create_timer(0.05, self.guarded(self._on_timer))
        self.create_timer(1.0, self._report)
        self.create_service(SaveMap, "~/save_map", lambda request, response: self.trigger(
            request, response, lambda: self._save(request.path)))
        self.create_service(LoadMap, "~/load_map", lambda request, response: self.trigger(
            request, response, lambda: self.session.load(request.path)))

    def _publish(self, output: str, fields: dict[str, Any]) -> None:
        if output == "markers":
            self._markers.publish(map_markers(**fields, frame_id=self.frame_id))
        else:
            publisher = self._outputs[output]
            publisher.publish(fill(publisher.msg_type(), fields))

    def _on_timer(self) -> None:
        try:
            if self.session.tick():
                self._report()
        except SelfcalError:
            self._report()
            raise

    def _save(self, path: str) -> str:
        self._on_timer()
        return self.session.save(path)

    def _report(self) -> None:
        self.diagnose(self.session.diagnosis())


def main() -> None:
    """Run the node."""
    sys.exit(run(Solver))


if __name__ == "__main__":
    main()
