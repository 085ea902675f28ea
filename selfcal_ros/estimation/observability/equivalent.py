# SPDX-License-Identifier: Apache-2.0
"""Plans that are mirror images or rotations of each other, with the same uncertainty."""

import math
from collections.abc import Iterable
from itertools import product

from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.view import View

TURNS = (1, 1j, -1, -1j)


def equivalent_key(artifact: Artifact, views: Iterable[View]) -> tuple:
    """Return a key that is the same for equivalent plans, from their turns and shifts.

    Turning stage and plate together renames sites and marks; so does mirroring both; turning the
    plate in all views renames the marks. A field that is not square has half of these symmetries.
    The uncertainty of XY is the same; that of theta need not be.

    Parameters
    ----------
    artifact : Artifact
        The plate.
    views : iterable of View
        Views of grid marks.
    """
    poses = [view.pose for view in views]
    steps = [(round(pose.turn_rad / (math.pi / 2), 9) % 4, complex(
        *(round(shift / artifact.grid_pitch_m, 6) for shift in pose.shift_m))) for pose in poses]
    turns = range(0, 4, 1 if artifact.shape[0] == artifact.shape[1] else 2)
    forms = list(product((False, True), turns, turns))
    return min(tuple(sorted(_moved(q, shift, *form) for q, shift in steps)) for form in forms)


def _moved(q: float, shift: complex, mirror: bool, stage: int,
           plate: int) -> tuple[float, float, float]:
    if mirror:
        q, shift = -q, shift.conjugate()
    shift = shift * TURNS[stage]
    return (q + plate) % 4, shift.real + 0.0, shift.imag + 0.0
