# SPDX-License-Identifier: Apache-2.0
"""Corrected G-code whose coordinates are worked out by hand."""

import math
import re

import numpy as np
import pytest

from selfcal_ros.applications.controllers.gcode import (
    Rewriter,
    commented,
    corrected_program,
)
from selfcal_ros.errors import InputError

SAID = {
    "grbl": "G21 G90 G17\n",
    "marlin": "G21\nG90\nM82\n",
    "klipper": "G21\nG90\nM82\n",
    "linuxcnc": "G21 G90 G17\nG64\n",
}


class Looked:
    """A correction by hand, and the points at which it is looked up, in mm."""

    def __init__(self, correct=lambda x, y: (0 * x, 0 * y)):
        self._correct, self.points = correct, []

    def __call__(self, x_m, y_m):
        self.points.append(np.stack([x_m, y_m], axis=1) * 1e3)
        return tuple(np.asarray(c) * 1e-3 for c in self._correct(x_m * 1e3, y_m * 1e3))


def roof(top):
    """Return a correction of y by 0.1 mm at x = top, 0 at x = 0 and twice the way."""
    return Looked(lambda x, y: (0 * x, 0.1 * (1 - abs(x - top) / top)))


def rewritten(
    text, correct=None, *, dialect="grbl", tolerance=1e-3, step=1.0, **kwargs
):
    """Return the lines of a corrected program, after those that say its modes.

    Tolerance and step in mm.
    """
    rewriter = Rewriter(
        correct or Looked(),
        dialect=dialect,
        tolerance_m=tolerance * 1e-3,
        step_m=step * 1e-3,
        **kwargs,
    )
    said = SAID[dialect]
    return corrected_program(said + text, "a.nc", rewriter).splitlines()[
        said.count("\n") :
    ]


def values(lines, letter):
    return [float(v) for line in lines for v in re.findall(rf"{letter}([-.\d]+)", line)]


def places(lines):
    return np.stack([values(lines, "X"), values(lines, "Y")], axis=1)


@pytest.mark.parametrize(
    ("arc", "centre", "first"),
    [
        ("G2 J-5", (0, -5), (1, -1)),
        ("G3 J-5", (0, -5), (-1, -1)),
        ("G2 I5", (5, 0), (1, 1)),
        ("G3 I5", (5, 0), (1, -1)),
        ("G3 I-5 F100", (-5, 0), (-1, 1)),
    ],
)
def test_a_circle_with_one_word_for_its_centre(arc, centre, first):
    """From (0, 0); `first` are the signs of the way at its beginning."""
    points = places(
        rewritten(f"G0 X0 Y0\n{arc}\n", tolerance=0.01, dialect="linuxcnc")[1:]
    )
    np.testing.assert_allclose(np.hypot(*(points - centre).T), 5, atol=1e-5)
    assert tuple(np.sign(points[0])) == first and tuple(points[-1]) == (0, 0)
    angle = np.unwrap(np.arctan2(*(np.vstack([[0, 0], points]) - centre).T[::-1]))
    assert abs(angle[-1] - angle[0]) == pytest.approx(2 * np.pi, abs=1e-9)


def test_the_radius_of_a_spiral_grows_with_the_angle():
    """From radius 10 mm to 10.0004 mm over 90 deg."""
    points = places(rewritten("G0 X10 Y0\nG3 X0 Y10.0004 I-10\n")[1:])
    turned = np.degrees(np.arctan2(points[:, 1], points[:, 0]))
    assert len(points) > 30 and turned[-1] == pytest.approx(90, abs=1e-9)
    np.testing.assert_allclose(
        np.hypot(*points.T), 10 + 0.0004 * turned / 90, atol=2e-5
    )


def test_a_quarter_is_split_once_where_that_suffices():
    """Radius 10 mm: 90 deg have a sagitta of 2.93 mm, 45 deg of 0.76 mm, within 7/8 of 1 mm."""
    points = places(
        rewritten("G0 X10 Y0\nG3 X0 Y10 J0 I-10\n", tolerance=1.0, step=0.1)[1:]
    )
    assert len(points) == 2 and tuple(points[1]) == (0, 10)
    assert np.hypot(*points[0]) == pytest.approx(10, abs=1e-5)
    assert math.degrees(math.atan2(*points[0][::-1])) == pytest.approx(45, abs=0.3)


