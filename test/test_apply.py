# SPDX-License-Identifier: Apache-2.0
"""A calibrated stage in a program of one's own: commands, inverse, covariance of points."""

import runpy
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from selfcal_ros import apply
from selfcal_ros.apply import StageMap, load
from selfcal_ros.errors import ExitCode, InputError, NotIdentifiableError
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.comparison.covariance import covariance_of, first_order_u
from selfcal_ros.estimation.options import Options
from selfcal_ros.estimation.verdict.uncertainty import Effect, enlarged
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.kept import NOISE, ROUGHNESS
from selfcal_ros.model.result import result_to_dict
from selfcal_ros.outputs import write_json
from selfcal_ros.reporting.words.findings import worded
from test.support.maps import random_map, result_of
from test.support.placed import SIX, plate, readings, rows
from test.support.sessions import collected, events_of, small_plan

EXAMPLE = Path(__file__).parents[1] / "examples/correct.py"


@pytest.fixture(scope="module")
def result():
    """A calibration of 5 x 5 marks, 10 mm apart."""
    return worded(calibrate(collected(events_of(small_plan("0, 90, 180, tx")))[1]))


@pytest.fixture(scope="module")
def file(result, tmp_path_factory):
    path = tmp_path_factory.mktemp("map") / "R.json"
    write_json(path, result_to_dict(result))
    return str(path)


def test_the_command_is_plus_the_error_and_correct_is_its_inverse(file, result):
    stage, pitch = load(file), result.artifact.grid_pitch_m
    x, y = stage.command(pitch, -2 * pitch)
    assert float(x) == pitch + result.error_map.gx[3, 0] and abs(x - pitch) > 1e-9
    assert float(y) == -2 * pitch + result.error_map.gy[3, 0]
    np.testing.assert_allclose(
        stage.correct(x, y), (pitch, -2 * pitch), rtol=0, atol=1e-15
    )


def test_at_the_nodes_the_covariance_has_the_variances_of_the_map(file, result):
    emap, plate = result.error_map, result.artifact
    found = load(file).covariance(plate.x_m, plate.y_m)
    np.testing.assert_allclose(
        np.sqrt(np.diag(found)), [*emap.u_gx.ravel(), *emap.u_gy.ravel()], rtol=1e-9
    )
    np.testing.assert_allclose(
        found, covariance_of(result, "xy", emap.valid), rtol=0, atol=1e-9 * found.max()
    )


def test_between_the_nodes_it_is_that_of_the_interpolated_error(file, result):
    """Against draws of the whole map, each interpolated by the compensator itself."""
    emap, plate = result.error_map, result.artifact
    full = covariance_of(result, "xy", emap.valid)
    rng = np.random.default_rng(1)
    draws = rng.multivariate_normal(np.zeros(len(full)), full, 20_000, method="eigh")
    pitch = plate.grid_pitch_m
    x, y = (
        np.array([0.3, -1.9, 2.0, 0.0]) * pitch,
        np.array([0.8, 1.2, -0.5, 2.0]) * pitch,
    )
    basis = []
    for unit in np.eye(len(full)):  # the compensator is linear in the sites
        gx, gy = unit.reshape(2, *plate.shape) * 1e-9
        basis.append(
            np.concatenate(StageMap(result_of(replace(emap, gx=gx, gy=gy))).error(x, y))
            / 1e-9
        )
    wanted = np.cov((draws @ np.array(basis)).T)
    stage = load(file)
    stage.halfway = np.zeros((2, 2))  # a stage that is bilinear between its nodes
    found = stage.covariance(x, y)
    np.testing.assert_allclose(found, wanted, rtol=0, atol=0.05 * found.max())
    assert (
        np.sqrt(np.diag(found)) <= (1 + 1e-9) * np.concatenate(stage.uncertainty(x, y))
    ).all()  # the bound of `uncertainty` holds


