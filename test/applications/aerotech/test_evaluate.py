# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from selfcal_ros.applications.aerotech.evaluate import (
    AxisSetup,
    CalEvaluator,
    MachineSetup,
)
from selfcal_ros.applications.aerotech.model import Table1D, Table2D, Unit, UnitWord
from selfcal_ros.applications.aerotech.read import parse_cal
from selfcal_ros.errors import InputError
from test.support.cal_tables import (
    AXES,
    decimals,
    setups,
    tables_1d,
    tables_2d,
    tables_galvo,
)
from test.support.slow_cal import slow_1d, slow_2d

MM = Unit(UnitWord.PRIMARY)
UM = Unit(UnitWord.PRIMARY, 1000.0)
positions = st.fixed_dictionaries({axis: decimals(-600, 600) for axis in AXES})


def machine(axes, temperature=None):
    return MachineSetup(
        {
            axis: AxisSetup(
                s["counts"],
                s["secondary"],
                s.get("direction"),
                s.get("offset"),
                s.get("feedback"),
            )
            for axis, s in axes.items()
        },
        temperature,
    )


def far_from_a_jump(track, at, rollover):
    """Whether rounding cannot carry `at` (or the home position) over the rollover."""
    if rollover is None:
        return True
    low = min(track)
    parts = [(p - low) / rollover for p in (at, 0.0) if p != low]
    return all(1e-9 < part - math.floor(part) < 1 - 1e-9 for part in parts)


def check(tables, want, at, setup):
    got = CalEvaluator(tables, setup).corrections(at)
    assert set(got) == set(want)
    for axis, (value, scale) in want.items():
        assert got[axis] == pytest.approx(value, rel=1e-12, abs=1e-12 * scale)


@given(
    tables=st.lists(tables_1d(), min_size=1, max_size=3),
    axes=setups(),
    at=positions,
    temperature=st.none() | decimals(0, 60),
)
def test_1d_tables_agree_with_the_slow_controller(tables, axes, at, temperature):
    want = {}
    for table in tables:
        reference = table.reference_axis or table.axis
        value, track, rollover = slow_1d(table, at[reference], axes, temperature)
        assume(far_from_a_jump(track, at[reference], rollover))
        old, scale = want.get(table.axis, (0.0, 0.0))
        size = 80.0 * np.abs(table.values).max() + 1
        want[table.axis] = (old + value, scale + size)
    check(tables, want, at, machine(axes, temperature))


@given(table=tables_2d() | tables_galvo(), axes=setups(), at=positions)
def test_2d_tables_agree_with_the_slow_controller(table, axes, at):
    values, tracks = slow_2d(table, at[table.row_axis], at[table.column_axis], axes)
    for (track, rollover), axis in zip(tracks, table.inputs, strict=True):
        assume(far_from_a_jump(track, at[axis], rollover))
    scale = 80.0 * np.abs(table.values).max()
    want = {axis: (v, scale) for axis, v in zip(table.output_axes, values, strict=True)}
    check([table], want, at, machine(axes))


@settings(max_examples=20)
@given(table=tables_2d(), axes=setups())
def test_arrays_give_what_single_positions_give(table, axes):
    evaluator = CalEvaluator([table], machine(axes))
    rng = np.random.default_rng(1)
    at = {axis: rng.uniform(-300, 300, (3, 2)) for axis in AXES}
    for axis, got in evaluator.corrections(at).items():
        for index in np.ndindex(3, 2):
            one = evaluator.corrections({a: p[index] for a, p in at.items()})[axis]
            assert one == got[index]


def test_entries_lie_at_n_times_distance_minus_offset():
    table = Table1D(
        1, 10.0, np.array([4.0, 0.0, 7.0]), pos_unit=MM, cor_unit=UM, offset=10.0
    )
    got = CalEvaluator([table]).corrections({1: [-99, -10, -5, 0, 5, 10, 99]})[1]
    np.testing.assert_allclose(got * 1000, [4, 4, 2, 0, 3.5, 7, 7], atol=1e-12)


def test_negative_distance_and_negpos_mirror_the_table():
    c = np.array([0.0, 2.0, 7.0])
    for table in (
        Table1D(1, -10.0, c, pos_unit=MM),
        Table1D(1, 10.0, c, pos_unit=MM, negpos=True),
    ):
        got = CalEvaluator([table]).corrections({1: [-20, -10, 0, 10]})[1]
        np.testing.assert_allclose(got, [7, 2, 0, 0])
    table = Table1D(1, -10.0, c, pos_unit=MM, offset=-10.0)
    np.testing.assert_allclose(
        CalEvaluator([table]).corrections({1: [10, 0, -10]})[1], c - 2
    )