@pytest.mark.parametrize(
    ("move", "length", "looks"),
    [
        ("G1 X30 Y0", 30, 2),
        ("G1 X18 Y24", 30, 2),
        ("G1 X41 Y0", 41, 3),
        ("G1 X19 Y0", 19, 1),
    ],
)
def test_the_correction_of_a_line_is_looked_up_at_steps(move, length, looks):
    correct = Looked()
    rewritten(f"G0 X0 Y0\n{move}\n", correct, step=20.0)
    gaps = np.hypot(*np.diff(correct.points[-1], axis=0).T)
    assert len(gaps) == looks and gaps == pytest.approx(length / looks)


@pytest.mark.parametrize(
    ("tolerance", "step", "looks"),
    [
        (8.0, 10.0, 4),  # 31.4 mm by steps of 10 mm
        (8.0, 8.0, 4),
        (8.0, 7.8, 5),
        (0.1, 100.0, 32),
    ],
)  # chords whose sagitta is 1/8 of the tolerance: 2 acos(1 - 1/800) = 0.1 rad
def test_the_correction_of_an_arc_is_looked_up_at_steps_and_chords(
    tolerance, step, looks
):
    """Half a circle of radius 10 mm, and of 2 m with all lengths 200 times as large."""
    for times in (1, 200):
        correct = Looked()
        rewritten(
            f"G0 X0 Y0\nG2 X{20 * times} Y0 I{10 * times}\n",
            correct,
            step=step * times,
            tolerance=tolerance * times,
        )
        points = correct.points[-1] / times
        assert len(points) == looks + 1
        np.testing.assert_allclose(np.hypot(*(points - [10, 0]).T), 10, rtol=1e-9)
        turned = np.degrees(np.arctan2(points[:, 1], points[:, 0] - 10))
        np.testing.assert_allclose(
            turned, 180 - 180 / looks * np.arange(looks + 1), atol=1e-6
        )


def test_what_lies_between_two_steps_is_found():
    """30 mm in two steps of up to 20 mm: the roof at 15 mm splits the line there."""
    lines = rewritten("G0 X0 Y0\nG1 X30 Y0 F100\n", roof(15), step=20.0)
    assert lines[1:] == ["G1 X15.0 Y0.1 F100", "G1 X30.0 Y0.0"]


@pytest.mark.parametrize(
    ("before", "move", "first", "last"),
    [
        ("G0 Z5\nG91\nG0 Z-1\nG90", "G1 X40 Y0 Z0", 2, 0),  # from 4 to 0
        ("G0 Z5", "G1 X40 Y0 Z-1", 2, -1),
        ("G0 Z5\nG91", "G1 X40 Y0 Z-1", -0.5, -0.5),
        ("G0 Z5\nG91\nG1 X40 Y0 Z-1\nG90\nG0 X0 Y0", "G1 X40 Y0 Z0", 2, 0),
    ],
)
def test_another_axis_shares_a_move_from_where_it_is(before, move, first, last):
    """The roof at 20 mm splits the move in halves."""
    lines = rewritten(f"G0 X0 Y0 Z9\n{before}\n{move}\n", roof(20))[-2:]
    assert values(lines, "Z") == [first, last]


@pytest.mark.parametrize("dialect", ["marlin", "klipper"])
@pytest.mark.parametrize(
    ("before", "e"),
    [
        ("M83", (1.5, 1.5)),
        ("M82\nG92 E1", (2, 3)),
        ("G92 E1\nG1 E2", (2.5, 3)),
        ("G91", (1.5, 1.5)),
        ("G91\nM83", (1.5, 1.5)),
        ("G92 E1\nM83\nM82", (2, 3)),
    ],
)
def test_an_extruder_has_its_own_kind_of_increments(dialect, before, e):
    lines = rewritten(f"G0 X0 Y0\n{before}\nG1 X40 Y0 E3\n", roof(20), dialect=dialect)
    assert values(lines[-2:], "E") == list(e)


