# SPDX-License-Identifier: Apache-2.0
"""The session of `selfcal cell check`: a short run that shows the faults of a cell."""

from collections import Counter
from collections.abc import Callable, Generator, Iterable, Mapping
from dataclasses import dataclass, replace
from itertools import islice, pairwise
from math import degrees, isfinite, nan
from typing import Any

import numpy as np

from selfcal_ros.bagio.messages import from_model, to_model
from selfcal_ros.collection.collector import Collector
from selfcal_ros.collection.expected import ViewProgress, expected_marks
from selfcal_ros.collection.inputs import (
    REMEDY,
    Command,
    Detection,
    EncoderSample,
    Kind,
    Phase,
    Reason,
)
from selfcal_ros.errors import InputError, printable
from selfcal_ros.estimation.checks.wiring import (
    sign_of_lines_is_shown,
    wiring_error,
    wiring_faults,
)
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.readings import Measurements, RepeatMotion, ViewReadings
from selfcal_ros.model.terms import block_of_offsets
from selfcal_ros.model.view import Plan, View
from selfcal_ros.nodes.sessions.cell_faults import (
    FOLLOWS,
    SAME_SCALE,
    Fault,
    Recorded,
    explaining,
    slope_of,
)
from selfcal_ros.nodes.sessions.health import Level, Ports
from selfcal_ros.settings.nodes import CollectorSettings
from selfcal_ros.units import (
    MM_PER_M,
    MRAD_PER_RAD,
    MS_PER_S,
    NS_PER_S,
    S_PER_NS,
    UM_PER_M,
)

PLAN_ID, MARKS, REPEATS, OFFSET_M = "cell_check", 3, 2, 20e-6
"""Settings of the run: marks per side in the middle of the plate, repeats, check offset."""
LISTEN_S, WATCH_S, STATUS_S, STALL_S = 2.0, 2.0, 0.5, 5.0
"""Times: for the encoder alone, for messages that should not come, between statuses, and without a
detection until an incomplete view ends."""
TURNED_DEG = 5.0
"""Turn of the offsets against the stage beyond which they are turned."""
CLEARLY, LEAST_TURN_RAD = 0.25, 2e-4
"""Part of the plate's turn within which lines show it or its opposite, and the least turn for which
this is not chance."""
AT_ONCE = 0.25
"""Part of the time between two marks within which a detection comes again at once."""
PLACED = 0.4
"""Part of the pitch by which the plate may lie beside where it is placed: from half of it on, marks
without ids are taken for their neighbours."""
ENDLESS = 1000
"""Repeats of the view that is aborted: even a fast cell is not done when ABORT arrives."""
MOST_NAMED = 5
"""Nodes in error, or joints, that are named."""
MOST_KEPT = 100
"""Names of statuses, and of joints, that are kept: whoever publishes can make up names for ever."""
REVISIT_S = 10.0
"""Time within which a cell must revisit a missing mark."""
BACK_S = 0.01
"""Least step of a clock that is told: that of a simulated one may stand still."""
OLDEST_S = 10.0
"""Largest age of a detection for a valid stamp of exposure."""
ALL_READ = ("detection clock", "rest", "ids", "marks", "check stops", "signs")
COVERED = {
    "publishers": (*ALL_READ, "theta"),
    "abort": ("commands", "detection clock"),
    "encoder rate": ("encoder clock", *ALL_READ),
    "encoder clock": ALL_READ,
    "commands": ALL_READ,
    "detection clock": ("rest", "ids", "marks", "check stops", "signs"),
    "rest": ("ids", "marks", "check stops", "signs"),
    "ids": ("detection clock", "rest", "marks", "check stops", "signs"),
    "marks": ("check stops", "signs"),
    "check stops": ("signs",),
    "signs": ("rest", "ids", "marks", "check stops"),
}
"""Checks of the readings -> those that fail as well if they fail."""
MISTAKEN = (
    Reason.UNKNOWN_MARK,
    Reason.TOO_FAR,
    Reason.AMBIGUOUS,
    Reason.NOT_IN_VIEW,
    Reason.ROTATION,
    Reason.NOT_AT_MARK,
)
"""Reasons of rejection related to ids."""

type Steps[T] = Generator[None, None, T]
"""Type of a script: yields between checks, and returns a value at the end."""


@dataclass(frozen=True)
class CheckItem:
    """One check: name, whether it passed, figure, remedy, and the fault that it follows from."""

    name: str
    passed: bool
    figure: str
    remedy: str = ""
    follows: str = ""