def test_negcor_changes_the_sign_and_the_home_position_stays_zero():
    c = np.array([3.0, 5.0])
    table = Table1D(1, 10.0, c, pos_unit=MM, negcor=True)
    np.testing.assert_allclose(
        CalEvaluator([table]).corrections({1: [0, 10]})[1], [0, -2]
    )


def test_a_1d_table_is_biased_by_its_end_point_if_home_lies_outside():
    table = Table1D(1, 10.0, np.array([3.0, 5.0]), pos_unit=MM, offset=-100.0)
    np.testing.assert_allclose(
        CalEvaluator([table]).corrections({1: [0, 110]})[1], [0, 2]
    )


def test_rollover_counts_from_the_lowest_entry():
    table = Table1D(
        1,
        90.0,
        np.array([0.0, 1, 2, 3, 0]),
        pos_unit=MM,
        offset=180.0,
        rollover=36000.0,
    )
    setup = MachineSetup({1: AxisSetup(100.0)})
    got = CalEvaluator([table], setup).corrections(
        {1: [0, 90, 180, 270, 360, 450, -360, 45]}
    )[1]
    np.testing.assert_allclose(got, np.array([2, 3, 0, 1, 2, 3, 2, 2.5]) - 2)


def test_rows_run_down_and_columns_across():
    values = np.array([[[0.0, 0], [1, 10], [2, 20]], [[5, 50], [6, 60], [7, 70]]])
    table = Table2D(2, 1, (1, 2), 100.0, 10.0, values, MM, MM)
    evaluator = CalEvaluator([table])
    assert evaluator.corrections({2: 100.0, 1: 20.0}) == {1: 7.0, 2: 70.0}
    assert evaluator.corrections({2: 0.0, 1: 20.0}) == {1: 2.0, 2: 20.0}
    assert evaluator.corrections({2: 50.0, 1: 5.0}) == {1: 3.0, 2: 30.0}


def test_a_2d_table_is_biased_only_if_home_lies_inside():
    values = np.array([[[1.0, 4], [2, 5]], [[3, 6], [4, 7]]])
    inside = Table2D(
        2, 1, (1, 2), 10.0, 10.0, values, MM, MM, offset_row=10.0, offset_col=0.0
    )
    assert CalEvaluator([inside]).corrections({1: 0, 2: 0}) == {1: 0.0, 2: 0.0}
    assert CalEvaluator([inside]).corrections({1: 0, 2: -10}) == {1: -2.0, 2: -2.0}
    outside = Table2D(
        2, 1, (1, 2), 10.0, 10.0, values, MM, MM, offset_row=10.1, offset_col=0.0
    )
    assert CalEvaluator([outside]).corrections({1: 0, 2: 0}) == {1: 3.0, 2: 6.0}


def test_the_centre_of_a_galvo_table_is_its_home():
    values = np.zeros((3, 3, 2))
    values[1, 2] = [5, 6]
    table = Table2D(2, 1, (1, 2), 10.0, 10.0, values, MM, MM, galvo=True)
    assert CalEvaluator([table]).corrections({1: 10, 2: 0}) == {1: 5.0, 2: 6.0}


def test_three_outputs_in_their_own_units():
    values = np.array([[[0.0, 0, 0], [1, 2, 3]]])
    table = Table2D(2, 1, (1, 2, 3), 10.0, 10.0, values, MM)
    setup = MachineSetup({1: AxisSetup(1.0), 2: AxisSetup(10.0), 3: AxisSetup(100.0)})
    assert CalEvaluator([table], setup).corrections({1: 10, 2: 0}) == {
        1: 1.0,
        2: 0.2,
        3: 0.03,
    }


@pytest.mark.parametrize(
    ("pos", "cor", "factor"),
    [
        (None, None, 1 / 50),
        (MM, None, 1.0),
        (UM, None, 1e-3),
        (MM, UM, 1e-3),
        (None, UM, 1e-3),
        (MM, Unit(UnitWord.COUNTS, 2.0), 1 / 100),
        (MM, Unit(UnitWord.SECONDARY, 10.0), 25 / 50 / 10),
    ],
)
def test_default_units(pos, cor, factor):
    table = Table1D(1, 1e6, np.array([0.0, 3.0]), pos_unit=pos, cor_unit=cor)
    setup = MachineSetup({1: AxisSetup(50.0, 25.0)})
    assert CalEvaluator([table], setup).corrections({1: 1e9})[1] == pytest.approx(
        3 * factor
    )


