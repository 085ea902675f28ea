# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from selfcal_ros.applications.laser.data import DIAGONALS, Form, StepDiagonal
from selfcal_ros.applications.laser.identify import identify_ibaraki, identify_wang
from selfcal_ros.applications.laser.noise import check_lengths
from selfcal_ros.applications.laser.profiles import squareness, straightness
from selfcal_ros.applications.laser.report import outcome
from selfcal_ros.applications.laser.simulation import (
    LaserNoise,
    Measurement,
    SetUp,
    case_study_machine,
    random_machine,
    simulate_step_diagonal,
)
from selfcal_ros.errors import InputError, NotIdentifiableError
from test.support.laser import planar, random_errors, scatter_of

NM = 1e-9
UM = 1e-6
angles = st.floats(-2e-3, 2e-3)


@settings(max_examples=15, deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.floats(2e-3, 0.05),
    st.floats(2e-3, 0.05),
    st.integers(1, 8),
    st.tuples(angles, angles),
)
def test_exact_form_recovers_the_truth_for_any_steps_and_mirrors(
    seed, a, b, n, mirrors
):
    errors = random_errors(n, np.random.default_rng(seed))
    found = identify_ibaraki(planar((a, b), errors, mirror_rad=mirrors))
    np.testing.assert_allclose(found.errors_m, errors, atol=1e-14)
    tilts = [found.mirror_rad["pp"][0], found.mirror_rad["np"][0]]
    np.testing.assert_allclose(tilts, mirrors, atol=1e-9)


@pytest.mark.parametrize("laser", [1e-3, -1e-3])
@pytest.mark.parametrize("mirror", [1e-3, -1e-3])
@pytest.mark.parametrize("steps", [(0.01, 0.01), (0.01, 0.007)])
def test_recovery_within_1_nm_with_mirror_and_laser_off_by_1_mrad(steps, laser, mirror):
    errors = random_errors(6, np.random.default_rng(21))
    data = planar(steps, errors, laser_rad=(laser, laser), mirror_rad=(mirror, mirror))
    found = identify_ibaraki(data)
    assert np.abs(found.errors_m - errors).max() < 0.01 * NM
    cosine_error = 6 * np.hypot(*steps) * (-(laser**2) / 2 - laser * mirror)
    assert found.closure.lengths_m == pytest.approx(cosine_error, rel=1e-3)


def test_unequal_misalignment_errs_by_the_cosine_that_the_docs_state():
    errors = random_errors(6, np.random.default_rng(22))
    lasers, mirrors = np.array([1e-3, -1e-3]), np.array([1e-3, 1e-3])
    data = planar((0.01, 0.01), errors, laser_rad=lasers, mirror_rad=mirrors)
    shrink = -(lasers**2) / 2 - lasers * mirrors
    expected = errors[1, :, 0] + 0.01 * (shrink[0] - shrink[1])
    np.testing.assert_allclose(
        identify_ibaraki(data).errors_m[1, :, 0], expected, atol=0.01 * NM
    )


@pytest.mark.parametrize("diagonal", ["pp", "np"])
@pytest.mark.parametrize("form", [Form.EXACT, Form.STEPWISE])
def test_one_diagonal_suffices(diagonal, form):
    errors = random_errors(6, np.random.default_rng(23))
    data = planar((0.01, 0.01), errors, mirror_rad=(1e-3, -1e-3)).pick([diagonal])
    found = identify_ibaraki(data, form=form)
    assert np.abs(found.errors_m - errors).max() < 1 * NM
    assert found.closure.lengths_m is None and found.closure.between_m is None


def test_eq_5_as_printed_errs_by_the_linear_errors_that_it_leaves_out():
    errors = random_errors(6, np.random.default_rng(24))
    data = planar((0.01, 0.01), errors, mirror_rad=(1e-3, 1e-3)).pick(["pp"])
    worst = np.abs(identify_ibaraki(data, form=Form.PRINTED).errors_m - errors).max()
    assert 60 * NM < worst < 400 * NM
    # Without variation of Ex(x) and of the half diagonal the printed form is right.
    same = random_errors(1, np.random.default_rng(25)).repeat(6, axis=1)
    data = planar((0.01, 0.01), same, mirror_rad=(1e-3, 1e-3))
    assert (
        np.abs(identify_ibaraki(data, form=Form.PRINTED).errors_m - same).max() < 1 * NM
    )


