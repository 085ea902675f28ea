# SPDX-License-Identifier: Apache-2.0
"""The session of solver: which readings are solved, what is published, saved and loaded."""

from typing import Any

from selfcal_ros.collection.digest import readings_digest, session_digest
from selfcal_ros.collection.parameters import solver_options
from selfcal_ros.errors import InputError, NoDataError, NotIdentifiableError, SelfcalError
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.files import read_json, write_json
from selfcal_ros.messages import from_model, to_model
from selfcal_ros.model.readings import Measurements
from selfcal_ros.model.result import (
    CalibrationResult,
    created_now,
    result_from_dict,
    result_to_dict,
    unidentified_result,
)
from selfcal_ros.reporting.summary.numbers import summary_numbers
from selfcal_ros.reporting.summary.text import state_sentence
from selfcal_ros.sessions.ports import Diagnosis, Level, Ports

ECHO_LENGTH = 128
"""Characters of a string that `ros2 topic echo` shows."""


class SolvingSession:
    """Solves when the readings of a view have arrived; publishes ``map`` and ``summary``.

    Parameters
    ----------
    values : dict
        Values of the solver's parameters.
    ports : Ports
        Publishes ``map``, ``markers`` (the result's map, its stamp in ns) and ``summary``.
    """

    def __init__(self, values: dict[str, Any], ports: Ports) -> None:
        self._values, self._ports = values, ports
        self._messages: dict[int, Any] = {}
        self._plan_id: str | None = None
        self._planned: dict[str, int] = {}
        self._digest = ""
        self._stale = False
        self.result: CalibrationResult | None = None
        self._problem: SelfcalError | None = None

    def take_command(self, message: Any) -> None:
        """Learn from a view command how many views are planned."""
        known = self._planned.get(message.plan_id, 0)
        self._planned[message.plan_id] = max(known, message.views_planned)
        if message.plan_id == self._plan_id and message.views_planned > known:
            self._stale = True  # the summary says how many views are planned

    def take_measurement(self, message: Any) -> None:
        """Take the readings of a view."""
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
        artifacts = {to_model.artifact_of(message) for message in ordered}
        if len(artifacts) > 1:
            raise InputError("selfcal/view_measurement", "views of different plates in one plan",
                             "measure one plate")
        return Measurements(ordered[0].plan_id, artifacts.pop(),
                            tuple(to_model.view_readings(message) for message in ordered),
                            to_model.sense_of(ordered[0]),
                            to_model.counts(newest, "session_reject"))

    def tick(self) -> bool:
        """Solve if readings have come since; return whether it did.

        Raises
        ------
        SelfcalError
            If the readings cannot be used.
        """
        if not self._stale:
            return False
        self._stale = False
        try:
            self._solve()
        except SelfcalError as error:
            self._problem = error
            raise
        return True

    def _solve(self) -> None:
        self._digest = ""
        measurements = self.measurements()
        self._digest = session_digest({
            index: readings_digest(to_model.view_readings(message), measurements.rejected)
            for index, message in self._messages.items()})
        self._problem = None
        try:
            self.result = calibrate(measurements, solver_options(self._values))
        except NotIdentifiableError as error:
            self._problem = error
            self.result = unidentified_result(measurements, error.observability)
        self._publish()
        if self._values["save_path"] and self._problem is None:
            write_json(self._values["save_path"], result_to_dict(created_now(self.result)))

    def _publish(self) -> None:
        stamp = max((to_model.stamp_ns(m) for m in self._messages.values()), default=0)
        frame_id = self._values["frame_id"]
        if self._problem is None:
            self._ports.publish("map", from_model.error_map(self.result, stamp, frame_id))
            self._ports.publish("markers", {"error_map": self.result.error_map, "stamp_ns": stamp})
        numbers = summary_numbers(self.result)
        seen = self.result.observability
        fields = {name: getattr(numbers, name) for name in (
            "max_error_um", "rms_error_um", "rms_uncertainty_um", "max_theta_error_arcsec",
            "rms_theta_uncertainty_arcsec")}
        self._ports.publish("summary", {
            "header": from_model.header(stamp, frame_id),
            "state": short(self._state()),
            "views_done": len(self._messages),
            "views_planned": self._planned.get(self._plan_id, 0),
            "identifiable": seen.identifiable, "rank_deficiency": seen.deficiency, **fields,
            "advice": [*seen.advice, *self.result.warnings],
            "qualified": self.result.verdict.qualified,
            "causes": [cause.text for cause in self.result.verdict.causes],
            "run_id": self.result.run_id})

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

    def save(self, path: str) -> str:
        """Write the result of the newest readings and say so."""
        self.tick()
        if self._problem is not None:
            raise self._problem
        if self.result is None:
            raise NoDataError("solver", "there is no map yet", "measure the views of the plan")
        write_json(_named(path), result_to_dict(created_now(self.result)))
        return f"saved to {path}; readings {self.digest() or 'of a loaded map'}"

    def load(self, path: str) -> str:
        """Publish the map of a RESULT.json and say so."""
        self.result = result_from_dict(read_json(_named(path)), path)
        self._problem, self._digest = None, ""
        self._publish()
        return f"loaded {path}: plan {self.result.plan_id}"

    def diagnosis(self) -> Diagnosis:
        """Return what the node says of itself."""
        known = self.result is not None or self._problem is not None
        fine = self._problem is None or self._unfinished()
        return Diagnosis(Level.OK if fine else Level.WARN,
                         self._state() if known else "waiting for views",
                         {"views": len(self._messages), "readings": self.digest()})


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
