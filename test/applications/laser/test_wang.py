# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from selfcal_ros.applications.laser.data import (
    DIAGONALS,
    Method,
    StepDiagonal,
    signs_of,
    step_vectors,
)
from selfcal_ros.applications.laser.identify import (
    Choice,
    identify,
    identify_wang,
    jacobian,
    readings_are_equal,
)
from selfcal_ros.applications.laser.profiles import squareness
from selfcal_ros.applications.laser.simulation import (
    Measurement,
    SetUp,
    random_machine,
    simulate_step_diagonal,
)
from selfcal_ros.errors import InputError
from test.support.laser import MM, one_block, planar, random_errors

# Table 1 of the source, mm: given and estimated Ex(x), Ey(x), Ex(y), Ey(y); a = b = 10 mm.
TABLE_1 = {
    "a": ((0, 0, 0, 0.1), (-0.05, 0, 0, 0.15), 2),
    "b": ((0.1, 0, 0, 0.1), (0.1, 0, 0, 0.1), 4),
    "c": ((0, 0, 0.1, 0), (-0.0002, 0, 0.1, 0.0002), 4),
}


def exact_nominal(steps, errors):
    """Return readings of lasers along the nominal diagonals: what eq. 1 assumes."""
    dim = len(steps)
    signs = signs_of(DIAGONALS[dim])
    lasers = signs * np.array(steps) / np.linalg.norm(steps)
    readings = signs[:, :, None] * np.einsum(
        "kc,jic->kji", lasers, step_vectors(steps, errors)
    )
    return StepDiagonal(tuple(steps), DIAGONALS[dim], readings[None])


@pytest.mark.parametrize("case", TABLE_1)
def test_table_1_of_the_source(case):
    given_mm, estimated_mm, decimals = TABLE_1[case]
    found = identify_wang(planar((0.01, 0.01), one_block(*given_mm)))
    np.testing.assert_allclose(
        found.errors_m.ravel() / MM, estimated_mm, atol=0.5 * 10.0**-decimals
    )


@settings(max_examples=15, deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.floats(1e-3, 0.1),
    st.floats(1e-3, 0.1),
    st.integers(1, 8),
)
def test_nominal_lasers_give_the_truth_for_any_steps_and_blocks(seed, a, b, n):
    errors = random_errors(n, np.random.default_rng(seed))
    found = identify_wang(exact_nominal((a, b), errors))
    np.testing.assert_allclose(found.errors_m, errors, atol=1e-15)


def test_body_diagonals_give_all_18_errors_at_nominal_lasers():
    machine = random_machine((0.01, 0.008, 0.006), 5, np.random.default_rng(3))
    found = identify_wang(exact_nominal(machine.steps_m, machine.errors_m))
    np.testing.assert_allclose(found.errors_m, machine.errors_m, atol=1e-15)
    assert found.closure.residual_rms_m < 1e-16


def test_the_sign_of_ex_y_needs_the_corrected_rows_of_eq_1():
    errors = random_errors(4, np.random.default_rng(5))
    data = exact_nominal((0.01, 0.01), errors)
    right = identify_wang(data)
    np.testing.assert_allclose(right.errors_m[1, :, 0], errors[1, :, 0], atol=1e-15)


def test_a_turn_of_the_whole_machine_changes_nothing():
    rng = np.random.default_rng(8)
    errors = random_errors(5, rng)
    turn = 1e-4
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    turned = (
        step_vectors((0.01, 0.01), errors) @ rotation.T - np.diag((0.01, 0.01))[:, None]
    )
    np.testing.assert_allclose(
        identify_wang(exact_nominal((0.01, 0.01), turned)).errors_m, errors, atol=1e-15
    )


def test_equal_readings_are_said_and_the_new_formulation_refuses_them():
    samples = np.full((1, 2, 2, 3), 7.0711e-3)
    data = StepDiagonal((0.01, 0.01), DIAGONALS[2], samples, np.zeros((1, 2, 3)))
    assert readings_are_equal(data)
    with pytest.raises(
        InputError, match="readings of all axes are equal in every block"
    ):
        identify(data, Choice(Method.NEW))
    for choice in (Choice(Method.NEW, allow_equal=True), Choice(Method.CONVENTIONAL)):
        assert np.isfinite(identify(data, choice).errors_m).all()


