# SPDX-License-Identifier: Apache-2.0
"""The visits of a view: move, verify rest, expose, tell the position before and after.

One logic for all machines, with and without ROS. It yields the messages of a cell; whatever is not
as commanded stops the machine and raises `MachineError`.
"""

import math
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from selfcal_ros.bagio.messages import from_model
from selfcal_ros.collection.inputs import Command, Detection, EncoderSample, Kind
from selfcal_ros.errors import NoDataError, first_line
from selfcal_ros.machine.calling import called
from selfcal_ros.machine.cell import FIRST_TURN_RAD, Cell
from selfcal_ros.machine.clock import Clock
from selfcal_ros.machine.duty import Again
from selfcal_ros.machine.interface import Image, Machine, MachineError, Offset
from selfcal_ros.machine.seeing import Eye, stamp_of
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.readings import Sense
from selfcal_ros.model.view import View
from selfcal_ros.model.visit_order import line_targets, stage_targets, visit_sequence
from selfcal_ros.portable import Overdue, interrupted_after
from selfcal_ros.topics import IMAGE_TOPICS
from selfcal_ros.units import NS_PER_S, UM_PER_M

Position = dict[str, float]
"""Axis -> position in the stage frame, m or rad."""
TRACK_NS = 40_000_000
"""Largest time between two positions that are told, below the collector's largest gap."""
COARSE_NS = 20_000_000
"""Largest step of a coarse clock, which shows the same time twice."""
TINY = 1e-15
"""Least tolerance, m or rad: one of 0 is allowed."""
TRIES = 3
"""Exposures that are tried at a stop whose position changes meanwhile."""
ANSWER_S = 60.0
"""Longest wait for an answer of the machine, beside `settle: patience`: for its slowest move."""
STOPS, STOP_AGAIN_S = 3, 0.1
"""A move that was being prepared when the machine was stopped begins after that: it is stopped
again while it lasts, so many times."""
EMPTY_STOPS = 5
"""Stops one after another at which nothing is seen, after which a view is given up."""
FOLLOWS = 0.25
"""Largest deviation, over the step, of a position or a mark from the step of the stage."""
UNITS = {
    1e3: "mm for m",
    1e6: "µm for m",
    1e-3: "m for mm",
    1e-6: "m for µm",
    25.4: "inches",
    1 / 25.4: "inches",
    1 / 0.0254: "inches for m",
}
"""Factor of a position that is given in another unit -> the units."""
ANGLE_UNITS = {
    math.degrees(1.0): "degrees for rad",
    math.radians(1.0): "rad for degrees",
    1e3: "mrad for rad",
}
"""The same for theta."""


@dataclass(frozen=True, eq=False)
class Photo:
    """An image in which somebody else finds the marks: grey values (h, w), middle of exposure."""

    stamp_ns: int
    pixels: np.ndarray


Event = EncoderSample | Detection | Photo
"""What a visit tells."""


@dataclass(frozen=True)
class Stop:
    """A position of the stage, and what is looked for there.

    Attributes
    ----------
    target : dict
        Position in the stage frame.
    kind : Kind
        A mark, or a line.
    exposures : int
        Exposures at this stop.
    """

    target: Position
    kind: Kind
    exposures: int = 1


def stops(
    artifact: Artifact,
    view: View,
    sense: Sense,
    *,
    again: Again | None = None,
    consecutive: bool = False,
    rng: np.random.Generator | None = None,
) -> list[Stop]:
    """Return the stops of a view in their order, marks first.

    Parameters
    ----------
    artifact, view
        The plate, and the view with its order, repeats and check stops.
    sense : Sense
        What moves.
    again : Again, optional
        Only what is missing, once each; None = all.
    consecutive : bool
        All repeats of a mark or line one after another.
    rng : numpy.random.Generator, optional
        Needed by the order ``random``.
    """
    if again is not None:
        view = replace(view, repeats=1, visit_order="")
        if not again.checks:
            view = replace(view, check_marks=0, check_offset_m=0.0)
    visits = visit_sequence(artifact, view, consecutive=consecutive, rng=rng)
    targets_m = stage_targets(artifact, view, visits, sense) + visits.aside_m
    aside = visits.aside_m.any(axis=0)
    stops_in_order = []
    for number, (m, n) in enumerate(
        zip(visits.m.tolist(), visits.n.tolist(), strict=True)
    ):
        if again is None or aside[number] or (m, n) in again.marks:
            x, y = targets_m[:, number].tolist()
            stops_in_order.append(
                Stop({"x": x, "y": y}, Kind.GRID, int(visits.count[number]))
            )
    if view.angular:
        lines, theta = line_targets(artifact, view, sense, consecutive=consecutive)
        for k, angle in zip(lines.tolist(), theta.tolist(), strict=True):
            if again is None or k in again.lines:
                stops_in_order.append(Stop({"theta": angle}, Kind.ANGULAR))
    return stops_in_order


