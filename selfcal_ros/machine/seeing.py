# SPDX-License-Identifier: Apache-2.0
"""What a machine sees: images or offsets into detections; images that cannot be trusted."""

from collections import Counter
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from selfcal_ros.collection.inputs import Detection, Kind
from selfcal_ros.errors import InputError
from selfcal_ros.machine.interface import Image, MachineError, Offset
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.settings.detector import DetectorSettings
from selfcal_ros.vision.images import Picture, saturated_at

if TYPE_CHECKING:
    from selfcal_ros.vision.exposures import ImageDetector  # for its name

SATURATED = 0.5
"""Part of saturated pixels from which an image is refused."""
LEAST_RANGE = 0.01
"""Range of grey values over the full scale below which an image is black, or blank."""
MOVED_M = 1e-6
"""Smallest motion between two images that cannot be identical."""


class Eye:
    """Turns what a machine shows into detections.

    Parameters
    ----------
    settings : DetectorSettings or None
        How marks are found in images; None = the machine detects by itself.
    where : str
        Place of the settings, for errors.
    """

    def __init__(self, settings: DetectorSettings | None, where: str) -> None:
        self._settings, self._where = settings, where
        self._detector: ImageDetector | None = None
        self._before: tuple[np.ndarray, tuple[float, ...]] | None = None
        self._kind: tuple[object, ...] = ()  # type and size of the first image
        self.newest: np.ndarray | None = None

    @property
    def why(self) -> str:
        """What the detector rejected, to be appended to a sentence."""
        return (
            commonest_rejections(self._detector.counts.rejected)
            if self._detector
            else ""
        )

    def require(self, artifact: Artifact) -> None:
        """Refuse markers of another plate than this one; raises InputError."""
        if self._settings is not None:
            self._settings.require_plate(artifact, f"{self._where}: detector")

    def detections(
        self,
        image_or_offsets: Image | list[Offset],
        stamp_ns: int,
        position: tuple[float, ...],
    ) -> list[Detection]:
        """Return the detections in an image or of offsets.

        Parameters
        ----------
        image_or_offsets : Image or list of Offset
            What the machine returned.
        stamp_ns : int
            Its instant, unless it has its own.
        position : tuple of float
            The position of the stage, m and rad.

        Raises
        ------
        MachineError
            If the image is not one, is the last one again, black, or saturated.
        InputError
            If the cell has no detector for it.
        """
        if isinstance(image_or_offsets, Image):
            picture = self.trusted(image_or_offsets, position)
            return self._of_images().take_picture(
                picture, stamp_of(image_or_offsets, stamp_ns)
            )
        return [_detection(offset, stamp_ns) for offset in image_or_offsets]

    def _of_images(self) -> "ImageDetector":
        if self._detector is None:
            if self._settings is None:
                raise InputError(
                    f"{self._where}: detector",
                    "the machine returns images, and how marks are found in them is not stated",
                    "give detector: {mark: disc, mark_size: ...}, in m",
                )
            from selfcal_ros.vision.exposures import (
                ImageDetector,
            )  # scipy: for images alone

            self._detector = ImageDetector(self._settings, f"{self._where}: detector")
        return self._detector

    def trusted(self, image: Image, position: tuple[float, ...]) -> Picture:
        """Return the grey values of an image, after checks; raises MachineError."""
        pixels = np.asarray(image.pixels)
        if (
            pixels.ndim != 2
            or not pixels.size
            or pixels.dtype not in (np.uint8, np.uint16)
        ):
            raise MachineError(
                f"an image is {pixels.dtype} {pixels.shape}",
                "machine.image",
                "return grey values (h, w), uint8 or uint16",
            )
        kind = (pixels.dtype, *pixels.shape)
        self._kind = self._kind or kind
        if kind != self._kind:
            raise MachineError(
                f"an image is {_kind_text(kind)}, those before were {_kind_text(self._kind)}",
                "machine.image",
                "set the camera to one size and type; see whether it was reset",
            )
        saturated = saturated_at(pixels, int(np.iinfo(pixels.dtype).max))
        full = (self._settings.full_scale if self._settings else 0) or saturated
        last = self._before
        self._before = (pixels.copy(), position)
        self.newest = self._before[0]
        if (
            last is not None
            and np.array_equal(last[0], pixels)
            and np.abs(np.subtract(last[1][:2], position[:2])).max() > MOVED_M
        ):
            raise MachineError(
                "the camera returns the last image again after a move, or is late by one frame",
                "machine.image",
                "let it expose when it is asked (software trigger), or drop a frame",
            )
        if (pixels >= full).mean() > SATURATED:
            raise MachineError(
                "the image is saturated",
                "machine.image",
                "shorten the exposure, or reduce the light",
            )
        if float(pixels.max()) - float(pixels.min()) < LEAST_RANGE * full:
            shade = "black" if pixels.max() < 0.1 * full else "blank"
            raise MachineError(
                f"the image is {shade}, grey values up to {pixels.max()} of {full}",
                "machine.image",
                "check light, shutter, lens cap and exposure time, and full_scale of the detector",
            )
        return Picture(pixels, saturated)


def commonest_rejections(rejected: Mapping[str, int]) -> str:
    """Return the commonest reasons for rejections, to be appended to a sentence."""
    commonest = Counter(rejected).most_common(3)
    reasons = ", ".join(f"{reason} {count}" for reason, count in commonest)
    return f" (rejected: {reasons})" if reasons else ""


def _kind_text(kind: tuple[object, ...]) -> str:
    dtype, height, width = kind
    return f"{width} x {height} {dtype}"


def stamp_of(seen: Image | Offset, called_ns: int) -> int:
    """Return the stamp of an image or offset, ns; without one that of the call.

    Raises
    ------
    MachineError
        If it is not a number.
    """
    if not seen.stamp_ns:
        return called_ns
    try:
        return int(seen.stamp_ns)  # time.time() * 1e9 is no whole number
    except (TypeError, ValueError, OverflowError) as error:
        raise MachineError(
            f"a stamp is {seen.stamp_ns!r:.50}",
            "machine",
            "give ns since 1970, or no stamp",
        ) from error


def _detection(offset: Offset, called_ns: int) -> Detection:
    """Return an offset as a detection; raises MachineError for values of another kind."""
    stamp_ns = stamp_of(offset, called_ns)
    is_line = offset.theta is not None
    try:
        m, n = map(_whole, offset.mark or (0, 0))
        detection = Detection(
            stamp_ns=stamp_ns,
            kind=int(Kind.ANGULAR if is_line else Kind.GRID),
            has_id=(offset.line if is_line else offset.mark) is not None,
            m=m,
            n=n,
            k=_whole(offset.line or 0),
            offset_x=float(offset.x),
            offset_y=float(offset.y),
            offset_theta=float(offset.theta or 0.0),
            sigma=float(offset.sigma),
            score=float(offset.score),
        )
    except (TypeError, ValueError, OverflowError) as error:
        raise MachineError(
            f"it returns {offset!r:.200}",
            "machine.offsets",
            "give m and rad, mark as two whole numbers (m, n), line as one",
        ) from error
    offsets = detection.offset_x, detection.offset_y, detection.offset_theta
    if not np.isfinite(offsets).all():
        raise MachineError(
            f"an offset is x {offset.x}, y {offset.y}, theta {offset.theta}",
            "machine.offsets",
            "leave out what is not seen",
        )
    return detection


def _whole(number: float) -> int:
    """Return a whole number; ValueError for another one, which would name another mark."""
    if int(number) != number:
        raise ValueError(number)
    return int(number)
