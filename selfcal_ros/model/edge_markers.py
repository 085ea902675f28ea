# SPDX-License-Identifier: Apache-2.0
"""ArUco markers around the lattice of a plate, by which a camera knows which marks it sees."""

import numpy as np

from selfcal_ros.errors import InputError

SIDE = 0.6
"""Side of a marker, pitches."""
AWAY = 1.0
"""Distance of a marker's centre from the outermost marks, pitches."""
MOST = 1000
"""Markers of the dictionary, `DICTIONARY`."""
DICTIONARY = "DICT_4X4_1000"
"""Name of the dictionary in OpenCV."""
CORNERS = np.array([(-1, 1), (1, 1), (1, -1), (-1, -1)]) * (SIDE / 2)
"""Corners of a marker about its centre, plate axes, pitches, in the order of OpenCV."""


def edge_markers(nx: int, ny: int) -> np.ndarray:
    """Return the centres of the markers of a lattice of nx x ny marks, plate axes, pitches, (n, 2).

    One stands beside each outermost mark; its number is its row here: along the lower side, the
    upper one, the left and the right one, each in the direction of its axis.

    Raises
    ------
    InputError
        If there are not as many markers.
    """
    if 2 * (nx + ny) > MOST:
        raise InputError(
            "aruco",
            f"{nx} x {ny} marks need {2 * (nx + ny)} markers",
            f"there are {MOST}: leave the markers out",
        )
    x, y = (np.arange(count) - (count - 1) / 2 for count in (nx, ny))
    low, left = y[0] - AWAY, x[0] - AWAY
    return np.concatenate(
        [
            np.stack(np.broadcast_arrays(*side), axis=1)
            for side in ((x, low), (x, -low), (left, y), (-left, y))
        ]
    )
