# SPDX-License-Identifier: Apache-2.0
"""A plan measured by a machine without ROS: views in their order, saved as it goes, resumed.

The bag is a journal: whatever happens, it has every exposure that was told, and can be read.
"""

import math
import shlex
import subprocess
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol

import numpy as np

from selfcal_ros.bagio.journal import Claim, Journal, create, remove_unbegun
from selfcal_ros.bagio.offline import take_all
from selfcal_ros.bagio.reader import BagReader
from selfcal_ros.bagio.writer import cdr_bytes
from selfcal_ros.collection.collector import Collector
from selfcal_ros.collection.expected import ViewProgress
from selfcal_ros.collection.inputs import Command, Detection, EncoderSample, Phase
from selfcal_ros.collection.sequencer import ENDED, Sequencer, State
from selfcal_ros.errors import InputError, NoDataError, some_of
from selfcal_ros.estimation.checks.placing import Misplaced, misplaced, placing_error
from selfcal_ros.estimation.checks.wiring import check_wiring
from selfcal_ros.machine.calling import called
from selfcal_ros.machine.cell import Cell
from selfcal_ros.machine.clock import Clock
from selfcal_ros.machine.contradicting import LEAST_VISITS, Contradiction, contradiction
from selfcal_ros.machine.duty import Again
from selfcal_ros.machine.interface import Machine, MachineError, Placing
from selfcal_ros.machine.seeing import commonest_rejections
from selfcal_ros.machine.visiting import Event, Visitor, message_of, stops
from selfcal_ros.model.readings import (
    REPEAT_OUTLIER,
    GridVisits,
    Measurements,
    placing_digest,
)
from selfcal_ros.model.view import Plan
from selfcal_ros.settings.nodes import CollectorSettings
from selfcal_ros.topics import COMMAND_TOPIC, INPUT_TOPICS, qos_profile
from selfcal_ros.units import NS_PER_S, UM_PER_M

REVISITS = 3
"""Rounds of revisits without a mark more, after which a view cannot be completed."""
TELL_NS = NS_PER_S // 2
"""Smallest time between two reports of the progress."""
SHIFT_MARKS = 5
"""Marks that are read again where a view is resumed."""
SHIFT_SIGMAS = 6.0
"""Shift of these marks, in standard deviations, from which the view is measured anew."""
LEAST_SHIFT_M = 1e-7
"""Smallest shift that counts."""
NAMED = 5
"""Number of missing marks that an error names."""


class Desk(Protocol):
    """The person at the machine, or whoever answers for them."""

    def place(self, command: Command) -> None:
        """Return when the plate lies as the view says."""
        ...

    def may_move(self, text: str) -> bool:
        """Return whether the stage may move as the text says."""
        ...

    def lies_still(self, view: str) -> bool:
        """Return whether the plate lies as it did when the view was interrupted."""
        ...

    def show(self, progress: ViewProgress) -> None:
        """Show how far the view is."""
        ...

    def say(self, line: str) -> None:
        """Show a line."""
        ...


