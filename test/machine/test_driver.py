# SPDX-License-Identifier: Apache-2.0
"""What cell_driver does with the commands of a run."""

import threading
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from selfcal_ros.collection.inputs import Command, Detection, Kind, Phase
from selfcal_ros.machine import MachineError
from selfcal_ros.machine.cell import open_machine, read_cell
from selfcal_ros.machine.driver import Driver
from selfcal_ros.machine.duty import PATIENCE_NS
from selfcal_ros.machine.measuring import Run
from selfcal_ros.settings.estimator import read_plan
from selfcal_ros.units import NS_PER_S
from test.support.cells import START_NS, Agreeing, Jumping, write_cell
from test.support.waiting import wait_until

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture
def cell(tmp_path):
    """Return a driver, what it said, its machine, and a function that commands a phase."""
    found, machine = write_cell(tmp_path)
    plan, said = read_plan(tmp_path / "plan.yaml"), []
    driver = Driver(found, machine, said.append, Jumping())
    stamps = iter(range(START_NS, START_NS + 100))

    def command(*phases: Phase) -> None:
        with driver._turn:  # its thread takes none of them up before the last
            for phase in phases:
                driver.take_command(
                    Command(
                        next(stamps),
                        phase,
                        plan.plan_id,
                        view=plan.views[0],
                        artifact=plan.artifact,
                        views_planned=len(plan.views),
                    )
                )
        wait_until(lambda: not driver.busy, f"the end of {phases}")

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
    assert said == [
        "robot: the gripper is empty",
        "view 'identity': the robot has not placed the plate; redo_view has it placed again",
    ]
    assert not any(isinstance(event, Detection) for event in driver.events)
    machine.place = place
    command(Phase.PLACE)
    command(Phase.MEASURE)
    seen = {
        (event.m, event.n) for event in driver.events if isinstance(event, Detection)
    }
    assert len(seen) == 9


@pytest.mark.parametrize("step_s", [-3600, 3600])
def test_stamps_follow_a_clock_that_was_set_between_two_runs(
    tmp_path, monkeypatch, step_s
):
    """By the new time at once, though nothing is commanded: a start waits for samples."""
    found, machine = write_cell(tmp_path)
    driver = Driver(found, machine, [].append)
    try:
        wait_until(lambda: driver.events, "a sample")
        real_ns, step_ns = time.time_ns, step_s * NS_PER_S
        monkeypatch.setattr(time, "time_ns", lambda: real_ns() + step_ns)
        driver.events.clear()

        def is_set():
            return driver.events and (
                abs(driver.events[-1].stamp_ns - time.time_ns()) < NS_PER_S
            )

        wait_until(is_set, "a sample by the new time")
    finally:
        driver.close()


def test_a_plate_is_placed_though_the_command_to_measure_follows_at_once(cell):
    driver, said, machine, command = cell
    place, placed = machine.place, []
    machine.place = lambda placing: (placed.append(placing.view), place(placing))
    command(Phase.PLACE, Phase.MEASURE)
    assert placed == ["identity"] and not said
    assert any(isinstance(event, Detection) for event in driver.events)


def test_a_machine_that_does_not_answer_is_named_until_it_does(cell):
    driver, _, machine, _ = cell
    position, asked, answers = machine.position, threading.Event(), threading.Event()

    def silent():
        asked.set()
        answers.wait()
        return position()

    machine.position = silent
    asked.wait()
    assert not driver.trouble
    driver._clock.sleep(75.0)
    assert driver.trouble.startswith(
        "machine.position: it has not answered for 61 s; check"
    )
    answers.set()
    wait_until(lambda: not driver.trouble, "an answer")


def test_a_machine_that_is_stopped_while_it_is_asked_is_not_silent_later(cell):
    """What it was asked is answered before the call of stop returns."""
    driver, _, machine, _ = cell
    stop, position, answers = machine.stop, machine.position, threading.Event()
    asked, answered = threading.Event(), threading.Event()

    def late():
        if not asked.is_set():
            asked.set()
            answers.wait()
        return position()

    def stops_and_waits():
        stop()
        answers.set()
        wait_until(lambda: driver._visitor._asked is None, "the answer")
        answered.set()

    machine.position, machine.stop = late, stops_and_waits
    asked.wait()
    driver._visitor.stop()
    assert answered.is_set()
    driver._clock.sleep(75.0)
    wait_until(lambda: not driver.trouble, "another answer")


