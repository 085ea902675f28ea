# SPDX-License-Identifier: Apache-2.0
"""A machine of your own in one class: replace the inside of `Stage` by your drivers.

selfcal measure config/plans/small.yaml examples/cell.yaml -o measured --yes         # without ROS
ros2 run selfcal_ros cell_driver --ros-args -p cell:=examples/cell.yaml         # under ROS
"""

import math
import random

from selfcal_ros.machine import Image, Offset, Placing

Pair = tuple[float, float]


class Stage:
    """A stage with wrong encoders, a plate with wrong marks, a microscope.

    Parameters
    ----------
    marks, lines : int
        Marks along a side of the plate, and angular lines.
    pitch : float
        Distance of two marks, m.
    """

    axes = ("x", "y", "theta")

    def __init__(self, marks: int = 5, pitch: float = 0.01, lines: int = 8) -> None:
        self._random = random.Random(1)
        self._at: tuple[float, ...] = (0.0, 0.0, 0.0)
        rows = range(-(marks // 2), marks - marks // 2)
        # of an even number the centre is between the rows
        middle = 0.5 * (marks % 2 == 0)
        self._marks = {
            (m, n): (
                (m + middle) * pitch + self._random.gauss(0, 3e-7),
                (n + middle) * pitch + self._random.gauss(0, 3e-7),
            )
            for m in rows
            for n in rows
        }
        self._lines = [
            math.tau * k / lines + self._random.gauss(0, 2e-5) for k in range(lines)
        ]
        self.place(Placing("", 0.0, 0.0, 0.0))

    def place(self, placing: Placing) -> None:
        """Lay the plate half a millirad and 20 um beside where it should be."""
        self._turn = placing.rotation + self._random.gauss(0, 5e-4)
        self._centre = (
            placing.x + self._random.gauss(0, 2e-5),
            placing.y + self._random.gauss(0, 2e-5),
        )

    def error(self, x: float, y: float) -> Pair:
        """Return what the encoders say too much at (x, y), m: what the calibration shall find."""
        return (
            3e-7 * math.sin(120 * x) * math.cos(80 * y),
            2e-7 * math.cos(90 * x + 60 * y),
        )

    def position(self) -> tuple[float, ...]:
        """Return what the encoders say: x and y in m, theta in rad."""
        return self._at

    def move_to(self, position: tuple[float, ...]) -> None:
        """Go there; return when the motion has ended."""
        self._at = position

    def image(self) -> Image | None:
        """Return None: the microscope finds marks by itself."""
        return None

    def offsets(self) -> list[Offset]:
        """Return the mark and the line nearest to the optical axis."""
        (m, n), (x, y) = min(
            ((mark, self.seen(place)) for mark, place in self._marks.items()),
            key=lambda item: math.hypot(*item[1]),
        )
        theta = self._at[2] - 2e-5 * math.sin(self._at[2])  # its encoder is eccentric
        turns = [
            math.remainder(line + self._turn - theta, math.tau) for line in self._lines
        ]
        k = min(range(len(turns)), key=lambda line: abs(turns[line]))
        return [
            Offset(
                x + self._random.gauss(0, 5e-9),
                y + self._random.gauss(0, 5e-9),
                mark=(m, n),
            ),
            Offset(theta=turns[k] + self._random.gauss(0, 1e-7), line=k),
        ]

    def seen(self, place: Pair) -> Pair:
        """Return mark centre less optical axis of a place on the plate, stage axes, m."""
        x, y = place
        cosine, sine = math.cos(self._turn), math.sin(self._turn)
        gx, gy = self.error(*self._at[:2])
        return (
            self._centre[0] + cosine * x - sine * y - (self._at[0] - gx),
            self._centre[1] + sine * x + cosine * y - (self._at[1] - gy),
        )

    def stop(self) -> None:
        """Stop at once."""

    def close(self) -> None:
        """Release the drivers."""
