# SPDX-License-Identifier: Apache-2.0
"""A Gaussian process as the prior of the stage's map, against the truth and a dense regression."""

import math
from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.apply import StageMap
from selfcal_ros.errors import InputError
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.comparison.combine import Part, combine
from selfcal_ros.estimation.comparison.covariance import first_order_u, xy_covariance
from selfcal_ros.estimation.comparison.maps import compare
from selfcal_ros.estimation.comparison.prior import (
    estimated,
    field_of,
    measured_alone,
    with_prior,
)
from selfcal_ros.estimation.options import Options, ReferenceKind, ReferenceLength
from selfcal_ros.model.artifact import Artifact, MapGrid
from selfcal_ros.model.readings import Sense
from selfcal_ros.model.result import PRIOR, result_from_dict, result_to_dict
from selfcal_ros.model.view import Plan, View
from selfcal_ros.reporting.words.findings import worded
from selfcal_ros.simulation.machine import Spread, random_truth
from selfcal_ros.standards.dcc import certificate
from test.support.options import BARE
from test.support.truth import simulate_measurements

SIGMA_M, PITCH_M = 20e-9, 0.01
GP = replace(BARE, prior="gp")


def measured(seed, length, *, size=11, g_m=2e-7, sense=Sense.MICROSCOPE_MOVES, off=None, **how):
    """Return a truth with a stage of the correlation length `length`, pitches, and readings.

    With `off`: (by m, nodes) that stand off the smooth stage.
    """
    artifact = Artifact(size, PITCH_M, 0, **how)
    views = (View("first"), View("quarter", math.pi / 2), View("shift", 0.0, (PITCH_M, 0.0)))
    rng = np.random.default_rng(seed)
    truth = random_truth(artifact, 3, rng, Spread(correlation_pitches=length, g_m=g_m))
    if off is not None:
        by_m, nodes = off
        truth = replace(truth, g=truth.g.copy())
        truth.g[(slice(None), *np.transpose(nodes))] += by_m * np.array([[0.6], [-0.8]])
    return truth, simulate_measurements(truth, Plan("p", artifact, views), rng, sigma_m=SIGMA_M,
                                        sense=sense)


def errors(result, truth):
    return np.stack([result.error_map.gx, result.error_map.gy]) - truth.g


@pytest.mark.parametrize(("length", "gain"), [(8.0, 0.36), (4.0, 0.51), (2.6, 0.62)])
def test_a_smooth_stage_is_known_better_and_its_uncertainty_covers(length, gain):
    """12 machines, noise a tenth of the stage; the readings alone give 0.90 sigma."""
    squares, alone, inside = [], [], []
    for seed in range(40, 52):
        truth, readings = measured(seed, length)
        plain = calibrate(readings, BARE)
        result = with_prior(plain, xy_covariance)
        u = np.stack([result.error_map.u_gx, result.error_map.u_gy])
        error = errors(result, truth)
        squares.append((error**2).mean() / SIGMA_M**2)
        alone.append((errors(plain, truth) ** 2).mean() / SIGMA_M**2)
        inside.append((np.abs(error) < result.noise.k_xy * u).mean())
    assert np.sqrt(np.mean(alone)) == pytest.approx(0.9, abs=0.06)
    assert np.sqrt(np.mean(squares)) == pytest.approx(gain, abs=0.08)
    assert 0.91 < np.mean(inside) < 0.99


@pytest.mark.parametrize(("length", "message"), [
    (1.5, r"prior: the stage's error is correlated over 1\.\d+ pitches, less than 2; solve"),
    (0.0, r"prior: the stage's error is correlated over 0\.\d+ pitches, less than 2")])
def test_a_stage_too_rough_for_it_is_refused(length, message):
    for seed in range(4):
        with pytest.raises(InputError, match=message):
            calibrate(measured(seed, length)[1], GP)