def test_the_closure_between_diagonals_is_zero_for_one_machine_and_the_difference_for_two():
    rng = np.random.default_rng(27)
    errors = random_errors(5, rng)
    data = planar((0.01, 0.01), errors, mirror_rad=(1e-3, -5e-4))
    assert np.abs(identify_ibaraki(data).closure.between_m).max() < 1e-5 * NM
    samples = data.samples_m.copy()
    samples[:, 1, 1] += 10 * NM  # every Y reading of np too long
    longer = StepDiagonal(data.steps_m, data.diagonals, samples, data.linear_m)
    other = identify_ibaraki(longer)
    # np alone: Ex(y) shrinks by sqrt(2) 10 nm, so pp - np grows by as much.
    np.testing.assert_allclose(
        other.closure.between_m[1, :, 0], np.sqrt(2) * 10 * NM, rtol=1e-3
    )
    stated = outcome(other, longer)["closure"]
    np.testing.assert_allclose(
        stated["ex_y_pp_minus_np"], np.sqrt(2) * 10e-6, rtol=1e-3
    )
    assert np.abs(stated["ey_x_pp_minus_np"]).max() < 1e-9
    np.testing.assert_allclose(
        other.errors_m[1, :, 0] - errors[1, :, 0], -10 * NM / np.sqrt(2), rtol=1e-3
    )
    # One diagonal of two too long by 50 nm: so is half the rms.
    assert other.closure.lengths_m == pytest.approx(25 * NM, rel=1e-3)
    assert other.closure.u_lengths_m is None and other.closure.u_between_m is None


@pytest.mark.parametrize("steps", [(0.01, 0.01, 0.01), (0.012, 0.008, 0.006)])
@pytest.mark.parametrize("n", [1, 5])
def test_body_diagonals_recover_all_transverse_errors_within_1_nm(steps, n):
    rng = np.random.default_rng(31)
    machine = random_machine(steps, n, rng)
    setups = {
        "ppp": SetUp(mirror_rad=(1e-3, -5e-4)),
        "npp": SetUp(mirror_rad=(-1e-3, 2e-4)),
        "pnp": SetUp(mirror_rad=(3e-4, 1e-3)),
        "ppn": SetUp(mirror_rad=(-8e-4, -1e-3)),
    }
    data = simulate_step_diagonal(machine, Measurement(setups), rng)
    found = identify_ibaraki(data)
    assert np.abs(found.errors_m - machine.errors_m).max() < 1e-4 * NM
    np.testing.assert_allclose(
        [found.mirror_rad[name] for name in DIAGONALS[3]],
        [setups[name].mirror_rad for name in DIAGONALS[3]],
        atol=3e-6,
    )
    same = {
        name: SetUp(laser_rad=(1e-3, 1e-3), mirror_rad=(1e-3, 1e-3))
        for name in DIAGONALS[3]
    }
    data = simulate_step_diagonal(machine, Measurement(same), rng)
    assert np.abs(identify_ibaraki(data).errors_m - machine.errors_m).max() < 0.1 * NM


def test_two_body_diagonals_are_not_enough():
    machine = random_machine((0.01, 0.01, 0.01), 3, np.random.default_rng(32))
    data = simulate_step_diagonal(machine, Measurement(), np.random.default_rng(0))
    with pytest.raises(
        NotIdentifiableError, match="ppp, npp: they do not determine the errors"
    ):
        identify_ibaraki(data.pick(["ppp", "npp"]))


def case_study(seed=2006):
    """Return machine and measurement of the source's case study."""
    machine = case_study_machine()
    setups = {name: SetUp(mirror_rad=(5e-4,)) for name in DIAGONALS[2]}
    setups["np"] = SetUp(mirror_rad=(-5e-4,))
    noise = LaserNoise(distance_m=10 * NM, linear_m=10 * NM, repeats=3)
    return machine, simulate_step_diagonal(
        machine, Measurement(setups, noise), np.random.default_rng(seed)
    )


