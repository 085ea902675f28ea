# SPDX-License-Identifier: Apache-2.0
"""A frame with axes: from quantities to pixels, with round ticks."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from selfcal_ros.reporting.sheet.drawing import Drawing, Point

TICK = 11.0
"""Size of the numbers at the axes, in pixels."""


@dataclass(frozen=True)
class Frame:
    """A rectangle of a drawing that stands for a range of x and of y.

    Attributes
    ----------
    drawing : Drawing
        Where it is drawn.
    box : tuple of float
        Left, top, width, height; pixels.
    x, y : tuple of float
        Lowest and highest value along each axis; y grows upwards.
    """

    drawing: Drawing
    box: tuple[float, float, float, float]
    x: tuple[float, float]
    y: tuple[float, float]

    def at(self, x: float, y: float) -> Point:
        """Return the pixel of a point, kept within ten sizes of the frame."""
        left, top, width, height = self.box
        along = (x - self.x[0]) / (self.x[1] - self.x[0])
        up = (y - self.y[0]) / (self.y[1] - self.y[0])
        return (left + width * min(max(along, -10.0), 10.0),
                top + height * (1 - min(max(up, -10.0), 10.0)))

    @property
    def per_x(self) -> float:
        """Pixels of a unit along x."""
        return self.box[2] / (self.x[1] - self.x[0])

    @property
    def per_y(self) -> float:
        """Pixels of a unit along y."""
        return self.box[3] / (self.y[1] - self.y[0])

    def border(self) -> None:
        """Draw the outline."""
        self.drawing.box(*self.box, stroke="soft")

    def axes(self, *, x_label: str = "", y_label: str = "", grid: bool = False,
             ticks: tuple[int, int] = (5, 5), size: float = TICK) -> None:
        """Draw outline, ticks with numbers, and what the axes are."""
        left, top, width, height = self.box
        bottom = top + height
        for value in round_ticks(*self.x, ticks[0]):
            x = self.at(value, self.y[0])[0]
            if grid:
                self.drawing.line([(x, top), (x, bottom)], stroke="line")
            self.drawing.line([(x, bottom), (x, bottom + 4)], stroke="soft")
            self.drawing.label(x, bottom + 6 + size, tick_text(value), size=size,
                               anchor="middle", colour="soft")
        for value in round_ticks(*self.y, ticks[1]):
            y = self.at(self.x[0], value)[1]
            if grid:
                self.drawing.line([(left, y), (left + width, y)], stroke="line")
            self.drawing.line([(left - 4, y), (left, y)], stroke="soft")
            self.drawing.label(left - 7, y + 0.35 * size, tick_text(value), size=size,
                               anchor="end", colour="soft")
        self.border()
        if x_label:
            self.drawing.label(left + width / 2, bottom + 2.4 * size + 8, x_label, size=size + 1,
                               anchor="middle", colour="soft")
        if y_label:
            self.drawing.label(left - 40, top + height / 2, y_label, size=size + 1,
                               anchor="middle", colour="soft", turned=True)


def round_step(span: float, count: int) -> float:
    """Return the smallest of 1, 2, 5 times a power of ten that divides `span` into `count` or less.

    1 where the span is not positive.
    """
    if not (math.isfinite(span) and span > 0):
        return 1.0
    rough = span / max(count, 1)
    power = 10.0 ** math.floor(math.log10(rough))
    return next((step * power for step in (1, 2, 5) if step * power >= rough * (1 - 1e-9)),
                10 * power)


def round_ticks(low: float, high: float, count: int) -> list[float]:
    """Return round values from `low` to `high`, about `count` of them."""
    step = round_step(high - low, count)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [index * step + 0.0 for index in range(first, last + 1)]


def tick_text(value: float) -> str:
    """Return a tick with the figures that it has, and a minus of full width."""
    text = f"{value:.6g}"
    return text.replace("-", "−")


def span_of(values: Sequence[float], least: float = 0.0) -> float:
    """Return the largest magnitude of the finite values; `least` or 1 where there is none."""
    return max((abs(v) for v in values if math.isfinite(v)), default=0.0) or least or 1.0
