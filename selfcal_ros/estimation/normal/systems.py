# SPDX-License-Identifier: Apache-2.0
"""Normal equations of plans, planned or measured, and what is computed once for each of them."""

import hashlib
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from threading import Lock
from weakref import WeakKeyDictionary

import numpy as np

from selfcal_ros.estimation.lattice.readings import (
    AngularData,
    AnyPose,
    GridData,
    MapPose,
    in_field,
    pose_of,
)
from selfcal_ros.estimation.normal.angular import AngularSystem, HarmonicSystem
from selfcal_ros.estimation.normal.equations import NormalEquations
from selfcal_ros.estimation.normal.grid import GridSystem
from selfcal_ros.estimation.normal.placed import PlacedEquations, PlacedSystem
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.pose import LatticePose
from selfcal_ros.model.view import View, rotations_of, with_sub_views

CACHED = 16
CACHED_READINGS = 4_000_000
"""Limits of the cache: number of plans, and of readings in all of them."""


_cache: OrderedDict[tuple, NormalEquations] = OrderedDict()
_lock = Lock()


@dataclass(frozen=True, eq=False)
class Marks[Pose]:
    """Marks of one kind that were read, and how often.

    Attributes
    ----------
    poses : tuple
        Of their views: lattice poses for the grid, turns in lines.
    weight : float array (views, ...)
        Weights of the marks on the plate.
    index : tuple of int
        Position of the views in the measurement.
    harmonics : int
        Of the map, if it is a Fourier series.
    rotations : tuple of int
        As of `GridSystem`.
    """

    poses: tuple[Pose, ...]
    weight: np.ndarray
    index: tuple[int, ...]
    harmonics: int = 0
    rotations: tuple[int, ...] = ()


def system_for(grid: GridData, angular: AngularData) -> NormalEquations:
    """Return the system of a measured plan, from the cache if the same marks were read."""
    return system_of(Marks(grid.poses, grid.weight, grid.index, rotations=grid.rotations),
                     Marks(angular.turns, angular.weight, angular.index, angular.harmonics))


def system_of(grid: Marks[AnyPose], angular: Marks[float]) -> NormalEquations:
    """Return the system of marks that were read, from the cache if present."""
    digest = hashlib.blake2b(grid.weight, digest_size=16)
    digest.update(angular.weight)
    key = (grid.weight.shape, grid.poses, grid.index, grid.rotations, angular.weight.shape,
           angular.poses, angular.index, angular.harmonics, digest.digest())
    with _lock:
        if key in _cache:
            _cache.move_to_end(key)
            return _cache[key]
    system = _equations(grid, angular)
    with _lock:
        _cache[key] = system
        while len(_cache) > 1 and (len(_cache) > CACHED or sum(
                known.grid.weight.size for known in _cache.values()) > CACHED_READINGS):
            _cache.popitem(last=False)
    return system


def _equations(grid: Marks[AnyPose], angular: Marks[float], *,
               rank_only: bool = False) -> NormalEquations:
    lines = lines_of(angular)
    placed = tuple(pose for pose in grid.poses if isinstance(pose, MapPose))
    if placed:
        return PlacedEquations(PlacedSystem(placed, grid.weight, rotations=grid.rotations), lines,
                               grid.index, angular.index)
    poses = tuple(pose for pose in grid.poses if isinstance(pose, LatticePose))
    return NormalEquations(GridSystem(poses, grid.weight, rotations=grid.rotations), lines,
                           grid.index, angular.index, rank_only=rank_only)


def lines_of(angular: Marks[float]) -> AngularSystem:
    """Return the equations of the angular readings."""
    if angular.harmonics and angular.poses:
        return HarmonicSystem(angular.poses, angular.weight, angular.harmonics)
    return AngularSystem(angular.poses, angular.weight)


def clear_cache() -> None:
    """Remove all systems."""
    with _lock:
        _cache.clear()


def planned_system(artifact: Artifact, views: Sequence[View], *,
                   rank_only: bool = False) -> NormalEquations:
    """Return the system of the planned views: every mark in the field, unit repeats.

    Parameters
    ----------
    artifact : Artifact
        The plate.
    views : sequence of View
        The plan; the cells of images are views of their own.
    rank_only : bool
        Whether only the rank is needed.
    """
    views = with_sub_views(views)
    grid_views = [(i, v) for i, v in enumerate(views) if v.grid]
    poses = tuple(pose_of(view, artifact) for _, view in grid_views)
    angular = [(i, v) for i, v in enumerate(views) if v.angular and artifact.angular_count]
    turns = tuple(pose_of(v, artifact).turn_lines or 0 for _, v in angular)
    field = np.array([in_field(pose, artifact) for pose in poses])
    weight = field.reshape(len(poses), *artifact.shape) * np.array(
        [v.repeats for _, v in grid_views], dtype=float)[:, None, None]
    lines = np.array([v.repeats for _, v in angular], dtype=float)
    return _equations(
        Marks(poses, weight, tuple(i for i, _ in grid_views),
              rotations=rotations_of([view for _, view in grid_views])),
        Marks(turns, np.ones((len(turns), artifact.angular_count)) * lines[:, None],
              tuple(i for i, _ in angular), artifact.harmonics), rank_only=rank_only)


class Memo[Key, Value]:
    """Values by system and key; the values must not reference the system.

    If two threads compute the same value at the same time, one of them is kept.
    """

    def __init__(self) -> None:
        self._values: WeakKeyDictionary[NormalEquations, dict[Key, Value]] = WeakKeyDictionary()

    def get(self, system: NormalEquations, key: Key, make: Callable[[], Value]) -> Value:
        """Return the value of `key` for `system`, computed by `make` the first time."""
        known = self._values.setdefault(system, {})
        if key not in known:
            known[key] = make()
        return known[key]