def test_interpolation_adds_its_error_between_the_nodes(file, result):
    """Nothing at a node, on an edge that along it, in the middle of a cell both."""
    stage, pitch = load(file), result.artifact.grid_pitch_m
    stage.halfway = np.zeros((2, 2))
    x, y = (
        np.array([0.0, 0.5, 0.5, 0.75, 0.5, 2.0]) * pitch,
        np.array([1.0, 1.0, 0.5, 1.5, -0.5, 0.5]) * pitch,
    )
    plain, before = stage.covariance(x, y), stage.uncertainty(x, y)
    stage.halfway = np.array([[3e-8, 3e-8], [0.0, 5e-8]])
    both = np.sqrt(2)
    added = (
        np.array(
            [[0, 3, 3 * both, 3 * np.hypot(0.75, 1), 3 * both, 3], [0, 0, 5, 5, 5, 5]]
        )
        * 1e-8
    )
    np.testing.assert_allclose(stage.uncertainty(x, y), np.hypot(before, added))
    # (0.5, 1) is in the cell of y = 1..2
    cells = [[a == b for a in "ABCBDE"] for b in "ABCBDE"]
    wanted = (
        plain
        + np.kron([[1, 0], [0, 0]], np.outer(added[0], added[0]) * cells)
        + np.kron([[0, 0], [0, 1]], np.outer(added[1], added[1]) * cells)
    )
    np.testing.assert_allclose(stage.covariance(x, y), wanted, atol=1e-22)


def test_neighbours_share_their_uncertainty(file, result):
    stage, pitch = load(file), result.artifact.grid_pitch_m
    x, y = np.array([0.4, 0.6]) * pitch, np.zeros(2)
    cover = stage.covariance(x, y)
    along = np.array([-1, 1, 0, 0])
    assert along @ cover @ along < 0.5 * (cover[0, 0] + cover[1, 1])


def test_the_error_of_a_distance_is_that_of_its_ends(file, result):
    emap, plate = result.error_map, result.artifact
    (x1, y1), (x2, y2) = ((plate.x_m[i], plate.y_m[i]) for i in ((1, 1), (4, 2)))
    error, u = load(file).length_error((x1, y1), (x2, y2))
    d = np.array([x2 - x1, y2 - y1])
    g = np.array([field[4, 2] - field[1, 1] for field in (emap.gx, emap.gy)])
    assert (
        error == pytest.approx([d @ g / np.hypot(*d)], abs=1e-11)
        and abs(error[0]) > 1e-8
    )
    full, known = (
        covariance_of(result, "xy", emap.valid),
        np.zeros((2, 2, *plate.shape)),
    )
    for axis in (0, 1):
        known[axis, axis, 4, 2], known[axis, axis, 1, 1] = 1, -1
    row = (d / np.hypot(*d)) @ known.reshape(2, -1)
    assert u == pytest.approx([np.sqrt(row @ full @ row)], rel=1e-9)


def test_what_residuals_have_beyond_repeats_is_met_at_both_ends_of_a_distance():
    """An encoder that errs by 30 nm in each 20 um errs anew at each place."""

    def encoder(z):
        x, y = 30e-9 * np.sin(2 * np.pi * np.stack([z.real, z.imag]) / 20e-6)
        return x + 1j * y

    inside, u_over_lack = [], []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        measurements, _ = readings(plate(11, 7), SIX, rng, sigma=9e-9, stage=encoder)
        repeated = [
            replace(view, count=view.count * 5, sigma_xy=20e-9, dof_xy=8 * len(view.m))
            for view in measurements.views
        ]
        stage = StageMap(
            calibrate(replace(measurements, views=tuple(repeated)), Options())
        )
        lack = max(part.u_max for part in stage.result.verdict.enlarged_by)
        ends = rng.uniform(-0.03, 0.03, (2, 2, 400))
        error, u = stage.length_error(*ends)
        true = encoder(ends[1, 0] + 1j * ends[1, 1]) - encoder(
            ends[0, 0] + 1j * ends[0, 1]
        )
        along = (ends[1] - ends[0]) / np.hypot(*(ends[1] - ends[0]))
        left = error - along[0] * true.real - along[1] * true.imag
        inside.append((abs(left) < stage.result.noise.k_xy * u).mean())
        u_over_lack.append(np.median(u) / lack)
    assert min(inside) > 0.9
    assert np.median(u_over_lack) == pytest.approx(np.sqrt(2), rel=0.2)


