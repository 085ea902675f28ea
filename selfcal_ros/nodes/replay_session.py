# SPDX-License-Identifier: Apache-2.0
"""The node of `selfcal replay`: plays a bag into live nodes up to the saved map.

Run as a process alongside measurement_collector and solver, and mark_detector for images:
``python -m selfcal_ros.nodes.replay_session BAG RATE SEED RESULT.json NAMESPACE`` (of the
cell in the bag; empty = the only one). Progress goes to stdout, one line ``progress DONE TOTAL``
per step, for the command line.
"""

import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Any

from rclpy.task import Future
from selfcal_msgs.srv import SaveMap
from std_srvs.srv import Trigger

from selfcal_ros.errors import ExitCode, InputError, SelfcalError
from selfcal_ros.nodes import names
from selfcal_ros.nodes.base import SelfcalNode
from selfcal_ros.nodes.hearing import others_serving
from selfcal_ros.nodes.player import IMAGES, Player
from selfcal_ros.nodes.running import run
from selfcal_ros.settings.nodes import PlayerSettings

PATIENCE_S = 60.0
"""Longest wait for the nodes to appear, to receive the messages, or to answer."""


class ReplaySession(SelfcalNode[PlayerSettings]):
    """Wait for subscribers, play, check for losses, have the map saved."""

    def __init__(
        self, player: Callable[[SelfcalNode], Player], output: str, **kwargs: Any
    ) -> None:
        super().__init__(PlayerSettings, parameter_overrides=[], **kwargs)
        self.finished, self.exit_code = Future(), ExitCode.INTERNAL
        self._output = output
        self.player = player(self)
        self.player.alone_on += [
            topic.name for topic in (*names.RESULTS, *names.COMMANDED)
        ]
        self._finish = self.create_client(Trigger, "measurement_collector/finish")
        self._save = self.create_client(SaveMap, "solver/save_map")
        self._act: Callable[[], None] = self._wait_for_nodes
        self._deadline = time.monotonic() + PATIENCE_S
        self._said = 0.0
        self._digest, self._solved = "", None
        self.subscribe(names.of_node("solver", names.SOLVED), self._on_solved)
        self.every(0.002, self._step)

    def _step(self) -> None:
        if self.finished.done():
            return
        try:
            self._act()
        except SelfcalError as error:
            self._end(str(error), error.exit_code)
        except Exception as error:  # the command waits for the end
            self._end(f"{type(error).__name__}: {error}")

    def _go(self, act: Callable[[], None]) -> None:
        self._act, self._deadline = act, time.monotonic() + PATIENCE_S

    def _late(self) -> bool:
        return time.monotonic() > self._deadline

    def _wait_for_nodes(self) -> None:
        deaf = self.player.deaf()
        ready = self._finish.service_is_ready() and self._save.service_is_ready()
        if self.player.is_alone() and not deaf and ready:
            self._refuse_other_servers()
            self._go(self._play)
        elif self._late():
            self._end(" and ".join(deaf) or "no services of collector and solver")

    def _refuse_other_servers(self) -> None:
        """Refuse a domain in which somebody else may answer a request of this session."""
        for client in (self._finish, self._save):
            service = self.resolve_service_name(client.srv_name)
            for other in others_serving(self, service, service.rpartition("/")[0]):
                raise InputError(
                    f"ROS domain {self.context.get_domain_id()}",
                    f"{other} answers {service} as well; "
                    f"{self.player.played} messages were played",
                    "end it, or play in another ROS domain",
                )

    def _play(self) -> None:
        self.player.step()
        now = time.monotonic()
        if now - self._said > 0.1 or self.player.done:
            self._said = now
            print(f"progress {self.player.played} {self.player.total}", flush=True)
        if self.player.done:
            self._go(self._wait_until_received)
        elif self.player.stalled_s > PATIENCE_S:
            self._end(f"the nodes take no more messages: {self._counts()}")

    def _wait_until_received(self) -> None:
        if self.player.arrived:
            self._ask(self._finish, Trigger.Request(), self._on_finished)
        elif self.player.overheard:
            self._end(
                f"the nodes heard somebody else as well: {self._counts()}; play in a ROS "
                "domain of its own",
                ExitCode.BAD_INPUT,
            )
        elif self._late():
            self._end(f"messages were lost: {self._counts()}")

    def _counts(self) -> str:
        received = (self.player.heard or {}) | {IMAGES: self.player.taken or 0}
        return ", ".join(
            f"{received.get(kind, 0)} of {sent} {kind} messages received"
            for kind, sent in self.player.sent.items()
        )

    def _ask(self, client: Any, request: Any, then: Callable[[Any], None]) -> None:
        self._refuse_other_servers()
        answer = client.call_async(request)

        def wait() -> None:
            if answer.done():
                then(answer.result())
            elif self._late():
                self._end(f"{client.srv_name} does not answer")

        self._go(wait)

    def _on_finished(self, response: Any) -> None:
        if not response.success:
            self._end(response.message, ExitCode.NO_DATA)
            return
        self._digest = response.message
        self._go(self._wait_until_solved)

    def _wait_until_solved(self) -> None:
        """Wait until the solver has solved exactly the readings that the collector sent last."""
        if self._solved == self._digest:
            self._ask(
                self._save,
                SaveMap.Request(path=self._output),
                lambda response: self._end(
                    "" if response.success else response.message,
                    ExitCode(response.error_code),
                ),
            )
        elif self._late():
            self._end("the solver did not receive the readings of all views")

    def _on_solved(self, message: Any) -> None:
        self._solved = message.data

    def _end(self, message: str, code: ExitCode = ExitCode.INTERNAL) -> None:
        if message:
            print(f"selfcal replay: {message}", file=sys.stderr, flush=True)
        for line in self.player.playlist.lost:
            print(f"lost {line}", flush=True)
        self.exit_code = code
        if not self.finished.done():
            self.finished.set_result(None)


def main() -> None:
    """Run the session: BAG RATE RESULT.json NAMESPACE."""
    bag, rate, output, cell = sys.argv[1:5]
    player = partial(Player, bag=bag, rate=float(rate), namespace=cell or None)
    sys.exit(run(lambda: ReplaySession(player, output), sys.argv[5:]))


if __name__ == "__main__":
    main()
