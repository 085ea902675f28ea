# SPDX-License-Identifier: Apache-2.0
"""Equations as printed, on triangles that anybody can check."""

import numpy as np
import pytest

from selfcal_ros.applications.laser.identify import eq3
from selfcal_ros.errors import InputError


def test_the_length_of_a_diagonal_gives_the_other_side_of_the_triangle():
    found = eq3(np.array([5.0, 13.0]), np.array([3.0, 4.0]), np.array([4.0, 12.0]))
    assert found == pytest.approx([0.0, 1.0])


@pytest.mark.parametrize(
    ("r", "block"), [((5.0, 4.0), 2), ((3.0, 5.0), 1), ((4.0, 4.0), 1)]
)
def test_a_diagonal_not_longer_than_its_step_is_refused_by_its_block(r, block):
    with pytest.raises(InputError) as raised:
        eq3(np.array(r), np.array([3.0, 3.0]), np.array([4.0, 4.0]))
    assert str(raised.value) == (
        f"block {block}: the diagonal is shorter than the Y step; check the units and the steps"
    )
