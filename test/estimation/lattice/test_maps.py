# SPDX-License-Identifier: Apache-2.0
"""Which site a mark comes to lie on, mark by mark, also where views leave the field."""

import numpy as np
import pytest

from selfcal_ros.estimation.lattice.maps import LatticeViews
from selfcal_ros.model.pose import LatticePose

TURNS = [
    np.array(rows)
    for rows in (
        [[1, 0], [0, 1]],
        [[0, -1], [1, 0]],
        [[-1, 0], [0, -1]],
        [[0, 1], [-1, 0]],
    )
]


@pytest.mark.parametrize(
    "shift",
    [
        (0, 0),
        (1, 0),
        (0, -2),
        (-2, 1),
        (4, 0),
        (5, 0),
        (0, 3),
        (0, -3),
        (-7, 1),
        (9, 9),
        (-9, -9),
    ],
)
@pytest.mark.parametrize(
    ("shape", "q"),
    [
        ((5, 5), 0),
        ((5, 5), 1),
        ((5, 5), 2),
        ((5, 5), 3),
        ((5, 3), 0),
        ((5, 3), 2),
        ((1, 7), 0),
    ],
)
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


POSES = (
    LatticePose(1, (1, 0), None),
    LatticePose(0, (0, 0), None),
    LatticePose(3, (-2, 1), None),
    LatticePose(2, (0, -1), None),
)
HALF, SIDE = 2, 5


def dense(pose):
    """Return what takes a field at the sites to the marks of a view, i^-q, complex (25, 25)."""
    out = np.zeros((SIDE**2, SIDE**2), dtype=complex)
    for m in range(-HALF, HALF + 1):
        for n in range(-HALF, HALF + 1):
            i, j = TURNS[pose.q] @ [m, n] + pose.shift
            if max(abs(i), abs(j)) <= HALF:
                out[(m + HALF) * SIDE + n + HALF, (i + HALF) * SIDE + j + HALF] = (
                    -1j
                ) ** pose.q
    return out


def test_fields_go_to_the_marks_and_back_as_dense_matrices_take_them():
    rng = np.random.default_rng(1)
    views, matrices = LatticeViews((SIDE, SIDE), POSES), [dense(pose) for pose in POSES]
    field = rng.normal(size=(SIDE, SIDE, 2)) @ [1, 1j]
    marks = rng.normal(size=(4, SIDE, SIDE, 2)) @ [1, 1j]
    gathered = [(matrix @ field.ravel()).reshape(SIDE, SIDE) for matrix in matrices]
    back = [
        (matrix.conj().T @ one.ravel()).reshape(SIDE, SIDE)
        for matrix, one in zip(matrices, marks, strict=True)
    ]
    assert views.gather(field) == pytest.approx(np.array(gathered))
    assert views.scatter(marks) == pytest.approx(np.sum(back, axis=0))
    for index in range(4):
        out = field.copy()
        views.add_scattered(out, index, marks[index])
        assert out == pytest.approx(field + back[index])


@pytest.mark.parametrize("q", range(4))
@pytest.mark.parametrize("shift", [(5, 0), (0, -7), (9, 9)])
def test_a_view_that_leaves_the_field_adds_nothing(shift, q):
    views = LatticeViews((SIDE, SIDE), (LatticePose(q, shift, None), POSES[1]))
    field, out = np.zeros((2, SIDE, SIDE), dtype=complex)
    views.add_scattered(out, 0, field + 1)
    assert not out.any() and not views.gather(field + 1)[0].any()


def test_a_mark_and_its_index_name_each_other():
    views = LatticeViews((5, 3), (LatticePose(0, (0, 0), None),))
    assert views.mark_at(0, 0) == (-2, -1)
    assert views.mark_at(4, 1) == (2, 0)
    for index in np.ndindex(5, 3):
        assert views.index_of(*views.mark_at(*index)) == index
