# SPDX-License-Identifier: Apache-2.0
"""Pixels of messages and of encoded images; what is damaged is refused in one line."""

import io
import os
import struct
import subprocess
import zlib
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import EpsImagePlugin, Image

from selfcal_ros.errors import InputError
from selfcal_ros.vision.images import decoded, picture_of


def message(values, encoding, **more):
    return SimpleNamespace(
        **(
            {
                "height": values.shape[0],
                "width": values.shape[1],
                "encoding": encoding,
                "is_bigendian": 0,
                "step": values.strides[0],
                "data": values.tobytes(),
            }
            | more
        )
    )


GREY = np.arange(12, dtype=np.uint8).reshape(3, 4)


@pytest.mark.parametrize("kind, encoding", [("u1", "mono8"), ("<u2", "mono16")])
def test_grey_images(kind, encoding):
    values, full, _ = picture_of(message((GREY * 20).astype(kind), encoding))
    assert (values == GREY * 20).all() and values.dtype == np.dtype(kind)
    assert full == (255 if kind == "u1" else 65535)


def test_the_order_of_bytes_and_padded_rows_are_obeyed():
    big = (GREY.astype(np.uint16) * 1000).astype(">u2")
    padded = np.concatenate([big, np.zeros((3, 5), ">u2")], axis=1).astype(">u2")
    found = picture_of(
        message(
            big, "mono16", is_bigendian=1, data=padded.tobytes(), step=padded.strides[0]
        )
    )
    assert (found.values == big).all()


@pytest.mark.parametrize("encoding", ["rgb8", "bgr8"])
def test_colours_are_summed(encoding):
    colours = np.stack([GREY, GREY + 100, GREY + 200], axis=2)
    values, full, _ = picture_of(message(colours, encoding))
    assert (values == colours.sum(axis=2)).all() and full == 765


@pytest.mark.parametrize("kind, full", [(np.uint8, 255), (np.uint16, 65535)])
def test_encoded_images(kind, full):
    values = GREY.astype(kind) * 21
    file = io.BytesIO()
    Image.fromarray(values).save(file, "PNG")
    data = np.frombuffer(file.getvalue(), np.uint8)  # as rosbags gives it
    for found in (
        picture_of(SimpleNamespace(format="png", data=data)),
        decoded(file.getvalue(), "a.png"),
    ):
        assert (found.values == values).all()
        assert (found.values.dtype, found.full_scale) == (kind, full)


@pytest.mark.parametrize(
    "wrong, problem",
    [
        ({"encoding": "bayer_rggb8"}, "encoding 'bayer_rggb8'"),
        ({"height": 4}, "12 bytes in rows"),
        ({"width": 5}, "12 bytes"),
        ({"height": 0}, "12 bytes"),
        ({"step": 0}, "in rows of 0"),
        (
            {"height": 2**32 - 1, "width": 2**32 - 1, "step": 2**32 - 1},
            "are not 4294967295",
        ),
        ({"data": b""}, "0 bytes"),
    ],
)
def test_impossible_images_are_refused(wrong, problem):
    with pytest.raises(InputError, match=problem):
        picture_of(message(GREY, **({"encoding": "mono8"} | wrong)))


def test_a_grey_value_of_16_bits_needs_two_bytes():
    whole = message(GREY.astype("<u2"), "mono16")
    whole.data = whole.data[:-1]
    with pytest.raises(
        InputError, match="23 bytes in rows of 8 are not 4 x 3 pixels of mono16"
    ):
        picture_of(whole)


@pytest.mark.parametrize("data", [b"", b"no image", b"\x89PNG\r\n\x1a\n" + bytes(50)])
def test_what_cannot_be_decoded_is_refused(data):
    with pytest.raises(
        InputError, match=r"^f\.png: not an image of a known kind, or damaged; g"
    ):
        decoded(data, "f.png")


EPS = (
    b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 100 100\n%%EndComments\n"
    b"0 setgray 20 20 60 60 rectfill showpage\n%%EOF\n"
)


