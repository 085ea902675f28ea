# SPDX-License-Identifier: Apache-2.0
"""Rendered images against what is known of them: area, centroid, blur, noise, light, direction."""

from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.simulation.rendering import Camera

PLAIN = Camera(width=101, height=91, read_noise=0.0, shot_noise=0.0, encoding="mono16")
CENTRE = np.zeros((2, 1))


def grey(camera, offsets=CENTRE, **kwargs):
    return camera.image(offsets, np.random.default_rng(1), **kwargs) / 65535


@pytest.mark.parametrize(
    "mark, area",
    [
        ("disc", np.pi / 4 * 25**2),
        ("ring", np.pi * 5 * 20),
        ("cross", 2 * 25 * 5 - 25),
        ("corner", 2 * 25**2),
    ],
)
def test_area_and_centroid_are_those_of_the_mark(mark, area):
    camera = replace(PLAIN, mark=mark, blur_px=1.2)
    away = np.array([[3.3], [-2.6]]) * camera.pixel_size_m
    weight = (camera.ground - grey(camera, away)) / camera.contrast
    assert weight.sum() == pytest.approx(area, rel=2e-3)
    v, u = np.mgrid[:91, :101]
    assert (weight * u).sum() / weight.sum() == pytest.approx(50 + 3.3, abs=0.01)
    assert (weight * v).sum() / weight.sum() == pytest.approx(45 + 2.6, abs=0.01)


def test_the_width_of_an_edge_is_that_of_blur_and_pixel():
    camera = replace(PLAIN, mark_size_m=60 * PLAIN.pixel_size_m, blur_px=1.5)
    edge = np.diff(grey(camera)[45, 50:95])
    place = np.arange(len(edge))
    mean = (edge * place).sum() / edge.sum()
    assert (edge * (place - mean) ** 2).sum() / edge.sum() == pytest.approx(
        1.5**2 + 2 / 12, rel=0.05
    )


def test_noise_grows_with_light():
    camera = replace(PLAIN, read_noise=0.01, shot_noise=0.02, ground=0.5, contrast=0.0)
    assert grey(camera).std() == pytest.approx(np.sqrt(1e-4 + 4e-4 * 0.5), rel=0.05)


def test_light_falls_to_the_corners_and_marks_are_displaced_there():
    dim = grey(replace(PLAIN, vignetting=0.3, contrast=0.0))
    assert dim[0, 0] / dim[45, 50] == pytest.approx(0.7, abs=1e-3)
    corner = np.array([[50.0], [45.0]]) * PLAIN.pixel_size_m
    u, v = replace(PLAIN, distortion=0.02).pixels_of(corner)[:, 0]
    assert (u, v) == pytest.approx((50 + 51, 45 - 45.9))


def test_a_corner_is_turned_counter_clockwise_with_the_plate():
    """Straight, its squares are at the lower right and upper left of the image."""
    camera = replace(PLAIN, mark="corner", mark_size_m=20 * PLAIN.pixel_size_m)
    upper_right = grey(camera)[45 - 8, 50 + 8]
    assert upper_right > 0.7
    for turned in (
        grey(camera, angles=np.pi / 2),
        grey(replace(camera, turn_deg=90.0)),
    ):
        assert turned[45 - 8, 50 + 8] < 0.3
    part = grey(camera, angles=np.deg2rad(30))
    # dark from 30 degrees below the row on, seen upwards
    assert part[45 - 3, 50 + 12] < 0.3


def test_dirt_is_dark_and_counted_on_average():
    spotted = grey(replace(PLAIN, dirt=5.0, contrast=0.0))
    assert 0 < (spotted < 0.4).sum() < spotted.size / 4


def test_a_mark_outside_of_the_image_does_not_show():
    for away in ((1e-3, 0.0), (-1e-3, 1e-3), (0.0, -1e-3)):
        assert (
            grey(PLAIN, np.array([away]).T) == grey(replace(PLAIN, contrast=0.0))
        ).all()


def test_a_mirrored_camera_shows_the_mirrored_image():
    camera = replace(PLAIN, mark="corner", turn_deg=10.0)
    away = np.array([[2e-5], [1e-5]])
    straight = grey(camera, away, angles=0.4)
    assert np.abs(straight - straight[:, ::-1]).max() > 0.5
    mirrored = grey(replace(camera, mirror=True), away, angles=0.4)
    assert mirrored == pytest.approx(straight[:, ::-1], abs=2e-5)
