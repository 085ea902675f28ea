# SPDX-License-Identifier: Apache-2.0
"""Between messages and the model: every field, by name, with its sign and unit, there and back."""

import math
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from selfcal_ros.bagio.messages import from_model, to_model
from selfcal_ros.bagio.schemas import typestore
from selfcal_ros.bagio.writer import build
from selfcal_ros.collection.expected import ViewProgress
from selfcal_ros.collection.inputs import Command, Detection, EncoderSample, Phase
from selfcal_ros.collection.timeline import Timeline
from selfcal_ros.errors import InputError
from selfcal_ros.model.artifact import Artifact, Interpolation, MapGrid
from selfcal_ros.model.error_map import ThetaDatum
from selfcal_ros.model.readings import (
    GridVisits,
    Measurements,
    RejectedPlaces,
    RepeatMotion,
    Sense,
    ViewReadings,
)
from selfcal_ros.model.verdict import Grade, Verdict
from selfcal_ros.model.view import ORDERS, View
from test.support.bags import contract_message, contract_types
from test.support.plans import image_plan
from test.support.results import known_result

STAMPS = st.integers(0, (2**31 - 1) * 10**9 + 999_999_999)
FLOATS = st.floats(allow_nan=False)
TEXTS = st.text(
    st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=9
)
U32, I32 = st.integers(0, 2**32 - 1), st.integers(-(2**31), 2**31 - 1)
FLOATS32 = st.floats(width=32, allow_nan=False)
DETECTIONS = st.builds(
    Detection,
    STAMPS,
    st.integers(0, 255),
    st.booleans(),
    I32,
    I32,
    U32,
    FLOATS,
    FLOATS,
    FLOATS,
    FLOATS,
    FLOATS32,
)
SAMPLES = st.lists(st.tuples(TEXTS, FLOATS, FLOATS), max_size=4).flatmap(
    lambda rows: st.builds(
        EncoderSample,
        STAMPS,
        *(st.just(tuple(row[i] for row in rows)) for i in range(3)),
    )
)
ARTIFACTS = st.builds(
    Artifact,
    st.integers(1, 50).map(lambda h: 2 * h + 1),
    st.floats(1e-7, 1.0),
    st.integers(0, 90).map(lambda q: 4 * q),
    st.integers(0, 50).map(lambda h: 2 * h + 1 if h else 0),
    st.none()
    | st.builds(
        MapGrid,
        st.integers(1, 50).map(lambda h: 2 * h + 1),
        st.floats(1e-7, 1.0),
        st.sampled_from(Interpolation),
        st.sampled_from([0, 3, 21]),
    ),
)
VIEWS = st.builds(
    View,
    TEXTS,
    FLOATS,
    st.tuples(FLOATS, FLOATS),
    st.booleans(),
    st.booleans(),
    st.integers(1, 2**32 - 1),
)
ORDER_TEXTS = st.sampled_from(["", *ORDERS]) | st.sampled_from(ORDERS).map(
    lambda o: o + "@plate"
)
ASKING = st.builds(
    Command,
    STAMPS,
    st.sampled_from([Phase.PLACE, Phase.MEASURE]),
    TEXTS,
    U32,
    st.builds(
        replace,
        VIEWS,
        visit_order=ORDER_TEXTS,
        check_marks=U32,
        check_offset_m=st.floats(0, 1),
    ),
    ARTIFACTS,
    U32,
)
ENDING = st.builds(
    Command,
    STAMPS,
    st.sampled_from([Phase.DONE, Phase.ABORT]),
    TEXTS,
    U32,
    views_planned=U32,
)
COUNTS = st.dictionaries(TEXTS, U32, max_size=3)
STAMP_NS = 1_700_000_000_123_456_789


def through_cdr(name, values):
    """Return the message with these fields after it was encoded and decoded."""
    typename = f"{'sensor' if name == 'JointState' else 'selfcal'}_msgs/msg/{name}"
    message = build(typestore(), typename, values)
    data = typestore().serialize_cdr(message, typename)
    return typestore().deserialize_cdr(bytes(data), typename)


@given(event=DETECTIONS)
def test_detections_come_back(event):
    message = through_cdr("MarkDetection", from_model.detection(event, "stage"))
    assert to_model.detection(message) == event
    assert message.header.frame_id == "stage"