@pytest.mark.parametrize(
    ("steps", "blocks", "spoil_m", "equal"),
    [
        ((0.01, 0.01), 3, 0.0, True),
        ((0.01, 0.01), 2, 0.0, True),
        ((0.01, 0.01), 1, 0.0, False),
        ((0.01, 0.011), 3, 0.0, False),
        ((0.01, 0.01), 3, 1e-8, False),
    ],
)
def test_readings_are_equal_where_all_axes_read_the_same_in_two_or_more_blocks(
    steps, blocks, spoil_m, equal
):
    samples = np.full((1, 2, 2, blocks), 7.0711e-3)
    samples[0, 1, 0, -1] += spoil_m
    assert (
        readings_are_equal(
            StepDiagonal(steps, DIAGONALS[2], samples, np.zeros((1, 2, blocks)))
        )
        is equal
    )


def test_table_1_case_b_holds_in_many_blocks():
    given, estimated, _ = TABLE_1["b"]
    data = planar((0.01, 0.01), np.repeat(one_block(*given), 6, axis=1))
    assert readings_are_equal(data)
    found = identify(data, Choice(Method.CONVENTIONAL)).errors_m
    np.testing.assert_allclose(
        found / MM, np.repeat(one_block(*estimated) / MM, 6, axis=1), atol=1e-9
    )


def test_one_diagonal_is_refused():
    data = planar((0.01, 0.01), random_errors(3, np.random.default_rng(0))).pick(["pp"])
    with pytest.raises(
        InputError,
        match="only pp measured; the conventional formulation needs every diagonal",
    ):
        identify_wang(data)


def test_no_uncertainty_without_repeats_and_the_propagated_one_with_them():
    rng = np.random.default_rng(11)
    data = planar((0.01, 0.01), random_errors(6, rng))
    assert identify_wang(data).covariance is None
    samples = data.samples_m + rng.normal(0, 1e-8, (400, 2, 2, 6))
    found = identify_wang(StepDiagonal(data.steps_m, data.diagonals, samples))
    # v = s (Rx_pp - Rx_np) / (2b), s = sqrt(2) a, less the turn by the first block's v.
    expected = 1e-8 / np.sqrt(400)
    np.testing.assert_allclose(found.u_errors_m[0, :, 0], expected, rtol=0.05)
    np.testing.assert_allclose(
        found.u_errors_m[0, 1:, 1], np.sqrt(2) * expected, rtol=0.05
    )
    assert found.u_errors_m[0, 0, 1] < 1e-12


def test_jacobian_of_a_product():
    at = np.array([[2.0, 3.0]])
    np.testing.assert_allclose(
        jacobian(lambda x: np.array([x[0, 0] * x[0, 1]]), at), [[3.0, 2.0]], rtol=1e-7
    )


def test_body_diagonals_are_weighted_by_their_repeats():
    machine = random_machine((0.01, 0.01, 0.01), 2, np.random.default_rng(3))
    samples = exact_nominal(machine.steps_m, machine.errors_m).samples_m.repeat(
        9, axis=0
    )
    samples[:, 0] += 1e-8  # ppp is off, and measured nine times; the others once
    heavy = samples.copy()
    heavy[1:, 1:] = np.nan
    residual = [
        identify_wang(StepDiagonal(machine.steps_m, DIAGONALS[3], each))
        for each in (samples, heavy)
    ]
    off = [np.abs(found.errors_m - machine.errors_m).max() for found in residual]
    # Four readings for three components: ppp alone pulls with 1/4 of its misfit left over, with
    # ninefold weight with 1/28, so that the component along ppp follows more.
    assert off[0] < off[1] < 2e-8


def test_equal_readings_of_one_diagonal_only_are_a_measurement():
    data = planar((0.01, 0.01), random_errors(3, np.random.default_rng(0)))
    samples = data.samples_m.copy()
    samples[:, 0, 1] = samples[:, 0, 0]
    found = identify_wang(StepDiagonal(data.steps_m, data.diagonals, samples))
    assert np.isfinite(found.errors_m).all()


def test_body_diagonals_take_a_mirror_for_a_lean_to_first_order():
    machine = random_machine((0.01, 0.01, 0.01), 4, np.random.default_rng(6))
    wrong = []
    for angle in (1e-4, 2e-4):
        setups = {"npp": SetUp(mirror_rad=(angle, 0.0))}
        data = simulate_step_diagonal(
            machine, Measurement(setups), np.random.default_rng(0)
        )
        found = identify_wang(data)
        wrong.append(squareness(found, 0, 2).value)
    off = wrong[1] - wrong[0]
    assert abs(off) > 1e-4 * 0.04 / 10, (
        "of the order of angle x range, not of its square"
    )
