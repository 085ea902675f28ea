# SPDX-License-Identifier: Apache-2.0
"""Parts of maps: coloured cells, scale bars, and enlarged vectors with their key."""

import math
from collections.abc import Sequence

import numpy as np

from selfcal_ros.model.artifact import Artifact
from selfcal_ros.reporting.figures.drawing import (
    LEVELS,
    SIDES,
    TICK,
    Drawing,
    Frame,
    Point,
    round_step,
    round_ticks,
    tick_text,
)
from selfcal_ros.reporting.summary.format import significant
from selfcal_ros.units import MM_PER_M, UM_PER_M

MAX_CELLS = 101
"""Cells along a side; of larger fields every second, third, ... site is shown."""

MAX_ARROWS = 21
"""Arrows along a side."""

MAX_SPOTS = 31
"""Sites along a side up to which a pointer is told their values."""

Scale = tuple[str, float]
"""Kind of a colour scale (``e``, ``v``: from 0; ``d``: to either side of 0) and its end, µm."""


def map_frame(drawing: Drawing, artifact: Artifact, box: tuple[float, float, float]) -> Frame:
    """Return a frame of the field in mm with half a cell of margin.

    `box` is left, top and width in pixels; the height follows from the shape of the plate.
    """
    left, top, width = box
    x, y = ((half + 0.5) * artifact.grid_pitch_m * MM_PER_M for half in artifact.half)
    return Frame(drawing, (left, top, width, width * y / x), (-x, x), (-y, y))


def thinned(artifact: Artifact, most: int) -> tuple[slice, slice]:
    """Return slices that leave at most `most` sites a side, the centre among them."""
    step = max(1, math.ceil(max(artifact.shape) / most))
    half_x, half_y = artifact.half
    return slice(half_x % step, None, step), slice(half_y % step, None, step)


def cells(frame: Frame, artifact: Artifact, values_um: np.ndarray, scale: Scale) -> None:
    """Colour the cell of every site; unknown sites take the colour of nothing."""
    name = scale[0]
    sites = thinned(artifact, MAX_CELLS)
    step = sites[0].step or 1
    level = levels(values_um[sites], scale)
    x, y = (along[sites] * MM_PER_M for along in (artifact.x_m, artifact.y_m))
    half = 0.5 * step * artifact.grid_pitch_m * MM_PER_M
    outlines: dict[int, list[tuple[Point, ...]]] = {}
    for i in range(level.shape[0]):
        for first, last in _runs(level[i]):
            low, high = frame.at(x[i, first] - half, y[i, first] - half), frame.at(
                x[i, last] + half, y[i, last] + half)
            low, high = _clipped(frame, low), _clipped(frame, high)
            outlines.setdefault(int(level[i, first]), []).append(
                (low, (high[0], low[1]), high, (low[0], high[1])))
    for found in sorted(outlines):
        frame.drawing.shapes(outlines[found], fill="none" if found < 0 else f"{name}{found}")


def _clipped(frame: Frame, point: Point) -> Point:
    left, top, width, height = frame.box
    return (min(max(point[0], left), left + width), min(max(point[1], top), top + height))


def _runs(row: np.ndarray) -> list[tuple[int, int]]:
    """Return first and last index of each run of equal values."""
    edges = np.flatnonzero(np.diff(row)) + 1
    starts = [0, *edges.tolist()]
    return list(zip(starts, [*(edge - 1 for edge in edges.tolist()), len(row) - 1], strict=True))


def levels(values_um: np.ndarray, scale: Scale) -> np.ndarray:
    """Return the step of the colour scale of each value; -1 where it is not known."""
    name, end = scale
    with np.errstate(invalid="ignore", over="ignore"):
        part = np.asarray(values_um) / end
        if name == "d":
            step = np.rint(np.clip(part, -1, 1) * SIDES) + SIDES
        else:
            step = np.floor(np.clip(part, 0, 1) * LEVELS)
            step = np.minimum(step, LEVELS - 1)
    return np.where(np.isfinite(part), step, -1).astype(int)


