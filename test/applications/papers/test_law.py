# SPDX-License-Identifier: Apache-2.0
"""Hu's law: truth recovery, both senses, published figures, its uncertainty, refusals."""

from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.applications.papers.law import (
    _quadratic_form,
    hu_readings,
    hu_views,
    law_for,
)
from selfcal_ros.applications.papers.methods import calibrate_by_law
from selfcal_ros.errors import InputError
from selfcal_ros.estimation.comparison.covariance import covariance_of
from selfcal_ros.estimation.options import Options
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.error_map import ThetaDatum
from selfcal_ros.model.findings import DrawnUncertainty
from selfcal_ros.model.readings import Sense
from selfcal_ros.model.reference import ReferenceKind, ReferenceLength
from selfcal_ros.model.result import Observability
from selfcal_ros.model.terms import ModelTerm
from test.support.recalibrations import responses, sizes_of
from test.support.truth import Spread, hu_plan, random_truth, simulate_measurements

SIGMA_M, SIGMA_RAD = 0.02e-6, np.deg2rad(0.001)
LAW = Options(datum_theta="xy_axes")
AS_PUBLISHED = Spread(encoder="xy_axes", rotation="linear")


def measured(
    size=5, count=8, *, seed=1, repeats=1, sense=Sense.MICROSCOPE_MOVES, **noise
):
    artifact = Artifact(size, 0.01, count)
    rng = np.random.default_rng(seed)
    truth = random_truth(artifact, 4, rng, AS_PUBLISHED)
    plan = hu_plan(artifact, repeats)
    return truth, simulate_measurements(truth, plan, rng, sense=sense, **noise)


CASES = [(5, 8, datum, sense) for datum in ThetaDatum for sense in Sense]


@pytest.mark.parametrize(
    ("size", "count", "datum", "sense"),
    [
        *CASES,
        (11, 24, ThetaDatum.XY_AXES, Sense.PLATE_MOVES),
        (15, 36, ThetaDatum.XY_AXES, Sense.MICROSCOPE_MOVES),
    ],
)
def test_noise_free_readings_give_the_truth_back(size, count, datum, sense):
    truth, readings = measured(size, count, sense=sense)
    result = calibrate_by_law(readings, replace(LAW, datum_theta=datum))
    emap, amap = result.error_map, result.artifact_map
    assert np.abs(np.stack([emap.gx, emap.gy]) - truth.g).max() < 1e-12 * 30e-6
    assert np.abs(np.stack([amap.ax, amap.ay]) - truth.a).max() < 1e-12 * 30e-6
    shift = 0.0 if datum is ThetaDatum.XY_AXES else truth.g_theta.mean()
    assert np.abs(emap.g_theta - truth.g_theta + shift).max() < 1e-12 * 5e-3
    shift = 0.0 if datum is ThetaDatum.XY_AXES else truth.g_theta.mean()
    sign = -1 if sense is Sense.PLATE_MOVES else 1
    assert np.abs(amap.a_theta - truth.a_theta - sign * shift).max() < 1e-12 * 5e-3
    assert np.allclose(
        [view.phi for view in result.views], truth.phi_rad, rtol=0, atol=1e-14
    )
    t = np.array([(view.tx, view.ty) for view in result.views])
    assert np.allclose(t[[0, 1, 3]], truth.t_m[[0, 1, 3]], rtol=0, atol=1e-16)
    assert np.isnan(t[2]).all()
    assert result.method == "law"
    unknowns = 4 * size**2 + 9
    assert result.observability == Observability(
        unknowns, unknowns, 0, True, unchecked_sites=0, unchecked_lines=0
    )


def test_first_order_parts_are_reported():
    _, readings = measured(11, 24)
    emap = calibrate_by_law(readings, LAW).error_map
    x, y = emap.artifact.x_m, emap.artifact.y_m
    d = (x**2 + y**2).sum()
    assert emap.nonorthogonality == pytest.approx(
        (emap.gx * y + emap.gy * x).sum() / d, rel=1e-9
    )
    assert emap.scale_difference == pytest.approx(
        (emap.gx * x - emap.gy * y).sum() / d, rel=1e-9
    )


def published_draws(n_draws):
    """Return errors (2, N, N, draws) and (K, draws) of the law in Hu's simulation."""
    artifact = Artifact(11, 0.01, 24)
    law = law_for(artifact, ThetaDatum.XY_AXES, Sense.MICROSCOPE_MOVES)
    rng = np.random.default_rng(2024)
    truth = random_truth(artifact, 4, rng, AS_PUBLISHED)
    errors = []
    for _ in range(n_draws):
        readings = simulate_measurements(
            truth, hu_plan(artifact), rng, sigma_m=SIGMA_M, sigma_theta_rad=SIGMA_RAD
        )
        found = law.solve(hu_readings(artifact, hu_views(readings)))
        errors.append((found.g[..., 0] - truth.g, found.g_theta[:, 0] - truth.g_theta))
    return tuple(np.stack(part, axis=-1) for part in zip(*errors, strict=True))


