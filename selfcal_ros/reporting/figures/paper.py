# SPDX-License-Identifier: Apache-2.0
"""Drawings as image files and on PDF pages, by matplotlib, in the light colours."""

import io
import os
from functools import cache
from pathlib import Path as FilePath
from typing import Any

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties, findfont, get_font
from matplotlib.patches import PathPatch
from matplotlib.path import Path as Outline

from selfcal_ros import __version__
from selfcal_ros.errors import InputError
from selfcal_ros.outputs import write_bytes
from selfcal_ros.reporting.figures.drawing import (
    COLOURS,
    Discs,
    Drawing,
    Label,
    Path,
    Point,
)

DPI = 150
"""Resolution of a PNG, in which a pixel of a drawing is a point."""

POINTS_PER_INCH = 72

KINDS: dict[str, dict[str, str | None]] = {
    ".png": {"Software": f"selfcal {__version__}"},
    ".svg": {"Creator": f"selfcal {__version__}", "Date": None},
    ".pdf": {"Creator": f"selfcal {__version__}", "CreationDate": None},
}
"""Endings of pictures, and what is written into them: no date, so that they are repeatable."""

RC: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "text.parse_math": False,
    "svg.hashsalt": "selfcal",
    "svg.fonttype": "path",
    "text.color": COLOURS["ink"][0],
}
"""Settings of every picture; the fixed salt makes SVG files repeatable."""


MARGIN = 0.02
"""Share of a picture that is left free at each edge: a page has margins, a file has not."""


def save_picture(drawing: Drawing, path: str | os.PathLike) -> None:
    """Write a drawing to `path` as PNG, SVG or PDF by its ending, atomically.

    Raises
    ------
    InputError
        If the name does not end in one of `KINDS`, or the file cannot be written.
    """
    kind = FilePath(path).suffix.lower()
    if kind not in KINDS:
        raise InputError(
            str(path),
            "not a picture format by its suffix",
            "name a file that ends in .png, .svg or .pdf",
        )
    page = figure(drawing)
    data = io.BytesIO()
    with rc_context(RC):
        page.savefig(data, format=kind.lstrip("."), dpi=DPI, metadata=KINDS[kind])
    write_bytes(path, data.getvalue())


def figure(drawing: Drawing) -> Figure:
    """Return a drawing as a figure of matplotlib."""
    with rc_context(RC):
        page = Figure(
            figsize=(drawing.width / POINTS_PER_INCH, drawing.height / POINTS_PER_INCH)
        )
        inner = 1 - 2 * MARGIN
        put(drawing, page.add_axes((MARGIN, MARGIN, inner, inner)), inner)
    return page


def put(drawing: Drawing, axes: Axes, points: float) -> None:
    """Draw on axes with the aspect ratio of the drawing.

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
    dash = (0, tuple(length * points for length in item.dash)) if item.dash else "solid"
    axes.add_artist(
        PathPatch(
            Outline(vertices, codes), linestyle=dash, **_style(item, points, order)
        )
    )


def _discs(item: Discs, axes: Axes, points: float, order: int) -> None:
    wide, high = zip(*item.radii, strict=True)
    axes.add_collection(
        EllipseCollection(
            [2 * r for r in wide],
            [2 * r for r in high],
            [0.0] * len(wide),
            units="xy",
            offsets=item.centres,
            offset_transform=axes.transData,
            **_style(item, points, order),
        ),
        autolim=False,
    )


def _style(item: Path | Discs, points: float, order: int) -> dict[str, Any]:
    """Return the keywords of matplotlib for the fill and the outline of an item."""
    return {
        "facecolor": to_rgba(_light(item.fill), item.opacity),
        "edgecolor": to_rgba(_light(item.stroke)),
        "linewidth": item.width * points if item.stroke else 0,
        "zorder": order,
        "clip_on": False,
    }


def _label(item: Label, axes: Axes, points: float, order: int) -> None:
    axes.text(
        *item.at,
        drawable(item.text),
        fontsize=item.size * points,
        color=_light(item.colour),
        weight="bold" if item.bold else "normal",
        ha={"start": "left", "middle": "center", "end": "right"}[item.anchor],
        va="baseline",
        rotation=90 if item.turned else 0,
        rotation_mode="anchor",
        zorder=order,
    )


def drawable(text: object, limit: int = 300) -> str:
    """Return `text` as one line of characters in the font, truncated at `limit`."""
    in_font = _characters()
    line = "".join(
        c if c.isprintable() and c in in_font else "?" for c in str(text)[: limit + 1]
    )
    return line if len(line) <= limit else line[: limit - 1] + "…"


@cache
def _characters() -> frozenset[str]:
    """Return the characters in the font."""
    font = get_font(findfont(FontProperties(family="DejaVu Sans")))
    return frozenset(chr(code) for code, glyph in font.get_charmap().items() if glyph)
