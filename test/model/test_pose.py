# SPDX-License-Identifier: Apache-2.0
"""Poses off the lattice, and the grid of the map that they need."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from selfcal_ros.errors import InputError
from selfcal_ros.model.artifact import (
    Artifact,
    Interpolation,
    MapGrid,
    default_map_grid,
)
from selfcal_ros.model.pose import LatticePose, turn_in_lines
from selfcal_ros.model.view import MAX_SHIFT, View

PLATE = Artifact(11, 10e-3)


def test_the_nearest_mark_of_a_plate_with_an_even_and_an_odd_side():
    plate = Artifact(8, 0.01, grid_size_y=5)
    x, y = (plate.x_m / 0.01).ravel(), (plate.y_m / 0.01).ravel()
    for part in (-0.4, 0.4):
        m, n = plate.nearest(x + part, y - part)
        np.testing.assert_array_equal([m, n], [plate.m.ravel(), plate.n.ravel()])
    tall = Artifact(5, 0.01, grid_size_y=8)
    m, n = tall.nearest(
        (tall.x_m / 0.01).ravel() - 0.4, (tall.y_m / 0.01).ravel() + 0.4
    )
    np.testing.assert_array_equal([m, n], [tall.m.ravel(), tall.n.ravel()])


@pytest.mark.parametrize(
    ("degrees", "shift", "fits"),
    [
        (0, 0.0, True),
        (0, 0.5, False),
        (90, 0.0, False),
        (90, 0.5, True),
        (180, 0.0, True),
        (270, 0.5, True),
        (270, 1.0, False),
    ],
)
def test_a_plate_with_an_even_and_an_odd_side_fits_after_a_quarter_turn_and_half_a_pitch(
    degrees, shift, fits
):
    view = View("v", math.radians(degrees), (shift * 0.01, shift * 0.01), True, False)
    assert view.is_on_lattice(Artifact(8, 0.01, grid_size_y=5)) is fits


def test_places_turn_counter_clockwise_and_shift() -> None:
    """A mark on the plate's x axis, turned by 37 deg, then shifted."""
    pose = View("a", math.radians(37), (2e-3, -1e-3)).pose
    place = pose.places(PLATE, np.array([3]), np.array([0]))
    assert place[0] == pytest.approx(
        complex(
            0.03 * math.cos(math.radians(37)) + 2e-3,
            0.03 * math.sin(math.radians(37)) - 1e-3,
        )
    )


@pytest.mark.parametrize("quarter", range(-3, 8))
def test_quarter_turns_are_exact(quarter: int) -> None:
    """The places of a quarter turn are those of the lattice pose, bit for bit."""
    view = View("a", quarter * math.pi / 2, (10e-3, 0.0))
    m, n = np.array([3, -5, 0]), np.array([2, 4, -1])
    i, j = view.lattice_pose(PLATE).site_of(m, n)
    assert np.allclose(
        view.pose.places(PLATE, m, n), (i + 1j * j) * 10e-3, rtol=0, atol=1e-17
    )


def test_marks_on_the_edge_are_in_the_field() -> None:
    """The edge belongs to the field; a mark half a pitch beyond does not."""
    assert View("a").pose.in_field(PLATE).all()
    shifted = View("a", 0.0, (5e-3, 0.0)).pose.in_field(PLATE)
    assert shifted[:10].all() and not shifted[10].any()


def test_the_field_is_that_of_the_map() -> None:
    """A smaller map takes in fewer marks."""
    small = Artifact(11, 10e-3, map_grid=MapGrid(5, 15e-3))
    assert small.field_half_m == (30e-3, 30e-3)
    assert View("a").pose.in_field(small).sum() == 49
    assert small.field == Artifact(5, 15e-3) and PLATE.field is PLATE


@pytest.mark.parametrize(
    ("size", "nodes"), [(3, 3), (5, 5), (7, 5), (11, 7), (21, 15), (101, 51)]
)
def test_default_map_spans_the_plate(size: int, nodes: int) -> None:
    """Three quarters as many nodes as marks, over the same field."""
    grid = default_map_grid(Artifact(size, 1e-3))
    assert grid.size == nodes and grid.interpolation is Interpolation.BICUBIC
    assert (nodes - 1) * grid.pitch_m == pytest.approx((size - 1) * 1e-3)


def test_default_map_of_an_oblong_plate_reaches_beyond_no_mark() -> None:
    """Nodes of one pitch along both sides; the shorter side is covered as well."""
    plate = Artifact(21, 1e-3, 0, 9)
    grid = default_map_grid(plate)
    assert (grid.size, grid.size_y) == (15, 7)
    assert 3 * grid.pitch_m >= 4e-3


