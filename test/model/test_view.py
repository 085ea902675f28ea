# SPDX-License-Identifier: Apache-2.0
"""Plates, views and plans: poses in whole steps, and what a PLAN.yaml may say."""

import math
from dataclasses import fields, replace

import numpy as np
import pytest

from selfcal_ros.blocks import BUILT_IN
from selfcal_ros.collection.inputs import Command
from selfcal_ros.collection.timeline import Timeline
from selfcal_ros.errors import InputError
from selfcal_ros.model.artifact import (
    Artifact,
    Interpolation,
    MapGrid,
    default_map_grid,
)
from selfcal_ros.model.plan_form import plan_from_dict, plan_to_dict
from selfcal_ros.model.readings import Measurements
from selfcal_ros.model.view import PLAN_KEYS, Plan, View, plan_keys, with_sub_views

PLATE = Artifact(11, 0.01, 24)
PLAN = {
    "plan_id": "p",
    "artifact": {"grid_size": 11, "grid_pitch": 0.01, "angular_count": 24},
    "views": [{"name": "a"}],
}


def plan_with(view=None, **keys):
    return {
        **PLAN,
        **keys,
        **({"views": [{"name": "a", **view}]} if view is not None else {}),
    }


@pytest.mark.parametrize(
    ("degrees", "quarter", "lines"),
    [
        (0, 0, 0),
        (90, 1, 6),
        (180, 2, 12),
        (270, 3, 18),
        (360, 0, 0),
        (-90, 3, 18),
        (-270, 1, 6),
        (450, 1, 6),
        (15, None, 1),
        (-15, None, 23),
        (90.001, 1, 6),
    ],
)
def test_turns_in_quarters_and_lines(degrees, quarter, lines):
    pose = View("v", math.radians(degrees), grid=quarter is not None).lattice_pose(
        PLATE
    )
    assert (pose.quarter_turns, pose.turn_lines) == (quarter, lines)


@pytest.mark.parametrize(
    ("pitches", "shift"),
    [
        ((0, 0), (0, 0)),
        ((1, -2), (1, -2)),
        ((0.9991, 0), (1, 0)),
        ((-3, 0.0009), (-3, 0)),
    ],
)
def test_translations_in_pitches(pitches, shift):
    view = View("v", 0.0, (pitches[0] * 0.01, pitches[1] * 0.01))
    assert view.lattice_pose(PLATE).shift == shift


@pytest.mark.parametrize("quarter", range(4))
def test_sites_are_turned_counter_clockwise_then_shifted(quarter):
    pose = View("v", quarter * math.pi / 2, (0.02, -0.01)).lattice_pose(PLATE)
    m, n = PLATE.m, PLATE.n
    turn = np.exp(1j * quarter * math.pi / 2)
    want = np.rint(np.stack([((m + 1j * n) * turn).real, ((m + 1j * n) * turn).imag]))
    np.testing.assert_array_equal(
        np.stack(pose.site_of(m, n)), want + np.array([2, -1])[:, None, None]
    )


def test_marks_have_no_sites_between_quarter_turns():
    pose = View("v", math.radians(15), grid=False).lattice_pose(PLATE)
    with pytest.raises(ValueError, match="only after whole quarter turns"):
        pose.site_of(1, 2)


