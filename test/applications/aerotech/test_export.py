# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest

from selfcal_ros.applications.aerotech.evaluate import CalEvaluator
from selfcal_ros.applications.aerotech.export import (
    DECIMALS,
    table_theta,
    table_xy,
    theta_decimals,
)
from selfcal_ros.applications.aerotech.model import same_table
from selfcal_ros.applications.aerotech.read import parse_cal
from selfcal_ros.applications.aerotech.verify import setup_of, turned, verify_tables
from selfcal_ros.applications.aerotech.write import cal_text
from selfcal_ros.compensation.compensator import Compensator
from selfcal_ros.compensation.export import fill_unknown, provenance
from selfcal_ros.compensation.frame import MachineFrame, frame_from_comments
from selfcal_ros.errors import InputError
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.error_map import ErrorMap, ThetaDatum
from selfcal_ros.model.readings import Sense
from selfcal_ros.model.reference import ReferenceLength
from test.support.maps import random_map, result_of
from test.support.slow_cal import slow_2d
from test.support.truth import hu_plan, random_truth, simulate_measurements

ARTIFACT = Artifact(7, 0.01, 24)
OBLONG = Artifact(7, 0.01, 24, 5)
ROUNDING_M = 0.5e-11
FRAMES = [
    MachineFrame(1, 2, 3),
    MachineFrame(
        4, 3, 9, "um", home_x_m=-0.03, home_y_m=-0.03, theta_counts_per_unit=1000.0
    ),
    MachineFrame(
        1, 2, 3, "m", home_x_m=0.03, home_y_m=-0.03, reverse_x=True, reverse_theta=True
    ),
    MachineFrame(
        2,
        1,
        3,
        home_x_m=0.013,
        home_y_m=0.004,
        reverse_y=True,
        home_theta_rad=0.7,
        theta_counts_per_unit=12345.6,
    ),
    MachineFrame(
        1,
        2,
        3,
        home_x_m=-0.2,
        reverse_x=True,
        reverse_y=True,
        home_theta_rad=-2.0,
        reverse_theta=True,
        theta_counts_per_unit=100.0,
    ),
]


def written(tables, frame, decimals=DECIMALS):
    """Return tables as a controller reads them from the file."""
    text = cal_text(tables, comments=[frame.comment()], decimals=decimals)
    cal = parse_cal(text.encode(), "f.cal")
    assert all(same_table(a, b) for a, b in zip(tables, cal.tables, strict=True))
    return cal


def shift_error(emap, shift_m):
    """Bound of what a constant shift changes: the error's slope times the shift."""
    slope = max(
        np.abs(np.diff(g, axis=axis)).max() / emap.artifact.grid_pitch_m
        for g in (emap.gx, emap.gy)
        for axis in (0, 1)
    )
    return 2 * slope * np.abs(shift_m).sum()


@pytest.mark.parametrize("artifact", [ARTIFACT, OBLONG])
@pytest.mark.parametrize("frame", FRAMES)
def test_the_table_makes_the_simulated_machine_true_at_its_sites(frame, artifact):
    emap = random_map(artifact, 5)
    cal = written([table_xy(emap, frame)], frame)
    found = verify_tables(emap, cal.tables, frame_from_comments(cal.comments))
    assert found.sites.largest("before") > 1e-7
    bound = np.sqrt(2) * 2 * ROUNDING_M + shift_error(emap, found.sites.shift_after)
    assert found.sites.largest("after") < bound < 1e-10
    assert not found.worse and found.between.rms("after") < found.between.rms("before")


@pytest.mark.parametrize("frame", FRAMES[1:2])
def test_rounding_alone_is_left_if_the_error_at_home_is_zero(frame):
    emap = random_map(ARTIFACT, 6)
    emap.gx[0, 0] = emap.gy[0, 0] = 0.0
    found = verify_tables(emap, written([table_xy(emap, frame)], frame).tables, frame)
    assert found.sites.largest("after") < 2 * np.sqrt(2) * ROUNDING_M


@pytest.mark.parametrize("frame", FRAMES)
def test_a_flipped_sign_doubles_the_error(frame):
    emap = random_map(ARTIFACT, 5)
    for flipped in (
        replace(table_xy(emap, frame), negcor=True),
        table_xy(replace(emap, gx=-emap.gx, gy=-emap.gy), frame),
    ):
        found = verify_tables(emap, [flipped], frame)
        assert found.worse
        assert found.sites.rms("after") == pytest.approx(
            2 * found.sites.rms("before"), rel=1e-3
        )
    table = replace(table_theta(emap, frame), negcor=True)
    found = verify_tables(emap, [table], frame)
    assert found.worse and found.lines.rms("after") > 1.9 * found.lines.rms("before")


