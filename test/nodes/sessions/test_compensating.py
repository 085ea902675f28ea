# SPDX-License-Identifier: Apache-2.0
"""The session of the compensator: which map is used, since when, and why another is not."""

import contextlib
import json
import math
import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.apply import StageMap
from selfcal_ros.bagio.messages import from_model
from selfcal_ros.bagio.schemas import typestore
from selfcal_ros.bagio.writer import build
from selfcal_ros.compensation.compensator import Compensator
from selfcal_ros.errors import InputError
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.result import digests_of, result_to_dict
from selfcal_ros.nodes.sessions.compensating import (
    KEEPS_UP,
    MOST_ASKED,
    CompensatingSession,
)
from selfcal_ros.nodes.sessions.health import Level
from selfcal_ros.reporting.summary.numbers import summary_figures
from selfcal_ros.reporting.words.findings import worded
from test.support.maps import first_order, random_map, result_of
from test.support.placed import SIX, plate, readings
from test.support.ports import START_NS, Hands, message, settings_of

ONE, TWO = (random_map(Artifact(5, 0.01, 8), seed) for seed in (3, 4))
NAMES = ["x", "y", "theta"]


def map_of(error_map=ONE, stamp_ns: int = START_NS, **changes) -> object:
    return message(
        "ErrorMap",
        from_model.error_map(result_of(error_map), stamp_ns, "stage")
        | {"run_id": "7"}
        | changes,
    )


def summary_of(stamp_ns: int = START_NS, **changes) -> object:
    numbers = dict.fromkeys(
        (
            "max_error_um",
            "rms_error_um",
            "rms_uncertainty_um",
            "max_theta_error_arcsec",
            "rms_theta_uncertainty_arcsec",
            "rms_uncertainty_anywhere_um",
            "max_uncertainty_anywhere_um",
        ),
        0.0,
    )
    return message(
        "CalibrationSummary",
        {
            "header": from_model.header(stamp_ns, "stage"),
            "state": "as it is",
            "views_done": 4,
            "views_planned": 4,
            "identifiable": True,
            "rank_deficiency": 0,
            "advice": [],
            "qualified": True,
            "causes": [],
            "run_id": "7",
            "grade": 2,
            **numbers,
        }
        | changes,
    )


class Desk:
    def __init__(self, **parameters) -> None:
        self.hands = Hands()
        self.session = CompensatingSession(
            settings_of("compensator", **parameters), self.hands.ports
        )

    def x_at(self, x: float) -> float | None:
        corrected = self.session.correct(NAMES, [x, 0.0, 0.0])
        return corrected and corrected[0]


@pytest.fixture
def desk():
    return Desk()


def use(desk, error_map=ONE) -> Compensator:
    desk.session.take_map(map_of(error_map))
    desk.session.take_summary(summary_of())
    return Compensator(error_map)


def commanded(desk, names, position, frame_id: str = "stage") -> list[float] | None:
    """Send a command through the session; return the positions that it passes on."""
    message = build(
        typestore(),
        "sensor_msgs/msg/JointState",
        {
            "header": from_model.header(5, frame_id),
            "name": list(names),
            "effort": [],
            "position": list(position),
            "velocity": [0.5] * len(names),
        },
    )
    data = bytes(typestore().serialize_cdr(message, "sensor_msgs/msg/JointState"))
    out = desk.session.command(data)
    if out is None:
        return None
    back = typestore().deserialize_cdr(out, "sensor_msgs/msg/JointState")
    assert (back.header, back.name) == (message.header, message.name)
    assert list(back.velocity) == [0.5] * len(names)
    return list(back.position)


def test_a_command_gets_the_error_added_and_all_else_stays(desk):
    by = use(desk)
    x, y = by.command(0.01, -0.013)
    assert commanded(desk, ["z", "y", "x", "theta"], [7.0, -0.013, 0.01, 0.4]) == [
        7.0,
        y,
        x,
        by.command_theta(0.4),
    ]
    assert abs(x - 0.01) > 1e-9 and desk.session.correct(
        NAMES, [float(x), float(y), 0.0]
    )[0] == (pytest.approx(0.01, abs=1e-15))
    assert commanded(desk, ["theta"], [0.4]) == [by.command_theta(0.4)]
    assert desk.session.counts["commands"] == 2


