# SPDX-License-Identifier: Apache-2.0
"""Parts of figures: panels, coloured cells, scale bars, enlarged vectors with their key."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import NamedTuple

import numpy as np

from selfcal_ros.model.artifact import Artifact
from selfcal_ros.reporting.figures import drawing as draw
from selfcal_ros.reporting.summary.numbers import significant
from selfcal_ros.units import MM_PER_M, UM_PER_M

WIDTH = 480.0
"""Width of a figure in pixels: its words can still be read on a telephone."""

MAX_CELLS = 101
"""Cells along a side; of larger fields every second, third, ... site is shown."""

MAX_ARROWS = 21
"""Arrows along a side."""


class Scale(NamedTuple):
    """A colour scale: its gradient (``d``: diverging from 0) and the values at its ends."""

    ramp: str
    low: float
    high: float


def titled(name: str, title: str, height: float = 0.0) -> draw.Drawing:
    """Return an empty figure with its title."""
    drawing = draw.Drawing(name, title, WIDTH, height)
    drawing.label(0, 16, title, size=13, bold=True)
    return drawing


def map_frame(
    drawing: draw.Drawing, artifact: Artifact, box: tuple[float, float, float]
) -> draw.Frame:
    """Return a frame of the field in mm with half a cell of margin.

    `box` is left, top and width in pixels; the height follows from the shape of the plate.
    """
    left, top, width = box
    x, y = ((half + 0.5) * artifact.grid_pitch_m * MM_PER_M for half in artifact.reach)
    return draw.Frame(drawing, (left, top, width, width * y / x), (-x, x), (-y, y))


def thinned(artifact: Artifact, most: int) -> tuple[slice, slice]:
    """Return slices that keep at most `most` sites per side, including the site m = n = 0.

    Of a list of marks as many as of such a lattice.
    """
    if artifact.marks:
        return slice(0, None, max(1, math.ceil(artifact.shape[0] / most**2))), slice(
            0, None, None
        )
    step = max(1, math.ceil(max(artifact.shape) / most))
    i, j = artifact.middle
    return slice(i % step, None, step), slice(j % step, None, step)


def cells(
    frame: draw.Frame, artifact: Artifact, values: np.ndarray, scale: Scale
) -> None:
    """Colour the cell of every site; unknown sites are grey."""
    sites = thinned(artifact, MAX_CELLS)
    step = sites[0].step or 1
    level = levels(values[sites], scale)
    x, y = (along[sites] * MM_PER_M for along in (artifact.x_m, artifact.y_m))
    half = 0.5 * step * artifact.grid_pitch_m * MM_PER_M
    outlines: dict[int, list[tuple[draw.Point, ...]]] = {}
    for i in range(level.shape[0]):
        for _, run in groupby(range(level.shape[1]), level[i].__getitem__):
            alike = list(run)
            first = alike[0]
            last = alike[-1]
            low = frame.at(x[i, first] - half, y[i, first] - half)
            high = frame.at(x[i, last] + half, y[i, last] + half)
            low, high = _clipped(frame, low), _clipped(frame, high)
            outlines.setdefault(int(level[i, first]), []).append(
                (low, (high[0], low[1]), high, (low[0], high[1]))
            )
    for shade in sorted(outlines):
        frame.drawing.shapes(
            outlines[shade], fill="none" if shade < 0 else f"{scale.ramp}{shade}"
        )


def _clipped(frame: draw.Frame, point: draw.Point) -> draw.Point:
    left, top, width, height = frame.box
    return (
        min(max(point[0], left), left + width),
        min(max(point[1], top), top + height),
    )


def levels(values: np.ndarray, scale: Scale) -> np.ndarray:
    """Return the step of the colour scale of each value; -1 if unknown.

    If the ends of the scale are equal it is the middle step.
    """
    top = 2 * draw.SIDES if scale.ramp == "d" else draw.LEVELS - 1
    with np.errstate(invalid="ignore", over="ignore"):
        offset = np.asarray(values) - scale.low
        span = scale.high - scale.low
        fraction = np.clip(offset / span if span else 0.4 + 0 * offset, 0, 1)
        step = (
            np.rint(fraction * top)
            if scale.ramp == "d"
            else np.floor(fraction * draw.LEVELS)
        )
    return np.where(np.isfinite(fraction), np.minimum(step, top), -1).astype(int)


def scale_bar(
    drawing: draw.Drawing,
    scale: Scale,
    box: tuple[float, float, float, float],
    unit: str = "µm",
) -> None:
    """Draw a colour bar from bottom to top, with round numbers on its right."""
    left, top, width, height = box
    count = 2 * draw.SIDES + 1 if scale.ramp == "d" else draw.LEVELS
    step_height = height / count
    for step in range(count):
        drawing.box(
            left,
            top + height - (step + 1) * step_height,
            width,
            step_height,
            fill=f"{scale.ramp}{step}",
        )
    drawing.box(*box, stroke="soft")
    # its outer steps are centred on the ends
    inset = step_height / 2 if scale.ramp == "d" else 0.0
    frame = draw.Frame(
        drawing,
        (left, top + inset, width, height - 2 * inset),
        (0.0, 1.0),
        (scale.low, scale.high),
    )
    for value in draw.round_ticks(scale.low, scale.high, 5):
        y = frame.at(0, value)[1]
        drawing.line([(left + width, y), (left + width + 3, y)], stroke="soft")
        drawing.label(
            left + width + 6,
            y + 0.35 * draw.TICK,
            draw.tick_text(value),
            size=draw.TICK,
            colour="soft",
        )
    drawing.label(
        left + width / 2, top - 7, unit, size=draw.TICK, anchor="middle", colour="soft"
    )


def round_end(values: np.ndarray) -> float:
    """Return the end of a colour scale: a rounded number not below the largest magnitude."""
    magnitudes = np.abs(values[np.isfinite(values)])
    largest = float(magnitudes.max()) if magnitudes.size else 0.0
    if largest <= 0:
        return 1.0
    step = draw.round_step(largest, 5) / 2
    return step * math.ceil(largest / step - 1e-9)


def range_scale(values: np.ndarray) -> Scale:
    """Return a scale of uncertainties, from the smallest to the largest, rounded outwards.

    Its ends are equal if the values agree to 1 %, or if none is known.
    """
    finite = values[np.isfinite(values)]
    low, high = (
        (float(finite.min()), float(finite.max())) if finite.size else (0.0, 0.0)
    )
    if high - low <= 0.01 * high:
        return Scale("v", high, high)
    step = draw.round_step(high - low, 5) / 2
    return Scale(
        "v", step * math.floor(low / step + 1e-9), step * math.ceil(high / step - 1e-9)
    )


def enlargement(lengths_m: np.ndarray, spacing_m: float) -> float:
    """Return the round factor by which the longest vectors become as long as their spacing."""
    finite_m = lengths_m[np.isfinite(lengths_m)]
    if not finite_m.size or finite_m.max() <= 0:
        return 1.0
    typical = max(float(np.percentile(finite_m, 95)), float(finite_m.max()) / 2)
    factor = 1.2 * spacing_m / typical
    if not math.isfinite(factor):
        return 1.0
    return draw.round_down(factor)


def arrows(
    frame: draw.Frame,
    xy_mm: np.ndarray,
    vectors_m: np.ndarray,
    factor: float,
    *,
    colour: str = "ink",
    width: float = 1.2,
    heads: bool = True,
) -> None:
    """Draw vectors (2, P) at points (2, P), enlarged by `factor`, without unknown ones."""
    shafts, tips = [], []
    for x, y, gx, gy in zip(*xy_mm, *vectors_m, strict=True):
        if not (math.isfinite(gx) and math.isfinite(gy)):
            continue
        start = frame.at(x, y)
        end = frame.at(x + gx * factor * MM_PER_M, y + gy * factor * MM_PER_M)
        length = math.dist(start, end)
        if length < 0.3:
            continue
        shafts.append((start, end))
        if heads:
            tips.append(_head(start, end, length, width))
    frame.drawing.lines(shafts, stroke=colour, width=width)
    frame.drawing.shapes(tips, fill=colour)


def _head(
    start: draw.Point, end: draw.Point, length: float, width: float
) -> tuple[draw.Point, ...]:
    """Return the outline of an arrow's head."""
    size = min(3.2 + 1.8 * width, 0.6 * length)
    ux, uy = (end[0] - start[0]) / length, (end[1] - start[1]) / length
    back = end[0] - ux * size, end[1] - uy * size
    side = 0.38 * size
    return (
        end,
        (back[0] - uy * side, back[1] + ux * side),
        (back[0] + uy * side, back[1] - ux * side),
    )


