# SPDX-License-Identifier: Apache-2.0
"""Exposures of a simulated camera instead of detections: all marks of the plate in its field."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from selfcal_ros.collection.inputs import Command, Detection, Kind
from selfcal_ros.errors import InputError
from selfcal_ros.model.readings import Sense
from selfcal_ros.model.view import Plan
from selfcal_ros.simulation import physics
from selfcal_ros.simulation.cell import Event
from selfcal_ros.simulation.machine import Truth
from selfcal_ros.simulation.rendering import Camera


@dataclass(frozen=True)
class Exposure:
    """An image to be rendered.

    Attributes
    ----------
    stamp_ns : int
        Its instant.
    offsets : float array (2, n)
        Offsets of its marks from the optical axis, stage axes, m.
    angle : float
        Direction of the plate's x axis, stage axes, rad.
    """

    stamp_ns: int
    offsets: np.ndarray
    angle: float


def exposures(truth: Truth, plan: Plan, camera: Camera, events: Iterable[Event], *,
              sense: Sense) -> Iterator[Event | Exposure]:
    """Yield `events` with an exposure for all grid detections of a stamp, which name their marks.

    The detected marks are at their offsets; the others lie around the first one as on the plate,
    turned by the yaw of the stage there, seen through the same microscope.
    """
    if truth.artifact.marks:
        raise InputError("camera", "images are rendered of lattices, the plate is a list of marks",
                         "simulate detections instead")
    (hx, hy), reach = truth.artifact.half, camera.reach_m
    m, n = (side.ravel() for side in np.mgrid[-hx:hx + 1, -hy:hy + 1])
    place, index, angle = np.zeros((2, 0)), -1, 0.0
    for _, group in groupby(events, key=lambda event: (event.stamp_ns, _is_grid(event))):
        found = list(group)
        for event in found:
            if isinstance(event, Command) and event.view is not None and event.view_index != index:
                index = event.view_index
                view = truth.placed_as(index, event.view)
                place, _ = physics.mark_places(truth, index, view, (m, n))
                angle = float(view.rotation_rad + truth.phi_rad[index])
        seen = {(event.m + hx) * (2 * hy + 1) + event.n + hy: (event.offset_x, event.offset_y)
                for event in found if isinstance(event, Detection) and _is_grid(event)}
        if not seen:
            yield from found
            continue
        first = next(iter(seen))
        away, stage = place - place[:, [first]], place[:, [first]]
        away = physics.with_yaw(truth, sense, -stage if sense is Sense.PLATE_MOVES else stage, away)
        offsets = np.array([seen[first]]).T + physics.seen_offset(truth, away)
        offsets[:, list(seen)] = np.array(list(seen.values())).T
        yield Exposure(found[0].stamp_ns, offsets[:, np.hypot(*away) < reach], angle)


def _is_grid(event: Event) -> bool:
    return isinstance(event, Detection) and event.kind == Kind.GRID