def test_a_stage_smooth_and_rough_at_once_contradicts_it():
    plain, rng = calibrate(measured(3, 5.0, g_m=1e-6)[1], BARE), np.random.default_rng(1)
    rough = replace(plain, error_map=replace(
        plain.error_map, gx=plain.error_map.gx + rng.normal(0, 0.7 * SIGMA_M, (11, 11)),
        gy=plain.error_map.gy + rng.normal(0, 0.7 * SIGMA_M, (11, 11))))
    with pytest.raises(InputError, match="prior: the readings contradict a smooth stage error"):
        with_prior(rough, xy_covariance)


@pytest.mark.parametrize(("length", "by_m"), [(8.0, 8e-8), (4.0, 8e-8), (4.0, 1e-6)])
def test_a_scratched_node_is_left_to_its_readings(length, by_m):
    """80 nm are 4 sigma of a reading; smoothed away, they were 5 to 18 u."""
    found = []
    for seed in range(12):
        node = (3 + seed % 5, 2 + seed % 7)
        _, readings = measured(seed, length, off=(by_m, [node]))
        plain, result = calibrate(readings, BARE), calibrate(readings, GP)
        out = result.extra[PRIOR]["left_out"]
        found.append([node[0] - 5, node[1] - 5] in out)
        assert len(out) <= 3
        if not found[-1]:
            continue
        before, after = (np.array([one.error_map.u_gx, one.error_map.u_gy])
                         for one in (plain, result))
        assert (after[:, *node] > 0.7 * before[:, *node]).all()
        assert np.median(after / before) < 0.7
        moved = np.stack([getattr(result.error_map, name) - getattr(plain.error_map, name)
                          for name in ("gx", "gy")])
        assert (np.abs(moved[:, *node]) < 3 * before[:, *node]).all()
        assert f"({out[0][0]}, {out[0][1]})" in " ".join(worded(result).warnings)
    assert sum(found) >= 11


def test_many_scratched_nodes_are_a_rough_stage():
    nodes = [(m, n) for m in range(1, 10, 2) for n in range(1, 10, 2)]
    with pytest.raises(InputError, match=r"prior: the stage's error is correlated over 0\.\d+ "):
        calibrate(measured(4, 8.0, g_m=1e-6, off=(1.5e-7, nodes))[1], GP)


def test_a_stage_without_an_error_beyond_first_order_teaches_nothing():
    with pytest.raises(InputError, match="prior: the readings show no error of the stage beyond"):
        calibrate(measured(1, 4.0, g_m=1e-12)[1], GP)


def dense(result, facts):
    """Return mean and covariance of a Gaussian process regression with very wide first orders."""
    size_m, length_m = facts["size_m"], facts["length_m"]
    emap = result.error_map
    place = (emap.artifact.x_m + 1j * emap.artifact.y_m).ravel()
    noise, _ = xy_covariance(result, emap.valid)
    first = np.stack([np.ones(len(place)), place.real / 0.05, place.imag / 0.05], axis=1)
    one = size_m**2 * np.exp(-np.abs(place[:, None] - place) ** 2 / (2 * length_m**2))
    for m, n in facts["left_out"]:  # any value of its own
        at = np.flatnonzero((emap.artifact.m.ravel() == m) & (emap.artifact.n.ravel() == n))
        one[at, at] += (1e3 * size_m) ** 2
    prior = np.kron(np.eye(2), one + (1e3 * size_m) ** 2 * first @ first.T)
    values = np.concatenate([emap.gx.ravel(), emap.gy.ravel()])
    # readings do not tell the datum: it is told to be that of the map
    modes = np.linalg.qr(np.stack([np.concatenate([rows.real, rows.imag]) for rows in (
        np.ones(len(place)), 1j * np.ones(len(place)), 1j * place, place)], axis=1))[0]
    free = np.eye(len(values)) - modes @ modes.T
    spread = free @ prior @ free
    gain = spread @ np.linalg.pinv(spread + noise, rcond=1e-13, hermitian=True)
    left = free - gain
    return gain @ values, left @ spread @ left.T + gain @ noise @ gain.T