@given(event=SAMPLES)
def test_encoder_samples_come_back(event):
    message = through_cdr("JointState", from_model.joint_state(event, "stage"))
    assert to_model.encoder_sample(message) == event
    assert len(message.effort) == 0


@given(event=ASKING | ENDING)
def test_commands_come_back(event):
    message = through_cdr("ViewCommand", from_model.command(event, "stage"))
    assert to_model.command(message) == event


@given(event=DETECTIONS | SAMPLES | ASKING)
def test_a_message_of_somebody_else_is_what_it_says(event):
    """The contract's fields by name, filled by another hand: no two are swapped both ways."""
    if isinstance(event, Command):
        event = replace(
            event,
            views_planned=0,
            artifact=replace(event.artifact, grid_size_y=0, map_grid=None),
            view=replace(event.view, visit_order="", check_marks=0, check_offset_m=0.0),
        )
    topic, typename, message = contract_message(contract_types(), event)
    read = {
        "stage/joint_states": to_model.encoder_sample,
        "selfcal/view_command": to_model.command,
        "stage/mark_detections": to_model.detection,
    }[topic]
    data = bytes(contract_types().serialize_cdr(message, typename))
    assert read(contract_types().deserialize_cdr(data, typename)) == event


def test_fields_of_a_detection_by_name():
    event = Detection(STAMP_NS, 1, True, -2, 3, 4, -5e-6, 6e-6, -7e-3, 8e-8, 0.5)
    assert from_model.detection(event, "f") == {
        "header": {
            "stamp": {"sec": 1_700_000_000, "nanosec": 123_456_789},
            "frame_id": "f",
        },
        "kind": 1,
        "has_id": True,
        "m": -2,
        "n": 3,
        "k": 4,
        "offset_x": -5e-6,
        "offset_y": 6e-6,
        "offset_theta": -7e-3,
        "sigma": 8e-8,
        "score": 0.5,
    }


PLATE = Artifact(5, 0.0125, 8, 7, MapGrid(9, 0.02, Interpolation.BILINEAR, 11), 3)
NO_IMAGE = {"image_nx": 0, "image_ny": 0, "image_pitch": 0.0}
NO_MARKS = {"mark_id": [], "mark_x": [], "mark_y": []}
MAP_FIELDS = {
    "map_grid_size": 9,
    "map_grid_size_y": 11,
    "map_grid_pitch": 0.02,
    "map_interpolation": "bilinear",
    "map_harmonics": 3,
}


def test_fields_of_a_command_by_name():
    view = View(
        "turned", math.pi / 2, (0.01, -0.02), True, False, 7, "x_then_y", 3, 2e-5
    )
    made = from_model.command(
        Command(
            STAMP_NS,
            Phase.MEASURE,
            "p",
            3,
            view,
            PLATE,
            9,
            model_terms=("drift:1e-08",),
            artifact_from="/r.json",
        ),
        "f",
    )
    del made["header"]
    assert made == {
        "phase": 1,
        "plan_id": "p",
        "view_index": 3,
        "view_name": "turned",
        "rotation": math.pi / 2,
        "translation_x": 0.01,
        "translation_y": -0.02,
        "grid": True,
        "angular": False,
        "repeats": 7,
        "grid_size": 5,
        "grid_pitch": 0.0125,
        "angular_count": 8,
        "grid_size_y": 7,
        "views_planned": 9,
        "visit_order": "x_then_y",
        "run_id": "",
        "model_terms": ["drift:1e-08"],
        "check_marks": 3,
        "check_offset": 2e-5,
        **MAP_FIELDS,
        **NO_IMAGE,
        "artifact_from": "/r.json",
        **NO_MARKS,
        "plan_keys": [],
    }


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"phase": 4},
            "selfcal/view_command: unknown phase 4; use PLACE, MEASURE, DONE or ABORT",
        ),
        ({"grid_size": 2}, "artifact grid_size: 2 is not a number"),
        ({"grid_pitch": math.nan}, "artifact grid_pitch: nan m is not a length"),
        (
            {"map_grid_size": 2, "map_grid_pitch": 0.1},
            "map grid_size: 2 is not a number",
        ),
        (
            {"angular_count": 7, "map_harmonics": 4},
            "map harmonics: 4 harmonics cannot be told with 7",
        ),
        (
            {"map_grid_size": 5},
            "map grid_pitch: 0.0 m is not a length; give the number of nodes",
        ),
        ({"image_nx": 2}, "image"),
        ({"image_nx": 3, "image_ny": 2}, "image"),
        (
            {"map_grid_size": 5, "map_grid_pitch": 0.1, "map_interpolation": "cubic"},
            "map_interpolation: 'cubic' is not known; use one of bilinear, bicubic",
        ),
        (
            {"header": from_model.header(-1, "f")},
            "selfcal/view_command: the stamp is before 1970; set the clock",
        ),
    ],
)
def test_commands_that_cannot_be_used(changes, message):
    values = from_model.command(
        Command(STAMP_NS, Phase.PLACE, "p", 3, View("a"), Artifact(5, 0.01)), "f"
    )
    with pytest.raises(InputError) as caught:
        to_model.command(through_cdr("ViewCommand", values | changes))
    assert str(caught.value).startswith(message)


