# SPDX-License-Identifier: Apache-2.0
"""The normal equations of measured plans, kept for further readings of the same marks."""

import hashlib
from collections import OrderedDict
from threading import Lock

from selfcal_ros.estimation.lattice.readings import AngularData, GridData
from selfcal_ros.estimation.normal.angular import AngularSystem
from selfcal_ros.estimation.normal.equations import NormalEquations
from selfcal_ros.estimation.normal.grid import GridSystem

CACHED = 16
CACHED_READINGS = 4_000_000
"""Limits of the cache: number of plans, and readings in all of them together."""


_cache: OrderedDict[tuple, NormalEquations] = OrderedDict()
_lock = Lock()


def system_for(grid: GridData, angular: AngularData) -> NormalEquations:
    """Return the system of a measured plan, from the cache if the same marks were read."""
    digest = hashlib.blake2b(grid.weight, digest_size=16)
    digest.update(angular.weight)
    key = (grid.weight.shape, grid.poses, grid.index, angular.weight.shape, angular.turns,
           angular.index, digest.digest())
    with _lock:
        if key in _cache:
            _cache.move_to_end(key)
            return _cache[key]
    system = NormalEquations(GridSystem(grid.poses, grid.weight),
                             AngularSystem(angular.turns, angular.weight), grid.index,
                             angular.index)
    with _lock:
        _cache[key] = system
        while len(_cache) > 1 and (len(_cache) > CACHED or _cached_readings() > CACHED_READINGS):
            _cache.popitem(last=False)
    return system


def _cached_readings() -> int:
    return sum(system.grid.weight.size for system in _cache.values())


def clear_cache() -> None:
    """Forget all systems."""
    with _lock:
        _cache.clear()