@dataclass
class Run:
    """The measurement of a plan.

    Parameters
    ----------
    plan, cell, machine
        What is measured, and by what.
    bag : Path
        Bag folder to write.
    desk : Desk
        The person.
    clock : Clock, optional
        Stamps and waits.
    """

    plan: Plan
    cell: Cell
    machine: Machine
    bag: Path
    desk: Desk
    clock: Clock = field(default_factory=Clock)

    def __post_init__(self) -> None:
        """Prepare; nothing is written or moved yet."""
        self.visitor = Visitor(self.machine, self.cell, self.clock)
        self.collector = Collector(collector_settings(self.cell))
        self._sequencer = Sequencer(self.plan)
        self._run_id, self._stamp_ns = "", 0
        self._told_ns = 0
        self._journal: Journal | None = None
        self._resumed = False
        self.begun = False
        """Whether the bag is that of this run."""

    def require(self) -> None:
        """Refuse a plan that the machine cannot carry out, before anything moves.

        Raises
        ------
        MachineError
            If a stop is beyond the limits, or the machine lacks an axis or cannot place.
        InputError
            If the markers of the cell's detector are those of another plate.
        """
        self.visitor.eye.require(self.plan.artifact)
        for view in self.plan.views:
            route = stops(
                self.plan.artifact,
                replace(view, repeats=1, visit_order=""),
                self.cell.sense,
            )
            try:
                self.visitor.require(route)
            except MachineError as error:
                raise MachineError(
                    error.what, f"view '{view.name}': {error.where}", error.remedy
                ) from error
        places = bool(self.cell.place_command) or hasattr(self.machine, "place")
        if self.cell.placing == "robot" and not places:
            raise MachineError(
                "the machine has no method 'place'",
                f"{self.cell.path}: placing",
                "write placing: {command: 'PROGRAM {view} {x} {y} {rotation}'}, or placing: person",
            )

    def measure(self, *, resume: bool = False) -> None:
        """Measure all views; return when the last one is complete.

        Parameters
        ----------
        resume : bool
            Continue the bag of an interrupted run.

        Raises
        ------
        InputError
            If the bag exists or, to be continued, does not, or is not of this plan.
        MachineError
            If the machine does not do as commanded; it was stopped, the bag is kept.
        NoDataError
            If marks are not seen; likewise.
        """
        commands = self._begin(resume)
        self.begun = True
        try:
            with self.visitor.stopping():
                self._write_all(commands)
                while self._sequencer.state not in ENDED:
                    if self._sequencer.state is State.PLACING:
                        self._place()
                        self._write_all(self._sequencer.confirm())
                    self._measure_view()
        finally:
            if self._journal is not None:
                self._journal.close()

    def _begin(self, resume: bool) -> list[Command]:
        """Open the bag; return the commands to begin with."""
        if resume:
            self._require_begun()
        if not self.bag.exists():
            self._journal = create(self.bag)
            self._declare()
            return self._sequencer.start()
        if not resume:
            raise InputError(
                str(self.bag),
                "exists already",
                "continue it with --resume, remove it, or name another folder",
            )
        return self._take_up()

    def _require_begun(self) -> None:
        """Refuse a bag that is not there; remove one that was killed before its first file."""
        if not self.bag.exists():
            raise InputError(
                str(self.bag),
                "no such folder, there is nothing to continue",
                "name the bag of the interrupted run, or leave out --resume to begin",
            )
        if self.bag.is_dir():
            remove_unbegun(self.bag)
        if not self.bag.exists():
            self.desk.say(f"{self.bag}: nothing was saved yet, the measurement begins")

    def _declare(self) -> None:
        assert self._journal is not None
        for topic, typename in INPUT_TOPICS.items():
            profile = qos_profile(
                reliable=True,
                transient_local=topic == COMMAND_TOPIC,
                depth=64 if topic == COMMAND_TOPIC else 1000,
            )
            self._journal.add_topic(f"/{topic}", typename, [profile])

    def _take_up(self) -> list[Command]:
        """Continue an interrupted run where it stood; no commands if it is in the middle of one."""
        where = str(self.bag)
        names = [path.name for path in self.bag.glob("*.mcap")]
        # files of another name would be left out, and written over in the list of the bag
        if not names or not all(name.startswith(f"{self.bag.name}_") for name in names):
            raise InputError(
                where,
                "not the bag of an interrupted run, or it was renamed",
                "name another folder, or give it its former name",
            )
        self._journal = Claim(self.bag).resume()
        if self._journal is not None:
            self._declare()
        take_all(BagReader(self.bag), self.collector, [])
        last = self.collector.newest_command
        if last is not None and not self._is_planned(last):
            raise InputError(
                where,
                f"its run is of another plan, '{last.plan_id}'",
                "name the same PLAN.yaml, unchanged, or another folder",
            )
        if self._journal is None:
            self.desk.say(f"{where}: measured already")
            return []
        if last is None:
            return self._sequencer.start()
        newest_ns = max(last.stamp_ns, self.collector.encoder_until_ns)
        if self.clock.now_ns() <= newest_ns:
            raise InputError(
                where,
                "this computer's clock is behind the last message of the bag",
                "set the clock",
            )
        self._run_id, self._stamp_ns = last.run_id, last.stamp_ns
        self._resumed = True
        self._sequencer.resume(last.view_index, last.phase)
        if last.phase == Phase.MEASURE and self._may_go_on():
            return []
        return self._sequencer.redo()

    def _is_planned(self, last: Command) -> bool:
        """Return whether all views of the run up to its last command are those of the plan."""
        told = dict(self.collector.timeline.views)
        if last.view is not None:
            told[last.view_index] = last.view
        plate, views = (
            last.artifact or self.collector.timeline.artifact,
            self.plan.views,
        )
        return last.plan_id == self.plan.plan_id and all(
            plate is not None
            and index < len(views)
            and placing_digest(plate, view)
            == placing_digest(self.plan.artifact, views[index])
            for index, view in told.items()
        )

    def _may_go_on(self) -> bool:
        """Return whether the view has readings to go on from, and the plate still lies for it."""
        readings = self._progress().readings
        if not (len(readings.m) or len(readings.k)):
            return False  # nothing shows how the plate lies: it is placed again
        return self.desk.lies_still(self.plan.views[self._sequencer.index].name)

    def _place(self) -> None:
        """Have the plate placed; the stage does not move meanwhile."""
        command = self._sequencer_command()
        if self.cell.placing == "robot":
            place_by_robot(self.machine, self.cell, command)
        else:
            self.desk.place(command)

    def _sequencer_command(self) -> Command:
        index = self._sequencer.index
        return Command(
            stamp_ns=self._stamp_ns,
            phase=Phase.PLACE,
            plan_id=self.plan.plan_id,
            view_index=index,
            view=self.plan.views[index],
            artifact=self.plan.artifact,
            views_planned=len(self.plan.views),
            run_id=self._run_id,
        )

    def _write_all(self, commands: list[Command]) -> None:
        for command in commands:
            self._stamp_ns = max(self.clock.now_ns(), self._stamp_ns + 1)
            self._run_id = self._run_id or str(self._stamp_ns)
            self._write(replace(command, stamp_ns=self._stamp_ns, run_id=self._run_id))

    def _write(self, event: Command | Event) -> None:
        """Save a message, then use it."""
        assert self._journal is not None
        topic, fields = message_of(event)
        self._journal.write(
            f"/{topic}", cdr_bytes(INPUT_TOPICS[topic], fields), event.stamp_ns
        )
        self._journal.flush()
        _feed(self.collector, event)

    def _why(self, progress: ViewProgress) -> tuple[str, str]:
        """Return why marks of a view are not read, to be appended to a sentence, and a remedy."""
        cause = self._contradiction(progress)
        if cause:
            return f": {cause.what}", cause.remedy
        findings = self.collector.findings(*self.collector.collect())
        finding = findings.get(progress.view_index) or findings.get(None)
        if finding:
            return f": {finding}", ""
        return commonest_rejections(progress.readings.rejected), (
            "clean the plate there, check light and focus; a plate that lacks these marks is "
            "a list of the others in the plan (artifact: {marks: marks.csv})"
        )

    def _contradiction(self, progress: ViewProgress) -> Contradiction | None:
        """Return why repeats of a view's marks contradict each other, if many do."""
        if progress.readings.rejected.get(REPEAT_OUTLIER, 0) < LEAST_VISITS:
            return None
        visits = self._all_visits(progress.view_index)
        return contradiction(visits) if visits else None

    def _all_visits(self, index: int) -> GridVisits | None:
        """Return the visits of a view from the bag, outliers included."""
        everything = Collector(
            replace(collector_settings(self.cell), outlier_limit=0.0)
        )
        take_all(BagReader(self.bag), everything, [])
        return everything.collect()[1][index].readings.visits

    def _progress(self) -> ViewProgress:
        return self.collector.collect()[1][self._sequencer.index]

    def _measure_view(self) -> None:
        """Measure the view that the plate lies for, until it is complete."""
        index = self._sequencer.index
        number = len(self.plan.views)
        view = self.plan.views[index]
        resumed = self._resumed
        self._resumed = False
        self.desk.say(f"view {index + 1} of {number} '{view.name}'")
        if not self.desk.may_move(
            "the stage makes a small move, then goes to its marks"
        ):
            raise InputError(
                f"view '{view.name}'",
                "the stage may not move",
                "continue with --resume",
            )
        self.visitor.approach(self.plan.artifact, view)
        if resumed and self._has_shifted():
            self._write_all(self._sequencer.redo())
            return
        if not resumed:
            self._visit(None)
        progress = self._completed(view.name)
        self.desk.show(progress)
        cause = self._contradiction(progress)
        if cause:
            self.desk.say(f"note: view '{view.name}': {cause.what}; {cause.remedy}")
        measurements, _ = self.collector.collect()
        check_wiring(measurements)
        if self._is_misplaced(measurements, view.name):
            self._write_all(self._sequencer.redo())
            return
        self._write_all(self._sequencer.status(self.plan.plan_id, index, True))

    def _completed(self, view: str) -> ViewProgress:
        """Visit again what is missing of the view, until nothing is.

        Raises
        ------
        NoDataError
            If more rounds read no more.
        """
        needed_before = math.inf
        rounds = 0
        progress = self._progress()
        while not progress.complete:
            rounds = rounds + 1 if progress.needed >= needed_before else 0
            needed_before = progress.needed
            if rounds >= REVISITS:
                why, remedy = self._why(progress)
                raise NoDataError(
                    f"view '{view}'",
                    f"{_named(progress)} are not read after {rounds} more visits{why}",
                    remedy,
                )
            missing = progress.missing
            self._visit(
                Again(
                    {*zip(missing.m, missing.n, strict=True)},
                    {*missing.k},
                    progress.check_done < progress.check_expected,
                )
            )
            progress = self._progress()
        return progress

    def _is_misplaced(self, measurements: Measurements, view: str) -> bool:
        """Return whether the plate lies otherwise than this view asks; a robot's error is raised.

        Raises
        ------
        PlacingError
            If a robot placed it.
        """
        misplacement = misplaced(measurements)
        if not isinstance(misplacement, Misplaced) or misplacement.view != view:
            return False
        error = placing_error(misplacement)
        if self.cell.placing == "robot":
            raise error
        self.desk.say(f"{error}; the view is measured anew")
        return True

    def _visit(self, again: Again | None) -> None:
        """Visit marks of the view, save what is seen, show the progress from time to time."""
        view = self.plan.views[self._sequencer.index]
        for event in self.visitor.view(self.plan.artifact, view, again):
            self._write(event)
            if event.stamp_ns - self._told_ns >= TELL_NS:
                self._told_ns = event.stamp_ns
                self.desk.show(self._progress())

    def _has_shifted(self) -> bool:
        """Return whether plate or stage have shifted since the view was interrupted.

        A few of its marks are read again: after a power cut a stage may have lost its zero.
        """
        progress = self._progress()
        readings, view = progress.readings, progress.view
        if not len(readings.m):
            return False
        some = np.linspace(
            0, len(readings.m) - 1, min(SHIFT_MARKS, len(readings.m))
        ).astype(int)
        marks = [(int(readings.m[row]), int(readings.n[row])) for row in some]
        before = {
            mark: (readings.dx[row], readings.dy[row])
            for mark, row in zip(marks, some, strict=True)
        }
        collector = Collector(collector_settings(self.cell))
        command = self.collector.newest_command
        assert command is not None
        collector.add_command(replace(command, view=replace(view, repeats=1)))
        for event in self.visitor.view(self.plan.artifact, view, Again(marks)):
            _feed(collector, event)
        revisited = collector.collect()[1][progress.view_index].readings
        shift = np.array(
            [
                [x - before[m, n][0], y - before[m, n][1]]
                for m, n, x, y in zip(
                    revisited.m.tolist(),
                    revisited.n.tolist(),
                    revisited.dx,
                    revisited.dy,
                    strict=True,
                )
                if (m, n) in before
            ]
        )
        if not len(shift):
            self.desk.say(
                f"view '{view.name}': none of its marks is seen where it was: the plate was "
                "moved, or nothing is seen; the view is measured anew"
            )
            return True
        sigma = readings.sigma_xy if math.isfinite(readings.sigma_xy) else 0.0
        limit = max(LEAST_SHIFT_M, SHIFT_SIGMAS * sigma * math.sqrt(1 + 1 / len(shift)))
        x, y = np.median(shift, axis=0)
        if math.hypot(x, y) <= limit:
            return False
        self.desk.say(
            f"view '{view.name}': its marks lie {x * UM_PER_M:+.3g}, "
            f"{y * UM_PER_M:+.3g} µm from where they were: the plate was moved, or the "
            f"stage has another zero; the view is measured anew{_of_zero(progress)}"
        )
        return True