def test_a_command_may_be_stamped_at_the_beginning_of_time():
    first = Command(0, Phase.PLACE, "p", 3, View("a"), Artifact(5, 0.01))
    assert (
        to_model.command(through_cdr("ViewCommand", from_model.command(first, "f")))
        == first
    )


@pytest.mark.parametrize("text", ["spiral", "\x1b[31m", "raster@stage"])
def test_an_order_that_is_not_known_does_not_cost_the_command(text):
    event = Command(
        STAMP_NS, Phase.MEASURE, "p", 3, View("a", repeats=2), Artifact(5, 0.01)
    )
    values = from_model.command(event, "f") | {"visit_order": text}
    assert to_model.command(through_cdr("ViewCommand", values)) == event


def test_no_repeats_are_one():
    values = from_model.command(
        Command(STAMP_NS, Phase.PLACE, "p", 3, View("a"), Artifact(5, 0.01)), "f"
    )
    assert (
        to_model.command(
            through_cdr("ViewCommand", values | {"repeats": 0})
        ).view.repeats
        == 1
    )


@given(stamp=st.integers(-(2**31) * 10**9, 2**31 * 10**9 - 1))
def test_a_stamp_is_kept_to_the_nanosecond(stamp):
    made = from_model.header(stamp, "f")["stamp"]
    assert 0 <= made["nanosec"] < 10**9
    assert made["sec"] * 10**9 + made["nanosec"] == stamp


def arrays(size, element, kind):
    return st.lists(element, min_size=size, max_size=size).map(
        lambda v: np.array(v, dtype=kind)
    )


@st.composite
def readings(draw):
    """Return readings with every field drawn by itself."""
    size, lines = draw(st.integers(0, 4)), draw(st.integers(0, 3))
    u, u_theta = (count * draw(st.booleans()) for count in (size, lines))
    return ViewReadings(
        draw(VIEWS),
        draw(arrays(size, I32, int)),
        draw(arrays(size, I32, int)),
        draw(arrays(size, FLOATS, float)),
        draw(arrays(size, FLOATS, float)),
        draw(arrays(size, U32, int)),
        draw(arrays(u, FLOATS, float)),
        draw(arrays(lines, U32, int)),
        draw(arrays(lines, FLOATS, float)),
        draw(arrays(lines, U32, int)),
        draw(arrays(u_theta, FLOATS, float)),
        draw(FLOATS),
        draw(FLOATS),
        draw(U32),
        draw(U32),
        draw(U32),
        draw(COUNTS),
    )


@settings(max_examples=20)
@given(
    read=readings(), artifact=ARTIFACTS, rejected=COUNTS, sense=st.sampled_from(Sense)
)
def test_view_measurements_come_back(read, artifact, rejected, sense):
    progress = ViewProgress(5, read.view, 0, 0, 0, 0, read, 0)
    whole = Measurements("p", artifact, (read,), sense, rejected)
    message = through_cdr(
        "ViewMeasurement", from_model.view_measurement(progress, whole, STAMP_NS, "f")
    )
    found = to_model.view_readings(message)
    for entry in (entry for entry in fields(ViewReadings) if entry.name != "places"):
        got, wanted = getattr(found, entry.name), getattr(read, entry.name)
        np.testing.assert_array_equal(got, wanted, entry.name)
        assert not isinstance(wanted, np.ndarray) or got.dtype == wanted.dtype
    assert to_model.artifact_of(message) == artifact
    assert to_model.counts(message, "session_reject") == rejected
    assert (to_model.sense_of(message), message.plan_id, message.view_index) == (
        sense,
        "p",
        5,
    )