@pytest.mark.parametrize(
    "names, position",
    [
        (["x"], [0.01]),
        (["y", "theta"], [0.01, 0.0]),
        (["z"], [3.0]),
        (["X", "Y"], [0.01, 0.0]),
        (["x", "y", "x"], [0.01, 0.0, 0.01]),
        (["theta", "theta"], [0.1, 0.1]),
        (NAMES, [math.nan, 0.0, 0.0]),
        (NAMES, [0.0, 2e12, 0.0]),
        (NAMES, [-0.02, -0.02, 0.0]),
    ],
)
def test_a_command_that_cannot_be_corrected_is_not_passed_on(desk, names, position):
    use(desk, random_map(Artifact(5, 0.01, 8), 3, unknown=((0, 0),)))
    assert commanded(desk, names, position) is None
    assert desk.session.command(b"damaged") is None
    told = desk.session.diagnosis()
    assert (
        told.level == Level.WARN
        and "2 commands refused since the last status" in told.message
    )
    assert told.values["commands_refused"] == 2
    assert desk.session.diagnosis().level == Level.OK  # told once


def test_joints_that_are_not_of_the_stage_are_named(desk):
    use(desk)
    assert desk.session.correct(["gantry_x", "gantry_y"], [0.01, -0.005]) is None
    assert desk.session.correct(["x", "z"], [0.01, 0.0]) is None
    told = desk.session.diagnosis()
    assert (
        told.level == Level.WARN
        and ("joints gantry_x, gantry_y are not of the stage (x, y, theta)")
        in told.message
    )
    assert desk.session.counts["refused"] == 2 and desk.session.counts["corrected"] == 0
    assert desk.session.diagnosis().level == Level.OK  # told once


@pytest.mark.parametrize(
    "frame_id, said", [("stage", False), ("", False), ("gantry", True)]
)
def test_a_command_in_another_frame_is_named_once(desk, frame_id, said):
    use(desk)
    assert commanded(desk, NAMES, [0.0, 0.0, 0.0], frame_id) is not None
    told = desk.session.diagnosis()
    assert told.level == (Level.WARN if said else Level.OK)
    assert (
        "commands name the frame 'gantry', but are corrected as positions in 'stage'"
        in told.message
    ) is said
    assert desk.session.diagnosis().level == Level.OK


def test_no_command_passes_without_a_map(desk):
    assert commanded(desk, NAMES, [0.0, 0.0, 0.0]) is None


@pytest.mark.parametrize("inverse", [False, True])
def test_a_request_is_answered_with_corrections_and_u(desk, inverse):
    by = use(desk)
    x, y, theta = [0.01, 0.003], [-0.02, 0.0], [0.5, -0.5]
    found = desk.session.answer(x, y, theta, inverse=inverse)
    wanted = by.correct(x, y) if inverse else by.command(x, y)
    np.testing.assert_array_equal([found["x"], found["y"]], wanted)
    turned = by.correct_theta(theta) if inverse else by.command_theta(theta)
    np.testing.assert_array_equal(found["theta"], turned)
    at = np.clip(wanted, -0.02, 0.02) if inverse else (x, y)  # y = -0.02 is on the edge
    np.testing.assert_array_equal([found["u_x"], found["u_y"]], by.uncertainty(*at))
    np.testing.assert_array_equal(
        found["u_theta"], by.uncertainty_theta(turned if inverse else theta)
    )
    assert len(desk.session.answer(x, y, [], inverse=inverse)["theta"]) == 0


