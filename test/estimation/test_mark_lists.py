# SPDX-License-Identifier: Apache-2.0
"""Calibration with a plate whose marks are a list: exact, as dense, as a lattice, covered by U."""

from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.errors import InputError, NotIdentifiableError
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.comparison.maps import compare
from selfcal_ros.estimation.joint.solve import fit_joint
from selfcal_ros.estimation.observability.plan_check import check_plan, predict_plan
from selfcal_ros.estimation.observability.rank import equivalent_key
from selfcal_ros.estimation.options import Options
from selfcal_ros.estimation.verdict.roughness import adequacy_of
from selfcal_ros.model.artifact import Artifact, Interpolation
from selfcal_ros.model.error_map import ThetaDatum
from selfcal_ros.model.readings import Measurements
from selfcal_ros.model.result import result_from_dict, result_to_dict
from selfcal_ros.model.view import Plan, View
from selfcal_ros.reporting.words.findings import worded
from test.support.mark_lists import lattice, rings, scatter
from test.support.placed import SIX, THREE, dense, error_in_datum, plate, readings
from test.support.refusals import in_words
from test.support.results import trusted

BARE = Options(assumed=())
LINEAR = Options(assumed=(), misalignment_model="linear")
COUNT = 8
HOLES = (0, 3, 17, 24, 25, 31, 40, 48)
PLATES = {
    "rings": rings,
    "scatter": scatter,
    "holes": lambda: lattice(7, HOLES),
    "even": lambda: lattice(8),
}


@pytest.mark.parametrize("how", ["bilinear", "bicubic"])
@pytest.mark.parametrize("name", PLATES)
def test_readings_without_noise_give_the_truth(name, how):
    """Stage and plate: the sign of each place, turn and shift matters."""
    artifact = PLATES[name]()
    artifact = replace(
        artifact, map_grid=replace(artifact.map_grid, interpolation=Interpolation(how))
    )
    found, truth = readings(artifact, SIX, np.random.default_rng(1), sigma=0.0)
    result = calibrate(found, BARE)
    assert result.error_map.valid.sum() >= 21
    assert np.nanmax(np.abs(error_in_datum(result.error_map, truth))) < 1e-11
    rest = result.artifact_map.ax + 1j * result.artifact_map.ay - truth.plate
    z = (artifact.x_m + 1j * artifact.y_m)[np.isfinite(rest)]
    # its place, turn and size are a convention
    columns = np.stack([np.ones_like(z), z], axis=1)
    left = rest[np.isfinite(rest)]
    assert (
        np.abs(left - columns @ np.linalg.lstsq(columns, left, rcond=None)[0]).max()
        < 1e-11
    )


@pytest.mark.parametrize("name", PLATES)
def test_the_dense_solution_is_the_same(name):
    """Map and uncertainty, from a matrix of all readings and unknowns, each mark by its id."""
    found, _ = readings(PLATES[name](), SIX, np.random.default_rng(1), linear=True)
    result = calibrate(found, LINEAR)
    known = result.error_map.valid
    field, u = (both[:, known] for both in dense(found, known))
    assert np.stack([result.error_map.gx, result.error_map.gy])[
        :, known
    ] == pytest.approx(field, abs=1e-13)
    lack = adequacy_of(fit_joint(found, LINEAR)).effect(result).xy[:, known]
    assert np.stack([result.error_map.u_gx, result.error_map.u_gy])[
        :, known
    ] == pytest.approx(np.hypot(u * result.noise.sigma_xy, lack), rel=1e-5)


def as_list(found: Measurements, artifact: Artifact) -> Measurements:
    """Return the readings of a lattice as those of the list of its marks."""
    half = found.artifact.half
    order = np.lexsort((artifact.y_m[:, 0].round(6), artifact.x_m[:, 0].round(6)))
    ids = artifact.m[order, 0].reshape(found.artifact.shape)
    views = tuple(
        replace(
            view, m=ids[view.m + half[0], view.n + half[1]], n=np.zeros_like(view.n)
        )
        for view in found.views
    )
    return replace(found, artifact=artifact, views=views)


