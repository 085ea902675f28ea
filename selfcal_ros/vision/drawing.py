# SPDX-License-Identifier: Apache-2.0
"""An image with circles around the marks that were found in it, as PNG."""

import io
from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw

RADIUS = 0.75
"""Radius of a circle, in sizes of the mark."""
COLOUR, AXIS, REJECTED = (0, 190, 90), (0, 160, 255), (255, 60, 0)


def circled(
    pixels: np.ndarray,
    marks: Sequence[tuple[float, float]],
    size_px: float,
    rejected: Sequence[tuple[float, float, str]] = (),
) -> bytes:
    """Return an image as PNG, stretched to its range, with a circle around every mark.

    A square with a reason stands around what was rejected. A cross shows the optical axis, the
    centre of the image.

    Parameters
    ----------
    pixels : array (h, w)
        Grey values.
    marks : sequence of (u, v)
        Columns and rows of the marks.
    size_px : float
        Size of a mark.
    rejected : sequence of (u, v, reason)
        Possible marks that were rejected.
    """
    low, high = float(pixels.min()), float(pixels.max())
    grey = ((pixels - low) * (255 / max(high - low, 1.0))).astype(np.uint8)
    picture = Image.fromarray(grey).convert("RGB")
    draw = ImageDraw.Draw(picture)
    line = max(1, round(size_px / 12))
    radius = RADIUS * size_px
    for u, v in marks:
        draw.ellipse(
            [u - radius, v - radius, u + radius, v + radius], outline=COLOUR, width=line
        )
    for u, v, reason in rejected:
        draw.rectangle(
            [u - radius, v - radius, u + radius, v + radius],
            outline=REJECTED,
            width=line,
        )
        draw.text((u - radius, v + radius + line), reason, fill=REJECTED)
    u = (pixels.shape[1] - 1) / 2
    v = (pixels.shape[0] - 1) / 2
    arm = size_px / 2
    draw.line([u - arm, v, u + arm, v], fill=AXIS, width=line)
    draw.line([u, v - arm, u, v + arm], fill=AXIS, width=line)
    out = io.BytesIO()
    picture.save(out, "PNG")
    return out.getvalue()