@pytest.mark.parametrize("inverse", [False, True])
def test_outside_the_field_u_is_not_known(desk, inverse):
    """Not even a quarter of a pitch beyond; the edge itself belongs to the field."""
    use(desk)
    found = desk.session.answer(
        [0.02, 0.0225, 0.0], [0.02, 0.0, -0.5], [], inverse=inverse
    )
    np.testing.assert_array_equal(np.isfinite(found["u_x"]), [True, False, False])
    np.testing.assert_array_equal(np.isfinite(found["u_y"]), [True, False, False])
    assert np.isfinite([found["x"], found["y"]]).all()
    assert "; u is not known at 2 positions: is one outside" in desk.session.remark(
        found
    )
    inside = desk.session.answer([0.01], [0.01], [], inverse=inverse)
    assert "u is not known" not in desk.session.remark(inside)


def test_positions_outside_the_field_are_counted_and_told_once(desk):
    use(desk)
    for x in (0.0, 0.02, 0.0225):
        assert desk.session.correct(NAMES, [x, 0.0, 0.0]) is not None
    assert commanded(desk, NAMES, [0.0, -0.0225, 0.0]) is not None
    said = desk.session.diagnosis()
    assert said.level == Level.WARN and said.values["outside"] == 2
    assert (
        "2 positions outside the field since the last status, corrected as at"
        in said.message
    )
    assert desk.session.diagnosis().level == Level.OK


@pytest.mark.parametrize(
    "x, y, theta, message",
    [
        ([0.0], [], [], "1 x, 0 y and 0 theta"),
        ([0.0], [0.0], [0.0, 1.0], "1 x, 1 y and 2 theta"),
        ([math.nan], [0.0], [], "a position is not a number"),
        (*2 * [[0.0] * (MOST_ASKED + 1)], [], "ask for 100000 at a time"),
        ([-0.02], [-0.02], [], "next to an unknown site"),
    ],
)
def test_a_request_that_cannot_be_met_is_refused_as_a_whole(desk, x, y, theta, message):
    with pytest.raises(InputError, match="no error map yet"):
        desk.session.answer([0.0], [0.0], [], inverse=False)
    use(desk, random_map(Artifact(5, 0.01, 8), 3, unknown=((0, 0),)))
    with pytest.raises(InputError, match=message):
        desk.session.answer(x, y, theta, inverse=False)


@pytest.mark.parametrize(
    ("parameter", "stated", "whole", "used"),
    [
        ("bilinear", "", True, "bilinear"),
        ("bicubic", "", True, "bicubic"),
        ("bilinear", "bicubic", True, "bicubic"),
        ("bicubic", "bilinear", True, "bilinear"),
        ("bicubic", "bicubic", False, "bilinear"),
    ],
)
def test_a_map_is_interpolated_as_it_was_estimated(parameter, stated, whole, used):
    desk = Desk(interpolation=parameter)
    known = ONE if whole else random_map(Artifact(5, 0.01, 8), 3, unknown=((0, 0),))
    desk.session.take_map(map_of(known, interpolation=stated))
    desk.session.take_summary(summary_of())
    wanted = Compensator(known, method=used).correct_point(0.0033, 0.0021)
    assert tuple(desk.session.correct(NAMES, [0.0033, 0.0021, 0.0])[:2]) == wanted


def test_u_between_nodes_is_that_of_the_file_and_has_more_from_a_message(tmp_path):
    """A message does not say that marks were read between the nodes, so nothing is assumed."""
    measured, _ = readings(plate(7, 5), SIX, np.random.default_rng(2))
    result = calibrate(measured)
    assert result.reads_between_nodes
    path = tmp_path / "map.json"
    path.write_text(json.dumps(result_to_dict(worded(result))))
    from_file = Desk(map=str(path), require_qualified=False)
    from_message = Desk(require_qualified=False)
    from_message.session.take_map(map_of(result.error_map, interpolation="bicubic"))

    between = [0.0011], [0.0023], []
    used = StageMap(result)
    u_x, _ = used.uncertainty(*between[:2])
    answers = [
        desk.session.answer(*between, inverse=False)
        for desk in (from_file, from_message)
    ]
    assert answers[0]["u_x"] == pytest.approx(u_x)
    assert answers[1]["u_x"] > 1.01 * u_x