def test_a_lattice_as_a_list_gives_the_same_numbers():
    """Map, plate, uncertainties, noise, verdict: to rounding."""
    one, _ = readings(plate(9, 5), SIX, np.random.default_rng(3))
    half = 4 * one.artifact.grid_pitch_m
    listed = lattice(9)
    scale = half / (max(listed.reach) * listed.grid_pitch_m)
    assert scale == pytest.approx(0.8)
    listed = replace(
        listed,
        map_grid=one.artifact.map_grid,
        marks=replace(
            listed.marks,
            x_m=tuple(scale * x for x in listed.marks.x_m),
            y_m=tuple(scale * y for y in listed.marks.y_m),
        ),
    )
    two = as_list(one, listed)
    a, b = calibrate(one), calibrate(two)
    for name in ("gx", "gy", "u_gx", "u_gy"):
        assert getattr(b.error_map, name) == pytest.approx(
            getattr(a.error_map, name), abs=1e-15
        )
    order = np.lexsort((listed.y_m[:, 0].round(6), listed.x_m[:, 0].round(6)))
    for name in ("ax", "ay", "u_ax", "u_ay"):
        assert getattr(b.artifact_map, name)[order, 0] == pytest.approx(
            getattr(a.artifact_map, name).ravel(), abs=1e-15
        )
    assert b.noise.sigma_xy == pytest.approx(a.noise.sigma_xy, rel=1e-9)
    assert b.observability.rank == a.observability.rank
    assert (b.verdict.grade, [c.name for c in b.verdict.causes]) == (
        a.verdict.grade,
        [c.name for c in a.verdict.causes],
    )
    assert b.artifact_map.magnification == pytest.approx(
        a.artifact_map.magnification, abs=1e-14
    )


@pytest.mark.parametrize("name", PLATES)
def test_errors_of_stage_and_plate_lie_in_u(name):
    """Mean square of error / u, and the part inside of U, over many sessions."""
    squares, inside, number, plates = 0.0, 0, 0, []
    for seed in range(COUNT):
        found, truth = readings(PLATES[name](), SIX, np.random.default_rng(seed))
        result = trusted(found, BARE)
        assert result.verdict.qualified
        known = result.error_map.valid
        z = error_in_datum(result.error_map, truth) / np.stack(
            [result.error_map.u_gx, result.error_map.u_gy]
        )
        squares += float((z[:, known] ** 2).sum())
        inside += int((np.abs(z[:, known]) < result.noise.k_xy).sum())
        number += 2 * int(known.sum())
        plates.append(_plate_z(result, truth))
    assert 0.85 < np.sqrt(squares / number) < 1.06
    assert 0.94 < inside / number < 0.985
    assert 0.85 < np.sqrt(np.nanmean(np.concatenate(plates) ** 2)) < 1.06


def _plate_z(result, truth) -> np.ndarray:
    """Return error / u of the plate's marks, in the datum that the least squares choose."""
    found, artifact = result.artifact_map, result.plate
    known = np.isfinite(found.ax + found.ay)
    rest = (found.ax + 1j * found.ay - truth.plate)[known]
    z = (artifact.x_m + 1j * artifact.y_m)[known]
    columns = np.stack([np.ones_like(z), z], axis=1)
    rest = rest - columns @ np.linalg.lstsq(columns, rest, rcond=None)[0]
    return np.concatenate(
        [rest.real / found.u_ax[known], rest.imag / found.u_ay[known]]
    )


def test_a_result_keeps_its_marks():
    """RESULT.json has ids and places; what is read back compares with itself only."""
    found, _ = readings(scatter(), SIX, np.random.default_rng(7))
    result = calibrate(found, BARE)
    data = result_to_dict(worded(result))
    assert data["artifact"]["marks"]["id"] == sorted(data["artifact"]["marks"]["id"])
    assert "grid_size" not in data["artifact"]
    again = result_from_dict(data, "RESULT.json")
    assert again.plate == found.artifact
    assert again.artifact_map.ax.shape == (80, 1)
    assert compare(result, again, plates=True).max_m == 0
    other = calibrate(readings(scatter(seed=4), SIX, np.random.default_rng(7))[0], BARE)
    with pytest.raises(InputError, match="lists of marks differ"):
        compare(result, other, plates=True)