@pytest.mark.parametrize(
    ("view", "plate", "message"),
    [
        (
            View("v", 0.0, (0.005, 0.0)),
            PLATE,
            "view 'v' translation: 0.5 is not a whole number of pitch steps; place "
            "the plate on the",
        ),
        (
            View("v", 0.0, (math.nan, 0.0)),
            PLATE,
            "view 'v' translation: (nan, 0.0) are not two length",
        ),
        (
            View("v", 0.0, (0.0, math.inf)),
            PLATE,
            "view 'v' translation: (0.0, inf) are not two length",
        ),
        (
            View("v", math.nan),
            PLATE,
            "view 'v' rotation: nan is not an angle; give a finite turn",
        ),
        (
            View("v", -math.inf),
            PLATE,
            "view 'v' rotation: -inf is not an angle; give a finite turn",
        ),
        (
            View("v", -1e300),
            PLATE,
            "view 'v' rotation: -5.72958e+301° are many turns of a plate; give it w",
        ),
        (
            View("v", math.radians(15)),
            PLATE,
            "view 'v': grid marks cannot be measured at a turn of 15°; turn by 90°, "
            "set grid to",
        ),
        (
            View("v", math.radians(7), grid=False),
            PLATE,
            "view 'v' rotation: 0.466667 is not a whole number of angular line steps",
        ),
        (
            View("v", math.radians(15), grid=False),
            Artifact(11, 0.01),
            "view 'v': a turn that is not a quarter needs angular lines; turn by a "
            "multiple of 90°",
        ),
    ],
)
def test_poses_off_the_lattice_are_refused(view, plate, message):
    with pytest.raises(InputError) as caught:
        view.lattice_pose(plate)
    assert str(caught.value).startswith(message)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            (2, 0.01),
            "artifact grid_size: 2 is not a number from 3 to 401; give the number of rows; "
            "marks in fewer rows as a list (artifact: {marks: FILE.csv})",
        ),
        ((1, 0.01), "artifact grid_size: 1 is not"),
        ((-3, 0.01), "artifact grid_size: -3 is not"),
        (
            (4003, 0.01),
            "artifact grid_size: 4003 rows of marks are more than 401; use every other",
        ),
        ((11, 0.01, 0, 2), "artifact grid_size_y: 2 is not"),
        ((11, 0.0), "artifact grid_pitch: 0.0 m is not a length"),
        ((11, -0.01), "artifact grid_pitch: -0.01 m is not a length"),
        (
            (11, 10.0),
            "artifact grid_pitch: 10 m is not a pitch of a plate (1e-07 to 1 m); is it in mm? "
            "give the distance between marks in metres",
        ),
        ((11, 9.9e-8), "artifact grid_pitch: 9.9e-08 m is not a pitch of a plate"),
        ((11, math.nan), "artifact grid_pitch: nan m is not a length"),
        ((11, math.inf), "artifact grid_pitch: inf m is not a length"),
        ((11, 0.01, 2), "artifact angular_count: 2 is not a number from 3 to "),
        ((11, 0.01, -4), "artifact angular_count: -4 is not a number from 3 to "),
        (
            (11, 0.01, 2**31),
            "artifact angular_count: 2147483648 is not a number from 3 to ",
        ),
    ],
)
def test_plates_that_are_refused(arguments, message):
    with pytest.raises(InputError) as caught:
        Artifact(*arguments)
    assert str(caught.value).startswith(message)


def test_the_lattice_of_a_plate():
    plate = Artifact(5, 0.01, 8, 7)
    assert (plate.shape, plate.half) == ((5, 7), (2, 3))
    assert plate.x_m[0, 0] == -0.02
    assert plate.y_m[0, 6] == 0.03
    np.testing.assert_allclose(plate.theta_rad, np.arange(8) * math.pi / 4)
    assert Artifact(5, 0.01).theta_rad.shape == (0,)


def test_a_plan_with_its_defaults_and_with_all_its_keys():
    (view,) = plan_from_dict(PLAN, "f").views
    assert view == View("a", 0.0, (0.0, 0.0), True, True, 1)
    plan = plan_from_dict(
        plan_with(
            {
                "rotation_deg": 15,
                "translation_pitch": [0, 2],
                "grid": False,
                "angular": True,
                "repeats": 3,
            }
        ),
        "f",
    )
    assert plan.artifact == PLATE
    assert plan.views[0] == View("a", math.radians(15), (0.0, 0.02), False, True, 3)
    ordered = plan_from_dict(
        {
            **PLAN,
            "visit_order": "x_then_y",
            "views": [
                {"name": "a"},
                {"name": "b", "visit_order": "raster@plate"},
                {"name": "c", "visit_order": ""},
            ],
        },
        "f",
    )
    assert [v.visit_order for v in ordered.views] == ["x_then_y", "raster@plate", ""]
    assert plan.views[0].visit_order == ""
    bare = plan_from_dict(
        {**PLAN, "artifact": {**PLAN["artifact"], "angular_count": 0}}, "f"
    )
    assert not bare.views[0].angular


