# SPDX-License-Identifier: Apache-2.0
"""The camera from moves of the stage: uncertainties against repetition, and marks followed."""

import numpy as np
import pytest

from selfcal_ros.errors import NoDataError
from selfcal_ros.model.readings import Sense
from selfcal_ros.vision.camera_pose import camera_pose, tracks

MOVES_M = np.array([(0, 0), (4, 0), (4, 3), (0, 5), (-5, -2), (-3, 2)]) * 1e-5
MARKS_PX = np.array([[-40.0, -35.0], [45.0, -30.0], [40.0, 38.0]])
PIXEL_M, TURN, NOISE_PX = 2.6e-6, 0.3, 0.05


@pytest.mark.parametrize("mirror", [False, True])
def test_uncertainties_are_the_scatter_of_repeated_moves(mirror):
    """300 times: a standard deviation is known to 4 %."""
    rng, turn = (
        np.random.default_rng(8),
        np.array([[np.cos(TURN), -np.sin(TURN)], [np.sin(TURN), np.cos(TURN)]]),
    )
    camera = PIXEL_M * turn @ np.diag([-1.0 if mirror else 1.0, 1.0])  # m of px
    moved = np.linalg.solve(camera, MOVES_M.T).T
    off = []
    for _ in range(300):
        images = [
            MARKS_PX + row + rng.normal(0, NOISE_PX, MARKS_PX.shape) for row in moved
        ]
        found = camera_pose(MOVES_M, images, Sense.PLATE_MOVES)
        assert found.mirror is mirror
        off.append(
            [
                (found.pixel_size_m - PIXEL_M) / found.u_pixel_size_m,
                (found.turn_rad - TURN) / found.u_turn_rad,
                found.noise_px / NOISE_PX,
            ]
        )
    size, angle, noise = np.transpose(off)
    for z in (size, angle):
        assert np.std(z) == pytest.approx(1, abs=0.17) and abs(np.mean(z)) < 0.25
    assert np.mean(noise) == pytest.approx(1, abs=0.03)


def test_marks_are_followed_by_number():
    """The first leaves the image, another enters, then one comes where none was before."""
    a, b, c, d = np.array([[0.0, 0], [100, 0], [200, 0], [300, 90]])
    step = np.array([-10.0, 3])
    images = [
        np.array([a, b]),
        np.array([c, b]) + step,
        np.zeros((0, 2)),
        np.array([b, d, c]) + 2 * step,
    ]
    assert [found.tolist() for found in tracks(images)] == [
        [0, 1],
        [2, 1],
        [],
        [1, 3, 2],
    ]


def test_images_without_marks_are_counted_as_such():
    empty = [np.zeros((0, 2))] * len(MOVES_M)
    with pytest.raises(NoDataError, match="0 readings of 0 marks"):
        camera_pose(MOVES_M, empty, Sense.PLATE_MOVES)