def test_published_calibration_errors_lie_within_the_spread_of_200_draws():
    g, theta = published_draws(200)
    std = np.concatenate(
        [g.std(axis=(1, 2)) * 1e6, np.rad2deg(theta.std(axis=0, keepdims=True))]
    )
    mean, spread = std.mean(axis=1), std.std(axis=1, ddof=1)
    published = np.array([0.0195, 0.0196, 7.1184e-4])
    assert (np.abs(published - mean) < 2 * spread).all()
    # our own earlier check of 20 draws (method, section 11), within its Monte Carlo error
    checked = np.array([0.0207, 0.0218, 8.3e-4])
    assert (np.abs(checked - mean) < 4 * spread / np.sqrt(20)).all()


@pytest.mark.parametrize("sense", Sense)
def test_uncertainty_is_that_of_every_reading_moved_in_turn(sense):
    """Each mean counts by its repeats, which differ from view to view."""
    _, readings = measured(5, 8, sense=sense)
    readings = _known_noise(
        replace(
            readings,
            views=tuple(
                replace(
                    view,
                    count=np.full(len(view.m), 1 + i),
                    count_theta=np.full(8, 4 - i),
                )
                for i, view in enumerate(readings.views)
            ),
        ),
        SIGMA_M,
        SIGMA_RAD,
    )
    law = law_for(readings.artifact, ThetaDatum.XY_AXES, sense)

    def solve(moved):
        found = law.solve(hu_readings(moved.artifact, hu_views(moved)))
        return np.concatenate([found.g.ravel(), found.g_theta[:, 0]])

    answers = responses(solve, readings, sizes_of(readings, SIGMA_M, SIGMA_RAD))
    spread = np.sqrt((answers**2).sum(axis=0))
    u_g, u_theta = spread[:50].reshape(2, 5, 5), spread[50:]
    if sense is Sense.PLATE_MOVES:  # the law solves for H(X) = -G(-X)
        u_g, u_theta = u_g[:, ::-1, ::-1], u_theta[-np.arange(8)]
    emap = calibrate_by_law(readings, LAW).error_map
    np.testing.assert_allclose([emap.u_gx, emap.u_gy], u_g, rtol=1e-8)
    np.testing.assert_allclose(emap.u_g_theta, u_theta, rtol=1e-8)


def _known_noise(readings, sigma_m, sigma_rad):
    views = tuple(
        replace(v, sigma_xy=sigma_m, dof_xy=100, sigma_theta=sigma_rad, dof_theta=100)
        for v in readings.views
    )
    return replace(readings, views=views)


def test_exact_and_drawn_propagation_agree(monkeypatch):
    _, readings = measured(11, 24, sigma_m=SIGMA_M, sigma_theta_rad=SIGMA_RAD)
    exact = calibrate_by_law(readings, LAW)
    monkeypatch.setattr("selfcal_ros.applications.papers.law.EXACT_SIZE", 9)
    drawn = calibrate_by_law(readings, LAW)
    for name in ("u_gx", "u_gy", "u_g_theta"):
        ratio = getattr(drawn.error_map, name) / getattr(exact.error_map, name)
        assert abs(np.sqrt((ratio**2).mean()) - 1) < 0.1
    assert drawn.noise.sigma_xy == pytest.approx(exact.noise.sigma_xy, rel=0.02)
    assert drawn.findings == (DrawnUncertainty(draws=400),) and exact.findings == ()


@pytest.mark.parametrize("exact_size", [21, 3])
def test_an_uncertainty_map_that_is_not_wanted_is_not_there(monkeypatch, exact_size):
    monkeypatch.setattr("selfcal_ros.applications.papers.law.EXACT_SIZE", exact_size)
    _, readings = measured(sigma_m=SIGMA_M, sigma_theta_rad=SIGMA_RAD)
    wanted, plain = (
        calibrate_by_law(readings, replace(LAW, uncertainty=uncertainty)).error_map
        for uncertainty in (None, False)
    )
    for name in ("gx", "gy", "g_theta"):
        assert np.array_equal(getattr(wanted, name), getattr(plain, name))
    for name in ("u_gx", "u_gy", "u_g_theta"):
        assert (getattr(wanted, name) > 0).all() and np.isnan(
            getattr(plain, name)
        ).all()
    found = calibrate_by_law(readings, replace(LAW, uncertainty=False))
    assert not any(finding.name == "drawn_uncertainty" for finding in found.findings)
    assert not found.has_uncertainty