def test_a_plate_without_angular_count_has_no_lines():
    plate = {"grid_size": 5, "grid_pitch": 0.01}
    assert plan_from_dict(plan_with(artifact=plate), "f") == plan_from_dict(
        plan_with(artifact={**plate, "angular_count": 0}), "f"
    )


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (None, "f: not a mapping of keys to values; see the examples in config"),
        ({}, "f: the key 'plan_id' is missing; add it"),
        (
            plan_with(extra=1),
            "f: extra: unknown key; known are plan_id, artifact, views, visit",
        ),
        (
            plan_with(artifact={"grid_size": 5, "grid_pitch": 0.01, "missing": []}),
            "f: artifact: missing: unknown key; known are grid_size, grid_pitch, "
            "angular_count, grid_size_y, marks",
        ),
        (plan_with(plan_id=3), "f: plan_id: 3 is not of type str; correct the value"),
        (
            plan_with(plan_id="a\r\x1b[31m\u202e"),
            r"f: plan_id: 'a\r\x1b[31m\u202e' has characters that cannot be printed, such as",
        ),
        (plan_with(plan_id=" "), "f: plan_id: the name is empty; give one"),
        (
            plan_with(views=[{"name": ""}]),
            "f: views[0]: name: the name is empty; give one",
        ),
        (
            plan_with(plan_id="n" * 201),
            "f: plan_id: a name of 201 characters; give one of at m",
        ),
        (
            plan_with(views=[{"name": "a\nb"}]),
            r"f: views[0]: name: 'a\nb' has characters that cannot be printed, such as a line br",
        ),
        (
            plan_with(views=[{"name": "a" * 10_000}]),
            "f: views[0]: name: a name of 10000 characters; give one of at most 200",
        ),
        (plan_with(views=[]), "f: the plan has no views; add at least one view"),
        (plan_with(views=[3]), "f: views[0]: not a mapping of keys to values"),
        (
            plan_with(views=[{"name": "a"}] * 1001),
            "f: views: 1001 views are more than 1000; ",
        ),
        (
            plan_with(views=[{"name": "a"}] * 1000),
            "f: views[1]: the name 'a' is used twice; give",
        ),
        (
            plan_with(views=[{"name": "a"}] * 2),
            "f: views[1]: the name 'a' is used twice; give every",
        ),
        (plan_with(artifact=[]), "f: artifact: [] is not of type dict"),
        (
            plan_with(
                artifact={"grid_size": 11.0, "grid_pitch": 1, "angular_count": 0}
            ),
            "f: artifact: grid_size: 11.0 is not of type int",
        ),
        (
            plan_with(
                artifact={"grid_size": True, "grid_pitch": 1, "angular_count": 0}
            ),
            "f: artifact: grid_size: True is not of type int",
        ),
        (
            plan_with(artifact={"grid_size": 11, "angular_count": 0}),
            "f: artifact: the key 'grid_pitch' is missing",
        ),
        (
            plan_with({"rotation": 90}),
            "f: views[0]: rotation: unknown key; did you mean 'rotation_deg'? known "
            "are name, rotation_",
        ),
        (
            plan_with({"rotation_deg": "90"}),
            "f: views[0]: rotation_deg: '90' is not of type float",
        ),
        (
            plan_with({"rotation_deg": math.nan}),
            "view 'a' rotation: nan is not an angle",
        ),
        (
            plan_with({"rotation_deg": math.inf}),
            "view 'a' rotation: inf is not an angle",
        ),
        (
            plan_with({"rotation_deg": 1, "angular": True}),
            "view 'a' rotation: 0.0666667 is not a whole number of angular line "
            "steps; turn by whole lines, or set angular to false",
        ),
        (
            plan_with({"rotation_deg": 1, "grid": False}),
            "view 'a' rotation: 0.0666667 is not a whole ",
        ),
        (
            plan_with({"translation_pitch": [1]}),
            "f: views[0]: translation_pitch: not two numbers; ",
        ),
        (
            plan_with({"translation_pitch": ["1", 0]}),
            "f: views[0]: translation_pitch: not two number",
        ),
        (
            plan_with({"translation_pitch": [True, 0]}),
            "f: views[0]: translation_pitch: not two number",
        ),
        (
            plan_with({"translation_pitch": [0.5, 0], "grid": False}),
            "view 'a' translation: 0.5 is not a whole number of pitch steps; place "
            "the plate on the latt",
        ),
        (
            plan_with({"translation_pitch": [2e5, 0]}),
            "view 'a' translation: 200000 pitches are beyond",
        ),
        (
            plan_with({"translation_mm": [-2e9, 0.5]}),
            "view 'a' translation: -2e+08 pitches are beyond",
        ),
        (
            plan_with({"translation_mm": [1, math.nan]}),
            "view 'a' translation: (0.001, nan) are not tw",
        ),
        (
            plan_with({"translation_mm": [1]}),
            "f: views[0]: translation_mm: not two numbers; give",
        ),
        (
            plan_with({"translation_mm": [1, 0], "translation_pitch": [1, 0]}),
            "f: views[0]: translation_pitch and translation_mm are given; leave one of them out",
        ),
        (
            plan_with(map={"grid_size": 2}),
            "map grid_size: 2 is not a number from 3 to 401; give",
        ),
        (
            plan_with(map={"grid_size": 7, "grid_size_y": 2}),
            "map grid_size_y: 2 is not a number",
        ),
        (
            plan_with(map={"grid_size": 7, "grid_pitch": -0.1}),
            "map grid_pitch: -0.1 m is not a length",
        ),
        (
            plan_with(map={"grid_pitch": 0.01}),
            "f: map: the key 'grid_size' is missing; add it",
        ),
        (
            plan_with(map={"grid_size": 7, "interpolation": "cubic"}),
            "f: map: interpolation: 'cubic' is not known; use one of bilinear, bicubic",
        ),
        (
            plan_with({"repeats": 0}),
            "f: views[0]: repeats: 0 is not positive; give 1 or more",
        ),
        (
            plan_with({"repeats": 10**18}),
            f"f: views[0]: repeats: {10**18} are more than 10000; give fewer",
        ),
        (
            plan_with(visit_order="spiral"),
            "f: visit_order: 'spiral' is not a visiting order; use ",
        ),
        (plan_with(visit_order=1), "f: visit_order: 1 is not of type str"),
        (
            plan_with({"visit_order": "back"}),
            "f: views[0]: visit_order: 'back' is not a visiting ",
        ),
        (
            plan_with({"visit_order": None}),
            "f: views[0]: visit_order: None is not of type str",
        ),
        (plan_with({"grid": 1}), "f: views[0]: grid: 1 is not of type bool"),
        (
            plan_with({"grid": False, "angular": False}),
            "f: views[0]: neither grid nor angular marks",
        ),
        (
            {
                **plan_with({"angular": True}),
                "artifact": {**PLAN["artifact"], "angular_count": 0},
            },
            "f: views[0]: angular marks are wanted but the plate has none; set "
            "angular to false, or give the plate its angular_count",
        ),
    ],
)
def test_plans_that_are_refused(data, message):
    with pytest.raises(InputError) as caught:
        plan_from_dict(data, "f")
    assert str(caught.value).startswith(message)