def test_a_map_of_an_unknown_interpolation_is_refused(desk):
    use(desk)
    before = desk.x_at(0.01)
    desk.session.take_map(map_of(TWO, START_NS + 1, interpolation="of tomorrow"))
    with pytest.raises(InputError, match="'of tomorrow' is not known"):
        desk.session.take_summary(summary_of(START_NS + 1))
    assert desk.x_at(0.01) == before


def test_a_map_that_is_older_than_the_one_in_use_is_used_with_a_warning(desk):
    """As that of a file which the solver was asked to load; or a solver that is late."""
    for stamp_ns, error_map in ((START_NS, ONE), (START_NS - 5, TWO)):
        assert not desk.hands.lines(Level.WARN)
        desk.session.take_map(map_of(error_map, stamp_ns))
        desk.session.take_summary(summary_of(stamp_ns))
    assert desk.x_at(TWO.gx[2, 2]) == pytest.approx(0.0, abs=1e-8)
    assert desk.hands.lines(Level.WARN) == [
        "the map of plan demo, run 7 is older than the one that it replaces, of plan demo, run 7"
    ]


@pytest.mark.parametrize("order", [1, -1])
def test_a_map_is_used_once_its_summary_says_that_it_is_complete(desk, order):
    for take in [
        lambda: desk.session.take_map(map_of()),
        lambda: desk.session.take_summary(summary_of()),
    ][::order]:
        assert desk.x_at(0.0) is None
        take()
    assert desk.x_at(ONE.gx[2, 2]) == pytest.approx(0.0, abs=1e-8)
    assert desk.hands.lines(Level.OK)[-1] == (
        "correcting by the map of plan demo, run 7 from now on"
    )
    desk.hands.pass_time(12)
    told = desk.session.diagnosis()
    assert (told.level, told.message) == (
        Level.OK,
        "correcting by the map of plan demo, run 7",
    )
    assert (told.values["since_s"], told.values["map_age_s"]) == ("12", "12")


@pytest.mark.parametrize(
    "the_map, the_summary, why",
    [
        ({"qualified": False}, {}, "plan demo, run 7 is not qualified"),
        (
            {"identifiable": False},
            {},
            "plan demo, run 7 is said to be qualified and not identified",
        ),
        ({}, {"qualified": False}, "plan demo, run 7 is not qualified: as it is"),
        ({}, {"views_done": 3}, "plan demo, run 7 contains 3 of 4 views"),
        (
            {},
            {"run_id": "6"},
            "no selfcal/summary says yet whether plan demo, run 7 is complete",
        ),
        (
            {},
            {"stamp_ns": START_NS + 1},
            "no selfcal/summary says yet whether plan demo, run 7 is complete",
        ),
    ],
)
def test_a_map_that_must_not_be_used_leaves_the_former_one_in_use(
    desk, the_map, the_summary, why
):
    desk.session.take_map(map_of(TWO, START_NS - 5))
    desk.session.take_summary(summary_of(START_NS - 5))
    before = desk.x_at(0.01)
    desk.session.take_map(map_of(ONE, **the_map))
    desk.session.take_summary(summary_of(**the_summary))
    assert desk.x_at(0.01) == before
    assert desk.hands.lines(Level.OK)[-1] == f"the newest map is not used: {why}"
    assert desk.session.diagnosis().message.endswith(f"; not used: {why}")


def stated(error_map):
    """Return a map with its own O and R."""
    o, r = first_order(error_map.artifact, error_map.gx, error_map.gy)
    return replace(error_map, nonorthogonality=o, scale_difference=r)


def exchanged(error_map):
    """Return a map with x and y exchanged, as positions and as errors."""
    swapped = {
        name: getattr(error_map, other).T
        for name, other in (
            ("gx", "gy"),
            ("gy", "gx"),
            ("u_gx", "u_gy"),
            ("u_gy", "u_gx"),
        )
    }
    return replace(error_map, **swapped)


def mirrored(error_map):
    """Return a map with x reversed, as position and as error."""
    fields = {
        name: getattr(error_map, name)[::-1] for name in ("gx", "gy", "u_gx", "u_gy")
    }
    return replace(error_map, **fields | {"gx": -fields["gx"]})


