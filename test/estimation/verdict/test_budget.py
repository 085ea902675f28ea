# SPDX-License-Identifier: Apache-2.0
"""The uncertainty budget: each component on its own, the sum, k, and the printed table."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import t as student

from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.options import ReferenceKind, ReferenceLength
from selfcal_ros.estimation.verdict.budget import FromReadings, Source, budgets
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.readings import Measurements
from selfcal_ros.model.terms import ModelTerm, TermName
from selfcal_ros.reporting.words.budget import budget_json, budget_text, how_text, quantity_text
from selfcal_ros.simulation.truth import Spread, hu_plan, random_truth, simulate_measurements
from test.support.lattice_plans import plan_of
from test.support.options import BARE, bare

ARTIFACT = Artifact(9, 0.01, 24)


def calibrated(repeats=5, *, extra_m=0.0, angular=True, g_m=0.0):
    artifact = ARTIFACT if angular else Artifact(9, 0.01)
    rng = np.random.default_rng(1)
    truth = random_truth(artifact, 4, rng, Spread(g_m=g_m, g_theta_rad=0.0))
    readings = simulate_measurements(truth, hu_plan(artifact, repeats), rng, sigma_m=2e-8,
                                     sigma_theta_rad=2e-5)
    views = tuple(replace(v, dx=v.dx + rng.normal(0, extra_m, v.dx.shape),
                          dy=v.dy + rng.normal(0, extra_m, v.dy.shape)) for v in readings.views)
    return calibrate(Measurements(readings.plan_id, artifact, views), BARE)


def parts_of(budget):
    return {part.label: part for part in budget.components}


def test_reading_noise_is_that_of_the_map():
    result = calibrated()
    xy, _, theta, _ = budgets(result)
    part = parts_of(xy)["reading noise"]
    u = np.stack([result.error_map.u_gx, result.error_map.u_gy])
    assert part.u_rms == pytest.approx(np.sqrt((u**2).mean()))
    assert part.u_max == pytest.approx(u.max())
    assert part.dof == result.noise.dof_xy_repeats and part.how == FromReadings(Source.REPEATS)
    assert parts_of(theta)["reading noise"].u_rms == pytest.approx(
        np.sqrt((result.error_map.u_g_theta**2).mean()))


def test_noise_beyond_the_repeats_is_in_the_noise_once():
    """Where the verdict's test fails, the map's u is that of the residuals already."""
    result = calibrated(extra_m=3e-8)
    part = parts_of(budgets(result)[0])["reading noise"]
    u = np.stack([result.error_map.u_gx, result.error_map.u_gy])
    assert part.u_rms == pytest.approx(np.sqrt((u**2).mean()))
    assert part.dof == result.noise.dof_xy_residuals
    assert part.how == FromReadings(Source.RESIDUALS, True)
    assert how_text(part.how) == ("residuals of the fit, the larger of two that contradict each "
                                  "other (see the verdict)")
    # an error of 30 nm a mean beside 20 nm / sqrt(5)
    quiet = parts_of(budgets(calibrated())[0])["reading noise"]
    assert part.u_rms == pytest.approx(quiet.u_rms * np.hypot(3e-8 * np.sqrt(5), 2e-8) / 2e-8,
                                       rel=0.15)
    assert quiet.how == FromReadings(Source.REPEATS)


def test_without_repeats_the_residuals_speak():
    parts = parts_of(budgets(calibrated(1))[0])
    assert parts["reading noise"].how == FromReadings(Source.RESIDUALS)


def test_nodes_and_field_are_told_apart():
    at_nodes, in_field, of_lines, at_any_angle = budgets(calibrated(g_m=1e-6))
    assert quantity_text(at_nodes) == "XY, one coordinate at the nodes of the map"
    assert quantity_text(in_field) == ("XY, one coordinate anywhere in the field, map interpolated "
                                 "between its nodes")
    assert quantity_text(of_lines) == "theta at the lines of the map"
    assert quantity_text(at_any_angle) == "theta at any angle, map interpolated between its lines"
    assert "interpolation" not in parts_of(at_nodes) | parts_of(of_lines)
    assert parts_of(in_field)["interpolation"].u_rms > 5 * at_nodes.u_rms
    assert in_field.u_rms == pytest.approx(np.hypot(
        at_nodes.u_rms, parts_of(in_field)["interpolation"].u_rms))


def test_a_term_with_a_size_has_a_line_and_the_lines_add_up():
    """Two maps of one machine, with the shape's size and without: what it adds is its line."""
    artifact = Artifact(7, 0.01)
    rng = np.random.default_rng(3)
    plan = plan_of("0,90,tx,-tx,ty", artifact)
    truth = random_truth(artifact, 5, rng)
    readings = simulate_measurements(truth, plan, rng, sigma_m=2e-8)
    plain = bare(datum_theta="zero_mean", causes=False)
    with_term = replace(plain, terms=(ModelTerm(TermName.PLATE_SHAPE, 1e-7),))
    alone, result = calibrate(readings, plain), calibrate(readings, with_term)
    parts = parts_of(budgets(result)[0])
    emap = result.error_map
    total = np.mean(np.stack([emap.u_gx, emap.u_gy]) ** 2)
    line = parts["term plate_shape"]
    assert total == pytest.approx(sum(part.u_rms**2 for part in parts.values()), rel=1e-4)
    own = np.stack([alone.error_map.u_gx, alone.error_map.u_gy]) / alone.noise.sigma_xy
    noise = np.sqrt(np.mean(own**2)) * result.noise.sigma_xy
    assert parts["reading noise"].u_rms == pytest.approx(noise, rel=1e-3)
    assert line.u_rms > 0.2 * noise
    assert how_text(line.how).startswith("known to 1e-07 beforehand; the readings leave ")
    loose = parts_of(budgets(calibrate(readings, replace(plain, terms=(
        ModelTerm(TermName.PLATE_SHAPE, 1e-9),))))[0])["term plate_shape"]
    assert (loose.kind, loose.dof) == ("B", np.inf) and loose.u_rms < line.u_rms


