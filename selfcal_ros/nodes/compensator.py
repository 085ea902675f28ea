# SPDX-License-Identifier: Apache-2.0
"""compensator: true positions from indicated ones, and commands, with the calibrated error map."""

import sys
import time
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from selfcal_msgs.srv import Correct

from selfcal_ros.errors import InputError
from selfcal_ros.nodes import names
from selfcal_ros.nodes.filling import fill
from selfcal_ros.nodes.hearing import FOUND_S
from selfcal_ros.nodes.managed import ManagedNode, WhileConfigured
from selfcal_ros.nodes.polling import ByTheClock
from selfcal_ros.nodes.running import run
from selfcal_ros.nodes.sessions.compensating import CompensatingSession
from selfcal_ros.nodes.sessions.health import Diagnosis, Level, merged
from selfcal_ros.settings.nodes import CompensatorSettings

LOOK_S = 0.1
"""Time between two looks at the publishers of maps."""
ALONE_S = 1.0
"""Time for which the publisher of a map must be alone before it is used: another one may be found
later than a latched message."""
MOST_WAITING = 20
"""Messages of a topic that wait for that time; of more the oldest are refused."""
KEPT = "maps from the network are not used until one node alone publishes them"


class MapsOfOneNode:
    """Subscribe to maps and summaries, and pass them on while one node alone publishes them.

    Whose a message is cannot be told: while several nodes publish, none is passed on. Once one is
    left, both topics are subscribed to anew, which brings its latched messages.

    Parameters
    ----------
    node : CompensatorNode
        The subscriber.
    inputs : sequence of (Topic, callable)
        The topics, and what takes a message of each.
    """

    def __init__(
        self,
        node: "CompensatorNode",
        inputs: Sequence[tuple[names.Topic, Callable[[Any], None]]],
    ) -> None:
        self._node = node
        self._inputs = [
            (topic, node.guarded(take, topic.name)) for topic, take in inputs
        ]
        self._waiting: deque[tuple[float, str, Callable[[], None]]] = deque()
        self._rivals, self._rivals_s = "", 0.0  # last seen
        self._found_s = time.monotonic() + FOUND_S
        self._subscriptions: list[Any] = []
        self._subscribe()
        node.own(self, MapsOfOneNode.close)
        node.every(LOOK_S, self._look)

    def diagnosis(self) -> Diagnosis:
        """Return WARN while several nodes publish."""
        return Diagnosis(Level.WARN, KEPT) if self._rivals else Diagnosis(Level.OK, "")

    def close(self) -> None:
        """End the subscriptions."""
        while self._subscriptions:
            self._node.destroy_subscription(self._subscriptions.pop())

    def _subscribe(self) -> None:
        for topic, take in self._inputs:
            receive = partial(self._receive, topic.name, take)
            self._subscriptions.append(self._node.subscribe(topic, receive))

    def _receive(self, topic: str, take: Callable[[Any], None], message: Any) -> None:
        """Keep a message until its publisher has been alone for long enough."""
        if self._has_rivals():
            raise self._of_several(topic)
        self._waiting.append((time.monotonic(), topic, partial(take, message)))
        of_topic = [entry for entry in self._waiting if entry[1] == topic]
        if len(of_topic) > MOST_WAITING:
            self._waiting.remove(of_topic[0])
            raise InputError(
                topic,
                f"a message is not used: more than {MOST_WAITING} wait",
                "publish each map once",
            )

    def _of_several(self, topic: str) -> InputError:
        return InputError(
            topic,
            f"a message is not used: {self._rivals}",
            "end all publishers but one",
        )

    def _has_rivals(self) -> bool:
        rivals = names.rivals(self._node, [topic.name for topic, _ in self._inputs])
        if not rivals:
            return False
        if not self._rivals:
            self._node.say(Level.WARN, f"{rivals}: {KEPT}")
        self._rivals, self._rivals_s = rivals, time.monotonic()
        while self._waiting:  # whose they are cannot be told either
            _, topic, _ = self._waiting.popleft()
            self._node.refusals.add(topic, self._of_several(topic))
        return True

    def _look(self) -> None:
        """Pass on what has waited, or begin anew once one publisher is left."""
        now_s = time.monotonic()
        if (
            self._has_rivals()
            or now_s - self._rivals_s < ALONE_S
            or now_s < self._found_s
        ):
            return
        if self._rivals:
            self._rivals = ""
            self._node.say(
                Level.OK, "one node alone publishes maps again: they are used"
            )
            self.close()
            self._subscribe()
        while self._waiting and now_s - self._waiting[0][0] >= ALONE_S:
            _, _, take = self._waiting.popleft()
            take()


class CompensatorNode(ManagedNode[CompensatorSettings]):
    """Publish samples without the stage's error, and commands with it.

    The topics are stage/corrected_joint_states and stage/corrected_command.
    """

    session = WhileConfigured[CompensatingSession]()
    _input = WhileConfigured[ByTheClock]()
    _encoder = WhileConfigured[Any]()
    _maps = WhileConfigured[MapsOfOneNode]()

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(CompensatorSettings, **kwargs)

    def configure(self) -> None:
        """Create the session, with the map of a file if named."""
        self.session = CompensatingSession(self.settings, self.ports(lambda *_: None))
        self._corrected = self.publisher(names.CORRECTED)
        self._commands = self.publisher(names.CORRECTED_MOTION)
        self.alone_on += [
            names.ERROR_MAP.name,
            names.SUMMARY.name,
            names.CORRECTED.name,
            names.CORRECTED_MOTION.name,
        ]

    def activate(self) -> None:
        """Subscribe to the maps and to the encoder."""
        self._maps = MapsOfOneNode(
            self,
            [
                (names.SUMMARY, self.session.take_summary),
                (names.ERROR_MAP, self.session.take_map),
            ],
        )
        self._input = ByTheClock(
            names.ENCODER.name,
            self.session.receive,
            self.guarded(self._on_samples, names.ENCODER.name),
        )
        self._encoder = self.subscribe(names.ENCODER_NEWEST, self._input, raw=True)
        self.subscribe(names.MOTION, self._on_command, raw=True)
        self.service(Correct, "~/correct", self._correct)

    def diagnose_session(self) -> Diagnosis:
        """Return the diagnosis of the session, and whether maps have several publishers."""
        return merged(self.session.diagnosis(), [self._maps.diagnosis()])

    def _on_samples(self) -> None:
        """Correct waiting samples: called for the first one, which takes the others."""
        with self._encoder.handle:
            missing = self._input.empty(self._encoder, names.ENCODER_NEWEST.qos.depth)
        self.session.correct_waiting(missing.lost, self._corrected.publish)

    def _on_command(self, data: bytes) -> None:
        corrected = self.session.command(data)
        if corrected is not None:
            self._commands.publish(corrected)

    def _correct(self, request: Any, response: Any) -> str:
        answer = self.session.answer(
            request.x, request.y, request.theta, inverse=request.inverse
        )
        fill(response, answer)
        return self.session.remark(answer)


def main() -> None:
    """Run the node."""
    sys.exit(run(CompensatorNode))


if __name__ == "__main__":
    main()
