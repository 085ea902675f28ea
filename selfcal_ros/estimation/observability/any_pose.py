# SPDX-License-Identifier: Apache-2.0
"""The best pose of a view whose plate may lie anywhere, found by a pattern search.

Turns are tried in whole degrees and shifts in tenths of a pitch: a plate is not placed better than
that on purpose, and the uncertainty is flat about its minimum.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import product

from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.view import View

TURNS_DEG = (0, 30, 60, 90, 120, 150, 180, 210, 240, 270, 300, 330)
SHIFTS = ((0.0, 0.0), (0.5, 0.5), (1.3, -0.7), (-1.3, 0.7), (-0.5, 1.5), (0.5, -1.5))
"""Turns and shifts, in pitches, from which the search starts."""

STEPS = ((30, 1.0), (15, 0.5), (5, 0.2), (1, 0.1))
"""Steps of the turn, in degrees, and of the shift, in pitches, one after the other."""

REACH = 0.2
"""Largest shift along an axis, as a part of the plate: beyond it too few marks are in the field."""

REFINED = 5
"""Starts that are refined: there are several minima."""

Pose = tuple[int, float, float]
"""Turn in degrees, shift along x and y in pitches."""


def posed(view: View, pose: Pose, pitch_m: float) -> View:
    """Return the view at a pose, named after it."""
    turn, *shift = pose
    moved = "".join(f"{step:+g}{axis}" for step, axis in zip(shift, "xy", strict=True) if step)
    return replace(view, name=f"{turn}deg{moved}", rotation_rad=math.radians(turn),
                   translation_m=(shift[0] * pitch_m, shift[1] * pitch_m))


def pose_of_view(view: View, pitch_m: float) -> Pose:
    """Return the pose of a view, rounded to whole degrees and tenths of a pitch."""
    x, y = (round(part / pitch_m, 1) for part in view.translation_m)
    return round(math.degrees(view.rotation_rad)) % 360, x, y


def start_poses(reach: float) -> list[Pose]:
    """Return the poses from which a search starts, with shifts up to `reach` pitches."""
    return [(turn, *shift) for turn, shift in product(TURNS_DEG, SHIFTS)
            if max(map(abs, shift)) <= reach]


def reach_of(artifact: Artifact) -> float:
    """Return the largest shift to be tried on a plate, in pitches."""
    return max(1.0, round(REACH * (2 * min(artifact.reach)), 1))


def best_pose(starts: Sequence[Pose], reach: float,
              value: Callable[[Pose], tuple[float, ...]]) -> Pose:
    """Return the pose of the smallest value near one of the best starts.

    Parameters
    ----------
    starts : sequence
        Poses to begin with.
    reach : float
        Largest shift along an axis, in pitches.
    value : callable
        Key of a pose, the smallest is the best.
    """
    known: dict[Pose, tuple[float, ...]] = {}

    def key(pose: Pose) -> tuple[float, ...]:
        if pose not in known:
            known[pose] = value(pose)
        return known[pose]

    found = []
    for best in sorted(starts, key=key)[:REFINED]:
        for turn, shift in STEPS:
            while key(near := min(_neighbours(best, turn, shift, reach), key=key)) < key(best):
                best = near
        found.append(best)
    return min(found, key=key)


def _neighbours(pose: Pose, turn: int, shift: float, reach: float) -> Iterator[Pose]:
    """Yield the pose and its neighbours: turned, or shifted along one axis."""
    yield pose
    angle, x, y = pose
    for sign in (1, -1):
        yield (angle + sign * turn) % 360, x, y
        yield from ((angle, to + 0.0, y) for to in [round(x + sign * shift, 1)]
                    if abs(to) <= reach)
        yield from ((angle, x, to + 0.0) for to in [round(y + sign * shift, 1)]
                    if abs(to) <= reach)