def scale_bar(drawing: Drawing, scale: Scale, box: tuple[float, float, float, float],
              unit: str = "µm") -> None:
    """Draw the colours of a scale from bottom to top with round numbers to the right of it."""
    name, end = scale
    left, top, width, height = box
    count = 2 * SIDES + 1 if name == "d" else LEVELS
    each = height / count
    for step in range(count):
        drawing.box(left, top + height - (step + 1) * each, width, each, fill=f"{name}{step}")
    drawing.box(*box, stroke="soft")
    low = -end if name == "d" else 0.0
    inset = each / 2 if name == "d" else 0.0  # the outer steps of d are centred on the ends
    frame = Frame(drawing, (left, top + inset, width, height - 2 * inset), (0.0, 1.0), (low, end))
    for value in round_ticks(low, end, 5):
        y = frame.at(0, value)[1]
        drawing.line([(left + width, y), (left + width + 3, y)], stroke="soft")
        drawing.label(left + width + 6, y + 0.35 * TICK, tick_text(value), size=TICK,
                      colour="soft")
    drawing.label(left + width / 2, top - 7, unit, size=TICK, anchor="middle", colour="soft")


def round_end(values_um: np.ndarray) -> float:
    """Return the end of a colour scale: a little round, not below the largest magnitude."""
    known = np.abs(values_um[np.isfinite(values_um)])
    largest = float(known.max()) if known.size else 0.0
    if largest <= 0:
        return 1.0
    step = round_step(largest, 5) / 2
    return step * math.ceil(largest / step - 1e-9)


def enlargement(lengths_m: np.ndarray, spacing_m: float) -> float:
    """Return the round factor that makes the longest vectors about as long as their spacing."""
    known = lengths_m[np.isfinite(lengths_m)]
    if not known.size or known.max() <= 0:
        return 1.0
    typical = max(float(np.percentile(known, 95)), float(known.max()) / 2)
    factor = 1.2 * spacing_m / typical
    if not math.isfinite(factor):
        return 1.0
    power = 10.0 ** math.floor(math.log10(factor))
    return next((step * power for step in (5, 2) if step * power <= factor * (1 + 1e-12)), power)


def arrows(frame: Frame, xy_mm: np.ndarray, vectors_m: np.ndarray, factor: float, *,
           colour: str = "ink", width: float = 1.2, heads: bool = True) -> None:
    """Draw vectors (2, P) from places (2, P), enlarged by `factor`; unknown ones are left out."""
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


def _head(start: Point, end: Point, length: float, width: float) -> tuple[Point, ...]:
    """Return the outline of an arrow's head."""
    size = min(3.2 + 1.8 * width, 0.6 * length)
    ux, uy = (end[0] - start[0]) / length, (end[1] - start[1]) / length
    back = end[0] - ux * size, end[1] - uy * size
    side = 0.38 * size
    return (end, (back[0] - uy * side, back[1] + ux * side),
            (back[0] + uy * side, back[1] - ux * side))


def arrow_key(frame: Frame, factor: float, at: Point, unit_m: float = 1 / UM_PER_M,
              unit: str = "µm") -> None:
    """Draw an arrow of a round length at the pixel `at` and say how long it is."""
    per_unit = unit_m * factor * MM_PER_M * frame.per_x
    wanted = 46.0 / per_unit if per_unit > 0 else 1.0
    power = 10.0 ** math.floor(math.log10(wanted))
    value = next((step * power for step in (5, 2) if step * power <= wanted), power)
    end = at[0] + value * per_unit, at[1]
    frame.drawing.lines([(at, end)], width=1.4)
    frame.drawing.shapes([_head(at, end, value * per_unit, 1.4)], fill="ink")
    frame.drawing.label(end[0] + 6, at[1] + 4, f"{significant(value, 1)} {unit}", size=TICK + 1)


def legend(drawing: Drawing, entries: Sequence[tuple[str, str]], at: Point, *,
           gap: float = 14.0) -> None:
    """Write (colour, words) in a row with a dot of the colour before each."""
    x, y = at
    for colour, words in entries:
        drawing.discs([(x + 4, y - 4)], 4.0, fill=colour)
        drawing.label(x + 12, y, words, size=TICK + 1)
        x += 12 + text_width(words, TICK + 1) + gap


def text_width(words: str, size: float) -> float:
    """Return about how wide words are, rather too much than too little."""
    return 0.6 * size * len(words)
