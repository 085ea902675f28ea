# SPDX-License-Identifier: Apache-2.0
"""A series of images into detections, the same live and from a bag; everything is counted."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from selfcal_ros.collection.inputs import Detection
from selfcal_ros.collection.settings.detector import DetectorSettings
from selfcal_ros.errors import InputError
from selfcal_ros.messages.to_model import stamp_ns
from selfcal_ros.vision.detector import MarkDetector
from selfcal_ros.vision.images import Picture, decoded, picture_of


@dataclass
class Counts:
    """What became of the images and of the possible marks in them.

    Attributes
    ----------
    images, empty : int
        Images that were used, and those of them without any mark.
    refused : int
        Images that could not be used.
    marks : int
        Detections.
    rejected : Counter
        Reason -> rejected marks.
    """

    images: int = 0
    empty: int = 0
    refused: int = 0
    marks: int = 0
    rejected: Counter[str] = field(default_factory=Counter)

    def values(self) -> dict[str, int]:
        """Return name -> number, the reasons last."""
        return {"images": self.images, "images_refused": self.refused,
                "images_without_marks": self.empty, "marks": self.marks,
                **{f"rejected_{name}": count for name, count in sorted(self.rejected.items())}}


class ImageDetector:
    """Detect the marks of images in the order of their exposures.

    Parameters
    ----------
    settings : DetectorSettings
        Values of the parameters of mark_detector.
    where : str
        Place of these for errors.
    """

    def __init__(self, settings: DetectorSettings, where: str = "mark_detector") -> None:
        self._detector = MarkDetector(settings, where)
        self.counts = Counts()
        self._shape: tuple[int, ...] | None = None
        self._last_ns: int | None = None

    def take(self, message: Any) -> list[Detection]:
        """Return the detections of an image message, row by row.

        Raises
        ------
        InputError
            If the image cannot be used, which is counted: unknown encoding, damaged, another size
            than that of the first one, no later stamp than the one before.
        """
        return self._detect(lambda: picture_of(message), stamp_ns(message))

    def take_file(self, data: bytes, name: str, stamp: int) -> list[Detection]:
        """Return the detections of an image file exposed at `stamp`, ns; raises like `take`."""
        return self._detect(lambda: decoded(data, name), stamp)

    def _detect(self, decode: Callable[[], Picture], stamp: int) -> list[Detection]:
        try:
            picture = decode()
            self._check(stamp, picture)
        except InputError:
            self.counts.refused += 1
            raise
        self._shape, self._last_ns = picture.values.shape, stamp
        found, rejected = self._detector.detections(picture, stamp)
        self.counts.images += 1
        self.counts.empty += not found
        self.counts.marks += len(found)
        self.counts.rejected.update(rejected)
        return found

    def _check(self, stamp: int, picture: Picture) -> None:
        """Refuse an image of another size, whose centre is not the axis, and a repeated one."""
        if self._shape is not None and picture.values.shape != self._shape:
            old, new = (f"{shape[1]} x {shape[0]}" for shape in (self._shape, picture.values.shape))
            raise InputError("image", f"{new} pixels, but the first image has {old}",
                             "record images of one size; the optical axis is their centre")
        if self._last_ns is not None and stamp <= self._last_ns:
            raise InputError("image", "its stamp is not later than that of the image before",
                             "stamp each exposure by its own instant, publish in their order")
