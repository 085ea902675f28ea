# SPDX-License-Identifier: Apache-2.0
"""The detector on drawn images: bias, uncertainty, signs, and a named reason for each bad mark."""

import re
from pathlib import Path

import numpy as np
import pytest

from selfcal_ros.errors import InputError
from selfcal_ros.settings.detector import MARKS, DetectorSettings
from selfcal_ros.simulation.rendering import Camera
from selfcal_ros.vision.detector import MarkDetector, MarkFault, offset
from selfcal_ros.vision.finding import _noise, candidates
from selfcal_ros.vision.images import Picture

PIXEL = 2e-6


def test_every_reason_of_the_detector_is_in_its_guide():
    page = (Path(__file__).parents[2] / "docs/start/camera.md").read_text()
    _, _, table = page.partition("| reason | what |\n")
    rows = table.partition("\n\n")[0]
    assert set(re.findall(r"^\| `(\w+)` \|", rows, re.MULTILINE)) == set(MarkFault)


def camera(mark="disc", size=25.0, **more):
    return Camera(
        **(
            {
                "width": 121,
                "height": 111,
                "mark": mark,
                "encoding": "mono16",
                "mark_size_m": size * PIXEL,
                "mark_width_m": size * PIXEL / 5,
                "read_noise": 0.0,
                "shot_noise": 0.0,
            }
            | more
        )
    )


def detector(mark="disc", size=25.0, **more):
    return MarkDetector(
        DetectorSettings(
            **({"pixel_size": PIXEL, "mark": mark, "mark_size": size * PIXEL} | more)
        )
    )


def picture(values):
    return Picture(values, int(np.iinfo(values.dtype).max))


def errors(camera, detector, offsets, rng, angles=None):
    """Return errors (n, 2) and errors over their u (n, 2) of one image per offset."""
    found = []
    for number, away in enumerate(offsets):
        angle = rng.uniform(-np.pi, np.pi) if angles is None else angles[number]
        marks, faults = detector.marks(
            picture(camera.image(away[:, None], rng, angles=angle))
        )
        # the squares of a corner end at the border of the image
        assert len(marks) == 1
        assert set(faults) <= ({"cut_off"} if camera.mark == "corner" else set())
        true = camera.pixels_of(away[:, None])[:, 0]
        miss = np.array([marks[0].u, marks[0].v]) - true
        found.append((miss, miss / (marks[0].u_u, marks[0].u_v)))
    return np.array([item[0] for item in found]), np.array([item[1] for item in found])


@pytest.mark.parametrize("vignetting", [0.0, 0.03])
@pytest.mark.parametrize("polarity", ["dark", "bright"])
@pytest.mark.parametrize("mark", MARKS)
def test_bias_is_below_a_two_hundredth_of_a_pixel_at_all_phases(
    mark, polarity, vignetting
):
    """Without noise; blur 0.6 px, the worst for pixels that integrate."""
    levels = {"ground": 0.8} if polarity == "dark" else {"ground": 0.1}
    cell = camera(mark, polarity=polarity, blur_px=0.6, vignetting=vignetting, **levels)
    phases = (
        np.stack(np.meshgrid(np.arange(4), np.arange(4))).reshape(2, -1).T / 4 - 0.4
    ) * PIXEL
    missed, _ = errors(
        cell,
        detector(mark, polarity=polarity),
        phases + 20 * PIXEL,
        np.random.default_rng(3),
    )
    assert np.abs(missed).max() < 0.005


@pytest.mark.parametrize("mark", MARKS)
def test_errors_over_their_uncertainty_have_unit_variance(mark):
    """A population over noise, blur, size, phase, direction and polarity: chi² within 4 sigma."""
    rng, ratios = np.random.default_rng(11), []
    for number in range(50):
        size, bright = rng.uniform(14, 40), number % 2 == 1
        noise = 0.6 / np.exp(rng.uniform(np.log(10), np.log(200)))
        cell = camera(
            mark,
            size,
            polarity="bright" if bright else "dark",
            ground=0.15 if bright else 0.8,
            blur_px=rng.uniform(0.6, 0.06 * size),
            read_noise=noise * rng.uniform(0.2, 1),
            shot_noise=noise,
        )
        found = detector(mark, size, polarity=cell.polarity)
        ratios.append(errors(cell, found, rng.uniform(-9, 9, (1, 2)) * PIXEL, rng)[1])
    square = np.square(np.concatenate(ratios))
    assert square.size == 100
    assert abs(square.mean() - 1) < 4 * np.sqrt(2 / square.size)


