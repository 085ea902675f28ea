# SPDX-License-Identifier: Apache-2.0
"""Drawings as SVG: in a page that includes the colours, on paper, or as a file of their own."""

import math
from collections.abc import Callable, Iterable
from html import escape

from selfcal_ros.errors import printable
from selfcal_ros.reporting.figures import drawing as draw

FONT = 'system-ui, "Segoe UI", "DejaVu Sans", sans-serif'
FIGURE_CSS = (
    f"svg.figure {{ display: block; width: 100%; height: auto; font-family: {FONT}; }}\n"
    "svg.figure path, svg.figure ellipse { fill: none; }\n"
    "svg.figure .b { font-weight: 600; }\n"
    "svg.figure .spot { fill: transparent; }\n"
    "svg.figure .spot:hover { fill: var(--truth); fill-opacity: .35; }\n"
)

Paint = Callable[[str, str], str]
"""Names of the colours of a fill and of a stroke -> attributes of the element."""


def by_class(fill: str, stroke: str) -> str:
    """Return the classes of two colours, which follow the reader's light or dark mode."""
    names = [f"f-{fill}"] * bool(fill) + [f"s-{stroke}"] * bool(stroke)
    return f' class="{" ".join(names)}"'


def by_value(fill: str, stroke: str) -> str:
    """Return two colours as they are on light paper."""
    light = {name: draw.COLOURS[name][0] if name else "none" for name in (fill, stroke)}
    return f' fill="{light[fill]}" stroke="{light[stroke]}"'


def css() -> str:
    """Return the rules that every figure needs, colours included."""
    return draw.variables_css() + FIGURE_CSS + draw.classes_css()


def inline_svg(drawing: draw.Drawing) -> str:
    """Return a drawing for a page that includes the rules of `css`."""
    return _svg(drawing)


def printed_svg(drawing: draw.Drawing) -> str:
    """Return a drawing for paper: light colours, no rules needed, no tooltips."""
    size = f' width="{_n(drawing.width)}" height="{_n(drawing.height)}"'
    return _svg(drawing, paint=by_value, attributes=f'{size} font-family="DejaVu Sans"')


def svg_file(drawing: draw.Drawing) -> str:
    """Return a drawing as a file that adapts to light and dark mode."""
    style = "".join((draw.variables_css("svg"), FIGURE_CSS, draw.classes_css()))
    size = f'width="{_n(drawing.width)}" height="{_n(drawing.height)}"'
    return (
        _svg(
            drawing,
            before=f'<style>{style}</style><rect class="f-paper" {size}/>\n',
            attributes=f' xmlns="http://www.w3.org/2000/svg" {size}',
        )
        + "\n"
    )


def _svg(
    drawing: draw.Drawing,
    *,
    paint: Paint = by_class,
    before: str = "",
    attributes: str = "",
) -> str:
    items = [
        _item(item, paint)
        for item in drawing.items
        if paint is by_class or not isinstance(item, draw.Spot)
    ]
    body = "\n".join(items)
    return (
        f'<svg{attributes} class="figure" role="img" '
        f'aria-label="{escape(printable(drawing.says))}" '
        f'viewBox="0 0 {_n(drawing.width)} {_n(drawing.height)}">\n{before}{body}\n</svg>'
    )


def _item(item: draw.Item, paint: Paint) -> str:
    if isinstance(item, draw.Label):
        return _label(item, paint)
    if isinstance(item, draw.Spot):
        return (
            f'<circle class="spot" cx="{_n(item.at[0])}" cy="{_n(item.at[1])}" '
            f'r="{_n(item.radius)}"><title>{escape(printable(item.title))}</title></circle>'
        )
    colours = paint(item.fill, item.stroke)
    more = _look(item)
    if isinstance(item, draw.Discs):
        return "".join(
            f'<ellipse{colours} cx="{_n(x)}" cy="{_n(y)}" rx="{_n(rx)}" ry="{_n(ry)}"{more}/>'
            for (x, y), (rx, ry) in zip(item.centres, item.radii, strict=True)
        )
    return f'<path{colours} d="{_d(item.lines, closed=bool(item.fill))}"{more}/>'


def _look(item: draw.Path | draw.Discs) -> str:
    more = (
        f' stroke-width="{_n(item.width)}"' if item.stroke and item.width != 1 else ""
    )
    if isinstance(item, draw.Path) and item.dash:
        more += f' stroke-dasharray="{" ".join(map(_n, item.dash))}"'
    return more + (f' fill-opacity="{_n(item.opacity)}"' if item.opacity != 1 else "")


def _d(lines: Iterable[tuple[draw.Point, ...]], *, closed: bool) -> str:
    """Return path data."""
    return "".join(
        "M" + "L".join(f"{_n(x)} {_n(y)}" for x, y in line) + "Z" * closed
        for line in lines
    )


def _label(label: draw.Label, paint: Paint) -> str:
    x, y = label.at
    if paint is by_class:
        look = f' class="f-{label.colour}{" b" if label.bold else ""}"'
    else:
        look = paint(label.colour, "") + (' font-weight="600"' if label.bold else "")
    anchor = "" if label.anchor == "start" else f' text-anchor="{label.anchor}"'
    turned = f' transform="rotate(-90 {_n(x)} {_n(y)})"' if label.turned else ""
    return (
        f'<text{look} x="{_n(x)}" y="{_n(y)}" font-size="{_n(label.size)}"{anchor}'
        f"{turned}>{escape(printable(label.text))}</text>"
    )


def _n(value: float) -> str:
    """Return a number with at most one decimal; one that is not finite is an error."""
    if not math.isfinite(value):
        raise ValueError(f"{value} in a drawing")
    decimals = 1 if abs(value) >= 2 else 2
    text = f"{value:.{decimals}f}".rstrip("0").rstrip(".")
    return "0" if text in ("-0", "") else text
