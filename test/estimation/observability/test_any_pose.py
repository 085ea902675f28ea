# SPDX-License-Identifier: Apache-2.0
"""Views at any pose: the pattern search, and the suggestions that come of it."""

import math
from dataclasses import replace

import pytest

from selfcal_ros.estimation.observability.suggest import (
    best_plan,
    best_pose,
    pose_of_view,
    rank_next,
    reach_of,
    score_plan,
    start_poses,
    view_at,
)
from selfcal_ros.model.artifact import Artifact, MapGrid
from selfcal_ros.model.plan_form import plan_from_dict, plan_to_dict
from selfcal_ros.model.view import Plan, View

PLATE = Artifact(11, 0.01, 0, map_grid=MapGrid(7, 0.1 / 6))
PLAN = Plan(
    "aslant",
    PLATE,
    (
        View("first", angular=False, repeats=2),
        View("turned", math.radians(90), angular=False, repeats=2),
        View("moved", math.radians(37), (0.013, -0.007), angular=False, repeats=2),
    ),
)


@pytest.mark.parametrize("target", [(217, 1.4, -0.8), (359, -0.3, 1.7), (45, 0.0, 0.0)])
def test_the_search_finds_the_minimum_to_a_degree_and_a_tenth(target):
    def value(pose):
        turn = math.radians(pose[0] - target[0])
        return (
            1
            - math.cos(turn)
            + sum((a - b) ** 2 for a, b in zip(pose[1:], target[1:], strict=True)),
        )

    assert best_pose(start_poses(2.0), 2.0, value) == target


def test_the_search_keeps_within_its_reach():
    assert best_pose([(0, 0.0, 0.0)], 1.6, lambda pose: (-pose[1] - 2 * pose[2],)) == (
        0,
        1.6,
        1.6,
    )


@pytest.mark.parametrize(("size", "reach"), [(5, 1.0), (9, 1.6), (11, 2.0), (41, 8.0)])
def test_the_reach_is_a_fifth_of_the_plate_and_at_least_a_pitch(size, reach):
    assert reach_of(Artifact(size, 0.01)) == reach


def test_a_pose_is_read_from_the_view_that_it_makes():
    view = view_at(View("", repeats=3), (217, 1.4, -0.8), 0.01)
    assert view.name == "217deg+1.4x-0.8y" and view.repeats == 3
    assert view.rotation_rad == pytest.approx(math.radians(217))
    assert view.translation_m == pytest.approx((0.014, -0.008))
    assert pose_of_view(view, 0.01) == (217, 1.4, -0.8)


def test_a_plan_of_any_pose_gets_a_view_of_any_pose():
    """It is better than every view on the lattice, and than its own neighbours."""
    now, ranked = rank_next(PLAN)
    best = ranked[0]
    found = pose_of_view(best.view, 0.01)
    lattice = [item.score.rms_xy for item in ranked[1:] if item.repeat_of is None]
    assert best.score.rms_xy < 0.95 * min(lattice) < 0.95 * now.rms_xy
    for change in ((1, 0, 0), (-1, 0, 0), (0, -0.1, 0), (0, 0, 0.1)):
        near = tuple(a + b for a, b in zip(found, change, strict=True))
        if max(map(abs, near[1:])) <= reach_of(PLATE):
            views = (*PLAN.views, view_at(best.view, near, 0.01))
            assert (
                score_plan(replace(PLAN, views=views), repeats=2).rms_xy
                >= best.score.rms_xy
            )
    plan = replace(PLAN, views=best.views)
    again = plan_from_dict(plan_to_dict(plan), "plan")
    assert score_plan(again, repeats=2).rms_xy == pytest.approx(
        best.score.rms_xy, rel=1e-9
    )


def test_the_best_plan_of_any_pose_is_no_worse_than_that_on_the_lattice():
    plate = Artifact(7, 0.01, 0, map_grid=MapGrid(5, 0.06 / 4))
    plan, score, _ = best_plan(plate, 3, angular=False)
    lattice, _, _ = best_plan(replace(plate, map_grid=None), 3, angular=False)
    on_the_lattice = score_plan(replace(plan, views=lattice.views))
    assert score.rms_xy < on_the_lattice.rms_xy
    assert score == score_plan(plan)
    assert plan.views[0].rotation_rad == 0 and plan.views[0].translation_m == (0.0, 0.0)


def test_a_plan_on_the_lattice_gets_views_on_the_lattice():
    plan = replace(PLAN, artifact=replace(PLATE, map_grid=None), views=PLAN.views[:1])
    _, ranked = rank_next(plan)
    views = [item.view for item in ranked if item.view is not None]
    assert all(math.degrees(view.rotation_rad) % 90 == 0 for view in views)