@pytest.mark.parametrize(
    "change",
    [
        {"reverse_x": True},
        {"reverse_y": True},
        {"home_x_m": 0.01},
        {"home_y_m": 0.02},
        {"unit": "um"},
    ],
)
def test_a_wrong_frame_leaves_an_error(change):
    emap = random_map(ARTIFACT, 5)
    right = MachineFrame(1, 2)
    found = verify_tables(emap, [table_xy(emap, right)], replace(right, **change))
    assert found.sites.rms("after") > 0.1 * found.sites.rms("before")


def test_exchanged_axes_leave_an_error():
    emap = random_map(ARTIFACT, 5)
    found = verify_tables(
        emap, [table_xy(emap, MachineFrame(1, 2))], MachineFrame(2, 1)
    )
    assert found.sites.rms("after") > found.sites.rms("before")


@pytest.mark.parametrize("reverse", [1.0, -1.0])
@pytest.mark.parametrize("home_m", [(-0.02, -0.02), (0.0, 0.0), (0.005, -0.01)])
def test_the_sign_against_physics_written_out_by_hand(reverse, home_m):
    """Encoder, home and correction from first principles; nothing of the package but the file."""
    artifact = Artifact(5, 0.01)
    emap = random_map(artifact, 8)
    stage = Compensator(emap)
    frame = MachineFrame(
        1, 2, home_x_m=home_m[0], home_y_m=home_m[1], reverse_x=reverse < 0
    )
    text = cal_text([table_xy(emap, frame)], decimals=DECIMALS)
    (table,) = parse_cal(text.encode(), "f").tables
    reached = []
    for x, y in zip(artifact.x_m.flat, artifact.y_m.flat, strict=True):
        # The program asks for these positions, in mm from home, counted by the encoders.
        px, py = reverse * (x - home_m[0]) * 1e3, (y - home_m[1]) * 1e3
        (cx, cy), _ = slow_2d(table, py, px, {1: {}, 2: {}})
        # The servo stops where the encoders show position plus correction: there
        # indicated = true + G(true) in the direction of the stage frame.
        indicated = reverse * (px + cx) * 1e-3 + home_m[0], (py + cy) * 1e-3 + home_m[1]
        true = np.array(indicated)
        for _ in range(20):
            true = np.array(indicated) - np.array(stage.error(*true))
        reached.append(true - (x, y))
    residual = np.array(reached) - np.mean(reached, axis=0)
    assert np.abs([emap.gx, emap.gy]).max() > 1e-7 and np.abs(residual).max() < 3e-11


@pytest.mark.parametrize("sense", list(Sense))
def test_from_readings_to_a_true_machine_whoever_moves(sense):
    """Microscope or plate moving: the map is in stage coordinates, and so is the table."""
    artifact = Artifact(7, 0.01, 8)
    plan = hu_plan(artifact)
    rng = np.random.default_rng(3)
    truth = random_truth(artifact, len(plan.views), rng)
    found = calibrate(simulate_measurements(truth, plan, rng, sense=sense)).error_map
    frame = MachineFrame(1, 2, 3, home_x_m=-0.03, theta_counts_per_unit=1000.0)
    machine = ErrorMap(artifact, *truth.g, *truth.g, truth.g_theta, truth.g_theta)
    xy = verify_tables(machine, [table_xy(found, frame)], frame).sites
    assert xy.largest("after") < 1e-10 < 1e-4 * xy.largest("before") * 10
    theta = verify_tables(machine, [table_theta(found, frame)], frame).lines
    assert theta.largest("after") < 2e-3 * theta.largest("before")


@pytest.mark.parametrize("frame", FRAMES)
def test_the_theta_table_makes_the_simulated_machine_true_at_its_lines(frame):
    # A smooth error, so that the shift of the zero bias costs little.
    angle = ARTIFACT.theta_rad
    emap = replace(
        random_map(ARTIFACT, 5),
        g_theta=1e-5 * np.sin(angle + 1) + 4e-6 * np.cos(3 * angle),
    )
    cal = written([table_theta(emap, frame)], frame, theta_decimals(emap))
    found = verify_tables(emap, cal.tables, frame_from_comments(cal.comments))
    assert found.sites is None and found.lines.largest("before") > 1e-5
    assert found.lines.largest("after") < 1e-9


def test_theta_rolls_over_for_ever_with_counts_and_covers_two_turns_without():
    emap = random_map(ARTIFACT, 5)
    for counts, turns in ((1000.0, (-5, 0, 1, 40)), (None, (-1, 0))):
        frame = MachineFrame(1, 2, 3, theta_counts_per_unit=counts)
        tables = CalEvaluator([table_theta(emap, frame)], setup_of(frame))
        base = turned(Compensator(emap), frame, ARTIFACT.theta_rad, tables)
        for turn in turns:
            reached = (
                turned(
                    Compensator(emap),
                    frame,
                    ARTIFACT.theta_rad + 2 * np.pi * turn,
                    tables,
                )
                - 2 * np.pi * turn
            )
            np.testing.assert_allclose(reached, base, rtol=0, atol=1e-11)


