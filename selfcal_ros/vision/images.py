# SPDX-License-Identifier: Apache-2.0
"""Grey values of sensor_msgs/Image and CompressedImage, of rosbags or rclpy, and of encoded files.

The fields are checked before memory is allocated.
"""

import io
import math
import warnings
from collections.abc import Buffer, Callable
from typing import Any, NamedTuple

import numpy as np
from PIL import Image, UnidentifiedImageError

from selfcal_ros.errors import InputError, first_line

ENCODINGS = {
    "mono8": ("u1", 1),
    "mono16": ("u2", 1),
    "rgb8": ("u1", 3),
    "bgr8": ("u1", 3),
    "8UC1": ("u1", 1),
    "16UC1": ("u2", 1),
}
"""Encoding -> type and number of its values."""
LARGEST = 1 << 26
"""Largest number of pixels of an image."""
EXPANSION = 1000
"""Largest number of pixels per byte of an encoded image: more is not a picture of a camera."""
FORMATS = ("PNG", "JPEG", "TIFF")
"""Formats that are decoded. Pillow starts programs for some others."""
SAVE_AS = "give PNG, JPEG or TIFF: grey of 8 or 16 bits, or colour of 8"
ORIENTATION, BITS, PHOTOMETRIC, SAMPLE_FORMAT = 274, 258, 262, 339
COMPRESSION, SAMPLES, STRIP_BYTES = 259, 277, 279
"""Tags of EXIF and TIFF."""
WHITE_IS_ZERO, SIGNED, UNCOMPRESSED = 0, 2, 1
"""Values of PHOTOMETRIC, SAMPLE_FORMAT and COMPRESSION."""
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
        raise InputError(
            "image",
            f"encoding '{message.encoding[:40]}'",
            f"publish one of {', '.join(ENCODINGS)}",
        )
    kind, channels = ENCODINGS[message.encoding]
    height, width, step = message.height, message.width, message.step
    row = width * channels * int(kind[1])
    if (
        not 0 < width * height <= LARGEST
        or step < row
        or len(message.data) < ((height - 1) * step + row)
    ):
        raise InputError(
            "image",
            f"{len(message.data)} bytes in rows of {step} are not {width} x {height} "
            f"pixels of {message.encoding}",
            "correct width, height, step and data",
        )
    check((height, width))
    data = np.frombuffer(memoryview(message.data).cast("B"), np.uint8)
    values = np.ndarray(
        (height, width, channels),
        (">" if message.is_bigendian else "<") + kind,
        data,
        strides=(step, channels * int(kind[1]), int(kind[1])),
    )
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
            # a bomb of decompression is announced by a warning
            warnings.simplefilter("error")
            with Image.open(io.BytesIO(octets), formats=FORMATS) as picture:
                if picture.width * picture.height > min(
                    LARGEST, EXPANSION * len(octets)
                ):
                    raise ValueError(
                        f"{picture.width} x {picture.height} pixels in {len(octets)} bytes"
                    )
                check((picture.height, picture.width))
                return _values(picture)._replace(more_pages=_has_second_page(picture))
    except InputError:
        raise
    except UnidentifiedImageError as error:  # its text has the address of an object
        raise InputError(
            where, "not an image of a known kind, or damaged", SAVE_AS
        ) from error
    except Exception as error:  # the decoders of Pillow raise many kinds
        raise InputError(
            where, f"cannot be decoded as an image ({first_line(error)[:80]})", SAVE_AS
        ) from error


def _has_second_page(picture: Image.Image) -> bool:
    try:
        picture.seek(1)
    except Exception:  # none, or a damaged one
        return False
    return True


def _values(picture: Image.Image) -> Picture:
    """Return the grey values; ValueError for those that Pillow would turn, cut or invert."""
    stored = str(getattr(picture, "tile", ""))  # before it is decoded
    tags = getattr(picture, "tag_v2", {})  # of a TIFF
    bits = max(tags.get(BITS, (1,)))
    signed = SIGNED in tags.get(SAMPLE_FORMAT, ())
    if picture.mode == "F":
        raise ValueError("floating-point values, whose black and white are unknown")
    if picture.getexif().get(ORIENTATION, 1) != 1:
        raise ValueError(
            "its EXIF orientation is not 1: which way up the camera saw is unknown"
        )
    if tags.get(PHOTOMETRIC) == WHITE_IS_ZERO and bits > 8:
        raise ValueError("white is 0")
    if signed and bits <= 8:
        raise ValueError("signed values")
    row = math.ceil(picture.width * bits * tags.get(SAMPLES, 1) / 8)
    stored_rows = sum(tags.get(STRIP_BYTES, ())) // max(row, 1)
    if tags.get(COMPRESSION) == UNCOMPRESSED and stored_rows > picture.height:
        raise ValueError(f"{stored_rows} rows of pixels instead of {picture.height}")
    if (
        picture.has_transparency_data
        and np.asarray(picture.convert("RGBA"))[:, :, 3].min() < 255
    ):
        raise ValueError("transparent pixels")
    if picture.mode not in GREY_MODES:
        if ";16" in stored:
            raise ValueError(f"16 bits in the mode {picture.mode}")
        return _grey(np.asarray(picture.convert("RGB")))

    values = np.asarray(picture)
    if values.min(initial=0) < 0 or values.max(initial=0) > np.iinfo(np.uint16).max:
        raise ValueError("values beyond 16 bits")
    grey = _grey(values.astype(GREY_MODES[picture.mode])[:, :, None])
    if 8 < bits <= 16:
        full = (1 << (bits - signed)) - 1
        if bits == 16:  # of the file: those of the camera may be fewer
            full = saturated_at(grey.values, full)
        grey = grey._replace(full_scale=full)
    return grey


def _grey(values: np.ndarray) -> Picture:
    full = int(np.iinfo(values.dtype).max)
    if values.shape[2] == 1:
        return Picture(values[:, :, 0], saturated_at(values, full))
    return Picture(values.sum(axis=2, dtype=np.uint16), 3 * full)


def saturated_at(values: np.ndarray, full: int) -> int:
    """Return the value of a saturated pixel of a camera of 9 to 16 bits.

    That is the largest of the encoding, unless the image ends at the largest value of fewer bits,
    which are the low ones or the high ones: 4095 or 65520 of 12 bits.
    """
    largest = int(values.max(initial=0))
    bits = full.bit_length()
    ends = {
        end for n in range(9, bits) for end in (2**n - 1, full + 1 - 2 ** (bits - n))
    }
    return largest if largest in ends else full
