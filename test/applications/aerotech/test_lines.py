# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.applications.aerotech.evaluate import CalEvaluator
from selfcal_ros.applications.aerotech.export import (
    AxisCorrection,
    length_m,
    line_table,
    map_line,
    map_orthogonality,
    measured_line,
    orthogonality,
    without_slope,
)
from selfcal_ros.applications.aerotech.verify import plane_correction, verify_tables
from selfcal_ros.compensation.compensator import Compensator
from selfcal_ros.compensation.frame import MachineFrame
from selfcal_ros.compensation.residual import reached
from selfcal_ros.errors import InputError
from selfcal_ros.model.artifact import Artifact
from test.support.maps import first_order, random_map

ARTIFACT = Artifact(7, 0.01)
FRAMES = [
    MachineFrame(1, 2),
    MachineFrame(2, 1, unit="um", home_x_m=-0.03, home_y_m=0.01, reverse_x=True),
    MachineFrame(1, 2, unit="m", reverse_y=True, home_y_m=-0.03),
]


def smooth_map(gx, gy):
    """Return an error map from functions of x and y in m."""
    x, y = ARTIFACT.x_m, ARTIFACT.y_m
    emap = replace(random_map(ARTIFACT, 1), gx=gx(x, y) + 0 * x, gy=gy(x, y) + 0 * x)
    o, r = first_order(ARTIFACT, emap.gx, emap.gy)
    return replace(emap, nonorthogonality=o, scale_difference=r)


# Aerotech, Orthogonality Correction: 5 um over 200 mm, 900 mm of travel.
@pytest.mark.parametrize(
    ("home", "positions_mm", "corrections_um"),
    [
        ("end", [0, 900], [0, -22.5]),
        ("middle", [-450, 450], [0, -22.5]),
        ("middle-balanced", [-450, 450], [11.25, -11.25]),
    ],
)
def test_the_three_tables_of_the_source(home, positions_mm, corrections_um):
    line = orthogonality(5e-6, 0.2, 0.9, home)
    table = line_table(line, MachineFrame(1, 2), along="x", corrected="y")
    assert (table.axis, table.reference_axis) == (2, 1)
    entries = np.arange(2) * table.sample_dist - table.offset
    np.testing.assert_array_equal(entries, positions_mm)
    np.testing.assert_array_equal(table.values, corrections_um)
    assert table.correction_unit.divisor == 1000.0


def test_both_forms_for_a_home_in_the_middle_mean_the_same():
    at = {1: np.linspace(-500, 500, 11)}
    first, second = (
        CalEvaluator(
            [
                line_table(
                    orthogonality(5e-6, 0.2, 0.9, home),
                    MachineFrame(),
                    along="x",
                    corrected="y",
                )
            ]
        ).corrections(at)[2]
        for home in ("middle", "middle-balanced")
    )
    np.testing.assert_allclose(first, second, atol=1e-15)


def test_the_orthogonality_correction_cancels_what_the_indicator_showed():
    # The indicator showed +5 um of y over 200 mm of x: true y - commanded y = x / 40000.
    evaluator = CalEvaluator(
        [
            line_table(
                orthogonality(5e-6, 0.2, 0.9, "end"),
                MachineFrame(),
                along="x",
                corrected="y",
            )
        ]
    )
    x_mm = np.array([0.0, 200.0, 555.0, 900.0])
    error_mm = x_mm * (5e-3 / 200)
    np.testing.assert_allclose(
        error_mm + evaluator.corrections({1: x_mm})[2], 0, atol=1e-15
    )


@pytest.mark.parametrize(
    ("over", "travel", "name"),
    [(0.0, 1.0, "--over"), (1.0, -1.0, "--travel"), (float("nan"), 1.0, "--over")],
)
def test_lengths_must_be_positive(over, travel, name):
    with pytest.raises(InputError, match=f"{name}: .* is not a positive length"):
        orthogonality(1e-6, over, travel)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("5um", 5e-6),
        ("-5.5 µm", -5.5e-6),
        ("200mm", 0.2),
        ("1e3nm", 1e-6),
        (" 2m ", 2.0),
        (".5mm", 5e-4),
    ],
)
def test_lengths_with_units(text, value):
    assert length_m(text, "--over") == pytest.approx(value, rel=1e-12)


@pytest.mark.parametrize(
    "text", ["5", "um", "5 inch", "nan m", "1e999 m", "", "5umm", "٣mm"]
)
def test_lengths_without_sense(text):
    with pytest.raises(
        InputError, match=r"--over: .* is not a length; write a number with"
    ):
        length_m(text, "--over")


@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize("along", ["x", "y"])
def test_accuracy_and_straightness_tables_make_a_line_true(frame, along):
    other = "y" if along == "x" else "x"

    def wave(p):
        return 1e-6 * np.sin(200 * p)

    emap = smooth_map(
        lambda x, y: wave(x if along == "x" else y),
        lambda x, y: 2 * wave(x if along == "x" else y),
    )
    tables = [
        line_table(
            map_line(emap, along, corrected), frame, along=along, corrected=corrected
        )
        for corrected in (along, other)
    ]
    found = verify_tables(emap, tables, frame)
    assert found.sites.largest("before") > 1e-6 and found.sites.largest("after") < 1e-9
    flipped = [replace(table, negcor=True) for table in tables]
    assert verify_tables(emap, flipped, frame).worse


