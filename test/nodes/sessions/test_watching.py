# SPDX-License-Identifier: Apache-2.0
"""What the monitor makes of the topics of a cell."""

import json
import math
from types import SimpleNamespace

import numpy as np
import pytest

from selfcal_ros.bagio.messages import from_model
from selfcal_ros.collection.inputs import Command, Phase
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.nodes.sessions.health import Diagnosis, Level
from selfcal_ros.nodes.sessions.watching import Watch
from test.support.maps import random_map, result_of
from test.support.plans import plan_of
from test.support.ports import Hands, message
from test.support.sessions import small_plan

PLAN = small_plan("0, 90, tx")


@pytest.fixture
def hands():
    return Hands()


@pytest.fixture
def watch(hands):
    return Watch(hands.ports)


def command(index: int, stamp_ns: int = 5) -> object:
    return message(
        "ViewCommand",
        from_model.command(
            Command(
                stamp_ns,
                Phase.MEASURE,
                PLAN.plan_id,
                index,
                PLAN.views[index],
                PLAN.artifact,
                len(PLAN.views),
                "17",
            ),
            "stage",
        ),
    )


def status(index: int, missing: list, **fields) -> object:
    return SimpleNamespace(
        **(
            {
                "plan_id": PLAN.plan_id,
                "view_index": index,
                "view_name": PLAN.views[index].name,
                "complete": False,
                "grid_done": 25 - len(missing),
                "grid_expected": 25,
                "angular_done": 7,
                "angular_expected": 8,
                "check_done": 2,
                "check_expected": 5,
                "detections_used": 50,
                "reject_reasons": ["duplicate"],
                "reject_counts": [2],
                "sigma_xy": 2e-8,
                "sigma_theta": float("nan"),
                "missing_m": [m for m, _ in missing],
                "missing_n": [n for _, n in missing],
                "missing_k": [3],
                "run_id": "",
            }
            | fields
        )
    )


def test_before_anything_is_heard(watch):
    picture = json.loads(json.dumps(watch.picture()))
    assert picture == {
        "health": {
            "measurement_collector": None,
            "pose_sequencer": None,
            "solver": None,
        },
        "command": None,
        "view": None,
        "summary": None,
        "map": None,
    }


def test_the_plate_is_drawn_in_its_own_frame_top_line_first(watch):
    watch.take_command(command(0))
    watch.take_status(status(0, [(-2, 2), (1, 0)]))
    view = watch.picture()["view"]
    assert view["plate"] == [".oooo", "ooooo", "ooo.o", "ooooo", "ooooo"]
    assert (view["grid"], view["angular"], view["rejected"]) == (
        [23, 25],
        [7, 8],
        {"duplicate": 2},
    )
    assert view["repeatability_um"] == pytest.approx(0.02)
    assert view["repeatability_arcsec"] is None
    watch.take_status(status(0, [], sigma_theta=math.radians(2 / 3600)))
    assert watch.picture()["view"]["repeatability_arcsec"] == pytest.approx(2.0)


def test_marks_outside_of_the_field_are_blank(watch):
    index = [view.name for view in PLAN.views].index("tx")
    watch.take_command(command(index))
    watch.take_status(status(index, [], grid_done=20, grid_expected=20))
    assert watch.picture()["view"]["plate"] == ["oooo "] * 5


def test_only_the_newest_command_and_its_view_count(watch):
    watch.take_command(command(1, stamp_ns=9))
    watch.take_command(command(0, stamp_ns=8))  # latched, and late
    watch.take_status(status(1, []))
    watch.take_status(status(0, []))
    picture = watch.picture()
    assert (
        picture["command"]["view_name"]
        == picture["view"]["view_name"]
        == PLAN.views[1].name
    )
    assert picture["command"]["rotation_deg"] == pytest.approx(90)


def test_the_plate_is_that_of_the_view_that_was_measured(watch):
    shifted = [view.name for view in PLAN.views].index("tx")
    watch.take_command(command(0))
    watch.take_status(status(0, []))
    watch.take_command(command(shifted, stamp_ns=9))  # the next view is placed
    assert watch.picture()["view"]["plate"] == ["ooooo"] * 5


