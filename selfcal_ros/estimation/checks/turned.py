# SPDX-License-Identifier: Apache-2.0
"""Offsets of a camera turned by quarters or mirrored, and lines of the other sign, without stops.

A stage that rests on the marks does not show how the offsets follow it (`wiring`). But the plate
never lies exactly as planned, and its displacement and turn differ from view to view: offsets D o
for the true o fit one rigid plate only for the right D, apart from an overall sign of marks and
lines together.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from selfcal_ros.estimation.checks.wiring import WiringError
from selfcal_ros.model.readings import GridVisits, Measurements, RepeatMotion, ViewReadings


@dataclass(frozen=True, eq=False)
class Turned:
    """Another wiring of the offsets.

    Attributes
    ----------
    of_offsets : float array (2, 2)
        D: the published offset is D times the true one.
    of_lines : int
        Sign of the published offset_theta; -1 = the other one.
    what : str
        In words.
    """

    of_offsets: np.ndarray
    of_lines: int
    what: str


TURN, MIRROR = np.array([[0.0, -1.0], [1.0, 0.0]]), np.diag([-1.0, 1.0])
AS_IS = Turned(np.eye(2), 1, "the offsets are as they are published")
OTHER_LINES = Turned(np.eye(2), -1, "offset_theta has the other sign, or the offsets are turned "
                     "by 180°")
PAIRS = (
    (Turned(TURN, 1, "the offsets are turned by 90° counter-clockwise"),
     Turned(-TURN, 1, "the offsets are turned by 90° clockwise")),
    (Turned(MIRROR, 1, "offset_x has the other sign"),
     Turned(-MIRROR, 1, "offset_y has the other sign")),
    (Turned(-TURN @ MIRROR, 1, "offset_x and offset_y are exchanged"),
     Turned(TURN @ MIRROR, 1, "offset_x and offset_y are exchanged, both with the other sign")))
"""Wirings that grid marks do not distinguish: the lines do."""


def turned_readings(measurements: Measurements, wiring: Turned) -> Measurements:
    """Return the readings as they are with true offsets, if the published ones have this wiring."""
    return replace(measurements, views=tuple(_undone(view, wiring) for view in measurements.views))


def shows_offsets(measurements: Measurements) -> bool:
    """Return whether the offsets of all grid marks are known, one mark an image."""
    return not measurements.has_images and all(
        view.visits is not None or not len(view.m) for view in measurements.views)


def turned_error(measurements: Measurements, found: Sequence[Turned]) -> WiringError:
    """Return the error for the wirings with which alone the readings agree."""
    what = ", or ".join(wiring.what for wiring in found)
    return WiringError(
        f"plan '{measurements.plan_id}', stage/mark_detections", f"{what}: only so do the "
        "readings of all views agree", "publish mark - optical axis along the stage's axes (a "
        "camera: --turn and --mirror, `selfcal camera init` finds them); check_stops in the plan "
        "show it in the first view")


def _undone(view: ViewReadings, wiring: Turned) -> ViewReadings:
    """Return the readings of a view with true offsets, if the published ones had this wiring."""
    back = wiring.of_offsets.T
    view = replace(view, dtheta=wiring.of_lines * view.dtheta, motion_theta=_turned_motion(
        view.motion_theta, np.array([[wiring.of_lines]])))
    if view.visits is None:
        return view

    visits = view.visits
    offset = np.stack([visits.offset_x, visits.offset_y])
    change = (back - np.eye(2)) @ offset
    weight = visits.count / np.bincount(visits.mark, visits.count, len(view.m))[visits.mark]
    dx, dy = (np.bincount(visits.mark, weight * row, len(view.m)) for row in change)
    x, y = back @ offset
    turned: GridVisits = replace(visits, dx=visits.dx + change[0], dy=visits.dy + change[1],
                                 offset_x=x, offset_y=y)
    return replace(view, dx=view.dx + dx, dy=view.dy + dy, visits=turned,
                   motion=_turned_motion(view.motion, back))


def _turned_motion(motion: RepeatMotion | None, back: np.ndarray) -> RepeatMotion | None:
    """Return the sums over repeats with other offsets."""
    if motion is None:
        return None
    n = len(back)
    both = np.eye(2 * n)
    both[n:, n:] = back
    return replace(motion, products=both @ motion.products @ both.T)
