# SPDX-License-Identifier: Apache-2.0
"""Covariances computed anew from a saved map are those of the calibration behind it."""

import json
from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.errors import InputError
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.comparison.covariance import covariance_of, first_order_u
from selfcal_ros.estimation.comparison.maps import compare
from selfcal_ros.estimation.joint.solve import solve_joint
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.kept import Kept
from selfcal_ros.model.readings import Sense
from selfcal_ros.model.reference import ReferenceLength
from selfcal_ros.model.result import result_from_dict, result_to_dict
from selfcal_ros.model.terms import ModelTerm
from selfcal_ros.model.view import View
from selfcal_ros.reporting.words.findings import worded
from test.support.lattice_plans import plan_of
from test.support.map_covariance import map_covariance
from test.support.options import BARE, bare, reference_length
from test.support.recalibrations import responses, sizes_of
from test.support.truth import hu_plan, random_truth, simulate_measurements

PLAN = plan_of("0,90,tx,2ty", Artifact(5, 0.01, 12), lines=1)
TURNED = plan_of("0,90+tx,2ty,270-2tx+ty,tx", Artifact(5, 0.01, 12), lines=1)
HU, SMALL = hu_plan(Artifact(7, 0.01, 12)), hu_plan(Artifact(5, 0.01, 8))
_BARE = plan_of("0,90,tx,ty", Artifact(5, 0.01, 24))
APART = replace(
    _BARE,
    views=(
        *(replace(view, angular=False) for view in _BARE.views),
        *(
            View(f"lines {k}", k * np.pi / 12, (0.0, 0.0), False, True)
            for k in (0, 1, 6)
        ),
    ),
)


def measured(
    plan,
    seed,
    truth_seed=99,
    sense=Sense.MICROSCOPE_MOVES,
    missing=0.0,
    linear=False,
    spread=None,
):
    truth = random_truth(
        plan.artifact, len(plan.views), np.random.default_rng(truth_seed), spread
    )
    return simulate_measurements(
        truth,
        plan,
        np.random.default_rng(seed),
        sense=sense,
        missing=missing,
        sigma_m=2e-8,
        sigma_theta_rad=2e-5,
        linear=linear,
    )


@pytest.mark.parametrize("sense", Sense)
@pytest.mark.parametrize(
    "reference",
    [
        None,
        ReferenceLength("stage_x", 1e-6, 0.0),
        ReferenceLength("stage_y", 1e-6, 2e-6),
        ReferenceLength("artifact", 1e-6, 2e-6),
        reference_length("marks", 1e-6, 2e-6),
    ],
)
def test_covariance_of_a_saved_map(sense, reference):
    readings = measured(PLAN, 1, sense=sense)
    options = bare(reference=reference)
    result = calibrate(readings, options)
    known = result.error_map.valid
    assert all(
        np.ndim(view.read_grid) == 0
        for view in result.views
        if view.read_grid is not None
    )
    found = covariance_of(result, "xy", known)
    wanted = map_covariance(readings, options).nodes(*np.nonzero(known))
    assert abs(found - wanted).max() < 1e-6 * wanted.max()


@pytest.mark.parametrize("sense", Sense)
@pytest.mark.parametrize(
    "reference",
    [
        None,
        ReferenceLength("stage_x", 1e-6, 2e-6),
        reference_length("marks", 1e-6, 2e-6),
    ],
)
def test_covariance_of_a_saved_map_with_missing_marks_and_terms(sense, reference):
    readings = measured(TURNED, 1, sense=sense, missing=0.1)
    options = bare(
        reference=reference,
        terms=(ModelTerm("plate_scale"), ModelTerm("plate_shape", 3e-8)),
    )
    result = calibrate(readings, options)
    saved = result_from_dict(
        json.loads(json.dumps(result_to_dict(worded(result)))), "r"
    )
    known = result.error_map.valid
    found = covariance_of(saved, "xy", known)
    wanted = map_covariance(readings, options).nodes(*np.nonzero(known))
    assert abs(found - wanted).max() < 1e-4 * wanted.max()
    u = np.concatenate([result.error_map.u_gx[known], result.error_map.u_gy[known]])
    assert np.sqrt(np.diag(wanted)) == pytest.approx(u, rel=1e-6)
    shear = first_order_u(saved)
    assert (
        shear[0]
        > 1.5 * first_order_u(calibrate(readings, bare(reference=reference)))[0]
    )
    alone = replace(saved, kept=Kept())
    assert covariance_of(alone, "xy", known).ndim == 1
    assert np.isnan(first_order_u(alone)).all()  # noise alone would be too little


