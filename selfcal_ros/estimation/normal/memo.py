# SPDX-License-Identifier: Apache-2.0
"""Values derived from a system of equations, computed once in its lifetime."""

from collections.abc import Callable
from weakref import WeakKeyDictionary

from selfcal_ros.estimation.normal.equations import NormalEquations


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
