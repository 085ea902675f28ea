# SPDX-License-Identifier: Apache-2.0
"""measurement_collector: encoder samples and detections in, readings of each view out."""

import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from rclpy.subscription import Subscription
from std_srvs.srv import Trigger

from selfcal_ros.collection.collector import keep_freed_memory
from selfcal_ros.errors import InputError
from selfcal_ros.nodes import names
from selfcal_ros.nodes.base import BEAT_S
from selfcal_ros.nodes.managed import WhileConfigured, stop
from selfcal_ros.nodes.names import MatchedInput, kept_names, offered
from selfcal_ros.nodes.polling import ByTheClock, PollingNode, wake
from selfcal_ros.nodes.running import run
from selfcal_ros.nodes.sessions.collecting import CollectingSession
from selfcal_ros.nodes.sessions.health import Diagnosis, merged
from selfcal_ros.nodes.sessions.journal_keeper import JournalKeeper, KeptTopic
from selfcal_ros.nodes.sessions.reception import Reception
from selfcal_ros.settings.nodes import CollectorSettings

TICK_S = 0.1
"""Period of processing received messages."""
BUSY_S, MANY, BUSY_LOOKS = 0.01, 200, 50
"""The same for this many periods after one with this many messages or more: a bag player waits
for the counts."""
SOON_S, SOON_TICKS = 0.002, 50
"""The same while the last exposure of a view waits for the following samples, and how often."""

NO_JOURNAL = "none"
"""Value of the parameter `journal` for none; a launch file cannot pass an empty value."""


class MeasurementCollector(PollingNode[CollectorSettings]):
    """Feed a `CollectingSession`; publish ViewStatus, ViewMeasurement and the line of progress.

    A tick takes the received messages as bytes, writes them to the journal, decodes them
    together, and passes them to the session. A detection that may complete a view triggers a tick.
    """

    session = WhileConfigured[CollectingSession]()
    _reception = WhileConfigured[Reception]()
    _detections = WhileConfigured[Subscription]()
    _inputs = WhileConfigured[dict[str, ByTheClock]]()

    def __init__(self, **kwargs: Any) -> None:
        self._busy_looks = 0  # to come
        self._looks = 0  # since the last detection that may have completed a view
        super().__init__(CollectorSettings, **kwargs)

    def configure(self) -> None:
        """Create the session, the journal and the publishers."""
        keep_freed_memory()
        ports = self.ports(self._publish)
        self.session = CollectingSession(self.settings, ports)
        journal = JournalKeeper(
            self._journal_folder(),
            {topic.name: self._kept_topic(topic) for topic in names.INPUTS},
            self.settings,
            ports,
        )
        self._reception = self.own(
            Reception(self.session, journal, say=self.say, refuse=self.refusals.add),
            Reception.close,
        )
        worker = self.own(ThreadPoolExecutor(1, thread_name_prefix="journal"), stop)
        self._reception.open(worker)
        self._outputs = {
            "status": self.output(names.STATUS),
            "measurement": self.output(names.MEASUREMENT),
            "progress": self.output(names.PROGRESS),
        }
        self._received = self.publisher(names.private(names.RECEIVED))
        self._inputs = {
            names.ENCODER.name: ByTheClock(names.ENCODER.name, self._reception.encoder),
            names.DETECTIONS.name: ByTheClock(
                names.DETECTIONS.name,
                self._reception.detection,
                self.guarded(self._on_detection),
            ),
        }
        self.alone_on += [names.STATUS.name, names.ENCODER.name]

    def _kept_topic(self, topic: names.Topic) -> KeptTopic:
        name_in_bag, heard = kept_names(self, topic)
        return KeptTopic(name_in_bag, offered(topic), heard)

    def _journal_folder(self) -> str:
        """Return the folder of this cell's journals, one per namespace."""
        folder = self.settings.journal
        if folder == NO_JOURNAL:
            return ""
        return folder and str(Path(folder, self.get_namespace().strip("/")))

    def activate(self) -> None:
        """Subscribe to the cell and to the commands."""
        # undone last: remaining messages of the subscriptions go to the journal and the session
        self.own(None, lambda _: self.guarded(self._drain)())
        inputs = self._inputs
        self._detections = self.subscribe(
            names.DETECTIONS, inputs[names.DETECTIONS.name], raw=True
        )
        self.subscribe_with_age(names.COMMAND, self._reception.command, raw=True)
        MatchedInput(self, names.ENCODER_EITHER, inputs[names.ENCODER.name], raw=True)
        self.every(TICK_S, self._on_timer)
        self._busy = self.at_need(BUSY_S, self._on_timer)
        self._soon = self.at_need(SOON_S, self._on_soon)
        self.service(Trigger, "~/finish", lambda request: self._finish())
        self.every(BEAT_S, self._tell_received)
        self._tell_received()

    def _publish(self, output: str, fields: dict[str, Any]) -> None:
        self._outputs[output](fields)

    def _on_timer(self) -> None:
        self._busy_looks = BUSY_LOOKS if self._drain() >= MANY else self._busy_looks - 1
        if self._busy_looks > 0:
            wake(self._busy)
        else:
            self._busy.cancel()
        if not self._reception.restoring:
            self.session.tick()

    def _on_detection(self) -> None:
        """Process at once if a view may be complete, and repeatedly until this is decided."""
        if self._reception.may_end:
            self._looks = 0
            wake(self._soon)

    def _on_soon(self) -> None:
        self._on_timer()
        self._looks += 1
        if self._looks >= SOON_TICKS or not self._reception.may_end:
            self._soon.cancel()

    def _drain(self) -> int:
        """Process received messages and publish the counts, so that a player can keep pace."""
        self.poll()
        count = self._reception.n_waiting
        if self._reception.drain():
            self._tell_received()
        return count

    def _tell_received(self) -> None:
        if self._reception.restoring:
            return
        self._received.publish(
            names.RECEIVED.type(data=list(self.session.collector.received.values()))
        )

    def _finish(self) -> str:
        self._drain()
        if self._reception.restoring:
            raise InputError(
                "measurement_collector", "a journal is being read", "ask again later"
            )
        return self.session.finish()

    def diagnose_session(self) -> Diagnosis:
        """Return the diagnosis of the session."""
        return merged(
            self.session.diagnosis(
                detections_matched=self._detections.get_publisher_count() > 0
            ),
            [self._reception.diagnosis()],
        )


def main() -> None:
    """Run the node."""
    sys.exit(run(MeasurementCollector))


if __name__ == "__main__":
    main()