@pytest.mark.parametrize("run_id, there", [("17", True), ("", True), ("16", False)])
def test_what_was_measured_in_an_earlier_run_is_not_shown(watch, run_id, there):
    watch.take_command(command(0))
    watch.take_status(status(0, [], run_id=run_id))
    assert (watch.picture()["view"] is not None) is there


@pytest.mark.parametrize("seconds, there", [(3.0, True), (3.1, False)])
def test_a_node_is_gone_after_a_while(watch, hands, seconds, there):
    watch.take_health("compensator", Diagnosis(Level.WARN, "no map", {"a": "1"}))
    hands.pass_time(seconds)
    assert watch.picture()["health"]["compensator"] == (
        {"level": 1, "message": "no map", "values": {"a": "1"}} if there else None
    )


def test_a_large_plate_shows_the_worst_of_the_marks_behind_a_sign(watch):
    plan = plan_of("0", 101)
    watch.take_command(
        message(
            "ViewCommand",
            from_model.command(
                Command(
                    5,
                    Phase.MEASURE,
                    plan.plan_id,
                    0,
                    plan.views[0],
                    plan.artifact,
                    1,
                    "17",
                ),
                "stage",
            ),
        )
    )
    watch.take_status(
        status(
            0,
            [(-50, -50), (0, 1), (50, 50)],
            plan_id=plan.plan_id,
            grid_expected=101**2,
            grid_done=101**2 - 3,
        )
    )
    view = watch.picture()["view"]
    assert view["plate_step"] == 3
    rows = view["plate"]
    assert {len(row) for row in rows} == {34} == {len(rows)}
    missing = {
        (x, y)
        for y, row in enumerate(reversed(rows))
        for x, sign in enumerate(row)
        if sign == "."
    }
    assert missing == {(0, 0), ((0 + 50) // 3, (1 + 50) // 3), (33, 33)}


def test_marks_behind_the_last_that_is_named_are_not_known(watch):
    watch.take_command(command(0))
    watch.take_status(status(0, [(-2, -2), (-1, 0)], grid_done=25 - 9))
    assert watch.picture()["view"]["plate"] == [
        "o????",
        "o????",
        "o.???",
        "oo???",
        ".o???",
    ]


def test_long_texts_and_lists_are_cut(watch):
    watch.take_command(command(0))
    watch.take_status(
        status(
            0,
            [],
            view_name="x" * 10**6,
            missing_k=[1] * 10**6,
            reject_reasons=[str(n) for n in range(1000)],
            reject_counts=[1] * 1000,
        )
    )
    watch.take_health(
        "solver",
        Diagnosis(Level.WARN, "y" * 10**6, {str(n): "z" * 10**6 for n in range(300)}),
    )
    picture = watch.picture()
    view, health = picture["view"], picture["health"]["solver"]
    assert (
        view["view_name"] == f"{'x' * 3000} ... (1000000 characters) ... {'x' * 1000}"
    )
    assert (
        len(view["rejected"])
        == len(view["missing_lines"])
        == len(health["values"])
        == 200
    )
    assert max(map(len, [health["message"], *health["values"].values()])) < 4100


def test_the_map_is_thinned_out_and_stands_upright(watch):
    error_map = random_map(Artifact(5, 0.01, 8), 3, unknown=[(0, 4)])
    watch.take_map(
        message("ErrorMap", from_model.error_map(result_of(error_map), 1, "stage"))
    )
    um = watch.picture()["map"]["um"]
    assert um[0][0] is None  # x smallest, y largest: top left
    assert um[-1][0] == pytest.approx(
        1e6 * np.hypot(error_map.gx[0, 0], error_map.gy[0, 0])
    )
    big = random_map(Artifact(101, 0.01, 8), 3)
    watch.take_map(
        message("ErrorMap", from_model.error_map(result_of(big), 1, "stage"))
    )
    found = watch.picture()["map"]
    size = 1e6 * np.hypot(big.gx, big.gy)
    assert (len(found["um"]), found["step"]) == (34, 3)
    # the largest of its sites
    assert found["um"][0][0] == pytest.approx(size[:3, 99:].max())
    assert found["um"][-1][1] == pytest.approx(size[3:6, :3].max())
