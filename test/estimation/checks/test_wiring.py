# SPDX-License-Identifier: Apache-2.0
"""The wiring of the microscope, from repeats alone: signs, exchanged axes and units."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import stdtr
from scipy.stats import linregress

from selfcal_ros.collection.inputs import Detection, Kind
from selfcal_ros.collection.marks.repeats import repeat_motion
from selfcal_ros.errors import ExitCode
from selfcal_ros.estimation.api import calibrate, robust_calibrate
from selfcal_ros.estimation.checks.wiring import (
    WiringError,
    _p_of,
    _response,
    check_wiring,
    contradicted_scale,
    wiring_error,
    wiring_faults,
)
from selfcal_ros.estimation.options import Options
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.readings import Measurements, RepeatMotion, Sense, ViewReadings
from selfcal_ros.model.view import View
from test.support.collecting import collect, scene

NM, UM = 1e-9, 1e-6
WIRINGS = {
    "-x": [[-1, 0], [0, 1]],
    "-y": [[1, 0], [0, -1]],
    "-x-y": [[-1, 0], [0, -1]],
    "yx": [[0, 1], [1, 0]],
    "-y-x": [[0, -1], [-1, 0]],
    "-yx": [[0, -1], [1, 0]],
    "y-x": [[0, 1], [-1, 0]],
}
GOOD = [[1, 0], [0, 1]]
BOTH_WAYS = pytest.mark.parametrize("sense", list(Sense))
NAMED = pytest.mark.parametrize("with_ids", [True, False])


def motion(
    rng,
    *,
    wiring=GOOD,
    marks=49,
    repeats=4,
    servo=60 * NM,
    noise=10 * NM,
    readout=0.0,
    correlation=0.0,
    drift=0.0,
    missing=0.0,
    stops=0.0,
):
    """Return the sums over repeats of marks whose stage scatters; drift moves plate and stage."""
    key = np.tile(np.arange(marks), repeats)
    moved = rng.normal(0, 1, (2, len(key)))
    moved[1] = correlation * moved[0] + np.sqrt(1 - correlation**2) * moved[1]
    moved *= servo
    if stops:
        beside = stops * np.tile([[1, -1, 0, 0], [0, 0, 1, -1]], 5)
        key = np.concatenate([key, np.repeat(np.arange(5), 4)])
        moved = np.concatenate([moved, beside], axis=1)
    keep = rng.random(len(key)) >= missing
    key, moved = key[keep], moved[:, keep]
    time = drift * np.linspace(0, 1, len(key)) ** 2
    place = rng.normal(0, 0.05, (2, marks))[:, key] + moved + time
    offset = rng.normal(0, 30 * UM, (2, marks))[:, key] - np.array(wiring) @ moved
    return repeat_motion(
        key,
        place + rng.normal(0, 1, moved.shape) * readout,
        offset + rng.normal(0, 1, moved.shape) * noise - 0.01 * time,
        np.zeros(len(key), dtype=bool),
    )


def measured(*views):
    return Measurements(
        "p",
        Artifact(7, 0.01, 0),
        tuple(ViewReadings(View(f"v{i}"), motion=told) for i, told in enumerate(views)),
    )


def found(*views):
    """Return offset -> axis, and slope rounded, of the faults of all kinds."""
    return {
        r.offset: (r.axis, round(r.slope, 1))
        for fault in wiring_faults(measured(*views))
        for r in fault.responses
    }


@pytest.mark.parametrize("name", WIRINGS)
def test_every_other_wiring_is_named_with_its_axes_and_signs(name):
    told = found(motion(np.random.default_rng(1), wiring=WIRINGS[name]))
    wiring = np.array(WIRINGS[name])
    expected = {}
    for j, offset in enumerate("xy"):
        i = int(np.abs(wiring[j]).argmax())
        if wiring[j, i] != 1 or i != j:
            expected[offset] = ("xy"[i], -wiring[j, i])
    assert {
        offset: (axis, np.sign(slope)) for offset, (axis, slope) in told.items()
    } == expected
    assert all(abs(slope) == pytest.approx(1, abs=0.1) for _, slope in told.values())


@pytest.mark.parametrize(
    ("scale", "named"),
    [
        ((2, 2), "xy"),
        ((2, 1), "x"),
        ((1, 0.5), "y"),
        ((0.5, 0.5), "xy"),
        ((1.3, 0.8), ""),
        ((1.05, 0.95), ""),
    ],
)
def test_units_far_from_one_are_refused_and_others_left_to_the_fit(scale, named):
    told = found(
        motion(np.random.default_rng(2), wiring=np.diag(scale), servo=100 * NM)
    )
    assert "".join(told) == named
    assert all(
        told[axis][1] == pytest.approx(-scale["xy".index(axis)], abs=0.1)
        for axis in told
    )


@pytest.mark.parametrize(
    ("scale", "how", "wanted"),
    [
        ((1.3, 1.3), {}, 1.3),
        ((0.8, 0.8), {}, 0.8),
        ((1.0, 1.3), {}, 1.3),
        ((1.1, 1.1), {}, 1.1),
        ((1.02, 1.02), {}, None),
        ((1.3, 1.3), {"servo": 20 * NM, "noise": 20 * NM}, 1.3),
        ((0.8, 0.8), {"servo": 20 * NM, "readout": 10 * NM}, None),
    ],
)
def test_repeats_contradict_a_scale_that_no_noise_explains(scale, how, wanted):
    """Encoder noise makes a scale smaller, noise of detections larger than the offsets show."""
    told = measured(
        *(
            motion(np.random.default_rng(seed), wiring=np.diag(scale), **how)
            for seed in range(4)
        )
    )
    response = contradicted_scale(told, 0.01)
    assert (response is None) == (wanted is None)
    if response is not None:
        assert response.axis == ("y" if scale[0] == 1 else response.offset)
        assert -response.slope == pytest.approx(wanted, rel=0.08)
        assert -response.slope < response.most
        assert contradicted_scale(told, 0.2) is None
        assert (
            contradicted_scale(measured(motion(np.random.default_rng(0), servo=0.0)), 0)
            is None
        )


@pytest.mark.parametrize(
    "how",
    [
        {},
        {"readout": 60 * NM},
        {"noise": 60 * NM},
        {"drift": UM},
        {"noise": 30 * NM, "readout": 30 * NM},
    ],
)
def test_no_noise_contradicts_a_correct_scale(how):
    """Of 200 measurements with a scale known exactly."""
    told = [
        measured(motion(np.random.default_rng(seed), servo=30 * NM, repeats=2, **how))
        for seed in range(200)
    ]
    assert sum(contradicted_scale(one, 0.0) is not None for one in told) <= 1


def test_readout_noise_is_no_scale_and_turns_no_sign():
    """The stage scatters by 20 nm, its encoder by 60 nm: the slope is a tenth."""
    how = {"servo": 20 * NM, "readout": 60 * NM, "repeats": 10, "marks": 121}
    assert found(motion(np.random.default_rng(3), **how)) == {}
    told = found(motion(np.random.default_rng(3), wiring=WIRINGS["-x-y"], **how))
    assert told == {"x": ("x", 0.1), "y": ("y", 0.1)}


def test_noise_of_the_microscope_is_no_scale():
    assert (
        found(
            motion(
                np.random.default_rng(4),
                servo=20 * NM,
                noise=60 * NM,
                repeats=10,
                marks=121,
            )
        )
        == {}
    )


def test_motion_along_a_diagonal_tells_no_exchange_but_a_sign():
    assert found(motion(np.random.default_rng(5), correlation=1.0)) == {}
    assert (
        found(motion(np.random.default_rng(5), correlation=1.0, wiring=WIRINGS["yx"]))
        == {}
    )
    assert found(
        motion(np.random.default_rng(5), correlation=1.0, wiring=WIRINGS["-x-y"])
    ) == {"x": ("x", 1.0), "y": ("y", 1.0)}


@pytest.mark.parametrize(
    "how", [{"servo": 0.0}, {"repeats": 1}, {"servo": 0.0, "noise": 0.0}]
)
def test_without_motion_nothing_is_said(how):
    assert found(motion(np.random.default_rng(6), wiring=WIRINGS["-x-y"], **how)) == {}


def test_a_drift_that_the_stage_follows_is_no_response_of_the_microscope():
    """Place and offset both change by it, slowly: +0.01 and -0.01 of 1 µm."""
    for wiring in (1, -1):
        told = motion(
            np.random.default_rng(7), servo=0.0, noise=0.1 * NM, drift=wiring * UM
        )
        assert found(told) == {}


def test_stops_beside_the_marks_tell_it_though_they_are_outliers():
    rng = np.random.default_rng(8)
    assert found(motion(rng, servo=0.0, stops=20 * UM)) == {}
    key = np.tile(np.arange(9), 6)
    moved = np.where(np.arange(54) < 9, 20 * UM, rng.normal(0, NM, (2, 54)))
    noise = rng.normal(0, 10 * NM, (2, 54))
    outlier = np.arange(54) < 9  # their deviations are 40 µm off
    speck = (np.arange(54) == 30) * 100 * UM  # and this is one
    told = repeat_motion(key, moved, moved + noise + speck, outlier | (speck > 0))
    assert found(told) == {"x": ("x", 1.0), "y": ("y", 1.0)}


def test_one_view_that_is_wired_wrongly_is_named():
    rng = np.random.default_rng(9)
    views = [motion(rng), motion(rng), motion(rng, wiring=WIRINGS["-x-y"])]
    (fault,) = wiring_faults(measured(*views))
    assert fault.view == "v2"
    assert wiring_error(fault).where == "stage/mark_detections of view 'v2'"


def test_no_clean_measurement_of_three_hundred_is_refused():
    refused = 0
    for seed in range(300):
        rng = np.random.default_rng(seed)
        how = {
            "servo": rng.choice([0, 1]) * 10 ** rng.uniform(-10, -7),
            "readout": rng.choice([0, 1]) * 10 ** rng.uniform(-10, -7),
            "noise": rng.uniform(5, 50) * NM,
            "repeats": int(rng.integers(2, 11)),
            "marks": int(rng.choice([9, 25, 49])),
            "missing": rng.choice([0, 0.2]),
            "correlation": rng.choice([0, 0.9, -1]),
            "drift": rng.choice([0, UM]),
            "stops": rng.choice([0, 20 * UM]),
        }
        wiring = np.eye(2) + rng.normal(0, 0.02, (2, 2))
        views = [motion(rng, wiring=wiring, **how) for _ in range(rng.integers(1, 5))]
        refused += bool(found(*views))
    assert refused == 0


@pytest.mark.parametrize("dof", [3, 40, 1000])
def test_the_probability_is_that_of_student_or_a_little_more(dof):
    for r in (0.05, 0.3, 0.6, 0.95):
        exact = stdtr(dof - 1, -r * np.sqrt((dof - 1) / (1 - r**2)))
        assert exact <= _p_of(r, dof) <= (1.1 * exact + 1e-300 if exact < 0.01 else 0.5)
    assert _p_of(-0.5, dof) == _p_of(0.0, dof) == 0.5


def measured_session(spoilt, *, sense, with_ids, text="0, 90, tx", **how):
    cell = scene(
        text,
        repeats=5,
        line=True,
        sense=sense,
        with_ids=with_ids,
        sigma_xy_m=10 * NM,
        servo_sigma_m=60 * NM,
        sigma_theta_rad=1e-6,
        servo_sigma_theta_rad=6e-6,
        **how,
    )
    cell.detections = [spoilt(d) for d in cell.detections]
    return collect(cell.events, measurement_sense=str(sense))[0]


def plain(detection: Detection) -> Detection:
    return detection


def reversed_x(d):
    return replace(d, offset_x=-d.offset_x)


def reversed_y(d):
    return replace(d, offset_y=-d.offset_y)


def reversed_theta(d):
    return replace(d, offset_theta=-d.offset_theta)


def exchanged(d):
    return replace(d, offset_x=d.offset_y, offset_y=d.offset_x)


def doubled(d):
    return replace(
        d,
        offset_x=2 * d.offset_x,
        offset_y=2 * d.offset_y,
        offset_theta=2 * d.offset_theta,
    )


SPOILT = [
    (reversed_x, {"x": ("x", 1.0)}),
    (reversed_y, {"y": ("y", 1.0)}),
    (lambda d: reversed_x(reversed_y(d)), {"x": ("x", 1.0), "y": ("y", 1.0)}),
    (reversed_theta, {"theta": ("theta", 1.0)}),
    (exchanged, {"x": ("y", -1.0), "y": ("x", -1.0)}),
    (doubled, {"x": ("x", -2.0), "y": ("y", -2.0), "theta": ("theta", -2.0)}),
]


@BOTH_WAYS
@NAMED
@pytest.mark.parametrize(("spoilt", "expected"), SPOILT)
def test_a_session_with_wrong_offsets_is_refused(sense, with_ids, spoilt, expected):
    readings = measured_session(spoilt, sense=sense, with_ids=with_ids)
    told = {
        r.offset: (r.axis, round(r.slope, 1))
        for fault in wiring_faults(readings)
        for r in fault.responses
    }
    assert told == {
        name: (axis, pytest.approx(slope, abs=0.11))
        for name, (axis, slope) in expected.items()
    }
    with pytest.raises(WiringError):
        calibrate(readings)


def test_exchanged_joints_look_the_same_as_exchanged_offsets():
    readings = measured_session(exchanged, sense=Sense.MICROSCOPE_MOVES, with_ids=True)
    lines = {str(wiring_error(fault)) for fault in wiring_faults(readings)}
    assert lines and all(
        line.endswith("; or, if the joints are exchanged, correct joint_x and joint_y")
        for line in lines
    )


@BOTH_WAYS
@NAMED
def test_a_session_with_good_offsets_is_calibrated(sense, with_ids):
    readings = measured_session(plain, sense=sense, with_ids=with_ids)
    check_wiring(readings)
    assert calibrate(readings).verdict.qualified


def test_without_ids_reversed_offsets_are_of_the_same_marks():
    told = [
        measured_session(
            lambda d: reversed_x(reversed_y(d)),
            sense=Sense.MICROSCOPE_MOVES,
            with_ids=with_ids,
        )
        for with_ids in (True, False)
    ]
    for named, free in zip(*(readings.views for readings in told), strict=True):
        np.testing.assert_array_equal(named.m, free.m)
        np.testing.assert_array_equal(named.dx, free.dx)
        assert free.rejected == {}


def test_the_error_says_what_and_how_to_correct_it_in_one_line():
    readings = measured_session(
        lambda d: reversed_x(reversed_y(d)), sense=Sense.PLATE_MOVES, with_ids=True
    )
    for solve in (calibrate, robust_calibrate):
        with pytest.raises(WiringError) as error:
            solve(readings, Options())
        text = str(error.value)
        assert text.startswith(
            "plan '0, 90, tx', stage/mark_detections: offsets of the other sign: "
            "offset_x and offset_y rise where the optical axis moves on"
        )
        assert text.endswith(
            "mark - optical axis: reverse the sign of offset_x and offset_y; or, "
            "if it is right, stamp the detections with the time of the exposure"
        )
        assert "sense" not in text and "\n" not in text
        assert error.value.exit_code is ExitCode.BAD_INPUT


def test_rejected_kinds_are_in_no_sums():
    """Lines tell nothing of x and y, marks nothing of the angle."""
    cell = scene("0", repeats=3, line=False, count=0)
    readings = collect(
        [
            e
            for e in cell.events
            if not (isinstance(e, Detection) and e.kind == Kind.ANGULAR)
        ]
    )[0].views[0]
    assert (
        readings.motion_theta is None and readings.motion.dof == 2 * (25 * 2 - 5) // 3
    )


@pytest.mark.parametrize("correlation", [0.0, -0.3])
def test_a_correlation_of_no_sign_or_the_other_one_is_as_probable_as_not(correlation):
    assert _p_of(correlation, 10) == 0.5


def test_the_slope_of_a_response_and_its_u_are_those_of_a_line_through_five_values():
    rng = np.random.default_rng(2)
    x = rng.normal(0, 60 * NM, 5)
    values = np.stack([x, 0.9 * x + rng.normal(0, 20 * NM, 5)])
    about = values - values.mean(axis=1, keepdims=True)
    response = _response(RepeatMotion(about @ about.T, 4), (0, 0), ("x",))
    line = linregress(*values)
    assert response.slope == pytest.approx(line.slope)
    assert response.u_slope == pytest.approx(line.stderr)