def test_more_noise_scales_u_of_distances_and_of_squareness_as_at_the_nodes(result):
    """A noisy view is more of the same noise: it moves no two places together."""
    nothing = np.zeros(len(result.error_map.g_theta))
    u_plate = np.stack([result.artifact_map.u_ax, result.artifact_map.u_ay])
    noisier = enlarged(
        result,
        [Effect(NOISE, np.sqrt(3) * result.error_map.u_xy, nothing, 3**0.5 * u_plate)],
    )
    ends = (-0.02, 0.01), (0.01, -0.01)
    before, after = (StageMap(r).length_error(*ends)[1] for r in (result, noisier))
    np.testing.assert_allclose(after, 2 * before, rtol=1e-5)
    np.testing.assert_allclose(
        first_order_u(noisier), 2 * np.array(first_order_u(result)), rtol=1e-5
    )
    known = np.ones(result.artifact.shape, dtype=bool)
    for of_plate in (False, True):
        covers = [
            covariance_of(r, "xy", known, plate=of_plate) for r in (result, noisier)
        ]
        np.testing.assert_allclose(
            covers[1], 4 * covers[0], rtol=1e-4, atol=1e-5 * covers[0].max()
        )


def test_what_the_nodes_do_not_follow_is_met_at_both_ends_of_a_distance(result):
    """Also at two nodes to which its effect gives the same sign."""
    rough_m = np.broadcast_to(3e-8, (2, *result.artifact.shape))
    nothing = np.zeros(len(result.error_map.g_theta))
    rough = enlarged(result, [Effect(ROUGHNESS, rough_m, nothing)])
    for ends in (((-0.02, 0.0), (0.02, 0.0)), ((-0.01, 0.01), (0.01, -0.01))):
        before, after = (StageMap(r).length_error(*ends)[1] for r in (result, rough))
        assert np.sqrt(after**2 - before**2) == pytest.approx(np.sqrt(2) * 3e-8)


def test_a_line_over_the_length_covers_every_distance_of_the_field(file, result):
    stage, plate = load(file), result.artifact
    a, b = stage.length_uncertainty(anywhere=False)
    i, j = np.triu_indices(25, 1)
    x, y = plate.x_m.ravel(), plate.y_m.ravel()
    length = np.hypot(x[j] - x[i], y[j] - y[i])
    U = result.noise.k_xy * stage.length_error((x[i], y[i]), (x[j], y[j]))[1]
    margin = a + b * length - U
    assert margin.min() > -1e-7 * U.max() and margin.min() < 1e-3 * U.max()
    assert a > 0 <= b and a + b * length.max() < 2 * U.max()


def test_the_line_is_that_of_the_diagonals_if_x_and_y_err_alike(
    file, result, monkeypatch
):
    """Of sites with one error of sigma along both axes, diagonal distances have u = 2 sigma."""
    monkeypatch.setattr(
        StageMap,
        "covariance",
        lambda self, x, y: 1e-16 * np.kron(np.ones((2, 2)), np.eye(len(x))),
    )
    a, b = load(file).length_uncertainty(anywhere=False)
    assert a == pytest.approx(2e-8 * result.noise.k_xy, rel=1e-6) and abs(b) < 1e-12


def test_no_other_line_over_all_distances_is_lower_on_average(
    file, result, monkeypatch
):
    """With an error of the scale, U grows with the distance."""
    monkeypatch.setattr(
        StageMap,
        "covariance",
        lambda self, x, y: (
            1e-16 * np.eye(2 * len(x))
            + 1e-12 * np.outer(np.append(x, y), np.append(x, y))
        ),
    )
    stage, plate = load(file), result.artifact
    i, j = np.triu_indices(25, 1)
    x, y = plate.x_m.ravel(), plate.y_m.ravel()
    length = np.hypot(x[j] - x[i], y[j] - y[i])
    U = result.noise.k_xy * stage.length_error((x[i], y[i]), (x[j], y[j]))[1]
    a, b = stage.length_uncertainty(anywhere=False)
    assert b > 1e-7
    for slope in np.linspace(0, 3 * b, 31):
        above = (U - slope * length).max() + slope * length.mean()
        assert above > (a + b * length.mean()) * (1 - 1e-6)


def test_between_nodes_the_line_covers_the_interpolation_too(file, result):
    stage, plate, rng = load(file), result.artifact, np.random.default_rng(4)
    ends = rng.uniform(-2, 2, (4, 400)) * plate.grid_pitch_m
    ends[:, :50] = (
        np.floor(ends[:, :50] / plate.grid_pitch_m) + 0.5
    ) * plate.grid_pitch_m
    ends = ends[:, np.hypot(*(ends[:2] - ends[2:])) > 0]
    a, b = stage.length_uncertainty()
    U = result.noise.k_xy * stage.length_error(ends[:2], ends[2:])[1]
    margin = a + b * np.hypot(*(ends[:2] - ends[2:])) - U
    assert -0.01 * U.max() < margin.min() < 0.2 * U.max()
    assert a > 1.5 * stage.length_uncertainty(anywhere=False)[0]


