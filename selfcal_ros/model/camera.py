# SPDX-License-Identifier: Apache-2.0
"""What images of several marks show of the camera and of the stage's yaw: ``camera`` of a result.

SI units, stage axes; None and NaN where unknown.
"""

from dataclasses import astuple, dataclass
from typing import Any

import numpy as np

from selfcal_ros.files import read
from selfcal_ros.outputs import plain


@dataclass(frozen=True)
class CameraPower:
    """A coefficient x + iy of z^a conj(z)^b, with `power` (a, b), and its standard uncertainty."""

    power: tuple[int, ...]
    x: float
    y: float
    u_x: float
    u_y: float


@dataclass(frozen=True)
class CameraCell:
    """A cell: mean true offset x, y, the error there and its standard uncertainty, m."""

    x: float
    y: float
    dx: float
    dy: float
    u_dx: float
    u_dy: float


@dataclass(frozen=True)
class CameraErrors:
    """Errors of a camera: published minus true offset, as a function of the true one.

    Attributes
    ----------
    scale, rotation, stretch, shear : float
        Of its linear part, each with its standard uncertainty.
    degree : int
        Degree of the polynomial.
    coefficients : tuple of CameraPower
        The polynomial.
    cells : tuple of CameraCell
        All cells of the image.
    noise_image, noise_mark : float
        Noise shared by the marks of an image, and that of a mark, m.
    """

    scale: float
    rotation: float
    stretch: float
    shear: float
    u_scale: float
    u_rotation: float
    u_stretch: float
    u_shear: float
    degree: int
    coefficients: tuple[CameraPower, ...]
    cells: tuple[CameraCell, ...]
    noise_image: float
    noise_mark: float

    @property
    def known_cells(self) -> np.ndarray:
        """Places, errors and u at the cells whose error is known, (6, cells), m."""
        cells = np.array([astuple(cell) for cell in self.cells]).reshape(-1, 6)
        return cells[np.isfinite(cells).all(axis=1)].T


@dataclass(frozen=True, eq=False)
class StageYawMap:
    """Rotation of what the stage carries, by its position.

    Attributes
    ----------
    x, y : float array (nodes,)
        Positions of the stage, m.
    yaw, u_yaw : float array (nodes,)
        Rotation, counter-clockwise, relative to its mean over the nodes, and its standard
        uncertainty, rad.
    p : float
        Probability that a stage that does not turn shows as much.
    """

    x: np.ndarray
    y: np.ndarray
    yaw: np.ndarray
    u_yaw: np.ndarray
    p: float


def shown_by_images(data: Any) -> tuple[CameraErrors | None, StageYawMap | None]:
    """Return the camera and the yaw of the stage from ``camera`` of RESULT.json."""
    fields = dict(read(dict, data or {}))
    yaw = read(StageYawMap | None, fields.pop("yaw", None))
    return (read(CameraErrors, fields) if fields else None), yaw


def camera_to_dict(
    camera: CameraErrors | None, yaw: StageYawMap | None
) -> dict[str, Any]:
    """Return ``camera`` of RESULT.json; empty without images."""
    return {
        **({} if camera is None else plain(camera)),
        **({} if yaw is None else {"yaw": plain(yaw)}),
    }
