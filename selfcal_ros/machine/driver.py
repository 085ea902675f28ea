# SPDX-License-Identifier: Apache-2.0
"""A machine that carries out view commands, in a thread of its own: what cell_driver does."""

import threading
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any

from selfcal_ros.collection.inputs import Command, Phase, check_command
from selfcal_ros.errors import SelfcalError
from selfcal_ros.machine.calling import called
from selfcal_ros.machine.cell import Cell
from selfcal_ros.machine.clock import Clock
from selfcal_ros.machine.duty import Again, Duty
from selfcal_ros.machine.interface import Machine, MachineError
from selfcal_ros.machine.measuring import place_by_robot
from selfcal_ros.machine.visiting import Event, Visitor

IDLE_S = 0.05
"""Time between two readings of the position while nothing is to be done."""
Job = Callable[[], None]


class Driver:
    """Carries out commands one after another; a new one gives up what is being visited.

    Parameters
    ----------
    cell, machine
        The machine, and what CELL.yaml states of it.
    say : callable (line)
        Takes what went wrong.
    clock : Clock, optional
        Stamps and waits.

    Attributes
    ----------
    events : deque
        Positions and detections to be published, in the order of their stamps.
    problem : str
        Why the machine stands still; empty if all is well.
    """

    def __init__(
        self,
        cell: Cell,
        machine: Machine,
        say: Callable[[str], None],
        clock: Clock | None = None,
    ) -> None:
        self._cell, self._machine, self._say = cell, machine, say
        self._clock = clock or Clock()
        self._visitor = Visitor(machine, cell, self._clock)
        self.events: deque[Event] = deque()
        self.problem = ""
        self._duty = Duty()
        self._idle_since_ns = 0
        self._unplaced = False  # the robot has failed, or was stopped
        self._placing = False  # a robot may be at it: MEASURE waits for its end
        self._turn = threading.Condition()  # guards the three below
        self._jobs: deque[Job] = deque()
        self._busy = self._ending = False
        self._thread = threading.Thread(target=self._work, name="machine", daemon=True)
        self._thread.start()

    @property
    def trouble(self) -> str:
        """The problem, or that the machine does not answer; empty if all is well."""
        return self.problem or str(self._visitor.silence or "")

    @property
    def busy(self) -> bool:
        """Whether it is placing or visiting."""
        with self._turn:
            return self._busy or bool(self._jobs)

    def take_command(self, command: Command) -> None:
        """Carry out a new command.

        Raises
        ------
        InputError
            If it is impossible.
        """
        check_command(command)
        if not self._duty.take_command(command):
            return
        job: Job | None = None
        if command.phase == Phase.PLACE and self._cell.placing == "robot":
            job = partial(self._place, command)
        elif command.phase == Phase.MEASURE:
            job = partial(self._measure, command, None)
        with self._turn:
            is_placed = self._placing and command.phase == Phase.MEASURE
            if not is_placed:
                self._jobs.clear()
            stands = is_placed or not self._busy or self._stop()
            if job is not None and stands:
                self._jobs.append(job)
            self._placing = command.phase == Phase.PLACE
            self._turn.notify()

    def take_status(self, status: Any) -> None:
        """Visit again what is missing, once all has been visited."""
        if self.busy or self.problem:
            return
        again = self._duty.missing(status, self._clock.now_ns(), self._idle_since_ns)
        command = self._duty.command
        if again and command is not None:
            with self._turn:
                if not self._jobs:
                    self._jobs.append(partial(self._measure, command, again))
                self._turn.notify()

    def _work(self) -> None:
        while not self._ending:
            with self._turn:
                self._turn.wait_for(lambda: self._jobs or self._ending, IDLE_S)
                job = self._jobs.popleft() if self._jobs else None
                self._busy, self._visitor.stopped = job is not None, False
            self._clock.read()  # by which the sequencer stamps its commands
            if job is None:
                self._guard(self._look)
                continue
            self.problem = ""
            self._guard(job)
            self._idle_since_ns = self._clock.now_ns()
            self._busy = False

    def _guard(self, job: Job) -> None:
        """Run a job; an error is said once, and the machine stands still."""
        try:
            job()
        except Exception as error:
            if self._visitor.stopped:
                return  # a new command
            self._report(error)

    def _report(self, error: Exception) -> None:
        line = (
            str(error)
            if isinstance(error, SelfcalError)
            else (f"machine: {type(error).__name__}: {error}")
        )
        if line != self.problem:
            self._say(line)
        self.problem = line

    def _stop(self) -> bool:
        """Stop what is being visited; return whether it could be, and say if it could not."""
        try:
            self._visitor.stop()
        except SelfcalError as error:
            self._report(
                MachineError(
                    f"it cannot be stopped ({error})",
                    "machine.stop",
                    "use the emergency stop",
                )
            )
            return False
        return True

    def _look(self) -> None:
        self.events.append(self._visitor.sample())
        if not self._duty.command:
            self.problem = ""

    def _place(self, command: Command) -> None:
        self._unplaced = True
        place_by_robot(self._machine, self._cell, command)
        self._unplaced = False

    def _measure(self, command: Command, again: Again | None) -> None:
        view, artifact = command.placed(), command.plate()
        if self._unplaced:
            raise MachineError(
                "the robot has not placed the plate",
                f"view '{view.name}'",
                "redo_view has it placed again",
            )
        with self._visitor.stopping():
            if again is None:
                self._visitor.approach(artifact, view)
            for event in self._visitor.view(artifact, view, again):
                self.events.append(event)

    def close(self) -> None:
        """Stop, and release the machine."""
        with self._turn:
            self._jobs.clear()
            self._ending = True
            self._stop()
            self._turn.notify()
        self._thread.join(self._cell.settle.patience)
        try:
            called("machine.close", self._machine.close)
        except SelfcalError as error:
            self._report(error)
