# SPDX-License-Identifier: Apache-2.0
"""The machine of cell.py with a camera: replace `picture` by yours.

selfcal measure examples/camera_plan.yaml examples/camera_cell.yaml -o measured --yes
"""

import numpy as np
from cell import Stage

from selfcal_ros.machine import Image

PIXEL_M, RADIUS_PX = 2e-6, 12.5
WIDTH, HEIGHT = 161, 151


def picture(x: float, y: float, rng: np.random.Generator) -> np.ndarray:
    """Return the image of a dark disc at the offset (x, y) from the optical axis, m.

    The axis is the centre of the image; columns run along +x, rows along -y.
    """
    row, column = np.mgrid[:HEIGHT, :WIDTH]
    right = column - (WIDTH - 1) / 2 - x / PIXEL_M
    up = (HEIGHT - 1) / 2 - row - y / PIXEL_M
    inside = 1 / (1 + np.exp(np.minimum(1.7 * (np.hypot(right, up) - RADIUS_PX), 50)))
    return np.clip(200 - 150 * inside + rng.normal(0, 1, row.shape), 0, 255).astype(
        np.uint8
    )


class CameraStage(Stage):
    """Shows images instead of finding marks by itself."""

    def __init__(self, marks: int = 3, pitch: float = 0.01) -> None:
        super().__init__(marks, pitch)
        self._rng = np.random.default_rng(1)

    def image(self) -> Image:
        """Expose now."""
        nearest = min(
            map(self.seen, self._marks.values()), key=lambda at: np.hypot(*at)
        )
        return Image(picture(*nearest, self._rng))