def renamed(error_map):
    return replace(error_map, gx=error_map.gy, gy=error_map.gx)


def reversed_sign(error_map):
    return replace(error_map, gx=-error_map.gx)


@pytest.mark.parametrize("qualified_only", [True, False])
@pytest.mark.parametrize("change", [exchanged, mirrored, renamed, reversed_sign])
def test_a_map_with_changed_axes_leaves_the_former_one_in_use(change, qualified_only):
    desk = Desk(require_qualified=qualified_only)
    use(desk, stated(TWO))
    before = desk.x_at(0.01)
    desk.session.take_summary(summary_of(START_NS + 1))
    with pytest.raises(InputError, match="axes were exchanged or reversed"):
        desk.session.take_map(map_of(change(stated(ONE)), START_NS + 1))
    assert desk.x_at(0.01) == before
    desk.session.take_map(map_of(stated(ONE), START_NS + 1))
    assert desk.x_at(0.01) != before


@pytest.mark.parametrize(
    "name",
    [
        "max_error_um",
        "rms_error_um",
        "rms_uncertainty_um",
        "max_theta_error_arcsec",
        "rms_theta_uncertainty_arcsec",
    ],
)
@pytest.mark.parametrize("qualified_only", [True, False])
def test_a_map_that_its_summary_contradicts_leaves_the_former_one_in_use(
    name, qualified_only
):
    desk = Desk(require_qualified=qualified_only)
    use(desk, TWO)
    before, figures = desk.x_at(0.01), summary_figures(ONE)
    desk.session.take_summary(
        summary_of(START_NS + 1, **figures | {name: 1.01 * figures[name]})
    )
    desk.session.take_map(map_of(ONE, START_NS + 1))
    assert desk.x_at(0.01) == before
    line = desk.hands.lines(Level.WARN)[-1]
    assert f"the newest map is not used: selfcal/summary states {name} " in line
    assert desk.session.diagnosis().level == Level.WARN
    desk.session.take_summary(summary_of(START_NS + 1, **figures))
    assert desk.x_at(0.01) != before
    assert desk.session.diagnosis().level == Level.OK


@pytest.mark.parametrize("planned, used", [(0, True), (4, True), (5, False)])
def test_complete_means_all_planned_views(desk, planned, used):
    desk.session.take_map(map_of())
    desk.session.take_summary(summary_of(views_planned=planned))
    assert (desk.session.compensator is not None) is used


def test_any_map_is_used_where_that_is_asked_for():
    desk = Desk(require_qualified=False)
    desk.session.take_map(map_of(qualified=False))
    assert desk.x_at(0.0) is not None


def test_a_sample_is_corrected_by_one_map_as_a_whole(desk):
    for error_map, stamp in ((ONE, START_NS), (TWO, START_NS + 1)):
        desk.session.take_map(map_of(error_map, stamp))
        desk.session.take_summary(summary_of(stamp))
        x, y, _ = desk.session.correct(
            NAMES, [error_map.gx[2, 2], error_map.gy[2, 2], 0.0]
        )
        assert np.hypot(x, y) < 1e-15


@pytest.mark.parametrize("age_s, level", [(10.0, Level.OK), (10.1, Level.WARN)])
def test_an_old_map_is_a_warning(age_s, level):
    desk = Desk(max_map_age=10.0)
    desk.session.take_map(map_of())
    desk.session.take_summary(summary_of())
    desk.hands.pass_time(age_s)
    assert desk.session.diagnosis().level == level


def test_a_file_that_does_not_identify_the_stage_is_refused(tmp_path):
    data = result_to_dict(result_of(ONE))
    data["observability"]["identifiable"] = False
    data |= {"digest": digests_of(data)}
    path = tmp_path / "map.json"
    path.write_text(json.dumps(data))
    with pytest.raises(
        InputError,
        match="the map is not qualified; measure again, or set require_qualified to false",
    ):
        Desk(map=str(path))
    assert Desk(map=str(path), require_qualified=False).x_at(0.0) is not None


