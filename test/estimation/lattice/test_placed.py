# SPDX-License-Identifier: Apache-2.0
"""Splines and maps of views at any pose."""

import numpy as np
import pytest

from selfcal_ros.compensation.cells import bicubic_cells, bilinear_cells
from selfcal_ros.estimation.lattice.maps import LatticeViews, MapSpline, PlacedViews
from selfcal_ros.estimation.lattice.readings import pose_of
from selfcal_ros.model.artifact import Artifact, Interpolation, MapGrid
from selfcal_ros.model.view import View
from test.support.placed import SIX, plate

CELLS = {"bilinear": bilinear_cells, "bicubic": bicubic_cells}


def views_of(artifact: Artifact, poses) -> PlacedViews:
    return PlacedViews(
        artifact,
        tuple(
            pose_of(
                View(
                    "",
                    np.radians(turn),
                    tuple(step * artifact.grid_pitch_m for step in shift),
                ),
                artifact,
            )
            for turn, shift in poses
        ),
    )


@pytest.mark.parametrize("how", CELLS)
@pytest.mark.parametrize(("nx", "ny"), [(3, 3), (5, 3), (7, 9)])
def test_the_spline_is_that_of_the_compensator(how, nx, ny):
    rng = np.random.default_rng(1)
    spline = MapSpline.of(Artifact(nx, 2e-3, 0, ny), Interpolation(how))
    field = rng.normal(size=(2, nx, ny))
    at = rng.uniform(-1, 1, (2, 50)) * [[nx // 2], [ny // 2]]
    x, y = CELLS[how](field).at(at[0] + nx // 2, at[1] + ny // 2)
    coefficients = spline.coefficients(field[0] + 1j * field[1]).ravel()
    found = spline.rows((at[0] + 1j * at[1]) * 2e-3) @ coefficients
    assert found == pytest.approx(x + 1j * y, abs=1e-13)


@pytest.mark.parametrize("how", CELLS)
def test_scatter_is_the_adjoint_of_gather(how):
    rng = np.random.default_rng(3)
    views = views_of(plate(9, 5, how), SIX)
    field = rng.normal(size=(5, 5)) + 1j * rng.normal(size=(5, 5))
    marks = rng.normal(size=(6, 9, 9)) + 1j * rng.normal(size=(6, 9, 9))
    inner = np.vdot(views.gather(field), marks)
    assert np.vdot(field, views.scatter(marks)) == pytest.approx(inner)
    summed = np.zeros((5, 5), dtype=complex)
    for number in range(6):
        views.add_scattered(summed, number, marks[number])
    assert summed == pytest.approx(views.scatter(marks))


def test_on_the_lattice_the_maps_are_those_of_the_lattice():
    poses = ((0, (0, 0)), (90, (1, 0)), (180, (0, -2)), (270, (0, 0)))
    artifact = Artifact(7, 10e-3, map_grid=MapGrid(7, 10e-3))
    placed = views_of(artifact, poses)
    bare = Artifact(7, 10e-3)
    lattice = LatticeViews(
        (7, 7),
        tuple(
            View(
                "", np.radians(turn), tuple(10e-3 * step for step in shift)
            ).lattice_pose(bare)
            for turn, shift in poses
        ),
    )
    field = np.random.default_rng(4).normal(size=(7, 7)) * (1 + 2j)
    assert placed.gather(field) == pytest.approx(lattice.gather(field), abs=1e-14)
    assert (placed.in_field == lattice.in_field).all()
    assert placed.z_sites == pytest.approx(lattice.z)


def test_several_fields_are_gathered_at_once():
    views = views_of(plate(7, 5), SIX)
    fields = np.random.default_rng(5).normal(size=(3, 5, 5)) + 0j
    together = views.gather(fields)
    assert together.shape == (3, 6, 7, 7)
    assert together[1] == pytest.approx(views.gather(fields[1]))


def test_a_mark_is_near_known_nodes_only_if_all_corners_of_its_cell_are():
    views = views_of(plate(9, 5, "bilinear"), [(20.0, (0.3, -0.2))])
    x, y = np.stack(views.from_corner).reshape(2, -1)
    inside = (x % 1 > 0.01) & (x % 1 < 0.99) & (y % 1 > 0.01) & (y % 1 < 0.99)
    inside &= (x > 0) & (x < 4) & (y > 0) & (y < 4)
    assert inside.sum() > 20
    for i in range(5):
        for j in range(5):
            nodes = np.ones((5, 5), dtype=bool)
            nodes[i, j] = False
            beside = (np.abs(x - i) < 1) & (np.abs(y - j) < 1)
            found = views.near(nodes).ravel()
            np.testing.assert_array_equal(found[inside], ~beside[inside])