VISITS = GridVisits(
    np.array([0, 0]),
    np.array([1e-6, 5e-6]),
    np.array([-2e-6, -6e-6]),
    np.array([2, 3]),
    np.array([5, 9]),
    np.array([1e-5, 2e-5]),
    np.array([3e-5, 4e-5]),
    np.array([1, -1], dtype=np.int8),
    np.array([0, 1], dtype=np.int8),
    np.array([4e-8, 5e-8]),
    9e-9,
    6,
)
READ = ViewReadings(
    View("a", 0.5, (0.01, -0.02), True, False, 3, "x_then_y"),
    np.array([-1]),
    np.array([2]),
    np.array([3e-6]),
    np.array([-4e-6]),
    np.array([5]),
    np.array([6e-8]),
    np.array([7]),
    np.array([-8e-3]),
    np.array([9]),
    np.array([1e-5]),
    1.1e-8,
    1.2e-6,
    13,
    14,
    15,
    {"low_score": 16, "not_at_mark": 2},
    VISITS,
    RejectedPlaces(
        ("not_at_mark", "low_score"), np.array([0.3, math.nan]), np.array([0.4, 0.5])
    ),
    motion=RepeatMotion(1e-15 * np.arange(16.0).reshape(4, 4), 21),
    motion_theta=RepeatMotion(1e-12 * np.array([[1.0, 2.0], [3.0, 4.0]]), 22),
    axis_theta=0.01,
)
MEASURED = Measurements(
    "p",
    replace(PLATE, grid_pitch_m=0.01),
    (READ,),
    Sense.PLATE_MOVES,
    {"other": 17},
    "77",
    ("approach",),
)
PROGRESS = ViewProgress(
    18,
    replace(READ.view, check_marks=4, check_offset_m=2e-5),
    19,
    20,
    21,
    22,
    READ,
    23,
    check_done=23,
)


def test_the_cell_of_an_image_comes_back():
    (plan_view, *_) = image_plan(5).views
    fields_of = from_model.command(
        Command(STAMP_NS, Phase.MEASURE, "p", 0, plan_view, image_plan(5).artifact), "f"
    )
    assert to_model.command(through_cdr("ViewCommand", fields_of)).view == plan_view
    unsaid = through_cdr("ViewCommand", {**fields_of, "image_pitch": 0.0})
    assert to_model.command(unsaid).view == plan_view
    for cell in plan_view.sub_views:
        progress = replace(PROGRESS, readings=replace(READ, view=cell))
        plate = replace(MEASURED, artifact=image_plan(5).artifact)
        message = through_cdr(
            "ViewMeasurement",
            from_model.view_measurement(progress, plate, STAMP_NS, "f"),
        )
        assert to_model.view_readings(message).view == cell
        assert to_model.cell_of(message) == cell.cell


def test_the_plate_and_the_map_of_a_measurement_come_back():
    there = from_model.view_measurement(PROGRESS, MEASURED, STAMP_NS, "f")
    assert (
        to_model.artifact_of(through_cdr("ViewMeasurement", there)) == MEASURED.artifact
    )


def test_the_visits_of_a_view_survive_the_message():
    there = from_model.view_measurement(PROGRESS, MEASURED, STAMP_NS, "f")
    back = to_model.view_readings(through_cdr("ViewMeasurement", there)).visits
    for name, column in vars(VISITS).items():
        assert np.array_equal(getattr(back, name), column), name
    old = through_cdr("ViewMeasurement", {**there, "visit_mark": []})
    assert to_model.view_readings(old).visits is None


def test_rejected_detections_and_the_visiting_order_survive_the_message():
    found = to_model.view_readings(
        through_cdr(
            "ViewMeasurement",
            from_model.view_measurement(PROGRESS, MEASURED, STAMP_NS, "f"),
        )
    )
    assert found.places.reason == READ.places.reason
    np.testing.assert_array_equal(
        [found.places.x, found.places.y], [READ.places.x, READ.places.y]
    )
    assert found.view.visit_order == "x_then_y"