@pytest.mark.parametrize(("sense", "off"), [
    *((sense, None) for sense in Sense), (Sense.MICROSCOPE_MOVES, (3e-7, [(4, 2)]))])
def test_the_map_is_that_of_a_dense_regression(sense, off):
    _, readings = measured(5, 4.0, size=7, sense=sense, off=off)
    plain, result = calibrate(readings, BARE), calibrate(readings, GP)
    facts, emap = result.extra[PRIOR], result.error_map
    assert facts["left_out"] == ([] if off is None else [[1, -1]])
    values, cover = dense(plain, facts)
    scale = np.abs(values).max()
    np.testing.assert_allclose(np.concatenate([emap.gx.ravel(), emap.gy.ravel()]), values,
                               rtol=0, atol=1e-4 * scale)
    u = np.sqrt(np.diag(cover))
    np.testing.assert_allclose(np.concatenate([emap.u_gx.ravel(), emap.u_gy.ravel()]), u, rtol=2e-3)
    stored = result_from_dict(result_to_dict(worded(result)), "f")
    found, whole = xy_covariance(stored, emap.valid)
    assert whole
    np.testing.assert_allclose(found, cover, rtol=0, atol=4e-3 * cover.max())
    part = np.zeros((7, 7), dtype=bool)
    part[2:4, 3] = True
    at = np.flatnonzero(np.tile(part.ravel(), 2))
    np.testing.assert_allclose(xy_covariance(stored, part)[0], found[np.ix_(at, at)], atol=1e-30)
    place = (emap.artifact.x_m + 1j * emap.artifact.y_m).ravel()
    rows = np.concatenate([place.imag, place.real]) / (np.abs(place) ** 2).sum()
    assert first_order_u(stored)[0] == pytest.approx(np.sqrt(rows @ found @ rows), rel=1e-6)
    assert emap.nonorthogonality == pytest.approx(rows @ values, rel=1e-3)


def test_size_and_length_are_those_of_the_greatest_restricted_likelihood():
    field = field_of(calibrate(measured(7, 4.0)[1], BARE), xy_covariance)
    field, size, length = estimated(field)
    assert field.held.all()
    noise = min(np.linspace(0.8, 1.25, 46), key=lambda of: field.misfit(size, length, of)[0])
    best = field.misfit(size, length, noise)[0]
    for other in (1.03, 0.97):
        assert field.misfit(size * other, length, noise)[0] > best
        assert field.misfit(size, length * other, noise)[0] > best
    # the likelihood itself, of contrasts taken in another way
    first = np.stack([np.ones(121), field.places.real, field.places.imag], axis=1)
    both = np.kron(np.eye(2), first)
    one = size**2 * np.exp(-np.abs(field.places[:, None] - field.places) ** 2 / (2 * length**2))
    whole = field.covariance + np.kron(np.eye(2), one) + field.modes @ field.modes.T * size**2
    inverse = np.linalg.inv(whole)
    within = both.T @ inverse @ both
    projected = inverse - inverse @ both @ np.linalg.solve(within, both.T @ inverse)
    square = field.values @ projected @ field.values
    assert field.misfit(size, length)[1] == pytest.approx(square, rel=1e-6)
    logs = np.linalg.slogdet(whole)[1] + np.linalg.slogdet(within)[1] - np.linalg.slogdet(
        both.T @ both)[1]
    assert field.misfit(size, length)[0] == pytest.approx(logs + square, rel=1e-9)