def collector_settings(cell: Cell) -> CollectorSettings:
    """Return the parameters with which the readings of a cell are collected."""
    return CollectorSettings.checked(
        {"measurement_sense": str(cell.sense)}, str(cell.path)
    )


def _feed(collector: Collector, event: Command | Event) -> None:
    if isinstance(event, Command):
        collector.add_command(event)
    elif isinstance(event, Detection):
        collector.add_detection(event)
    elif isinstance(event, EncoderSample):
        collector.add_encoder(event)


def place_by_robot(machine: Machine, cell: Cell, command: Command) -> None:
    """Have the plate placed by the cell's program, or by the machine itself.

    Raises
    ------
    MachineError
        If the program fails, or there is nobody to place.
    """
    view = command.placed()
    placing = Placing(view.name, *view.translation_m, view.rotation_rad, command)
    if not cell.place_command:
        place: Callable[[Placing], None] | None = getattr(machine, "place", None)
        if place is None:
            raise MachineError(
                "the machine has no method 'place'",
                f"{cell.path}: placing",
                "name a command",
            )
        called("machine.place", place, placing)
        return
    words = [
        word.format(
            view=placing.view,
            x=repr(placing.x),
            y=repr(placing.y),
            rotation=repr(placing.rotation),
        )
        for word in shlex.split(cell.place_command)
    ]
    try:
        process = subprocess.run(
            words, cwd=cell.path.parent, check=False, capture_output=True, text=True
        )
    except OSError as error:
        raise MachineError(
            f"{words[0]} cannot be run ({error.strerror})", f"{cell.path}: placing"
        ) from error
    if process.returncode:
        last = (process.stderr.strip().splitlines() or [""])[-1]
        raise MachineError(
            f"{words[0]} ended with {process.returncode}: {last}",
            f"{cell.path}: placing",
            "the plate is not placed; --resume continues",
        )


def _of_zero(progress: ViewProgress) -> str:
    """Return what another zero means for the views before, if there are any."""
    if not progress.view_index:
        return ""
    return (
        ". Another zero moves the map, and the views before have the former one: set it back, or "
        "begin a new bag"
    )


def _named(progress: ViewProgress) -> str:
    missing = progress.missing
    marks = [f"mark ({m}, {n})" for m, n in zip(missing.m, missing.n, strict=True)]
    names = [*marks, *(f"line {k}" for k in missing.k)]
    if not names:
        return "check stops"
    return some_of(names, NAMED)