def test_no_format_is_decoded_that_needs_a_program(monkeypatch):
    def run(*_, **__):
        pytest.fail("a program was started")

    monkeypatch.setattr(subprocess, "Popen", run)
    monkeypatch.setattr(os, "system", run)
    # Pillow would take it
    assert EpsImagePlugin.EpsImageFile(io.BytesIO(EPS)).size == (100, 100)
    with pytest.raises(
        InputError, match="not an image of a known kind, or damaged; give PNG"
    ):
        decoded(EPS, "f.eps")


def saved(picture, kind="PNG", **more) -> bytes:
    file = io.BytesIO()
    picture.save(file, kind, **more)
    return file.getvalue()


def test_a_size_is_checked_before_an_image_is_decoded(monkeypatch):
    def refuse(shape):
        raise InputError("a.png", f"of {shape}")

    data = saved(Image.fromarray(GREY))
    monkeypatch.setattr(Image.Image, "load", lambda _: pytest.fail("decoded"))
    for asked in (
        lambda: decoded(data, "a.png", refuse),
        lambda: picture_of(SimpleNamespace(format="png", data=data), refuse),
        lambda: picture_of(message(GREY, "mono8"), refuse),
    ):
        with pytest.raises(InputError, match=r"of \(3, 4\)"):
            asked()


def test_few_bytes_are_no_large_image():
    """10 kB of PNG can hold a hundred million pixels of one value."""
    bomb = saved(Image.new("1", (6000, 6000)))
    assert len(bomb) < 6000 * 6000 / 1000
    with pytest.raises(InputError, match="6000 x 6000 pixels in"):
        decoded(bomb, "f.png")
    assert decoded(saved(Image.new("1", (60, 60))), "f.png").values.shape == (60, 60)


def test_floating_point_values_are_refused():
    """Their black and white are not in the file: 0 and 1, or 0 and 65535."""
    data = saved(Image.fromarray(GREY.astype(np.float32) / 100), "TIFF")
    with pytest.raises(
        InputError, match="floating-point values, whose black and white are unkn"
    ):
        decoded(data, "f.tif")


@pytest.mark.parametrize("pages, more", [(1, False), (3, True)])
def test_pages_beyond_the_first_are_told(pages, more):
    first, *others = [Image.fromarray(GREY + 10 * page) for page in range(pages)]
    found = decoded(saved(first, "TIFF", save_all=True, append_images=others), "f.tif")
    assert (found.values == GREY).all() and found.more_pages is more


def tiff(values, *tags) -> bytes:
    """Return a TIFF of one strip, written as its specification says; tags (number, value)."""
    order, entry = (">", ">HHIHxx") if values.dtype.byteorder == ">" else ("<", "<HHII")
    data = values.tobytes() + bytes(values.nbytes % 2)
    height, width = values.shape[:2]
    entries = {
        256: width,
        257: height,
        258: 8 * values.itemsize,
        259: 1,
        262: 1,
        273: 8,
        277: 1,
        278: height,
        279: values.nbytes,
        **dict(tags),
    }
    kind = 3 if order == ">" else 4
    directory = b"".join(
        struct.pack(entry, tag, kind, 1, value)
        for tag, value in sorted(entries.items())
    )
    head = struct.pack(
        f"{order}2sHI", b"II" if order == "<" else b"MM", 42, 8 + len(data)
    )
    return head + data + struct.pack(f"{order}H", len(entries)) + directory + bytes(4)


def png(colour, depth, rows) -> bytes:
    """Return a PNG of rows of bytes, of 4 pixels, written as its specification says."""

    def chunk(name, data):
        return (
            struct.pack(">I", len(data))
            + name
            + data
            + struct.pack(">I", zlib.crc32(name + data))
        )

    return b"\x89PNG\r\n\x1a\n" + b"".join(
        [
            chunk(
                b"IHDR", struct.pack(">IIBBBBB", 4, len(rows), depth, colour, 0, 0, 0)
            ),
            chunk(b"IDAT", zlib.compress(b"".join(b"\0" + row for row in rows))),
            chunk(b"IEND", b""),
        ]
    )