def test_many_distances_are_evaluated_in_parts(file, monkeypatch):
    rng = np.random.default_rng(2)
    ends = rng.uniform(-0.02, 0.02, (4, 40))
    whole = load(file).length_error(ends[:2], ends[2:])
    monkeypatch.setattr(apply, "MAX_POINTS", 14)
    np.testing.assert_allclose(
        load(file).length_error(ends[:2], ends[2:]), whole, rtol=1e-9
    )
    with pytest.raises(InputError, match="its ends coincide"):
        load(file).length_error((0.0, 0.0), (0.0, 0.0))


def test_what_has_no_covariance_is_refused(file, monkeypatch):
    stage = load(file)
    with pytest.raises(InputError, match="a position is not a number"):
        stage.covariance([np.nan, 0.0], 0.0)
    monkeypatch.setattr(apply, "MAX_POINTS", 3)
    with pytest.raises(InputError, match="4 points; give at most 3"):
        stage.covariance(np.zeros(4), 0.0)
    with pytest.raises(InputError, match="does not contain the correlations"):
        StageMap(result_of(random_map(Artifact(5, 0.01), 1))).covariance(0.0, 0.0)
    holed = StageMap(result_of(random_map(Artifact(5, 0.01), 1, unknown=((2, 2),))))
    with pytest.raises(InputError, match="next to an unknown site"):
        holed.covariance(0.001, 0.0)
    with pytest.raises(InputError, match="outside the calibrated field"):
        stage.covariance(1.0, 0.0)


def test_a_map_that_is_not_identified_is_no_stage(result):
    unseen = replace(
        result, observability=replace(result.observability, identifiable=False)
    )
    with pytest.raises(NotIdentifiableError) as raised:
        StageMap(unseen)
    assert raised.value.exit_code is ExitCode.NOT_IDENTIFIABLE


