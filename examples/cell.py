#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""A complete machine cell for selfcal_ros in one file: replace `Machine` by your own drivers.

The node tells where the encoders say the stage is, carries out view commands, and tells where its
microscope saw each mark. It imports nothing of selfcal_ros but the messages. Run it with

    .venv/bin/python examples/cell.py            # or: python3 examples/cell.py with ROS 2 sourced
"""

import math
import random
from collections.abc import Iterator

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from selfcal_msgs.msg import MarkDetection, ViewCommand, ViewStatus
from sensor_msgs.msg import JointState

Position = tuple[float, float, float]
"""Indicated x, y (m) and theta (rad) in the stage frame."""


class Machine:
    """What you replace: a stage with wrong encoders, a plate with wrong marks, a microscope."""

    def __init__(self, seed: int = 1) -> None:
        self._random = random.Random(seed)
        self.position: Position = (0.0, 0.0, 0.0)
        self._plate: dict = {}
        self._laid = (0.0, 0.0, 0.0)

    def move_to(self, position: Position) -> None:
        """Go to a commanded position and come to rest."""
        self.position = position

    def lay_plate(self) -> None:
        """Lay the plate down anew: half a millirad and 20 um beside where it should be."""
        self._laid = tuple(self._random.gauss(0, s) for s in (5e-4, 2e-5, 2e-5))

    def error(self, x: float, y: float) -> tuple[float, float]:
        """Return what the encoders say too much at (x, y), m: what the calibration shall find."""
        return (3e-7 * math.sin(120 * x) * math.cos(80 * y), 2e-7 * math.cos(90 * x + 60 * y))

    def angle_error(self, theta: float) -> float:
        """Return what the rotary encoder says too much, rad."""
        return 2e-5 * math.sin(theta)

    def see_mark(self, m: int, n: int, view: ViewCommand) -> tuple[float, float]:
        """Return mark centre less optical axis, stage axes, m: what the image processing gives."""
        ax, ay = self._plate.setdefault((m, n), (self._random.gauss(0, 3e-7),
                                                 self._random.gauss(0, 3e-7)))
        phi, tx, ty = self._laid
        turn = view.rotation + phi
        x, y = mark_place(m, n, view)
        x, y = x + ax, y + ay
        mark_x = math.cos(turn) * x - math.sin(turn) * y + view.translation_x + tx
        mark_y = math.sin(turn) * x + math.cos(turn) * y + view.translation_y + ty
        gx, gy = self.error(*self.position[:2])
        return (mark_x - (self.position[0] - gx) + self._random.gauss(0, 5e-9),
                mark_y - (self.position[1] - gy) + self._random.gauss(0, 5e-9))

    def see_line(self, k: int, view: ViewCommand) -> float:
        """Return line direction less optical axis, rad, counter-clockwise."""
        a = self._plate.setdefault(k, self._random.gauss(0, 2e-5))
        line = 2 * math.pi * k / view.angular_count + a + view.rotation + self._laid[0]
        offset = line - (self.position[2] - self.angle_error(self.position[2]))
        return math.remainder(offset, 2 * math.pi) + self._random.gauss(0, 1e-7)


def mark_place(m: int, n: int, view: ViewCommand) -> tuple[float, float]:
    """Return where a mark lies on the plate, m: the rows lie evenly about its centre."""
    nx, ny = view.grid_size, view.grid_size_y or view.grid_size  # 0: the plate is square
    return (m + 0.5 * (nx % 2 == 0)) * view.grid_pitch, (n + 0.5 * (ny % 2 == 0)) * view.grid_pitch


def grid_sites(view: ViewCommand) -> Iterator[tuple[int, int, Position]]:
    """Yield the marks (m, n) of a view with the stage position at which each is seen.

    Mark (m, n) lies where the turn and the translation of the plate bring it. A view includes the
    marks in the field, which is as large as the plate (one that is shifted by one pitch has a row
    less), or as the map where the command gives its nodes.
    """
    nx, ny = view.grid_size, view.grid_size_y or view.grid_size
    reach_x, reach_y = ((rows - 1) / 2 * view.grid_pitch for rows in (nx, ny))
    if view.map_grid_size:
        reach_x = (view.map_grid_size - 1) / 2 * view.map_grid_pitch
        reach_y = ((view.map_grid_size_y or view.map_grid_size) - 1) / 2 * view.map_grid_pitch
    rounding = 1e-9 * view.grid_pitch
    cosine, sine = math.cos(view.rotation), math.sin(view.rotation)
    for m in range(-(nx // 2), nx - nx // 2):
        for n in range(-(ny // 2), ny - ny // 2):
            u, v = mark_place(m, n, view)
            x = cosine * u - sine * v + view.translation_x
            y = sine * u + cosine * v + view.translation_y
            if abs(x) <= reach_x + rounding and abs(y) <= reach_y + rounding:
                yield m, n, (x, y, 0.0)


REVISIT_TICKS = 500
"""Ticks until the status is that of all marks of a pass: a second."""


class Cell(Node):
    """Encoders, microscope and the hand that lays the plate, as a ROS node."""

    def __init__(self, machine: Machine | None = None, **kwargs: object) -> None:
        super().__init__("cell", **kwargs)
        self.machine = machine or Machine()
        self._encoder = self.create_publisher(JointState, "stage/joint_states", QoSProfile(
            depth=1000, reliability=ReliabilityPolicy.RELIABLE))
        self._marks = self.create_publisher(MarkDetection, "stage/mark_detections", QoSProfile(
            depth=1000, reliability=ReliabilityPolicy.RELIABLE))
        # The sequencer latches its newest command alone: a cell that starts late carries it out.
        # Of a depth of 1 a MEASURE that follows its PLACE at once would overtake it.
        self.create_subscription(ViewCommand, "selfcal/view_command", self._on_command, QoSProfile(
            depth=10, reliability=ReliabilityPolicy.RELIABLE,
            durability=DurabilityPolicy.TRANSIENT_LOCAL))
        self.create_subscription(ViewStatus, "selfcal/view_status", self._on_status, QoSProfile(
            depth=10, reliability=ReliabilityPolicy.RELIABLE))
        self._status: ViewStatus | None = None
        self._work: Iterator[None] = iter(())
        self._acted: set[tuple[int, int]] = set()  # stamps of commands
        self.create_timer(0.002, self._tick)

    def _on_command(self, view: ViewCommand) -> None:
        stamp = (view.header.stamp.sec, view.header.stamp.nanosec)
        if stamp in self._acted:
            return  # a sequencer that was restarted latches its last command anew
        self._acted.add(stamp)
        self._work = iter(())  # whatever was measured is given up
        if view.phase == ViewCommand.PLACE:
            self.machine.lay_plate()  # then confirm_view is called, here by auto_confirm
        elif view.phase == ViewCommand.MEASURE:
            self._work = self._measure(view)

    def _on_status(self, status: ViewStatus) -> None:
        self._status = status

    def _tick(self) -> None:
        """Take one step of the work and tell where the stage is: it rests between two ticks."""
        next(self._work, None)
        message = JointState(name=["x", "y", "theta"], position=list(self.machine.position))
        message.header.stamp = self.get_clock().now().to_msg()
        self._encoder.publish(message)

    def _measure(self, view: ViewCommand) -> Iterator[None]:
        """Visit every mark as often as asked, then those that are missing, until a command comes.

        A detection that is lost on the way, or rejected, has to be seen again.
        """
        marks = [(m, n) for m, n, _ in grid_sites(view)] if view.grid else []
        lines = list(range(view.angular_count)) if view.angular else []
        for number in range(view.repeats):
            yield from self._visit(view, marks, lines)
            if number == (view.repeats - 1) // 2:  # half way: a drift does not add up in them
                yield from self._check_stops(view)
        while True:
            self._status = None
            for _ in range(REVISIT_TICKS):
                yield
            status = self._status
            if status is not None and (status.view_index, status.run_id) == (
                    view.view_index, view.run_id):
                missing = list(zip(status.missing_m, status.missing_n, strict=True))
                yield from self._visit(view, missing, list(status.missing_k))
                if status.check_done < status.check_expected:
                    yield from self._check_stops(view)

    def _visit(self, view: ViewCommand, marks: list[tuple[int, int]],
               lines: list[int]) -> Iterator[None]:
        """See some of the marks and lines of a view once: move, rest, expose, rest."""
        for m, n, position in grid_sites(view) if marks else ():
            if (m, n) not in marks:
                continue
            yield from self._settle(position)
            self._expose(self._see(m, n, view))
            yield
        for k in lines:
            yield from self._settle((0.0, 0.0, view.rotation
                                     + 2 * math.pi * k / view.angular_count))
            self._expose(MarkDetection(kind=MarkDetection.ANGULAR, has_id=True, k=k,
                                       offset_theta=self.machine.see_line(k, view), score=1.0))
            yield

    def _check_stops(self, view: ViewCommand) -> Iterator[None]:
        """See some marks again with the stage off them: +x, -x, +y, -y.

        Any marks will do that are spread over the plate. One side after the other, each in the same
        order of marks: backlash is then the same in all of them and looks like no scale.
        """
        sites = list(grid_sites(view)) if view.grid and view.check_marks else []
        step, off = max(1, len(sites) // max(1, view.check_marks)), view.check_offset
        for side_x, side_y in ((off, 0.0), (-off, 0.0), (0.0, off), (0.0, -off)):
            for m, n, (x, y, theta) in sites[step // 2::step][:view.check_marks]:
                yield from self._settle((x + side_x, y + side_y, theta))
                self._expose(self._see(m, n, view))
                yield

    def _see(self, m: int, n: int, view: ViewCommand) -> MarkDetection:
        x, y = self.machine.see_mark(m, n, view)
        return MarkDetection(kind=MarkDetection.GRID, has_id=True, m=m, n=n, offset_x=x, offset_y=y,
                             score=1.0)

    def _settle(self, position: Position) -> Iterator[None]:
        """Move, then wait until two encoder samples have told that the stage rests."""
        self.machine.move_to(position)
        yield
        yield

    def _expose(self, seen: MarkDetection) -> None:
        seen.header.stamp = self.get_clock().now().to_msg()  # the instant of exposure
        seen.header.frame_id = "stage"
        self._marks.publish(seen)


def main(kind: type[Cell] = Cell) -> None:
    """Run a cell until Ctrl-C."""
    rclpy.init()
    try:
        rclpy.spin(kind())
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