@pytest.mark.parametrize(
    ("read", "message"),
    [
        ("x", "no weights of this field"),
        ([[1, 2], [3, 4]], "no weights of this field"),
        ([[1, 2], [3]], "no weights of this field"),
        (-1, "no weights of this field"),
    ],
)
def test_weights_that_are_none_are_refused(read, message):
    result = calibrate(measured(PLAN, 1), BARE)
    views = (replace(result.views[0], read_grid=read), *result.views[1:])
    with pytest.raises(
        InputError, match=f"view '0', read.grid: {message}; write the result again"
    ):
        covariance_of(replace(result, views=views), "xy", result.error_map.valid)


def test_a_reference_adds_nothing_to_the_uncertainty_of_squareness():
    readings = measured(PLAN, 1)
    plain = first_order_u(calibrate(readings, BARE))
    scaled = first_order_u(
        calibrate(readings, bare(reference=ReferenceLength("artifact", 1e-6, 2e-6)))
    )
    assert scaled == pytest.approx(plain, rel=0.05)


def test_without_weights_only_the_variances_are_known():
    result = calibrate(measured(PLAN, 1), BARE)
    emap, bare_views = (
        result.error_map,
        replace(
            result,
            views=tuple(
                replace(v, read_grid=None, read_angular=None) for v in result.views
            ),
        ),
    )
    found = covariance_of(bare_views, "xy", emap.valid)
    assert found.tolist() == [
        *(emap.u_gx[emap.valid] ** 2),
        *(emap.u_gy[emap.valid] ** 2),
    ]
    assert covariance_of(bare_views, "theta", np.isfinite(emap.g_theta)).ndim == 1
    assert np.isnan(first_order_u(bare_views)).all()


@pytest.mark.parametrize(
    ("keep_scale", "certificate"), [(False, ""), (True, ""), (True, "PTB 1")]
)
def test_maps_with_references_agree_as_often_as_they_should(keep_scale, certificate):
    """Ratios of 12 pairs: each holds a chi^2 of 94 (95) degrees of freedom, so that their mean
    scatters by 0.04. Two maps by one certificate have one error of the length."""
    found, options = [], bare(causes=False)
    kind = "artifact" if certificate else "stage_x"
    for seed in range(12):
        pair = []
        for one in range(2):
            drawn = (seed,) if certificate else (seed, one)
            error = 3e-6 * np.random.default_rng(drawn).normal()
            reference = ReferenceLength(kind, error, 3e-6, certificate)
            pair.append(
                calibrate(
                    measured(HU, 1000 * seed + one),
                    replace(options, reference=reference),
                )
            )
        test = compare(*pair, keep_scale=keep_scale).xy
        assert test.correlated
        found.append(test.chi2_ratio)
    assert np.mean(found) == pytest.approx(1, abs=0.12)
    assert np.std(found) < 0.35


def require_covariances(result, answers, *, theta=1e-6):
    """Require the covariances of a saved result to be those of every reading moved in turn."""
    sites = result.artifact.shape[0] * result.artifact.shape[1]
    of_readings = answers.T @ answers
    for covariance, wanted, tolerance in (
        (
            covariance_of(result, "xy", result.error_map.valid),
            of_readings[: 2 * sites, : 2 * sites],
            1e-6,
        ),
        (
            covariance_of(result, "theta", np.isfinite(result.error_map.g_theta)),
            of_readings[2 * sites :, 2 * sites :],
            theta,
        ),
    ):
        assert abs(covariance - wanted).max() < tolerance * wanted.max()


def map_of(result):
    emap = result.error_map
    return np.concatenate([emap.gx.ravel(), emap.gy.ravel(), emap.g_theta])


def stated(readings):
    return replace(
        readings,
        views=tuple(
            replace(view, sigma_xy=2e-8, dof_xy=1000, sigma_theta=2e-5, dof_theta=1000)
            for view in readings.views
        ),
    )


@pytest.mark.parametrize(
    ("datum", "sense", "theta"),
    [("xy_axes", Sense.MICROSCOPE_MOVES, 0.02), ("zero_mean", Sense.PLATE_MOVES, 1e-6)],
)
def test_lines_in_views_of_their_own_have_the_covariance_of_their_readings(
    datum, sense, theta
):
    """Angular noise alone tells how lines correlate: the slopes that the axes add are small."""
    readings = stated(measured(APART, 1, sense=sense, linear=True))
    options = bare(misalignment_model="linear", datum_theta=datum, causes=False)
    quick = replace(options, uncertainty=False)
    answers = responses(
        lambda moved: map_of(solve_joint(moved, quick).result),
        readings,
        sizes_of(readings, 2e-8, 2e-5),
    )
    require_covariances(calibrate(readings, options), answers, theta=theta)