def test_noise_of_one_reading_from_what_is_left_over():
    ratios = []
    for seed in range(12):
        _, readings = measured(
            11, 24, seed=seed, repeats=3, sigma_m=SIGMA_M, sigma_theta_rad=SIGMA_RAD
        )
        noise = calibrate_by_law(readings, LAW).noise
        assert noise.sigma_xy == noise.sigma_xy_repeats == pytest.approx(SIGMA_M)
        ratios.append(
            (
                noise.sigma_xy_residuals / SIGMA_M,
                noise.sigma_theta_residuals / SIGMA_RAD,
            )
        )
    ratios = np.array(ratios)
    assert np.abs((ratios**2).mean(axis=0) - 1).max() < 0.15
    assert noise.dof_xy_residuals > 100 and noise.dof_theta_residuals > 15


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda v: v[:3],
            "Hu's view 3 (one pitch along +X with grid and lines) is missing",
        ),
        (
            lambda v: (v[0], v[2], v[3]),
            "Hu's view 1 (90° with grid and lines) is missing",
        ),
        (
            lambda v: (*v, v[0]),
            "view 'identity': is not one of Hu's four views, each once",
        ),
        (
            lambda v: (
                replace(
                    v[0],
                    m=v[0].m[1:],
                    n=v[0].n[1:],
                    dx=v[0].dx[1:],
                    dy=v[0].dy[1:],
                    count=v[0].count[1:],
                ),
                *v[1:],
            ),
            "view 'identity': 24 of 25 grid marks were read",
        ),
        (
            lambda v: (
                v[0],
                v[1],
                replace(v[2], k=v[2].k[2:], dtheta=v[2].dtheta[2:]),
                v[3],
            ),
            "view 'line': 6 of 8 angular lines were read",
        ),
    ],
)
def test_views_that_are_not_hus_are_refused(change, message):
    _, readings = measured()
    with pytest.raises(InputError) as refusal:
        calibrate_by_law(replace(readings, views=change(readings.views)), LAW)
    assert message in str(refusal.value) and "--method joint" in str(refusal.value)


def test_options_and_plates_that_the_law_does_not_know_are_refused():
    _, readings = measured()
    reference = ReferenceLength(ReferenceKind.ARTIFACT, 1e-6)
    for change, message in (
        ({"reference": reference}, "no reference length"),
        ({"terms": (ModelTerm("drift"),)}, "no terms besides stage and plate"),
        ({"robust": True}, "robust: Hu's law needs every reading"),
        ({"plate": calibrate_by_law(readings, LAW)}, "use a known plate"),
    ):
        with pytest.raises(InputError, match=message):
            calibrate_by_law(readings, replace(LAW, **change))
    with pytest.raises(InputError, match="square plate with 4, 8, 12"):
        calibrate_by_law(replace(readings, artifact=Artifact(5, 0.01, 8, 7)), LAW)
    _, small = measured(3, 4)
    with pytest.raises(InputError, match="has no slope"):
        calibrate_by_law(small, LAW)
    assert (
        calibrate_by_law(small, replace(LAW, datum_theta="zero_mean")).method == "law"
    )


def test_correlations_are_unknown():
    _, readings = measured(sigma_m=SIGMA_M, sigma_theta_rad=SIGMA_RAD)
    result = calibrate_by_law(readings, LAW)
    variances = covariance_of(result, "xy", result.error_map.valid)
    assert np.array_equal(variances, result.error_map.of("xy")[1].ravel() ** 2)


def test_order_of_views_does_not_matter():
    _, readings = measured(sigma_m=SIGMA_M, sigma_theta_rad=SIGMA_RAD)
    first = calibrate_by_law(readings, LAW)
    second = calibrate_by_law(replace(readings, views=readings.views[::-1]), LAW)
    assert np.array_equal(first.error_map.gx, second.error_map.gx)
    assert [v.phi for v in first.views] == [v.phi for v in second.views][::-1]


def test_squares_in_a_few_directions_of_equal_noise_have_as_many_degrees_of_freedom():
    """Chi-square: 3 directions of standard deviation 2 have the mean 12 and 3 degrees."""
    rng = np.random.default_rng(6)
    directions = 2 * np.linalg.qr(rng.normal(size=(20, 3)))[0]
    assert _quadratic_form(directions, exact=True) == pytest.approx((12, 3))
    drawn = directions @ rng.normal(size=(3, 40_000))
    assert _quadratic_form(drawn, exact=False) == pytest.approx((12, 3), rel=0.04)
    uneven = np.diag([1.0, 2.0])  # Satterthwaite: 5 squared over 1 + 16
    assert _quadratic_form(uneven, exact=True) == pytest.approx((5, 25 / 17))
