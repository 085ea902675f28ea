# SPDX-License-Identifier: Apache-2.0
"""What repeats in an image: its side and whether it is dark, from drawn spots."""

import numpy as np
import pytest

from selfcal_ros.vision.shown import alternates, spots_in


def spots(side, *, dark, pitch=60, shape=(300, 360)):
    """Return an image of discs on a lattice, half of the ground in a slope, with noise."""
    v, u = np.mgrid[: shape[0], : shape[1]].astype(float)
    away = np.hypot((u % pitch) - pitch / 2, (v % pitch) - pitch / 2)
    inside = away <= side / 2
    ground, mark = (180.0, 60.0) if dark else (60.0, 180.0)
    noise = np.random.default_rng(1).normal(0, 4, shape)
    return np.clip(np.where(inside, mark, ground) + 0.05 * u + noise, 0, 255).astype(
        np.uint8
    )


@pytest.mark.parametrize("dark", [True, False])
@pytest.mark.parametrize("side", [9, 21, 35])
def test_the_side_and_the_polarity_of_what_repeats(side, dark):
    found = spots_in(spots(side, dark=dark))
    assert found.number == 30
    assert found.side_px == pytest.approx(side, abs=1.0)
    assert found.polarity == ("dark" if dark else "bright")


def test_an_even_image_shows_nothing():
    assert spots_in(np.full((50, 60), 7, dtype=np.uint8)) is None


def test_of_two_spots_that_differ_the_larger_is_stated():
    # one mark and a speck of dust beside it: neither is like the mean of both
    image = np.full((60, 60), 200, dtype=np.uint8)
    image[20:34, 20:34] = 40
    image[45:49, 45:49] = 40
    found = spots_in(image)
    assert (found.side_px, found.polarity, found.number) == (14.0, "dark", 1)


@pytest.mark.parametrize("noise", [1.0, 4.0, 30.0])
@pytest.mark.parametrize("light", ["even", "slope", "photons"])
def test_noise_shows_nothing(noise, light):
    """Its parts are specks, or of all sizes."""
    rng = np.random.default_rng(3)
    slope = np.arange(360) / 3 if light == "slope" else np.full(360, 100.0)
    values = slope + rng.normal(0, noise, (300, 360))
    if light == "photons":
        values = rng.poisson(noise / 10, (300, 360))
    assert spots_in(np.clip(values, 0, 255).astype(np.uint8)) is None


@pytest.mark.parametrize("noise", [0.0, 4.0])
@pytest.mark.parametrize(
    ("side", "pitch"), [(3, 6), (5, 6), (3, 8), (5, 8), (5, 20), (3, 40), (5, 40)]
)
def test_sharp_marks_at_an_even_pitch_are_not_a_bayer_pattern(side, pitch, noise):
    v, u = np.mgrid[:240, :280]
    inside = (u % pitch < side) & (v % pitch < side)
    values = np.where(inside, 60.0, 180.0)
    values += np.random.default_rng(2).normal(0, noise, values.shape)
    assert not alternates(np.rint(values).astype(np.uint8))


FILTERS = {
    "green of a Bayer pattern": [[0.5, 1.0], [1.0, 0.6]],
    "red light": [[1.0, 0.3], [0.3, 0.1]],
    "every other row": [[1.0, 1.0], [0.7, 0.7]],
    "every other column": [[1.0, 0.7], [1.0, 0.7]],
}


@pytest.mark.parametrize("filters", FILTERS.values(), ids=FILTERS)
@pytest.mark.parametrize("dark", [True, False])
def test_a_pattern_beside_the_marks_as_well_is_one_of_a_colour_camera(filters, dark):
    values = spots(21, dark=dark)
    assert not alternates(values)
    raw = np.rint(values * np.tile(filters, (150, 180))).astype(np.uint8)
    assert alternates(raw)
    assert alternates(raw[1:, 1:])  # an odd number of rows and columns


@pytest.mark.parametrize("shape", [(1, 40), (40, 1)])
def test_one_row_or_column_is_not_a_bayer_pattern(shape):
    assert not alternates(np.arange(40, dtype=np.uint8).reshape(shape))