@dataclass
class Visitor:
    """Drives a machine through views.

    Parameters
    ----------
    machine, cell
        The machine, and what CELL.yaml states of it.
    clock : Clock
        Stamps and waits.
    seed : int
        For the order ``random``.
    step_ns : int
        Largest time between two positions that are told, on the line between two readings; rest
        is two readings that agree after half of it.
    of_a_move : int
        Least number of positions told on the line of a move, so that the direction of a fast one
        is known.
    consecutive : bool
        All repeats of a mark or line one after another.
    detects : bool
        Whether marks are found in images; if not, the images are told.
    """

    machine: Machine
    cell: Cell
    clock: Clock = field(default_factory=Clock)
    seed: int = 0
    step_ns: int = TRACK_NS
    of_a_move: int = 4
    consecutive: bool = False
    detects: bool = True

    def __post_init__(self) -> None:
        """Begin without a position."""
        self.axes = tuple(self.machine.axes)
        self.eye = Eye(self.cell.detector, str(self.cell.path))
        self._rng = np.random.default_rng(self.seed)
        self._last: EncoderSample | None = None  # where it was left at rest
        self._untold: list[EncoderSample] = []  # of moves
        self._has_moved = False
        self._told_ns = 0  # newest stamp of a position
        # what the machine has to answer, and since when
        self._asked: tuple[str, int] | None = None
        self.stopped = False

    def stop(self) -> None:
        """Stop the machine, and whatever is being visited; may be called from another thread."""
        self.stopped = True
        for _ in range(STOPS):
            called("machine.stop", self.machine.stop)
            self.clock.sleep(STOP_AGAIN_S)
            asked = self._asked
            if asked is None or asked[0] != "machine.move_to":
                return

    def _ask(self, name: str, *values: Any) -> Any:
        """Call a method of the machine; its errors, and no answer, become MachineError.

        One after another: `stop` alone comes from other threads, and is not asked for here.
        """
        where = f"machine.{name}"
        self._asked = (where, self.clock.now_ns())
        try:
            with interrupted_after(self._longest_s):
                return called(where, getattr(self.machine, name), *values)
        except Overdue as error:
            raise self._silent(where) from error
        finally:
            self._asked = None

    @property
    def _longest_s(self) -> float:
        return ANSWER_S + self.cell.settle.patience

    def _silent(self, where: str) -> MachineError:
        return MachineError(
            f"it has not answered for {self._longest_s:g} s",
            where,
            "check cables, power and the driver; for longer moves raise settle: patience",
        )

    @property
    def silence(self) -> MachineError | None:
        """What has not been answered for too long; only in the main thread is it given up."""
        pending = self._asked
        if (
            pending is None
            or (self.clock.now_ns() - pending[1]) / NS_PER_S <= self._longest_s
        ):
            return None
        return self._silent(pending[0])

    @contextmanager
    def stopping(self) -> Iterator[None]:
        """Stop the machine if anything is raised; say so if it cannot be stopped."""
        try:
            yield
        except BaseException as error:
            self._has_moved = False  # the next move is a small one again
            try:
                with interrupted_after(ANSWER_S):
                    self.machine.stop()
            except (Exception, Overdue) as failed:
                raise MachineError(
                    f"{str(error) or 'interrupted'}; and it cannot be stopped "
                    f"({first_line(failed)})",
                    "machine.stop",
                    "use the emergency stop",
                ) from error
            raise

    def show(self, kind: Kind = Kind.GRID) -> Image | list[Offset]:
        """Return what the machine sees now; lines are seen by its own sensor, if it has a camera.

        Raises
        ------
        MachineError
            If it shows neither an image nor offsets, or no image after others.
        """
        image = self._ask("image") if kind == Kind.GRID else None
        if isinstance(image, Image):
            return image
        if image is not None:
            raise MachineError(
                f"it returns {type(image).__name__}",
                "machine.image",
                "return Image(pixels), or None without a camera",
            )
        if kind == Kind.GRID and self.eye.newest is not None:
            raise MachineError(
                "it returns no image any more",
                "machine.image",
                "check the camera and its cable",
            )
        offsets = self._ask("offsets")
        if not isinstance(offsets, list) or not all(
            isinstance(offset, Offset) for offset in offsets
        ):
            raise MachineError(
                f"it returns {offsets!r:.50}",
                "machine.offsets",
                "return a list of Offset, empty if nothing is seen",
            )
        return offsets

    def approach(self, artifact: Artifact, view: View) -> None:
        """Go to the first stop of a view, and check there that position and marks follow.

        The first move of all is a small one, from where the stage stands.

        Raises
        ------
        MachineError
            If anything is not as commanded.
        """
        self.eye.require(artifact)
        route = stops(artifact, view, self.cell.sense)
        self.require(route)
        self._last, self._untold = None, []  # a person may have moved it by hand
        if not self._has_moved:
            self.first_move(marks=False, turns=view.angular)
            self._has_moved = True
        if view.grid:
            self.go(route[0].target)
            self.first_move(marks=True)

    def view(
        self, artifact: Artifact, view: View, again: Again | None = None
    ) -> Iterator[Event]:
        """Visit a view and yield positions, and detections or images, in the order of their stamps.

        Raises
        ------
        MachineError
            If anything is not as commanded.
        NoDataError
            If nothing is seen at several stops one after another.
        """
        route = stops(
            artifact,
            view,
            self.cell.sense,
            again=again,
            consecutive=self.consecutive,
            rng=self._rng,
        )
        self.require(route)
        empty = 0
        for number, stop in enumerate(route):
            for _ in range(stop.exposures):
                n_detected = 0
                for event in self._visit(stop, only_nearest=view.image is None):
                    n_detected += not isinstance(event, EncoderSample)
                    yield event
                empty = 0 if n_detected else empty + 1
            if again is None and empty >= min(EMPTY_STOPS, len(route)):
                raise self._sees_nothing(view, empty, at_first=empty > number)

    def _sees_nothing(self, view: View, empty: int, *, at_first: bool) -> NoDataError:
        first_or_last = "first" if at_first else "last"
        remedy = (
            "place the plate as the view says, check focus, light, and mark_size and "
            "pixel_size in CELL.yaml"
            if at_first
            else "check light, focus, the camera, and whether the plate is dirty there"
        )
        if self.cell.detector and self.eye.newest is None:
            remedy = (
                "the machine returns no images: check the camera, or take detector out "
                "of CELL.yaml"
            )
        return NoDataError(
            f"view '{view.name}'",
            f"nothing is seen at the {first_or_last} {empty} stops{self.eye.why}",
            remedy,
        )

    def require(self, route: Iterable[Stop]) -> None:
        """Refuse a route that leaves the limits or needs an axis that the machine lacks."""
        for stop in route:
            for axis, value in stop.target.items():
                if axis not in self.axes:
                    raise MachineError(
                        f"the view moves {axis}, the machine has {' and '.join(self.axes)}",
                        str(self.cell.path),
                        "set angular: false in the plan",
                    )
                self.cell.require_limits(
                    axis, self.cell.to_machine(axis, value), "a stop"
                )

    def sample(self) -> EncoderSample:
        """Return the position now, in the stage frame.

        Raises
        ------
        MachineError
            If it is not a position.
        """
        before = self.clock.now_ns()
        indicated = self._ask("position")
        stamp = (before + self.clock.now_ns()) // 2
        if stamp <= self._told_ns < stamp + COARSE_NS:  # else it was set back
            stamp = self._told_ns + 1
        try:
            values = tuple(map(float, indicated))
        except (TypeError, ValueError):
            values = ()
        if len(values) != len(self.axes) or not all(map(math.isfinite, values)):
            raise MachineError(
                f"its position is {indicated!r:.100}",
                "machine.position",
                f"return {', '.join(self.axes)} in m and rad",
            )
        self._told_ns = stamp
        return EncoderSample(
            stamp,
            self.axes,
            tuple(
                self.cell.to_stage(axis, value)
                for axis, value in zip(self.axes, values, strict=True)
            ),
        )

    def go(self, target: Position) -> EncoderSample:
        """Move to a position in the stage frame, verify arrival and rest; return the position.

        Axes that `target` does not name stay.

        Raises
        ------
        MachineError
            If the target is beyond the limits, the position does not follow or does not rest.
        """
        last = self._last
        departure = self._where_it_was_left()
        start = departure.by_joint
        for axis, value in start.items():
            self.cell.require_near(axis, self.cell.to_machine(axis, value))
        if "theta" in self.axes and "theta" in target:
            turns = round((target["theta"] - start["theta"]) / math.tau)
            target = target | {
                "theta": self._within_limits(target["theta"] + turns * math.tau)
            }
        goal = start | target
        for axis in target:
            self.cell.require_limits(
                axis,
                self.cell.to_machine(axis, goal[axis]),
                "the end of a move",
                start=self.cell.to_machine(axis, start[axis]),
            )
        if self.stopped:
            raise MachineError("stopped", "a move")
        self._ask(
            "move_to",
            tuple(self.cell.to_machine(axis, goal[axis]) for axis in self.axes),
        )
        if self.cell.settle.time:
            self.clock.sleep(self.cell.settle.time)
        arrival = self._rest(start, goal, target)
        if last is None or departure.stamp_ns - last.stamp_ns > self.step_ns:
            # what was read at rest meanwhile may have been told
            self._untold.append(departure)
        self._untold += self._track(departure, arrival, least=self.of_a_move)
        return arrival

    def _where_it_was_left(self) -> EncoderSample:
        """Return where the stage rests; raise if it is not where it was left."""
        now = self.sample()
        if self._last is not None:
            self._check_left_alone(_difference(self._last, now))
        return now

    def _check_left_alone(self, motion: Position) -> None:
        """Raise if the position at rest has changed by more than the tolerance of arrival."""
        axis = self._farthest(motion, "arrival")
        if abs(motion[axis]) > self.cell.settle.of(axis, "arrival"):
            raise MachineError(
                f"{axis} has changed by {_length_text(axis, motion[axis])} at rest, "
                "without a command",
                "machine.position",
                "see whether it was moved by hand, was reset, or has lost its zero; home it",
            )

    def _rests(self, motion: Position) -> bool:
        """Return whether two readings agree."""
        return all(
            abs(motion[axis]) <= self.cell.settle.of(axis, "within")
            for axis in self.axes
        )

    def _farthest(self, away: Position, tolerance: str) -> str:
        """Return the axis that is farthest off, in units of its own tolerance."""
        return max(
            away,
            key=lambda axis: (
                abs(away[axis]) / max(self.cell.settle.of(axis, tolerance), TINY)
            ),
        )

    def _within_limits(self, theta: float) -> float:
        """Return an angle or the same some turns off, within the limits if one is."""
        low, high = self.cell.limits.get("theta", (-math.inf, math.inf))
        angle = self.cell.to_machine("theta", theta)
        turns = (
            math.ceil((low - angle) / math.tau)
            if angle < low
            else (math.floor((high - angle) / math.tau) if angle > high else 0)
        )
        return theta + turns * math.tau

    def _rest(
        self, start: Position, goal: Position, commanded: Position
    ) -> EncoderSample:
        """Wait until two successive readings agree with each other and with the target."""
        settle = self.cell.settle
        deadline_ns = self.clock.now_ns() + round(settle.patience * NS_PER_S)
        before = self.sample()
        while True:
            self.clock.sleep(self.step_ns / 2 / NS_PER_S)
            now = self.sample()
            motion = _difference(before, now)
            away = {axis: value - goal[axis] for axis, value in now.by_joint.items()}
            self._check_limits(start, goal, now)
            rests = self._rests(motion)
            arrived = all(
                abs(away[axis]) <= settle.of(axis, "arrival") for axis in commanded
            )
            if rests and arrived:
                self._last = now
                return now
            if self.stopped:
                raise MachineError("stopped", "a move")
            if now.stamp_ns > deadline_ns:
                raise (
                    self._not_at_rest(before, now)
                    if not rests
                    else self._astray(
                        start,
                        goal,
                        {
                            axis: away[axis]
                            for axis in self.axes
                            if axis in commanded or axis != "theta"
                        },
                        f"after {settle.patience:g} s",
                    )
                )
            before = now

    def _check_limits(
        self, start: Position, goal: Position, now: EncoderSample
    ) -> None:
        """Raise if an axis leaves its limits, beyond where it was and where it is to go."""
        for axis, value in now.by_joint.items():
            low, high = self.cell.limits.get(axis, (-math.inf, math.inf))
            indicated, *ends = (
                self.cell.to_machine(axis, place)
                for place in (value, start[axis], goal[axis])
            )
            near = self.cell.settle.of(axis, "arrival")
            if not min(low, *ends) - near <= indicated <= max(high, *ends) + near:
                raise self._astray(
                    start, goal, {axis: value - goal[axis]}, "beyond its limits"
                )

    def _not_at_rest(self, before: EncoderSample, now: EncoderSample) -> MachineError:
        self._check_axes(before, now)
        motion = _difference(before, now)
        axis = self._farthest(motion, "within")
        return MachineError(
            f"{axis} does not come to rest in {self.cell.settle.patience:g} s: two readings differ "
            f"by {_length_text(axis, motion[axis])}",
            "machine",
            "tune the axis, or raise settle: within or patience in CELL.yaml",
        )

    def _check_axes(self, before: EncoderSample, now: EncoderSample) -> None:
        """Raise if two readings at rest differ by an exchange of x and y."""
        exchanged = replace(now, positions=(*now.positions[1::-1], *now.positions[2:]))
        if self._rests(_difference(before, exchanged)):
            raise MachineError(
                "the readings of x and y change places: it answers for the other axis",
                "machine.position",
                "wait for each answer before the next question; drop what is left of old answers",
            )

    def _astray(
        self, start: Position, goal: Position, away: Position, when: str
    ) -> MachineError:
        moving = {
            axis: value
            for axis, value in away.items()
            if goal[axis] != start[axis]
            and (abs(value) > self.cell.settle.of(axis, "arrival"))
        }
        axis = self._farthest(moving or away, "arrival")
        cross_axis = {"x": "y", "y": "x"}.get(axis, "")
        indicated = goal[axis] + away[axis]
        step = goal[axis] - start[axis]
        reason = (
            _reason(axis, step, indicated - start[axis], away.get(cross_axis, 0.0))
            if (abs(step) > self.cell.settle.of(axis, "within"))
            else ""
        )
        return MachineError(
            f"{axis} was sent to {goal[axis]:.6g} and indicates {indicated:.6g} {when}, "
            f"{_length_text(axis, away[axis])} away"
            f"{reason and ': '}{reason}",
            "machine",
            "check drives, limit switches and the unit of the positions, or raise settle: arrival",
        )

    def expose(
        self, kind: Kind = Kind.GRID
    ) -> tuple[EncoderSample, list[Detection | Photo], EncoderSample]:
        """Expose at rest: the positions before and after, and what is seen: all, or an image.

        Raises
        ------
        MachineError
            If the stage moves meanwhile, or the image cannot be used.
        """
        for _ in range(TRIES):
            before = self._last or self.sample()
            if self.clock.now_ns() - before.stamp_ns > self.step_ns:
                before = self.sample()
            began = self.clock.now_ns()
            image_or_offsets = self.show(kind)
            ended = self.clock.now_ns()
            after = self.sample()
            motion = _difference(before, after)
            self._last = after
            if self._rests(motion):
                detections = self._detections(
                    image_or_offsets, (began + ended) // 2, before.positions
                )
                self._check_stamps(detections, before, after)
                return before, detections, after
            self._check_axes(before, after)
            self._check_left_alone(motion)
        axis = self._farthest(motion, "within")
        raise MachineError(
            f"{axis} moved by {_length_text(axis, motion[axis])} during {TRIES} exposures",
            "machine",
            "wait longer: settle: time in CELL.yaml",
        )

    def _detections(
        self,
        image_or_offsets: Image | list[Offset],
        stamp_ns: int,
        position: tuple[float, ...],
    ) -> list[Detection | Photo]:
        if isinstance(image_or_offsets, Image) and not self.detects:
            return [
                Photo(
                    stamp_of(image_or_offsets, stamp_ns),
                    np.asarray(image_or_offsets.pixels),
                )
            ]
        return [*self.eye.detections(image_or_offsets, stamp_ns, position)]

    def _check_stamps(
        self,
        detections: list[Detection | Photo],
        before: EncoderSample,
        after: EncoderSample,
    ) -> None:
        for item in detections:
            if not before.stamp_ns <= item.stamp_ns <= after.stamp_ns:
                late_s = (item.stamp_ns - after.stamp_ns) / NS_PER_S
                raise MachineError(
                    f"the stamp of an exposure is {late_s:+.3g} s from the reading "
                    "of the position after it",
                    "machine",
                    "stamp by this computer's clock, or give no stamp",
                )

    def _visit(self, stop: Stop, *, only_nearest: bool) -> Iterator[Event]:
        at = self.go(stop.target)
        untold = self._untold
        self._untold = []
        yield from untold
        before, detections, after = self.expose(stop.kind)
        detections = [
            item
            for item in detections
            if isinstance(item, Photo) or item.kind == stop.kind
        ]
        if only_nearest and stop.kind == Kind.GRID:
            detections = sorted(detections, key=_from_axis)[:1]
        yield from self._track(at, before)
        events = [*self._track(before, after), *detections]
        yield from sorted(events, key=lambda event: event.stamp_ns)

    def _track(
        self, before: EncoderSample, after: EncoderSample, *, least: int = 0
    ) -> Iterator[EncoderSample]:
        """Yield the second of two positions, and before it others on the line between them.

        The encoder of a machine that is asked for its position has no gap, and the direction of
        its last motion is known.
        """
        length_ns = after.stamp_ns - before.stamp_ns
        count = min(max((length_ns - 1) // self.step_ns, least), length_ns - 1)
        for number in range(1, count + 1):
            fraction = number / (count + 1)
            stamp = before.stamp_ns + round(fraction * length_ns)
            yield EncoderSample(
                stamp,
                after.names,
                tuple(
                    early + fraction * (late - early)
                    for early, late in zip(
                        before.positions, after.positions, strict=True
                    )
                ),
            )
        if before.stamp_ns < after.stamp_ns:
            yield after

    def first_move(
        self, *, marks: bool, turns: bool = False, step_m: float = 0.0
    ) -> None:
        """Make a small move along each axis and back; check that position and marks follow.

        From beyond the limits it is a move towards them, and not back.

        Parameters
        ----------
        marks : bool
            Whether a mark is in sight whose offset has to follow.
        turns : bool
            Whether the rotary axis is moved as well.
        step_m : float
            Length of the move, m; 0 = `Cell.first_step_m`.

        Raises
        ------
        MachineError
            If they do not, with the likely reason.
        """
        step = step_m or self.cell.first_step_m
        start = self.sample()
        self._last = start
        home = start.by_joint
        for axis in ("x", "y", "theta") if turns else ("x", "y"):
            low, high = self.cell.limits[axis]
            length = FIRST_TURN_RAD if axis == "theta" else step
            at_home = self.cell.to_machine(axis, home[axis])
            inward = length if at_home < (low + high) / 2 else -length
            sees = marks and axis != "theta"
            marks_before = self.marks() if sees else []
            arrival = self.go({axis: home[axis] + inward})
            if sees:
                step_done = arrival.by_joint[axis] - home[axis]
                self._check_marks(
                    axis, step_done, marks_before, self.marks(), self.marks()
                )
            if low <= at_home <= high:
                self.go({axis: home[axis]})

    def marks(self) -> list[Detection]:
        """Expose at rest; return the marks that are seen; raises like `expose`."""
        return [
            item
            for item in self.expose()[1]
            if isinstance(item, Detection) and item.kind == Kind.GRID
        ]

    def _check_marks(
        self,
        axis: str,
        step: float,
        first: list[Detection],
        second: list[Detection],
        third: list[Detection],
    ) -> None:
        """Raise if the marks did not follow a step of the stage along an axis, m."""
        if not (first and second and third):
            return
        sign = 1 if self.cell.sense is Sense.PLATE_MOVES else -1
        expected = sign * step
        changes = [_change(first, later, axis, expected) for later in (second, third)]
        (along, across), (along_again, _) = changes
        follows = math.hypot(along - expected, across) <= FOLLOWS * abs(step)
        if follows:
            return
        if abs(along) <= FOLLOWS * abs(step) and abs(
            along_again - expected
        ) <= FOLLOWS * abs(step):
            reason = "the image is late by one frame"
            remedy = "let the camera expose when it is asked (software trigger), or drop a frame"
        elif abs(along) <= FOLLOWS * abs(step) and abs(across) <= FOLLOWS * abs(step):
            reason = "the marks stand still"
            remedy = "check that the camera returns new images, and that the stage really moves"
        else:
            cross_axis = "y" if axis == "x" else "x"
            reason = _reason(axis, expected, along, across) or (
                f"the marks moved by {_length_text(axis, along)} along {axis} and "
                f"{_length_text(cross_axis, across)} along {cross_axis}"
            )
            remedy = "correct pixel_size, turn, mirror and sense in CELL.yaml: `selfcal cell try`"
        raise MachineError(
            f"the stage moved by {_length_text(axis, step)} along {axis}: {reason}",
            "first move",
            remedy,
        )


def _reason(axis: str, step: float, along: float, across: float) -> str:
    """Return why a motion along and across an axis is not the step that was made, "" if unknown."""
    near = FOLLOWS * abs(step)
    if not step or abs(along - step) <= near:
        return ""
    if abs(along) <= near and abs(across) <= near:
        return (
            "nothing moved: its position is frozen, its drive is off, or it stands at a limit "
            "switch"
        )
    if abs(along + step) <= near and abs(across) <= near:
        return f"the opposite direction: {axis} is reversed"
    if abs(along) <= near and abs(abs(across) - abs(step)) <= near:
        return f"{'y' if axis == 'x' else 'x'} moved instead: the axes are exchanged"
    ratio = along / step
    for factor, units in (ANGLE_UNITS if axis == "theta" else UNITS).items():
        if abs(ratio / factor - 1) <= FOLLOWS:
            return f"{ratio:.2g} times as far: is it {units}?"
    return f"{ratio:.3g} times as far" if abs(across) <= near else ""


def _change(
    first: list[Detection], later: list[Detection], axis: str, expected: float
) -> tuple[float, float]:
    """Return the motion of the mark nearest to the middle along and across an axis, m.

    Of several marks in an image, it went to the one nearest to where it is expected, or stayed.
    """
    mark = min(first, key=lambda item: math.hypot(item.offset_x, item.offset_y))
    from_x, from_y = mark.offset_x, mark.offset_y
    to_x, to_y = (
        (from_x + expected, from_y) if axis == "x" else (from_x, from_y + expected)
    )
    nearest = min(
        later, key=lambda item: math.hypot(item.offset_x - to_x, item.offset_y - to_y)
    )
    x, y = nearest.offset_x - from_x, nearest.offset_y - from_y
    return (x, y) if axis == "x" else (y, x)


def _length_text(axis: str, value: float) -> str:
    return f"{value:.3g} rad" if axis == "theta" else f"{value * UM_PER_M:.4g} µm"


def _difference(before: EncoderSample, after: EncoderSample) -> Position:
    return {
        axis: late - early
        for axis, early, late in zip(
            before.names, before.positions, after.positions, strict=True
        )
    }


def _from_axis(item: Detection | Photo) -> float:
    return 0.0 if isinstance(item, Photo) else math.hypot(item.offset_x, item.offset_y)


def message_of(
    event: Command | Event, frame_id: str = "stage"
) -> tuple[str, from_model.Fields]:
    """Return topic and fields of a message of a cell."""
    if isinstance(event, Photo):
        encoding = f"mono{8 * event.pixels.itemsize}"
        return IMAGE_TOPICS["raw"], from_model.image(
            event.pixels, encoding, event.stamp_ns, "camera"
        )
    return from_model.event_fields(event, frame_id)
