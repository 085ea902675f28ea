# SPDX-License-Identifier: Apache-2.0
"""The ROS side of `selfcal up`, `monitor` and `call`.

Run as a process: ``python -m selfcal_ros.nodes.monitor_session NAMESPACE``. It writes a line of
JSON to stdout when something has changed, ``{"picture": ...}``, and takes requests from stdin, one
word per line: start, confirm, redo, skip, abort. Each is answered by a line
``{"answer": TEXT, "success": true|false}``. Unusable messages are reported in a line
``{"said": TEXT}``. It ends when stdin does.
"""

import json
import os
import sys
import threading
import time
from collections.abc import Callable
from functools import partial
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.clock import Clock, ClockType
from rclpy.task import Future
from std_srvs.srv import Trigger

from selfcal_ros.errors import printable
from selfcal_ros.nodes import names
from selfcal_ros.nodes.callbacks import Guarded
from selfcal_ros.nodes.filling import diagnosis_of
from selfcal_ros.nodes.running import run
from selfcal_ros.nodes.sessions.health import Level, Ports, Refusals
from selfcal_ros.nodes.sessions.watching import Watch
from selfcal_ros.topics import REQUESTS

WATCHED = (
    "measurement_collector",
    "pose_sequencer",
    "solver",
    "compensator",
    "mark_detector",
    "bag_recorder",
    "cell_driver",
    "stage_simulator",
    "bag_player",
)
PERIOD_S = 0.2
PATIENCE_S = 10.0


class MonitorSession(Guarded):
    """Publish the state of a cell from its topics, and send requests to its sequencer."""

    def __init__(self, namespace: str, **kwargs: Any) -> None:
        super().__init__(f"monitor_{os.getpid()}", namespace=namespace, **kwargs)
        self.finished = Future()
        self.refusals = Refusals(self._say, time.monotonic)
        self._watch = Watch(
            Ports(lambda *_: None, self._say, time.monotonic, time.time_ns)
        )
        for topic, take in (
            (names.COMMAND, self._watch.take_command),
            (names.STATUS, self._watch.take_status),
            (names.SUMMARY, self._watch.take_summary),
            (names.ERROR_MAP, self._watch.take_map),
        ):
            self._hear(topic, take)
        for node in WATCHED:
            self._hear(
                names.of_node(node, names.HEALTH), partial(self._on_health, node)
            )
        self._askers = {
            word: self.create_client(Trigger, f"pose_sequencer/{service}")
            for word, service in REQUESTS.items()
        }
        self._words: list[str] = []
        self._asked: list[tuple[str, float, Any]] = []
        self._shown = ""
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(
            PERIOD_S, self.guarded(self._show, "the picture"), clock=steady
        )
        self.create_timer(0.05, self.guarded(self._serve, "requests"), clock=steady)
        threading.Thread(target=self._listen, name="stdin", daemon=True).start()

    def _hear(self, topic: names.Topic, take: Callable[[Any], None]) -> None:
        self.create_subscription(
            topic.type, topic.name, self.guarded(take, topic.name), topic.qos
        )

    def _say(self, level: Level, line: str) -> None:
        self._write(json.dumps({"said": printable(line)}))

    def _on_health(self, node: str, status: DiagnosticStatus) -> None:
        self._watch.take_health(node, diagnosis_of(status))

    def _listen(self) -> None:
        for line in sys.stdin:
            self._words.append(line.strip())
        self._words.append("")

    def _show(self) -> None:
        text = json.dumps({"picture": self._watch.picture()})
        if text != self._shown:
            self._shown = text
            self._write(text)

    def _serve(self) -> None:
        """Send requests, and forward answers and time-outs."""
        while self._words:
            word = self._words.pop(0)
            if not word:
                self._end()
            elif word not in self._askers:
                known = ", ".join([*REQUESTS, "quit"])
                self._answer(f"{word}: is unknown; give {known}", success=False)
            else:
                self._asked.append((word, time.monotonic() + PATIENCE_S, None))
        waiting = []
        for word, until, future in self._asked:
            client = self._askers[word]
            if future is None and client.service_is_ready():
                future = client.call_async(Trigger.Request())
            if future is not None and future.done():
                self._answer(
                    f"{word}: {future.result().message}",
                    success=future.result().success,
                )
            elif time.monotonic() > until:
                self._answer(
                    f"{word}: pose_sequencer does not answer; is it running in this "
                    "namespace and ROS_DOMAIN_ID?",
                    success=False,
                )
            else:
                waiting.append((word, until, future))
        self._asked = waiting

    def _answer(self, text: str, *, success: bool) -> None:
        self._write(json.dumps({"answer": text, "success": success}))

    def _write(self, text: str) -> None:
        try:
            print(text, flush=True)
        except BrokenPipeError:
            self._end()

    def _end(self) -> None:
        if not self.finished.done():
            self.finished.set_result(None)


def main() -> None:
    """Run the session: NAMESPACE."""
    namespace = sys.argv[1] if len(sys.argv) > 1 else ""
    sys.exit(run(lambda: MonitorSession(namespace), sys.argv[2:]))


if __name__ == "__main__":
    main()