def test_what_the_2d_table_says():
    emap = random_map(OBLONG, 2)
    table = table_xy(emap, MachineFrame(4, 7, home_x_m=-0.03))
    assert (table.row_axis, table.column_axis, table.outputs) == (7, 4, (4, 7))
    assert table.values.shape == (5, 7, 2)
    assert (table.sample_row, table.sample_col) == (10.0, 10.0)
    assert (table.offset_row, table.offset_col) == (20.0, 0.0)
    assert table.values[1, 6, 0] == round(emap.gx[6, 1] * 1e6, 5)
    assert table.values[1, 6, 1] == round(emap.gy[6, 1] * 1e6, 5)
    mirrored = table_xy(emap, MachineFrame(4, 7, home_x_m=-0.03, reverse_x=True))
    assert (mirrored.sample_col, mirrored.offset_col) == (-10.0, 0.0)
    np.testing.assert_array_equal(mirrored.values, table.values * [-1, 1])


@pytest.mark.parametrize("unit", ["m", "mm", "um"])
def test_rounding_stays_below_a_hundredth_of_a_nanometre(unit):
    emap = random_map(ARTIFACT, 2, gain=30)
    frame = MachineFrame(1, 2, unit=unit)
    evaluator = CalEvaluator(written([table_xy(emap, frame)], frame).tables)
    got = evaluator.corrections(
        dict(zip((1, 2), frame.to_machine(ARTIFACT.x_m, ARTIFACT.y_m), strict=True))
    )
    for axis, g in ((1, emap.gx), (2, emap.gy)):
        bias = round(g[3, 3] * 1e6, 5) * 1e-6
        assert np.abs(got[axis] * frame.unit_m - (g - bias)).max() < 0.51e-11


def test_theta_digits_follow_the_size_of_the_field():
    for pitch in (1e-4, 1e-2, 1.0):
        emap = random_map(Artifact(11, pitch, 24), 1)
        half_digit_rad = np.deg2rad(0.5 * 10.0 ** -theta_decimals(emap) / 3600)
        assert half_digit_rad * np.hypot(5, 5) * pitch < 0.01e-9


def test_unknown_sites_and_lines_are_refused_or_filled():
    emap = random_map(ARTIFACT, 2, unknown=[(0, 0), (3, 3), (3, 4)])
    with pytest.raises(
        InputError, match="3 sites are unknown, and a table has no holes"
    ):
        table_xy(emap, MachineFrame())
    filled, count = fill_unknown(emap)
    assert count == 3 and filled.gx[0, 0] == pytest.approx(
        (emap.gx[0, 1] + emap.gx[1, 0]) / 2
    )
    around = [emap.gy[2, 3], emap.gy[4, 3], emap.gy[3, 2], filled.gy[3, 4]]
    assert filled.gy[3, 3] == pytest.approx(np.mean(around))
    np.testing.assert_array_equal(filled.gx[emap.valid], emap.gx[emap.valid])
    pair, _ = fill_unknown(random_map(ARTIFACT, 2, unknown=[(0, 0), (0, 1), (6, 6)]))
    assert pair.gx[0, 0] == pytest.approx((pair.gx[0, 1] + pair.gx[1, 0]) / 2)
    assert pair.gx[0, 1] == pytest.approx(
        (pair.gx[0, 0] + pair.gx[0, 2] + pair.gx[1, 1]) / 3
    )
    table = table_xy(filled, MachineFrame())
    found = verify_tables(emap, [table], MachineFrame())
    assert found.between is None and found.sites.largest("after") < 1e-10
    whole = random_map(ARTIFACT, 2)
    assert fill_unknown(whole)[1] == 0
    with pytest.raises(InputError, match="no site is known"):
        fill_unknown(replace(whole, gx=np.full((7, 7), np.nan)))
    whole.g_theta[0] = np.nan
    with pytest.raises(InputError, match="1 angular lines are unknown"):
        table_theta(whole, MachineFrame(1, 2, 3))


def test_theta_needs_an_axis_and_lines():
    with pytest.raises(InputError, match="theta axis: it is not named"):
        table_theta(random_map(ARTIFACT, 1), MachineFrame())
    with pytest.raises(InputError, match="it has no angular lines"):
        table_theta(random_map(Artifact(5, 0.01), 1), MachineFrame(1, 2, 3))