@pytest.mark.parametrize(
    "before", ["M83\nG90", "G91\nM82", "M83\nG91\nM82\nG90\nG91\nM82"]
)
def test_marlin_1_and_2_read_e_after_g90_and_m83_differently(before):
    """Version 1: relative by G91 or M83; version 2: by the last of the four."""
    with pytest.raises(InputError, match="M82"):
        rewritten(
            f"G0 X0 Y0\nG92 E0\n{before}\nG1 X40 Y0 E3\n", roof(20), dialect="marlin"
        )


@pytest.mark.parametrize(
    ("unit", "scale", "x", "z"),
    [("G21", 1.0, "10.123", "0.3333"), ("G20", 25.4, "10.1235", "0.33333")],
)
def test_digits_one_more_in_inches_and_one_more_for_other_axes(unit, scale, x, z):
    """A split after 10 of 30 units that begin at 0.12346, Z from 0 to 1."""

    def correct(px, py):
        return 0 * px, np.interp(px / scale, [0, 10.12346, 31], [0, scale, 0])

    lines = rewritten(
        f"G91 {unit}\nG90\nG0 X0.12346 Y0 Z0\nG1 X30.12346 Y0 Z1\n",
        Looked(correct),
        decimals=3,
        tolerance=0.1,
        step=10 * scale * (1 + 1e-9),
    )
    assert re.fullmatch(rf"G1 X{x} Y1.0 Z{z}", lines[3]), lines
    assert len(lines) == 5 and lines[4].endswith(" Z1.0")


def test_other_words_of_a_split_move_stand_in_its_first_line():
    lines = rewritten(
        "G0 X0 Y0\nN7 g1 x40 S3 M8 F50 (a) ; b\nG4 P1\nG1 F50 ; kept\nZ1.50\n", roof(20)
    )
    assert lines[1:] == [
        "N7 G1 X20.0 Y0.1 S3 F50 M8 (a) ; b",
        "G1 X40.0 Y0.0",
        "G4 P1",
        "G1 F50 ; kept",
        "G1 Z1.50",
    ]


@pytest.mark.parametrize(
    "line", ["G64", "G64 P0.01 Q0", "g 64 ( merge )", "G64 P0", "G61.1"]
)
def test_path_modes_that_do_not_merge_are_kept(line):
    assert rewritten(line, dialect="linuxcnc") == [line]


@pytest.mark.parametrize(
    ("program", "head"),
    [
        ("G0 X0\n", "; one\n; two\nG0 X0\n"),
        ("%\r\nG0\r\n", "%\r\n; one\r\n; two\r\nG0\r\n"),
        ("\n %\nG0\n", "\n %\n; one\n; two\nG0\n"),
    ],
)
def test_comments_come_first(program, head):
    assert commented(program, ["one", "two"]) == head


def test_a_comment_has_no_character_that_acts():
    assert commented("G0\n", ["a!\u00b5?\nc"]).splitlines()[0] == "; a____c"
    assert len(commented("G0\n", ["x" * 300]).splitlines()[0]) == 202


@pytest.mark.parametrize(
    ("arc", "top"),
    [
        ("G2 J-8.6602540378", 10 - 75**0.5),
        ("G3 J8.6602540378", 75**0.5 - 10),
        ("G2 J8.6602540378", 10 + 75**0.5),
        ("G3 J-8.6602540378", -10 - 75**0.5),
    ],
)
def test_an_arc_bulges_to_the_side_of_its_sense(arc, top):
    """From (0, 0) to (10, 0), radius 10: the shorter way, or the longer one."""
    y = places(rewritten(f"G0 X0 Y0\n{arc} I5 X10\n", tolerance=1e-3))[:, 1]
    assert y[abs(y).argmax()] == pytest.approx(top, abs=2e-3)
    assert (y * np.sign(top) > -1e-3).all() or abs(top) > 10


def test_motion_along_a_line_keeps_its_pace():
    """A correction along the way that bends at the middle: there z is half its way."""
    along = Looked(lambda x, y: (0.1 * (1 - abs(x - 20) / 20), 0 * x))
    assert rewritten("G0 X0 Y0 Z0\nG1 X40 Z1", along)[1:] == [
        "G1 X20.1 Y0.0 Z0.5",
        "G1 X40.0 Y0.0 Z1.0",
    ]