def test_views_off_the_lattice_get_a_map_of_their_own():
    """Lines are read where a line lies on a line; a plan on the lattice stays as it is."""
    plan = plan_from_dict(
        plan_with(
            views=[
                {"name": "a"},
                {"name": "b", "rotation_deg": 37, "translation_mm": [13, -7]},
                {"name": "c", "translation_pitch": [1.3, -0.7]},
                {"name": "d", "rotation_deg": 30},
            ]
        ),
        "f",
    )
    assert plan.artifact == replace(PLATE, map_grid=default_map_grid(PLATE))
    assert [view.angular for view in plan.views] == [True, False, True, True]
    assert plan.views[1].translation_m == (0.013, -0.007)
    pose = plan.views[2].on_stage(plan.artifact)
    assert pose.shift == pytest.approx((1.3, -0.7), abs=1e-12) and pose.s == 0
    assert plan.views[3].on_stage(plan.artifact).s == 2
    assert plan_from_dict(
        plan_with({"translation_mm": [-20, 30]}), "f"
    ) == plan_from_dict(plan_with({"translation_pitch": [-2, 3]}), "f")


@pytest.mark.parametrize(
    ("grid", "want"),
    [
        ({"grid_size": 7}, MapGrid(7, 0.1 / 6)),
        ({"grid_size": 5, "grid_pitch": 0.02}, MapGrid(5, 0.02)),
        (
            {"grid_size": 7, "grid_size_y": 5, "interpolation": "bilinear"},
            MapGrid(7, 0.025, Interpolation.BILINEAR, 5),
        ),
    ],
)
def test_the_nodes_of_a_map_span_the_plate_unless_their_pitch_is_given(grid, want):
    """Also of a plan on the lattice."""
    assert plan_from_dict(plan_with(map=grid), "f").artifact.map_grid == want


