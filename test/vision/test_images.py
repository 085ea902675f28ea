# SPDX-License-Identifier: Apache-2.0
"""Pixels of messages and of encoded images; what is damaged is refused in one line."""

import io
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from selfcal_ros.errors import InputError
from selfcal_ros.vision.images import decoded, picture_of


def message(values, encoding, **more):
    return SimpleNamespace(**({
        "height": values.shape[0], "width": values.shape[1], "encoding": encoding,
        "is_bigendian": 0, "step": values.strides[0], "data": values.tobytes()} | more))


GREY = np.arange(12, dtype=np.uint8).reshape(3, 4)


@pytest.mark.parametrize("kind, encoding", [("u1", "mono8"), ("<u2", "mono16")])
def test_grey_images(kind, encoding):
    values, full = picture_of(message((GREY * 20).astype(kind), encoding))
    assert (values == GREY * 20).all() and values.dtype == np.dtype(kind)
    assert full == (255 if kind == "u1" else 65535)


def test_the_order_of_bytes_and_padded_rows_are_obeyed():
    big = (GREY.astype(np.uint16) * 1000).astype(">u2")
    padded = np.concatenate([big, np.zeros((3, 5), ">u2")], axis=1).astype(">u2")
    found = picture_of(message(big, "mono16", is_bigendian=1, data=padded.tobytes(),
                               step=padded.strides[0]))
    assert (found.values == big).all()


@pytest.mark.parametrize("encoding", ["rgb8", "bgr8"])
def test_colours_are_summed(encoding):
    colours = np.stack([GREY, GREY + 100, GREY + 200], axis=2)
    values, full = picture_of(message(colours, encoding))
    assert (values == colours.sum(axis=2)).all() and full == 765


@pytest.mark.parametrize("kind, full", [(np.uint8, 255), (np.uint16, 65535)])
def test_encoded_images(kind, full):
    values = GREY.astype(kind) * 21
    file = io.BytesIO()
    Image.fromarray(values).save(file, "PNG")
    data = np.frombuffer(file.getvalue(), np.uint8)  # as rosbags gives it
    for found in (picture_of(SimpleNamespace(format="png", data=data)),
                  decoded(file.getvalue(), "a.png")):
        assert (found.values == values).all()
        assert (found.values.dtype, found.full_scale) == (kind, full)


@pytest.mark.parametrize("wrong, problem", [
    ({"encoding": "bayer_rggb8"}, "encoding 'bayer_rggb8'"), ({"height": 4}, "12 bytes in rows"),
    ({"width": 5}, "12 bytes"), ({"height": 0}, "12 bytes"), ({"step": 0}, "in rows of 0"),
    ({"height": 2**32 - 1, "width": 2**32 - 1, "step": 2**32 - 1}, "are not 4294967295"),
    ({"data": b""}, "0 bytes")])
def test_impossible_images_are_refused(wrong, problem):
    with pytest.raises(InputError, match=problem):
        picture_of(message(GREY, **({"encoding": "mono8"} | wrong)))


def test_a_grey_value_of_16_bits_needs_two_bytes():
    whole = message(GREY.astype("<u2"), "mono16")
    whole.data = whole.data[:-1]
    with pytest.raises(InputError, match="23 bytes in rows of 8 are not 4 x 3 pixels of mono16"):
        picture_of(whole)


@pytest.mark.parametrize("data", [b"", b"no image", b"\x89PNG\r\n\x1a\n" + bytes(50)])
def test_what_cannot_be_decoded_is_refused(data):
    with pytest.raises(InputError, match=r"^f\.png: not an image, or damaged; give PNG"):
        decoded(data, "f.png")