def views_of(artifact: Artifact, poses) -> tuple[View, ...]:
    return tuple(
        View(
            f"v{i}",
            np.radians(turn),
            tuple(step * artifact.grid_pitch_m for step in shift),
            True,
            False,
        )
        for i, (turn, shift) in enumerate(poses)
    )


def test_a_plan_is_judged_as_the_dense_solution():
    """The prediction of `plan check` is u of unit noise."""
    artifact = scatter()
    plan = Plan("p", artifact, views_of(artifact, SIX))
    assert check_plan(plan).observability.identifiable
    found = predict_plan(plan, ThetaDatum.ZERO_MEAN)
    _, u = dense(readings(artifact, SIX, np.random.default_rng(0))[0])
    assert found.u_xy == pytest.approx(u, rel=1e-5)


@pytest.mark.parametrize(("nodes", "gain"), [(5, 0.6798), (7, 0.8200)])
def test_three_views_determine_a_lattice_of_even_sides(nodes, gain):
    """As docs/guides/identifiability.md says: 0, 90 deg and a shift by a pitch."""
    artifact = lattice(8, nodes=nodes)
    views = (
        View("0", 0.0),
        View("90", np.pi / 2),
        View("shift", 0.0, (artifact.grid_pitch_m, 0.0)),
    )
    plan = Plan("even", artifact, views)
    assert check_plan(plan).observability.identifiable
    assert predict_plan(plan, ThetaDatum.ZERO_MEAN).rms_xy == pytest.approx(
        gain, abs=1e-4
    )


@pytest.mark.parametrize("how", ["bilinear", "bicubic"])
@pytest.mark.parametrize("poses", [THREE, SIX])
def test_three_nodes_a_side_are_determined_as_the_dense_solution_says(how, poses):
    """Only one of them lies in the core of the plate: the datum is that of all."""
    artifact = lattice(4, nodes=3, interpolation=how)
    plan = Plan("p", artifact, views_of(artifact, poses))
    assert check_plan(plan).observability.identifiable
    found = predict_plan(plan, ThetaDatum.ZERO_MEAN)
    _, u = dense(readings(artifact, poses, np.random.default_rng(0))[0])
    assert found.u_xy == pytest.approx(u, rel=1e-5)


@pytest.mark.parametrize(
    "poses",
    [THREE[:1], ((0, (0, 0)), (90, (0, 0))), ((0, (0, 0)), (180, (0, 0)), (0, (1, 0)))],
)
def test_three_nodes_a_side_are_not_determined_by_turns_or_shifts_alone(poses):
    artifact = lattice(4, nodes=3)
    assert not check_plan(
        Plan("p", artifact, views_of(artifact, poses))
    ).observability.identifiable


def test_a_plan_that_shows_too_little_is_refused():
    artifact = scatter()
    found, _ = readings(artifact, THREE[:1], np.random.default_rng(0))
    with pytest.raises(NotIdentifiableError, match="do not identify"):
        calibrate(found, BARE)
    seen = check_plan(Plan("p", artifact, views_of(artifact, THREE[:1]))).observability
    assert not seen.identifiable and any(
        "mm along X" in text for text in in_words(seen.advice)
    )


def test_no_turn_makes_plans_of_a_list_equal():
    """A lattice looks the same after a quarter turn, scattered marks do not."""
    keys = [
        [
            equivalent_key(artifact, views_of(artifact, [(0, (0, 0)), (turn, (0, 0))]))
            for turn in (90, 270)
        ]
        for artifact in (scatter(), plate(9, 5))
    ]
    assert keys[0][0] != keys[0][1] and keys[1][0] == keys[1][1]
