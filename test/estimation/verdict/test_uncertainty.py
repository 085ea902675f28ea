# SPDX-License-Identifier: Apache-2.0
"""What effects add to the uncertainties of a map, to its covariance, and in which frame."""

import json
from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.comparison.covariance import covariance_of
from selfcal_ros.estimation.verdict.uncertainty import (
    INTERPOLATION,
    Effect,
    budget_lines,
    difference,
    effect_of_field,
    enlarged,
    enlargements,
)
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.readings import Sense
from selfcal_ros.model.result import result_from_dict, result_to_dict
from selfcal_ros.model.terms import ModelTerm
from selfcal_ros.reporting.words.findings import worded
from test.support.options import bare
from test.support.truth import hu_plan, random_truth, simulate_measurements

FIELD = np.arange(15.0).reshape(5, 3) + 1j * np.arange(15.0, 30.0).reshape(5, 3) ** 2


@pytest.fixture(scope="module")
def result():
    plan, rng = hu_plan(Artifact(5, 0.01, 8), repeats=2), np.random.default_rng(2)
    truth = random_truth(plan.artifact, 4, rng)
    return calibrate(
        simulate_measurements(truth, plan, rng, sigma_m=2e-8, sigma_theta_rad=2e-6),
        bare(
            terms=(
                ModelTerm("plate_strain", 2e-7),
                ModelTerm("line_eccentricity", 1e-6),
            )
        ),
    )


def effects_of(result):
    rng, shape = np.random.default_rng(5), (2, *result.artifact.shape)
    return (
        Effect("slip", rng.normal(0, 3e-8, shape), np.zeros(8)),
        Effect("rotation", rng.normal(0, 1e-8, shape), rng.normal(0, 2e-6, 8)),
        Effect("nothing", np.zeros(shape), np.zeros(8)),
    )


def test_a_field_of_a_moved_plate_is_that_of_the_opposite_place_with_the_other_sign():
    lines = np.arange(8.0)
    ahead = effect_of_field("slip", FIELD, Sense.MICROSCOPE_MOVES, lines)
    back = effect_of_field("slip", FIELD, Sense.PLATE_MOVES, lines)
    np.testing.assert_array_equal(ahead.theta, lines)
    np.testing.assert_array_equal(back.theta, [0, -7, -6, -5, -4, -3, -2, -1])
    np.testing.assert_array_equal(ahead.xy, [FIELD.real, FIELD.imag])
    assert (
        back.xy[0, 0, 0] == -FIELD[4, 2].real and back.xy[1, 4, 0] == -FIELD[0, 2].imag
    )
    np.testing.assert_array_equal(
        back.xy, [-FIELD.real[::-1, ::-1], -FIELD.imag[::-1, ::-1]]
    )


def test_effects_add_up_in_quadrature_and_leave_the_map_alone(result):
    slip, turned, nothing = effects_of(result)
    found = enlarged(result, (slip, turned, nothing)).error_map
    before = result.error_map
    for name, at in (("u_gx", 0), ("u_gy", 1)):
        wanted = np.sqrt(
            getattr(before, name) ** 2 + slip.xy[at] ** 2 + turned.xy[at] ** 2
        )
        np.testing.assert_allclose(getattr(found, name), wanted, rtol=1e-12)
    np.testing.assert_allclose(
        found.u_g_theta, np.hypot(before.u_g_theta, turned.theta), rtol=1e-12
    )
    for name in ("gx", "gy", "g_theta"):
        np.testing.assert_array_equal(getattr(found, name), getattr(before, name))
    assert enlarged(result, (nothing,)) is result


