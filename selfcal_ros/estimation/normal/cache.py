# SPDX-License-Identifier: Apache-2.0
"""Cache of normal equations, for further readings of the same marks."""

import hashlib
from collections import OrderedDict
from dataclasses import dataclass
from threading import Lock

import numpy as np

from selfcal_ros.estimation.lattice.readings import AngularData, GridData
from selfcal_ros.estimation.normal.angular import AngularSystem
from selfcal_ros.estimation.normal.equations import NormalEquations
from selfcal_ros.estimation.normal.grid import GridSystem
from selfcal_ros.model.view import LatticePose

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
    """

    poses: tuple[Pose, ...]
    weight: np.ndarray
    index: tuple[int, ...]


def system_for(grid: GridData, angular: AngularData) -> NormalEquations:
    """Return the system of a measured plan, from the cache if the same marks were read."""
    return system_of(Marks(grid.poses, grid.weight, grid.index),
                     Marks(angular.turns, angular.weight, angular.index))


def system_of(grid: Marks[LatticePose], angular: Marks[int]) -> NormalEquations:
    """Return the system of marks that were read, from the cache if present."""
    digest = hashlib.blake2b(grid.weight, digest_size=16)
    digest.update(angular.weight)
    key = (grid.weight.shape, grid.poses, grid.index, angular.weight.shape, angular.poses,
           angular.index, digest.digest())
    with _lock:
        if key in _cache:
            _cache.move_to_end(key)
            return _cache[key]
    system = NormalEquations(GridSystem(grid.poses, grid.weight),
                             AngularSystem(angular.poses, angular.weight), grid.index,
                             angular.index)
    with _lock:
        _cache[key] = system
        while len(_cache) > 1 and (len(_cache) > CACHED or _cached_readings() > CACHED_READINGS):
            _cache.popitem(last=False)
    return system


def _cached_readings() -> int:
    return sum(system.grid.weight.size for system in _cache.values())


def clear_cache() -> None:
    """Remove all systems."""
    with _lock:
        _cache.clear()