@pytest.mark.parametrize(
    ("sides", "want"), [([7, 5], (7, 5)), ([5, 7], (5, 7)), ([7, 7], (7, 7))]
)
def test_a_plate_may_give_both_its_sides(sides, want):
    """A square one is the same plate as by one number."""
    plate = plan_from_dict(
        plan_with(artifact={**PLAN["artifact"], "grid_size": sides}), "f"
    ).artifact
    assert plate.shape == want
    assert (plate == replace(PLATE, grid_size=7)) is (sides == [7, 7])


def test_a_plan_off_the_lattice_is_written_as_it_is_read():
    plan = plan_from_dict(
        plan_with(
            views=[
                {"name": "a"},
                {
                    "name": "b",
                    "rotation_deg": -37.25,
                    "translation_pitch": [1.3, -0.7],
                    "repeats": 3,
                },
            ],
            map={"grid_size": 7, "interpolation": "bilinear"},
        ),
        "f",
    )
    written = plan_to_dict(plan)
    assert written["views"][1]["translation_pitch"] == [1.3, -0.7]
    assert plan_from_dict(written, "f") == plan


def test_check_stops_hold_for_all_views_with_grid_marks():
    """20e-6 is a text to YAML, which wants a point in a number."""
    data = plan_with({}, check_stops={"marks": 5, "offset": "20e-6"})
    data["views"].append({"name": "line", "grid": False})
    views = plan_from_dict(data, "f").views
    assert [(v.check_marks, v.check_offset_m) for v in views] == [(5, 2e-5), (0, 0.0)]
    for none in ({}, {"marks": 0, "offset": 0}):
        assert plan_from_dict(plan_with({}, check_stops=none), "f") == plan_from_dict(
            plan_with({}), "f"
        )
    at_most = plan_with(
        {"translation_pitch": [10, 0]}, check_stops={"marks": 11, "offset": 0.0025}
    )
    assert plan_from_dict(at_most, "f").views[0].check_marks == 11


