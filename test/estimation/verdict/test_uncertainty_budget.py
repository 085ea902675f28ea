# SPDX-License-Identifier: Apache-2.0
"""The uncertainty budget: each component on its own, the sum, k, and the printed table."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import t as student

from selfcal_ros.compensation.compensator import Compensator
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.comparison.covariance import covariance_of, first_order_u
from selfcal_ros.estimation.options import Options
from selfcal_ros.estimation.verdict.uncertainty import budget_lines, budgets
from selfcal_ros.model.artifact import Artifact, Interpolation, MapGrid
from selfcal_ros.model.budget import OfNoise
from selfcal_ros.model.error_map import CELL_MEAN, first_order
from selfcal_ros.model.readings import Measurements
from selfcal_ros.model.reference import ReferenceLength
from selfcal_ros.model.result import (
    CalibrationResult,
    result_from_dict,
    result_to_dict,
)
from selfcal_ros.model.terms import ModelTerm, parse_terms
from selfcal_ros.model.verdict import Grade
from selfcal_ros.reporting.words.findings import worded
from selfcal_ros.reporting.words.phrases import line_text
from selfcal_ros.reporting.words.tables import budget_text, quantity_text
from test.support.lattice_plans import plan_of
from test.support.options import BARE, bare
from test.support.truth import Spread, hu_plan, random_truth, simulate_measurements

ARTIFACT = Artifact(9, 0.01, 24)


def calibrated(repeats=5, *, extra_m=0.0, angular=True, g_m=0.0):
    artifact = ARTIFACT if angular else Artifact(9, 0.01)
    rng = np.random.default_rng(1)
    truth = random_truth(artifact, 4, rng, Spread(g_m=g_m, g_theta_rad=0.0))
    readings = simulate_measurements(
        truth, hu_plan(artifact, repeats), rng, sigma_m=2e-8, sigma_theta_rad=2e-5
    )
    views = tuple(
        replace(
            v,
            dx=v.dx + rng.normal(0, extra_m, v.dx.shape),
            dy=v.dy + rng.normal(0, extra_m, v.dy.shape),
        )
        for v in readings.views
    )
    return calibrate(Measurements(readings.plan_id, artifact, views), BARE)


def parts_of(budget):
    return {line.component: line for line in budget.lines}


def drawn_up(result, **changed):
    """Return the budgets of a result of which something is changed."""
    return budgets(replace(result, budget=(), **changed))


def by(noise, *, contradicted=False):
    return OfNoise(noise, contradicted=contradicted)


def test_reading_noise_is_that_of_the_map():
    result = calibrated()
    xy, _, theta, _ = budgets(result)
    part = parts_of(xy)["reading noise"]
    u = np.stack([result.error_map.u_gx, result.error_map.u_gy])
    assert part.effect_rms == pytest.approx(np.sqrt((u**2).mean()))
    assert part.effect_max == pytest.approx(u.max())
    assert part.dof == result.noise.dof_xy_repeats and part.details == by("repeats")
    assert parts_of(theta)["reading noise"].effect_rms == pytest.approx(
        np.sqrt((result.error_map.u_g_theta**2).mean())
    )


def test_noise_beyond_the_repeats_is_in_the_noise_once():
    """Where the test fails the noise is that of the residuals, which are more than noise."""
    result = calibrated(extra_m=3e-8)
    parts = parts_of(budgets(result)[0])
    part, lack = parts["reading noise"], parts["effect lack_of_fit"]
    u = np.stack([result.error_map.u_gx, result.error_map.u_gy])
    assert np.hypot(part.effect_rms, lack.effect_rms) == pytest.approx(
        np.sqrt((u**2).mean())
    )
    # in full at every node, by the view that has most, with its upper limit
    assert 3e-8 < lack.effect_rms < 4.5e-8 and lack.effect_max == pytest.approx(
        lack.effect_rms
    )
    assert (
        line_text(lack)
        == "residuals beyond the scatter of repeats, met in full at every place"
    )
    assert part.dof == result.noise.dof_xy_residuals
    assert part.details == by("residuals", contradicted=True)
    assert line_text(part) == (
        "residuals of the fit, the larger of two that contradict each other (see the verdict)"
    )
    # an error of 30 nm a mean beside 20 nm / sqrt(5)
    quiet = parts_of(budgets(calibrated())[0])["reading noise"]
    more = np.hypot(3e-8 * np.sqrt(5), 2e-8) / 2e-8
    assert part.effect_rms == pytest.approx(quiet.effect_rms * more, rel=0.15)
    assert quiet.details == by("repeats")


def test_lack_of_fit_is_in_the_squareness_as_at_each_node_by_itself():
    result = calibrated(extra_m=3e-8)
    cover = covariance_of(result, "xy", result.error_map.valid)
    units = np.eye(len(cover)).reshape(-1, 2, *ARTIFACT.shape)
    rows = np.array([first_order(ARTIFACT, unit) for unit in units]).T
    wanted = np.sqrt(np.diag(rows @ cover @ rows.T))
    assert first_order_u(result) == pytest.approx(wanted, rel=0.01)
    quiet = replace(result, kept=replace(result.kept, factors=None))
    assert first_order_u(quiet)[0] < 0.9 * wanted[0]


def test_noise_that_repeats_show_beyond_the_declared_is_not_lack_of_fit():
    """A detector knows the noise of its image, not the vibration of the stage."""
    rng = np.random.default_rng(1)
    truth = random_truth(ARTIFACT, 4, rng)
    readings = simulate_measurements(
        truth, hu_plan(ARTIFACT, 5), rng, sigma_m=2e-8, sigma_theta_rad=2e-5
    )
    views = tuple(
        replace(view, u=np.full(view.dx.shape, 1e-8 / np.sqrt(5)))
        for view in readings.views
    )
    result = calibrate(replace(readings, views=views), BARE)
    assert result.verdict.grade == Grade.ENLARGED  # the declaration is contradicted
    parts = parts_of(budgets(result)[0])
    assert "effect lack_of_fit" not in parts
    assert parts["reading noise"].effect_rms == pytest.approx(
        parts_of(budgets(calibrated())[0])["reading noise"].effect_rms, rel=0.1
    )


def test_without_repeats_the_residuals_speak():
    parts = parts_of(budgets(calibrated(1))[0])
    assert parts["reading noise"].details == by("residuals")


def test_nodes_and_field_are_told_apart():
    at_nodes, in_field, of_lines, at_any_angle = budgets(calibrated(g_m=1e-6))
    assert quantity_text(at_nodes) == "XY, one coordinate at the nodes of the map"
    assert quantity_text(in_field) == (
        "XY, one coordinate anywhere in the field, map interpolated between its nodes"
    )
    assert quantity_text(of_lines) == "theta at the lines of the map"
    assert (
        quantity_text(at_any_angle)
        == "theta at any angle, map interpolated between its lines"
    )
    assert "interpolation" not in parts_of(at_nodes) | parts_of(of_lines)
    assert parts_of(in_field)["interpolation"].effect_rms > 5 * at_nodes.u_rms
    assert in_field.u_rms == pytest.approx(
        np.hypot(at_nodes.u_rms, parts_of(in_field)["interpolation"].effect_rms)
    )


def test_a_term_with_a_size_has_a_line_and_the_lines_add_up():
    """Two maps of one machine, with the shape's size and without: what it adds is its line."""
    artifact = Artifact(7, 0.01)
    rng = np.random.default_rng(3)
    plan = plan_of("0,90,tx,-tx,ty", artifact)
    truth = random_truth(artifact, 5, rng)
    readings = simulate_measurements(truth, plan, rng, sigma_m=2e-8)
    plain = bare(datum_theta="zero_mean", causes=False)
    with_term = replace(plain, terms=(ModelTerm("plate_shape", 1e-7),))
    alone, result = calibrate(readings, plain), calibrate(readings, with_term)
    parts = parts_of(budgets(result)[0])
    emap = result.error_map
    total = np.mean(np.stack([emap.u_gx, emap.u_gy]) ** 2)
    line = parts["term plate_shape"]
    assert total == pytest.approx(
        sum(part.effect_rms**2 for part in parts.values()), rel=1e-4
    )
    own = np.stack([alone.error_map.u_gx, alone.error_map.u_gy]) / alone.noise.sigma_xy
    noise = np.sqrt(np.mean(own**2)) * result.noise.sigma_xy
    assert parts["reading noise"].effect_rms == pytest.approx(noise, rel=1e-3)
    assert line.effect_rms > 0.2 * noise
    assert line_text(line).startswith("size 0.1 µm, of which the readings leave ")
    loose = parts_of(
        budgets(
            calibrate(readings, replace(plain, terms=(ModelTerm("plate_shape", 1e-9),)))
        )[0]
    )["term plate_shape"]
    assert (loose.kind, loose.dof) == (
        "B",
        np.inf,
    ) and loose.effect_rms < line.effect_rms


