# SPDX-License-Identifier: Apache-2.0
"""Maps compared: any datum shift changes nothing, significance is right on average."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import binom, norm

from selfcal_ros.errors import InputError
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.comparison.maps import compare, compare_with_laser
from selfcal_ros.estimation.joint.solve import solve_joint
from selfcal_ros.estimation.normal import equations
from selfcal_ros.estimation.normal.equations import NormalEquations
from selfcal_ros.model.artifact import Artifact
from test.support.options import BARE, bare
from test.support.recalibrations import responses, sizes_of
from test.support.truth import hu_plan, random_truth, simulate_measurements

ARTIFACT = Artifact(7, 0.01, 12)
SIGMA_M, SIGMA_RAD = 2e-8, 2e-5


def calibrated(seed, truth=None, *, sigma=SIGMA_M):
    rng = np.random.default_rng(seed)
    truth = truth or random_truth(ARTIFACT, 4, np.random.default_rng(99))
    readings = simulate_measurements(
        truth, hu_plan(truth.artifact), rng, sigma_m=sigma, sigma_theta_rad=SIGMA_RAD
    )
    return solve_joint(readings, BARE).result


A, B = calibrated(1), calibrated(2)


def moved(result, *, shift=(0.0, 0.0), rotation=0.0, scale=0.0, theta=0.0):
    emap = result.error_map
    x, y = emap.artifact.x_m, emap.artifact.y_m
    return replace(
        result,
        error_map=replace(
            emap,
            gx=emap.gx + shift[0] - rotation * y + scale * x,
            gy=emap.gy + shift[1] + rotation * x + scale * y,
            g_theta=emap.g_theta + theta,
        ),
    )


small = st.floats(-1e-4, 1e-4)


@settings(max_examples=8, deadline=None)
@given(small, small, small, small, small)
def test_a_datum_shift_of_either_map_changes_nothing(tx, ty, rotation, scale, theta):
    base = compare(A, B)
    change = {"shift": (tx, ty), "rotation": rotation, "scale": scale, "theta": theta}
    for found, sign in (
        (compare(A, moved(B, **change)), 1),
        (compare(moved(A, **change), B), -1),
    ):
        assert np.allclose(found.dx, base.dx, rtol=0, atol=1e-17)
        assert np.allclose(found.dy, base.dy, rtol=0, atol=1e-17)
        assert np.allclose(found.d_theta, base.d_theta, rtol=0, atol=1e-17)
        assert found.xy.chi2_ratio == pytest.approx(base.xy.chi2_ratio, rel=1e-6)
        assert found.rotation_rad - base.rotation_rad == pytest.approx(
            sign * rotation, abs=1e-12
        )
        assert found.scale - base.scale == pytest.approx(sign * scale, abs=1e-12)
        assert found.translation_m[0] - base.translation_m[0] == pytest.approx(
            sign * tx, abs=1e-15
        )


def test_a_map_against_itself():
    found = compare(A, A)
    assert found.rms_m == found.max_m == found.rms_theta_rad == 0.0
    assert found.xy.chi2_ratio == 0.0 and found.xy.p == 1.0


def test_maps_of_the_same_marks_share_their_equations_and_others_do_not(monkeypatch):
    made = []
    monkeypatch.setattr(
        equations,
        "NormalEquations",
        lambda *given, **kw: made.append(given) or NormalEquations(*given, **kw),
    )
    equations.system_of.cache_clear()
    compare(A, B)
    assert len(made) == 1
    repeated = replace(B, views=tuple(replace(v, read_angular=2) for v in B.views))
    other = compare(A, repeated)
    assert len(made) == 2 and other.theta.p == pytest.approx(compare(A, B).theta.p)
    # lines that weigh more tell more of the rotations
    assert other.xy.p != compare(A, B).xy.p


def test_known_difference_is_found_with_its_sign_and_size():
    x, y = ARTIFACT.x_m, ARTIFACT.y_m
    emap = A.error_map
    sheared = replace(
        A,
        error_map=replace(
            emap,
            gx=emap.gx + 1e-5 * y,
            gy=emap.gy + 1e-5 * x,
            nonorthogonality=emap.nonorthogonality + 1e-5,
        ),
    )
    found = compare(A, sheared)
    assert np.allclose(found.dx, 1e-5 * y) and np.allclose(found.dy, 1e-5 * x)
    assert found.nonorthogonality == pytest.approx(1e-5)
    assert found.max_m == pytest.approx(3e-7)
    assert found.xy.p < 1e-12


def test_scale_is_kept_on_demand():
    found = compare(A, moved(A, scale=1e-5), keep_scale=True)
    assert found.scale == 0.0
    assert np.allclose(found.dx, 1e-5 * ARTIFACT.x_m, atol=1e-18)


def test_p_values_of_repeated_calibrations_are_uniform():
    """Of 30 pairs the mean ratio scatters by 0.04 (xy, 46 degrees of freedom each) and 0.07."""
    truth = random_truth(Artifact(5, 0.01, 16), 4, np.random.default_rng(5))
    results = [calibrated(seed, truth) for seed in range(100, 160)]
    tests = [compare(a, b) for a, b in zip(results[::2], results[1::2], strict=True)]
    for kind, four_sigma in (("xy", 0.16), ("theta", 0.2)):
        found = [getattr(test, kind) for test in tests]
        assert all(test.correlated for test in found)
        assert np.mean([test.chi2_ratio for test in found]) == pytest.approx(
            1, abs=four_sigma
        )
        low = sum(test.p < 0.1 for test in found)
        assert (
            binom.ppf(0.001, len(found), 0.1)
            <= low
            <= binom.ppf(0.999, len(found), 0.1)
        )
        half = sum(test.p < 0.5 for test in found)
        assert (
            binom.ppf(0.001, len(found), 0.5)
            <= half
            <= binom.ppf(0.999, len(found), 0.5)
        )


def test_another_stage_is_significantly_different():
    other = calibrated(3, random_truth(ARTIFACT, 4, np.random.default_rng(123)))
    found = compare(A, other)
    assert found.xy.p < 1e-12 and found.theta.p < 1e-12


@pytest.mark.parametrize("coordinates", ["both", "gx", "gy"])
def test_unknown_sites_do_not_count(coordinates):
    """One that is known in one coordinate alone is not known."""
    hole = np.zeros(ARTIFACT.shape)
    hole[0, 0] = np.nan
    holed = replace(
        A,
        error_map=replace(
            A.error_map,
            **{
                name: getattr(A.error_map, name) + hole
                for name in ("gx", "gy")
                if coordinates in (name, "both")
            },
        ),
    )
    found = compare(holed, B)
    wholly = compare(
        replace(
            A,
            error_map=replace(
                A.error_map, gx=A.error_map.gx + hole, gy=A.error_map.gy + hole
            ),
        ),
        B,
    )
    assert np.isnan(wholly.dx[0, 0]) and np.isnan(wholly.dx).sum() == 1
    assert (found.rms_m, found.max_m) == pytest.approx(
        (wholly.rms_m, wholly.max_m), rel=0.02
    )
    assert np.isfinite([found.rms_m, found.max_m, found.xy.p]).all()


def test_without_uncertainties_there_is_no_test():
    nothing = np.full(ARTIFACT.shape, np.nan)
    bare = replace(A, error_map=replace(A.error_map, u_gx=nothing, u_gy=nothing))
    assert compare(bare, B).xy is None


def test_views_that_tell_no_correlation_are_said_so():
    found = compare(replace(A, views=()), B)
    assert found.xy.correlated is False
    assert 0.2 < found.xy.chi2_ratio < 5
    sites, lines = ARTIFACT.shape[0] * ARTIFACT.shape[1], ARTIFACT.angular_count
    # translation, rotation, magnification
    assert found.xy.dof == pytest.approx(2 * sites - 4)
    assert found.theta.dof == pytest.approx(lines - 1)


@pytest.mark.parametrize(
    ("artifact", "message"),
    [
        (Artifact(9, 0.01, 12), r"\(7, 7\) and \(9, 9\) sites"),
        (Artifact(7, 0.01, 16), "12 and 16 angular lines"),
        (Artifact(7, 0.005, 12), "pitches of 10 and 5 mm"),
    ],
)
def test_other_lattices_are_refused(artifact, message):
    emap = replace(B.error_map, artifact=artifact)
    with pytest.raises(InputError, match=message):
        compare(A, replace(B, error_map=emap))


def test_maps_without_common_sites_are_refused():
    nothing = np.full(ARTIFACT.shape, np.nan)
    empty = replace(B, error_map=replace(B.error_map, gx=nothing, gy=nothing))
    with pytest.raises(
        InputError, match="fewer than three sites are known in both maps"
    ):
        compare(A, empty)


def test_laser_squareness_against_the_map():
    o, r = A.error_map.nonorthogonality, A.error_map.scale_difference
    laser = {
        "error_map_equivalent": {
            "nonorthogonality": o,
            "u_nonorthogonality": 1e-9,
            "scale_difference": r + 1e-5,
            "u_scale_difference": 1e-9,
        }
    }
    same, other = compare_with_laser(A, laser, "out.json")
    assert same.difference == 0.0 and same.p == 1.0 and same.u > 1e-9
    assert other.difference == pytest.approx(1e-5) and other.p < 1e-6
    laser["error_map_equivalent"]["scale_difference"] = None
    assert [row.name for row in compare_with_laser(A, laser, "out.json")] == [
        "nonorthogonality"
    ]
    with pytest.raises(InputError, match="no error_map_equivalent"):
        compare_with_laser(A, {"squareness": 0.1}, "out.json")


def test_without_any_uncertainty_no_difference_has_a_probability():
    exact = replace(A, noise=replace(A.noise, sigma_xy=0.0))
    for of_laser in (0.0, 2e-9):
        laser = {
            "error_map_equivalent": {
                "nonorthogonality": 3e-9,
                "u_nonorthogonality": of_laser,
            }
        }
        (row,) = compare_with_laser(exact, laser, "out.json")
        gap = abs(3e-9 - A.error_map.nonorthogonality)
        assert row.u == of_laser
        assert row.p == (
            pytest.approx(2 * norm.sf(gap / 2e-9))
            if of_laser
            else pytest.approx(np.nan, nan_ok=True)
        )


def test_uncertainty_of_squareness_is_that_of_every_reading_moved_in_turn():
    truth = random_truth(Artifact(5, 0.01, 8), 4, np.random.default_rng(5))
    readings = simulate_measurements(
        truth, hu_plan(truth.artifact), np.random.default_rng(1), linear=True
    )
    readings = replace(
        readings,
        views=tuple(
            replace(
                view,
                sigma_xy=SIGMA_M,
                dof_xy=1000,
                sigma_theta=SIGMA_RAD,
                dof_theta=1000,
            )
            for view in readings.views
        ),
    )
    linear = bare(misalignment_model="linear", causes=False)
    answers = responses(
        lambda moved: np.array(
            [
                solve_joint(
                    moved, replace(linear, uncertainty=False)
                ).result.error_map.nonorthogonality
            ]
        ),
        readings,
        sizes_of(readings, SIGMA_M, SIGMA_RAD),
    )
    laser = {
        "error_map_equivalent": {"nonorthogonality": 0.0, "u_nonorthogonality": 0.0}
    }
    row = compare_with_laser(calibrate(readings, linear), laser, "out.json")[0]
    assert row.u == pytest.approx(np.sqrt((answers**2).sum()), rel=1e-4)
