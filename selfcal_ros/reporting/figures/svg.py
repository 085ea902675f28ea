# SPDX-License-Identifier: Apache-2.0
"""Drawings as SVG: in a page that includes the colours, or as a file of their own."""

import math
from collections.abc import Iterable
from html import escape

from selfcal_ros.errors import printable
from selfcal_ros.reporting.figures import drawing as draw

FONT = 'system-ui, "Segoe UI", "DejaVu Sans", sans-serif'
FIGURE_CSS = (f"svg.figure {{ display: block; width: 100%; height: auto; font-family: {FONT}; }}\n"
              "svg.figure path, svg.figure ellipse { fill: none; }\n"
              "svg.figure .b { font-weight: 600; }\n"
              "svg.figure .spot { fill: transparent; }\n"
              "svg.figure .spot:hover { fill: var(--truth); fill-opacity: .35; }\n")


def css() -> str:
    """Return the rules that every figure needs, colours included."""
    return draw.variables_css() + FIGURE_CSS + draw.classes_css()


def inline_svg(drawing: draw.Drawing) -> str:
    """Return a drawing for a page that includes the rules of `css`."""
    return _svg(drawing, "")


def svg_file(drawing: draw.Drawing) -> str:
    """Return a drawing as a file that adapts to light and dark mode."""
    style = "".join((draw.variables_css("svg"), FIGURE_CSS, draw.classes_css()))
    sheet = f'<rect class="f-paper" width="{_n(drawing.width)}" height="{_n(drawing.height)}"/>'
    return _svg(drawing, f"<style>{style}</style>{sheet}\n",
                f' xmlns="http://www.w3.org/2000/svg" width="{_n(drawing.width)}" '
                f'height="{_n(drawing.height)}"') + "\n"


def _svg(drawing: draw.Drawing, before: str, attributes: str = "") -> str:
    body = "\n".join(map(_item, drawing.items))
    return (f'<svg{attributes} class="figure" role="img" '
            f'aria-label="{escape(printable(drawing.says))}" '
            f'viewBox="0 0 {_n(drawing.width)} {_n(drawing.height)}">\n{before}{body}\n</svg>')


def _item(item: draw.Item) -> str:
    if isinstance(item, draw.Label):
        return _label(item)
    if isinstance(item, draw.Spot):
        return (f'<circle class="spot" cx="{_n(item.at[0])}" cy="{_n(item.at[1])}" '
                f'r="{_n(item.radius)}"><title>{escape(printable(item.title))}</title></circle>')
    look = " ".join(name for name in (item.fill and f"f-{item.fill}",
                                      item.stroke and f"s-{item.stroke}") if name)
    more = _look(item)
    if isinstance(item, draw.Discs):
        return "".join(f'<ellipse class="{look}" cx="{_n(x)}" cy="{_n(y)}" rx="{_n(rx)}" '
                       f'ry="{_n(ry)}"{more}/>'
                       for (x, y), (rx, ry) in zip(item.centres, item.radii, strict=True))
    return f'<path class="{look}" d="{_d(item.lines, closed=bool(item.fill))}"{more}/>'


def _look(item: draw.Path | draw.Discs) -> str:
    more = f' stroke-width="{_n(item.width)}"' if item.stroke and item.width != 1 else ""
    if isinstance(item, draw.Path) and item.dash:
        more += f' stroke-dasharray="{" ".join(map(_n, item.dash))}"'
    return more + (f' fill-opacity="{_n(item.opacity)}"' if item.opacity != 1 else "")


def _d(lines: Iterable[tuple[draw.Point, ...]], *, closed: bool) -> str:
    """Return path data."""
    return "".join("M" + "L".join(f"{_n(x)} {_n(y)}" for x, y in line) + "Z" * closed
                   for line in lines)


def _label(label: draw.Label) -> str:
    x, y = label.at
    look = f"f-{label.colour}" + (" b" if label.bold else "")
    anchor = "" if label.anchor == "start" else f' text-anchor="{label.anchor}"'
    turned = f' transform="rotate(-90 {_n(x)} {_n(y)})"' if label.turned else ""
    return (f'<text class="{look}" x="{_n(x)}" y="{_n(y)}" font-size="{_n(label.size)}"{anchor}'
            f"{turned}>{escape(printable(label.text))}</text>")


def _n(value: float) -> str:
    """Return a number with at most one decimal; one that is not finite is an error."""
    if not math.isfinite(value):
        raise ValueError(f"{value} in a drawing")
    text = f"{value:.1f}".rstrip("0").rstrip(".") if abs(value) >= 2 else f"{value:.2f}".rstrip(
        "0").rstrip(".")
    return "0" if text in ("-0", "") else text
