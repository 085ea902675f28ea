# SPDX-License-Identifier: Apache-2.0
"""Which site a mark comes to lie on, mark by mark, also where views leave the field."""

import numpy as np
import pytest

from selfcal_ros.estimation.lattice.maps import LatticeViews
from selfcal_ros.model.view import LatticePose

TURNS = [np.array(rows) for rows in ([[1, 0], [0, 1]], [[0, -1], [1, 0]], [[-1, 0], [0, -1]],
                                     [[0, 1], [-1, 0]])]


@pytest.mark.parametrize("shift", [(0, 0), (1, 0), (0, -2), (-2, 1), (4, 0), (5, 0), (0, 3),
                                   (0, -3), (-7, 1), (9, 9), (-9, -9)])
@pytest.mark.parametrize(("shape", "q"), [((5, 5), 0), ((5, 5), 1), ((5, 5), 2), ((5, 5), 3),
                                          ((5, 3), 0), ((5, 3), 2), ((1, 7), 0)])
def test_sites_of_marks(shape, q, shift):
    hx, hy = (shape[0] - 1) // 2, (shape[1] - 1) // 2
    expected = np.full(shape, -1)
    for m in range(-hx, hx + 1):
        for n in range(-hy, hy + 1):
            i, j = TURNS[q] @ [m, n] + shift
            if abs(i) <= hx and abs(j) <= hy:
                expected[m + hx, n + hy] = (i + hx) * shape[1] + j + hy
    views = LatticeViews(shape, (LatticePose(q, shift, None),))
    assert views.site_index[0].tolist() == expected.tolist()
    assert views.in_field[0].tolist() == (expected >= 0).tolist()
