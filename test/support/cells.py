# SPDX-License-Identifier: Apache-2.0
"""Cells for tests: a clock without waiting, a person who agrees, a plate under a controller."""

from selfcal_ros.machine.cell import open_machine, read_cell
from selfcal_ros.machine.clock import SimulatedClock
from selfcal_ros.machine.gcode import GcodeMachine

START_NS = 1_700_000_000_000_000_000
PLAN = """
plan_id: machine
artifact: {grid_size: 3, grid_pitch: 0.001, angular_count: 0}
check_stops: {marks: 3, offset: 20e-6}
views:
  - {name: identity, repeats: 2}
  - {name: rot90, rotation_deg: 90, repeats: 2}
  - {name: shift, translation_pitch: [1, 0], repeats: 2}
"""
SIMULATION = """
plan: plan.yaml
seed: 3
truth: {g: 2.0e-7, a: 2.0e-7, t: 5.0e-6, phi: 1.0e-3}
noise: {sigma_xy: 5.0e-9, sigma_theta: 1.0e-6}
"""
QUIET = """
plan: plan.yaml
seed: 3
truth: {g: 2.0e-7, a: 2.0e-7, t: 5.0e-6, phi: 1.0e-3}
cell: {servo_sigma: 0.0}
"""
FEW = """
plan_id: p
artifact: {grid_size: 3, grid_pitch: 0.001, angular_count: 0}
check_stops: {marks: 2, offset: 25e-6}
views:
  - {name: a, repeats: 2}
  - {name: b, rotation_deg: 90}
  - {name: c, translation_pitch: [1, 0]}
"""
CAMERA = "camera: {width: 150, height: 140, pixel_size: 2.0e-6, mark_size: 50.0e-6, turn: 3.0}\n"
DETECTOR = "detector: {pixel_size: 2.0e-6, mark_size: 50.0e-6, turn: 3.0}\n"
CELL = """
machine: simulated
simulated: {simulation: sim.yaml}
limits: {x: [-0.01, 0.01], y: [-0.01, 0.01], theta: [-7, 7]}
placing: robot
settle: {patience: 1.0}
"""


class Jumping(SimulatedClock):
    """A clock on which a wait takes no time, from `START_NS`."""

    def __init__(self, ns: int = START_NS) -> None:
        super().__init__(ns)


class Agreeing:
    """A person who places the plate at once and agrees to everything."""

    def __init__(self) -> None:
        self.lines, self.placed, self.shown = [], [], []

    def place(self, command) -> None:
        self.placed.append(command.placed().name)

    def may_move(self, text: str) -> bool:
        return True

    def lies_still(self, view: str) -> bool:
        return True

    def show(self, progress) -> None:
        self.shown.append(progress.coverage)

    def say(self, line: str) -> None:
        self.lines.append(line)


class WithPlate(GcodeMachine):
    """A plate lies under the camera of the controller's machine."""

    def __init__(self, simulated, **keys) -> None:
        self._simulated = simulated
        super().__init__(feed=6000.0, **keys)

    def place(self, placing) -> None:
        self._simulated.place(placing)

    def image(self):
        self._simulated.move_to((self.position()[0], self.position()[1], 0.0))
        return self._simulated.image()


def write_cell(
    folder,
    *,
    plan: str = PLAN,
    simulation: str = SIMULATION,
    cell: str = CELL,
    camera: bool = False,
):
    """Write plan.yaml, sim.yaml and cell.yaml; return the cell and its machine."""
    (folder / "plan.yaml").write_text(plan)
    (folder / "sim.yaml").write_text(simulation + (CAMERA if camera else ""))
    (folder / "cell.yaml").write_text(cell + (DETECTOR if camera else ""))
    found = read_cell(folder / "cell.yaml")
    return found, open_machine(found)
