# SPDX-License-Identifier: Apache-2.0
"""Poses off the lattice, and the grid of the map that they need."""

import math

import numpy as np
import pytest

from selfcal_ros.errors import InputError
from selfcal_ros.model.artifact import Artifact, Interpolation, MapGrid, default_map_grid
from selfcal_ros.model.view import View

PLATE = Artifact(11, 10e-3)


def test_places_turn_counter_clockwise_and_shift() -> None:
    """A mark on the plate's x axis, turned by 37 deg, then shifted."""
    pose = View("a", math.radians(37), (2e-3, -1e-3)).pose
    place = pose.places(PLATE, np.array([3]), np.array([0]))
    assert place[0] == pytest.approx(
        complex(0.03 * math.cos(math.radians(37)) + 2e-3, 0.03 * math.sin(math.radians(37)) - 1e-3))


@pytest.mark.parametrize("quarter", range(-3, 8))
def test_quarter_turns_are_exact(quarter: int) -> None:
    """The places of a quarter turn are those of the lattice pose, bit for bit."""
    view = View("a", quarter * math.pi / 2, (10e-3, 0.0))
    m, n = np.array([3, -5, 0]), np.array([2, 4, -1])
    i, j = view.lattice_pose(PLATE).site_of(m, n)
    assert np.allclose(view.pose.places(PLATE, m, n), (i + 1j * j) * 10e-3, rtol=0, atol=1e-17)


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


@pytest.mark.parametrize(("size", "nodes"), [(3, 3), (5, 5), (7, 5), (11, 7), (21, 15), (101, 51)])
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


def test_maps_of_even_size_are_refused() -> None:
    """The map needs a node at the centre, as the plate a mark."""
    with pytest.raises(InputError, match="odd number"):
        Artifact(11, 10e-3, map_grid=MapGrid(6, 10e-3))
