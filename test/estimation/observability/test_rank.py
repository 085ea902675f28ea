# SPDX-License-Identifier: Apache-2.0
"""The rank by components and misalignments is that of the full matrix."""

from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.joint.solve import prepare
from selfcal_ros.estimation.lattice.maps import PHASES, LatticeViews
from selfcal_ros.estimation.normal.angular import AngularSystem
from selfcal_ros.estimation.normal.equations import NormalEquations, PlacedEquations
from selfcal_ros.estimation.normal.grid import GridSystem
from selfcal_ros.estimation.observability.rank import (
    identifies,
    measured_observability,
    plan_observability,
)
from selfcal_ros.estimation.options import Options
from selfcal_ros.model.artifact import Artifact, MapGrid
from selfcal_ros.model.pose import LatticePose
from selfcal_ros.model.readings import subset
from selfcal_ros.model.view import Plan, View
from selfcal_ros.reporting.words.observability import with_advice
from test.support.lattice_plans import plan_of
from test.support.placed import SIX, plate
from test.support.refusals import in_words, refused
from test.support.truth import random_truth, simulate_measurements

PLANS = [
    ((0, 0, 0), (1, 0, 0), (0, 1, 0)),
    ((0, 0, 0), (2, 0, 0), (0, 1, 0)),
    ((0, 0, 0), (0, 1, 0), (0, 0, 1)),
    ((0, 0, 0), (3, 1, 0), (0, 2, -1)),
    ((0, 0, 0), (1, 0, 0), (2, 0, 0), (3, 0, 0), (0, 0, 1)),
    ((0, 0, 0), (1, 0, 0)),
]


def test_more_nodes_than_readings_are_refused_by_the_count(monkeypatch):
    """50 nodes a side in place of 5: the search for views that help took an hour."""

    def never(system):
        raise AssertionError("the nodes were looked at one by one")

    monkeypatch.setattr(PlacedEquations, "known_sites", property(never))
    views = plan_of("0,90,tx", Artifact(7, 0.01, 0)).views
    assert not identifies(Artifact(7, 0.01, 0, map_grid=MapGrid(50, 0.06 / 49)), views)
    with pytest.raises(AssertionError):
        identifies(Artifact(7, 0.01, 0, map_grid=MapGrid(5, 0.06 / 4)), views)


def dense(grid: GridSystem) -> np.ndarray:
    """Return the real matrix of all grid readings over G, A, phi, tau."""
    n, views = grid.n_sites, grid.n_views
    index = grid.views.site_index.reshape(views, -1)
    z, rows = grid.views.z.ravel(), []
    for v, pose in enumerate(grid.views.poses):
        back = PHASES[-pose.q % 4]
        for m in np.flatnonzero(grid.read[v].ravel()):
            row = np.zeros(4 * n + 3 * views, dtype=complex)
            row[2 * index[v, m] : 2 * index[v, m] + 2] = back, 1j * back
            row[2 * n + 2 * m : 2 * n + 2 * m + 2] = 1, 1j
            row[4 * n + 3 * v : 4 * n + 3 * v + 3] = 1j * z[m], 1, 1j
            rows += [row.real, row.imag]
    return np.array(rows)


@pytest.mark.parametrize("shape", [(5, 5), (5, 7)])
@pytest.mark.parametrize("poses", PLANS)
@pytest.mark.parametrize("missing", [0.0, 0.2, 0.5, 0.8])
def test_rank_is_that_of_the_full_matrix(poses, shape, missing):
    rng = np.random.default_rng(int(100 * missing))
    views = tuple(LatticePose(pose[0], pose[1:], None) for pose in poses)
    field = LatticeViews(shape, views).in_field
    weight = (
        field * (rng.random(field.shape) >= missing) * rng.integers(1, 5, field.shape)
    )
    grid = GridSystem(views, weight.astype(float))
    joint = NormalEquations(
        grid, AngularSystem((), np.zeros((0, 0))), tuple(range(len(views))), ()
    )
    assert joint.rank_grid == np.linalg.matrix_rank(dense(grid), tol=1e-8)


