# SPDX-License-Identifier: Apache-2.0
"""Size of the pixels, turn and mirror of a camera, from marks seen while the stage moves."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from selfcal_ros.errors import InputError, NoDataError
from selfcal_ros.model.readings import Sense
from selfcal_ros.settings.detector import DetectorSettings
from selfcal_ros.units import M_PER_UM

NOT_SIMILAR = 0.02
"""Relative difference of the two axes, or shear, above which a camera is refused."""
TOO_UNCERTAIN = 0.02
"""Relative standard uncertainty of the size of a pixel above which a camera is refused."""
FOLLOWED = 1 / (2 + DetectorSettings().size_tolerance)
"""Part of the distance of two marks over which a mark is followed from image to image.

Where the stage moves by more than half of the distance d, each mark seems to move the other way,
by the rest. Of a rest of more than this part of d, the pixels are off by less than the
tolerance of the size of marks, which then does not show it.
"""
SHORT = "less than 0.4 times the distance of two marks"
"""Moves that are followed."""
LEAST_SPAN = 0.1
"""Smallest extent of the positions over the largest one."""


@dataclass(frozen=True)
class CameraPose:
    """A camera as the parameters of mark_detector describe it, with standard uncertainties.

    Attributes
    ----------
    pixel_size_m, u_pixel_size_m : float
        Side of a pixel on the plate.
    turn_rad, u_turn_rad : float
        Turn of the image to the stage axes.
    mirror : bool
        Whether the image is mirrored.
    sheared, u_sheared : float
        Relative difference from a similarity: unequal axes and shear.
    noise_px : float
        Standard deviation of a coordinate of a mark.
    """

    pixel_size_m: float
    u_pixel_size_m: float
    turn_rad: float
    u_turn_rad: float
    mirror: bool
    sheared: float
    u_sheared: float
    noise_px: float


def tracks(images: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Return the number of the track of each mark, image by image.

    A mark continues the nearest one of the image before, if it has moved by less than `FOLLOWED`
    of the smallest distance between two marks; a single mark per image is always the same one.

    Parameters
    ----------
    images : sequence of float arrays (k, 2)
        Places of the marks, px.
    """
    distances_px = [
        float(np.hypot(*(places[i] - places[j])))
        for places in images
        for i in range(len(places))
        for j in range(i)
    ]
    limit = FOLLOWED * min(distances_px) if distances_px else np.inf
    numbers: list[np.ndarray] = []
    count = 0
    before = np.zeros((0, 2))
    tracks_before = np.zeros(0, dtype=int)
    for places in images:
        mine = np.full(len(places), -1)
        for index, place in enumerate(places):
            away = np.hypot(*(before - place).T)
            if len(away) and away.min() < limit:
                mine[index] = tracks_before[away.argmin()]
            else:
                mine[index] = count
                count = count + 1
        numbers.append(mine)
        if len(places):
            before, tracks_before = places, mine
    return numbers


def camera_pose(
    positions: np.ndarray, images: Sequence[np.ndarray], sense: Sense
) -> CameraPose:
    """Return the camera that sees marks at these places while the stage is at `positions`.

    Parameters
    ----------
    positions : float array (n, 2)
        Indicated positions of the stage, m.
    images : sequence of n float arrays (k, 2)
        Places of the marks, px: to the right of and above the centre of the image.
    sense : Sense
        What moves.

    Raises
    ------
    NoDataError
        If too few marks were followed.
    InputError
        If the stage did not move, or along one line, the marks do not follow it, or the image is
        not a similar image of the motion.
    """
    number = np.concatenate([np.zeros(0, int), *tracks(images)])
    stage = np.repeat(positions, [len(places) for places in images], axis=0)
    place = np.concatenate([np.zeros((0, 2)), *images])
    followed = np.bincount(number)[number] > 1 if len(number) else np.zeros(0, bool)
    number, stage, place = number[followed], stage[followed], place[followed]
    _, number = np.unique(number, return_inverse=True)
    count = number.max(initial=-1) + 1
    if len(number) < count + 3:
        raise NoDataError(
            "images",
            f"{len(number)} readings of {count} marks that were followed",
            f"move the stage in x and y by {SHORT}, so that marks stay in the image",
        )
    stage = (
        stage
        - (
            np.stack([np.bincount(number, axis) for axis in stage.T])
            / np.bincount(number)
        ).T[number]
    )
    place = (
        place
        - (
            np.stack([np.bincount(number, axis) for axis in place.T])
            / np.bincount(number)
        ).T[number]
    )
    span = np.linalg.svd(stage, compute_uv=False)
    if span[1] <= LEAST_SPAN * span[0]:
        motion = "moved along one line only" if span[0] else "did not move"
        raise InputError("images", f"the stage {motion}", "move it in x and in y")
    by_stage = np.linalg.lstsq(stage, place, rcond=None)[0].T  # px per m
    residual = place - stage @ by_stage.T
    noise = float(np.sqrt(np.square(residual).sum() / (2 * (len(number) - count - 2))))
    covariance = np.kron(np.eye(2), np.linalg.inv(stage.T @ stage)) * noise**2
    return _similar(by_stage, covariance, sense, noise)