def test_a_steep_map_is_used_from_its_file_alone(tmp_path):
    steep = replace(ONE, gx=ONE.gx + 2e-4 * (np.arange(25) == 24).reshape(5, 5))
    (tmp_path / "map.json").write_text(json.dumps(result_to_dict(result_of(steep))))
    used = Desk(map=str(tmp_path / "map.json"), require_qualified=False)
    assert used.x_at(0.02) is not None
    with pytest.raises(
        InputError, match="if it is, name its file in the parameter map"
    ):
        Desk(require_qualified=False).session.take_map(map_of(steep))


def with_value(field: np.ndarray, value: float) -> np.ndarray:
    """Return a field of a map as in a message, with one value of another kind."""
    return np.append(field.ravel()[:-1], value)


MILLIRADIAN_REACH = 1e-3 / np.hypot(0.02, 0.02)
"""Angle by which the farthest of 5 x 5 sites of 10 mm moves by 1 mm, rad."""


@pytest.mark.parametrize(
    "changes, why",
    [
        ({"gx": np.zeros(3)}, "gx has 3 values, the plate 25"),
        (
            {"gx": with_value(ONE.gx, math.nan)},
            "gx is not finite at 1 of the 25 valid sites",
        ),
        ({"u_gy": with_value(ONE.gy, -1e-9)}, "u_gy is negative"),
        ({"u_g_theta": with_value(ONE.g_theta, -1e-9)}, "u_g_theta is negative"),
        (
            {"gy": with_value(ONE.gy, -math.inf)},
            "gy is not finite at 1 of the 25 valid sites",
        ),
        ({"g_theta": with_value(ONE.g_theta, math.inf)}, "g_theta is infinite"),
        (
            {"g_theta": np.full(8, math.nan)},
            "the error of no site or of no line is known",
        ),
        ({"valid": [False] * 25}, "the error of no site or of no line is known"),
        (
            {"gx": with_value(ONE.gx, 2e-4)},
            "mm to the next along x, 10 mm away: is it real?",
        ),
        (
            {"gy": np.full(25, -1.01e-3)},
            "it corrects by up to 0.00101 m, max_correction is 0.001 m; check its units",
        ),
        (
            {"g_theta": with_value(ONE.g_theta, 1.01 * MILLIRADIAN_REACH)},
            "it corrects by up to 0.00101 m, max_correction is 0.001 m; check its units",
        ),
    ],
)
def test_a_map_that_harms_leaves_the_former_one_in_use(desk, changes, why):
    use(desk, TWO)
    before = desk.session.correct(NAMES, [0.01, -0.01, 0.3])
    desk.session.take_summary(summary_of(START_NS + 1))
    with pytest.raises(InputError, match=re.escape(why)):
        desk.session.take_map(map_of(ONE, START_NS + 1, **changes))
    assert desk.session.correct(NAMES, [0.01, -0.01, 0.3]) == before
    assert why in desk.session.diagnosis().message
    desk.session.take_map(map_of(ONE, START_NS + 1))
    assert desk.session.correct(NAMES, [0.01, -0.01, 0.3]) != before


@pytest.mark.parametrize(
    "frame_id, used", [("stage", True), ("", True), ("gantry", False)]
)
def test_a_map_of_another_frame_leaves_the_former_one_in_use(desk, frame_id, used):
    use(desk, TWO)
    before = desk.x_at(0.01)
    desk.session.take_summary(summary_of(START_NS + 1))
    newer = map_of(ONE, START_NS + 1, header=from_model.header(START_NS + 1, frame_id))
    why = "it is in the frame 'gantry', the positions to correct are in 'stage'"
    with contextlib.nullcontext() if used else pytest.raises(InputError, match=why):
        desk.session.take_map(newer)
    assert (desk.x_at(0.01) != before) is used
    assert (why in desk.session.diagnosis().message) is not used


