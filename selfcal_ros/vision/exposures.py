# SPDX-License-Identifier: Apache-2.0
"""A series of images into detections, the same live and from a bag; everything is counted."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from selfcal_ros.bagio.messages.to_model import stamp_ns
from selfcal_ros.collection.inputs import Detection
from selfcal_ros.errors import InputError, NoDataError, printable
from selfcal_ros.settings.detector import DetectorSettings
from selfcal_ros.vision.coded import CodedPlate
from selfcal_ros.vision.detector import (
    Judged,
    Mark,
    MarkDetector,
    MarkFault,
    told_apart,
)
from selfcal_ros.vision.images import Check, Picture, decoded, picture_of

SETTLED = 3
"""Consecutive images that fix the camera and the size for all."""

MANY_REPEATED = 5
"""Images like the one before them from which a camera is said to give each twice."""
MOST_STAMPS = 100_000
"""Most stamps that are kept to refuse repeated images: an hour of 30 a second."""


Draw = Callable[[str, Picture, Sequence[Judged]], None]
"""Name of an image, the image, and its possible marks -> nothing."""


@dataclass
class Counts:
    """What became of the images and of the possible marks in them.

    Attributes
    ----------
    images, empty : int
        Images that were used, and those of them without any mark.
    refused : int
        Images that could not be used.
    repeated : int
        Images that are the one before them, pixel by pixel, under another stamp.
    paged : int
        Images whose file has further pages, which were not used.
    marks : int
        Detections.
    named : int or None
        Those of them with the id of their mark; None where no markers are looked for.
    contradicting : int
        Images whose markers do not lie as on the plate, so that none is believed.
    rejected : Counter
        Reason -> rejected marks.
    """

    images: int = 0
    empty: int = 0
    refused: int = 0
    repeated: int = 0
    paged: int = 0
    marks: int = 0
    named: int | None = None
    contradicting: int = 0
    rejected: Counter[str] = field(default_factory=Counter)

    @property
    def come_twice(self) -> bool:
        """Whether images come again under other stamps: the noise of a camera repeats in none."""
        return self.repeated >= MANY_REPEATED and 2 * self.repeated >= self.images - 1

    def values(self) -> dict[str, int]:
        """Return name -> number, the reasons last."""
        return {
            "images": self.images,
            "images_refused": self.refused,
            "images_without_marks": self.empty,
            "marks": self.marks,
            **({} if self.named is None else {"marks_with_ids": self.named}),
            **(
                {"images_with_contradicting_markers": self.contradicting}
                if self.contradicting
                else {}
            ),
            **({"images_repeated": self.repeated} if self.repeated else {}),
            **({"images_with_more_pages": self.paged} if self.paged else {}),
            **{
                f"rejected_{name}": count
                for name, count in sorted(self.rejected.items())
            },
        }


class ImageDetector:
    """Detect the marks of images in the order of their exposures.

    Parameters
    ----------
    settings : DetectorSettings
        Values of the parameters of mark_detector.
    where : str
        Place of these for errors.
    draw : callable, optional
        Called with the name of each image, the image, and its possible marks.

    Attributes
    ----------
    counts : Counts
        What became of the images.
    problems : Counter
        Line -> number of images that could not be used.
    """

    def __init__(
        self,
        settings: DetectorSettings,
        where: str = "mark_detector",
        draw: Draw | None = None,
    ) -> None:
        self._detector = MarkDetector(settings, where)
        self._coded = CodedPlate(settings.aruco, where) if settings.aruco else None
        self.counts = Counts()
        self.problems: Counter[str] = Counter()
        self.draw = draw
        # an image without marks, until there is a mark
        self._empty: Picture | None = None
        self._source = _Source()
        self._stamps: dict[int, None] = {}  # of the images used, in their order
        self._last: np.ndarray | None = None  # grey values of the image before

    def take(self, message: Any) -> list[Detection]:
        """Return the detections of an image message, row by row.

        Raises
        ------
        InputError
            If the image cannot be used, which is counted: unknown encoding, damaged, of another
            camera or size, the stamp of an earlier image, more possible marks than `max_marks`.
        """
        return self._detect(
            partial(picture_of, message),
            stamp_ns(message),
            "image",
            camera=str(message.header.frame_id),
        )

    def take_file(self, data: bytes, name: str, stamp: int) -> list[Detection]:
        """Return the detections of an image file exposed at `stamp`, ns; raises like `take`."""
        return self._detect(partial(decoded, data, name), stamp, name)

    def take_picture(self, picture: Picture, stamp: int) -> list[Detection]:
        """Return the detections of grey values exposed at `stamp`, ns; raises like `take`."""
        return self._detect(lambda check: picture, stamp, "image")

    def refuse_nothing(self, where: str, size_option: str = "--mark-size") -> None:
        """Refuse images in which no mark was found, and say what they show instead.

        `size_option` is the option of the command that states the size of a mark.

        Raises
        ------
        NoDataError
            If there is no detection.
        """
        counts = self.counts
        if counts.marks:
            return
        if not counts.images:
            why = "".join(f": {line}" for line, _ in self.problems.most_common(1))
            raise NoDataError(
                where,
                f"no image could be used{why}",
                "correct the images"
                if why
                else "record stage/image, or name the folder of the images",
            )
        raise NoDataError(
            where,
            *self._detector.nothing_found(
                self._empty, rejected=counts.rejected, size_option=size_option
            ),
        )

    def _detect(
        self,
        decode: Callable[[Check], Picture],
        stamp: int,
        name: str,
        *,
        camera: str = "",
    ) -> list[Detection]:
        try:
            if stamp in self._stamps:
                raise InputError(
                    name,
                    "its stamp is that of an earlier image",
                    "stamp each exposure by its own instant",
                )
            picture = decode(lambda shape: self._refuse_other((camera, *shape), name))
            if not self._source.agrees(source := (camera, *picture.values.shape)):
                raise other_source(self._source.image, source, name)
            judged, ids = self._identified(self._detector.judged(picture), picture)
        except InputError as error:
            self.counts.refused += 1
            self.problems[str(error)] += 1
            raise
        if self.draw is not None:
            self.draw(name if name != "image" else str(stamp), picture, judged)
        marks, rejected = told_apart(judged)
        detections = self._detector.detections(marks, picture.values.shape, stamp, ids)
        if not self.counts.marks and not detections:
            self._empty = picture
        self._stamps[stamp] = None
        if len(self._stamps) > MOST_STAMPS:
            del self._stamps[next(iter(self._stamps))]
        self.counts.repeated += self._last is not None and np.array_equal(
            self._last, picture.values
        )
        self._last = picture.values
        self.counts.paged += picture.more_pages
        self.counts.images += 1
        self.counts.empty += not detections
        self.counts.marks += len(detections)
        if self._coded is not None:
            named = sum(item.has_id for item in detections)
            self.counts.named = (self.counts.named or 0) + named
            self.counts.contradicting = self._coded.contradicting
        self.counts.rejected.update(rejected)
        return detections

    def _identified(
        self, judged: list[Judged], picture: Picture
    ) -> tuple[list[Judged], list[tuple[int, int] | None]]:
        """Return the possible marks without parts of markers, and the ids of the marks."""
        if self._coded is None:
            return judged, []
        marks = [
            candidate.found for candidate in judged if isinstance(candidate.found, Mark)
        ]
        id_of_mark = self._coded.identified(
            marks, picture, mirror=self._detector.settings.mirror
        )
        each_id = iter(id_of_mark)
        out = []
        for candidate in judged:
            identified = next(each_id) if isinstance(candidate.found, Mark) else None
            out.append(
                replace(candidate, found=identified)
                if isinstance(identified, MarkFault)
                else candidate
            )
        return out, [
            mark_id for mark_id in id_of_mark if not isinstance(mark_id, MarkFault)
        ]

    def _refuse_other(self, image: tuple, name: str) -> None:
        """Refuse an image of another camera or size than the settled one, before it is decoded.

        Stamps need not ascend: a single one in the future, or a clock that was set back, spoils no
        other image. Which of them count, the collector judges.
        """
        if self._source.settled and image != self._source.image:
            raise other_source(self._source.image, image, name)


def other_source(image: tuple, source: tuple, name: str) -> InputError:
    """Return the error that an image is of another camera, or of another size.

    Its centre would not be the optical axis of the others.
    """
    if image[0] != source[0]:
        return InputError(
            name,
            f"of the camera '{printable(source[0])}', earlier ones are of "
            f"'{printable(image[0])}' (frame_id)",
            "remap one of the two: a mark_detector has one camera",
        )
    old, new = (f"{width} x {height}" for _, height, width in (image, source))
    return InputError(
        name,
        f"{new} pixels, but earlier images have {old}",
        "record images of one size; the optical axis is their centre",
    )


@dataclass
class _Source:
    """Camera, height and width of the images: those of the first one, unless it was an odd one."""

    image: tuple = ()
    used: int = 0
    other: tuple = ()
    alike: int = 0

    @property
    def settled(self) -> bool:
        """Whether the first `SETTLED` images in a row of one kind have settled it."""
        return self.used >= SETTLED

    def agrees(self, image: tuple) -> bool:
        """Take the camera and the size of an image; return whether they are those of the images."""
        self.image = self.image or image
        if image != self.image:
            self.alike = self.alike + 1 if image == self.other else 1
            self.other = image
            if self.settled or self.alike < SETTLED:
                return False
            self.image, self.used = image, self.alike - 1
        self.used, self.alike = self.used + 1, 0
        return True