def grouped(
    items: list[CheckItem], fault: str, earlier: Iterable[str] = ()
) -> list[CheckItem]:
    """Return the items that passed, then each fault with those that follow from it.

    Parameters
    ----------
    items : list of CheckItem
        Checks of the readings, in their order.
    fault : str
        Name of the one that tells the fault, "" = the first that failed.
    earlier : iterable of str
        Names of checks before them that failed.
    """
    ordered = [item for item in items if item.passed]
    failed = sorted(
        (item for item in items if not item.passed), key=lambda item: item.name != fault
    )
    for name in earlier:
        covered = [
            item
            for item in failed
            if item.name in COVERED.get(name, ())
            and (item.name != fault or name == "publishers")
        ]
        ordered += [replace(item, remedy="", follows=name) for item in covered]
        failed = [item for item in failed if item not in covered]
    while failed:
        first, *later_faults = failed
        covered = [
            item for item in later_faults if item.name in COVERED.get(first.name, ())
        ]
        ordered += [
            first,
            *(replace(item, remedy="", follows=first.name) for item in covered),
        ]
        failed = [item for item in later_faults if item not in covered]
    return ordered


def checked_view(plan: Plan) -> tuple[Artifact, View]:
    """Return the middle of a plan's plate, and its view: straight, with check stops."""
    plate = plan.artifact
    listed = plan.artifact.marks
    nx, ny = (MARKS + 1 - size % 2 for size in plate.shape)  # about the same centre
    plate = (
        replace(plate, marks=listed.innermost(MARKS**2))
        if listed
        else Artifact(
            nx, plate.grid_pitch_m, plate.angular_count, 0 if nx == ny else ny
        )
    )
    marks = next((view for view in plan.views if view.check_marks), View(""))
    offset = marks.check_offset_m or min(OFFSET_M, plate.grid_pitch_m / 4)
    angular = plate.angular_count > 0 and any(view.angular for view in plan.views)
    return plate, View(
        "check",
        grid=True,
        angular=angular,
        repeats=REPEATS,
        check_marks=5,
        check_offset_m=offset,
    )


