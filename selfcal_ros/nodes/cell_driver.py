# SPDX-License-Identifier: Apache-2.0
"""cell_driver: the machine of a CELL.yaml follows view commands; publishes positions and marks."""

import sys
from typing import Any

from selfcal_ros.bagio.messages import to_model
from selfcal_ros.errors import InputError
from selfcal_ros.machine.cell import open_machine, read_cell
from selfcal_ros.machine.driver import Driver
from selfcal_ros.nodes import names
from selfcal_ros.nodes.running import run
from selfcal_ros.nodes.sessions.health import Diagnosis, Level
from selfcal_ros.nodes.telling import CellNode
from selfcal_ros.settings.nodes import DriverSettings

TICK_S = 0.005
"""Time between two looks for what the machine has told."""


class CellDriver(CellNode[DriverSettings]):
    """Publish what the thread of the machine tells."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(DriverSettings, **kwargs)
        if self.get_parameter("use_sim_time").value:
            raise InputError(
                "cell_driver: use_sim_time",
                "is set, but readings of a machine are stamped by the clock of this computer",
                "start it without use_sim_time",
            )
        if not self.settings.cell:
            raise InputError("cell_driver: cell", "is not set", "name a CELL.yaml")
        cell = read_cell(self.settings.cell)
        self._driver = Driver(
            cell, open_machine(cell), lambda line: self.say(Level.ERROR, line)
        )
        self.publish(images=False)
        self.subscribe(
            names.COMMAND,
            lambda message: self._driver.take_command(to_model.command(message)),
        )
        self.subscribe(names.STATUS_AS_IT_COMES, self._driver.take_status)
        self.every(TICK_S, self._tell)

    def _tell(self) -> None:
        while self._driver.events:
            self.tell(self._driver.events.popleft())

    def diagnosis(self) -> Diagnosis:
        """Return what the machine does, or why it stands still."""
        if self._driver.trouble:
            return Diagnosis(Level.ERROR, self._driver.trouble, self.sent)
        return Diagnosis(
            Level.OK, "measuring" if self._driver.busy else "at rest", self.sent
        )

    def close(self) -> None:
        """Stop the machine and release it."""
        self._driver.close()


def main() -> None:
    """Run the node."""
    sys.exit(run(CellDriver))


if __name__ == "__main__":
    main()