WIDE = GREY.astype("<u2") * 300
COLOUR_16 = [np.repeat(row, 3).astype(">u2").tobytes() for row in WIDE]
GREY_ALPHA_16 = [
    np.stack([row, 0 * row + 65535], axis=1).astype(">u2").tobytes() for row in WIDE
]
VEILED = np.dstack([GREY, GREY, GREY, GREY + 240])


@pytest.mark.parametrize("order", "<>")
def test_a_tiff_of_16_bits_in_both_orders_of_bytes(order):
    found = decoded(tiff(WIDE.astype(f"{order}u2")), "f.tif")
    assert (found.values == WIDE).all() and found.full_scale == 65535


def test_the_full_scale_is_that_of_the_bits():
    twelve = np.array([[0x12, 0x3A, 0xBC], [0xFF, 0xF0, 0x00]], np.uint8)
    found = decoded(tiff(twelve, (256, 2), (258, 12)), "f.tif")
    assert (
        found.values.tolist() == [[0x123, 0xABC], [0xFFF, 0]]
        and found.full_scale == 4095
    )
    assert decoded(tiff(WIDE, (339, 2)), "f.tif").full_scale == 32767


@pytest.mark.parametrize(
    ("largest", "full"),
    [(4095, 4095), (0xFFF0, 0xFFF0), (1023, 1023), (4094, 65535), (255, 65535)],
)
def test_16_bits_with_a_camera_of_fewer_saturate_where_they_end(largest, full):
    """The low or the high bits; what ends elsewhere is not saturated."""
    values = np.array([[100, largest, largest, 7]], np.uint16)
    assert decoded(saved(Image.fromarray(values), "PNG"), "f.png").full_scale == full
    assert decoded(tiff(values), "f.tif").full_scale == full


def test_signed_16_bits_with_a_camera_of_12_saturate_where_they_end():
    values = np.array([[100, 4095, 4095, 7]], np.uint16)
    assert decoded(tiff(values, (339, 2)), "f.tif").full_scale == 4095


def test_a_tiff_of_one_bit_without_a_tag_for_it():
    data = saved(
        Image.fromarray((GREY > 5).astype(np.uint8) * 255).convert("1"), "TIFF"
    )
    assert (decoded(data, "f.tif").values == (GREY > 5) * 765).all()


def test_white_is_0_in_8_bits_is_turned_round():
    assert (decoded(tiff(GREY, (262, 0)), "f.tif").values == 255 - GREY).all()


@pytest.mark.parametrize(
    ("data", "problem"),
    [
        (tiff(WIDE, (262, 0)), "white is 0"),
        (tiff(GREY, (339, 2)), "signed values"),
        (tiff(WIDE - 1, (339, 2)), "values beyond 16 bits"),
        (tiff(GREY, (256, 2)), "6 rows of pixels instead of 3"),
        (tiff(WIDE, (257, 2)), "3 rows of pixels instead of 2"),
        (tiff(GREY, (274, 6)), "its EXIF orientation is not 1"),
        (png(2, 16, COLOUR_16), "16 bits in the mode RGB"),
        (png(4, 16, GREY_ALPHA_16), "16 bits in the mode"),
        (saved(Image.fromarray(VEILED)), "transparent pixels"),
        (saved(Image.fromarray(GREY), transparency=3), "transparent pixels"),
    ],
)
def test_pixels_that_would_be_turned_cut_or_inverted_are_refused(data, problem):
    with pytest.raises(
        InputError, match=rf"^f: cannot be decoded as an image \({problem}"
    ):
        decoded(data, "f")


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "TIFF"])
def test_every_orientation_but_upright_is_refused(kind):
    for orientation in range(1, 9):
        exif = Image.Exif()
        exif[274] = orientation
        data = saved(Image.fromarray(GREY), kind, exif=exif)
        if orientation == 1:
            assert decoded(data, "f").values.shape == (3, 4)
        else:
            with pytest.raises(
                InputError, match="which way up the camera saw is unknown"
            ):
                decoded(data, "f")