@pytest.mark.parametrize("name", ["ViewCommand", "ViewMeasurement"])
def test_a_key_of_a_plan_that_is_not_known_is_refused_by_name(name):
    command = Command(STAMP_NS, Phase.MEASURE, "p", 3, View("a"), Artifact(5, 0.01))
    made = (
        from_model.command(command, "f")
        if name == "ViewCommand"
        else (from_model.view_measurement(PROGRESS, MEASURED, STAMP_NS, "f"))
    )
    read = to_model.command if name == "ViewCommand" else to_model.view_readings
    with pytest.raises(
        InputError,
        match="the key 'warm_up' of the plan is not known here; run all nodes in the newer version",
    ):
        read(through_cdr(name, {**made, "plan_keys": ["warm_up: 60"]}))


def test_sums_over_repeats_come_back():
    message = through_cdr(
        "ViewMeasurement",
        from_model.view_measurement(PROGRESS, MEASURED, STAMP_NS, "f"),
    )
    found = to_model.view_readings(message)
    for name in ("motion", "motion_theta"):
        got, wanted = getattr(found, name), getattr(READ, name)
        np.testing.assert_array_equal(got.products, wanted.products)
        assert got.dof == wanted.dof


def test_fields_of_a_view_measurement_by_name():
    known = replace(MEASURED, artifact_from="/r.json")
    made = from_model.view_measurement(PROGRESS, known, STAMP_NS, "f")
    del made["header"]
    np.testing.assert_array_equal(
        [made.pop("rejected_x"), made.pop("rejected_y")], [[0.3, math.nan], [0.4, 0.5]]
    )
    np.testing.assert_array_equal(made.pop("motion"), 1e-15 * np.arange(16.0))
    np.testing.assert_array_equal(made.pop("motion_theta"), 1e-12 * np.arange(1.0, 5.0))
    for name in [
        name for name in made if name.startswith("visit_") and name != "visit_order"
    ]:
        del made[name]
    assert made == {
        "plan_id": "p",
        "view_index": 18,
        "view_name": "a",
        "rotation": 0.5,
        "translation_x": 0.01,
        "translation_y": -0.02,
        "grid": True,
        "angular": False,
        "repeats": 3,
        "grid_size": 5,
        "grid_pitch": 0.01,
        "angular_count": 8,
        "grid_size_y": 7,
        "m": -1,
        "n": 2,
        "dx": 3e-6,
        "dy": -4e-6,
        "count": 5,
        "u": 6e-8,
        "k": 7,
        "dtheta": -8e-3,
        "count_theta": 9,
        "u_theta": 1e-5,
        "sigma_xy": 1.1e-8,
        "sigma_theta": 1.2e-6,
        "dof_xy": 13,
        "dof_theta": 14,
        "detections_used": 15,
        "reject_reasons": ["low_score", "not_at_mark"],
        "reject_counts": [16, 2],
        "measurement_sense": "plate_moves",
        "session_reject_reasons": ["other"],
        "session_reject_counts": [17],
        "run_id": "77",
        "sigma_visit": 9e-9,
        "dof_visit": 6,
        "model_terms": ["approach"],
        "session_notes": [],
        "dof_motion": 21,
        "dof_motion_theta": 22,
        **MAP_FIELDS,
        **NO_IMAGE,
        "image_x": 0,
        "image_y": 0,
        "artifact_from": "/r.json",
        "axis_theta": 0.01,
        **NO_MARKS,
        "rejected_reason": [1, 0],
        "visit_order": "x_then_y",
        "plan_keys": [],
    }