def test_tables_add_up_and_cross_axis_tables_follow_the_other_axis():
    tables = [
        Table1D(1, 10.0, np.array([0.0, 1.0]), pos_unit=MM),
        Table1D(2, 900.0, np.array([0.0, -22.5]), 1, MM, UM),
        Table1D(1, 10.0, np.array([0.0, 2.0]), 2, MM),
    ]
    got = CalEvaluator(tables).corrections({1: 10.0, 2: 5.0})
    assert got == {1: 2.0, 2: pytest.approx(-0.25e-3)}


@pytest.mark.parametrize(
    ("now", "moved"),
    [
        (AxisSetup(), 0.0),
        (AxisSetup(home_offset=3.0), 0.0 - 2.0),
        (AxisSetup(home_direction="CCW"), 100.0),
        (AxisSetup(home_direction="CCW", home_offset=1.5), 99.5),
    ],
)
def test_home_keywords_shift_the_table_with_the_home_position(now, moved):
    # Home CW is the positive end. From there to CCW, home moves by -FULLTRAVEL: every point of
    # the stage then has a coordinate that is FULLTRAVEL larger.
    c = np.array([0.0, 1.0, 5.0, 2.0])
    table = Table1D(
        1,
        -10.0,
        c,
        pos_unit=MM,
        home_direction="CW",
        home_offset=1.0,
        full_travel=100.0,
    )
    got = CalEvaluator([table], MachineSetup({1: now})).corrections(
        {1: np.array([0, -10, -20, -30]) + moved}
    )[1]
    np.testing.assert_allclose(got - got[0], c - c[0], atol=1e-12)


def test_home_keywords_need_homedirection():
    table = Table1D(
        1, 10.0, np.array([0.0, 1.0]), pos_unit=MM, home_offset=1.0, full_travel=9.0
    )
    setup = MachineSetup({1: AxisSetup(home_offset=5.0, home_direction="CW")})
    assert CalEvaluator([table], setup).corrections({1: 10.0})[1] == 1.0


def test_absolute_feedback_offset_is_added_to_the_position():
    table = Table1D(
        1, 10.0, np.array([0.0, 1.0, 4.0]), pos_unit=MM, absolute_feedback_offset=50.0
    )
    setup = MachineSetup({1: AxisSetup(100.0, absolute_feedback_offset=250.0)})
    got = CalEvaluator([table], setup).corrections({1: np.array([0, 10, 20]) + 2.0})[1]
    np.testing.assert_allclose(got - got[0], [0, 1, 4])


def test_a_warm_scale_indicates_too_little_so_the_correction_is_negative():
    table = Table1D(
        1, 10.0, np.zeros(2), pos_unit=MM, expand_coeff=10e-6, material_temp=20.0
    )
    warm = CalEvaluator([table], MachineSetup(temperature_c=25.0)).corrections(
        {1: 400.0}
    )[1]
    assert warm == pytest.approx(-400 * 10e-6 * 5)
    assert CalEvaluator([table]).corrections({1: 400.0})[1] == 0.0


def test_positions_that_are_not_finite():
    table = Table1D(1, 10.0, np.array([0.0, 2.0, 3.0]), pos_unit=MM)
    got = CalEvaluator([table]).corrections({1: [np.nan, np.inf, -np.inf]})[1]
    np.testing.assert_array_equal(got, [np.nan, 3.0, 0.0])
    round_ = Table1D(1, 10.0, np.array([0.0, 2.0, 0.0]), pos_unit=MM, rollover=20.0)
    got = CalEvaluator([round_], MachineSetup({1: AxisSetup(1.0)})).corrections(
        {1: [np.inf, 5]}
    )
    np.testing.assert_array_equal(got[1], [np.nan, 1.0])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            ":START 2 SAMPLEDIST=1 POSUNIT=PRIMARY\n0\n:END\n",
            "axis 2: its position is needed",
        ),
        (
            ":START 1 SAMPLEDIST=1\n0\n:END\n",
            r"POSUNIT of the table of line 1 is in counts, .*"
            r"--counts-per-unit 1=",
        ),
        (
            ":START 1 SAMPLEDIST=1 POSUNIT=PRIMARY ROLLOVER=9\n0\n:END\n",
            "ROLLOVER of the table",
        ),
        (":START 1 SAMPLEDIST=1 POSUNIT=SECONDARY\n0\n:END\n", "counts"),
    ],
)
def test_what_is_not_known_is_asked_for(text, message):
    with pytest.raises(InputError, match=message):
        CalEvaluator(parse_cal(text.encode(), "x").tables).corrections({1: 0.0})


def test_secondary_units_ask_for_their_size():
    table = Table1D(1, 1.0, np.zeros(2), pos_unit=Unit(UnitWord.SECONDARY))
    with pytest.raises(InputError, match="--counts-per-secondary 1="):
        CalEvaluator([table], MachineSetup({1: AxisSetup(5.0)}))
