# SPDX-License-Identifier: Apache-2.0
"""Machines that have changed and machines that have not: type I error, detection, coverage."""

import numpy as np
import pytest
from scipy.stats import binom

from tools.rechecking import Case, run

MACHINES = 3


@pytest.mark.parametrize("plan", ["lattice", "general six"])
def test_five_of_hundred_unchanged_machines_are_said_to_have_changed(plan):
    """And those with three nodes moved by ten u are found; the new map has its U at the nodes.

    On the lattice three marks may have changed as well as the stage at their sites.
    """
    same, other = (
        [run(Case(plan, seed, size)) for seed in range(MACHINES)] for size in (0, 10.0)
    )
    assert all(qualified for qualified, *_ in same)
    assert sum(changed for _, changed, *_ in same) <= binom.ppf(0.999, MACHINES, 0.05)
    assert sum(changed for _, changed, *_ in other) >= 0.9 * MACHINES
    inside, ratio = np.array([one[2:] for one in (*same, *other)]).T
    # nodes of a map are correlated: machines scatter by some 3 % each
    assert np.mean(inside) == pytest.approx(0.9545, abs=0.025)
    assert np.sqrt(np.mean(ratio**2)) == pytest.approx(1.0, abs=0.05)
