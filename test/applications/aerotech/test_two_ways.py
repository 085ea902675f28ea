# SPDX-License-Identifier: Apache-2.0
"""The same correction two ways: map, 2D table, 1D tables, galvo table, controller, any wiring."""

from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.applications.aerotech.evaluate import (
    AxisSetup,
    CalEvaluator,
    MachineSetup,
)
from selfcal_ros.applications.aerotech.export import (
    DECIMALS,
    AxisCorrection,
    line_table,
    table_theta,
    table_xy,
    theta_decimals,
)
from selfcal_ros.applications.aerotech.model import Unit, UnitWord
from selfcal_ros.applications.aerotech.read import parse_cal, refuse_errors
from selfcal_ros.applications.aerotech.verify import plane_correction, setup_of
from selfcal_ros.applications.aerotech.write import cal_text
from selfcal_ros.compensation.compensator import Compensator
from selfcal_ros.compensation.frame import MachineFrame, frame_from_comments
from selfcal_ros.compensation.residual import reached
from selfcal_ros.model.artifact import Artifact
from test.support.maps import random_map
from test.support.slow_cal import slow_2d

ROUNDING_M = 1.01e-11
"""A correction and the bias at home, each rounded to 1e-5 um."""
METRES = {"m": 1.0, "mm": 1e-3, "um": 1e-6}


def written(tables, decimals=None, comments=()):
    """Return what a file of these tables holds after writing and reading."""
    text = cal_text(tables, decimals=decimals, comments=comments)
    return refuse_errors(parse_cal(text.encode(), "f.cal"))


def case(seed):
    """Return a random map, a random wiring, and stage positions: inside, outside, sites, edges."""
    rng = np.random.default_rng(seed)
    artifact = Artifact(
        int(rng.choice([3, 5, 11])),
        float(rng.choice([0.01, 0.0033, 1 / 3e3])),
        int(rng.choice([4, 24, 72])),
        int(rng.choice([3, 7, 11])),
    )
    half = np.array(artifact.half) * artifact.grid_pitch_m
    home = [
        float(rng.choice([0, -h, h, rng.uniform(-h, h), rng.uniform(-3 * h, 3 * h)]))
        for h in half
    ]
    axes = [int(axis) for axis in rng.choice(np.arange(1, 33), 3, replace=False)]
    frame = MachineFrame(
        *axes,
        str(rng.choice(list(METRES))),
        *home,
        float(rng.uniform(-4, 4)),
        *(bool(turned) for turned in rng.integers(0, 2, 3)),
        [None, 1000.0, 1234.5][seed % 3],
    )
    error_map = random_map(artifact, seed)
    places = np.concatenate(
        [
            rng.uniform(-1.5, 1.5, (2, 40)) * half[:, None],
            [artifact.x_m.ravel(), artifact.y_m.ravel()],
            half[:, None] * [[1, 1, -1, 0], [1, -1, 0, 1]],
        ],
        axis=1,
    )
    return error_map, frame, places, bool(np.all(np.abs(home) <= half * (1 + 1e-12)))


def metres(found, frame):
    """Return corrections by axis as stage corrections, m."""
    return (
        np.stack(
            [frame.sign_x * found[frame.x_axis], frame.sign_y * found[frame.y_axis]]
        )
        * METRES[frame.unit]
    )


@pytest.mark.parametrize("seed", range(30))
def test_a_table_is_the_map_less_its_value_at_home(seed):
    error_map, frame, places, inside = case(seed)
    cal = written([table_xy(error_map, frame)], DECIMALS, [frame.comment()])
    again = vars(frame_from_comments(cal.comments))
    assert all(
        again[name]
        == (pytest.approx(value, rel=1e-14) if isinstance(value, float) else value)
        for name, value in vars(frame).items()
    )
    compensator, evaluator = Compensator(error_map), CalEvaluator(cal.tables)
    px, py = frame.to_machine(*places)
    found = evaluator.corrections({frame.x_axis: px, frame.y_axis: py})
    bias = (
        np.array(compensator.error(frame.home_x_m, frame.home_y_m))
        if inside
        else np.zeros(2)
    )
    want = np.array(compensator.error(*places)) - bias[:, None]
    np.testing.assert_allclose(metres(found, frame), want, rtol=0, atol=ROUNDING_M)
    table = cal.tables[0]
    for k in range(0, places.shape[1], 9):
        slow, _ = slow_2d(table, py[k], px[k], {axis: {} for axis in range(33)})
        for axis, value in zip(table.outputs, slow, strict=True):
            assert value == pytest.approx(
                found[axis][k], abs=1e-14 / METRES[frame.unit]
            )
    # The controller stands where it was told to but for the bias, to first order in the slope.
    stood = np.array(
        reached(compensator, frame, places, correct=plane_correction(evaluator, frame))
    )
    within = np.abs(places).max(axis=0) < 0.9 * min(np.abs(places[:, 40:]).max(axis=1))
    slope = (
        4 * np.abs([error_map.gx, error_map.gy]).max() / error_map.artifact.grid_pitch_m
    )
    np.testing.assert_allclose(
        (stood - places)[:, within],
        (-bias[:, None] + 0 * places)[:, within],
        rtol=0,
        atol=ROUNDING_M + 2 * slope * np.abs(bias).max() + 1e-17,
    )


