# SPDX-License-Identifier: Apache-2.0
"""A camera of the operating system, through OpenCV."""

from typing import Any

import numpy as np

from selfcal_ros.machine.interface import Image, MachineError

STALE = 3
"""Frames that are dropped before an exposure: drivers keep some."""


class VideoCamera:
    """A camera that OpenCV's VideoCapture opens.

    Parameters
    ----------
    source : int or str
        Number of the camera, or device, file or URL of a stream.
    width, height : int
        Size to ask for, px; 0 = that of the driver.

    Raises
    ------
    MachineError
        If it cannot be opened.
    """

    def __init__(self, source: int | str, width: int = 0, height: int = 0) -> None:
        import cv2  # extra camera

        self._where = f"camera {source}"
        self._capture: Any = cv2.VideoCapture(source)
        if not self._capture.isOpened():
            raise MachineError("it cannot be opened", self._where,
                               "check number, cable and permissions (group video)")
        for name, value in ((cv2.CAP_PROP_FRAME_WIDTH, width), (cv2.CAP_PROP_FRAME_HEIGHT, height)):
            if value:
                self._capture.set(name, value)
        self._capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)

    def image(self) -> Image:
        """Drop the frames that were exposed before, and return the next one."""
        for _ in range(STALE):
            self._capture.grab()
        good, frame = self._capture.read()
        if not good:
            raise MachineError("no image", self._where, "check the cable")
        return Image(grey(frame))

    def close(self) -> None:
        """Release the camera."""
        self._capture.release()


def grey(frame: np.ndarray) -> np.ndarray:
    """Return a frame as grey values (h, w); the mean of the channels of a coloured one."""
    frame = np.asarray(frame)
    if frame.ndim == 2:
        return frame
    return np.rint(frame[:, :, :3].mean(axis=2)).astype(frame.dtype)