def test_the_example_runs(file, capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", [str(EXAMPLE), file])
    runpy.run_path(str(EXAMPLE), run_name="__main__")
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 6 and lines[3] in [
        f"and back: off by at most {e} m"
        for e in ("0e+00", "2e-18", "3e-18", "4e-18", "5e-18")
    ]
    assert lines[4].startswith("distance 0.025000 m is indicated ")
    assert lines[5].startswith("mean error in x ")


@pytest.mark.parametrize(("nodes", "method"), [(7, "bicubic"), (9, "bilinear")])
def test_a_map_with_nodes_of_its_own_is_applied_by_its_interpolation(nodes, method):
    """Bilinear where nodes are unknown: those of nine lie partly beyond the plate."""
    artifact = plate(11, 7)
    artifact = replace(artifact, map_grid=replace(artifact.map_grid, size=nodes))
    found, _ = readings(artifact, SIX, np.random.default_rng(3))
    result = calibrate(found, Options(assumed=()))
    stage = StageMap(result)
    assert stage.method == method and result.error_map.valid.all() == (nodes == 7)
    if nodes == 7:
        place = np.array([0.0123 - 0.031j])
        wanted = (
            rows(artifact, place)
            @ (result.error_map.gx + 1j * result.error_map.gy).ravel()
        )
        x, y = stage.command(place.real, place.imag)
        assert complex(x[0], y[0]) - place[0] == pytest.approx(wanted[0], abs=1e-15)
        return
    holes = result.artifact.x_m[~result.error_map.valid]
    far = ([0.0, holes[0]], [0.0, result.artifact.y_m[~result.error_map.valid][0]])
    error, u = stage.length_error(([0.01, 0.01], [0.0, 0.0]), far)
    assert np.isfinite(error[0]) and u[0] > 0
    assert np.isnan(error[1]) and np.isnan(u[1])
    assert stage.length_uncertainty()[0] > stage.length_uncertainty(anywhere=False)[0]


def test_of_a_map_with_nodes_of_its_own_the_line_meets_the_largest_distance():
    nodes, artifact = 5, plate(11, 5)
    found, _ = readings(artifact, SIX, np.random.default_rng(3))
    result = calibrate(found, Options(assumed=()))
    stage = StageMap(result)
    assert stage.method == "bicubic" and result.reads_between_nodes
    a, b = stage.length_uncertainty()
    half_m = (nodes - 1) / 2 * artifact.map_grid.pitch_m
    halves_m = np.array(np.meshgrid(*[np.linspace(-half_m, half_m, 2 * nodes - 1)] * 2))
    i, j = np.triu_indices((2 * nodes - 1) ** 2, 1)
    pairs = halves_m.reshape(2, -1)[:, [i, j]].swapaxes(0, 1).reshape(4, -1)
    ends = np.hstack(
        [pairs, np.random.default_rng(4).uniform(-half_m, half_m, (4, 1000))]
    )
    _, u = stage.length_error(ends[:2], ends[2:])
    U = result.noise.k_xy * u
    margin = a + b * np.hypot(*(ends[:2] - ends[2:])) - U
    assert -0.02 * np.nanmax(U) < np.nanmin(margin) < 0.1 * np.nanmax(U)


def stage_of(plate, covariance, monkeypatch, halfway=((0, 0), (0, 0))):
    """Return a stage whose sites have this covariance of Gx, then Gy."""
    monkeypatch.setattr(
        "selfcal_ros.apply.covariance_of",
        lambda _, kind, used: covariance[np.ix_(*[np.tile(used.ravel(), 2)] * 2)],
    )
    stage = StageMap(result_of(random_map(plate, 1)))
    stage.halfway = np.array(halfway, dtype=float)
    return stage


def test_u_of_distances_is_a_bound_of_all_pairs_that_one_of_them_meets(monkeypatch):
    """With x and y correlated, so that one diagonal is worse than the other."""
    plate = Artifact(3, 0.01, 0, 5)
    mix = np.random.default_rng(3).normal(size=(30, 30)) * 1e-9
    mix[15:] += 2 * mix[:15]
    stage = stage_of(plate, mix @ mix.T, monkeypatch)
    a, b = stage.length_uncertainty()
    i, j = np.triu_indices(15, 1)
    x, y = plate.x_m.ravel(), plate.y_m.ravel()
    _, u = stage.length_error((x[i], y[i]), (x[j], y[j]))
    slack = a + b * np.hypot(x[j] - x[i], y[j] - y[i]) - stage.result.noise.k_xy * u
    assert slack.min() == pytest.approx(0, abs=1e-13)


@pytest.mark.parametrize(("size", "node", "anywhere"), [(9, 10, True), (26, -1, False)])
def test_the_line_covers_the_distances_of_the_worst_node(
    monkeypatch, size, node, anywhere
):
    """Beside a corner, and the corner of an even field: both were passed over."""
    variance = np.full((2, size**2), 1e-18)
    variance[:, node] = 1e-16
    stage = stage_of(Artifact(size, 0.01), np.diag(variance.ravel()), monkeypatch)
    a, b = stage.length_uncertainty(anywhere=anywhere)
    U = stage.result.noise.k_xy * np.sqrt(101e-18)
    assert a + b * 0.01 >= U * (1 - 1e-9)


def test_a_distance_anywhere_has_the_interpolation_of_its_own_direction(monkeypatch):
    """Gx is 8 nm off halfway, Gy nothing: along y the distance is as between nodes."""
    plate = Artifact(3, 0.01, 0, 3)
    for row in (0, 1):
        halfway = np.zeros((2, 2))
        halfway[row, 0] = 8e-9
        stage = stage_of(
            plate, np.diag(np.repeat([1e-18, 9e-18], 9)), monkeypatch, halfway
        )
        a, b = stage.length_uncertainty()
        # from halfway to halfway, which along x share the middle one of the three nodes
        worst = np.sqrt((1 / 2 if row == 0 else 9) + 2 * 64) * 1e-9
        assert a + b * 0.01 == pytest.approx(stage.result.noise.k_xy * worst, rel=1e-6)


def test_a_distance_anywhere_may_end_in_the_cell_at_an_edge(monkeypatch):
    plate = Artifact(3, 0.01, 0, 3)
    stage = stage_of(plate, np.diag(np.full(18, 1e-18)), monkeypatch)
    stage.edges = np.zeros((2, 2, 2))
    inside = stage.length_uncertainty()
    stage.edges[1, 0, 1] = 8e-9  # of Gy along x
    a, b = stage.length_uncertainty()
    assert a + b * 0.01 == pytest.approx(stage.result.noise.k_xy * np.sqrt(129) * 1e-9)
    assert a + b * 0.01 > 5 * (inside[0] + inside[1] * 0.01)
    assert stage.length_uncertainty(anywhere=False) == pytest.approx(inside)


def test_cells_of_an_oblong_field_share_no_error_of_interpolation(monkeypatch):
    """Five nodes along x, nine along y: the last two cells of y are different ones."""
    plate = Artifact(5, 0.01, 0, 9)
    stage = stage_of(plate, np.zeros((90, 90)), monkeypatch, [[0, 5e-9], [0, 5e-9]])
    found = stage.covariance([0.0, 0.0, 0.0], [0.035, 0.025, 0.0251])
    assert found[0, 0] > 0 and found[0, 1] == 0 and found[1, 2] > 0


@pytest.mark.parametrize("plate", [Artifact(3, 0.01, 0, 7), Artifact(7, 0.01, 0, 3)])
def test_inside_an_oblong_field(plate):
    stage = StageMap(result_of(random_map(plate, 1)))
    hx, hy = (half * 0.01 for half in plate.half)
    np.testing.assert_array_equal(
        stage.inside([hx, 0, hx + 1e-4, 0], [0, hy, 0, hy + 1e-4]),
        [True, True, False, False],
    )


def test_u_of_distances_is_their_error_on_a_map_with_nodes_of_its_own():
    """20 sessions against the truth: rows of the bilinear map instead give 1.2 for 1."""
    artifact, ratios = plate(11, 7), []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        found, truth = readings(artifact, SIX, rng)
        stage = StageMap(calibrate(found, Options(assumed=())))
        first, second = rng.uniform(-0.05, 0.05, (2, 2, 100))
        error, u = stage.length_error(first, second)
        nodes = truth.field.ravel()
        moved = [
            place + rows(artifact, place) @ nodes
            for place in (end[0] + 1j * end[1] for end in (first, second))
        ]
        true_error = abs(moved[1] - moved[0]) - np.hypot(*(second - first))
        ratios.append((error - true_error) / u)
    assert np.sqrt(np.mean(np.square(ratios))) == pytest.approx(0.98, abs=0.07)
    assert np.mean(np.abs(ratios) < 2) == pytest.approx(0.954, abs=0.025)


def test_the_notebook_runs_and_finds_the_days_alike(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    runpy.run_path(str(EXAMPLE.parent / "explore.py"))
    said = capsys.readouterr().out
    assert "<StageMap small: Good: " in said and "significant: False" in said
    assert (tmp_path / "day_1.png").read_bytes().startswith(b"\x89PNG")


def test_a_notebook_shows_the_picture_and_text_shows_the_state(result):
    stage = StageMap(result)
    assert repr(stage).startswith(f"<StageMap {result.plan_id}: Good: error up to ")
    page = stage._repr_html_()
    assert page.startswith("<div") and page.count("<svg") == 1 and 'fill="#' in page


def test_two_maps_differ_as_diff_says(result):
    changed = result.error_map.gx.copy()
    changed[1, 2] += 4e-7
    other = replace(result, error_map=replace(result.error_map, gx=changed))
    found = StageMap(result).difference(StageMap(other))
    assert found.dx[1, 2] == pytest.approx(4e-7, rel=0.1) and found.significant


@pytest.mark.parametrize("name", ["dataframe", "xarray"])
def test_without_the_library_one_line_says_so(result, name, monkeypatch):
    library = {"dataframe": "pandas", "xarray": "xarray"}[name]
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(
        InputError, match=f"^{library}: not installed; pip install {library}$"
    ):
        getattr(StageMap(result), f"to_{name}")()


def test_a_data_frame_has_each_node_at_its_place(result):
    pytest.importorskip("pandas")
    table = StageMap(result).to_dataframe().set_index(["x", "y"])
    plate, emap = result.artifact, result.error_map
    row = table.loc[(plate.x_m[3, 0], plate.y_m[3, 0])]
    assert (row.gx, row.u_gy) == (emap.gx[3, 0], emap.u_gy[3, 0]) and len(
        table
    ) == emap.gx.size


def test_a_data_set_has_the_maps_over_their_places(result):
    pytest.importorskip("xarray")
    maps, emap, plate = StageMap(result).to_xarray(), result.error_map, result.artifact
    assert float(maps.gy.sel(x=plate.x_m[3, 0], y=plate.y_m[3, 0])) == emap.gy[3, 0]
    assert float(maps.theta[3]) == pytest.approx(3 * 2 * np.pi / plate.angular_count)
    assert float(maps.g_theta[3]) == emap.g_theta[3] and maps.attrs["grade"] == "good"