@pytest.mark.parametrize(
    ("names", "needs"),
    [
        ("0", "turned by 90°"),
        ("0,90", "1 pitch along X"),
        ("0,tx", "turned by 90°"),
        ("0,180,tx,ty", "turned by 90°"),
        ("0,tx,ty", "turned by 90°"),
        ("0,90,180,270", "1 pitch along X"),
    ],
)
@pytest.mark.parametrize("lines", [0, 24])
def test_deficient_plans_are_refused_by_name(names, needs, lines):
    artifact = Artifact(7, 0.01, lines)
    plan = plan_of(names, artifact, lines=1 if lines else None)
    rng = np.random.default_rng(0)
    readings = simulate_measurements(
        random_truth(artifact, len(plan.views), rng), plan, rng
    )
    with refused(needs) as caught:
        calibrate(readings)
    assert "\n" not in str(with_advice(caught.value))
    seen = caught.value.observability
    assert not seen.identifiable
    assert seen.deficiency == plan_observability(plan).deficiency > 0
    assert seen.unknowns - seen.rank == seen.deficiency


def test_a_half_turn_spares_neither_the_quarter_turn_nor_the_shift():
    assert in_words(plan_observability(plan_of("0,180", Artifact(5, 0.01))).advice) == [
        "add a view turned by 90°",
        "add an unturned view shifted by +1 pitch along X",
    ]


def test_angular_views_without_a_line_turn_are_refused():
    artifact = Artifact(5, 0.01, 24)
    plan = plan_of("0,90,tx", artifact)
    rng = np.random.default_rng(0)
    readings = simulate_measurements(random_truth(artifact, 3, rng), plan, rng)
    with refused(r"5 modes undetermined.*1 line \(15°\)"):
        calibrate(readings)


def test_too_many_missing_marks_are_refused():
    artifact = Artifact(11, 0.01)
    plan = plan_of("0,90,tx", artifact)
    rng = np.random.default_rng(0)
    readings = simulate_measurements(
        random_truth(artifact, 3, rng), plan, rng, missing=0.7
    )
    with refused("read the missing marks: only"):
        calibrate(readings)


def test_without_a_mark_the_rank_is_that_of_what_is_read():
    """The full matrix of the readings, and seven degrees of freedom that the datum fixes."""
    artifact = Artifact(5, 0.01)
    plan = plan_of("0,90,tx", artifact)
    rng = np.random.default_rng(0)
    readings = simulate_measurements(random_truth(artifact, 3, rng), plan, rng)
    readings = replace(
        readings,
        views=tuple(
            subset(view, (view.m != 2) | (view.n != 2), np.ones(0, dtype=bool))
            for view in readings.views
        ),
    )
    system = prepare(readings, Options())[0].system
    seen = measured_observability(system, artifact, plan.views)
    assert seen.identifiable
    assert (
        seen.rank
        == seen.unknowns
        == np.linalg.matrix_rank(dense(system.grid), tol=1e-8) + 7
    )


@pytest.mark.parametrize(
    ("lines", "more"),
    [
        (1, []),
        (-1, []),
        (2, ["add an angular view turned by 1 line (45°)"]),
        (4, ["add an angular view turned by 1 line (45°)"]),
    ],
)
def test_a_turn_by_one_line_is_advised_where_none_tells_the_lines_apart(lines, more):
    seen = plan_observability(plan_of("0,90", Artifact(5, 0.01, 8), lines=lines))
    assert in_words(seen.advice) == [
        "add an unturned view shifted by +1 pitch along X",
        *more,
    ]


def test_a_view_of_a_single_mark_hides_its_own_rotation_alone():
    """The other rotations, all lines and all sites are as well known as without it."""
    poses = ((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1))
    views = tuple(LatticePose(pose[0], pose[1:], None) for pose in poses)
    weight = LatticeViews((5, 5), views).in_field.astype(float)
    weight[3] = 0
    weight[3, 3, 1] = 1
    lines = AngularSystem((0, 2, 1), np.ones((3, 8)))
    system = NormalEquations(GridSystem(views, weight), lines, (0, 1, 2, 3), (0, 1, 4))
    assert system.unseen.shape[1] == 1
    assert system.known_lines.all() and system.known_sites.all()
    rotations = system.known_views[0:12:3]
    assert rotations.tolist() == [True, True, True, False]


def test_unknowns_of_a_map_of_its_own_nodes():
    """Both parts of 49 nodes and 121 marks, three misalignments a view; nothing is lacking."""
    views = tuple(
        View(f"{number}", np.radians(turn), (x * 0.01, y * 0.01), True, False)
        for number, (turn, (x, y)) in enumerate(SIX)
    )
    seen = plan_observability(Plan("six", plate(11, 7), views))
    assert seen.identifiable and seen.deficiency == 0
    assert seen.rank == seen.unknowns == 2 * (49 + 121) + 3 * 6