@pytest.mark.parametrize("factor", [0.99, 1.01])
def test_max_correction_is_the_largest_error_that_is_used(factor):
    largest = max(
        np.abs(ONE.gx).max(),
        np.abs(ONE.gy).max(),
        np.abs(ONE.g_theta).max() * np.hypot(0.02, 0.02),
    )
    desk = Desk(require_qualified=False, max_correction=factor * largest)
    taken = True
    try:
        desk.session.take_map(map_of())
    except InputError:
        taken = False
    assert taken is (factor > 1) and (desk.session.compensator is not None) is taken


@pytest.mark.parametrize(
    ("interpolation", "used"), [("bilinear", True), ("bicubic", False)]
)
@pytest.mark.parametrize("changed", ["gx", "g_theta"])
def test_a_spline_that_passes_beyond_the_limit_between_its_nodes_is_not_used(
    interpolation, used, changed
):
    """Through 0, 1, 1, 0 it reaches 9/8 in the middle, one of a circle about as much."""
    error_map = random_map(Artifact(4, 0.01, 8), 3)
    plateau = np.zeros_like(getattr(error_map, changed))
    plateau[1:3] = {"gx": 0.95e-4, "g_theta": 0.95e-4 / np.hypot(0.015, 0.015)}[changed]
    desk = Desk(require_qualified=False, max_correction=1e-4)
    try:
        desk.session.take_map(
            map_of(error_map, interpolation=interpolation, **{changed: plateau.ravel()})
        )
    except InputError as error:
        assert "max_correction is 0.0001 m" in str(error)
    assert (desk.session.compensator is not None) is used


@pytest.mark.parametrize(("angle", "used"), [(0.02, True), (0.06, False)])
def test_the_map_of_a_tiny_plate_does_not_turn_a_stage_by_any_angle(angle, used):
    desk, tiny = Desk(require_qualified=False), random_map(Artifact(5, 1e-6, 8), 3)
    try:
        desk.session.take_map(
            map_of(tiny, gx=np.zeros(25), gy=np.zeros(25), g_theta=np.full(8, angle))
        )
    except InputError as error:
        assert "max_correction is 0.001 m" in str(error)
    assert (desk.session.compensator is not None) is used


def test_nan_where_the_map_is_not_valid_is_no_error(desk):
    """Unknown sites have no value; what stands there is not looked at."""
    known = [True] * 24 + [False]
    desk.session.take_map(map_of(ONE, valid=known, gx=with_value(ONE.gx, math.nan)))
    desk.session.take_summary(summary_of())
    assert desk.x_at(0.0) is not None


@pytest.mark.parametrize(
    "position, refused",
    [
        (1e12, False),
        (-1.1e12, True),
        (1.7e308, True),
        (float("inf"), True),
        (float("nan"), True),
    ],
)
@pytest.mark.parametrize("joint", [0, 1, 2])
def test_a_position_that_no_stage_has_is_refused(desk, joint, position, refused):
    desk.session.take_map(map_of())
    desk.session.take_summary(summary_of())
    sample = [0.0, 0.0, 0.0]
    sample[joint] = position
    assert (desk.session.correct(NAMES, sample) is None) is refused
    assert desk.session.counts["refused"] == refused


JOINT_STATE = "sensor_msgs/msg/JointState"


def sample(number: int, x: float = 0.01, names: Sequence[str] = NAMES) -> bytes:
    """Return the bytes of a sample with a stamp of its own."""
    return bytes(
        typestore().serialize_cdr(
            build(
                typestore(),
                JOINT_STATE,
                {
                    "header": from_model.header(START_NS + number, "stage"),
                    "name": names,
                    "position": np.array([x, 0.0, 0.0]),
                    "velocity": np.array([1.0, 2.0, 3.0]),
                    "effort": np.zeros(0),
                },
            ),
            JOINT_STATE,
        )
    )


def corrected(desk, samples: list[bytes], lost: int = 0, age_ms: float = 0.0) -> list:
    """Have what came so long ago corrected; return the messages that are published."""
    out: list = []
    for data in samples:
        desk.session.receive(data, desk.hands.now_ns - round(age_ms * 1e6))
    desk.session.correct_waiting(lost, out.append)
    return [typestore().deserialize_cdr(data, JOINT_STATE) for data in out]