def test_straightness_has_no_slope():
    line = map_line(random_map(ARTIFACT, 3), "x", "y")
    flat = without_slope(line)
    assert np.polyfit(flat.positions_m, flat.corrections_m, 1) == pytest.approx(
        [0, 0], abs=1e-18
    )
    rest = line.corrections_m - flat.corrections_m
    np.testing.assert_allclose(np.diff(rest, 2), 0, atol=1e-20)


def test_a_slope_is_removed_about_the_middle_of_positions_that_start_at_home():
    x = np.arange(5) * 0.1
    flat = without_slope(
        AxisCorrection(x, np.array([1.0, 0, 0, 0, 1.0]) * 1e-6 + 3e-6 * x)
    )
    np.testing.assert_allclose(
        flat.corrections_m,
        np.array([0.6, -0.4, -0.4, -0.4, 0.6]) * 1e-6,
        rtol=0,
        atol=1e-18,
    )


@pytest.mark.parametrize(
    ("along", "half_m", "row"),
    [("x", 0.03, (slice(None), 2)), ("y", 0.02, (3, slice(None)))],
)
def test_the_lines_of_an_oblong_field_are_its_middle_ones_from_edge_to_edge(
    along, half_m, row
):
    emap = replace(random_map(Artifact(7, 0.01, 0, 5), 2), nonorthogonality=4e-6)
    for corrected, values in (("x", emap.gx), ("y", emap.gy)):
        line = map_line(emap, along, corrected)
        assert line.corrections_m.tolist() == values[row].tolist()
        assert line.positions_m[[0, -1]] == pytest.approx([-half_m, half_m])
    square = map_orthogonality(emap, along)
    assert square.positions_m.tolist() == pytest.approx([-half_m, half_m])
    assert square.corrections_m.tolist() == pytest.approx(
        [-8e-6 * half_m, 8e-6 * half_m]
    )


@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize("along", ["x", "y"])
def test_orthogonality_of_a_map_makes_the_axes_square(frame, along):
    o = 3e-5
    emap = smooth_map(lambda x, y: o * y, lambda x, y: o * x)
    other = "y" if along == "x" else "x"
    table = line_table(
        map_orthogonality(emap, along), frame, along=along, corrected=other
    )
    loaded = plane_correction(CalEvaluator([table]), frame)

    def angle(correct):
        """Angle between the true paths of the two axes, rad."""
        ends = np.array([[0.02, 0], [-0.02, 0], [0, 0.02], [0, -0.02]]).T
        x, y = reached(Compensator(emap), frame, ends, correct=correct)
        ax, ay = x[0] - x[1], y[0] - y[1]
        bx, by = x[2] - x[3], y[2] - y[3]
        return np.arctan2(ax * by - ay * bx, ax * bx + ay * by)

    assert angle(None) - np.pi / 2 == pytest.approx(2 * o, rel=1e-3)
    assert angle(loaded) == pytest.approx(np.pi / 2, abs=1e-8)


def test_measured_errors_are_opposed():
    line = measured_line("position,error\n10,1\n\n-10, 2.5\n0,-3\n", "d.csv", 1e-3)
    np.testing.assert_allclose(line.positions_m, [-0.01, 0, 0.01])
    np.testing.assert_allclose(line.corrections_m, [-2.5e-6, 3e-6, -1e-6])
    table = line_table(line, MachineFrame(3, 4), along="x", corrected="x")
    assert (table.axis, table.reference_axis, table.sample_dist, table.offset) == (
        3,
        None,
        10,
        10,
    )
    np.testing.assert_array_equal(table.values, [-2.5, 3, -1])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "d.csv:1: the header is not position,error"),
        ("# mm\nx,y\n1,2\n", "d.csv:2: the header is not position,error; begin with"),
        ("position,error\n1,2\n", "d.csv: 1 measured positions; give at least two"),
        ("position,error\n1,2\n2,x\n", "d.csv:3: not two numbers"),
        ("position,error\n1,2\n2,1_0\n", "d.csv:3: not two numbers"),
        ("position,error\n1,2\n2\n", "d.csv:3: not two numbers"),
        ("position,error\n1,nan\n2,0\n", "d.csv:2: not two numbers"),
        ("position,error\n1,1\n1,2\n", "not equidistant between 1 and 1"),
        ("position,error\n1,1\n2,2\n4,0\n", "not equidistant between"),
        ("position,error\n1,1\n2,2\n4,0\n7,1\n", "not equidistant between 1 and 2"),
    ],
)
def test_measured_errors_without_sense(text, message):
    with pytest.raises(InputError, match=message):
        measured_line(text, "d.csv", 1e-3)


def test_a_line_with_unknown_sites_is_refused():
    with pytest.raises(InputError, match="1 sites on its x axis are unknown"):
        map_line(random_map(ARTIFACT, 1, unknown=[(0, 3), (0, 0)]), "x", "y")
