# SPDX-License-Identifier: Apache-2.0
"""Drawings on paper: put on the axes of a page, in the light colours."""

from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection
from matplotlib.colors import to_rgba
from matplotlib.patches import PathPatch
from matplotlib.path import Path as Outline

from selfcal_ros.reporting.figures.drawing import COLOURS, Discs, Drawing, Label, Path, Point
from selfcal_ros.reporting.maps.style import drawable


def put(drawing: Drawing, axes: Axes, points: float) -> None:
    """Draw on axes that have the drawing's shape.

    Parameters
    ----------
    drawing : Drawing
        What to draw.
    axes : matplotlib.axes.Axes
        Where; its limits and frame are set.
    points : float
        Points of a pixel, for strokes and letters.
    """
    axes.set_xlim(0, drawing.width)
    axes.set_ylim(drawing.height, 0)
    axes.set_axis_off()
    for order, item in enumerate(drawing.items):
        if isinstance(item, Path):
            _path(item, axes, points, order)
        elif isinstance(item, Discs):
            _discs(item, axes, points, order)
        elif isinstance(item, Label):
            _label(item, axes, points, order)


def _light(name: str) -> str:
    return COLOURS[name][0] if name else "none"


def _path(item: Path, axes: Axes, points: float, order: int) -> None:
    vertices: list[Point] = []
    codes: list = []
    for line in item.lines:
        vertices += line
        codes += [Outline.MOVETO, *[Outline.LINETO] * (len(line) - 1)]
        if item.fill:
            vertices.append(line[0])
            codes.append(Outline.CLOSEPOLY)
    dash = (0, tuple(part * points for part in item.dash)) if item.dash else "solid"
    fill, stroke = to_rgba(_light(item.fill), item.opacity), to_rgba(_light(item.stroke))
    axes.add_artist(PathPatch(Outline(vertices, codes), facecolor=fill, edgecolor=stroke,
                              linewidth=item.width * points if item.stroke else 0,
                              linestyle=dash, zorder=order, clip_on=False))


def _discs(item: Discs, axes: Axes, points: float, order: int) -> None:
    wide, high = zip(*item.radii, strict=True)
    fill, stroke = to_rgba(_light(item.fill), item.opacity), to_rgba(_light(item.stroke))
    axes.add_collection(EllipseCollection(
        [2 * r for r in wide], [2 * r for r in high], [0.0] * len(wide), units="xy",
        offsets=item.centres, offset_transform=axes.transData, facecolor=fill, edgecolor=stroke,
        linewidth=item.width * points if item.stroke else 0, zorder=order, clip_on=False),
        autolim=False)


def _label(item: Label, axes: Axes, points: float, order: int) -> None:
    axes.text(*item.at, drawable(item.text), fontsize=item.size * points,
              color=_light(item.colour), weight="bold" if item.bold else "normal",
              ha={"start": "left", "middle": "center", "end": "right"}[item.anchor],
              va="baseline", rotation=90 if item.turned else 0, rotation_mode="anchor",
              zorder=order)