def test_a_saved_map_has_the_covariance_of_its_effects(result):
    slip, turned, nothing = effects_of(result)
    known = result.error_map.valid
    larger = enlarged(result, (slip, turned, nothing))
    saved = result_from_dict(
        json.loads(json.dumps(result_to_dict(worded(larger)))), "r"
    )
    assert saved.kept.factors.terms[-2:] == ("slip", "rotation")
    found = covariance_of(saved, "xy", known)
    wanted = covariance_of(result, "xy", known)
    for effect in (slip, turned):
        flat = effect.xy[:, known].ravel()
        wanted = wanted + np.outer(flat, flat)
    assert found.ndim == 2
    assert abs(found - wanted).max() < 1e-6 * wanted.max()
    u = np.concatenate([larger.error_map.u_gx[known], larger.error_map.u_gy[known]])
    np.testing.assert_allclose(np.sqrt(np.diag(found)), u, rtol=1e-6)


def test_a_map_without_uncertainty_stays_without(result):
    nowhere = np.full(result.artifact.shape, np.nan)
    bare_map = replace(
        result.error_map, u_gx=nowhere, u_gy=nowhere, u_g_theta=np.full(8, np.nan)
    )
    found = enlarged(replace(result, error_map=bare_map), effects_of(result)).error_map
    assert np.isnan(found.u_gx).all() and np.isnan(found.u_g_theta).all()


def test_the_difference_of_two_maps_is_theirs_without_a_common_angle(result):
    emap = result.error_map
    gy = emap.gy + 2e-9
    gy[1, 2] = np.nan
    g_theta = emap.g_theta + 7e-6 - np.arange(8) * 1e-6
    g_theta[7] = np.nan
    other = replace(
        result, error_map=replace(emap, gx=emap.gx - 1e-9, gy=gy, g_theta=g_theta)
    )
    found = difference("rotation", result, other)
    np.testing.assert_allclose(found.xy[0], 1e-9, rtol=1e-6)
    wanted = np.full(emap.gy.shape, -2e-9)
    wanted[1, 2] = 0.0
    np.testing.assert_allclose(found.xy[1], wanted, rtol=1e-6)
    np.testing.assert_allclose(
        found.theta, np.array([-3, -2, -1, 0, 1, 2, 3, 0]) * 1e-6, rtol=1e-6, atol=1e-15
    )


def test_what_enlarged_an_uncertainty_is_listed_the_most_first(result):
    slip, turned, _ = effects_of(result)
    only_lines = replace(turned, name="reading", xy=np.zeros_like(turned.xy))
    found = enlargements(
        result,
        ["plate_strain", "line_eccentricity", "plate_strain", "drift"],
        (slip, only_lines),
    )
    by_name = {item.name: item for item in found}
    assert sorted(by_name) == ["line_eccentricity", "plate_strain", "reading", "slip"]
    sizes = [item.u_rms for item in found]
    assert sizes == sorted(sizes, reverse=True)
    assert by_name["slip"].u_rms == pytest.approx(np.sqrt(np.mean(slip.xy**2)))
    assert (by_name["slip"].u_max, by_name["slip"].unit) == (abs(slip.xy).max(), "m")
    assert by_name["reading"].u_rms == pytest.approx(np.sqrt(np.mean(turned.theta**2)))
    assert by_name["reading"].unit == by_name["line_eccentricity"].unit == "rad"
    lines = result.kept.angular["line_eccentricity"]
    assert by_name["line_eccentricity"].u_max == pytest.approx(lines.max(), rel=1e-12)
    # a strain of 2e-7 that no reading tells bends a plate of 20 mm by 4 nm
    assert 1e-9 < by_name["plate_strain"].u_rms < 1e-8


def test_the_interpolation_of_angles_does_not_depend_on_where_the_lines_begin(result):
    def line(steps):
        emap = result.error_map
        turned = replace(
            result,
            error_map=replace(
                emap,
                g_theta=np.roll(emap.g_theta, steps),
                u_g_theta=np.roll(emap.u_g_theta, steps),
            ),
        )
        return next(
            line
            for line in budget_lines(turned)
            if line.component == INTERPOLATION and line.quantity == "theta"
        )

    lines = [line(steps) for steps in range(8)]
    assert all(
        one.effect_rms == pytest.approx(lines[0].effect_rms, rel=1e-12) for one in lines
    )
    assert lines[0].effect_rms > 0