@pytest.mark.parametrize("frame", FRAMES)
def test_frames_survive_their_comment(frame):
    got = frame_from_comments(["x", frame.comment()])
    assert repr(replace(got, home_x_m=0, home_y_m=0, home_theta_rad=0)) == repr(
        replace(frame, home_x_m=0, home_y_m=0, home_theta_rad=0)
    )
    assert (got.home_x_m, got.home_y_m, got.home_theta_rad) == pytest.approx(
        (frame.home_x_m, frame.home_y_m, frame.home_theta_rad), rel=1e-12
    )


def test_axes_alone_go_with_every_frame_of_these_axes():
    frame = MachineFrame(1, 2, 3, home_x_m=0.01, reverse_y=True)
    lines = [MachineFrame().comment(axes_alone=True), frame.comment()]
    assert frame_from_comments(lines) == frame_from_comments(lines[::-1]) == frame
    assert frame_from_comments(lines[:1]) == MachineFrame()
    assert frame_from_comments(lines[:1], MachineFrame(reverse_x=True)).reverse_x
    with pytest.raises(InputError, match="'machine: x-axis=4 y-axis=2 unit=mm' and"):
        frame_from_comments([MachineFrame(4).comment(axes_alone=True), frame.comment()])


@pytest.mark.parametrize(
    "comments",
    [
        [],
        ["machine"],
        ["machine: x-axis=1"],
        ["machine: x-axis=1 y-axis=b"],
        ["machine: x-axis=1 y-axis=2 unit=ell"],
    ],
)
def test_comments_that_tell_no_frame(comments):
    assert frame_from_comments(comments) is None


def test_frames_refuse_nonsense():
    with pytest.raises(InputError, match="'inch' is not a primary unit"):
        MachineFrame(unit="inch")
    with pytest.raises(InputError, match="are not distinct"):
        MachineFrame(1, 2, 2)


def test_tables_of_other_axes_are_refused_by_the_verification():
    emap = random_map(ARTIFACT, 1)
    with pytest.raises(InputError, match="name the axes of the stage"):
        verify_tables(emap, [table_xy(emap, MachineFrame(5, 6))], MachineFrame(1, 2))


@pytest.mark.parametrize("datum", ThetaDatum)
def test_provenance_says_bag_plan_date_and_uncertainty(datum):
    result = result_of(
        replace(random_map(ARTIFACT, 1), datum_theta=datum), sense="plate_moves"
    )
    when = datetime(2026, 1, 2, tzinfo=UTC)
    text = "\n".join(provenance(result, MachineFrame(), filled=2, now=when))
    for part in (
        "2026-01-02T00:00:00Z",
        "plan: demo",
        "plate_moves",
        "demo.mcap",
        "ab" * 32,
        "um rms",
        str(datum),
        "2 sites were not measured",
        "machine: x-axis=1",
    ):
        assert part in text
    u = (
        np.sqrt(np.mean(np.square([result.error_map.u_gx, result.error_map.u_gy])))
        * 1e6
    )
    assert f"(k=1): {u:.3g} um rms" in text
    assert f"datum: no translation, rotation, magnification; theta: {datum}" in text
    known = replace(result, reference=ReferenceLength("artifact", 1e-6, 1e-7))
    text = "\n".join(provenance(known, MachineFrame()))
    assert f"datum: no translation, rotation; theta: {datum}" in text


def test_the_residual_is_true_minus_commanded():
    emap = random_map(OBLONG, 4)
    found = verify_tables(emap, [table_xy(emap, MachineFrame())], MachineFrame())
    g = np.stack([emap.gx.ravel(), emap.gy.ravel()])
    np.testing.assert_allclose(
        found.sites.before, g.mean(axis=1)[:, None] - g, atol=1e-10
    )
    np.testing.assert_allclose(
        found.sites.shift_after, -np.array([emap.gx[3, 2], emap.gy[3, 2]]), atol=1e-10
    )
    lines = verify_tables(emap, [table_theta(emap, FRAMES[0])], FRAMES[0]).lines
    # Without a table the stage stands at the angle whose error it shows: slope times error off.
    np.testing.assert_allclose(
        lines.before[0], emap.g_theta.mean() - emap.g_theta, atol=1e-6
    )
    assert np.corrcoef(lines.before[0], emap.g_theta)[0, 1] < -0.99


@pytest.mark.parametrize("counts", [0.0, -1.0, np.inf, np.nan])
def test_counts_of_theta_are_positive_numbers(counts):
    assert MachineFrame(1, 2, 3, theta_counts_per_unit=0.5).theta_counts_per_unit == 0.5
    with pytest.raises(InputError, match="is not a positive number; give the encoder"):
        MachineFrame(1, 2, 3, theta_counts_per_unit=counts)
