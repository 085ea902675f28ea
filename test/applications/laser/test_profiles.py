# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from selfcal_ros.applications.laser.data import (
    Closure,
    StepDiagonalResult,
    step_vectors,
)
from selfcal_ros.applications.laser.profiles import (
    ReferenceLine,
    axis_pairs,
    name_of,
    positions_m,
    profile_m,
    slope,
    squareness,
    squareness_rad,
    straightness,
    u_profile_m,
    u_slope,
)
from selfcal_ros.applications.laser.simulation import case_study_machine
from test.support.laser import random_errors


def identified(steps, errors, covariance=None):
    return StepDiagonalResult(
        tuple(steps), errors, covariance, "new", "exact", {}, Closure()
    )


def test_profiles_start_at_zero_and_end_at_the_sum():
    errors = np.arange(12.0).reshape(2, 3, 2)
    found = identified((0.01, 0.02), errors)
    np.testing.assert_array_equal(profile_m(found, 1, 0), [0, 6, 14, 24])
    np.testing.assert_allclose(positions_m(found, 1), [0, 0.02, 0.04, 0.06])
    assert slope(found, 1, 0, ReferenceLine.END_POINTS) == pytest.approx(24 / 0.06)
    assert slope(found, 1, 0) == pytest.approx(
        np.polyfit([0, 0.02, 0.04, 0.06], [0, 6, 14, 24], 1)[0]
    )
    assert u_profile_m(found, 1, 0) is None


def test_straightness_about_both_lines_against_a_plain_fit():
    errors = random_errors(7, np.random.default_rng(1))
    found = identified((0.01, 0.02), errors)
    x, p = positions_m(found, 0), profile_m(found, 0, 1)
    residual = p - np.polyval(np.polyfit(x, p, 1), x)
    assert straightness(found, 0, 1).value == pytest.approx(np.ptp(residual), rel=1e-9)
    residual = p - p[-1] * x / x[-1]
    chord = straightness(found, 0, 1, ReferenceLine.END_POINTS)
    assert chord.value == pytest.approx(np.ptp(residual))


def test_the_case_study_machine_has_the_published_errors():
    machine = case_study_machine()
    found = identified(machine.steps_m, machine.errors_m)
    assert squareness(found).value == pytest.approx(-1.22e-6, rel=1e-12)
    assert straightness(found, 0, 1).value == pytest.approx(0.05e-6, rel=1e-9)
    assert straightness(found, 1, 0).value == pytest.approx(0.11e-6, rel=1e-9)
    np.testing.assert_allclose(
        [profile_m(found, j, j)[-1] for j in (0, 1)], [1.14e-6, 0.69e-6]
    )
    assert machine.errors_m[0, 0, 1] == 0.0
    np.testing.assert_allclose(machine.truth_m(), machine.errors_m, atol=1e-18)


@pytest.mark.parametrize("line", list(ReferenceLine))
def test_squareness_is_positive_where_the_axes_enclose_less_than_90_deg(line):
    errors = np.zeros((2, 4, 2))
    errors[1, :, 0] = 1e-7  # Y leans towards +X
    found = identified((0.01, 0.005), errors)
    assert squareness(found, line=line).value == pytest.approx(4e-7)
    assert squareness_rad(found, line=line) == pytest.approx(1e-7 / 0.005)
    errors = np.zeros((2, 4, 2))
    # X leans towards +Y: 1e-7/0.01 rad over the Y range of 20 mm
    errors[0, :, 1] = 1e-7
    assert squareness(
        identified((0.01, 0.005), errors), line=line
    ).value == pytest.approx(2e-7)


@settings(max_examples=25, deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.floats(-1e-5, 1e-5),
    st.sampled_from(list(ReferenceLine)),
)
def test_a_turn_of_the_machine_changes_neither_straightness_nor_squareness(
    seed, turn, line
):
    errors = random_errors(6, np.random.default_rng(seed))
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    turned = (
        step_vectors((0.01, 0.01), errors) @ rotation.T - np.diag((0.01, 0.01))[:, None]
    )
    one, other = identified((0.01, 0.01), errors), identified((0.01, 0.01), turned)
    assert squareness(one, line=line).value == pytest.approx(
        squareness(other, line=line).value, abs=1e-11
    )
    for axis in (0, 1):
        assert straightness(one, axis, 1 - axis, line).value == pytest.approx(
            straightness(other, axis, 1 - axis, line).value, abs=1e-11
        )


def test_uncertainties_against_monte_carlo():
    rng = np.random.default_rng(4)
    mixing = rng.normal(0, 1e-9, (24, 24))
    covariance = mixing @ mixing.T
    base = 1e-6 * rng.normal(size=24)
    found = identified((0.01, 0.02), base.reshape(2, 6, 2), covariance)
    draws = base + rng.multivariate_normal(np.zeros(24), covariance, 4000)
    drawn = [identified((0.01, 0.02), d.reshape(2, 6, 2)) for d in draws]
    for value, of in (
        (squareness(found).u, squareness),
        (
            squareness(found, line=ReferenceLine.END_POINTS).u,
            lambda d: squareness(d, line=ReferenceLine.END_POINTS),
        ),
        (straightness(found, 1, 0).u, lambda d: straightness(d, 1, 0)),
    ):
        assert value == pytest.approx(np.std([of(d).value for d in drawn]), rel=0.05)
    assert u_slope(found, 1, 1) == pytest.approx(
        np.std([slope(d, 1, 1) for d in drawn]), rel=0.05
    )
    assert u_slope(drawn[0], 1, 1) is None
    profile = np.std([profile_m(d, 0, 1) for d in drawn], axis=0)
    np.testing.assert_allclose(u_profile_m(found, 0, 1), profile, rtol=0.05)


def test_names_and_pairs():
    assert name_of(0, 1) == "ey_x" and name_of(2, 0) == "ex_z"
    assert axis_pairs(3) == [(0, 1), (0, 2), (1, 2)]
