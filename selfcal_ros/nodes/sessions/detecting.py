# SPDX-License-Identifier: Apache-2.0
"""The session of mark_detector: images in, detections out, what became of them."""

import time
from typing import Any

from selfcal_ros.bagio.messages import from_model
from selfcal_ros.nodes.sessions.health import Diagnosis, Level, Ports
from selfcal_ros.reporting.summary.numbers import counted
from selfcal_ros.settings.detector import DetectorSettings
from selfcal_ros.units import MS_PER_S
from selfcal_ros.vision.detector import REMEDIES
from selfcal_ros.vision.exposures import ImageDetector

MANY_EMPTY = 5
"""Consecutive images without marks from which there is a warning."""


class DetectingSession:
    """Detect the marks of images and publish them.

    Parameters
    ----------
    settings : DetectorSettings
        Values of the parameters of mark_detector.
    ports : Ports
        Takes the fields of the output ``detection``.

    Raises
    ------
    InputError
        If the size of the pixels or marks is not set or impossible.
    """

    def __init__(self, settings: DetectorSettings, ports: Ports) -> None:
        self._settings, self._ports = settings, ports
        self._detector = ImageDetector(settings, "parameters of mark_detector")
        self._empty = 0  # consecutive images without marks
        self._busy_s = 0.0  # longest time for an image since the last diagnosis

    def take(self, message: Any) -> None:
        """Take an image message; raise InputError if it cannot be used."""
        began_s = time.thread_time()
        detections = self._detector.take(message)
        self._empty = 0 if detections else self._empty + 1
        for detection in detections:
            self._ports.publish(
                "detection", from_model.detection(detection, self._settings.frame_id)
            )
        self._busy_s = max(self._busy_s, time.thread_time() - began_s)

    def diagnosis(self) -> Diagnosis:
        """Return the numbers of images, marks and rejected marks."""
        counts = self._detector.counts
        values: dict[str, Any] = dict(counts.values())
        if self._busy_s:
            values["ms_per_image_max"] = f"{self._busy_s * MS_PER_S:.1f}"
        self._busy_s = 0.0
        if not counts.images:
            return Diagnosis(Level.WARN, "no image yet", values)
        if self._empty >= MANY_EMPTY:
            most = max(
                counts.rejected, key=lambda name: counts.rejected[name], default=""
            )
            why = (
                f", most rejected as {most}{f': {REMEDIES[most]}' if most in REMEDIES else ''}"
                if most
                else ", nothing looks like one: check mark, mark_size, pixel_size and polarity"
            )
            return Diagnosis(
                Level.WARN, f"no mark in the last {self._empty} images{why}", values
            )
        if 2 * counts.contradicting > counts.images:
            return Diagnosis(
                Level.WARN,
                f"the markers of {counts.contradicting} of {counted(counts.images, 'image')} do "
                "not lie as on the plate that 'aruco' names: their marks have no ids",
                values,
            )
        if counts.come_twice:
            return Diagnosis(
                Level.ERROR,
                f"{counts.repeated} of {counted(counts.images, 'image')} are the one before them, "
                "pixel by pixel, under another stamp: publish each exposure once, or let the "
                "camera expose for each",
                values,
            )
        return Diagnosis(
            Level.OK,
            f"{counted(counts.marks, 'mark')} in {counted(counts.images, 'image')}",
            values,
        )