@pytest.mark.parametrize("seed", range(30))
def test_a_theta_table_is_the_map_less_its_value_at_home(seed):
    error_map, frame, _, _ = case(seed)
    cal = written([table_theta(error_map, frame)], theta_decimals(error_map))
    turns = 2 if frame.theta_counts_per_unit is None else 30
    theta = np.append(
        np.linspace(-1, 1, 101) * turns * np.pi, error_map.artifact.theta_rad
    )
    compensator = Compensator(error_map)
    found = CalEvaluator(cal.tables, setup_of(frame)).corrections(
        {frame.theta_axis: frame.theta_to_machine(theta)}
    )[frame.theta_axis]
    want = compensator.error_theta(theta) - compensator.error_theta(
        frame.home_theta_rad
    )
    np.testing.assert_allclose(
        frame.sign_theta * np.deg2rad(found), want, rtol=0, atol=4.9e-11
    )


@pytest.mark.parametrize("seed", range(15))
def test_1d_tables_add_up_to_the_2d_table_of_their_sum(seed):
    error_map, frame, places, inside = case(seed)
    artifact, rng = error_map.artifact, np.random.default_rng(seed)
    along = {"x": artifact.x_m[:, 0], "y": artifact.y_m[0]}
    parts = {
        (a, c): np.round(rng.normal(0, 0.1, len(along[a])), 4) * 1e-6
        for a in "xy"
        for c in "xy"
    }
    fields = [parts["x", c][:, None] + parts["y", c] for c in "xy"]
    both = replace(error_map, gx=fields[0], gy=fields[1])
    px, py = frame.to_machine(*places)
    place = {frame.x_axis: px, frame.y_axis: py}
    plane = CalEvaluator(written([table_xy(both, frame)], DECIMALS).tables).corrections(
        place
    )
    tables = [
        line_table(AxisCorrection(along[a], values), frame, along=a, corrected=c)
        for (a, c), values in parts.items()
    ]
    lines = CalEvaluator(written(tables, DECIMALS).tables)
    difference = metres(lines.corrections(place), frame) - metres(plane, frame)
    # 1D tables are always zero at home, a 2D table only where it holds home
    if not inside:
        difference -= difference.mean(axis=1, keepdims=True)
    np.testing.assert_allclose(difference, 0, atol=1e-16)


@pytest.mark.parametrize("seed", range(10))
def test_galvo_tables_and_tables_in_counts_say_the_same(seed):
    error_map, frame, places, _ = case(seed)
    frame = MachineFrame(unit=frame.unit)
    table, unit_m, counts = table_xy(error_map, frame), METRES[frame.unit], 12345.0
    galvo = replace(table, galvo=True, offset_row=None, offset_col=None)
    in_counts = replace(
        table,
        pos_unit=None,
        cor_unit=Unit(UnitWord.COUNTS, 7.0),
        values=table.values * (1e-6 / unit_m * counts * 7.0),
        sample_row=table.sample_row * counts,
        sample_col=table.sample_col * counts,
        offset_row=table.offset_row * counts,
        offset_col=table.offset_col * counts,
    )
    place = {1: places[0] / unit_m, 2: places[1] / unit_m}
    want = CalEvaluator([table]).corrections(place)
    setup = MachineSetup({axis: AxisSetup(counts) for axis in (1, 2)})
    for other in (galvo, in_counts):
        got = CalEvaluator(written([other]).tables, setup).corrections(place)
        for axis in (1, 2):
            np.testing.assert_allclose(
                got[axis], want[axis], rtol=0, atol=1e-17 / unit_m
            )
