#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""A cell that publishes images instead of mark detections: replace `picture` by your camera.

It is the cell of cell.py, which tells where the encoders say the stage is; mark_detector finds the
marks. Run it with

    .venv/bin/python examples/camera_cell.py
    .venv/bin/selfcal up --plan PLAN.yaml --params NODES.yaml --detect     # another terminal

where NODES.yaml says `mark_detector: {ros__parameters: {pixel_size: 2.0e-6, mark_size: 50.0e-6}}`.
"""

import numpy as np
from cell import Cell, main
from rclpy.qos import QoSProfile, ReliabilityPolicy
from selfcal_msgs.msg import MarkDetection
from sensor_msgs.msg import Image

PIXEL_M, RADIUS_PX = 2e-6, 12.5
WIDTH, HEIGHT = 161, 151


def picture(x: float, y: float, rng: np.random.Generator) -> np.ndarray:
    """Return the image of a dark disc at the offset (x, y) from the optical axis, m.

    The axis is the centre of the image; columns run along +x, rows along -y.
    """
    row, column = np.mgrid[:HEIGHT, :WIDTH]
    right = column - (WIDTH - 1) / 2 - x / PIXEL_M
    up = (HEIGHT - 1) / 2 - row - y / PIXEL_M
    inside = 1 / (1 + np.exp(1.7 * (np.hypot(right, up) - RADIUS_PX)))
    return np.clip(200 - 150 * inside + rng.normal(0, 1, row.shape), 0, 255).astype(np.uint8)


class CameraCell(Cell):
    """The cell of cell.py with a camera."""

    def __init__(self, **kwargs: object) -> None:
        super().__init__(**kwargs)
        self._rng = np.random.default_rng(1)
        self._images = self.create_publisher(Image, "stage/image", QoSProfile(
            depth=100, reliability=ReliabilityPolicy.RELIABLE))

    def _expose(self, seen: MarkDetection) -> None:
        if seen.kind != MarkDetection.GRID:  # lines have their own reader
            super()._expose(seen)
            return
        values = picture(seen.offset_x, seen.offset_y, self._rng)
        image = Image(height=HEIGHT, width=WIDTH, encoding="mono8", step=WIDTH,
                      data=values.tobytes())
        image.header.stamp = self.get_clock().now().to_msg()  # the instant of exposure
        image.header.frame_id = "camera"
        self._images.publish(image)


if __name__ == "__main__":
    main(CameraCell)