def test_thin_lines_are_found_though_their_width_and_contrast_are_hard_to_tell_apart():
    rng, ratios = np.random.default_rng(3), []
    for _ in range(60):
        size = rng.uniform(7, 12)
        cell = camera(
            "ring",
            size,
            blur_px=0.7,
            read_noise=0.6 / np.exp(rng.uniform(np.log(20), np.log(200))),
        )
        found = detector("ring", size)
        ratios.append(errors(cell, found, rng.uniform(-3, 3, (1, 2)) * PIXEL, rng)[1])
    square = np.square(np.concatenate(ratios))
    assert abs(square.mean() - 1) < 4 * np.sqrt(2 / square.size)


def test_small_marks_blurred_by_lens_and_pixels_lie_where_their_uncertainty_says():
    """A photographed plate had 19,500 of 20,000 discs of 6.8 px rejected as defocused."""
    rng, ratios = np.random.default_rng(5), []
    for _ in range(60):
        size = rng.uniform(6.2, 10)
        cell = camera(
            size=size,
            blur_px=rng.uniform(1.0, 1.35),
            read_noise=0.6 / np.exp(rng.uniform(np.log(20), np.log(200))),
        )
        where = rng.uniform(-9, 9, (1, 2)) * PIXEL
        ratios.append(errors(cell, detector(size=size), where, rng)[1])
    square = np.square(np.concatenate(ratios))
    assert abs(square.mean() - 1) < 4 * np.sqrt(2 / square.size)


def test_pixels_are_counted_from_the_centre_of_the_first_one_and_rows_run_down():
    """A hand-made image: a dark disc, its centre at column 30 and row 14."""
    row, column = np.mgrid[:81, :101]
    inside = 1 / (1 + np.exp((np.hypot(column - 30, row - 14) - 8) * 1.7))
    values = np.rint(200 - 150 * inside).astype(np.uint8)
    given = {"size": 16.0, "max_blur": 1.0}
    [mark] = detector(**given).marks(picture(values))[0]
    assert (mark.u, mark.v) == pytest.approx((30, 14), abs=1e-6)
    left, up = -20 * PIXEL, 26 * PIXEL  # the axis is at (50, 40)
    for turn, mirror, expected in (
        (0.0, False, (left, up)),
        (0.0, True, (-left, up)),
        (90.0, False, (-up, left)),
        (90.0, True, (-up, -left)),
        (180.0, False, (-left, -up)),
        (-90.0, False, (up, -left)),
    ):
        eye = detector(**given, turn=turn, mirror=mirror)
        [found] = eye.detections(eye.marks(picture(values))[0], values.shape, 7)
        assert (found.offset_x, found.offset_y) == pytest.approx(expected, abs=1e-11)
        assert found.stamp_ns == 7 and not found.has_id and found.kind == 0


def test_a_large_mark_sought_in_a_reduced_image_is_found_to_the_pixel():
    """One pixel of the image in which it is sought is 12 pixels of this one."""
    cell = camera(size=100.0, width=401, height=381)
    for away in np.array([(0.0, 0.0), (3.1, 4.9), (-4.2, 2.3), (5.8, -1.6)]) * PIXEL:
        image = cell.image(away[:, None], np.random.default_rng(1))
        [found] = candidates(
            image, mark="disc", size=100.0, width=20.0, sign=-1, most=9
        )
        true = cell.pixels_of(away[:, None])[:, 0]
        assert np.abs(np.subtract((found.column, found.row), true)).max() <= 1


def test_the_simulated_camera_and_the_detector_agree_on_turn_and_mirror():
    rng = np.random.default_rng(5)
    for _ in range(20):
        pose = {"turn": rng.uniform(-180, 180), "mirror": bool(rng.integers(2))}
        cell = camera(turn_deg=pose["turn"], mirror=pose["mirror"])
        away = rng.uniform(-40, 40, 2) * PIXEL
        u, v = cell.pixels_of(away[:, None])[:, 0]
        assert offset(u, v, (111, 121), detector(**pose).settings) == pytest.approx(
            tuple(away), abs=1e-15
        )


def test_sigma_is_the_uncertainty_in_metres():
    cell = camera(read_noise=0.02)
    image = picture(cell.image(np.zeros((2, 1)), np.random.default_rng(2)))
    [mark], _ = detector().marks(image)
    [found] = detector().detections([mark], image.values.shape, 0)
    assert found.sigma == pytest.approx(
        PIXEL * np.sqrt((mark.u_u**2 + mark.u_v**2) / 2), rel=1e-12
    )
    assert found.score == mark.score > 0.98