class CellCheck:
    """Command a short run like a sequencer, and evaluate messages like a collector.

    Parameters
    ----------
    plan : Plan
        Provides the plate, and whether it has angular lines.
    settings : CollectorSettings
        Sense, names of joints and limits.
    ports : Ports
        Publishes ``command`` and ``status``.
    settle_s, patience_s : float
        Time from PLACE to MEASURE, and for the first message.
    """

    def __init__(
        self,
        plan: Plan,
        settings: CollectorSettings,
        ports: Ports,
        *,
        settle_s: float = 1.0,
        patience_s: float = 30.0,
    ) -> None:
        self.plate, self.view = checked_view(plan)
        self.items: list[CheckItem] = []
        self.done = False
        self._settings, self._ports = settings, ports
        self._settle_s, self._patience_s = settle_s, patience_s
        self._collector = Collector(settings)
        self._samples: list[tuple[int, int]] = []  # stamp, and age at its reception, ns
        self._seen: list[
            tuple[float, int, bool]
        ] = []  # received, s; age, ns; whether with an id
        self._joints: set[str] = set()
        self._n_unknown: Counter[str] = Counter()  # samples of a joint without a number
        self._n_twice: Counter[str] = Counter()  # samples that name a joint twice
        self._errors: dict[str, str] = {}  # of nodes of the cell, by their names
        self._foreign: dict[
            str, str
        ] = {}  # ERRORs on /diagnostics, by the names of their statuses
        # whether there were more of them at a time than are kept
        self._has_unread = False
        self._n_early = 0  # detections between PLACE and MEASURE
        self._command = Command(0, Phase.ABORT, PLAN_ID)
        self._pause_s = WATCH_S  # after which a detection in transit has arrived
        self._script = self._run_and_diagnosed()
        self.publishers: dict[str, list[str]] = {}  # topic -> nodes that publish on it
        # of the measured view
        self._encoder: list[EncoderSample] = []
        self._detections: list[Detection] = []

    def take_encoder(self, message: Any) -> None:
        """Take a sample of the encoder."""
        sample: EncoderSample = to_model.encoder_sample(message)
        self._samples.append((sample.stamp_ns, self._ports.now_ns() - sample.stamp_ns))
        self._note_joints(sample)
        self._collector.add_encoder(sample)
        self._encoder.append(sample)

    def _note_joints(self, sample: EncoderSample) -> None:
        """Keep the names of joints: all that are wanted, of others so many."""
        where = sample.by_joint
        for name in {*sample.names}:
            if name in self._wanted_joints:
                self._joints.add(name)
                self._n_twice[name] += sample.names.count(name) > 1
                self._n_unknown[name] += not isfinite(where.get(name, nan))
            elif len(self._joints) < MOST_KEPT:
                self._joints.add(printable(name))

    @property
    def _wanted_joints(self) -> list[str]:
        """Joints of the stage that the run needs."""
        settings = self._settings
        joints = [settings.joint_x, settings.joint_y]
        return [*joints, settings.joint_theta] if self.view.angular else joints

    def take_detection(self, message: Any) -> None:
        """Take a detection."""
        detection = to_model.detection(message)
        self._seen.append(
            (
                self._ports.now_s(),
                self._ports.now_ns() - detection.stamp_ns,
                detection.has_id,
            )
        )
        self._collector.add_detection(detection)
        self._detections.append(detection)

    def take_health(self, node: str, level: int, line: str) -> None:
        """Take the health of a node of the cell: its level, and what is wrong."""
        self._errors.pop(node, None)
        if level >= Level.ERROR:
            self._errors[node] = line

    def take_diagnosis(self, name: str, level: int, line: str) -> None:
        """Take a status of /diagnostics, of whichever node; a later one of a name replaces it."""
        name = printable(name)
        self._foreign.pop(name, None)
        if level != Level.ERROR:
            return
        if len(self._foreign) < MOST_KEPT:
            self._foreign[name] = printable(line)
        else:
            self._has_unread = True

    def tick(self) -> None:
        """Perform due work; an error ends the check, which then has failed."""
        if self.done:
            return
        try:
            self.done = next(self._script, self) is self
        except Exception as error:
            self.end()
            self._tell(
                "check",
                False,
                f"ended by an error: {printable(str(error))}",
                "correct what the error names, and check again",
            )
            raise

    def end(self) -> None:
        """Abort the view, unless the check is over: else the cell goes on measuring."""
        if not self.done:
            self.done = True
            if self._command.run_id:  # else nothing was begun, and another may measure
                self._send(Phase.ABORT)

    def _run_and_diagnosed(self) -> Steps[None]:
        """Check the cell, then tell which nodes are in error at the end."""
        yield from self._run()
        if self._foreign or self._has_unread:
            node_errors = [
                f"{name}: {line}"
                for name, line in islice(sorted(self._foreign.items()), MOST_NAMED)
            ]
            n_unread = len(self._foreign) - len(node_errors)
            if n_unread > 0:
                node_errors.append(f"and {n_unread} more")
            if self._has_unread:
                node_errors.append(
                    f"there were more than {MOST_KEPT} names, and others were not read"
                )
            self._tell(
                "diagnostics",
                False,
                "ERROR on /diagnostics: " + "; ".join(node_errors),
                "correct what these nodes say, or end them if they are not of this machine",
            )

    def _run(self) -> Steps[None]:
        if not (yield from self._until(lambda: self._samples, self._patience_s)):
            self._tell(
                "encoder",
                False,
                f"nothing on stage/joint_states in {self._patience_s:g} s",
                "publish sensor_msgs/JointState there all the time, at rest as well",
            )
            return
        yield from self._wait(LISTEN_S)
        if not self._judge_publishers() or not self._judge_encoder():
            return  # everything else would follow from it
        aborted = yield from self._aborted()
        if aborted is None:
            return
        measured = yield from self._measured()
        if not self._seen:
            self._send(Phase.ABORT)
            self._tell(
                "commands",
                False,
                f"{len(self._encoder)} samples and 0 detections after a MEASURE that "
                "follows an ABORT",
                "end the view alone when ABORT arrives: the next PLACE and MEASURE begin "
                "another one",
            )
            return
        yield from self._wait(self._pause_s)
        self._judge_readings(*self._collected())
        revisited = yield from self._revisited()
        self._send(Phase.DONE)
        yield from self._wait(self._pause_s)
        if revisited is not None:
            self._tell(
                "revisits",
                revisited,
                "a mark named as missing was "
                + (
                    "seen again"
                    if revisited
                    else f"not measured again within {REVISIT_S:g} s"
                ),
                "read missing_m, missing_n, missing_k of selfcal/view_status and visit these "
                "marks until the next command; if it cannot, set min_repeats",
            )
        yield from self._old(aborted, measured)

    def _aborted(self) -> Steps[Command | None]:
        """Begin a view and abort it; return its MEASURE, None without detections."""
        command = yield from self._place_and_measure(
            replace(self.view, repeats=ENDLESS)
        )
        first = len(self._seen)
        if not (
            yield from self._until(
                lambda: len(self._seen) >= first + 3, self._patience_s
            )
        ):
            figure = f"{len(self._seen) - first} detections in {self._patience_s:g} s after MEASURE"
            remedy = (
                "subscribe selfcal/view_command reliable and transient local, act on "
                "MEASURE, publish stage/mark_detections reliable"
            )
            if self._errors:  # a node of the cell knows better
                node, error = next(iter(self._errors.items()))
                what, _, remedy = error.partition("; ")
                figure = f"{figure}: {node}: {what}"
            self._send(Phase.ABORT)
            self._tell("commands", False, figure, remedy)
            return None
        aborted = self._send(Phase.ABORT)
        self._pause_s = self._longest_pause_s()
        yield from self._wait(self._pause_s)
        before = len(self._detections)
        yield from self._wait(self._pause_s)
        late = self._exposed_since(aborted, before, self._pause_s / 2)
        self._tell(
            "abort",
            not late,
            f"{late} detections exposed later than {self._pause_s / 2:.3g} s after ABORT",
            "stop measuring when ABORT arrives",
        )
        return command

    def _measured(self) -> Steps[Command]:
        """Measure the view until it is complete or detections stop; return its MEASURE."""
        self._collector = Collector(self._settings)
        self._seen, self._encoder, self._detections = [], [], []
        command = yield from self._place_and_measure(self.view)
        self._n_early = len(self._seen)
        self._collector.add_command(command)
        begin = self._ports.now_s()

        def over() -> bool:
            last = self._seen[-1][0] if self._seen else begin + self._patience_s
            return self._collected()[1].complete or self._ports.now_s() - last > max(
                STALL_S, 2 * self._longest_pause_s()
            )

        while not over():  # without a status: nothing to revisit yet
            yield from self._wait(STATUS_S)
        self._pause_s = self._longest_pause_s()
        return command

    def _revisited(self) -> Steps[bool | None]:
        """Report a mark as missing until it is detected; return whether it was.

        None if no mark was read that could be missing.
        """
        progress = self._collected()[1]
        if not len(progress.readings.m):
            return None
        before = len(self._seen)
        end = self._ports.now_s() + REVISIT_S + self._pause_s
        mark = {
            "missing_m": [int(progress.readings.m[0])],
            "missing_n": [int(progress.readings.n[0])],
            "complete": False,
            "grid_done": max(progress.grid_done - 1, 0),
        }
        while len(self._seen) == before and self._ports.now_s() < end:
            self._status(progress, mark)
            yield from self._wait(STATUS_S)
        return len(self._seen) > before

    def _old(self, *commands: Command) -> Steps[None]:
        """Send commands again that the cell has already executed."""
        count = 0
        for command in commands:
            before = len(self._detections)
            ended = self._command
            self._publish(command)
            yield from self._wait(self._pause_s)
            count += self._exposed_since(ended, before)
            self._send(Phase.ABORT)
            yield from self._wait(self._pause_s)
        self._tell(
            "old commands",
            not count,
            f"{count} detections after a finished MEASURE was sent again",
            "remember the stamps of executed commands and do not execute them again",
        )

    def _exposed_since(
        self, command: Command, before: int, grace_s: float = 0.0
    ) -> int:
        """Return the number of detections exposed after a command: others are in transit.

        Of those received after the first `before` ones, and exposed `grace_s` after it.
        """
        end_ns = command.stamp_ns + round(grace_s * NS_PER_S)
        return sum(
            detection.stamp_ns > end_ns for detection in self._detections[before:]
        )

    def _place_and_measure(self, view: View) -> Steps[Command]:
        self._send(Phase.PLACE, view)
        yield from self._wait(self._settle_s)
        return self._send(Phase.MEASURE, view)

    def _send(self, phase: Phase, view: View | None = None) -> Command:
        """Send a command of its own run, stamped now, or after the last if a clock was set back.

        A cell takes a command stamped before the last for an old one.
        """
        now_ns = self._ports.now_ns()
        back_s = (self._command.stamp_ns - now_ns) * S_PER_NS
        if back_s > BACK_S and all(item.name != "clock" for item in self.items):
            self._tell(
                "clock",
                False,
                f"the clock of this machine was set back by {back_s:.3g} s or more: the "
                "commands are ahead of it",
                "synchronise it first, and check again",
            )
        stamp = max(now_ns, self._command.stamp_ns + 1)
        begins = phase is Phase.PLACE or not self._command.run_id
        run_id = str(stamp) if begins else self._command.run_id
        self._command = Command(
            stamp_ns=stamp,
            phase=phase,
            plan_id=PLAN_ID,
            view_index=0,
            view=view,
            artifact=None if view is None else self.plate,
            views_planned=1,
            run_id=run_id,
        )
        self._publish(self._command)
        return self._command

    def _publish(self, command: Command) -> None:
        self._ports.publish(
            "command", from_model.command(command, self._settings.frame_id)
        )

    def _status(self, progress: ViewProgress, changes: dict[str, Any]) -> None:
        fields = from_model.view_status(
            progress,
            PLAN_ID,
            self._ports.now_ns(),
            self._settings.frame_id,
            run_id=self._command.run_id,
        )
        self._ports.publish("status", fields | changes)

    def _wait(self, seconds: float) -> Steps[None]:
        yield from self._until(lambda: False, seconds)

    def _until(self, condition: Callable[[], Any], patience_s: float) -> Steps[bool]:
        """Wait for a condition; return whether it holds."""
        end = self._ports.now_s() + patience_s
        while not condition():
            if self._ports.now_s() >= end:
                return False
            yield
        return True

    def _longest_pause_s(self) -> float:
        """Return the time in which a detection in transit arrives.

        Twice the longest interval, or so much more than the usual age.
        """
        if len(self._seen) < 2:
            return WATCH_S
        received_s, ages_ns, _ = zip(*self._seen, strict=True)
        age_s = float(np.median(ages_ns)) * S_PER_NS
        return max(
            WATCH_S + float(np.clip(age_s, 0.0, OLDEST_S)),
            2 * float(np.diff(received_s).max()),
        )

    def _collected(self) -> tuple[Measurements, ViewProgress]:
        measurements, progress = self._collector.collect()
        return measurements, progress[0]

    def _tell(self, name: str, passed: bool, figure: str, remedy: str = "") -> None:
        self.items.append(CheckItem(name, passed, figure, "" if passed else remedy))

    def _several(self) -> dict[str, list[str]]:
        """Return the topics that several nodes publish on, and who."""
        return {
            topic: nodes for topic, nodes in self.publishers.items() if len(nodes) > 1
        }

    def _judge_publishers(self) -> bool:
        """Tell whether one node publishes each of the cell's topics; return whether it is so."""
        several = self._several()
        self._tell(
            "publishers",
            not several,
            "; ".join(
                f"{len(nodes)} publishers of {topic}: {', '.join(nodes)}"
                for topic, nodes in several.items()
            )
            or "one of each topic",
            "end all but one: a simulator, a second driver, or a bag being played",
        )
        return not several

    def _judge_encoder(self) -> bool:
        """Tell joints, rate and clock; return whether the joints are there."""
        settings = self._settings
        stamps, ages = np.array(self._samples).T
        missing = [joint for joint in self._wanted_joints if joint not in self._joints]
        unknown, twice = +self._n_unknown, +self._n_twice
        self._tell(
            "joints",
            not missing and not unknown and not twice,
            f"heard {printable(', '.join(sorted(self._joints)))}"
            + "".join(
                f"; {name} without a number in {count} of {len(stamps)} samples"
                for name, count in unknown.items()
            )
            + "".join(
                f"; {name} twice in {count} of {len(stamps)} samples"
                for name, count in twice.items()
            ),
            f"no joint {', '.join(missing)}: set joint_x, joint_y, joint_theta of "
            "measurement_collector"
            if missing
            else "name each joint once"
            if twice
            else "publish a position of each joint that is named, NaN is none",
        )
        steps = np.diff(np.sort(stamps)) * S_PER_NS
        moves_on = bool(steps.sum() > 0)
        gap = float(steps.max()) if moves_on else float("inf")
        rate = len(steps) / float(steps.sum()) if moves_on else 0.0
        jitter = (
            float(np.ptp(np.quantile(steps, [0.025, 0.975]))) / 2 if moves_on else 0.0
        )
        self._tell(
            "encoder rate",
            gap <= settings.max_encoder_gap and rate >= settings.encoder_rate_min,
            f"{rate:.4g} Hz, intervals ± {jitter * MS_PER_S:.3g} ms, largest "
            f"{gap * MS_PER_S:.3g} ms"
            if moves_on
            else f"{len(stamps)} samples, all with one stamp",
            f"stamp each sample when it is taken, publish with gaps below max_encoder_gap "
            f"({settings.max_encoder_gap:g} s) and encoder_rate_min "
            f"({settings.encoder_rate_min:g} Hz), or set these",
        )
        if not moves_on:
            return False
        age = float(np.median(ages)) * S_PER_NS
        self._tell(
            "encoder clock",
            abs(age) <= settings.clock_limit,
            f"stamps {age * MS_PER_S:.4g} ms old when they arrive",
            "stamp samples when they are taken, by a clock synchronised with this machine's "
            "(NTP, PTP)",
        )
        *earlier, clock = self.items
        failed = [item.name for item in earlier if not item.passed]
        self.items[-1:] = grouped([clock], "", failed)
        return not missing and not unknown and not twice

    def _judge_readings(
        self, measurements: Measurements, progress: ViewProgress
    ) -> None:
        rejected = measurements.all_rejected()
        total = len(self._seen)
        if self._several():  # found, or begun, later than the others
            self._judge_publishers()
        first = len(self.items)
        self._judge_stamps(progress, rejected)
        moving = rejected.get(Reason.MOVING, 0) + rejected.get(Reason.NO_ENCODER, 0)
        self._tell(
            "rest",
            not moving,
            f"{moving} of {total} exposures while the stage moved, or without samples around them",
            REMEDY[Reason.MOVING],
        )
        fault = self._explaining(rejected)
        ids_fit = self._judge_ids(rejected, fault)
        self._judge_loss(progress, rejected, total)
        # of few stops beside marks taken for others the offsets may show anything
        stops = (
            progress.check_done
            if 2 * progress.check_done > progress.check_expected
            else 0
        )
        follows, signs_told = self._judge_wiring(measurements, stops)
        if ids_fit and follows:
            self._judge_placing(measurements)
        if follows and ids_fit and progress.angular_done:
            self._judge_theta(measurements)
        self.items[first:] = grouped(
            self.items[first:],
            "ids" if fault else "signs" * signs_told,
            [item.name for item in self.items[:first] if not item.passed],
        )

    def _judge_stamps(
        self, progress: ViewProgress, rejected: Mapping[str, int]
    ) -> None:
        if self._n_early:
            self._tell(
                "commands",
                False,
                f"{self._n_early} detections between PLACE and MEASURE",
                "measure after MEASURE: until then the plate may still be moved",
            )
        ages = [age for _, age, _ in self._seen] or [0]
        age, earliest = (
            float(value) * S_PER_NS for value in (np.median(ages), min(ages))
        )
        outside = rejected.get(Reason.OUTSIDE_VIEWS, 0) + rejected.get(Reason.FUTURE, 0)
        stood_at_marks = progress.readings.used > (len(self._seen) - outside) / 2
        self._tell(
            "detection clock",
            not outside and age <= OLDEST_S and earliest >= -self._settings.clock_limit,
            f"stamps {age * MS_PER_S:.4g} ms old when they arrive, {outside} outside the view",
            "publish each detection as soon as it is found"
            if stood_at_marks
            else "stamp detections at the instant of exposure, by the clock of the joint states",
        )

    def _explaining(self, rejected: Mapping[str, int]) -> Fault | None:
        """Return the fault of the cell that explains the rejected detections, if any."""
        # offsets in any unit contradict each other less
        bad = sum(
            count
            for reason, count in rejected.items()
            if reason in REMEDY and reason != Reason.OUTLIER
        )
        recorded = Recorded(self._command, self._encoder, self._detections)
        return explaining(recorded, self._settings) if bad else None

    def _judge_ids(self, rejected: Mapping[str, int], fault: Fault | None) -> bool:
        """Tell, and return, whether detections are where their ids, or their marks, are."""
        named = sum(has_id for *_, has_id in self._seen)
        mistaken = {
            reason: rejected[reason] for reason in MISTAKEN if rejected.get(reason)
        }
        figure = f"{named} of {len(self._seen)} detections name their mark"
        figure += "" if named else ": marks are identified by their positions"
        figure += "".join(f", {count} {reason}" for reason, count in mistaken.items())
        remedy = "; ".join(REMEDY[reason] for reason in mistaken)
        if fault is not None:
            figure = f"{fault.what} ({figure})"
            remedy = fault.remedy
        fit = not mistaken and fault is None
        self._tell("ids", fit, figure, remedy)
        return fit

    def _judge_loss(
        self, progress: ViewProgress, rejected: Mapping[str, int], total: int
    ) -> None:
        not_mistaken = {
            reason: count
            for reason, count in rejected.items()
            if reason not in MISTAKEN
        }
        grid, angular = expected_marks(self.plate, self.view)
        twice = rejected.get(Reason.DUPLICATE) or self._come_twice()
        self._tell(
            "marks",
            progress.grid_done >= grid
            and progress.angular_done >= angular
            and not twice,
            f"{progress.grid_done} of {grid} marks and {progress.angular_done} of {angular} "
            f"lines {REPEATS} times; {progress.readings.used} of {total} detections used"
            + "".join(f", {count} {reason}" for reason, count in not_mistaken.items()),
            "publish each detection once, with the stamp of its exposure"
            if twice
            else "; ".join(
                REMEDY.get(Reason(reason), reason) for reason in not_mistaken
            )
            or "measure every mark `repeats` times; publish reliable, depth 1000",
        )
        self._tell(
            "check stops",
            progress.check_done >= progress.check_expected,
            f"{progress.check_done} of {progress.check_expected} marks from all four sides",
            REMEDY[Reason.OUTLIER]
            if rejected.get(Reason.OUTLIER)
            else "measure check_marks marks again at +x, -x, +y and -y, check_offset off each "
            "(docs/start/cell.md)",
        )

    def _come_twice(self) -> bool:
        """Whether most detections come again at once, under another stamp.

        A detector that rounds may give one offset at two exposures, whose stamps are apart.
        """
        marks = sorted(
            (
                seen
                for seen in self._detections
                if seen.kind == Kind.GRID and seen.has_id
            ),
            key=lambda seen: seen.stamp_ns,
        )
        of_pairs: dict[bool, list[int]] = {True: [], False: []}
        for seen, then in pairwise(marks):
            is_same = replace(then, stamp_ns=seen.stamp_ns) == seen
            of_pairs[is_same].append(then.stamp_ns - seen.stamp_ns)
        again_ns, between_ns = of_pairs[True], of_pairs[False]
        return bool(between_ns) and (
            3 * len(again_ns) > len(marks)
            and float(np.median(again_ns)) < AT_ONCE * float(np.median(between_ns))
        )

    def _turn_rad(self, view: ViewReadings) -> float:
        """Return the turn of the plate by its marks."""
        x, y = self.plate.places(view.m, view.n)
        x, y = (self.plate.grid_pitch_m * (row - row.mean()) for row in (x, y))
        return float((x * view.dy - y * view.dx).sum() / (x**2 + y**2).sum())

    def _judge_placing(self, measurements: Measurements) -> None:
        """Tell where the plate lies, and how far apart its marks, if that is not as commanded."""
        [view] = measurements.views
        shift_m = float(np.mean(view.dx)), float(np.mean(view.dy))
        turn_deg = degrees(self._turn_rad(view))
        limit_m = PLACED * self.plate.grid_pitch_m
        limit_deg = degrees(self._settings.max_rotation)
        if max(map(abs, shift_m)) > limit_m or abs(turn_deg) > limit_deg:
            x_mm, y_mm = (part * MM_PER_M for part in shift_m)
            self._tell(
                "placing",
                False,
                f"the plate lies ({x_mm:+.3g}, {y_mm:+.3g}) mm and {turn_deg:+.2g}° from where "
                "the view places it",
                f"place it within {limit_m * MM_PER_M:.3g} mm and {limit_deg:.2g}°, or set the "
                "zeros of the encoders",
            )
        x, y = (
            self.plate.grid_pitch_m * row for row in self.plate.places(view.m, view.n)
        )
        factors = 1 + np.polyfit(x, view.dx, 1)[0], 1 + np.polyfit(y, view.dy, 1)[0]
        if max(abs(factor - 1) for factor in factors) > SAME_SCALE:
            self._tell(
                "scale",
                False,
                f"x is indicated {factors[0]:.4g} times as far as the marks lie apart, y "
                f"{factors[1]:.4g} times",
                "correct the scale of the encoders, or grid_pitch of the plan",
            )

    def _judge_theta(self, measurements: Measurements) -> None:
        """Tell whether the lines show the turn of the plate that the marks show, or its opposite.

        If the rotary encoder has another zero they show neither: then its scatter among the repeats
        must show the sign.
        """
        [view] = measurements.views
        by_marks = self._turn_rad(view)
        by_lines = float(view.dtheta.mean()) if len(view.dtheta) else 0.0
        turned = abs(by_marks) > LEAST_TURN_RAD
        same, reversed_ = (
            turned and abs(by_lines - sign * by_marks) < CLEARLY * abs(by_marks)
            for sign in (1, -1)
        )
        in_degrees = turned and abs(by_lines - degrees(by_marks)) < CLEARLY * abs(
            degrees(by_marks)
        )
        scatters = (
            view.motion_theta is not None and view.motion_theta.products[1, 1] > 0
        )
        sign_is_shown = scatters and sign_of_lines_is_shown(measurements)
        figure = (
            f"turn of the plate by the marks {by_marks * MRAD_PER_RAD:+.3f} mrad, by the "
            f"lines {by_lines * MRAD_PER_RAD:+.3f} mrad"
        )
        if reversed_:
            figure += ": offset_theta has the other sign"
            remedy = "reverse the sign of offset_theta: line - axis of the stage, counter-clockwise"
        elif in_degrees:
            figure += ": offset_theta is in degrees"
            remedy = "publish offset_theta in rad"
        elif not turned:
            remedy = "turn the plate by 1 mrad and check again"
            figure += "" if sign_is_shown else ", too little to tell the sign"
        else:
            enough_rad = (abs(by_marks) + abs(by_lines)) / CLEARLY
            remedy = (
                "lay the plate straight, set theta to 0 where line 0 is read, turn the plate "
                "by 1 mrad and check again"
            )
            if enough_rad < self._settings.max_rotation / 2:
                remedy += f"; or turn it by {enough_rad * MRAD_PER_RAD:.2g} mrad"
            figure += (
                ""
                if same or sign_is_shown
                else ": offset_theta is the same for all lines"
                if self._all_lines_alike()
                else ": neither the same nor the opposite turn"
            )
        self._tell("theta", same or (sign_is_shown and not reversed_), figure, remedy)

    def _all_lines_alike(self) -> bool:
        """Whether all lines have one offset, which then is not measured."""
        return (
            len(
                {
                    seen.offset_theta
                    for seen in self._detections
                    if seen.kind == Kind.ANGULAR
                }
            )
            == 1
        )

    def _judge_wiring(
        self, measurements: Measurements, stops: int
    ) -> tuple[bool, bool]:
        """Tell whether the offsets follow the stage; the angle only with check stops.

        Returns
        -------
        follows, told : bool
            Whether they do, and whether they show how they do not.
        """
        [view] = measurements.views
        slopes = {
            "x": slope_of(view.motion, 0),
            "y": slope_of(view.motion, 1),
            # of noise alone it may be any
            "theta": slope_of(view.motion_theta, 0)
            if sign_of_lines_is_shown(measurements)
            else None,
        }
        known_slopes = {
            axis: slope for axis, slope in slopes.items() if slope is not None
        }
        fault = _fault_of_offsets(
            view.motion,
            known_slopes,
            [wiring_error(fault) for fault in wiring_faults(measurements)],
            has_stops=stops > 0,
        )
        follows = fault is None and {"x", "y"} <= known_slopes.keys()
        figure = ", ".join(
            f"{axis} {slope:+.3f}" for axis, slope in known_slopes.items()
        )
        self._tell(
            "signs",
            follows,
            fault.what
            if fault
            else f"offset against stage {figure or 'not known'} (-1 expected)",
            fault.remedy if fault else "let the stage stop off the marks: check stops",
        )
        return follows, fault is not None


