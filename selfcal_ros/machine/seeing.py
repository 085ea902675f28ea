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
from selfcal_ros.vision.images import Picture

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
                picture, image_or_offsets.stamp_ns or stamp_ns
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
        full = (self._settings.full_scale if self._settings else 0) or int(
            np.iinfo(pixels.dtype).max
        )
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
        return Picture(pixels, int(np.iinfo(pixels.dtype).max))


def commonest_rejections(rejected: Mapping[str, int]) -> str:
    """Return the commonest reasons for rejections, to be appended to a sentence."""
    commonest = Counter(rejected).most_common(3)
    reasons = ", ".join(f"{reason} {count}" for reason, count in commonest)
    return f" (rejected: {reasons})" if reasons else ""


def _kind_text(kind: tuple[object, ...]) -> str:
    dtype, height, width = kind
    return f"{width} x {height} {dtype}"


def _detection(offset: Offset, stamp_ns: int) -> Detection:
    if not np.isfinite([offset.x, offset.y, offset.theta or 0.0]).all():
        raise MachineError(
            f"an offset is x {offset.x}, y {offset.y}, theta {offset.theta}",
            "machine.offsets",
            "leave out what is not seen",
        )
    m, n = offset.mark or (0, 0)
    is_line = offset.theta is not None
    return Detection(
        stamp_ns=offset.stamp_ns or stamp_ns,
        kind=int(Kind.ANGULAR if is_line else Kind.GRID),
        has_id=(offset.line if is_line else offset.mark) is not None,
        m=int(m),
        n=int(n),
        k=int(offset.line or 0),
        offset_x=float(offset.x),
        offset_y=float(offset.y),
        offset_theta=float(offset.theta or 0.0),
        sigma=float(offset.sigma),
        score=float(offset.score),
    )
