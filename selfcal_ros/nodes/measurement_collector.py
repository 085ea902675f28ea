# SPDX-License-Identifier: Apache-2.0
"""measurement_collector: encoder samples and detections in, readings of each view out."""

import sys
import time
from collections import Counter
from typing import Any

from std_srvs.srv import Trigger

from selfcal_ros.bagio import convert_in, convert_out
from selfcal_ros.collection.collector import Collector, ViewProgress
from selfcal_ros.collection.digest import readings_digest, session_digest
from selfcal_ros.collection.messages import Command, EncoderSample, Phase
from selfcal_ros.collection.reasons import advice
from selfcal_ros.errors import InputError, NoDataError
from selfcal_ros.model.readings import Measurements
from selfcal_ros.nodes import names
from selfcal_ros.nodes.base import SelfcalNode, fill, run
from selfcal_ros.nodes.encoder_input import EncoderInput

REPORT_EVERY = 500
"""Messages after which the counts are reported at once, so that a player can keep pace."""


class MeasurementCollector(SelfcalNode):
    """Feeds a `Collector`; publishes ViewStatus, and ViewMeasurement when a view completes."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("measurement_collector", **kwargs)
        self.collector = Collector(self.values)
        self._dirty, self._since_report, self._next_status = False, 0, 0.0
        self._published: dict[int, str] = {}
        self._plan_id, self._advised = "", set()
        self._missed: dict[tuple[str, int], str] = {}  # views that began before this node
        self._placed: set[tuple[str, int]] = set()
        self._problem = ""
        self._state, self._rejected = "waiting for a MEASURE command", Counter()
        self._status = self.publisher(names.STATUS)
        self._measurement = self.publisher(names.MEASUREMENT)
        self.subscribe(names.DETECTIONS, self._on_detection)
        self.subscribe_with_age(names.COMMAND, self._on_command)
        EncoderInput(self, self._on_encoder)
        self.create_timer(0.05, self.guarded(self._on_timer))
        self.create_timer(1.0, self._report)
        self.create_service(Trigger, "~/finish", lambda request, response: self.trigger(
            request, response, self._finish))

    def _on_encoder(self, message: Any) -> None:
        self.collector.add_encoder(EncoderSample(
            convert_in.stamp_ns(message), tuple(message.name), tuple(message.position),
            tuple(message.velocity)))
        self._count()

    def _on_detection(self, message: Any) -> None:
        self.collector.add_detection(convert_in.detection(message))
        self._count()

    def _on_command(self, message: Any, is_older: bool) -> None:
        try:
            command = convert_in.command(message)
            self.collector.add_command(command)
            self._note_missed(command, is_older=is_older)
        except InputError:
            self.collector.refuse_command()
            raise
        finally:
            self._next_status = 0.0
            self._count()

    def _note_missed(self, command: Command, *, is_older: bool) -> None:
        """Say which views began before this node: their detections up to now are not here."""
        view = (command.plan_id, command.view_index)
        if command.phase == Phase.PLACE and not is_older:
            self._placed.add(view)
        elif command.phase == Phase.MEASURE and view in self._placed:
            self._missed.pop(view, None)
        elif command.phase == Phase.MEASURE and is_older:
            self._missed[view] = command.view.name
            self.get_logger().warning(
                f"view '{command.view.name}' began before this node: what was detected until now "
                "is missing here; redo_view measures it again")

    def _count(self) -> None:
        self._dirty = True
        self._since_report += 1
        if self._since_report >= REPORT_EVERY:
            self._report()

    def _on_timer(self) -> None:
        now = time.monotonic()
        if self._since_report:
            self._report()
        if not self._dirty or now < self._next_status:
            return
        self._dirty = False
        try:
            measurements, progress = self.collector.collect()
        except NoDataError:
            self._rejected = Counter(self.collector.unusable)
            return
        except InputError as error:  # holds until this node is restarted: say it once
            if self._problem != str(error):
                self._problem = str(error)
                self.get_logger().error(f"{error}; then restart this node")
            return
        self._publish(measurements, progress, final=False)
        self._describe(measurements, progress)
        spent = time.monotonic() - now
        self._next_status = now + max(self.values["status_period"], 5 * spent)

    def _publish(self, measurements: Measurements, progress: dict[int, ViewProgress], *,
                 final: bool) -> None:
        timeline = self.collector.timeline
        if timeline.plan_id != self._plan_id:
            self._plan_id, self._published, self._advised = timeline.plan_id, {}, set()
        for index, view in progress.items():
            stamp = convert_out.session_stamp_ns(timeline, view)
            current = index == timeline.intervals[-1].view_index or not view.complete
            key = readings_digest(view.readings, measurements.rejected)
            closed = view.end_ns <= timeline.last_stamp_ns
            ready = final or closed or view.complete
            worth = view.readings.used or index in self._published
            if ready and worth and self._published.get(index) != key:
                self._published[index] = key
                self._measurement.publish(fill(
                    names.MEASUREMENT.type(), convert_out.view_measurement(
                        view, measurements, stamp, self.frame_id)))
            # after the readings: what is called complete can be solved
            if current or index == max(progress) or final:
                self._status.publish(fill(names.STATUS.type(), convert_out.view_status(
                    view, timeline.plan_id, stamp, self.frame_id)))
            if closed or final:
                self._advise(index, view)

    def _advise(self, index: int, view: ViewProgress) -> None:
        """Say once for each view that is over what would mend its rejections."""
        lines = advice(view.readings.rejected) if index not in self._advised else []
        for line in lines:
            self.get_logger().warning(f"view '{view.view.name}': {line}")
            self._advised.add(index)

    def _describe(self, measurements: Measurements, progress: dict[int, ViewProgress]) -> None:
        """Keep for the diagnostics how far the view is and what was rejected so far."""
        self._rejected = Counter(measurements.rejected)
        for view in progress.values():
            self._rejected.update(view.readings.rejected)
        index = self.collector.timeline.intervals[-1].view_index
        self._state = "between views" if index is None else (
            f"view '{progress[index].view.name}': {100 * progress[index].coverage:.0f} % of the "
            "marks read")

    def _finish(self) -> str:
        measurements, progress = self.collector.collect()
        self._publish(measurements, progress, final=True)
        return session_digest(self._published)

    def _report(self) -> None:
        self._since_report = 0
        received = {f"{kind}_received": n for kind, n in self.collector.received.items()}
        missed = ", ".join(self._missed.values())
        state = self._problem or self._state
        state += f"; began before this node: {missed}" if missed else ""
        self.diagnose(state, {
            **received, "views": len(self._published),
            **{f"rejected {reason}": n for reason, n in sorted(self._rejected.items())}},
            ok=not missed and not self._problem and not self.collector.unusable)


def main() -> None:
    """Run the node."""
    sys.exit(run(MeasurementCollector))


if __name__ == "__main__":
    main()
