# SPDX-License-Identifier: Apache-2.0
"""bag_player: replays a bag onto the graph."""

import sys
import time
from typing import Any

from rclpy.task import Future

from selfcal_ros.collection.settings.nodes import PlayerSettings
from selfcal_ros.errors import ExitCode, InputError
from selfcal_ros.nodes.base import SelfcalNode
from selfcal_ros.nodes.player import Player
from selfcal_ros.nodes.running import run
from selfcal_ros.sessions.ports import Diagnosis, Level


class BagPlayer(SelfcalNode[PlayerSettings]):
    """Plays one bag, says what it sent, and ends."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(PlayerSettings, **kwargs)
        if not self.settings.bag:
            raise InputError("bag_player", "no bag is named", "set the parameter 'bag'")
        self.finished = Future()
        self.exit_code = ExitCode.DONE
        self.player = Player(self, self.settings.bag, rate=self.settings.rate,
                             seed=self.settings.seed)
        self._patience = time.monotonic() + self.settings.wait_for_subscribers
        self._started = False
        self.every(0.002, self._step)

    def diagnosis(self) -> Diagnosis:
        """Return how far it is."""
        return Diagnosis(Level.OK, "playing", {
            "played": self.player.played, "total": self.player.total})

    def _step(self) -> None:
        if not self._started:
            alone = self.player.matched()
            if alone and time.monotonic() < self._patience:
                return
            for topic in alone:
                self.get_logger().warning(f"nobody listens to {topic}")
            self._started = True
        self.player.step()
        if self.player.done and not self.finished.done():
            self.player.drain()
            for line in self.player.playlist.lost:
                self.get_logger().warning(line)
            self.get_logger().info(f"played {self.player.sent}")
            self.finished.set_result(None)


def main() -> None:
    """Run the node."""
    sys.exit(run(BagPlayer))


if __name__ == "__main__":
    main()