def test_case_study_new_is_within_20_nm_and_conventional_errs_as_the_geometry_predicts():
    machine, data = case_study()
    found = identify_ibaraki(data)
    assert abs(squareness(found).value - -1.22 * UM) < 0.02 * UM
    assert abs(straightness(found, 0, 1).value - 0.05 * UM) < 0.02 * UM
    assert abs(straightness(found, 1, 0).value - 0.11 * UM) < 0.02 * UM
    conventional = identify_wang(data)
    # phi = angle of the mirror to nominal = own diagonal's lean + mirror off the laser. A machine
    # with shear lean_pp: to first order Ex(x) errs by b/2 (phi_np - phi_pp), Ey(y) by the opposite.
    side = machine.errors_m.sum(axis=1) + np.diag((0.06, 0.06))
    lean = [
        np.arctan2(side[1, 1] + side[0, 1], side[0, 0] + side[1, 0]) - np.pi / 4,
        np.arctan2(side[1, 1] - side[0, 1], side[1, 0] - side[0, 0]) - 3 * np.pi / 4,
    ]
    predicted = 0.06 / 2 * ((lean[1] - 5e-4) - (lean[0] + 5e-4))
    wrong = conventional.errors_m.sum(axis=1) - machine.errors_m.sum(axis=1)
    assert predicted == pytest.approx(-30 * UM, abs=1 * UM)
    assert wrong[0, 0] == pytest.approx(predicted, abs=0.05 * UM)
    assert wrong[1, 1] == pytest.approx(-predicted, abs=0.05 * UM)


def test_case_study_own_diagonal_alone_spoils_the_linear_errors_of_the_conventional_form():
    machine = case_study_machine()
    data = simulate_step_diagonal(machine, Measurement(), np.random.default_rng(0))
    conventional = identify_wang(data)
    # Lasers along the own diagonals: both linear errors become their mean over the range
    # (a = b), as in case (a) of table 1; squareness and straightness stay right.
    total = conventional.errors_m.sum(axis=1)
    linear = machine.errors_m.sum(axis=1)
    lean = (linear[1, 1] - linear[0, 0]) / 0.06 / 2
    assert total[0, 0] - linear[0, 0] == pytest.approx(0.06 / 2 * -2 * lean, abs=2 * NM)
    assert total[1, 1] - linear[1, 1] == pytest.approx(0.06 / 2 * 2 * lean, abs=2 * NM)
    assert squareness(conventional).value == pytest.approx(-1.22 * UM, abs=1 * NM)


def test_standard_uncertainties_are_the_scatter_of_measurements():
    """Of squareness, errors and closures, for noise of distances and of readings."""

    def values(data):
        found = identify_ibaraki(data)
        return np.array(
            [
                squareness(found).value,
                *found.errors_m[[1, 0], [2, 3], [0, 1]],
                found.closure.lengths_m,
                *found.closure.between_m[[1, 0], [2, 4], [0, 1]],
            ]
        )

    machine = case_study_machine()
    scatter = scatter_of(machine, values)
    for noise in (
        LaserNoise(distance_m=10 * NM, linear_m=20 * NM, repeats=400),
        LaserNoise(reading_m=10 * NM, repeats=400),
    ):
        found = identify_ibaraki(
            simulate_step_diagonal(
                machine, Measurement({}, noise), np.random.default_rng(1)
            )
        )
        closure = found.closure
        # a standard deviation from 400 runs of 24 readings scatters by 0.7 %
        np.testing.assert_allclose(
            [
                squareness(found).u,
                *found.u_errors_m[[1, 0], [2, 3], [0, 1]],
                closure.u_lengths_m,
                *closure.u_between_m[[1, 0], [2, 4], [0, 1]],
            ],
            scatter(noise),
            rtol=0.05,
        )


def test_joint_use_of_both_diagonals_halves_the_variance():
    machine = case_study_machine()
    noise = LaserNoise(reading_m=10 * NM, repeats=200)
    data = simulate_step_diagonal(
        machine, Measurement({}, noise), np.random.default_rng(5)
    )
    both = squareness(identify_ibaraki(data)).u
    one = squareness(identify_ibaraki(data.pick(["pp"]))).u
    assert one / both == pytest.approx(np.sqrt(2), rel=0.05)


def test_a_diagonal_with_more_repeats_counts_for_more():
    errors = random_errors(4, np.random.default_rng(41))
    data = planar((0.01, 0.01), errors)
    samples = data.samples_m.repeat(9, axis=0)
    samples[1:, 1] = np.nan  # pp nine times, np once
    samples[0, 1, 1] += 10 * NM
    found = identify_ibaraki(
        StepDiagonal(data.steps_m, data.diagonals, samples, data.linear_m)
    )
    np.testing.assert_allclose(
        found.errors_m[1, :, 0] - errors[1, :, 0], -np.sqrt(2) * 10 * NM / 10, rtol=0.01
    )