def test_reference_length_grows_with_the_distance_from_the_centre():
    result = calibrated()
    assert parts_of(budgets(result)[0])["reference length"].effect_rms == 0.0
    reference = ReferenceLength("artifact", 0.0, 1e-6)
    part = parts_of(drawn_up(result, reference=reference)[0])["reference length"]
    assert part.effect_max == pytest.approx(1e-6 * 0.04)
    assert part.effect_rms == pytest.approx(1e-6 * np.sqrt((ARTIFACT.x_m**2).mean()))
    assert part.kind == "B" and "artifact" in line_text(part)


def test_the_reference_is_not_counted_twice():
    result = calibrated(angular=False)
    noise = parts_of(budgets(result)[0])["reading noise"]
    own = 3e-7 * np.stack([ARTIFACT.x_m, ARTIFACT.y_m])
    emap = result.error_map
    with_scale = replace(
        emap, u_gx=np.hypot(emap.u_gx, own[0]), u_gy=np.hypot(emap.u_gy, own[1])
    )
    reference = ReferenceLength("artifact", 0.0, 3e-7)
    found = parts_of(drawn_up(result, error_map=with_scale, reference=reference)[0])
    assert found["reading noise"].effect_rms == pytest.approx(noise.effect_rms)
    assert found["reading noise"].effect_max == pytest.approx(noise.effect_max)


