# SPDX-License-Identifier: Apache-2.0
"""What follows from a system of equations alone, computed once for as long as the system lives."""

from collections.abc import Callable
from weakref import WeakKeyDictionary

from selfcal_ros.estimation.normal.equations import NormalEquations


class Memo[Key, Value]:
    """Values by system and key; the values must not hold the system.

    Where two threads compute the same value at a time, one of the two equal ones is kept.
    """

    def __init__(self) -> None:
        self._values: WeakKeyDictionary[NormalEquations, dict[Key, Value]] = WeakKeyDictionary()

    def get(self, system: NormalEquations, key: Key, make: Callable[[], Value]) -> Value:
        """Return the value of `key` for `system`, made by `make` the first time."""
        known = self._values.setdefault(system, {})
        if key not in known:
            known[key] = make()
        return known[key]