def test_fields_of_a_view_status_by_name():
    made = from_model.view_status(PROGRESS, "p", STAMP_NS, "f")
    assert made.pop("header") == from_model.header(STAMP_NS, "f")
    assert made == {
        "plan_id": "p",
        "view_index": 18,
        "view_name": "a",
        "grid_expected": 19,
        "grid_done": 20,
        "angular_expected": 21,
        "angular_done": 22,
        "detections_used": 15,
        "detections_rejected": 18,
        "reject_reasons": ["low_score", "not_at_mark"],
        "reject_counts": [16, 2],
        "sigma_xy": 1.1e-8,
        "sigma_theta": 1.2e-6,
        "complete": True,
        "missing_m": [],
        "missing_n": [],
        "missing_k": [],
        "run_id": "",
        "check_expected": 4,
        "check_done": 23,
    }
    through_cdr("ViewStatus", {"header": from_model.header(0, ""), **made})


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"n": [1, 2]}, "m, n, dx, dy, count, u differ in length"),
        ({"u": [1.0, 2.0]}, "m, n, dx, dy, count, u differ in length"),
        ({"u": [], "dy": []}, "m, n, dx, dy, count differ in length"),
        ({"k": []}, "k, dtheta, count_theta, u_theta differ in length"),
        ({"u_theta": [1.0, 2.0]}, "k, dtheta, count_theta, u_theta differ in length"),
        ({"reject_counts": []}, "reject_reasons and reject_counts differ in length"),
        (
            {"visit_dy": [1.0]},
            "the visits differ in length or name marks that were not read",
        ),
        (
            {"rejected_y": [1.0]},
            "the rejected detections differ in length or name no reason",
        ),
        (
            {"rejected_reason": [0, 2]},
            "the rejected detections differ in length or name no reason",
        ),
        ({"motion": [1.0, 2.0]}, "motion has 2 values, not 16"),
        ({"motion_theta": [1.0]}, "motion_theta has 1 values, not 4"),
        (
            {"visit_mark": [0, 1]},
            "the visits differ in length or name marks that were not read",
        ),
    ],
)
def test_arrays_that_do_not_belong_together(changes, said):
    values = from_model.view_measurement(PROGRESS, MEASURED, STAMP_NS, "f")
    with pytest.raises(InputError) as caught:
        to_model.view_readings(through_cdr("ViewMeasurement", values | changes))
    assert str(caught.value) == (
        f"selfcal/view_measurement of 'a': {said}; correct the publisher"
    )


def test_the_sense_of_a_measurement():
    values = from_model.view_measurement(PROGRESS, MEASURED, STAMP_NS, "f")
    older = through_cdr("ViewMeasurement", values | {"measurement_sense": ""})
    assert to_model.sense_of(older) is Sense.MICROSCOPE_MOVES
    with pytest.raises(
        InputError,
        match="measurement_sense 'both' is not known; use one of microscope_moves, plate_moves",
    ):
        to_model.sense_of(
            through_cdr("ViewMeasurement", values | {"measurement_sense": "both"})
        )


@pytest.fixture(scope="module")
def result():
    made, _ = known_result(5, 8, size_y=7)
    emap = replace(
        made.error_map,
        nonorthogonality=1.5e-6,
        scale_difference=-2.5e-6,
        datum_theta=ThetaDatum.ZERO_MEAN,
    )
    emap.gx[1, 2] = emap.gy[1, 2] = np.nan
    return replace(made, error_map=emap)


def test_an_oblong_error_map_is_laid_out_as_its_comments_say():
    made, _ = known_result(5, 8, size_y=7)
    emap = made.error_map
    message = through_cdr("ErrorMap", from_model.error_map(made, STAMP_NS, "f"))
    definition = (Path(__file__).parents[3] / "msg_defs/msg/ErrorMap.msg").read_text()
    said = (
        "Site i*Ny + j of Nx x Ny lies at x = (i - (Nx-1)/2) grid_pitch, "
        "y = (j - (Ny-1)/2) grid_pitch, i and j from 0: m = i - Nx//2, n = j - Ny//2."
    )
    assert said in definition
    nx, ny = message.grid_size, message.grid_size_y
    assert (nx, ny) == (5, 7) and len(message.gx) == nx * ny
    for i in range(nx):
        for j in range(ny):
            assert emap.artifact.x_m[i, j] == (i - (nx - 1) / 2) * message.grid_pitch
            assert emap.artifact.y_m[i, j] == (j - (ny - 1) / 2) * message.grid_pitch
            assert (emap.artifact.m[i, j], emap.artifact.n[i, j]) == (
                i - nx // 2,
                j - ny // 2,
            )
            assert message.gx[i * ny + j] == emap.gx[i, j]
            assert message.gy[i * ny + j] == emap.gy[i, j]