def test_the_datum_and_all_else_are_those_of_the_readings():
    _, readings = measured(2, 5.0)
    plain, result = calibrate(readings, Options()), calibrate(readings, Options(prior="gp"))
    emap, z = result.error_map, result.artifact.x_m + 1j * result.artifact.y_m
    g = emap.gx + 1j * emap.gy
    for mode in (np.ones(z.shape), 1j * np.ones(z.shape), 1j * z / 0.05, z / 0.05):
        assert abs(np.real(np.vdot(mode, g))) < 1e-9 * np.abs(g).sum()
    before, after = (result_to_dict(worded(one)) for one in (plain, result))
    for key in ("views", "noise", "artifact_map", "verdict", "residuals", "dof"):
        assert after[key] == before[key], key
    np.testing.assert_array_equal(result.artifact_map.ax, plain.artifact_map.ax)
    back = measured_alone(result_from_dict(result_to_dict(worded(result)), "f"))
    for name in ("gx", "gy", "u_gx", "u_gy", "nonorthogonality", "scale_difference"):
        np.testing.assert_array_equal(getattr(back.error_map, name), getattr(plain.error_map, name))
    u = np.sqrt(np.mean([emap.u_gx**2, emap.u_gy**2]))
    lines = [line for line in result.budget if line.quantity == "xy"
             and line.component != "interpolation"]
    assert np.sqrt(sum(line.effect_rms**2 for line in lines)) == pytest.approx(u, rel=1e-6)
    own = next(line for line in lines if line.component == "stage prior")
    assert 0 < own.effect_rms < u and own.kind == "B"
    assert compare(plain, result).xy.correlated
    assert np.isfinite(StageMap(result).length_uncertainty()).all()


def test_a_reference_length_keeps_the_scale():
    readings = measured(2, 5.0)[1]
    known = ReferenceLength(ReferenceKind.ARTIFACT, 3e-6, 1e-7, "")
    plain, result = (calibrate(readings, replace(BARE, reference=known, prior=prior))
                     for prior in ("", "gp"))
    z = result.artifact.x_m + 1j * result.artifact.y_m
    scales = [np.real(np.vdot(z, one.error_map.gx + 1j * one.error_map.gy)) / (abs(z) ** 2).sum()
              for one in (plain, result)]
    assert abs(scales[0]) > 1e-6 and scales[1] == pytest.approx(scales[0], abs=2e-8)


def test_the_result_says_that_a_prior_was_used_and_others_refuse_it():
    result = worded(calibrate(measured(2, 5.0)[1], GP))
    assert "the map has a prior: its error beyond first order" in " ".join(result.warnings)
    assert result_to_dict(result)["prior"]["kind"] == "gp"
    with pytest.raises(InputError, match="certificate: a prior is part of the map"):
        certificate(result, None)
    with pytest.raises(InputError, match="one: a prior is part of its map"):
        combine([Part("one", result.error_map, result), Part("two", result.error_map, result)])
    with pytest.raises(InputError, match="prior: 'rbf' is unknown"):
        Options(prior="rbf")
    with pytest.raises(InputError, match=r"prior: the plate is known from f; solve without"):
        calibrate(measured(2, 5.0)[1], Options(plate=result, plate_from="f", prior="gp"))
    with pytest.raises(InputError, match="prior: the uncertainty of the map is not known"):
        calibrate(measured(2, 5.0)[1], replace(GP, uncertainty=False))


def test_nodes_of_a_map_of_its_own_take_it_too():
    """Six general views, whose map has fewer nodes than the plate has marks."""
    artifact = Artifact(11, PITCH_M, 0, map_grid=MapGrid(9, 0.1 / 8))
    views = tuple(View(f"v{i}", math.radians(turn), (x * PITCH_M, y * PITCH_M)) for i, (turn, x, y)
                  in enumerate([(0, 0, 0), (90, 0, 0), (37, 1.3, -0.7), (200, -0.6, 1.1)]))
    rng = np.random.default_rng(4)
    truth = random_truth(artifact, len(views), rng, Spread(correlation_pitches=5.0))
    readings = simulate_measurements(truth, Plan("p", artifact, views), rng, sigma_m=SIGMA_M)
    plain, result = calibrate(readings, BARE), calibrate(readings, GP)
    known = plain.error_map.valid
    assert (result.error_map.u_gx[known] < plain.error_map.u_gx[known]).all()
    assert (np.isnan(result.error_map.gx) == ~known).all()
    change = np.abs(result.error_map.gx - plain.error_map.gx)[known]
    assert (change < 4 * plain.error_map.u_gx[known]).all()