def drawn(away=(0.0, 0.0), rng=None, **more):
    cell = camera(read_noise=0.005, **more)
    return cell.image(np.array([away]).T * PIXEL, rng or np.random.default_rng(9))


def disc(values, column, row, radius, level):
    v, u = np.mgrid[: values.shape[0], : values.shape[1]]
    values[np.hypot(u - column, v - row) <= radius] = round(level * 65535)
    return values


def test_a_good_mark_has_no_fault():
    marks, faults = detector().marks(picture(drawn()))
    assert len(marks) == 1 and not faults


@pytest.mark.parametrize(
    "reason, values",
    [
        ("cut_off", drawn((52, 0))),
        ("cut_off", drawn((0, -49))),
        ("defocused", drawn(blur_px=5.0)),
        ("wrong_size", drawn(size=33.0)),
        ("wrong_size", drawn(size=18.0)),
        ("dirt", disc(drawn(), 60, 41, 3, 0.05)),  # on the edge: darker than a mark
        ("dirt", disc(drawn(), 43, 55, 3, 0.3)),  # beside, as dark as a mark
        ("broken", disc(drawn(), 66, 55, 4, 0.75)),  # a piece is missing
        ("reflection", disc(drawn(), 60, 55, 4, 0.99)),
        ("reflection", disc(drawn(), 70, 50, 4, 0.99)),
        ("reflection", disc(drawn(), 80, 50, 1, 0.99)),  # at the rim of the window
        ("saturated", drawn(ground=1.2, contrast=0.9)),
        ("weak", drawn(ground=0.5, contrast=0.08, shot_noise=0.1)),
    ],
)
def test_a_bad_mark_is_rejected_with_its_reason(reason, values):
    settings = {"max_sigma_px": 0.05} if reason == "weak" else {}
    marks, faults = detector(**settings).marks(picture(values))
    assert marks == [] and dict(faults) == {reason: 1}


def test_a_hot_pixel_does_no_harm():
    values = drawn()
    missed = detector().marks(picture(values))[0][0]
    values[55, 72] = 65535
    [mark], faults = detector().marks(picture(values))
    assert not faults and np.hypot(mark.u - missed.u, mark.v - missed.v) < 0.005


def test_the_full_scale_of_a_camera_of_12_bits_can_be_given():
    values = np.minimum(drawn(ground=1.1, contrast=0.9) >> 4, 4095)
    assert detector().marks(picture(values))[1]["saturated"] == 0
    assert detector(full_scale=4095).marks(picture(values))[1]["saturated"] == 1


def test_nothing_is_found_where_there_is_nothing():
    rng = np.random.default_rng(1)
    for values in (
        np.zeros((100, 120), np.uint8),
        np.full((9, 9), 255, np.uint8),
        np.zeros((1, 1), np.uint8),
        np.zeros((2, 4000), np.uint16),
        rng.integers(90, 110, (200, 200)).astype(np.uint8),
    ):
        assert detector().marks(picture(values)) == ([], {})


def test_nine_marks_are_found_row_by_row():
    cell = camera(width=301, height=281)
    lattice = np.stack(np.meshgrid([-80, 0, 80], [80, 0, -80])).reshape(2, -1)
    image = cell.image(lattice * PIXEL, np.random.default_rng(4))
    marks, faults = detector().marks(picture(image))
    assert not faults
    assert np.array([(mark.u - 150, 140 - mark.v) for mark in marks]) == pytest.approx(
        lattice.T, abs=0.01
    )


@pytest.mark.parametrize(
    "wrong, problem",
    [
        ({"pixel_size": 0.0}, "pixel_size: is not set"),
        ({"size": 0.0}, "mark_size: is not set"),
        ({"size": 3.0}, "mark_size: 3 pixels"),
        ({"size": 1e5}, "mark_size: 1e"),
        ({"mark": "ring", "mark_width": 13 * PIXEL}, "mark_width: at least half"),
    ],
)
def test_impossible_sizes_are_refused(wrong, problem):
    with pytest.raises(InputError, match=problem):
        detector(**wrong)


def test_the_noise_of_a_picture_is_found_beside_a_slope_and_a_mark():
    rng, (x, y) = np.random.default_rng(4), np.mgrid[:120, :150]
    picture = rng.normal(0, 3.0, x.shape) + 0.4 * x - 0.2 * y
    picture[50:60, 40:50] += 200
    assert _noise(picture) == pytest.approx(3.0, rel=0.05)
