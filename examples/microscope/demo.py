# SPDX-License-Identifier: Apache-2.0
"""The demo devices of Micro-Manager's core, with a plate on their stage: no microscope is needed.

The stage moves as a real one does. Its camera exposes, and the plate is drawn into the image where
the stage says that it stands.

pip install 'selfcal_ros[micromanager]' mm-test-adapters
selfcal measure examples/microscope/plan.yaml examples/microscope/cell.yaml -o first
"""

from selfcal_ros.machine import Image, Placing
from selfcal_ros.machine.micromanager import MicroManagerMachine
from selfcal_ros.machine.simulated import SimulatedMachine


class Microscope(MicroManagerMachine):
    """The demo stage and camera, and a plate.

    Parameters
    ----------
    config : str
        Configuration file of Micro-Manager.
    simulation : str
        Plate, errors of the stage, and camera.
    folder : str
        Folder in which both lie.
    """

    def __init__(self, config: str, simulation: str, folder: str = "") -> None:
        super().__init__(config, folder=folder)
        self.plate = SimulatedMachine(simulation, folder)

    def place(self, placing: Placing) -> None:
        """Lay the plate down, as well as a hand does."""
        self.plate.place(placing)

    def image(self) -> Image | None:
        """Expose, and draw what lies under the objective."""
        super().image()
        self.plate.move_to((*self.position(), 0.0))
        return self.plate.image()
