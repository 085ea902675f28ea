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

SETTLED = 3
"""Consecutive images that fix the size for all."""

MOST_STAMPS = 100_000
"""Most stamps that are kept to refuse repeated images: an hour of 30 a second."""


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
        self._size = _Size()
        self._stamps: dict[int, None] = {}  # of the images used, in their order

    def take(self, message: Any) -> list[Detection]:
        """Return the detections of an image message, row by row.

        Raises
        ------
        InputError
            If the image cannot be used, which is counted: unknown encoding, damaged, another size,
            the stamp of an earlier image.
        """
        return self._detect(lambda: picture_of(message), stamp_ns(message), "image")

    def take_file(self, data: bytes, name: str, stamp: int) -> list[Detection]:
        """Return the detections of an image file exposed at `stamp`, ns; raises like `take`."""
        return self._detect(lambda: decoded(data, name), stamp, name)

    def _detect(self, decode: Callable[[], Picture], stamp: int, name: str) -> list[Detection]:
        try:
            picture = decode()
            self._check(stamp, picture, name)
        except InputError:
            self.counts.refused += 1
            raise
        self._stamps[stamp] = None
        if len(self._stamps) > MOST_STAMPS:
            del self._stamps[next(iter(self._stamps))]
        found, rejected = self._detector.detections(picture, stamp)
        self.counts.images += 1
        self.counts.empty += not found
        self.counts.marks += len(found)
        self.counts.rejected.update(rejected)
        return found

    def _check(self, stamp: int, picture: Picture, name: str) -> None:
        """Refuse a repeated image, and one of another size, whose centre is not the axis.

        Stamps need not ascend: a single one in the future, or a clock that was set back, spoils no
        other image. Which of them count, the collector judges.
        """
        if stamp in self._stamps:
            raise InputError(name, "its stamp is that of an earlier image",
                             "stamp each exposure by its own instant")
        shape = picture.values.shape
        if not self._size.agrees(shape):
            old, new = (f"{size[1]} x {size[0]}" for size in (self._size.shape, shape))
            raise InputError(name, f"{new} pixels, but earlier images have {old}",
                             "record images of one size; the optical axis is their centre")


@dataclass
class _Size:
    """The size of the images: that of the first one, unless it was an odd one."""

    shape: tuple[int, ...] = ()
    used: int = 0
    other: tuple[int, ...] = ()
    alike: int = 0

    def agrees(self, shape: tuple[int, ...]) -> bool:
        """Take the size of an image; return whether it is that of the images.

        The first `SETTLED` images in a row of one size settle it.
        """
        self.shape = self.shape or shape
        if shape != self.shape:
            self.alike = self.alike + 1 if shape == self.other else 1
            self.other = shape
            if self.used >= SETTLED or self.alike < SETTLED:
                return False
            self.shape, self.used = shape, self.alike - 1
        self.used, self.alike = self.used + 1, 0
        return True
