# SPDX-License-Identifier: Apache-2.0
"""Where the items of a drawing lie: what is cut off, which words lie on each other."""

from selfcal_ros.reporting.figures.drawing import (
    Discs,
    Drawing,
    Item,
    Label,
    Path,
    Spot,
)
from selfcal_ros.reporting.figures.parts import text_width


def extent(item: Item) -> tuple[float, float, float, float]:
    """Return the smallest and largest x and y of an item; words by a cautious width."""
    if isinstance(item, Path):
        points = [point for line in item.lines for point in line]
    elif isinstance(item, Discs):
        points = [
            (x + a * rx, y + a * ry)
            for (x, y), (rx, ry) in zip(item.centres, item.radii, strict=True)
            for a in (-1, 1)
        ]
    elif isinstance(item, Spot):
        return extent(Discs((item.at,), ((0.0, 0.0),)))
    else:
        x, y = item.at
        width = text_width(item.text, item.size) * 0.9
        start = {"start": 0.0, "middle": 0.5, "end": 1.0}[item.anchor] * width
        if item.turned:
            return x - item.size, x, y + start - width, y + start
        return x - start, x - start + width, y - 0.8 * item.size, y + 0.25 * item.size
    return (
        min(p[0] for p in points),
        max(p[0] for p in points),
        min(p[1] for p in points),
        max(p[1] for p in points),
    )


def cut_off(drawing: Drawing) -> list[Item]:
    """Return the items that do not lie within the sheet."""

    def outside(item: Item) -> bool:
        left, right, top, bottom = extent(item)
        return (
            min(left, top) < -0.5
            or right > drawing.width + 0.5
            or bottom > drawing.height + 0.5
        )

    return [item for item in drawing.items if outside(item)]


def words_on_words(drawing: Drawing) -> list[tuple[str, str]]:
    """Return the pairs of labels that lie on each other."""
    boxes = [
        (item.text, extent(item)) for item in drawing.items if isinstance(item, Label)
    ]
    return [
        (text, other)
        for number, (text, (left, right, top, bottom)) in enumerate(boxes)
        for other, (a, b, c, d) in boxes[number + 1 :]
        if min(right, b) - max(left, a) >= 3 and min(bottom, d) - max(top, c) >= 3
    ]
