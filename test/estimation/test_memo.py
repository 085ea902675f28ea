# SPDX-License-Identifier: Apache-2.0
"""Values of a system are computed once, kept apart, and go with it."""

import gc
import weakref

from selfcal_ros.estimation.normal.equations import Memo, planned_system
from selfcal_ros.model.artifact import Artifact
from test.support.lattice_plans import plan_of


def system_of(names):
    plan = plan_of(names, Artifact(3, 0.01, 0))
    return planned_system(plan.artifact, plan.views)


def test_a_value_is_made_once_for_each_system_and_key():
    memo, made = Memo(), []
    one, other = system_of("0,90"), system_of("0,tx")

    def ask(system, key):
        return memo.get(
            system, key, lambda: made.append((system is one, key)) or len(made)
        )

    asked = (one, "a"), (one, "a"), (one, "b"), (other, "a"), (one, "b")
    assert [ask(system, key) for system, key in asked] == [1, 1, 2, 3, 2]
    assert made == [(True, "a"), (True, "b"), (False, "a")]


def kept(memo, system):
    """Return a weak reference to a value that the memo alone keeps."""
    value = Artifact(5, 0.01)
    memo.get(system, 0, lambda: value)
    return weakref.ref(value)


def test_values_go_with_their_system():
    memo, system = Memo(), system_of("0,90")
    value = kept(memo, system)
    gc.collect()
    assert value() is not None
    del system
    gc.collect()
    assert value() is None
