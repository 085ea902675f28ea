# SPDX-License-Identifier: Apache-2.0
"""Grey values of sensor_msgs/Image and CompressedImage, of rosbags or rclpy, and of encoded files.

The fields are checked before memory is allocated.
"""

import io
import warnings
from collections.abc import Buffer, Callable
from typing import Any, NamedTuple

import numpy as np
from PIL import Image, UnidentifiedImageError

from selfcal_ros.errors import InputError, first_line

ENCODINGS = {"mono8": ("u1", 1), "mono16": ("u2", 1), "rgb8": ("u1", 3), "bgr8": ("u1", 3),
             "8UC1": ("u1", 1), "16UC1": ("u2", 1)}
"""Encoding -> type and number of its values."""
LARGEST = 1 << 26
"""Largest number of pixels of an image."""
EXPANSION = 1000
"""Largest number of pixels per byte of an encoded image: more is no picture of a camera."""
FORMATS = ("PNG", "JPEG", "TIFF")
"""Formats that are decoded. Pillow starts programs for some others."""
GREY_MODES = {"L": np.uint8, "I;16": np.uint16, "I;16B": np.uint16, "I": np.uint16}
"""Modes of Pillow with one value per pixel; those of 16 bits in I, too."""


class Picture(NamedTuple):
    """Grey values of an image, uint8 or uint16 (h, w), and that of a saturated pixel.

    Those of a colour image are the sums of its three channels: rounded means would add noise.
    `more_pages` is whether its file has others, which are not used.
    """

    values: np.ndarray
    full_scale: int
    more_pages: bool = False


Check = Callable[[tuple[int, int]], None]
"""Raises InputError if an image of this height and width must not be decoded."""


def any_size(_: tuple[int, int]) -> None:
    """Accept an image of any size."""


def picture_of(message: Any, check: Check = any_size) -> Picture:
    """Return the grey values of an image message.

    Raises
    ------
    InputError
        For an unknown encoding, sizes that do not match the data, data that cannot be decoded, or
        what `check` refuses.
    """
    if hasattr(message, "format"):
        return decoded(message.data, "image", check)
    if message.encoding not in ENCODINGS:
        raise InputError("image", f"encoding '{message.encoding[:40]}'",
                         f"publish one of {', '.join(ENCODINGS)}")
    kind, channels = ENCODINGS[message.encoding]
    height, width, step = message.height, message.width, message.step
    row = width * channels * int(kind[1])
    if not 0 < width * height <= LARGEST or step < row or len(message.data) < (
            (height - 1) * step + row):
        raise InputError("image", f"{len(message.data)} bytes in rows of {step} are not "
                         f"{width} x {height} pixels of {message.encoding}",
                         "correct width, height, step and data")
    check((height, width))
    data = np.frombuffer(memoryview(message.data).cast("B"), np.uint8)
    values = np.ndarray((height, width, channels), (">" if message.is_bigendian else "<") + kind,
                        data, strides=(step, channels * int(kind[1]), int(kind[1])))
    return _grey(values.astype(values.dtype.newbyteorder("=")))


def decoded(data: Buffer, where: str, check: Check = any_size) -> Picture:
    """Return the grey values of an encoded image, of its first page.

    Raises
    ------
    InputError
        If it cannot be decoded, or `check` refuses its size, before that.
    """
    octets = memoryview(data).cast("B")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # a bomb of decompression is announced by a warning
            with Image.open(io.BytesIO(octets), formats=FORMATS) as picture:
                if picture.width * picture.height > min(LARGEST, EXPANSION * len(octets)):
                    raise ValueError(f"{picture.width} x {picture.height} pixels in "
                                     f"{len(octets)} bytes")
                check((picture.height, picture.width))
                return _values(picture)._replace(more_pages=_has_second_page(picture))
    except InputError:
        raise
    except UnidentifiedImageError as error:  # its text has the address of an object
        raise InputError(where, "not an image, or damaged", "give PNG, JPEG or TIFF") from error
    except Exception as error:  # the decoders of Pillow raise many kinds
        raise InputError(where, f"cannot be decoded as an image ({first_line(error)[:80]})",
                         "give PNG, JPEG or TIFF of 8 or 16 bits") from error


def _has_second_page(picture: Image.Image) -> bool:
    try:
        picture.seek(1)
    except Exception:  # none, or a damaged one
        return False
    return True


def _values(picture: Image.Image) -> Picture:
    if picture.mode == "F":
        raise ValueError("floating-point values, whose black and white are unknown")
    if picture.mode not in GREY_MODES:
        return _grey(np.asarray(picture.convert("RGB")))
    values = np.asarray(picture)
    if values.min(initial=0) < 0 or values.max(initial=0) > np.iinfo(np.uint16).max:
        raise ValueError("values beyond 16 bits")
    return _grey(values.astype(GREY_MODES[picture.mode])[:, :, None])


def _grey(values: np.ndarray) -> Picture:
    full = int(np.iinfo(values.dtype).max)
    if values.shape[2] == 1:
        return Picture(values[:, :, 0], full)
    return Picture(values.sum(axis=2, dtype=np.uint16), 3 * full)
