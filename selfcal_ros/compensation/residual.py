# SPDX-License-Identifier: Apache-2.0
"""A simulated controller with loaded tables, and the residuals that it leaves.

The command is a position in the stage frame. The controller looks up the correction at the
commanded position, adds it, and drives until the encoder shows the sum; the true position of the
stage follows from its error G = indicated - true.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from selfcal_ros.compensation.compensator import Compensator
from selfcal_ros.compensation.frame import MachineFrame
from selfcal_ros.errors import InputError
from selfcal_ros.model.error_map import ErrorMap
from selfcal_ros.units import M_PER_MM

Correction = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
"""What a controller adds to commanded positions x, y; all in the unit of its frame."""
SETTLED = 60
"""Iterations that remove an active table; its slope is below a quarter."""


class Covering:
    """A correction that goes on beyond its nodes: what it adds, and the field of its nodes.

    Parameters
    ----------
    add : Correction
        What the controller adds.
    x, y : tuple of float
        First and last node along x and y, in the unit of the frame.
    """

    def __init__(
        self, add: Correction, x: tuple[float, float], y: tuple[float, float]
    ) -> None:
        self._add, self.field = add, tuple((min(ends), max(ends)) for ends in (x, y))

    def __call__(self, px: np.ndarray, py: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return what the controller adds at positions."""
        return self._add(px, py)


def require_known(error_map: ErrorMap) -> None:
    """Raise InputError if a site is unknown: a table has no holes."""
    missing = int((~error_map.valid).sum())
    if missing:
        raise InputError(
            "error map",
            f"{missing} sites are unknown, and a table has no holes",
            "measure them, or fill them from their neighbours (--fill)",
        )


@dataclass(frozen=True, eq=False)
class Residual:
    """Residuals true - commanded before and after, without their common shift.

    The zero bias of the controller, and the home position itself, move all positions by one
    constant; the calibration does not determine this constant (datum), so it is removed.

    Attributes
    ----------
    place : str
        "sites", "between" or "lines".
    position : float array (axes, P)
        Commanded positions, m or rad.
    before, after : float array (axes, P)
        Residuals without their mean, m or rad.
    shift_before, shift_after : float array (axes,)
        The means that were removed.
    """

    place: str
    position: np.ndarray
    before: np.ndarray
    after: np.ndarray
    shift_before: np.ndarray
    shift_after: np.ndarray

    def rms(self, state: str) -> float:
        """Return the root mean square of the residual vectors `state`: before or after."""
        return float(np.sqrt(np.mean(np.sum(np.square(getattr(self, state)), axis=0))))

    def largest(self, state: str) -> float:
        """Return the length of the largest residual vector `state`: before or after."""
        return float(np.sqrt(np.max(np.sum(np.square(getattr(self, state)), axis=0))))


def residual_of(
    place: str, position: np.ndarray, reached: list[np.ndarray]
) -> Residual:
    """Return the residuals from the positions reached before and after, (axes, P) each."""
    residuals = [true - position for true in reached]
    # A known site next to an unknown one cannot be inverted exactly: omit it.
    finite = np.isfinite(residuals).all(axis=(0, 1))
    if not finite.any():
        raise InputError("error map", "no site can be verified", "measure more sites")
    residuals = [residual[:, finite] for residual in residuals]
    shifts = [residual.mean(axis=1) for residual in residuals]
    before, after = (r - s[:, None] for r, s in zip(residuals, shifts, strict=True))
    return Residual(place, position[:, finite], before, after, *shifts)