def numbers(messages: list) -> list[int]:
    return [message.header.stamp.nanosec for message in messages]


@pytest.fixture
def busy():
    """Return a desk whose map corrects at once."""
    desk = Desk(require_qualified=False, max_age=0.005)
    desk.session.take_map(map_of())
    return desk


def test_of_the_bytes_of_a_sample_the_positions_alone_change(busy):
    [message] = corrected(busy, [sample(7)])
    assert list(message.position) == busy.session.correct(NAMES, [0.01, 0.0, 0.0])
    assert message.position[0] != 0.01
    assert (
        message.name,
        list(message.velocity),
        message.header.frame_id,
        numbers([message]),
    ) == (NAMES, [1.0, 2.0, 3.0], "stage", [7])


@pytest.mark.parametrize(
    "waiting, lost, out",
    [
        (KEEPS_UP, 0, range(KEEPS_UP)),
        (KEEPS_UP + 1, 0, [KEEPS_UP]),
        (KEEPS_UP - 2, 2, range(KEEPS_UP - 2)),
        (KEEPS_UP - 2, 3, [KEEPS_UP - 3]),
        (0, 4, []),
    ],
)
def test_few_samples_are_corrected_in_order_and_of_many_the_newest_alone(
    busy, waiting, lost, out
):
    found = corrected(busy, [sample(number) for number in range(waiting)], lost)
    assert numbers(found) == list(out)
    skipped = waiting + lost - len(out)
    assert (busy.session.counts["corrected"], busy.session.counts["skipped"]) == (
        len(out),
        skipped,
    )
    told = busy.session.diagnosis()
    assert told.level == (Level.WARN if skipped else Level.OK)
    assert told.message.startswith(
        f"{skipped} samples skipped since the last status: "
    ) is (skipped > 0)


def test_skipped_samples_are_a_warning_once_and_a_count_for_good(busy):
    corrected(busy, [sample(1)], lost=40)
    assert busy.session.diagnosis().level == Level.WARN
    told = busy.session.diagnosis()
    assert (told.level, told.values["skipped"]) == (Level.OK, 40)
    assert corrected(busy, [sample(2)]) != []


@pytest.mark.parametrize("age_ms, level", [(5.0, Level.OK), (5.1, Level.WARN)])
def test_the_age_of_corrected_samples_is_told_and_beyond_max_age_a_warning(
    busy, age_ms, level
):
    corrected(busy, [sample(1)], age_ms=1.0)
    corrected(busy, [sample(2)], age_ms=2.0)
    corrected(busy, [sample(3)], age_ms=age_ms)
    told = busy.session.diagnosis()
    assert told.level == level
    assert (told.values["age_ms"], told.values["age_ms_max"]) == (
        "2.00",
        f"{age_ms:.2f}",
    )
    assert (
        "a corrected position was 5.1 ms old when it was published, max_age is 5 ms"
        in told.message
    ) is (level == Level.WARN)
    assert busy.session.diagnosis().level == Level.OK


def test_samples_that_cannot_be_read_are_refused_and_those_behind_them_corrected(busy):
    bad = sample(1)
    found = corrected(
        busy, [bad[:40], b"", sample(2, math.nan), b"\xff" * len(bad), sample(3)]
    )
    assert numbers(found) == [3]
    assert (busy.session.counts["refused"], busy.session.counts["corrected"]) == (4, 1)


def test_names_of_joints_do_not_spoil_the_diagnosis(desk):
    use(desk)
    assert desk.session.correct(["\x1b[2J\n", "x" * 10**6], [0.0, 0.0]) is None
    told = desk.session.diagnosis().message
    assert told.isprintable() and len(told) < 10_000


def test_another_axis_beside_the_stage_is_no_fault(busy):
    found = corrected(busy, [sample(1), sample(2, names=["z", "w", "v"]), sample(3)])
    assert numbers(found) == [1, 3]
    assert busy.session.diagnosis().level == Level.OK


def test_without_a_map_samples_are_counted_not_published(desk):
    assert corrected(desk, [sample(1), sample(2)]) == []
    assert desk.session.counts["without_map"] == 2
