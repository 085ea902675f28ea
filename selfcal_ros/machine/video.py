# SPDX-License-Identifier: Apache-2.0
"""A camera of the operating system, through OpenCV.

Such a camera runs freely, and frames wait in buffers whose number no program is told: a frame that
comes at once was exposed before it was asked for. One that had to be waited for is fresh.
"""

import time
from typing import Any

import numpy as np

from selfcal_ros.machine.interface import Image, MachineError

WATCHED_S = 1.0
"""Time in which the period of the frames is measured."""
LEAST_FRAMES = 4
"""Frames by which it is measured at least."""
WAITED = 0.25
"""Part of the period from which a frame had to be waited for."""
FRESH = 2
"""Frames that had to be waited for: the first of them may have been exposed before."""
PATIENCE_S = 10.0
"""Longest wait for a fresh frame."""


class VideoCamera:
    """A camera that OpenCV's VideoCapture opens.

    Parameters
    ----------
    source : int or str
        Number of the camera, or device, file or URL of a stream. Of a file or a sequence of image
        files (``frame_%03d.png``) each image is the next one.
    width, height : int
        Size to ask for, px; 0 = that of the driver.

    Raises
    ------
    MachineError
        If it cannot be opened, or does not have the size.
    """

    def __init__(self, source: int | str, width: int = 0, height: int = 0) -> None:
        import cv2  # extra camera

        self._where = f"camera {source}"
        self._capture: Any = cv2.VideoCapture(source)
        if not self._capture.isOpened():
            raise MachineError(
                "it cannot be opened",
                self._where,
                "check number, cable and permissions (group video)",
            )
        for name, value, dimension in (
            (cv2.CAP_PROP_FRAME_WIDTH, width, "width"),
            (cv2.CAP_PROP_FRAME_HEIGHT, height, "height"),
        ):
            if value:
                self._capture.set(name, value)
                actual = round(self._capture.get(name))
                if actual != value:
                    raise MachineError(
                        f"its {dimension} is {actual} instead of {value} pixels",
                        self._where,
                        "give a size that it has",
                    )
        self._capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        self._is_live = self._capture.get(cv2.CAP_PROP_FRAME_COUNT) <= 0
        self._period_s = self._measured_period_s() if self._is_live else 0.0

    def _grab(self) -> float:
        """Take the next frame; return how long it had to be waited for, s."""
        began = time.monotonic()
        if not self._capture.grab():
            raise MachineError(
                "it returns no image any more",
                self._where,
                "check the cable and whether another program uses it"
                if self._is_live
                else "the file has ended",
            )
        return time.monotonic() - began

    def _measured_period_s(self) -> float:
        """Return the median time between two frames, once those that waited are taken."""
        began = time.monotonic()
        waits: list[float] = []
        ends: list[float] = []
        while len(ends) < LEAST_FRAMES or ends[-1] < WATCHED_S:
            waits.append(self._grab())
            ends.append(time.monotonic() - began)
        late = np.array(ends) > min(WATCHED_S / 2, ends[-LEAST_FRAMES])
        return float(np.median(np.array(waits)[late]))

    def image(self) -> Image:
        """Return a frame that was exposed after the call.

        Raises
        ------
        MachineError
            If none comes: the camera is disconnected.
        """
        began = time.monotonic()
        fresh = 0
        while fresh < (FRESH if self._is_live else 1):
            fresh += self._grab() >= WAITED * self._period_s
            if time.monotonic() - began > PATIENCE_S:
                raise MachineError(
                    f"no image is exposed after the call in {PATIENCE_S:g} s",
                    self._where,
                    "let it send fewer frames a second",
                )
        good, frame = self._capture.retrieve()
        if not good:
            raise MachineError(
                "an image cannot be decoded", self._where, "check the cable"
            )
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
