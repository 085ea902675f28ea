# SPDX-License-Identifier: Apache-2.0
"""A cell that goes on when its nodes are killed: node processes, and messages played into them."""

import contextlib
import resource
import subprocess
import time
from collections.abc import Sequence
from functools import partial
from operator import ge
from pathlib import Path
from typing import Any

from rclpy.event_handler import PublisherEventCallbacks
from selfcal_msgs.srv import SaveMap
from std_srvs.srv import Trigger

from selfcal_ros.cli.processes import process
from selfcal_ros.collection.inputs import Command, Detection, EncoderSample
from selfcal_ros.files import read_json
from selfcal_ros.nodes import names
from selfcal_ros.nodes.measurement_collector import MeasurementCollector
from selfcal_ros.nodes.solver import Solver
from selfcal_ros.simulation.cell import Event
from test.support.forked import Forks
from test.support.ros import Graph
from test.support.sessions import cdr_of

ROLES = {
    EncoderSample: names.ENCODER,
    Detection: names.DETECTIONS,
    Command: names.COMMAND,
}
KINDS = tuple(ROLES)
"""In the order in which the collector tells its counts."""

NODES = {"measurement_collector": MeasurementCollector, "solver": Solver}
"""Those that may run in the process of the test."""

ATTEMPTS, IDLE_S = 5, 5.0
LATE_S = 25.0
"""After which a message does not come any more: one to a collector that was started again may wait
until DDS gives up the reader that was killed, 20 s, and would be counted twice if sent again."""


