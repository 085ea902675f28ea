# SPDX-License-Identifier: Apache-2.0
"""The node of `selfcal cell check`: acts as sequencer and collector for one short run.

Run as a process: ``python -m selfcal_ros.nodes.cell_checker PLAN.yaml SETTLE_S PATIENCE_S``. It
takes the parameters of measurement_collector, and writes a line of JSON to stdout for each
`CheckItem`.
"""

import json
import sys
from dataclasses import asdict
from functools import partial
from typing import Any

from rclpy.duration import Duration
from rclpy.task import Future

from selfcal_ros.errors import ExitCode, InputError
from selfcal_ros.model.view import Plan
from selfcal_ros.nodes import names
from selfcal_ros.nodes.base import SelfcalNode
from selfcal_ros.nodes.hearing import publishers_of
from selfcal_ros.nodes.names import MatchedInput, unheard
from selfcal_ros.nodes.running import run
from selfcal_ros.nodes.sessions.cell_check import CellCheck
from selfcal_ros.nodes.sessions.health import Level
from selfcal_ros.settings.estimator import read_plan
from selfcal_ros.settings.nodes import CollectorSettings

PATIENCE_S = 3.0
"""Longest time for a last command to arrive."""
OF_A_CELL = ("cell_driver", "mark_detector")
"""Nodes of this package that are part of a cell."""


class CellChecker(SelfcalNode[CollectorSettings]):
    """Command a cell like a sequencer and check its messages."""

    def __init__(
        self, plan: Plan, *, settle_s: float, patience_s: float, **kwargs: Any
    ) -> None:
        super().__init__(CollectorSettings, **kwargs)
        self.finished, self.exit_code = Future(), ExitCode.INTERNAL
        self._said = 0
        self._outputs = {
            "command": self.output(names.NEWEST_COMMAND),
            "status": self.output(names.STATUS),
        }
        self.session = CellCheck(
            plan,
            self.settings,
            self.ports(lambda output, fields: self._outputs[output](fields)),
            settle_s=settle_s,
            patience_s=patience_s,
        )
        MatchedInput(self, names.ENCODER_EITHER, self.session.take_encoder)
        self.subscribe(names.DETECTIONS, self.session.take_detection)
        for node in OF_A_CELL:
            self.subscribe(
                names.of_node(node, names.HEALTH), partial(self._take_health, node)
            )
        self.subscribe(names.DIAGNOSTICS, self._take_diagnostics)
        self.every(0.02, self._tick)

    def _take_health(self, node: str, message: Any) -> None:
        self.session.take_health(node, message.level[0], message.message)

    def _take_diagnostics(self, message: Any) -> None:
        own_name = self.get_fully_qualified_name().lstrip("/")
        for status in message.status:
            if status.name != own_name:
                self.session.take_diagnosis(
                    status.name, status.level[0], status.message
                )

    def _tick(self) -> None:
        if self.finished.done():
            return
        if len(publishers_of(self, names.COMMAND.name)) > 1:
            self.say(
                Level.ERROR, "another node sends view commands: end the sequencer first"
            )
            self._end(ExitCode.BAD_INPUT)
            return
        for topic in (names.ENCODER.name, names.DETECTIONS.name):
            self.session.publishers[topic] = sorted(
                publisher.node_name for publisher in publishers_of(self, topic)
            )
        detections = self.resolve_topic_name(names.DETECTIONS.name)
        found = unheard(self, {detections: names.DETECTIONS})
        self.session.take_health("quality of service", found.level, found.message)
        self.session.tick()
        for item in self.session.items[self._said :]:
            print(json.dumps(asdict(item)), flush=True)
        self._said = len(self.session.items)
        if self.session.done:
            good = all(item.passed for item in self.session.items)
            self._end(ExitCode.DONE if good else ExitCode.NOT_QUALIFIED)

    def close(self) -> None:
        """Abort what a signal interrupts."""
        if not self.session.done:
            self.session.end()
            topic = self.resolve_topic_name(names.COMMAND.name)
            for publisher in self.publishers:
                if publisher.topic_name == topic:
                    publisher.wait_for_all_acked(Duration(seconds=PATIENCE_S))

    def _end(self, code: ExitCode) -> None:
        self.exit_code = code
        self.finished.set_result(None)


def main() -> None:
    """Run the node: PLAN.yaml SETTLE_S PATIENCE_S."""
    try:
        plan = read_plan(sys.argv[1])
    except InputError as error:
        print(f"selfcal: {error}", file=sys.stderr)
        sys.exit(int(error.exit_code))
    make = partial(
        CellChecker, plan, settle_s=float(sys.argv[2]), patience_s=float(sys.argv[3])
    )
    sys.exit(run(make, sys.argv[4:]))


if __name__ == "__main__":
    main()