def curved_arrow(
    drawing: draw.Drawing, way: Sequence[draw.Point], *, colour: str
) -> None:
    """Draw a line through points that ends in an arrowhead."""
    back = next(
        (point for point in reversed(way) if math.dist(point, way[-1]) >= 9), way[0]
    )
    drawing.line(way, stroke=colour, width=1.4)
    drawing.shapes([_head(back, way[-1], math.dist(back, way[-1]), 3.0)], fill=colour)


def arrow_key(frame: draw.Frame, factor: float, at: draw.Point) -> None:
    """Draw an arrow of a round length at the pixel `at`, labelled with its length."""
    per_unit = factor * MM_PER_M / UM_PER_M * frame.per_x
    value = draw.round_down(46.0 / per_unit) if per_unit > 0 else 1.0
    end = at[0] + value * per_unit, at[1]
    frame.drawing.lines([(at, end)], width=1.4)
    frame.drawing.shapes([_head(at, end, value * per_unit, 1.4)], fill="ink")
    frame.drawing.label(
        end[0] + 6, at[1] + 4, f"{significant(value, 1)} µm", size=draw.TICK + 1
    )


def legend(
    drawing: draw.Drawing, entries: Sequence[tuple[str, str]], at: draw.Point
) -> None:
    """Write texts in a row, each after a dot of its colour."""
    x, y = at
    for colour, words in entries:
        drawing.discs([(x + 4, y - 4)], 4.0, fill=colour)
        drawing.label(x + 12, y, words, size=draw.TICK + 1)
        x += 12 + text_width(words, draw.TICK + 1) + 14