def _similar(
    by_stage: np.ndarray, covariance: np.ndarray, sense: Sense, noise: float
) -> CameraPose:
    """Return the similarity in the change of places (px) by the stage (m), with uncertainties."""
    sign = 1 if sense is Sense.PLATE_MOVES else -1
    mirror = bool(np.linalg.det(by_stage) < 0)

    def parts(matrix: np.ndarray) -> np.ndarray:
        """Return size, turn, and the two parts that are not a similarity, of m per px."""
        camera = sign * np.linalg.inv(matrix)
        if mirror:
            camera = camera * np.array([-1.0, 1.0])
        (a, b), (c, d) = camera
        size = np.hypot(a + d, c - b) / 2
        return np.array(
            [size, np.arctan2(c - b, a + d), (a - d) / 2 / size, (b + c) / 2 / size]
        )

    components = parts(by_stage)
    step = 1e-6 * np.abs(by_stage).max()
    jacobian = np.empty((4, 4))
    for index in range(4):
        change = np.zeros(4)
        change[index] = step
        nearby = [parts(by_stage + way * change.reshape(2, 2)) for way in (1, -1)]
        differ = nearby[0] - nearby[1]
        differ[1] = np.remainder(differ[1] + np.pi, 2 * np.pi) - np.pi
        jacobian[:, index] = differ / (2 * step)
    u = np.sqrt(np.diagonal(jacobian @ covariance @ jacobian.T))
    if not u[0] <= TOO_UNCERTAIN * components[0]:
        raise InputError(
            "images",
            "the marks do not follow the stage: the size of a pixel has a standard "
            f"uncertainty of {u[0] / components[0]:.2g} of itself",
            f"move the stage from image to image by {SHORT}, and check the positions",
        )
    sheared = float(np.hypot(*components[2:]))
    if sheared > max(NOT_SIMILAR, 5 * float(u[2:].max())):
        raise InputError(
            "images",
            f"the image of the motion is sheared by {100 * sheared:.1f} %",
            f"check that the moves are {SHORT}, and that the encoder axes are those of the "
            "camera's stage",
        )
    return CameraPose(
        float(components[0]),
        float(u[0]),
        float(components[1]),
        u_turn_rad=float(u[1]),
        mirror=mirror,
        sheared=sheared,
        u_sheared=float(u[2:].max()),
        noise_px=noise,
    )


def require_size(
    pose: CameraPose, *, mark_size_m: float, mark_pixels: float, where: str
) -> None:
    """Raise InputError for a camera in which marks would have another size than stated."""
    stated_m = mark_size_m / mark_pixels
    if abs(stated_m / pose.pixel_size_m - 1) > DetectorSettings().size_tolerance:
        raise InputError(
            where,
            "by the moves of the stage a pixel has "
            f"{pose.pixel_size_m / M_PER_UM:.3g} µm, by the size of the marks over "
            f"their pixels {stated_m / M_PER_UM:.3g} µm",
            "correct the unit of the positions (m), the size of the marks (m) or their pixels",
        )
