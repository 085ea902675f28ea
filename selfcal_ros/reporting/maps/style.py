# SPDX-License-Identifier: Apache-2.0
"""Colours, text and round numbers that the pictures share; readable in grey and colour-blind."""

import math
from functools import cache
from typing import Any

from matplotlib.colors import Colormap, LinearSegmentedColormap
from matplotlib.font_manager import FontProperties, findfont, get_font

INK = "#16202a"
"""Measured values."""
TRUTH = "#d55e00"
"""A known truth: the vermilion of Okabe and Ito, distinct from blue and ink to everyone."""
BAND = "#56b4e9"
"""Uncertainty."""
BAND_EDGE = "#0072b2"
GRID = "#c4ccd4"
UNKNOWN_SITE = "#e3e3e3"

RC: dict[Any, Any] = {
    "font.family": "DejaVu Sans", "font.size": 10, "axes.titlesize": 11, "axes.edgecolor": INK,
    "axes.labelcolor": INK, "text.color": INK, "xtick.color": INK, "ytick.color": INK,
    "axes.linewidth": 0.8, "svg.hashsalt": "selfcal", "svg.fonttype": "path",
    "text.parse_math": False, "savefig.facecolor": "white", "figure.facecolor": "white"}
"""Settings of every picture; the fixed salt makes SVG files repeatable."""


def error_colours() -> Colormap:
    """Return white to blue, light enough for ink on top; unknown sites grey."""
    colours = LinearSegmentedColormap.from_list(
        "error", ["#ffffff", "#deebf7", "#b5d3ea", "#7fb4dc", "#5a9bd0"])
    return colours.with_extremes(bad=UNKNOWN_SITE)


def drawable(text: object, limit: int = 300) -> str:
    """Return `text` as one line of characters that the font has, cut at `limit`."""
    known = _characters()
    line = "".join(c if c.isprintable() and c in known else "?" for c in str(text)[:limit + 1])
    return line if len(line) <= limit else line[:limit - 1] + "…"


@cache
def _characters() -> frozenset[str]:
    """Return the characters that the font has."""
    font = get_font(findfont(FontProperties(family="DejaVu Sans")))
    return frozenset(chr(code) for code, glyph in font.get_charmap().items() if glyph)


def round_down(value: float) -> float:
    """Return the largest of 1, 2, 5 times a power of ten that is not above `value` > 0."""
    power = 10.0 ** math.floor(math.log10(value))
    return next((step * power for step in (5, 2) if step * power <= value * (1 + 1e-12)), power)
