# SPDX-License-Identifier: Apache-2.0
"""Readings: what was measured of the marks, view by view."""

from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.view import View


class Sense(StrEnum):
    """Who moves: the microscope over a resting plate, or the plate under the microscope.

    With ``plate_moves`` the mark at X is measured with the stage at p = -X, so that the
    stage's part of a deviation is -G(-X), and -Gtheta(-k) (method, section 1).
    """

    MICROSCOPE_MOVES = "microscope_moves"
    PLATE_MOVES = "plate_moves"


def _empty(kind: type) -> field:
    return field(default_factory=lambda: np.zeros(0, dtype=kind))


@dataclass(frozen=True, eq=False)
class ViewReadings:
    """Deviations of one view: reading minus nominal position, stage frame, m and rad.

    Only marks that were read appear, sorted by (m, n) and by k, each once.

    Attributes
    ----------
    view : View
        The commanded view.
    m, n : int array (P,)
        Indices of the grid marks, plate frame.
    dx, dy : float array (P,)
        Mean deviation V of each mark, m.
    count : int array (P,)
        Repeats behind each mean.
    u : float array (P,) or (0,)
        Standard uncertainty of each mean as the detections declare it, m; empty = not known,
        and NaN for a single mark whose detections declared none.
    k, dtheta, count_theta, u_theta : arrays (Q,)
        The same for angular lines, rad.
    sigma_xy, sigma_theta : float
        Repeatability of one reading, pooled, m and rad; NaN if no mark was read twice.
    dof_xy, dof_theta : int
        Degrees of freedom of these.
    used : int
        Detections behind the means.
    rejected : dict
        Reason -> number of detections that were rejected.
    """

    view: View
    m: np.ndarray = _empty(int)
    n: np.ndarray = _empty(int)
    dx: np.ndarray = _empty(float)
    dy: np.ndarray = _empty(float)
    count: np.ndarray = _empty(int)
    u: np.ndarray = _empty(float)
    k: np.ndarray = _empty(int)
    dtheta: np.ndarray = _empty(float)
    count_theta: np.ndarray = _empty(int)
    u_theta: np.ndarray = _empty(float)
    sigma_xy: float = float("nan")
    sigma_theta: float = float("nan")
    dof_xy: int = 0
    dof_theta: int = 0
    used: int = 0
    rejected: dict[str, int] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Measurements:
    """All readings of one calibration.

    Attributes
    ----------
    plan_id : str
        Plan that was measured.
    artifact : Artifact
        The plate.
    views : tuple of ViewReadings
        In the order of their view_index.
    sense : Sense
        Sense of measurement, the same for all views.
    rejected : dict
        Reason -> number of detections that belong to no view.
    """

    plan_id: str
    artifact: Artifact
    views: tuple[ViewReadings, ...]
    sense: Sense = Sense.MICROSCOPE_MOVES
    rejected: dict[str, int] = field(default_factory=dict)

    def all_rejected(self) -> dict[str, int]:
        """Return reason -> count over all views and outside of them, sorted by reason."""
        total: dict[str, int] = {}
        for rejected in (self.rejected, *(view.rejected for view in self.views)):
            for reason, count in rejected.items():
                total[reason] = total.get(reason, 0) + count
        return dict(sorted(total.items()))