@pytest.mark.parametrize(
    ("stops", "message"),
    [
        ({"marks": 5}, "f: check_stops: the key 'offset' is missing; add it"),
        (
            {"marks": 5.0, "offset": 2e-5},
            "f: check_stops: marks: 5.0 is not of type int",
        ),
        (
            {"marks": 5, "offset": "20 um"},
            "f: check_stops: offset: '20 um' is not of type float",
        ),
        (
            {"marks": 5, "offset": 0.0},
            "f: view 'a' check_stops: 5 marks, 0 m off; give both ",
        ),
        (
            {"marks": 5, "offset": -2e-5},
            "f: view 'a' check_stops: 5 marks, -2e-05 m off; give both",
        ),
        (
            {"marks": -1, "offset": 2e-5},
            "f: view 'a' check_stops: -1 marks, 2e-05 m off; give both",
        ),
        (
            {"marks": 0, "offset": 2e-5},
            "f: view 'a' check_stops: 0 marks, 2e-05 m off; give both",
        ),
        (
            {"marks": 5, "offset": math.nan},
            "f: view 'a' check_stops: 5 marks, nan m off; give both",
        ),
        (
            {"marks": 5, "offset": 0.00251},
            "f: view 'a' check_stops: 0.00251 m is more than a quarter of the pitch; "
            "stop at most 0.0025 m off the mark; 20e-6 is usual",
        ),
        (
            {"marks": 12, "offset": 2e-5},
            "f: view 'a' check_stops: 12 marks are requested, 11 lie in the field; "
            "ask for fewer marks",
        ),
    ],
)
def test_check_stops_that_are_refused(stops, message):
    with pytest.raises(InputError) as caught:
        plan_from_dict(
            plan_with({"translation_pitch": [10, 0]}, check_stops=stops), "f"
        )
    assert str(caught.value).startswith(message)


def test_terms_of_a_plan_are_read_and_checked():
    plan = plan_from_dict(plan_with(model_terms=["plate_shape:30e-9", "drift"]), "here")
    assert plan.model_terms == ("drift", "plate_shape:3e-08")
    assert plan_from_dict(PLAN, "here").model_terms == ()
    for terms, message in (
        (
            ["creep"],
            "here: model_terms: the term 'creep' is unknown; known are "
            + ", ".join(BUILT_IN),
        ),
        (
            [{"drift": 1e-9}],
            "here: model_terms: {'drift': 1e-09} is not a text; write TERM or TERM:SIZE",
        ),
        ("drift", "here: model_terms: 'drift' is not of type list; write [drift]"),
    ):
        with pytest.raises(InputError) as caught:
            plan_from_dict(plan_with(model_terms=terms), "here")
        assert str(caught.value) == message


def test_a_plan_knows_its_microscope():
    plan = plan_from_dict(
        plan_with(microscope={"rotation_u": 0.002}, model_terms=["drift"]), "p"
    )
    assert plan.model_terms == ("microscope:0.01:0.002:0.002", "drift")
    with pytest.raises(
        InputError,
        match=r"^p: microscope: model_terms has a microscope as well; "
        "leave one of them out$",
    ):
        plan_from_dict(
            plan_with(microscope={"scale_u": 0.1}, model_terms=["microscope"]), "p"
        )
    with pytest.raises(InputError, match="p: microscope: the size 2 is"):
        plan_from_dict(plan_with(microscope={"shear_u": 2.0}), "p")


IMAGE = {
    "plan_id": "p",
    "artifact": {"grid_size": 7, "grid_pitch": 0.001, "angular_count": 8},
    "views": [
        {"name": "a"},
        {"name": "turned", "rotation_deg": 90, "translation_pitch": [1, 0]},
    ],
    "image": {"nx": 3, "ny": 1},
}


def test_the_cells_of_an_image_are_views_at_shifted_poses():
    plan = plan_from_dict(IMAGE, "p")
    assert plan_from_dict(plan_to_dict(plan), "p") == plan
    views = with_sub_views(plan.views)
    assert [view.name for view in views[3:]] == [
        "turned[-1,+0]",
        "turned[+0,+0]",
        "turned[+1,+0]",
    ]
    assert [view.plan_view for view in views] == ["a"] * 3 + ["turned"] * 3
    assert [view.on_stage(plan.artifact).shift for view in views[3:]] == [
        (2, 0),
        (1, 0),
        (0, 0),
    ]
    assert [view.cell_m for view in views[:3]] == [-0.001, 0, 0.001]
    assert plan.views[1].cell_m == 0  # the axis of the microscope stands at the centre
    assert [view.angular for view in views[:3]] == [False, True, False]
    assert with_sub_views(views) == views
    alone = plan_from_dict(IMAGE | {"image": {"nx": 1, "ny": 1}}, "p")
    assert (
        with_sub_views(alone.views)
        == alone.views
        == tuple(replace(view, image=None) for view in plan.views)
    )