class Cell:
    """Plays a run into node processes; repeats what the collector had not told as received.

    A cell whose detections nobody takes waits: it goes on when the collector is back. Nodes named
    in `inside`, which nobody kills, run in the process of the test; the others are forked, if there
    are `forks`, or started as new interpreters.
    """

    def __init__(
        self,
        graph: Graph,
        environment: dict,
        folder: Path,
        namespace: str = "",
        *,
        forks: Forks | None = None,
    ) -> None:
        self.graph, self.environment, self.folder, self.forks = (
            graph,
            environment,
            folder,
            forks,
        )
        self.inside: dict[str, Any] = {}
        self.namespace, self.running = namespace, {}
        self.processes = contextlib.ExitStack()
        self.told = (0, 0, 0)
        graph.hand.create_subscription(
            names.RECEIVED.type,
            self.name("measurement_collector/received"),
            self._on_told,
            names.RECEIVED.qos,
        )
        self.newest_ns, self.newest_told = 0, ""
        graph.hand.create_subscription(
            names.HEALTH.type,
            self.name("measurement_collector/health"),
            self._on_health,
            names.HEALTH.qos,
        )
        self.solved: list = []
        graph.hand.create_subscription(
            names.SOLVED.type,
            self.name("solver/solved"),
            self.solved.append,
            names.SOLVED.qos,
        )
        self.matched = dict.fromkeys(KINDS, 0)
        self.publishers = {
            kind: graph.hand.create_publisher(
                topic.type,
                self.name(topic.name),
                topic.qos,
                event_callbacks=PublisherEventCallbacks(
                    matched=partial(self._on_matched, kind)
                ),
            )
            for kind, topic in ROLES.items()
        }

    def name(self, name: str) -> str:
        """Return a name of this cell as the hand of the graph sees it."""
        return f"{self.namespace}/{name}" if self.namespace else name

    def _on_matched(self, kind: type, info: Any) -> None:
        self.matched[kind] = info.total_count

    def _on_told(self, message: object) -> None:
        self.told = tuple(message.data)

    def _on_health(self, message: Any) -> None:
        self.newest_told = {value.key: value.value for value in message.values}.get(
            "command_stamp", ""
        )

    def start(self, node: str, **parameters: object) -> None:
        if node in self.inside:
            self.inside[node] = self.graph.node(
                partial(NODES[node], namespace=self.namespace),
                **{
                    key: str(value) if isinstance(value, Path) else value
                    for key, value in parameters.items()
                },
            )
            return
        arguments = [
            "--ros-args",
            "-r",
            f"__ns:=/{self.namespace}",
            *(
                word
                for key, value in parameters.items()
                for word in ("-p", f"{key}:={value}")
            ),
        ]
        self.running[node] = self.processes.enter_context(
            self.forks.process(node, arguments, self.environment)
            if self.forks
            else process(
                f"selfcal_ros.nodes.{node}",
                arguments,
                self.environment,
                stderr=subprocess.PIPE,
                text=True,
            )
        )

    def start_collector(self) -> None:
        """Start it and wait until it knows what its journal holds."""
        before, self.told = self.told, (-1, -1, -1)
        heard = dict(self.matched)
        self.start("measurement_collector", journal=self.folder, status_period=0.1)
        # a reader that was killed counts as a reader for a while: wait for a new one
        self.graph.until(
            lambda: all(self.matched[kind] > count for kind, count in heard.items()),
            "the collector",
        )
        if sum(before):
            # commands that are refused are not in it, and others are heard again
            self.graph.until(
                lambda: all(map(ge, self.told[:2], before[:2])),
                f"what the journal holds: told {before} before",
            )

    def kill(self, node: str) -> None:
        running = self.running.pop(node)
        running.kill()
        running.communicate()

    def end(self, node: str) -> None:
        """End a node as a launcher does, and wait for it."""
        if node in self.inside:
            self.graph.remove(self.inside.pop(node))
            return
        running = self.running.pop(node)
        running.terminate()
        running.communicate()

    def limit_files(self, node: str, size: int) -> None:
        """Let the files of a node grow no larger than `size` bytes, as if the disk were full."""
        resource.prlimit(
            self.running[node].pid,
            resource.RLIMIT_FSIZE,
            (size, resource.RLIM_INFINITY),
        )

    def send(self, events: Sequence[Event], *, first: int = 0) -> None:
        """Publish events, those of which the collector has told nothing; commands are latched."""
        number = dict.fromkeys(KINDS, 0)
        for index, event in enumerate(events):
            kind = type(event)
            number[kind] += 1
            new = (
                index >= first
                if kind is Command
                else number[kind] > self.told[KINDS.index(kind)]
            )
            if kind is Command:
                self.newest_ns = max(self.newest_ns, event.stamp_ns)
            if new:
                self.publishers[kind].publish(cdr_of(event))

    def until_told(self, events: Sequence[Event], but: int = 0) -> None:
        """Wait until all samples and detections but some are told as received."""
        counts = [
            sum(isinstance(event, kind) for event in events) - but for kind in KINDS[:2]
        ]
        self.graph.until(lambda: all(map(ge, self.told, counts)), "what was sent")

    def deliver(self, events: Sequence[Event], *, first: int = 0) -> None:
        """Send events and wait until all are told; once more those that a new node did not hear."""
        counts = [sum(isinstance(event, kind) for event in events) for kind in KINDS]
        for _ in range(ATTEMPTS):
            self.send(events, first=first)
            first, changed, before = len(events), time.monotonic(), self.told
            while time.monotonic() < changed + LATE_S and not self._all_told(counts):
                self.graph.executor.spin_once(timeout_sec=0.02)
                if self.told != before:
                    before, changed = self.told, time.monotonic()
            if self._all_told(counts):
                return
        raise AssertionError(f"{counts} messages sent, {self.told} told as received")

    def _all_told(self, counts: Sequence[int]) -> bool:
        return all(map(ge, self.told[:2], counts[:2]))

    def saved(self) -> dict | str:
        """Return the result that the solver saves, or why there is none."""
        path = self.folder / "map.json"
        # a count does not tell: a collector that starts hears commands again
        if self.newest_ns:
            self.graph.until(
                lambda: self.newest_told == str(self.newest_ns), "the last command"
            )
        finished = self.answer(Trigger, "measurement_collector/finish")
        assert finished.success, finished.message
        # where the readings are refused it says nothing
        end = time.monotonic() + 4 * IDLE_S
        while time.monotonic() < end and all(
            m.data != finished.message for m in self.solved
        ):
            self.graph.executor.spin_once(timeout_sec=0.02)
        answer = self.answer(SaveMap, "solver/save_map", path=str(path))
        return read_json(path) if answer.success else answer.message

    def answer(
        self, kind: type, name: str, *, again_s: float = 2 * IDLE_S, **fields: object
    ) -> Any:
        """Call a service, again where a node that was killed seems to have taken the request."""
        client = self.graph.hand.create_client(kind, self.name(name))
        for _ in range(round(ATTEMPTS * 2 * IDLE_S / again_s)):
            self.graph.until(client.service_is_ready, name)
            future, end = (
                client.call_async(kind.Request(**fields)),
                time.monotonic() + again_s,
            )
            while not future.done() and time.monotonic() < end:
                self.graph.executor.spin_once(timeout_sec=0.02)
            if future.done():
                return future.result()
        raise AssertionError(f"{name} does not answer")

    def close(self) -> None:
        self.processes.close()
