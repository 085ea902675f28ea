# SPDX-License-Identifier: Apache-2.0
"""bag_player: plays a bag into the ROS graph."""

import sys
import time
from typing import Any

from rclpy.task import Future

from selfcal_ros.errors import ExitCode, InputError, SelfcalError
from selfcal_ros.nodes.base import SelfcalNode
from selfcal_ros.nodes.player import Player
from selfcal_ros.nodes.running import run
from selfcal_ros.nodes.sessions.health import Diagnosis, Level
from selfcal_ros.settings.nodes import CollectorSettings, PlayerSettings

STALLED_S = 2.0
"""Time after which a listener that takes no further messages is a warning."""


class BagPlayer(SelfcalNode[PlayerSettings]):
    """Play one bag, report the messages sent, and end."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(PlayerSettings, **kwargs)
        if not self.settings.bag:
            raise InputError("bag_player", "no bag is named", "set the parameter 'bag'")
        self.finished = Future()
        self.exit_code = ExitCode.DONE
        listener = self.settings.listener
        patience_s = self.settings.wait_for_subscribers
        self.player = Player(
            self,
            self.settings.bag,
            rate=self.settings.rate,
            seed=self.settings.seed,
            listener=listener or CollectorSettings.NODE,
            beside_others=self.settings.beside_others,
        )
        self._patience = time.monotonic() + patience_s
        self._waits = bool(listener and patience_s)
        self._started = False
        self.every(0.002, self._step)

    def diagnosis(self) -> Diagnosis:
        """Return the progress, and the node it waits for."""
        level, line = Level.OK, "playing"
        if not self._started:
            level, line = Level.WARN, self._waits_for()
        elif self.player.stalled_s > STALLED_S:
            level, line = Level.WARN, f"{self.player.listener} takes no more messages"
        return Diagnosis(
            level, line, {"played": self.player.played, "total": self.player.total}
        )

    def _waits_for(self) -> str:
        if self._waits and self.player.unheard():
            return f"waiting for {self.player.listener}"
        if self._waits and self.player.unseen():
            return f"waiting for {self.player.detector}"
        return "looking who else publishes"

    def _step(self) -> None:
        if self.finished.done():
            return
        try:
            self._started = self._started or (
                self.player.is_alone() and (not self._waits or self._is_heard())
            )
            if self._started:
                self.player.step()
        except SelfcalError as error:
            self.say(Level.ERROR, str(error))
            self.exit_code = error.exit_code
            self.finished.set_result(None)
            return
        if self.player.done:
            self.player.drain()
            for line in self.player.playlist.lost:
                self.get_logger().warning(line)
            self.get_logger().info(f"played {self.player.sent}")
            self.finished.set_result(None)

    def _is_heard(self) -> bool:
        missing = self.player.deaf()
        if missing and time.monotonic() > self._patience:
            raise InputError(
                "bag_player",
                f"{' and '.join(missing)} after "
                f"{self.settings.wait_for_subscribers:g} s, nothing was played",
                "start it, name another node as listener, or set listener to '' to "
                "play without waiting",
            )
        return not missing


def main() -> None:
    """Run the node."""
    sys.exit(run(BagPlayer))


if __name__ == "__main__":
    main()
