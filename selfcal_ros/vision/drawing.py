# SPDX-License-Identifier: Apache-2.0
"""An image with circles around the marks that were found in it, as PNG."""

import io
from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw

from selfcal_ros.vision.detector import Judged, Mark

RADIUS = 0.75
"""Radius of a circle, in sizes of the mark."""
COLOUR, AXIS, REJECTED = (0, 190, 90), (0, 160, 255), (255, 60, 0)


def circled(pixels: np.ndarray, judged: Sequence[Judged], size_px: float) -> bytes:
    """Return an image as PNG, stretched to its range, with a circle around every mark.

    A square with a reason stands around what was rejected. A cross shows the optical axis, the
    centre of the image.

    Parameters
    ----------
    pixels : array (h, w)
        Grey values.
    judged : sequence of Judged
        The marks, and what was rejected.
    size_px : float
        Size of a mark.
    """
    low, high = float(pixels.min()), float(pixels.max())
    grey = ((pixels - low) * (255 / max(high - low, 1.0))).astype(np.uint8)
    picture = Image.fromarray(grey).convert("RGB")
    draw = ImageDraw.Draw(picture)
    line = max(1, round(size_px / 12))
    radius = RADIUS * size_px
    for each in judged:
        u, v = each.u, each.v
        square = [u - radius, v - radius, u + radius, v + radius]
        if isinstance(each.found, Mark):
            draw.ellipse(square, outline=COLOUR, width=line)
            continue
        draw.rectangle(square, outline=REJECTED, width=line)
        draw.text((u - radius, v + radius + line), str(each.found), fill=REJECTED)
    u = (pixels.shape[1] - 1) / 2
    v = (pixels.shape[0] - 1) / 2
    arm = size_px / 2
    draw.line([u - arm, v, u + arm, v], fill=AXIS, width=line)
    draw.line([u, v - arm, u, v + arm], fill=AXIS, width=line)
    out = io.BytesIO()
    picture.save(out, "PNG")
    return out.getvalue()