def test_cells_of_a_plate_at_any_turn_follow_its_rows():
    data = IMAGE | {"views": [{"name": "a", "rotation_deg": 100}]}
    (_, _, right) = with_sub_views(plan_from_dict(data, "p").views)
    assert right.cell_m == pytest.approx(0.001 * np.exp(1j * np.radians(10)))
    assert complex(*right.translation_m) == pytest.approx(-right.cell_m)


@pytest.mark.parametrize(
    ("image", "told"),
    [
        ({"nx": 2, "ny": 3}, "nx"),
        ({"nx": 3, "ny": 17}, "ny"),
        ({"nx": 3}, "ny"),
        ({"nx": 3, "ny": 3, "pitch_m": 0.0015}, "pitch_m"),
        ({"nx": 3, "ny": 3, "pitch_m": -1.0}, "pitch_m"),
        ({"nx": 3, "ny": 3, "px": 1}, "px"),
    ],
)
def test_impossible_images_are_refused(image, told):
    with pytest.raises(InputError, match=told):
        plan_from_dict(IMAGE | {"image": image}, "p")


def test_a_plan_has_no_more_cells_than_views():
    many = [{"name": str(number)} for number in range(112)]
    with pytest.raises(InputError, match="image"):
        plan_from_dict(IMAGE | {"views": many, "image": {"nx": 3, "ny": 3}}, "p")


def test_a_plan_with_harmonics_reads_lines_at_any_turn():
    data = plan_with(
        views=[
            {"name": "a"},
            {"name": "b", "rotation_deg": -37.25, "grid": False},
            {"name": "c", "rotation_deg": 375, "grid": False},
        ],
        map={"harmonics": 11},
    )
    plan = plan_from_dict(data, "f")
    assert (plan.artifact.harmonics, plan.artifact.map_grid) == (11, None)
    assert [view.angular for view in plan.views] == [True, True, True]
    turns = [view.on_stage(plan.artifact).s for view in plan.views]
    assert turns == [0, pytest.approx(24 - 37.25 / 15, abs=1e-12), 1]
    assert plan_from_dict(plan_to_dict(plan), "f") == plan
    placed = plan_from_dict(plan_with({"rotation_deg": 37}, map={"harmonics": 3}), "f")
    assert placed.views[0].angular
    assert placed.artifact.map_grid == default_map_grid(
        plan_from_dict(PLAN, "f").artifact
    )
    assert placed.artifact.field.harmonics == 3


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (
            {"harmonics": 12},
            "map harmonics: 12 harmonics cannot be told with 24 lines; give 1 to 11",
        ),
        ({"harmonics": 1.5}, "f: map: harmonics"),
        (
            {"harmonics": 3, "nodes": 5},
            "f: map: nodes: unknown key; known are grid_size",
        ),
    ],
)
def test_harmonics_that_are_refused(given, message):
    with pytest.raises(InputError) as caught:
        plan_from_dict(plan_with(map=given), "f")
    assert str(caught.value).startswith(message)


@pytest.mark.parametrize("key", PLAN_KEYS)
def test_a_key_of_a_plan_that_travels_has_its_place_everywhere(key):
    for kind in (Plan, Command, Timeline, Measurements):
        assert key in [item.name for item in fields(kind)], (
            f'add `{key}: str = ""` to {kind.__name__}'
        )
    plan = plan_from_dict(plan_with(**{key: "what it says"}), "p.yaml")
    assert plan_keys(plan)[key] == plan_to_dict(plan)[key] == "what it says"
    assert key not in plan_to_dict(plan_from_dict(PLAN, "p.yaml"))
