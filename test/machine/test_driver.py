# SPDX-License-Identifier: Apache-2.0
"""What cell_driver does with the commands of a run."""

import pytest

from selfcal_ros.collection.inputs import Command, Detection, Phase
from selfcal_ros.collection.settings.estimator import read_plan
from selfcal_ros.machine import MachineError
from selfcal_ros.machine.driver import Driver
from test.support.cells import START_NS, Jumping, write_cell
from test.support.waiting import wait_until


@pytest.fixture
def cell(tmp_path):
    """Return a driver, what it said, its machine, and a function that commands a phase."""
    found, machine = write_cell(tmp_path)
    plan, said = read_plan(tmp_path / "plan.yaml"), []
    driver = Driver(found, machine, said.append, Jumping())
    stamps = iter(range(START_NS, START_NS + 100))

    def command(phase: Phase) -> None:
        driver.take_command(Command(next(stamps), phase, plan.plan_id, view=plan.views[0],
                                    artifact=plan.artifact, views_planned=len(plan.views)))
        wait_until(lambda: not driver.busy, f"the end of {phase.name}")
    yield driver, said, machine, command
    driver.close()


def test_nothing_is_measured_on_a_plate_that_the_robot_did_not_place(cell):
    driver, said, machine, command = cell
    place = machine.place

    def drop(placing):
        raise MachineError("the gripper is empty", "robot")
    machine.place = drop
    command(Phase.PLACE)
    command(Phase.MEASURE)
    assert said == ["robot: the gripper is empty", "view 'identity': the robot has not placed the "
                    "plate; redo_view has it placed again"]
    assert not any(isinstance(event, Detection) for event in driver.events)
    machine.place = place
    command(Phase.PLACE)
    command(Phase.MEASURE)
    seen = {(event.m, event.n) for event in driver.events if isinstance(event, Detection)}
    assert len(seen) == 9