def test_a_move_that_was_being_prepared_at_an_abort_is_stopped_once_it_begins(cell):
    """A controller is asked for its position before it is sent away."""
    driver, _, machine, command = cell
    move_to, preparing, moving = machine.move_to, threading.Event(), threading.Event()
    stopped, stops = threading.Event(), []

    def moves(position):
        preparing.set()
        wait_until(lambda: stops, "the abort")
        moving.set()
        assert stopped.wait(5.0)
        move_to(position)

    def stop():
        stops.append(moving.is_set())
        if stops[-1]:
            stopped.set()
        else:
            moving.wait(1.0)

    command(Phase.PLACE)
    machine.move_to, machine.stop = moves, stop
    threading.Thread(target=command, args=[Phase.MEASURE]).start()
    preparing.wait()
    driver.take_command(replace(driver._duty.command, phase=Phase.ABORT, stamp_ns=1))
    assert stops[0] is False
    assert stops[1] is True


def test_a_machine_that_cannot_be_stopped_is_said_and_takes_no_other_view(cell):
    driver, said, machine, command = cell
    move_to, moving, ended = machine.move_to, threading.Event(), threading.Event()

    def moves(position):
        moving.set()
        ended.wait()
        move_to(position)

    def lost():
        raise OSError("no route to host")

    command(Phase.PLACE)
    machine.move_to, machine.stop = moves, lost
    threading.Thread(target=command, args=[Phase.MEASURE]).start()
    moving.wait()
    again = replace(driver._duty.command, stamp_ns=START_NS + 1000)
    driver.take_command(again)
    assert "machine.stop: it cannot be stopped" in said[-1]
    assert "no route to host" in said[-1] and said[-1].endswith("emergency stop")
    ended.set()
    wait_until(lambda: not driver.busy, "the end of the move")
    assert driver.trouble == said[-1]
    assert not any(isinstance(event, Detection) for event in driver.events)


def test_a_mark_that_is_missing_later_is_visited_in_the_order_of_time(cell):
    """The positions on the way to it begin where the stage has stood meanwhile."""
    driver, _, _, command = cell
    command(Phase.PLACE)
    command(Phase.MEASURE)
    told = len(driver.events)
    wait_until(lambda: len(driver.events) >= told + 3, "positions at rest")
    driver._clock.ns += 10 * PATIENCE_NS
    wait_until(
        lambda: driver.events[-1].stamp_ns > driver._clock.ns - PATIENCE_NS,
        "a later one",
    )
    driver.take_status(
        SimpleNamespace(
            complete=False,
            view_index=0,
            run_id="",
            missing_m=[1],
            missing_n=[0],
            missing_k=[],
            check_done=0,
            check_expected=0,
        )
    )
    wait_until(lambda: not driver.busy, "the visit")
    again = list(driver.events)[told:]
    assert [(event.m, event.n) for event in again if isinstance(event, Detection)] == [
        (1, 0)
    ]
    stamps = [event.stamp_ns for event in driver.events]
    assert stamps == sorted(stamps)


def exposures(events) -> list[tuple]:
    """Return each detection without its stamp, with the position before it."""
    found, at = [], ()
    for event in events:
        if isinstance(event, Detection):
            found.append((replace(event, stamp_ns=0), at))
        else:
            at = event.positions
    return found


def test_a_class_of_ones_own_tells_the_same_without_ros_and_by_the_driver(tmp_path):
    cell = read_cell(EXAMPLES / "cell.yaml")
    plan = read_plan(EXAMPLES.parent / "config/plans/small.yaml")

    class Listening(Run):
        def _write(self, event):
            super()._write(event)
            written.append(event)

    written = []
    Listening(
        plan, cell, open_machine(cell), tmp_path / "bag", Agreeing(), Jumping()
    ).measure()
    commands = [event for event in written if isinstance(event, Command)]
    alone = exposures(event for event in written if not isinstance(event, Command))

    driver = Driver(cell, open_machine(cell), pytest.fail, Jumping())
    try:
        for command in commands:
            driver.take_command(command)
            wait_until(lambda: not driver.busy, "the end of the command")
        driven = exposures(driver.events)
    finally:
        driver.close()
    assert driven == alone
    assert len(alone) == 340
    lines = [line for line, _ in alone if line.kind == Kind.ANGULAR]
    assert {(line.offset_x, line.offset_y) for line in lines} == {(0.0, 0.0)}