def test_an_error_map_comes_back(result):
    emap = result.error_map
    message = through_cdr("ErrorMap", from_model.error_map(result, STAMP_NS, "f"))
    found = to_model.error_map(message)
    assert message.interpolation == ""
    own = replace(
        result, placed_plate=replace(emap.artifact, map_grid=MapGrid(3, 0.01))
    )
    assert from_model.error_map(own, STAMP_NS, "f")["interpolation"] == "bicubic"
    for name in ("gx", "gy", "g_theta", "u_g_theta"):
        np.testing.assert_array_equal(getattr(found, name), getattr(emap, name), name)
    for name in ("u_gx", "u_gy"):
        wanted = np.where(emap.valid, getattr(emap, name), np.nan)
        np.testing.assert_array_equal(getattr(found, name), wanted, name)
    assert (
        found.artifact,
        found.datum_theta,
        found.nonorthogonality,
        found.scale_difference,
    ) == (emap.artifact, ThetaDatum.ZERO_MEAN, 1.5e-6, -2.5e-6)
    for m in range(-2, 3):
        for n in range(-3, 4):
            at = (m + 2) * 7 + (n + 3)
            assert message.valid[at] == ((m, n) != (-1, -1))
            if message.valid[at]:
                assert message.gx[at] == emap.gx[m + 2, n + 3]
                assert message.u_gy[at] == emap.u_gy[m + 2, n + 3]
    assert (message.sigma_xy, message.sigma_theta) == (
        result.noise.sigma_xy,
        result.noise.sigma_theta,
    )
    assert message.identifiable and message.plan_id == result.plan_id


@pytest.mark.parametrize(
    ("grade", "identifiable", "number"),
    [
        (Grade.GOOD, True, 2),
        (Grade.ENLARGED, True, 1),
        (Grade.NOT_QUALIFIED, True, 0),
        (Grade.GOOD, False, 0),
    ],
)
def test_the_grade_of_a_map_is_a_number(result, grade, identifiable, number):
    seen = replace(result.observability, identifiable=identifiable)
    graded = replace(result, verdict=Verdict(grade), observability=seen)
    message = through_cdr("ErrorMap", from_model.error_map(graded, STAMP_NS, "f"))
    assert (message.grade, from_model.grade_number(graded)) == (number, number)
    assert message.qualified is (grade is not Grade.NOT_QUALIFIED)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"gx": [1.0]}, "gx has 1 values, the plate 35; correct the publisher"),
        ({"valid": []}, "valid has 0 values, the plate 35; correct the publisher"),
        (
            {"u_g_theta": [1.0]},
            "u_g_theta has 1 values, the plate 8; correct the publisher",
        ),
        (
            {"datum_theta": "none"},
            "datum_theta 'none' is not known; use one of xy_axes, zero_mean",
        ),
    ],
)
def test_error_maps_that_cannot_be(result, changes, said):
    values = from_model.error_map(result, STAMP_NS, "f") | changes
    with pytest.raises(InputError) as caught:
        to_model.error_map(through_cdr("ErrorMap", values))
    assert str(caught.value) == f"selfcal/error_map: {said}"


@pytest.mark.parametrize(("last", "end"), [(10, 10), (40, 23)])
def test_the_stamp_of_a_view_is_its_end_or_the_last_command(last, end):
    assert from_model.session_stamp_ns(Timeline(last_stamp_ns=last), PROGRESS) == end


def test_a_field_that_is_not_given_is_an_error():
    with pytest.raises(KeyError, match="score"):
        build(
            typestore(),
            "selfcal_msgs/msg/MarkDetection",
            {
                name: value
                for name, value in from_model.detection(
                    Detection(0, 0, True, 0, 0, 0, 0.0, 0.0, 0.0, 0.0, 0.0), ""
                ).items()
                if name != "score"
            },
        )


def test_a_command_without_a_view_names_no_plate_and_asks_for_nothing():
    made = from_model.command(Command(STAMP_NS, Phase.DONE, "p", 3), "stage")
    for name in (
        "grid_size",
        "grid_pitch",
        "angular_count",
        "grid_size_y",
        "repeats",
        "map_grid_size",
        "map_grid_size_y",
        "map_grid_pitch",
        "map_harmonics",
    ):
        assert made[name] == 0, name
    assert (made["grid"], made["angular"], made["visit_order"]) == (False, False, "")