def test_interpolation_error_of_a_parabola_is_the_exact_one(monkeypatch):
    result = calibrated()
    x = ARTIFACT.x_m
    nothing = np.zeros(ARTIFACT.shape)
    curved = replace(
        result.error_map, gx=1e-3 * x**2, gy=nothing, u_gx=nothing, u_gy=nothing
    )
    part = parts_of(drawn_up(result, error_map=curved)[1])["interpolation"]
    # linear interpolation of a x^2 over a pitch, at its middle
    middle = 1e-3 * 0.01**2 / 4
    assert part.effect_max == pytest.approx(middle)
    assert part.effect_rms == pytest.approx(np.sqrt(8 / 15 / 2) * middle)
    linear = MapGrid(9, 0.01, Interpolation.BILINEAR)
    nodes = replace(result, placed_plate=replace(ARTIFACT, map_grid=linear))
    at_nodes = parts_of(drawn_up(nodes, error_map=curved)[1])["interpolation"]
    assert at_nodes == part
    monkeypatch.setattr(CalibrationResult, "reads_between_nodes", True)
    part = parts_of(drawn_up(nodes, error_map=curved)[1])["interpolation"]
    assert part.effect_max == part.effect_rms == 0


def test_an_edge_of_its_own_is_in_the_budget_anywhere_once_in_eight_cells():
    result, nothing = calibrated(), np.zeros(ARTIFACT.shape)
    smooth = replace(
        result.error_map, gx=nothing, gy=nothing, u_gx=nothing, u_gy=nothing
    )
    rising = replace(smooth, gx=np.where(ARTIFACT.m == ARTIFACT.m.max(), 4e-7, 0.0))
    without, found = (
        parts_of(drawn_up(result, error_map=emap)[1])["interpolation"]
        for emap in (smooth, rising)
    )
    assert without.effect_max == 0
    used = Compensator(rising)
    squares = used.halfway[0, 0] ** 2 + used.edges[0, 0, 1] ** 2 / 8
    assert used.edges[0, 0, 1] == pytest.approx(2e-7)
    assert found.effect_rms == pytest.approx(np.sqrt(CELL_MEAN / 2 * squares))
    assert found.effect_max > 2e-7


def test_a_spline_with_an_unknown_node_has_the_error_of_the_linear_map_that_is_used(
    monkeypatch,
):
    monkeypatch.setattr(CalibrationResult, "reads_between_nodes", True)
    result = calibrated(angular=False)
    grid = MapGrid(9, 0.01)
    nodes = replace(result, placed_plate=replace(result.plate, map_grid=grid))
    x = ARTIFACT.x_m
    gx = 1e-3 * x**2
    gx[0, 0] = np.nan  # a corner that no view reaches
    nothing = np.where(np.isfinite(gx), 0.0, np.nan)
    curved = replace(result.error_map, gx=gx, gy=nothing, u_gx=nothing, u_gy=nothing)
    part = parts_of(drawn_up(nodes, error_map=curved)[1])["interpolation"]
    used = Compensator(curved, fitted="bicubic")
    middle_of_a_cell = used.uncertainty(0.005, 0.0)[0]
    assert part.effect_max == pytest.approx(1e-3 * 0.01**2 / 4)
    assert middle_of_a_cell == pytest.approx(part.effect_max)
    linear = replace(grid, interpolation=Interpolation.BILINEAR)
    nodes = replace(result, placed_plate=replace(result.plate, map_grid=linear))
    part = parts_of(drawn_up(nodes, error_map=curved)[1])["interpolation"]
    assert part.effect_max == part.effect_rms == 0


def test_noise_is_no_interpolation_error():
    parts = parts_of(budgets(calibrated())[1])
    assert parts["interpolation"].effect_rms < parts["reading noise"].effect_rms


