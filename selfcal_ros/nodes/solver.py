# SPDX-License-Identifier: Apache-2.0
"""solver: readings of the views in, calibrated error map out."""

import sys
from typing import Any

from selfcal_msgs.srv import LoadMap, SaveMap

from selfcal_ros.bagio import convert_in, convert_out
from selfcal_ros.collection.digest import readings_digest, session_digest
from selfcal_ros.collection.parameters import solver_options
from selfcal_ros.errors import InputError, NoDataError, NotIdentifiableError, SelfcalError
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.files import read_json, write_json
from selfcal_ros.model.readings import Measurements
from selfcal_ros.model.result import (
    CalibrationResult,
    result_from_dict,
    result_to_dict,
    unidentified_result,
)
from selfcal_ros.nodes import names
from selfcal_ros.nodes.base import SelfcalNode, fill, run
from selfcal_ros.nodes.markers import map_markers
from selfcal_ros.reporting.summary import state_sentence
from selfcal_ros.reporting.summary_numbers import summary_numbers

ECHO_LENGTH = 128
"""Characters of a string that `ros2 topic echo` shows."""


class Solver(SelfcalNode):
    """Solves whenever a view's readings arrive; publishes ErrorMap and CalibrationSummary."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("solver", **kwargs)
        self._messages: dict[int, Any] = {}
        self._plan_id: str | None = None
        self._planned: dict[str, int] = {}
        self._digest = ""
        self._stale = False
        self.result: CalibrationResult | None = None
        self._problem: SelfcalError | None = None
        self._map = self.publisher(names.ERROR_MAP)
        self._summary = self.publisher(names.SUMMARY)
        self._markers = self.publisher(names.MAP_MARKERS)
        self.subscribe(names.MEASUREMENT, self._on_measurement)
        self.subscribe(names.COMMAND, self._on_command)
        self.create_timer(0.05, self.guarded(self._solve_if_stale))
        self.create_timer(1.0, self._report)
        self.create_service(SaveMap, "~/save_map", lambda request, response: self.trigger(
            request, response, lambda: self._save(request.path)))
        self.create_service(LoadMap, "~/load_map", lambda request, response: self.trigger(
            request, response, lambda: self._load(request.path)))

    def _on_command(self, message: Any) -> None:
        known = self._planned.get(message.plan_id, 0)
        self._planned[message.plan_id] = max(known, message.views_planned)
        if message.plan_id == self._plan_id and message.views_planned > known:
            self._stale = True  # the summary says how many views are planned

    def _on_measurement(self, message: Any) -> None:
        if message.plan_id != self._plan_id:
            self._plan_id, self._messages = message.plan_id, {}
        # one collector, delivered in order: its newest word on a view holds
        self._messages[message.view_index] = message
        self._stale = True

    def measurements(self) -> Measurements:
        """Return the readings of all views so far."""
        if not self._messages:
            raise NoDataError("selfcal/view_measurement", "no view has been measured",
                              "start the collector and measure")
        ordered = [self._messages[index] for index in sorted(self._messages)]
        newest = max(ordered, key=lambda m: sum(m.session_reject_counts))
        artifacts = {convert_in.artifact_of(message) for message in ordered}
        if len(artifacts) > 1:
            raise InputError("selfcal/view_measurement", "views of different plates in one plan",
                             "measure one plate")
        return Measurements(ordered[0].plan_id, artifacts.pop(),
                            tuple(convert_in.view_readings(message) for message in ordered),
                            convert_in.sense_of(ordered[0]),
                            convert_in.counts(newest, "session_reject"))

    def _solve_if_stale(self) -> None:
        if self._stale:
            self._stale = False
            try:
                self._solve()
            except SelfcalError as error:
                self._problem = error
                raise
            finally:
                self._report()

    def _solve(self) -> None:
        self._digest = ""
        measurements = self.measurements()
        self._digest = session_digest({
            index: readings_digest(convert_in.view_readings(message), measurements.rejected)
            for index, message in self._messages.items()})
        self._problem = None
        try:
            self.result = calibrate(measurements, solver_options(self.values))
        except NotIdentifiableError as error:
            self._problem = error
            self.result = unidentified_result(measurements, error.observability)
        self._publish()
        if self.values["save_path"] and self._problem is None:
            write_json(self.values["save_path"], result_to_dict(self.result))

    def _publish(self) -> None:
        stamp = max((convert_in.stamp_ns(m) for m in self._messages.values()), default=0)
        if self._problem is None:
            self._map.publish(fill(names.ERROR_MAP.type(), convert_out.error_map(
                self.result, stamp, self.frame_id)))
            self._markers.publish(map_markers(self.result.error_map, stamp, self.frame_id))
        numbers = summary_numbers(self.result)
        seen = self.result.observability
        fields = {name: getattr(numbers, name) for name in (
            "max_error_um", "rms_error_um", "rms_uncertainty_um", "max_theta_error_arcsec",
            "rms_theta_uncertainty_arcsec")}
        self._summary.publish(fill(names.SUMMARY.type(), {
            "header": convert_out.header(stamp, self.frame_id),
            "state": short(self._state()),
            "views_done": len(self._messages),
            "views_planned": self._planned.get(self._plan_id, 0),
            "identifiable": seen.identifiable, "rank_deficiency": seen.deficiency, **fields,
            "advice": [*seen.advice, *self.result.warnings],
            "qualified": seen.identifiable, "causes": [], "run_id": ""}))

    def _unfinished(self) -> bool:
        """Return whether the plan has views that are still to come."""
        return (isinstance(self._problem, NotIdentifiableError)
                and len(self._messages) < self._planned.get(self._plan_id, 0))

    def _state(self) -> str:
        if self._unfinished():
            return (f"{len(self._messages)} of {self._planned[self._plan_id]} views measured, "
                    "not yet enough to identify the stage.")
        return str(self._problem or state_sentence(self.result))

    def digest(self) -> str:
        """Return the fingerprint of the readings behind the published map; "" = of none."""
        return "" if self._stale else self._digest

    def _save(self, path: str) -> str:
        self._solve_if_stale()
        if self._problem is not None:
            raise self._problem
        if self.result is None:
            raise NoDataError("solver", "there is no map yet", "measure the views of the plan")
        write_json(_named(path), result_to_dict(self.result))
        return f"saved to {path}; readings {self.digest() or 'of a loaded map'}"

    def _load(self, path: str) -> str:
        self.result = result_from_dict(read_json(_named(path)), path)
        self._problem, self._digest = None, ""
        self._publish()
        return f"loaded {path}: plan {self.result.plan_id}"

    def _report(self) -> None:
        known = self.result is not None or self._problem is not None
        self.diagnose(self._state() if known else "waiting for views",
                      {"views": len(self._messages), "readings": self.digest()},
                      ok=self._problem is None or self._unfinished())


def _named(path: str) -> str:
    """Return `path`, or raise InputError if it is empty."""
    if not path:
        raise InputError("path", "is empty", "name a file")
    return path


def short(sentence: str) -> str:
    """Return a sentence without the clauses at its end that `ros2 topic echo` would cut into."""
    if len(sentence) <= ECHO_LENGTH:
        return sentence
    head = sentence[:ECHO_LENGTH]
    end = max(head.rfind(mark) for mark in ("; ", ", ", ": "))
    return (head[:end] if end > 0 else head[:-1]) + "."


def main() -> None:
    """Run the node."""
    sys.exit(run(Solver))


if __name__ == "__main__":
    main()