def _fault_of_offsets(
    motion: RepeatMotion | None,
    slopes: Mapping[str, float],
    wrong: list[InputError],
    *,
    has_stops: bool,
) -> Fault | None:
    """Return how the offsets do not follow the stage, if that is shown.

    Parameters
    ----------
    motion : RepeatMotion, optional
        Of stage and offsets between the repeats of marks.
    slopes : mapping
        Axis -> response of its offset, where that is known.
    wrong : list of InputError
        Wrong signs and scales that are shown.
    has_stops : bool
        Whether marks were seen from all four sides.
    """
    response = _response(motion) if has_stops else None
    if response is not None:
        mirrored = bool(np.linalg.det(response) < 0)
        turned = _turned_deg(response @ np.diag([-1, 1]) if mirrored else response)
        if abs(turned) > TURNED_DEG and not (
            wrong and (mirrored or abs(turned) > 180 - TURNED_DEG)
        ):
            how = f"turned by {turned:+.1f}° against the stage"
            stated = (
                f"mirror: true, turn: {turned:.1f}"
                if mirrored
                else f"turn: {-turned:.1f}"
            )
            return Fault(
                f"the offsets are {'mirrored (x) and ' * mirrored}{how}",
                f"publish offsets along the stage's axes (mark_detector, if it states neither "
                f"turn nor mirror: {stated})",
            )
    if wrong:
        return Fault(
            "; ".join(error.what for error in wrong),
            "; ".join(error.remedy for error in wrong),
        )
    if not has_stops:
        return None
    if not {"x", "y"} <= slopes.keys():
        moved_um, seen_um = _spreads_um(motion)
        if not moved_um > 0:
            return None
        return Fault(
            "the offsets do not follow the stage: between the stops at a mark it moves by "
            f"{moved_um:.3g} µm rms, they by {seen_um:.3g} µm",
            "measure the offset anew in each image, and publish it in m: check the unit "
            "and pixel_size",
        )
    factor = max((abs(slopes[axis]) for axis in "xy"), key=lambda size: abs(size - 1))
    if abs(factor - 1) <= block_of_offsets().plausible:
        return None
    return Fault(
        f"the offsets are {factor:.3g} times as large as the motion of the stage",
        "divide pixel_size by this factor, or find it with selfcal camera init: no "
        "map would be qualified",
    )