def test_sum_degrees_of_freedom_and_coverage_factor():
    _, budget = budgets(calibrated(2, angular=False, extra_m=3e-8, g_m=1e-7))
    rms = [part.effect_rms for part in budget.lines]
    assert budget.u_rms == pytest.approx(np.sqrt(np.sum(np.square(rms))))
    expected = budget.u_rms**4 / sum(p.effect_rms**4 / p.dof for p in budget.lines)
    assert budget.dof == pytest.approx(expected)
    assert (
        budget.k == pytest.approx(student.isf(0.02275, budget.dof)) and budget.k > 2.0
    )
    assert budget.U_rms == pytest.approx(budget.k * budget.u_rms)
    assert budget.unit == "m"


def test_the_table_names_all_lines_and_their_sum():
    text = "\n".join(budget_text(budgets(calibrated())))
    for label in (
        "reading noise",
        "reference length",
        "interpolation",
        "combined",
        "expanded, k = 2.",
        "scatter of repeats",
        "curvature of the map; assumes that it is smooth between lines",
    ):
        assert label in text


def test_a_result_has_its_budget_also_in_a_file():
    result = worded(calibrated())
    assert [
        (line.quantity, line.component, line.kind, line.source)
        for line in result.budget
    ] == [
        ("xy", "reading noise", "A", "readings"),
        ("xy", "reference length", "B", "default"),
        ("xy", "interpolation", "B", "readings"),
        ("theta", "reading noise", "A", "readings"),
        ("theta", "interpolation", "B", "readings"),
    ]
    rows = json.loads(json.dumps(result_to_dict(result)))["budget"]
    noise = result.noise
    assert rows[0] == {
        "quantity": "xy",
        "component": "reading noise",
        "type": "A",
        "value": 0.0,
        "u": noise.sigma_xy,
        "unit": "m",
        "effect_rms": result.budget[0].effect_rms,
        "effect_max": result.budget[0].effect_max,
        "dof": noise.dof_xy,
        "source": "readings",
        "details": {"by": "repeats", "contradicted": False},
        "text": "scatter of repeats",
    }
    assert rows[1]["dof"] is None and rows[3]["u"] == noise.sigma_theta
    again = result_from_dict(result_to_dict(result), "r.json")
    assert again.budget == result.budget and budgets(again) == budgets(result)
    old = replace(again, budget=())
    assert [b.lines for b in budgets(old)] == [b.lines for b in budgets(calibrated())]
    bare = replace(
        result, error_map=replace(result.error_map, u_gx=result.error_map.gx * np.nan)
    )
    assert list(budget_lines(bare)) == [] and drawn_up(bare) == []


@pytest.mark.parametrize(
    ("given", "source"), [(None, "default"), ("plate_strain:1e-9", "declared")]
)
def test_a_line_says_what_its_size_rests_on(given, source):
    rng = np.random.default_rng(1)
    plan = hu_plan(ARTIFACT, 2)
    readings = simulate_measurements(
        random_truth(ARTIFACT, 4, rng), plan, rng, sigma_m=2e-8, sigma_theta_rad=2e-5
    )
    result = calibrate(
        readings, Options(terms=parse_terms([given], "") if given else ())
    )
    line = parts_of(budgets(result)[0])["term plate_strain"]
    (term,) = (term for term in result.model.terms if term.name == "plate_strain")
    assert (line.kind, line.source, line.unit, line.dof) == ("B", source, "m/m", np.inf)
    assert line.details.given == term.size and line.details.remaining > 0.5
    largest = max(term.estimates, key=lambda estimate: abs(estimate.value))
    assert (line.value, line.u) == (largest.value, largest.u)


def test_a_map_without_noise_has_no_noise_component():
    result = calibrated()
    silent = replace(result, noise=replace(result.noise, sigma_xy=0.0))
    assert parts_of(drawn_up(silent)[0])["reading noise"].details == {}


def test_noise_that_the_detections_declare_is_told_as_such():
    """Also where residuals or a few repeats have their own figure: the map's u is the declared."""
    rng = np.random.default_rng(1)
    truth = random_truth(ARTIFACT, 4, rng)
    for repeats in (1, 3):
        readings = simulate_measurements(
            truth, hu_plan(ARTIFACT, repeats), rng, sigma_m=2e-8, sigma_theta_rad=2e-5
        )
        views = tuple(replace(v, u=np.full(len(v.m), 5e-8)) for v in readings.views)
        result = calibrate(replace(readings, views=views), BARE)
        parts = parts_of(budgets(result)[0])
        noise = parts["reading noise"]
        assert (noise.kind, noise.dof) == ("B", np.inf)
        assert noise.details == by("declared", contradicted=True)
        u = np.stack([result.error_map.u_gx, result.error_map.u_gy])
        assert noise.effect_rms == pytest.approx(np.sqrt((u**2).mean()))
