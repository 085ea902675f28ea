# SPDX-License-Identifier: Apache-2.0
"""What an image shows that repeats: for the advice where no mark of the given size was found."""

from dataclasses import dataclass
from statistics import median_high

import numpy as np
from scipy import ndimage

SMALLEST = 4
"""Smallest side of a spot, px: less is noise."""
ALIKE = 0.3
"""Spots whose sides differ from their median by less than this part are alike."""
LARGEST = 0.5
"""Largest side of a spot, over the shorter side of the image."""

ALTERNATING = 0.1
"""Difference of rows, columns or diagonals in a block of 2 x 2 pixels, over the spread of all
pixels, above which it is not chance."""
AGREEING = 0.5
"""Part of the blocks that differ one way, less those that differ the other way, above which it is
not the edges of marks: with marks of 5 px every 6 px it is a third."""


@dataclass(frozen=True)
class Spots:
    """Spots of one size in an image: their side, px, whether they are dark, and their number."""

    side_px: float
    polarity: str
    number: int


def spots_in(image: np.ndarray) -> Spots | None:
    """Return the most frequent kind of spots in an image (h, w); None if there are none.

    Dark and bright parts about a threshold between the two (Otsu) are compared: those of the
    marks are small, most of them alike, and do not reach the border of the image. Parts of noise
    are of all sizes, and specks cover more of the image than they do.
    """
    level = _threshold(image)
    if level is None:
        return None
    kinds = [
        spots
        for polarity, mask in (("dark", image <= level), ("bright", image > level))
        if (spots := _alike(mask, polarity)) is not None
    ]
    return max(kinds, key=lambda spots: spots.number, default=None)


def alternates(image: np.ndarray) -> bool:
    """Return whether every other row, column or diagonal is brighter, beside the marks as well.

    Such are the raw values of a colour camera. Sharp marks of odd side at an even pitch change the
    means of every other row and column as well, but only blocks at their edges differ.
    """
    height, width = (size // 2 * 2 for size in image.shape)
    if not height * width:
        return False
    a, b, c, d = (
        image[row:height:2, column:width:2].astype(float)
        for row in (0, 1)
        for column in (0, 1)
    )
    least = ALTERNATING * image.std()
    differences = ((a + b - c - d) / 2, (a - b + c - d) / 2, (a - b - c + d) / 2)
    return any(
        abs(np.mean(difference > least) - np.mean(difference < -least)) > AGREEING
        for difference in differences
    )


def _threshold(image: np.ndarray) -> float | None:
    """Return the grey value between dark and bright that separates them best; None if all are one.

    The variance between the two classes is the largest (Otsu 1979).
    """
    counts, edges = np.histogram(image, bins=256)
    if np.count_nonzero(counts) < 2:
        return None
    values = (edges[:-1] + edges[1:]) / 2
    below = np.cumsum(counts)[:-1]
    above = image.size - below
    total = float(counts @ values)
    sums = np.cumsum(counts * values)[:-1]
    mean_below = sums / np.maximum(below, 1)
    mean_above = (total - sums) / np.maximum(above, 1)
    between = below * above * np.square(mean_above - mean_below)
    return float(edges[1:-1][np.argmax(between)])


def _alike(mask: np.ndarray, polarity: str) -> Spots | None:
    labels, number = ndimage.label(mask)
    if not number:
        return None
    areas = np.bincount(labels.ravel())[1:]
    sides, spot_areas = [], []
    speck_area = 0
    for (rows, columns), area in zip(
        ndimage.find_objects(labels), areas.tolist(), strict=True
    ):
        inside = (
            rows.start > 0
            and columns.start > 0
            and rows.stop < mask.shape[0]
            and columns.stop < mask.shape[1]
        )
        side = (rows.stop - rows.start + columns.stop - columns.start) / 2
        if side < SMALLEST:
            speck_area = speck_area + area
        elif inside and side <= LARGEST * min(mask.shape):
            sides.append(side)
            spot_areas.append(area)
    if not sides:
        return None
    typical = median_high(sides)  # one of them, so that it is like itself
    alike = np.abs(np.array(sides) - typical) <= ALIKE * typical
    if 2 * alike.sum() < len(sides) or np.sum(spot_areas, where=alike) < speck_area:
        return None
    return Spots(float(np.mean(sides, where=alike)), polarity, int(alike.sum()))