def test_missing_linear_errors_are_named():
    data = planar((0.01, 0.01), random_errors(3, np.random.default_rng(1)))
    with pytest.raises(
        InputError, match="linear errors: the new formulation needs them; measure"
    ):
        identify_ibaraki(StepDiagonal(data.steps_m, data.diagonals, data.samples_m))


def test_linear_errors_in_micrometres_are_found_out_by_the_diagonals():
    errors = random_errors(3, np.random.default_rng(1), sigma_m=2e-7)
    data = planar((0.01, 0.01), errors)
    wrong = StepDiagonal(
        data.steps_m, data.diagonals, data.samples_m, data.linear_m * 1000
    )
    with pytest.raises(
        InputError, match="the linear errors look like micrometres; give ex_x"
    ):
        identify_ibaraki(wrong)


@pytest.mark.parametrize(
    ("misfit", "micrometres"),
    [(-0.11, False), (-0.09, True), (0.0, True), (0.09, True), (0.11, False)],
)
def test_linear_errors_count_as_micrometres_where_a_tenth_of_the_misfit_is_left(
    misfit, micrometres
):
    """Block 2 of 3, steps 30 and 40 mm: linear errors of 1 % in mm, of 10 ppm in micrometres.

    A diagonal of 50 mm times d is off by d / 1.01 - 1 of them, and by d / 1.00001 - 1 of a
    thousandth; d is such that the second is `misfit` times the first.
    """
    d = (1 - misfit) / (1 / 1.00001 - misfit / 1.01)
    steps = np.array([0.03, 0.04])
    # along the diagonal, in X and Y
    readings = np.repeat((steps**2 / 0.05)[:, None], 3, axis=1)
    readings[:, 1] *= d
    linear = np.zeros((2, 3))
    linear[:, 1] = 0.01 * steps
    data = StepDiagonal(
        tuple(steps), DIAGONALS[2], np.stack([readings] * 2)[None], linear[None]
    )
    with pytest.raises(InputError) as raised:
        check_lengths(data)
    expected = (
        f"block 2: diagonals and linear errors disagree by {(d / 1.01 - 1) * 50:.4g} mm"
        + (
            "; the linear errors look like micrometres; give ex_x, ey_y in mm"
            if micrometres
            else "; check the steps, the units, and that both are of one machine"
        )
    )
    assert str(raised.value) == expected


def test_paper_forms_are_planar():
    machine = random_machine((0.01, 0.01, 0.01), 3, np.random.default_rng(32))
    data = simulate_step_diagonal(machine, Measurement(), np.random.default_rng(0))
    with pytest.raises(
        InputError, match="in 2D only; use the exact form for body diagonals"
    ):
        identify_ibaraki(data, form=Form.PRINTED)


def test_eq_5_as_printed_has_the_right_sign():
    # Ex(x) and the half diagonal the same in every block, Ey(x) not: the printed form is right.
    n = 6
    ey_x = np.array([0, 1, -2, 3, -1, 2]) * 1e-7
    errors = np.zeros((2, n, 2))
    errors[0, :, 1] = ey_x
    errors[1, :, 0] = -ey_x  # keeps the diagonal's length to first order
    data = planar((0.01, 0.01), errors, mirror_rad=(1e-3, -1e-3))
    found = identify_ibaraki(data, form=Form.PRINTED)
    np.testing.assert_allclose(found.errors_m[0, :, 1], ey_x, atol=1 * NM)


@pytest.mark.parametrize("form", [Form.STEPWISE, Form.PRINTED])
def test_paper_forms_hold_for_unequal_steps(form):
    errors = random_errors(1, np.random.default_rng(25)).repeat(6, axis=1)
    errors[0, :, 1] = np.array([0, 1, -1, 2, 0, 1]) * 1e-7
    errors[1, :, 0] = -errors[0, :, 1] * 0.006 / 0.01
    data = planar((0.01, 0.006), errors, mirror_rad=(1e-3, -1e-3))
    assert np.abs(identify_ibaraki(data, form=form).errors_m - errors).max() < (
        1 * NM if form is Form.STEPWISE else 60 * NM
    )
