# SPDX-License-Identifier: Apache-2.0
"""Figures of ISO 230: definitions, repeats with their signs, circles, diagonals, uncertainties."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.special import gamma

from selfcal_ros.applications.standards.iso230 import (
    Scatter,
    _true_shares,
    axis_figures,
    bidirectional,
    circle_figures,
    diagonal_figures,
    scatters,
)
from selfcal_ros.apply import StageMap
from selfcal_ros.bagio.offline import bag_input, collect_bag
from selfcal_ros.cli import iso230 as verb
from selfcal_ros.cli.main import main
from selfcal_ros.errors import InputError
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.options import Options
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.error_map import ErrorMap
from selfcal_ros.model.readings import Sense
from selfcal_ros.model.result import result_to_dict
from selfcal_ros.outputs import plain, write_json
from selfcal_ros.reporting.words.findings import worded
from selfcal_ros.settings.nodes import CollectorSettings
from selfcal_ros.simulation.cell import CellSettings
from test.support.bags import Foreign
from test.support.maps import random_map, result_of
from test.support.options import bare
from test.support.pages import ROOT
from test.support.sessions import events_of, small_plan
from test.support.truth import Spread, hu_plan, random_truth, simulate_measurements

ARTIFACT = Artifact(7, 0.01)
BACKLASH_M = (40e-9, -25e-9)


def test_the_figures_are_those_of_the_definitions():
    """Three positions, µm; by hand from ISO 230-2, clause 3."""
    up, down = np.array([1.0, 3.0, 2.0]), np.array([0.0, 3.5, 4.0])
    s_up, s_down = np.array([0.1, 0.2, 0.3]), np.array([0.1, 0.4, 0.1])
    found = bidirectional(up, down, s_up, s_down)
    expected = {
        "M": 3.25 - 0.5,
        "B": 2.0,
        "mean B": (1.0 - 0.5 - 2.0) / 3,
        "E": 4.0 - 0.0,
        "E+": 2.0,
        "E-": 4.0,
        "R+": 1.2,
        "R-": 1.6,
        "R": 0.6 + 0.2 + 2.0,
        "A": 4.3 - -0.2,
        "A+": 3.4 - 0.8,
        "A-": 4.3 - -0.2,
    }
    assert set(found) == set(expected)
    for name, value in expected.items():
        assert found[name] == pytest.approx(value), name
    # four s beat two and two without reversal
    alone = bidirectional(up, up, s_up, 0.5 * s_up)
    assert alone["R"] == pytest.approx(1.2)


def test_the_figures_of_many_draws_are_those_of_each():
    rng = np.random.default_rng(1)
    draws = rng.normal(size=(4, 5, 3)) ** [[[2]], [[2]], [[2]], [[2]]]
    found = bidirectional(*draws)
    for index in range(5):
        for name, value in bidirectional(*draws[:, index]).items():
            assert found[name][index] == pytest.approx(value), name


def test_the_uncertainty_of_the_mean_reversal_is_that_of_its_approaches():
    """Seven sites, s of 30 and 40 nm: a reversal of four approaches each has u = s (2 / 4)^1/2."""
    items = {
        (i, 0): Scatter(1e-7, np.sqrt(0.5), 30e-9, 40e-9, 3, 3, 0.0)
        for i in range(-3, 4)
    }
    stage = StageMap(result_of(random_map(ARTIFACT, 1)))
    found = axis_figures(stage, 0, 0, items).figures["mean B"]
    assert found.value == pytest.approx(-1e-7)
    assert found.u == pytest.approx(
        np.sqrt((30e-9**2 + 40e-9**2) / 2 * 0.5 / 7), rel=0.06
    )


def test_sites_that_are_not_known_are_no_positions():
    stage = StageMap(result_of(random_map(ARTIFACT, 1, unknown=((1, 3), (0, 0)))))
    found = axis_figures(stage, 0, 0)
    np.testing.assert_allclose(found.position_m, np.array([-3, -1, 0, 1, 2, 3]) * 0.01)
    assert len(axis_figures(stage, 1, 0).position_m) == 7


def measured(
    *, sense=Sense.MICROSCOPE_MOVES, sigma=0.0, seed=1, repeats=4, order="x_back_y_back"
):
    rng = np.random.default_rng(seed)
    spread = Spread(backlash_x_m=BACKLASH_M[0], backlash_y_m=BACKLASH_M[1])
    plan = hu_plan(ARTIFACT, repeats)
    truth = random_truth(ARTIFACT, len(plan.views), rng, spread)
    return truth, simulate_measurements(
        truth,
        plan,
        rng,
        settings=CellSettings(sense, sigma, 0.0, servo_sigma_m=0.0, visit_order=order),
    )


@pytest.mark.parametrize("sense", Sense)
@pytest.mark.parametrize("axis", [0, 1])
def test_the_reversal_is_that_of_the_machine(sense, axis):
    """Approached from below the indicated position is high by the backlash, the stage low."""
    truth, readings = measured(sense=sense)
    repeats = scatters(readings, axis)
    assert len(repeats) >= 25
    for item in repeats.values():
        assert item.reversal_m == pytest.approx(2 * BACKLASH_M[axis], abs=1e-12)
        assert item.s_up_m < 1e-12 and item.s_down_m < 1e-12 and item.dof_up >= 1
    exact = result_of(replace(random_map(ARTIFACT, 1), gx=truth.g[0], gy=truth.g[1]))
    found = axis_figures(StageMap(exact), axis, 0, repeats, approach_in_model=True)
    sites = np.rint(found.position_m / ARTIFACT.grid_pitch_m).astype(int) + 3
    g = truth.g[0][sites, 3] if axis == 0 else truth.g[1][3, sites]
    np.testing.assert_allclose(found.up_m, -(g + BACKLASH_M[axis]), atol=1e-12)
    np.testing.assert_allclose(found.down_m, -(g - BACKLASH_M[axis]), atol=1e-12)
    assert found.figures["B"].value == pytest.approx(
        2 * abs(BACKLASH_M[axis]), abs=1e-12
    )
    assert found.figures["mean B"].value == pytest.approx(
        -2 * BACKLASH_M[axis], abs=1e-12
    )


def test_a_map_of_one_approach_more_than_the_other_is_moved_to_their_middle():
    _, readings = measured()
    repeats = scatters(readings, 0)
    stage = StageMap(result_of(random_map(ARTIFACT, 1)))
    biased = {site: replace(item, mean_sign=1.0) for site, item in repeats.items()}
    moved = axis_figures(stage, 0, 0, biased)
    middle = axis_figures(stage, 0, 0, biased, approach_in_model=True)
    np.testing.assert_allclose(middle.up_m - moved.up_m, -BACKLASH_M[0], atol=1e-12)
    assert axis_figures(stage, 0, -2, repeats).line_m == pytest.approx(-0.02)


def test_the_scatter_of_approaches_is_that_of_the_machine():
    _, readings = measured(sigma=30e-9, repeats=8)
    found = scatters(readings, 0).values()
    s = np.sqrt(
        np.average(
            [item.s_up_m**2 for item in found], weights=[item.dof_up for item in found]
        )
    )
    dof = sum(item.dof_up for item in found)
    assert dof > 200 and s == pytest.approx(30e-9, rel=4 / np.sqrt(2 * dof))
    off = np.array(
        [
            (item.reversal_m - 2 * BACKLASH_M[0]) / (item.u_reversal_m * 30e-9)
            for item in found
        ]
    )
    assert np.sqrt(np.mean(off**2)) == pytest.approx(1, abs=4 / np.sqrt(2 * len(off)))


@pytest.mark.parametrize("axis", [0, 1])
def test_check_stops_are_no_approaches(axis):
    """What a microscope of a wrong scale shows of them is no scatter of the stage."""
    rng = np.random.default_rng(1)
    plan = hu_plan(ARTIFACT, 4)
    checked = tuple(
        replace(view, check_marks=5 * view.grid, check_offset_m=20e-6 * view.grid)
        for view in plan.views
    )
    truth = random_truth(ARTIFACT, len(plan.views), rng, Spread(microscope_scale=5e-3))
    readings = simulate_measurements(
        truth,
        replace(plan, views=checked),
        rng,
        settings=CellSettings(servo_sigma_m=0.0, visit_order="x_back_y_back"),
    )
    found = scatters(readings, axis)
    assert max(len(view.visits.mark) / len(view.m) for view in readings.views) > 4
    for item in found.values():
        assert item.s_up_m < 1e-9 and item.s_down_m < 1e-9
        assert abs(item.reversal_m) < 1e-9


def test_the_reversal_of_unequal_approaches_is_that_of_one_least_squares():
    """Per site: one reversal and a mean a view, from visits of which every third is missing."""
    _, readings = measured(sigma=30e-9)
    rng, visits = np.random.default_rng(3), {}
    fewer = []
    for view in readings.views:
        kept = rng.random(len(view.visits.mark)) > 1 / 3
        own = replace(
            view.visits,
            **{
                name: values[kept]
                for name, values in vars(view.visits).items()
                if np.shape(values) == kept.shape
            },
        )
        fewer.append(replace(view, visits=own))
        x, y = view.view.lattice_pose(ARTIFACT).site_of(view.m, view.n)
        for mark, value, sign in zip(own.mark, own.dx, own.approach_x, strict=True):
            visits.setdefault((x[mark], y[mark]), []).append((len(fewer), value, sign))
    found, unequal = scatters(replace(readings, views=tuple(fewer)), 0), 0
    assert len(found) >= 20
    for site, item in found.items():
        rows = [row for row in visits[site] if row[2]]
        both = [
            v
            for v in {row[0] for row in rows}
            if {row[2] for row in rows if row[0] == v} == {1, -1}
        ]
        rows = [row for row in rows if row[0] in both]
        matrix = np.array(
            [[sign / 2, *(v == view for v in both)] for view, _, sign in rows]
        )
        inverse = np.linalg.inv(matrix.T @ matrix)
        value = inverse @ matrix.T @ [value for _, value, _ in rows]
        assert item.reversal_m == pytest.approx(value[0], abs=1e-15), site
        assert item.u_reversal_m == pytest.approx(np.sqrt(inverse[0, 0])), site
        unequal += len({sum(row[2] == sign for row in rows) for sign in (1, -1)}) == 2
    assert unequal >= 10


def solved(seed, truth=None):
    rng = np.random.default_rng(seed)
    plan = hu_plan(ARTIFACT, 2)
    truth = truth or random_truth(ARTIFACT, len(plan.views), np.random.default_rng(7))
    return truth, calibrate(
        simulate_measurements(truth, plan, rng, sigma_m=2e-8), bare(causes=False)
    )


def test_uncertainties_are_the_scatter_of_repeated_calibrations():
    """20 calibrations: a standard deviation is known to 16 %, and lengths have no bias."""
    truth, _ = solved(0)
    exact = StageMap(
        result_of(replace(random_map(ARTIFACT, 1), gx=truth.g[0], gy=truth.g[1]))
    )
    z = {
        "difference": [],
        "G": [],
        "Fmax": [],
        "Fmin": [],
        "M": [],
        "1 M": [],
        "2 M": [],
    }
    for seed in range(20):
        stage = StageMap(solved(seed, truth)[1])
        stage.halfway = np.zeros((2, 2))  # the truth is bilinear between its nodes
        for name, of in (
            ("difference", lambda s: diagonal_figures(s)[2].figures["length"]),
            ("G", lambda s: circle_figures(s, 0.03).figures["G"]),
            ("Fmax", lambda s: circle_figures(s, 0.03).figures["Fmax"]),
            ("Fmin", lambda s: circle_figures(s, 0.03).figures["Fmin"]),
            ("1 M", lambda s: diagonal_figures(s)[0].figures["M"]),
            ("2 M", lambda s: diagonal_figures(s)[1].figures["M"]),
            ("M", lambda s: axis_figures(s, 0, 0).figures["M"]),
        ):
            figure = of(stage)
            z[name].append((figure.value - of(exact).value) / figure.u)
    for name, values in z.items():
        assert 0.6 < np.sqrt(np.mean(np.square(values))) < 1.4, name


def linear(gx, gy):
    """Return a stage with a linear error, a function of x and y."""
    x, y = ARTIFACT.x_m, ARTIFACT.y_m
    return StageMap(
        result_of(replace(random_map(ARTIFACT, 1), gx=gx(x, y), gy=gy(x, y)))
    )


def test_circles_and_diagonals_of_linear_errors():
    """Out of square by O the circle has the radial error -O r sin 2 phi."""
    shear = linear(lambda x, y: 1e-5 * y, lambda x, y: 1e-5 * x)
    circle = circle_figures(shear, 0.03).figures
    assert circle["G"].value == pytest.approx(2e-5 * 0.03, rel=1e-3)
    assert circle["Fmax"].value == pytest.approx(1e-5 * 0.03, rel=1e-3)
    assert circle["Fmin"].value == pytest.approx(-1e-5 * 0.03, rel=1e-3)
    rising, falling, difference = (item.figures for item in diagonal_figures(shear))
    length = 2 * np.sqrt(2) * 0.03 * 1e-5
    assert rising["length"].value == pytest.approx(-length)
    assert falling["length"].value == pytest.approx(length)
    assert difference["length"].value == pytest.approx(-2 * length)
    assert rising["M"].value == pytest.approx(length)
    larger = linear(lambda x, y: 1e-5 * x + 2e-7, lambda x, y: 1e-5 * y - 3e-7)
    circle = circle_figures(larger, 0.02, (0.005, -0.01)).figures
    assert circle["G"].value == pytest.approx(0, abs=1e-15)
    centre = np.hypot(1e-5 * 0.005 + 2e-7, -1e-5 * 0.01 - 3e-7)
    assert circle["Fmax"].value == pytest.approx(-2e-7 + centre, rel=2e-3)
    assert circle["Fmin"].value == pytest.approx(-2e-7 - centre, rel=2e-3)
    assert diagonal_figures(larger)[2].figures["length"].value == pytest.approx(
        0, abs=1e-15
    )


def test_without_repeats_the_range_of_the_mean_deviation_is_left():
    stage = linear(lambda x, y: 2e-5 * x, lambda x, y: 0 * x)
    found = axis_figures(stage, 0, 1)
    assert found.line_m == pytest.approx(0.01) and list(found.figures) == ["M"]
    assert found.figures["M"].value == pytest.approx(2e-5 * 0.06)
    np.testing.assert_allclose(found.up_m, -2e-5 * found.position_m)
    assert np.isnan(found.s_up_m).all() and found.approaches == (0, 0)
    assert axis_figures(stage, 1, 1).figures["M"].value == 0.0


@pytest.mark.parametrize("name", ["R+", "R-"])
def test_the_uncertainty_of_the_repeatability_of_one_direction(name):
    """It is 4 s, of one position with scatter; s sqrt(dof) / sigma follows chi with dof."""
    stage, dof = linear(lambda x, y: 0 * x, lambda x, y: 0 * x), {"R+": 5, "R-": 3}
    few = {(m, 0): Scatter(0.0, 1.0, 1e-12, 1e-12, 5, 3, 0.0) for m in range(-3, 4)}
    few[1, 0] = Scatter(0.0, 1.0, 3e-8, 2e-8, 5, 3, 0.0)
    found, n = axis_figures(stage, 0, 0, few).figures[name], dof[name]
    mean = np.sqrt(2 / n) * gamma((n + 1) / 2) / gamma(n / 2)  # of chi over sqrt(dof)
    assert found.value == pytest.approx(4 * {"R+": 3e-8, "R-": 2e-8}[name])
    assert found.u == pytest.approx(found.value * np.sqrt(2 - 2 * mean), rel=0.1)


@pytest.mark.parametrize("reversal_m", [0.0, 6e-8])
def test_the_largest_of_equal_scatters_is_within_its_uncertainty(reversal_m):
    """Seven positions, 37 approaches each: of 80 machines 4 s of one sigma is in 2 u of most."""
    stage, sigma_m, dof = linear(lambda x, y: 0 * x, lambda x, y: 0 * x), 2e-8, 36
    rng, within = np.random.default_rng(5), {"R": 0, "R+": 0, "R-": 0}
    true = {
        "R": max(4 * sigma_m + reversal_m, 4 * sigma_m),
        "R+": 4 * sigma_m,
        "R-": 4 * sigma_m,
    }
    for _ in range(80):
        s_m = sigma_m * np.sqrt(rng.chisquare(dof, (7, 2)) / dof)
        u_reversal = np.sqrt(2 / (dof + 1))
        seen_m = reversal_m + u_reversal * sigma_m * rng.standard_normal(7)
        items = {
            (m - 3, 0): Scatter(seen_m[m], u_reversal, *s_m[m], dof, dof, 0.0)
            for m in range(7)
        }
        figures = axis_figures(stage, 0, 0, items).figures
        for name, value in true.items():
            within[name] += abs(figures[name].value - value) < 2 * figures[name].u
    assert min(within.values()) >= 74, within


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda stage: axis_figures(stage, 0, 9),
            "line 9 along x: 0 positions are known",
        ),
        (lambda stage: axis_figures(stage, 1, 0, {}), "visit_order there_and_back"),
        (
            lambda stage: circle_figures(stage, 0.04),
            "is not in the field; give one up to 0.03 m",
        ),
        (lambda stage: circle_figures(stage, -0.01), "is not in the field"),
        (lambda stage: circle_figures(stage, float("nan")), "is not in the field"),
    ],
)
def test_what_cannot_be_given_is_refused(call, message):
    with pytest.raises(InputError, match=message):
        call(StageMap(result_of(random_map(ARTIFACT, 1))))


def test_a_path_over_unknown_sites_is_refused():
    stage = StageMap(result_of(random_map(ARTIFACT, 1, unknown=((0, 0),))))
    with pytest.raises(InputError, match="diagonals: unknown sites on the path"):
        diagonal_figures(stage)


def test_the_verb_leaves_out_what_crosses_unknown_sites_and_says_which(
    tmp_path, capsys
):
    path = str(tmp_path / "r.json")
    write_json(
        path,
        plain(
            result_to_dict(
                result_of(random_map(ARTIFACT, 1, unknown=((0, 0), (0, 3), (5, 3))))
            )
        ),
    )
    assert main(["iso230", path]) == 0
    out, err = capsys.readouterr()
    assert "axis x at y = 0 mm, 5 positions from -20 to 30 mm" in out
    assert "  left out: -30, 20 mm (unknown)" in out and out.count("left out") == 1
    assert "circle" not in out and "diagonal" not in out
    assert err.splitlines() == [
        "selfcal iso230: circle of radius 30 mm: unknown sites on the path; measure them, or "
        "choose a smaller --radius; left out",
        "selfcal iso230: diagonals: unknown sites on the path; measure them; left out",
    ]
    assert main(["iso230", path, "--radius", "5", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert [axis["left_out"] for axis in found["axes"]] == [[-0.03, 0.02], []]
    assert [one["name"] for one in found["paths"]] == ["circle of radius 5 mm"]
    assert main(["iso230", path, "--radius", "30"]) == 2


def test_the_verb_takes_a_bag_or_a_result(tmp_path, capsys):
    bag = str(ROOT / "bags/hu_noise")
    assert main(["iso230", bag, "--json"]) == 0
    of_bag = json.loads(capsys.readouterr().out)
    assert main(["solve", bag, "--quiet", "-o", str(tmp_path / "r.json")]) == 0
    assert main(["iso230", bag, "--result", str(tmp_path / "r.json"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == of_bag
    other = ["iso230", str(ROOT / "bags/demo"), "--result", str(tmp_path / "r.json")]
    assert main(other) == 2  # the same plate, on another day
    assert "the result is of another recording" in capsys.readouterr().err
    assert main(["iso230", str(tmp_path / "r.json"), "--json"]) == 0
    of_result = json.loads(capsys.readouterr().out)
    assert of_result["paths"] == of_bag["paths"]
    assert set(of_bag["axes"][0]["figures"]) > {"A", "R", "E", "B", "M"}
    assert set(of_result["axes"][0]["figures"]) == {"M"}
    assert of_bag["scale"] == "convention"
    assert (
        main(["iso230", str(tmp_path / "r.json"), "--radius", "20", "--line", "-2"])
        == 0
    )
    text = capsys.readouterr().out
    assert (
        "circle of radius 20 mm" in text
        and "axis x at y = -20 mm, 11 positions" in text
    )
    assert main(["iso230", str(tmp_path / "r.json"), "--result", "x.json"]) == 2
    assert "is a result itself" in capsys.readouterr().err


def test_a_bag_without_approaches_from_both_sides_says_so(
    tmp_path, capsys, monkeypatch
):
    from selfcal_ros.cli import iso230 as verb

    _, readings = measured(order="raster", sigma=1e-8)
    result = worded(calibrate(readings, Options(causes=False)))
    write_json(tmp_path / "r.json", plain(result_to_dict(result)))
    monkeypatch.setattr(verb, "collect_bag", lambda *_: (readings, {}, [], []))
    assert main(["iso230", "some_bag", "--result", str(tmp_path / "r.json")]) in (0, 5)
    both = capsys.readouterr()
    assert "visit_order" in both.err and "only M is given" in both.err
    assert "without repeats" in both.out


@pytest.mark.parametrize(
    ("reversal_m", "spread_m", "unlike"),
    [(0.0, 0.0, True), (1e-7, 0.0, True), (5e-8, 5e-8, False)],
)
def test_u_holds_the_bias_of_what_is_largest_of_noisy_values(
    reversal_m, spread_m, unlike
):
    """150 machines with known reversal and scatter, five approaches from each side.

    The largest of eleven reversals with noise is too large by more than the scatter of draws about
    the measured ones.
    """
    plate, count = Artifact(11, 0.01), 5
    rng, ratios = np.random.default_rng(8), {}
    for _ in range(150):
        truth = rng.normal(0, 5e-7, plate.shape)
        reversal = (
            rng.normal(reversal_m, spread_m, 11)
            if spread_m
            else np.full(11, reversal_m)
        )
        scatter = 8e-8 * (
            rng.uniform(0.5, 1.5, (2, 11)) if unlike else np.ones((2, 11))
        )
        u = np.full(plate.shape, 3e-8)
        emap = ErrorMap(
            plate, truth + rng.normal(0, u), 0 * truth, u, u, np.zeros(0), np.zeros(0)
        )
        repeats = {}
        for i in range(11):
            s = scatter[:, i] * np.sqrt(rng.chisquare(count - 1, 2) / (count - 1))
            noise = np.hypot(*scatter[:, i]) / np.sqrt(count)
            repeats[i - 5, 0] = Scatter(
                reversal[i] + rng.normal(0, noise),
                np.sqrt(2 / count),
                *s,
                count - 1,
                count - 1,
                0.0,
            )
        found = axis_figures(StageMap(result_of(emap)), 0, 0, repeats).figures
        mean = -truth[:, 5]
        true = bidirectional(mean - reversal / 2, mean + reversal / 2, *scatter)
        for name, figure in found.items():
            ratios.setdefault(name, []).append((figure.value - true[name]) / figure.u)
    for name, least in (
        ("B", 0.94),
        ("R", 0.94),
        ("A", 0.89),
        ("E", 0.89),
        ("M", 0.89),
    ):
        assert np.mean(np.abs(ratios[name]) < 2) > least, name
    assert np.sqrt(np.mean(np.square(ratios["B"]))) < 1.4


def test_what_scatters_far_beyond_its_noise_is_true():
    """Of 40 values that differ by 10 u nearly all is true; of equal ones nothing."""
    rng = np.random.default_rng(1)
    u = np.full(40, 0.1)
    values = 5.0 + rng.normal(0, 1.0, 40)
    centre, share = _true_shares(values, u, rng)
    assert share.mean() == pytest.approx(0.99, abs=0.005)
    assert centre.mean() == pytest.approx(values.mean(), abs=0.02)
    assert centre.std() == pytest.approx(1 / np.sqrt(40), rel=0.3)
    _, share = _true_shares(5.0 + rng.normal(0, 0.1, 40), u, rng)
    assert not share.any()


@pytest.mark.parametrize(
    ("run_id", "digest", "code"),
    [
        ("", "of another", 2),
        ("", None, 0),
        ("run of another", None, 0),
        ("", "own", 0),
        ("run of another", "own", 0),
    ],
)
def test_a_bag_whose_commands_name_no_run(
    tmp_path, monkeypatch, capsys, run_id, digest, code
):
    """Two recordings of no run were taken for one: "" is "" in both."""
    bag, path = tmp_path / "a.mcap", str(tmp_path / "r.json")
    Foreign().write(bag, events_of(small_plan()))
    measurements = replace(collect_bag(bag, CollectorSettings())[0], run_id="")
    monkeypatch.setattr(verb, "collect_bag", lambda *_: (measurements,))
    result = calibrate(measurements)
    digests = {"own": bag_input(bag)["sha256"], "of another": 64 * "0"}
    source = {} if digest is None else {"sha256": digests[digest]}
    result = replace(worded(result), run_id=run_id, input=source)
    write_json(path, result_to_dict(result))
    assert main(["iso230", str(bag), "--result", path, "--json"]) == code
    assert ("of another recording" in capsys.readouterr().err) == (code == 2)


def test_another_run_without_a_digest_is_another_recording(tmp_path, capsys):
    bag, path = str(ROOT / "bags/hu_noise"), str(tmp_path / "r.json")
    measurements = collect_bag(bag, CollectorSettings())[0]
    result = worded(calibrate(measurements))
    for run_id, code in ((measurements.run_id, 0), ("", 0), ("another", 2)):
        write_json(path, result_to_dict(replace(result, run_id=run_id, input={})))
        assert main(["iso230", bag, "--result", path, "--json"]) == code
