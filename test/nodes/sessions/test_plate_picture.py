# SPDX-License-Identifier: Apache-2.0
"""The plate as characters: drawn by hand, by blocks against the marks that each stands for."""

from math import pi

import pytest

from selfcal_ros.model.artifact import Artifact, MapGrid
from selfcal_ros.model.view import View
from selfcal_ros.nodes.sessions.watching import plate_picture

PLATE = Artifact(7, 0.01, 0, 5)


def test_marks_missing_marks_and_what_a_shift_leaves_out():
    """Shifted by a pitch along +x the marks at m = 3 lie off the field."""
    lines, step = plate_picture(
        PLATE, View("v", 0.0, (0.01, 0.0)), [(-3, 2), (0, -1)], 2, 20
    )
    assert step == 1
    assert lines == [".ooooo ", "oooooo ", "oooooo ", "ooo.oo ", "oooooo "]


def test_what_lies_behind_the_last_missing_mark_that_is_named_is_not_told():
    lines, _ = plate_picture(PLATE, View("v"), [(-3, -2), (1, 0)], 9, 20)
    assert lines == ["oooo???", "oooo???", "oooo.??", "ooooo??", ".oooo??"]


def test_what_is_not_told_begins_behind_the_last_of_three_named_marks():
    lines, _ = plate_picture(PLATE, View("v"), [(2, 1), (-3, -2), (0, 0)], 9, 20)
    assert lines == ["ooooo??", "ooooo.?", "ooo.oo?", "oooooo?", ".ooooo?"]


def test_nothing_is_drawn_where_nothing_is_told():
    assert plate_picture(PLATE, View("v"), [], 3, 20) == ([], 1)
    assert plate_picture(PLATE, View("v", 0.0, (0.07, 0.0)), [], 0, 20) == ([], 1)


@pytest.mark.parametrize(
    ("most", "step"), [(7, 1), (6, 2), (4, 2), (3, 3), (2, 4), (1, 7)]
)
@pytest.mark.parametrize(
    "missing", [[(3, 2)], [(-3, -2)], [(0, 0), (3, -2)], [(2, 1), (1, 1)]]
)
def test_of_several_marks_the_worst_shows(most, step, missing):
    lines, found = plate_picture(PLATE, View("v"), missing, len(missing), most)
    assert found == step
    expected = []
    for row in range(0, 5, step):
        blocks = [
            {
                (m, n)
                for m in range(-3 + column, min(-3 + column + step, 4))
                for n in range(-2 + row, min(-2 + row + step, 3))
            }
            for column in range(0, 7, step)
        ]
        expected.append(
            "".join("." if block & set(missing) else "o" for block in blocks)
        )
    assert lines == expected[::-1]


def test_a_placed_plate_shows_the_marks_over_the_map():
    """The turned and shifted plate reaches beyond the map with two corners and a side."""
    plate = Artifact(5, 0.01, map_grid=MapGrid(3, 0.02))
    view = View("v", pi / 4, (0.005, 0.0))
    lines, _ = plate_picture(plate, view, [(0, -1), (1, 0)], 2, 20)
    inside = view.pose.in_field(plate)
    assert 9 < inside.sum() < 25
    wanted = [
        ["o" if inside[m + 2, n + 2] else " " for m in range(-2, 3)]
        for n in range(2, -3, -1)
    ]
    wanted[3][2] = wanted[2][3] = "."
    assert lines == ["".join(row) for row in wanted]
