# SPDX-License-Identifier: Apache-2.0
"""Drawings in pixels: lines, shapes and text, their colours, and frames with axes."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

LEVELS = 10
"""Steps of a sequential scale, ``e0`` to ``e9`` (error) and ``v0`` to ``v9`` (uncertainty)."""

SIDES = 5
"""Steps of a diverging scale to either side of its middle: ``d0`` to ``d10``."""

SERIES = 6
"""Colours of series, ``c0`` to ``c5`` (Okabe and Ito); then they repeat."""

_PLAIN = {
    "ink": ("#16202a", "#e7ecf1"),
    "soft": ("#55606a", "#a3afba"),
    "paper": ("#ffffff", "#14191e"),
    "line": ("#d5dbe1", "#36414b"),
    "card": ("#f5f7f9", "#1d242b"),
    "good": ("#00664b", "#4cc9a0"),
    "bad": ("#a83a00", "#ff9a5c"),
    "warn": ("#b58900", "#e3b341"),
    "none": ("#e3e3e3", "#2b3137"),
    "band": ("#56b4e9", "#2f7fb0"),
    "truth": ("#d55e00", "#ff8f3f"),
    "c0": ("#0072b2", "#5ab4e8"),
    "c1": ("#d55e00", "#ff8f3f"),
    "c2": ("#008060", "#3fcf9f"),
    "c3": ("#a0509a", "#e39ad0"),
    "c4": ("#7a6a00", "#e0cc55"),
    "c5": ("#404a54", "#b9c3cc"),
}
_RAMPS = {
    "e": (("#ffffff", "#b5d3ea", "#4f93cc"), ("#171d23", "#22476a", "#2f74b0")),
    "v": (("#ffffff", "#c3b8de", "#7761ab"), ("#171d23", "#41346a", "#7058b0")),
    "d": (("#2b6cb0", "#ffffff", "#c8601a"), ("#3f86d0", "#171d23", "#d06a20")),
}


def _mixed(stops: tuple[str, ...], fraction: float) -> str:
    """Return the colour at `fraction` (0 to 1) of a gradient with evenly spaced stops."""
    place = fraction * (len(stops) - 1)
    index = min(int(place), len(stops) - 2)
    low, high = (
        tuple(int(stops[i][at : at + 2], 16) for at in (1, 3, 5))
        for i in (index, index + 1)
    )
    return "#" + "".join(
        f"{round(a + (b - a) * (place - index)):02x}"
        for a, b in zip(low, high, strict=True)
    )


def _all_colours() -> dict[str, tuple[str, str]]:
    colours = dict(_PLAIN)
    for name, (light, dark) in _RAMPS.items():
        count = 2 * SIDES + 1 if name == "d" else LEVELS
        for i in range(count):
            fraction = i / (count - 1)
            colours[f"{name}{i}"] = (_mixed(light, fraction), _mixed(dark, fraction))
    return colours


COLOURS: dict[str, tuple[str, str]] = _all_colours()
"""Name -> colour on light and on dark paper."""


def _variables(column: int) -> str:
    return " ".join(f"--{name}: {pair[column]};" for name, pair in COLOURS.items())


def variables_css(root: str = ":root") -> str:
    """Return the rules that define all colours as CSS variables; print uses the light ones."""
    return (
        f"{root} {{ color-scheme: light dark; {_variables(0)} }}\n"
        f"@media screen and (prefers-color-scheme: dark) {{ {root} {{ {_variables(1)} }} }}\n"
    )


def classes_css() -> str:
    """Return the classes of figures: ``f-NAME`` fills, ``s-NAME`` strokes."""
    return "".join(
        f"svg.figure .f-{name}{{fill:var(--{name})}}svg.figure .s-{name}{{stroke:var(--{name})}}\n"
        for name in COLOURS
    )


Point = tuple[float, float]


@dataclass(frozen=True)
class Path:
    """Lines through points, x to the right and y down; closed if filled.

    Attributes
    ----------
    lines : tuple of tuples of points
        One or more lines with the same look.
    fill, stroke : str
        Names of colours (`palette.COLOURS`); empty = none.
    width : float
        Of the stroke.
    dash : tuple of float
        Lengths of dashes and gaps; empty = solid.
    opacity : float
        Of the fill.
    """

    lines: tuple[tuple[Point, ...], ...]
    fill: str = ""
    stroke: str = ""
    width: float = 1.0
    dash: tuple[float, ...] = ()
    opacity: float = 1.0


@dataclass(frozen=True)
class Discs:
    """Ellipses with axes along x and y in one style, from pairs of `centres` and `radii`."""

    centres: tuple[Point, ...]
    radii: tuple[Point, ...]
    fill: str = ""
    stroke: str = ""
    opacity: float = 1.0
    width: ClassVar[float] = 1.0


@dataclass(frozen=True)
class Spot:
    """An invisible disc with a tooltip."""

    at: Point
    radius: float
    title: str


@dataclass(frozen=True)
class Label:
    """A line of text. `anchor` is start, middle or end; `turned` text reads upwards."""

    at: Point
    text: str
    size: float = 12.0
    anchor: str = "start"
    colour: str = "ink"
    bold: bool = False
    turned: bool = False


Item = Path | Discs | Spot | Label


@dataclass
class Drawing:
    """Items on a sheet of `width` x `height` pixels, drawn in order.

    `name` gives a file name or an anchor; `says` describes the drawing in one sentence.
    """

    name: str
    says: str
    width: float
    height: float
    items: list[Item] = field(default_factory=list)

    def line(
        self,
        points: Iterable[Point],
        *,
        stroke: str = "ink",
        width: float = 1.0,
        dash: Sequence[float] = (),
    ) -> None:
        """Draw one line through points."""
        self.items.append(
            Path((tuple(points),), stroke=stroke, width=width, dash=tuple(dash))
        )

    def lines(
        self,
        lines: Iterable[Iterable[Point]],
        *,
        stroke: str = "ink",
        width: float = 1.0,
    ) -> None:
        """Draw many lines in one style."""
        together = tuple(tuple(line) for line in lines)
        if together:
            self.items.append(Path(together, stroke=stroke, width=width))

    def shapes(
        self,
        outlines: Iterable[Iterable[Point]],
        *,
        fill: str,
        stroke: str = "",
        opacity: float = 1.0,
    ) -> None:
        """Fill outlines in one style."""
        together = tuple(tuple(outline) for outline in outlines)
        if together:
            self.items.append(Path(together, fill=fill, stroke=stroke, opacity=opacity))

    def box(
        self,
        left: float,
        top: float,
        width: float,
        height: float,
        *,
        fill: str = "",
        stroke: str = "",
    ) -> None:
        """Draw a rectangle."""
        self.items.append(
            Path(
                (
                    (
                        (left, top),
                        (left + width, top),
                        (left + width, top + height),
                        (left, top + height),
                        (left, top),
                    ),
                ),
                fill=fill,
                stroke=stroke,
            )
        )

    def discs(
        self,
        centres: Sequence[Point],
        radii: Sequence[Point] | float,
        *,
        fill: str = "",
        stroke: str = "",
        opacity: float = 1.0,
    ) -> None:
        """Draw ellipses in one style; a single number is the radius of all."""
        if not len(centres):
            return
        sizes = (
            ((float(radii), float(radii)),) * len(centres)
            if isinstance(radii, int | float)
            else tuple(radii)
        )
        self.items.append(Discs(tuple(centres), sizes, fill, stroke, opacity))

    def label(
        self,
        x: float,
        y: float,
        text: str,
        *,
        size: float = 12.0,
        anchor: str = "start",
        colour: str = "ink",
        bold: bool = False,
        turned: bool = False,
    ) -> None:
        """Write text with its baseline at (x, y)."""
        self.items.append(
            Label(
                at=(x, y),
                text=text,
                size=size,
                anchor=anchor,
                colour=colour,
                bold=bold,
                turned=turned,
            )
        )

    def spot(self, x: float, y: float, radius: float, title: str) -> None:
        """Add a tooltip."""
        self.items.append(Spot((x, y), radius, title))

    def add(self, other: "Drawing", x: float, y: float) -> None:
        """Put the items of another drawing with its upper left corner at (x, y)."""

        def moved(points: Iterable[Point]) -> tuple[Point, ...]:
            return tuple((across + x, down + y) for across, down in points)

        for item in other.items:
            if isinstance(item, Path):
                self.items.append(replace(item, lines=tuple(map(moved, item.lines))))
            elif isinstance(item, Discs):
                self.items.append(replace(item, centres=moved(item.centres)))
            else:
                self.items.append(replace(item, at=moved([item.at])[0]))


TICK = 11.0
"""Size of the numbers at the axes, in pixels."""

SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


@dataclass(frozen=True)
class Frame:
    """A rectangle of a drawing that represents a range of x and y.

    Attributes
    ----------
    drawing : Drawing
        Where it is drawn.
    box : tuple of float
        Left, top, width, height; pixels.
    x, y : tuple of float
        Lowest and highest value along each axis; y grows upwards.
    log : bool
        Whether the values are decimal logarithms: ticks are powers of ten.
    """

    drawing: Drawing
    box: tuple[float, float, float, float]
    x: tuple[float, float]
    y: tuple[float, float]
    log: bool = False

    def at(self, x: float, y: float) -> Point:
        """Return the pixel of a point, limited to ten times the size of the frame."""
        left, top, width, height = self.box
        along = (x - self.x[0]) / (self.x[1] - self.x[0])
        up = (y - self.y[0]) / (self.y[1] - self.y[0])
        return (
            left + width * min(max(along, -10.0), 10.0),
            top + height * (1 - min(max(up, -10.0), 10.0)),
        )

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

    def axes(
        self, *, x_label: str = "", y_label: str = "", ticks: tuple[int, int] = (5, 5)
    ) -> None:
        """Draw outline, numbered ticks, and labels of the axes."""
        left, top, width, height = self.box
        bottom = top + height
        for value, text in self._ticks(self.x, ticks[0]):
            x = self.at(value, self.y[0])[0]
            self.drawing.line([(x, bottom), (x, bottom + 4)], stroke="soft")
            self.drawing.label(
                x, bottom + 6 + TICK, text, size=TICK, anchor="middle", colour="soft"
            )
        for value, text in self._ticks(self.y, ticks[1]):
            y = self.at(self.x[0], value)[1]
            self.drawing.line([(left - 4, y), (left, y)], stroke="soft")
            self.drawing.label(
                left - 7, y + 0.35 * TICK, text, size=TICK, anchor="end", colour="soft"
            )
        self.border()
        if x_label:
            self.drawing.label(
                left + width / 2,
                bottom + 2.4 * TICK + 8,
                x_label,
                size=TICK + 1,
                anchor="middle",
                colour="soft",
            )
        if y_label:
            self.drawing.label(
                left - 40,
                top + height / 2,
                y_label,
                size=TICK + 1,
                anchor="middle",
                colour="soft",
                turned=True,
            )

    def _ticks(self, span: tuple[float, float], count: int) -> list[tuple[float, str]]:
        if not self.log:
            return [(value, tick_text(value)) for value in round_ticks(*span, count)]
        step = max(1, round((span[1] - span[0]) / count))
        decades = range(math.ceil(span[0]), math.floor(span[1]) + 1, step)
        return [
            (decade, "10" + str(decade).translate(SUPERSCRIPT)) for decade in decades
        ]


def round_step(span: float, count: int) -> float:
    """Return the smallest of 1, 2, 5 times a power of ten that divides `span` into `count` or less.

    1 if the span is not positive.
    """
    if not (math.isfinite(span) and span > 0):
        return 1.0
    rough = span / max(count, 1)
    power = 10.0 ** math.floor(math.log10(rough))
    return next(
        (step * power for step in (1, 2, 5) if step * power >= rough * (1 - 1e-9)),
        10 * power,
    )


def round_down(value: float) -> float:
    """Return the largest of 1, 2, 5 times a power of ten that is not above `value` > 0."""
    power = 10.0 ** math.floor(math.log10(value))
    return next(
        (step * power for step in (5, 2) if step * power <= value * (1 + 1e-12)), power
    )


def round_ticks(low: float, high: float, count: int) -> list[float]:
    """Return about `count` round values from `low` to `high`."""
    step = round_step(high - low, count)
    first = math.ceil(low / step - 1e-9)
    last = math.floor(high / step + 1e-9)
    return [index * step + 0.0 for index in range(first, last + 1)]


def tick_text(value: float) -> str:
    """Return the label of a tick, with a true minus sign."""
    text = f"{value:.6g}"
    return text.replace("-", "−")


def span_of(values: Sequence[float]) -> float:
    """Return the largest magnitude of the finite values; 1 if there is none."""
    return max((abs(v) for v in values if math.isfinite(v)), default=0.0) or 1.0