def test_maps_of_two_nodes_a_side_are_refused() -> None:
    with pytest.raises(InputError, match="map grid_size: 2 is not a number from 3 to"):
        Artifact(11, 10e-3, map_grid=MapGrid(2, 10e-3))


TURNS = st.sampled_from([0.0, 37.0, 45.0, 90.0, -90.0, 180.0, 211.0, 1e-4])


@given(
    st.integers(3, 9),
    st.integers(3, 9),
    TURNS,
    st.floats(-6, 6),
    st.floats(-6, 6),
    st.sampled_from([3, 4, 5, 9]),
)
def test_marks_in_the_field_of_a_map_are_counted_by_rows(nx, ny, turn, a, b, nodes):
    """The same marks as in `Pose.in_field`, row by row."""
    plate = Artifact(nx, 0.01, 0, ny, MapGrid(nodes, 0.012))
    view = View("v", math.radians(turn), (a * 0.01, b * 0.01))
    inside, pose = view.pose.in_field(plate), view.on_stage(plate)
    first, count = pose.mark_rows(plate)
    rows = (plate.n >= first[:, None]) & (plate.n < (first + count)[:, None])
    np.testing.assert_array_equal(rows, inside)
    assert pose.n_in_field(plate) == inside.sum()
    marks, sites = pose.marks_in_field(plate)
    np.testing.assert_array_equal(marks, [plate.m[inside], plate.n[inside]])
    places = view.pose.places(plate, *marks) / 0.01
    np.testing.assert_allclose(sites, [places.real, places.imag], rtol=0, atol=1e-12)


@pytest.mark.parametrize("degrees", [0, 90, 180, 270, 37])
def test_turning_back_undoes_a_turn(degrees):
    """And a turn goes counter-clockwise."""
    for plate in (PLATE, replace(PLATE, map_grid=MapGrid(7, 0.01))):
        if degrees % 90 and plate is PLATE:
            continue
        pose = View("v", math.radians(degrees)).on_stage(plate)
        turned = np.array(pose.turned(np.array(2.0), np.array(-3.0)))
        want = (2 - 3j) * np.exp(1j * math.radians(degrees))
        np.testing.assert_allclose(turned, [want.real, want.imag], atol=1e-12)
        np.testing.assert_allclose(pose.turned_back(*turned), [2, -3], atol=1e-12)


@pytest.mark.parametrize(
    ("view", "message"),
    [
        (
            View("v", math.nan),
            "view 'v' rotation: nan is not an angle; give a finite turn",
        ),
        (
            View("v", 0.0, (math.inf, 0.0)),
            "view 'v' translation: (inf, 0.0) are not two lengths; give",
        ),
        (
            View("v", 0.0, (0.0, -2e3)),
            "view 'v' translation: -200000 pitches are beyond every field",
        ),
        (
            View("v", 0.1),
            "view 'v' rotation: 0.381972 is not a whole number of angular line steps",
        ),
    ],
)
def test_poses_that_no_map_allows(view, message):
    """Not finite, far beyond every field, or between two lines that are to be read."""
    plate = Artifact(11, 0.01, 24, map_grid=MapGrid(7, 0.01))
    with pytest.raises(InputError) as caught:
        view.on_stage(plate)
    assert str(caught.value).startswith(message)


@pytest.mark.parametrize(
    ("shift", "refused"),
    [
        ((MAX_SHIFT, 0.0), False),
        ((0.0, -MAX_SHIFT), False),
        ((MAX_SHIFT + 1, 0.0), True),
        ((0.0, -MAX_SHIFT - 1), True),
    ],
)
def test_a_shift_along_one_axis_is_enough_to_be_refused(shift, refused):
    """100 000 pitches are the last that are taken."""
    view = View("v", 0.0, (shift[0] * 0.5, shift[1] * 0.5))
    plate = Artifact(11, 0.5)
    if refused:
        with pytest.raises(InputError, match="beyond every field"):
            view.on_stage(plate)
    else:
        assert view.on_stage(plate).site_of(0, 0) == shift


@pytest.mark.parametrize("quarters", range(4))
def test_a_quarter_turn_has_90_deg(quarters):
    assert LatticePose(quarters, (0, 0), None).turn_deg == 90 * quarters


def test_turns_of_a_fourier_map_are_whole_lines_to_rounding_alone():
    """A part of a line that is no rounding counts; on lines it would not be read at all."""
    plate = replace(Artifact(11, 0.01, 24), harmonics=5)
    line = 2 * math.pi / 24
    assert turn_in_lines(26 * line, plate) == 2
    assert turn_in_lines((3 + 1e-7) * line, plate) == pytest.approx(3 + 1e-7, abs=1e-11)
    assert turn_in_lines(-0.25 * line, plate) == pytest.approx(23.75)
