# SPDX-License-Identifier: Apache-2.0
"""A drawing: lines, shapes and words in pixels, which any backend can put on paper."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

Point = tuple[float, float]


@dataclass(frozen=True)
class Path:
    """Lines through points, x to the right and y down; closed where they are filled.

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
    title : str
        What is shown where a pointer rests on it.
    """

    lines: tuple[tuple[Point, ...], ...]
    fill: str = ""
    stroke: str = ""
    width: float = 1.0
    dash: tuple[float, ...] = ()
    opacity: float = 1.0
    title: str = ""


@dataclass(frozen=True)
class Discs:
    """Ellipses with axes along x and y, all of one look; `centres` and `radii` pair by pair."""

    centres: tuple[Point, ...]
    radii: tuple[Point, ...]
    fill: str = ""
    stroke: str = ""
    width: float = 1.0
    opacity: float = 1.0


@dataclass(frozen=True)
class Spot:
    """An invisible disc that tells something where a pointer rests on it."""

    at: Point
    radius: float
    title: str


@dataclass(frozen=True)
class Label:
    """Words. `anchor` is start, middle or end; `turned` reads upwards."""

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
    """Items on a sheet of `width` x `height` pixels, drawn in their order.

    `name` makes a file name or an anchor, `says` tells in one sentence what is to be seen.
    """

    name: str
    says: str
    width: float
    height: float
    items: list[Item] = field(default_factory=list)

    def line(self, points: Iterable[Point], *, stroke: str = "ink", width: float = 1.0,
             dash: Sequence[float] = ()) -> None:
        """Draw one line through points."""
        self.items.append(Path((tuple(points),), stroke=stroke, width=width, dash=tuple(dash)))

    def lines(self, lines: Iterable[Iterable[Point]], *, stroke: str = "ink",
              width: float = 1.0) -> None:
        """Draw many lines of one look."""
        together = tuple(tuple(line) for line in lines)
        if together:
            self.items.append(Path(together, stroke=stroke, width=width))

    def shapes(self, outlines: Iterable[Iterable[Point]], *, fill: str, stroke: str = "",
               width: float = 1.0, opacity: float = 1.0) -> None:
        """Fill outlines of one look."""
        together = tuple(tuple(outline) for outline in outlines)
        if together:
            self.items.append(Path(together, fill=fill, stroke=stroke, width=width,
                                   opacity=opacity))

    def box(self, left: float, top: float, width: float, height: float, *, fill: str = "",
            stroke: str = "") -> None:
        """Draw a rectangle."""
        self.items.append(Path((((left, top), (left + width, top), (left + width, top + height),
                                 (left, top + height), (left, top)),), fill=fill, stroke=stroke))

    def discs(self, centres: Sequence[Point], radii: Sequence[Point] | float, *, fill: str = "",
              stroke: str = "", width: float = 1.0, opacity: float = 1.0) -> None:
        """Draw ellipses of one look; a single number is the radius of all."""
        if not len(centres):
            return
        sizes = ((float(radii), float(radii)),) * len(centres) if isinstance(
            radii, int | float) else tuple(radii)
        self.items.append(Discs(tuple(centres), sizes, fill, stroke, width, opacity))

    def label(self, x: float, y: float, text: str, *, size: float = 12.0, anchor: str = "start",
              colour: str = "ink", bold: bool = False, turned: bool = False) -> None:
        """Write words with their baseline at (x, y)."""
        self.items.append(Label((x, y), text, size, anchor, colour, bold, turned))

    def spot(self, x: float, y: float, radius: float, title: str) -> None:
        """Tell something where a pointer rests."""
        self.items.append(Spot((x, y), radius, title))