def text_width(words: str, size: float) -> float:
    """Return an upper estimate of the width of text."""
    return 0.6 * size * len(words)


def ordinal(number: int) -> str:
    """Return ``1st``, ``2nd``, ``3rd``, ``4th``, ``11th``, ``21st``."""
    teen = number % 100 in (11, 12, 13)
    return f"{number}{'th' if teen else {1: 'st', 2: 'nd', 3: 'rd'}.get(number % 10, 'th')}"


def panels(
    drawing: draw.Drawing,
    titles: Sequence[str],
    reach_mm: Sequence[float],
    below: float = 50.0,
) -> list[draw.Frame]:
    """Return titled frames of the field, two per row; the drawing grows as needed."""
    side, gap, left, top = 186.0, 42.0, 46.0, 48.0
    height = side * reach_mm[1] / reach_mm[0]
    out = []
    for number, title in enumerate(titles):
        box = (
            left + number % 2 * (side + gap),
            top + number // 2 * (height + below),
            side,
            height,
        )
        drawing.label(box[0], box[1] - 6, shortened(title, 26), bold=True)
        spans = [(-reach, reach) for reach in reach_mm]
        out.append(draw.Frame(drawing, box, spans[0], spans[1]))
    drawing.height = top + -(-len(titles) // 2) * (height + below) - 26
    return out


def shortened(words: str, most: int) -> str:
    """Return text truncated at `most` characters."""
    return words if len(words) <= most else words[: most - 1] + "…"


@dataclass(frozen=True, eq=False)
class Curve:
    """Values over x: a line unless its width is 0, dots, and ± `U` as bars or as a band."""

    x: np.ndarray
    y: np.ndarray
    colour: str = "ink"
    width: float = 1.5
    dash: tuple[float, ...] = ()
    dots: float = 0.0
    U: np.ndarray | None = None
    band: bool = False


def chart(
    drawing: draw.Drawing,
    box: tuple[float, float, float, float],
    curves: Sequence[Curve],
    *,
    title: str = "",
    labels: tuple[str, str] = ("", ""),
    log: bool = False,
    x: tuple[float, float] | None = None,
    y: tuple[float, float] | None = None,
) -> None:
    """Draw curves; x and y are ranges that include all of them unless given.

    With `log` both axes are logarithmic.
    """
    scaled = (
        [replace(c, x=np.log10(c.x), y=np.log10(c.y)) for c in curves]
        if log
        else curves
    )
    reach = [
        c.y + side * (0.0 if c.U is None else c.U) for c in scaled for side in (-1, 1)
    ]
    frame = draw.Frame(
        drawing,
        box,
        x or _span([c.x for c in scaled], 0.04),
        y or _span(reach, 0.06),
        log,
    )
    drawing.label(box[0], box[1] - 7, title, bold=True)
    for curve in scaled:
        low, high = (
            [
                frame.at(*point)
                for point in zip(
                    curve.x,
                    curve.y + side * (0.0 if curve.U is None else curve.U),
                    strict=True,
                )
            ]
            for side in (-1, 1)
        )
        if curve.band:
            drawing.shapes([[*high, *reversed(low)]], fill=curve.colour, opacity=0.25)
        elif curve.U is not None:
            drawing.lines(zip(low, high, strict=True), stroke=curve.colour)
        places = [frame.at(*point) for point in zip(curve.x, curve.y, strict=True)]
        if curve.width:
            drawing.line(
                places, stroke=curve.colour, width=curve.width, dash=curve.dash
            )
        if curve.dots:
            drawing.discs(places, curve.dots, fill=curve.colour)
    frame.axes(x_label=labels[0], y_label=labels[1])


def _span(values: Sequence[np.ndarray], margin: float) -> tuple[float, float]:
    """Return a range that includes all values, with a margin at either end."""
    finite = np.concatenate(values)
    finite = finite[np.isfinite(finite)]
    low, high = (
        (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)
    )
    room = margin * (high - low) or abs(low) or 1.0
    return low - room, high + room