def reached(
    stage: Compensator,
    frame: MachineFrame,
    command: tuple[ArrayLike, ArrayLike],
    *,
    correct: Correction | None = None,
    active: Correction | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the true positions, m, after commands in the stage frame.

    Parameters
    ----------
    stage : Compensator
        The stage's error, including between its sites.
    frame : MachineFrame
        Wiring of the axes.
    command : tuple of float array
        Commanded x and y, m.
    correct : Correction, optional
        The loaded table; without it the machine is as it was when it was calibrated.
    active : Correction, optional
        The table that was loaded during the calibration and that `correct` replaces.
    """
    px, py = frame.to_machine(*command)
    if correct is not None:
        cx, cy = correct(px, py)
        px, py = px + cx, py + cy
        # what the controller showed with the former table at this place
        if active is not None:
            ex, ey = px, py
            for _ in range(SETTLED):
                cx, cy = active(px, py)
                px, py = ex - cx, ey - cy
    return stage.correct(*frame.from_machine(px, py))


def plane_of(error_map: ErrorMap) -> ErrorMap:
    """Return the map of x and y alone, without angles."""
    return replace(
        error_map,
        artifact=replace(error_map.artifact, angular_count=0, harmonics=0),
        g_theta=np.zeros(0),
        u_g_theta=np.zeros(0),
    )


def added_m(
    correct: Correction, frame: MachineFrame, px: np.ndarray, py: np.ndarray
) -> np.ndarray:
    """Return what a table adds at positions of the controller, stage axes, (2, ...), m."""
    cx, cy = correct(px, py)
    return np.stack([frame.sign_x * cx, frame.sign_y * cy]) * frame.unit_m


def plane_residuals(
    error_map: ErrorMap,
    frame: MachineFrame,
    correct: Correction,
    active: Correction | None = None,
) -> list[Residual]:
    """Return the residuals at the sites and, if all are known, between them.

    At the sites the map is the truth. Between them the truth is unknown: it is substituted by the
    cubic spline through the sites at the centres of the cells, so that the residual there is
    the error of the controller's interpolation.
    """
    plate, valid = error_map.artifact, error_map.valid
    plane = plane_of(error_map)
    places = [
        ("sites", np.stack([plate.x_m[valid], plate.y_m[valid]]), Compensator(plane))
    ]
    if valid.all():
        centres = np.stack(
            [
                along[:-1, :-1].ravel() + plate.grid_pitch_m / 2
                for along in (plate.x_m, plate.y_m)
            ]
        )
        places.append(("between", centres, Compensator(plane, method="bicubic")))
    return [
        residual_of(
            name,
            points,
            [
                np.stack(
                    reached(
                        stage,
                        frame,
                        (points[0], points[1]),
                        correct=table,
                        active=active,
                    )
                )
                for table in (None, correct)
            ],
        )
        for name, points, stage in places
    ]


def combined(error_map: ErrorMap, frame: MachineFrame, active: Correction) -> ErrorMap:
    """Return the map for the table that replaces `active`, loaded during the calibration.

    To be at p the controller then has to show p + G(p); with the former table this meant
    p + G(p) + c(p + G(p)) on the encoder, so the new correction is G(p) + c(p + G(p)).

    Raises
    ------
    InputError
        If the former table is too steep to be one of this stage.
    """
    plate = error_map.artifact
    px, py = frame.to_machine(plate.x_m + error_map.gx, plate.y_m + error_map.gy)
    added = added_m(active, frame, px, py)
    map_error = np.stack([error_map.gx, error_map.gy])
    limit_m = plate.grid_pitch_m / 4
    step_m = _steepest(added)
    if step_m > limit_m or _steepest(map_error + added) > limit_m >= _steepest(
        map_error
    ):
        raise _misfit(
            active,
            (px, py),
            f"changes by up to {step_m / M_PER_MM:.3g} mm between neighbouring sites "
            f"{plate.grid_pitch_m / M_PER_MM:g} mm apart",
            frame.unit,
        )
    gx, gy = map_error + added
    return replace(error_map, gx=gx, gy=gy)


def _steepest(fields: np.ndarray) -> float:
    """Return the largest step between neighbouring sites of fields (2, nx, ny)."""
    return max(float(np.nanmax(np.abs(np.diff(fields, axis=axis)))) for axis in (1, 2))


def _misfit(
    active: Correction, at: tuple[np.ndarray, np.ndarray], fault: str, unit: str
) -> InputError:
    """Return the refusal of an active table that is too steep at positions of the controller."""
    spans = [(float(np.nanmin(p)), float(np.nanmax(p))) for p in at]
    if isinstance(active, Covering) and any(
        max(low - first, last - high) > (last - first) / 4
        for (low, high), (first, last) in zip(active.field, spans, strict=True)
    ):
        table, stage = (
            "x from {:.4g} to {:.4g}, y from {:.4g} to {:.4g}".format(*x, *y)
            for x, y in (active.field, spans)
        )
        return InputError(
            "--onto",
            f"the active table covers only part of the field: {table} {unit}, the map "
            f"{stage}; beyond it the table {fault}",
            "name the table of this stage, in this unit (--unit)",
        )
    return InputError(
        "--onto", f"the active table {fault}", "is it that of this stage, in this unit?"
    )


def bends_between(
    error_map: ErrorMap, frame: MachineFrame, active: Correction
) -> float:
    """Return how far an active table bends between the nodes of a map, m.

    That is the largest difference to its linear interpolation, at every quarter of the cells. The
    table that replaces it has the nodes of the map and loses this.
    """
    plate = error_map.artifact
    x, y = (
        np.interp(np.arange(4 * len(p) - 3) / 4, np.arange(len(p)), p)
        for p in (plate.x_m[:, 0], plate.y_m[0])
    )
    left, right = (
        np.stack([np.interp(p, p[::4], unit) for unit in np.eye(len(p[::4]))], axis=1)
        for p in (x, y)
    )
    fields = active(*frame.to_machine(*np.meshgrid(x, y, indexing="ij")))
    return frame.unit_m * max(
        float(abs(c - left @ c[::4, ::4] @ right.T).max()) for c in fields
    )