def test_reference_length_grows_with_the_distance_from_the_centre():
    result = calibrated()
    assert parts_of(budgets(result)[0])["reference length"].u_rms == 0.0
    reference = ReferenceLength(ReferenceKind.ARTIFACT, 0.0, 1e-6)
    part = parts_of(budgets(result, reference)[0])["reference length"]
    assert part.u_max == pytest.approx(1e-6 * 0.04)
    assert part.u_rms == pytest.approx(1e-6 * np.sqrt((ARTIFACT.x_m**2).mean()))
    assert part.kind == "B" and "artifact" in how_text(part.how)


def test_the_reference_is_not_counted_twice():
    result = calibrated(angular=False)
    noise = parts_of(budgets(result)[0])["reading noise"]
    own = 3e-7 * np.stack([ARTIFACT.x_m, ARTIFACT.y_m])
    emap = result.error_map
    with_scale = replace(emap, u_gx=np.hypot(emap.u_gx, own[0]), u_gy=np.hypot(emap.u_gy, own[1]))
    reference = ReferenceLength(ReferenceKind.ARTIFACT, 0.0, 3e-7)
    found = parts_of(budgets(replace(result, error_map=with_scale), reference)[0])
    assert found["reading noise"].u_rms == pytest.approx(noise.u_rms)
    assert found["reading noise"].u_max == pytest.approx(noise.u_max)


def test_interpolation_error_of_a_parabola_is_the_exact_one():
    result = calibrated()
    x = ARTIFACT.x_m
    nothing = np.zeros(ARTIFACT.shape)
    curved = replace(result.error_map, gx=1e-3 * x**2, gy=nothing, u_gx=nothing, u_gy=nothing)
    part = parts_of(budgets(replace(result, error_map=curved))[1])["interpolation"]
    middle = 1e-3 * 0.01**2 / 4  # linear interpolation of a x^2 over a pitch, at its middle
    assert part.u_max == pytest.approx(middle)
    assert part.u_rms == pytest.approx(np.sqrt(8 / 15 / 2) * middle)


def test_noise_is_no_interpolation_error():
    parts = parts_of(budgets(calibrated())[1])
    assert parts["interpolation"].u_rms < parts["reading noise"].u_rms


def test_sum_degrees_of_freedom_and_coverage_factor():
    _, budget = budgets(calibrated(2, angular=False, extra_m=3e-8, g_m=1e-7))
    rms = [part.u_rms for part in budget.components]
    assert budget.u_rms == pytest.approx(np.sqrt(np.sum(np.square(rms))))
    expected = budget.u_rms**4 / sum(p.u_rms**4 / p.dof for p in budget.components)
    assert budget.dof == pytest.approx(expected)
    assert budget.k == pytest.approx(student.isf(0.02275, budget.dof)) and budget.k > 2.0
    assert budget.U_rms == pytest.approx(budget.k * budget.u_rms)
    assert budget.unit == "m"


def test_table_and_json():
    found = budgets(calibrated())
    text = "\n".join(budget_text(found))
    for label in ("reading noise", "reference length", "interpolation",
                  "combined", "expanded, k = 2."):
        assert label in text
    rows = budget_json(found)
    assert {row["component"] for row in rows} >= {"reading noise", "combined", "expanded"}
    first = rows[0]
    assert first["u_rms_m"] == found[0].components[0].u_rms and first["u_rms_rad"] is None
    assert rows[-1]["u_rms_rad"] == found[-1].U_rms


def test_a_map_without_noise_has_no_noise_component():
    result = calibrated()
    silent = replace(result, noise=replace(result.noise, sigma_xy=0.0))
    assert parts_of(budgets(silent)[0])["reading noise"].how == FromReadings(None)


def test_noise_that_the_detections_declare_is_told_as_such():
    """Also where residuals or a few repeats have their own figure: the map's u is the declared."""
    rng = np.random.default_rng(1)
    truth = random_truth(ARTIFACT, 4, rng)
    for repeats in (1, 3):
        readings = simulate_measurements(truth, hu_plan(ARTIFACT, repeats), rng, sigma_m=2e-8,
                                         sigma_theta_rad=2e-5)
        views = tuple(replace(v, u=np.full(len(v.m), 5e-8)) for v in readings.views)
        result = calibrate(replace(readings, views=views), BARE)
        parts = parts_of(budgets(result)[0])
        noise = parts["reading noise"]
        assert (noise.kind, noise.dof) == ("B", np.inf)
        assert noise.how == FromReadings(Source.DECLARED, True)
        u = np.stack([result.error_map.u_gx, result.error_map.u_gy])
        assert noise.u_rms == pytest.approx(np.sqrt((u**2).mean()))