def _spreads_um(motion: RepeatMotion | None) -> tuple[float, float]:
    """Return the rms spread of position and of offset among repeats, um; 0 without repeats."""
    if motion is None or motion.dof <= 0:
        return 0.0, 0.0
    n = len(motion.products) // 2
    squares = np.diag(motion.products).reshape(2, n).sum(axis=1)
    position, offset = np.sqrt(squares / motion.dof) * UM_PER_M
    return float(position), float(offset)


def _response(motion: RepeatMotion | None) -> np.ndarray | None:
    """Return the response D of offsets to the stage, (2, 2): an offset is minus D times its motion.

    None if they do not follow it.
    """
    if motion is None or len(motion.products) != 4:
        return None
    place, cross, offset = (
        motion.products[block]
        for block in (
            (slice(2), slice(2)),
            (slice(2, 4), slice(2)),
            (slice(2, 4), slice(2, 4)),
        )
    )
    if not np.linalg.det(place) > 0:
        return None
    response = -cross @ np.linalg.inv(place)
    explained = np.trace(response @ place @ response.T)
    return None if explained < FOLLOWS * np.trace(offset) else response


def _turned_deg(response: np.ndarray) -> float:
    """Return the turn that a response has, counter-clockwise, degrees."""
    return float(
        np.degrees(
            np.arctan2(response[1, 0] - response[0, 1], response[0, 0] + response[1, 1])
        )
    )
