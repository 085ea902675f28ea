# SPDX-License-Identifier: Apache-2.0
"""Ids of marks from the ArUco markers at the edge of their plate, by OpenCV."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from selfcal_ros.errors import InputError
from selfcal_ros.model.edge_markers import CORNERS, DICTIONARY, SIDE, edge_markers
from selfcal_ros.settings.detector import coded_shape
from selfcal_ros.settings.parameter import place_of
from selfcal_ros.vision.detector import Mark, MarkFault
from selfcal_ros.vision.images import Picture

AGREE = 0.15
"""Largest distance of a corner or mark from its place, pitches, at which markers are believed."""
NEAR = 0.25
"""Largest distance of a mark from its place on the lattice, pitches."""
SAMPLED = 3
"""Every which row and column of an image its black and white are taken from."""


def stretched(values: np.ndarray) -> np.ndarray:
    """Return grey values as uint8 from black to white, whatever the exposure and the bits are.

    One pixel in a thousand may be darker, one brighter: hot pixels, reflections.
    """
    low, high = np.percentile(values[::SAMPLED, ::SAMPLED], (0.1, 99.9))
    grey = (values - low) * (255.0 / max(high - low, 1.0))
    return np.ascontiguousarray(np.clip(grey, 0, 255), dtype=np.uint8)


class CodedPlate:
    """Knows which marks of a plate are in an image, if one of its markers is.

    Parameters
    ----------
    text : str
        Marks along x and y of the plate, as in ``11x9``.
    where : str
        Place of the text, for errors.

    Attributes
    ----------
    contradicting : int
        Images whose markers or marks do not lie as on this plate, so that no marker is believed.

    Raises
    ------
    InputError
        If the text cannot be read, or OpenCV is not installed.
    """

    def __init__(self, text: str, where: str) -> None:
        shape = coded_shape(text, where)
        try:
            import cv2  # extra camera
        except ModuleNotFoundError as error:
            raise InputError(
                place_of(where, "aruco"),
                "OpenCV, which reads the markers, is not installed",
                "pip install 'selfcal_ros[camera]', or leave aruco out",
            ) from error
        self._shape = np.array(shape)
        self._centres = edge_markers(*shape)
        self.contradicting = 0
        parameters = cv2.aruco.DetectorParameters()
        parameters.detectInvertedMarker = True
        parameters.minMarkerPerimeterRate = 0.01
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        self._reader: Any = cv2.aruco.ArucoDetector(
            cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, DICTIONARY)),
            parameters,
        )

    def identified(
        self, marks: Sequence[Mark], picture: Picture, *, mirror: bool
    ) -> list[tuple[int, int] | MarkFault | None]:
        """Return the id (m, n) of each mark; None if it is not known, a fault if it is none.

        Parameters
        ----------
        marks : sequence of Mark
            Found in the image.
        picture : Picture
            The image.
        mirror : bool
            Whether it is mirrored, columns along -x.
        """
        values = picture.values[:, ::-1] if mirror else picture.values
        places = self._places(values)
        if places is None:
            return [None] * len(marks)
        last = values.shape[1] - 1
        pixels = np.array(
            [(last - mark.u if mirror else mark.u) - 1j * mark.v for mark in marks]
        )
        place_of, markers = places
        ids = [self._id(place_of(pixel), markers) for pixel in pixels.tolist()]
        if not _on_lattice(pixels, ids):
            self.contradicting += 1
            return [None] * len(marks)
        return ids

    def _places(self, values: np.ndarray) -> Any:
        """Return the function from pixel to plate, and the markers seen; None without them.

        Pixels are u - iv, places x + iy in pitches: a turn, a scale and a shift, by least squares.
        """
        corners, numbers, _ = self._reader.detectMarkers(stretched(values))
        if numbers is None:
            return None
        numbers = np.ravel(numbers)
        on_plate = numbers < len(self._centres)
        if not on_plate.any():
            return None
        markers = self._centres[numbers[on_plate]]
        pixels = np.reshape(corners, (-1, 4, 2))[on_plate]
        pixel = (pixels[..., 0] - 1j * pixels[..., 1]).ravel()
        place = (markers[:, None] + CORNERS) @ (1, 1j)
        (factor, shift), away = _similarity(pixel, place.ravel())
        if away > AGREE:
            self.contradicting += 1
            return None
        return lambda place_px: factor * place_px + shift, markers

    def _id(
        self, place: complex, markers: np.ndarray
    ) -> tuple[int, int] | MarkFault | None:
        point = np.array([place.real, place.imag])
        if (np.abs(markers - point).max(axis=1) < SIDE / 2 + 0.05).any():
            return MarkFault.MARKER
        index = point + (self._shape - 1) / 2
        nearest = np.round(index)
        if (
            np.abs(index - nearest).max() > NEAR
            or (nearest < 0).any()
            or (nearest >= self._shape).any()
        ):
            return None
        m, n = (nearest - self._shape // 2).astype(int).tolist()
        return m, n


def _similarity(pixel: np.ndarray, place: np.ndarray) -> tuple[np.ndarray, float]:
    """Return factor and shift from pixels to places, complex, and the largest residual."""
    columns = np.stack([pixel, np.ones_like(pixel)], axis=1)
    solution = np.linalg.lstsq(columns, place, rcond=None)[0]
    return solution, float(np.abs(columns @ solution - place).max())


def _on_lattice(
    pixels: np.ndarray, ids: Sequence[tuple[int, int] | MarkFault | None]
) -> bool:
    """Return whether most marks, at these pixels, have ids, which lie as on the plate.

    Otherwise a marker is read wrongly: one that is cut by the border of the image may have another
    size, which shows at marks that are far from it. One mark without an id may be a speck.
    """
    has_id = np.array([isinstance(mark_id, tuple) for mark_id in ids], dtype=bool)
    others = sum(mark_id is None for mark_id in ids)
    if others > 1 and others >= has_id.sum():
        return False
    if not has_id.any():
        return True
    place = np.array(
        [complex(*mark_id) for mark_id in ids if isinstance(mark_id, tuple)]
    )
    return _similarity(pixels[has_id], place)[1] <= AGREE
