# SPDX-License-Identifier: Apache-2.0
"""Readings on the lattice, in a canonical form that does not depend on their order; view poses."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import cast

import numpy as np

from selfcal_ros.errors import InputError
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.pose import AnyPose
from selfcal_ros.model.readings import Measurements, ViewReadings
from selfcal_ros.model.view import View, rotations_of, with_sub_views


@lru_cache(maxsize=1024)
def pose_of(view: View, artifact: Artifact) -> AnyPose:
    """Return the pose of a view: on the lattice unless the map has a grid of its own.

    Raises
    ------
    InputError
        As `View.on_stage`.
    """
    return cast(AnyPose, view.on_stage(artifact))


def in_field(view: View, artifact: Artifact) -> np.ndarray:
    """Return the marks of a view that lie in the field, bool (nx, ny)."""
    pose = pose_of(view, artifact)
    places = artifact.places(artifact.m, artifact.n)
    return ~pose.beyond_field(np.stack(pose.site_of(*places)), artifact)


@dataclass(frozen=True, eq=False)
class Marks[Pose]:
    """Marks of one kind that were read, and how often.

    Attributes
    ----------
    poses : tuple
        Of their views: on the lattice or anywhere for the grid, turns in lines for lines; with
        harmonics those of the axis where it stood.
    weight : float array (views, *marks)
        Repeats, or (sigma / u)^2 where detections declare their uncertainty; 0 = not read.
    index : tuple of int
        Position of the views in the measurement.
    harmonics : int
        Of the map, if it is a Fourier series.
    rotations : tuple of int
        The first of the views that have the rotation of each view, see `rotations_of`.
    known_plate : bool
        Whether the plate is known.
    plate : Artifact, optional
        The plate, if the map has nodes of its own.
    """

    poses: tuple[Pose, ...]
    weight: np.ndarray
    index: tuple[int, ...]
    harmonics: int = 0
    rotations: tuple[int, ...] = ()
    known_plate: bool = False
    plate: Artifact | None = None

    @cached_property
    def _key(self) -> tuple:
        return (
            self.plate,
            self.poses,
            self.index,
            self.harmonics,
            self.rotations,
            self.known_plate,
            self.weight.shape,
            self.weight.tobytes(),
        )

    def __hash__(self) -> int:
        """Return that of all that the equations depend on."""
        return hash(self._key)

    def __eq__(self, other: object) -> bool:
        """Return whether other marks have the same equations."""
        return getattr(other, "_key", None) == self._key


@dataclass(frozen=True, eq=False)
class Deviations[Pose](Marks[Pose]):
    """Marks of one kind with their readings.

    Attributes
    ----------
    y : complex array (views, nx, ny), or float array (views, K)
        Deviations turned into the plate frame, m; or those of lines, rad. 0 where not read.
    sigma_declared : float
        Standard deviation of one reading as declared, m or rad; NaN if not declared.
    """

    y: np.ndarray = field(kw_only=True)
    sigma_declared: float = field(kw_only=True)


GridData = Deviations[AnyPose]
AngularData = Deviations[float]


def planned_readings(artifact: Artifact, views: Sequence[View]) -> Measurements:
    """Return the readings of planned views before they are measured, all 0: every mark and line.

    The cells of images are views of their own.
    """
    return Measurements(
        "", artifact, tuple(_planned(view, artifact) for view in with_sub_views(views))
    )


def _planned(view: View, artifact: Artifact) -> ViewReadings:
    out = ViewReadings(view)
    if view.grid:
        read = in_field(view, artifact)
        nothing = np.zeros(int(read.sum()))
        out = replace(
            out,
            m=artifact.m[read],
            n=artifact.n[read],
            dx=nothing,
            dy=nothing,
            count=np.full(len(nothing), view.repeats),
        )
    if view.angular and artifact.angular_count:
        lines = np.arange(artifact.angular_count)
        out = replace(
            out,
            k=lines,
            dtheta=np.zeros(len(lines)),
            count_theta=np.full(len(lines), view.repeats),
        )
    return out


def grid_data(measurements: Measurements) -> GridData:
    """Return the grid readings of all views that have any.

    Raises
    ------
    InputError
        If a mark does not exist, is outside the field, is duplicated, or is not a finite number.
    """
    artifact = measurements.artifact
    index = tuple(i for i, view in enumerate(measurements.views) if len(view.m))
    y = np.zeros((len(index), *artifact.shape), dtype=complex)
    weight = np.zeros(y.shape)
    poses, ones = [], []
    for row, i in enumerate(index):
        readings = measurements.views[i]
        pose = _grid_pose(readings, artifact)
        where = f"view '{readings.view.name}' grid readings"
        flat = _flat_marks(readings, artifact, where=where)
        _weigh(
            weight[row].reshape(-1),
            flat,
            values=(readings.dx, readings.dy),
            count=readings.count,
            where=where,
        )
        deviations = readings.dx + 1j * readings.dy
        y[row].reshape(-1)[flat] = deviations * pose.phase.conjugate()
        ones.append((flat, readings.u))
        poses.append(pose)
    sigma = _declare(weight, ones)
    return GridData(
        tuple(poses),
        weight,
        index,
        plate=artifact.placed,
        y=y,
        sigma_declared=sigma,
        rotations=rotations_of([measurements.views[i].view for i in index]),
    )


def angular_data(measurements: Measurements) -> AngularData:
    """Return the angular readings of all views that have any; InputError as `grid_data`."""
    artifact = measurements.artifact
    index = tuple(i for i, view in enumerate(measurements.views) if len(view.k))
    y = np.zeros((len(index), artifact.angular_count))
    weight = np.zeros(y.shape)
    turns, ones = [], []
    for row, i in enumerate(index):
        readings = measurements.views[i]
        where = f"view '{readings.view.name}' angular readings"
        turn = pose_of(readings.view, artifact).turn_lines
        k = np.asarray(readings.k)
        if turn is None or k.min() < 0 or k.max() >= artifact.angular_count:
            raise InputError(
                where,
                "a line that the plate does not have",
                f"lines are 0 to {artifact.angular_count - 1}",
            )
        _weigh(
            weight[row],
            k,
            values=(readings.dtheta,),
            count=readings.count_theta,
            where=where,
        )
        y[row, k] = readings.dtheta
        ones.append((k, readings.u_theta))
        about = readings.axis_theta * artifact.angular_count / (2 * np.pi)
        turns.append(turn + about if artifact.harmonics and about else turn)
    sigma = _declare(weight, ones)
    return AngularData(
        tuple(turns), weight, index, artifact.harmonics, y=y, sigma_declared=sigma
    )


def _grid_pose(readings: ViewReadings, artifact: Artifact) -> AnyPose:
    if not readings.view.on_stage(artifact).has_sites:
        raise InputError(
            f"view '{readings.view.name}'",
            "grid marks were read at a turn that is not a multiple of 90°",
            "turn by a multiple of 90°",
        )
    return pose_of(readings.view, artifact)


def _flat_marks(
    readings: ViewReadings, artifact: Artifact, *, where: str
) -> np.ndarray:
    """Return the flat index of every mark read, checked for plate and field."""
    m, n = np.asarray(readings.m), np.asarray(readings.n)
    if m.shape != n.shape:
        raise InputError(where, "m and n differ in length", "give one value a mark")
    off_plate = ~artifact.has(m, n)
    flat = np.where(off_plate, 0, artifact.flat(m, n))
    off_field = ~in_field(readings.view, artifact).reshape(-1)[flat]
    for name, bad in (
        ("off the plate", off_plate),
        ("off the stage's field", off_field),
    ):
        if bad.any():
            k = int(np.argmax(bad))
            raise InputError(
                where,
                f"mark ({m[k]}, {n[k]}) lies {name}",
                "check the view's pose and the plate's size",
            )
    return flat


def _weigh(
    weight: np.ndarray,
    flat: np.ndarray,
    *,
    values: tuple[np.ndarray, ...],
    count: np.ndarray,
    where: str,
) -> None:
    """Weigh the marks read, in place, by their counts; check these and the deviations."""
    if any(np.shape(of_marks) != flat.shape for of_marks in (*values, count)):
        raise InputError(
            where,
            "marks, deviations and counts differ in length",
            "give one value a mark",
        )
    if not all(np.isfinite(deviations).all() for deviations in values):
        raise InputError(where, "a deviation is not a finite number", "remove the mark")
    if np.min(count) < 1:
        raise InputError(where, "a count below 1", "leave out marks that were not read")
    weight[flat] = count
    if np.count_nonzero(weight) != len(flat):
        raise InputError(where, "a mark comes twice", "average its readings first")


def _declare(weight: np.ndarray, ones: list[tuple]) -> float:
    """Convert counts to (sigma / u)^2 where uncertainties are declared; also return sigma.

    Sigma is the rms of u sqrt(count) over the declared marks; marks without a declaration are
    treated as readings of that sigma.
    """
    if not any(len(u) for _, u in ones):
        return float("nan")
    total, number = 0.0, 0
    for row, (flat, u) in enumerate(ones):
        if len(u):
            good = np.isfinite(u) & (u > 0)
            # summed in lattice order: the result does not depend on the order of readings
            square = np.zeros(weight[row].size)
            square[flat[good]] = u[good] ** 2 * weight[row].reshape(-1)[flat[good]]
            total, number = total + float(square.sum()), number + int(good.sum())
    if not number:
        return float("nan")
    variance = total / number
    for row, (flat, u) in enumerate(ones):
        if len(u):
            good = np.isfinite(u) & (u > 0)
            weight[row].reshape(-1)[flat[good]] = variance / u[good] ** 2
    return float(np.sqrt(variance))
