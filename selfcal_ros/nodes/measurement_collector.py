# SPDX-License-Identifier: Apache-2.0
"""measurement_collector: encoder samples and detections in, readings of each view out."""

import sys
import time
from typing import Any

from rclpy.qos import ReliabilityPolicy
from std_srvs.srv import Trigger

from selfcal_ros.bagio import convert_in, convert_out
from selfcal_ros.collection.collector import Collector, ViewProgress
from selfcal_ros.collection.digest import readings_digest, session_digest
from selfcal_ros.collection.messages import EncoderSample
from selfcal_ros.collection.reasons import advice
from selfcal_ros.errors import InputError, NoDataError
from selfcal_ros.model.readings import Measurements
from selfcal_ros.nodes import names
from selfcal_ros.nodes.base import SelfcalNode, fill, run

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
        self._status = self.publisher(names.STATUS)
        self._measurement = self.publisher(names.MEASUREMENT)
        self.subscribe(names.DETECTIONS, self._on_detection)
        self.subscribe(names.COMMAND, self._on_command)
        self._encoder = None
        self._match_encoder()
        self.create_timer(0.1, self._match_encoder)
        self.create_timer(0.05, self.guarded(self._on_timer))
        self.create_service(Trigger, "~/finish", lambda request, response: self.trigger(
            request, response, self._finish))

    def _match_encoder(self) -> None:
        """Subscribe to the encoder as its publishers offer it: reliable if all of them are."""
        offers = self.get_publishers_info_by_topic(self.resolve_topic_name(names.ENCODER.name))
        if not offers:
            return
        reliable = all(o.qos_profile.reliability == ReliabilityPolicy.RELIABLE for o in offers)
        topic = names.ENCODER if reliable else names.ENCODER_BEST_EFFORT
        if self._encoder is not None and self._encoder[0] is topic:
            return
        if self._encoder is not None:
            self.destroy_subscription(self._encoder[1])
        self._encoder = (topic, self.subscribe(topic, self._on_encoder))

    def _on_encoder(self, message: Any) -> None:
        self.collector.add_encoder(EncoderSample(
            convert_in.stamp_ns(message), tuple(message.name), tuple(message.position),
            tuple(message.velocity)))
        self._count()

    def _on_detection(self, message: Any) -> None:
        self.collector.add_detection(convert_in.detection(message))
        self._count()

    def _on_command(self, message: Any) -> None:
        try:
            self.collector.add_command(convert_in.command(message))
        except InputError:
            self.collector.refuse_command()
            raise
        finally:
            self._next_status = 0.0
            self._count()

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
            return
        self._publish(measurements, progress, final=False)
        spent = time.monotonic() - now
        self._next_status = now + max(self.values["status_period"], 5 * spent)

    def _publish(self, measurements: Measurements, progress: dict[int, ViewProgress], *,
                 final: bool) -> None:
        timeline = self.collector.timeline
        if timeline.plan_id != self._plan_id:
            self._plan_id, self._published, self._advised = timeline.plan_id, {}, set()
        for index, view in progress.items():
            stamp = convert_out.session_stamp_ns(timeline, view)
            is_last = view is list(progress.values())[-1] or not view.complete
            if is_last or final:
                self._status.publish(fill(names.STATUS.type(), convert_out.view_status(
                    view, timeline.plan_id, stamp, self.frame_id)))
            closed = view.end_ns <= timeline.last_stamp_ns
            if closed or final:
                self._advise(index, view)
            key = readings_digest(view.readings, measurements.rejected)
            ready = final or closed or view.complete
            worth = view.readings.used or index in self._published
            if ready and worth and self._published.get(index) != key:
                self._published[index] = key
                self._measurement.publish(fill(
                    names.MEASUREMENT.type(), convert_out.view_measurement(
                        view, measurements, stamp, self.frame_id)))

    def _advise(self, index: int, view: ViewProgress) -> None:
        """Say once for each view that is over what would mend its rejections."""
        lines = advice(view.readings.rejected) if index not in self._advised else []
        for line in lines:
            self.get_logger().warning(f"view '{view.view.name}': {line}")
            self._advised.add(index)

    def _finish(self) -> str:
        measurements, progress = self.collector.collect()
        self._publish(measurements, progress, final=True)
        return session_digest(self._published)

    def _report(self) -> None:
        self._since_report = 0
        received = {f"{kind}_received": n for kind, n in self.collector.received.items()}
        self.diagnose("collecting", {**received, "views": len(self._published)})


def main() -> None:
    """Run the node."""
    sys.exit(run(MeasurementCollector))


if __name__ == "__main__":
    main()
