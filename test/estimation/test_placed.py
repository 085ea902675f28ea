# SPDX-License-Identifier: Apache-2.0
"""Calibration from views at any pose: exact, as dense, as the lattice, and covered by U."""

from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.apply import StageMap
from selfcal_ros.errors import InputError, NotIdentifiableError
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.joint.solve import fit_joint, prepare
from selfcal_ros.estimation.options import Options
from selfcal_ros.estimation.verdict.roughness import adequacy_of, known_places
from selfcal_ros.model.artifact import Interpolation, MapGrid
from selfcal_ros.model.findings import RoughnessUntested
from selfcal_ros.model.plan_form import plan_from_dict
from selfcal_ros.model.plate_form import with_nodes
from selfcal_ros.model.readings import Sense, subset
from selfcal_ros.model.result import result_from_dict, result_to_dict
from selfcal_ros.model.view import View, reads_between_nodes
from selfcal_ros.reporting.words.findings import worded
from selfcal_ros.simulation.machine import Spread, random_truth
from test.support.placed import (
    PITCH_M,
    SIX,
    THREE,
    dense,
    error_in_datum,
    plate,
    readings,
)
from test.support.results import trusted
from test.support.truth import simulate_measurements

BARE = Options(assumed=())
LINEAR = Options(assumed=(), misalignment_model="linear")
COUNT = 5


@pytest.mark.parametrize("how", ["bilinear", "bicubic"])
def test_readings_without_noise_give_the_truth(how):
    """Finite rotations included: the sign of each turn and shift matters to every node."""
    found, truth = readings(plate(11, 7, how), SIX, np.random.default_rng(1), sigma=0.0)
    emap = calibrate(found, BARE).error_map
    assert emap.valid.all()
    assert np.abs(error_in_datum(emap, truth)).max() < 1e-14


def test_the_dense_solution_is_the_same():
    """Map and uncertainty, from a matrix of all readings and unknowns."""
    found, _ = readings(plate(7, 5), SIX, np.random.default_rng(2), linear=True)
    result = calibrate(found, LINEAR)
    field, u = dense(found)
    assert np.stack([result.error_map.gx, result.error_map.gy]) == pytest.approx(
        field, abs=1e-15
    )
    lack = adequacy_of(fit_joint(found, LINEAR)).effect(result).xy
    assert np.stack([result.error_map.u_gx, result.error_map.u_gy]) == pytest.approx(
        np.hypot(u * result.noise.sigma_xy, lack), rel=1e-6
    )


def test_on_the_lattice_the_map_is_that_of_the_lattice():
    """The same readings, the map's grid that of the plate: the other solver's map and u."""
    poses = ((0, (0, 0)), (90, (0, 0)), (0, (1, 0)), (180, (0, 1)))
    placed, _ = readings(plate(7, 7), poses, np.random.default_rng(3))
    one = calibrate(placed, BARE).error_map
    other = calibrate(
        replace(placed, artifact=replace(placed.artifact, map_grid=None)), BARE
    ).error_map
    assert one.gx == pytest.approx(other.gx, abs=1e-14)
    assert one.gy == pytest.approx(other.gy, abs=1e-14)
    assert one.u_gx == pytest.approx(other.u_gx, rel=1e-6)


def test_what_moves_turns_the_map():
    """The plate moves: G(X) = -H(-X), nodes and all."""
    found, _ = readings(plate(11, 7), SIX, np.random.default_rng(4))
    plain = replace(BARE, causes=False)
    stage = calibrate(found, plain).error_map
    moved = calibrate(replace(found, sense=Sense.PLATE_MOVES), plain).error_map
    assert moved.gx == pytest.approx(-stage.gx[::-1, ::-1], abs=1e-18)


@pytest.mark.parametrize(
    ("poses", "how"), [(SIX, "bicubic"), (SIX, "bilinear"), (THREE, "bicubic")]
)
def test_errors_lie_in_u(poses, how):
    """z of all nodes over many sessions, and the part inside of U.

    The lack of fit of a map that suffices is an estimate of zero, and never below it: z is
    somewhat less than 1.
    """
    squares, inside, number = 0.0, 0, 0
    for seed in range(COUNT):
        found, truth = readings(plate(11, 7, how), poses, np.random.default_rng(seed))
        result = trusted(found, BARE)
        assert result.verdict.qualified
        known = result.error_map.valid
        z = error_in_datum(result.error_map, truth) / np.stack(
            [result.error_map.u_gx, result.error_map.u_gy]
        )
        squares += float((z[:, known] ** 2).sum())
        inside += int((np.abs(z[:, known]) < result.noise.k_xy).sum())
        number += 2 * int(known.sum())
    assert 0.85 < np.sqrt(squares / number) < 1.05
    assert 0.94 < inside / number < 0.985


@pytest.mark.parametrize(
    "poses", [((0, (0, 0)), (37, (0, 0))), ((0, (0, 0)), (180, (1.3, 0.4)))]
)
def test_turns_alone_and_half_turns_are_refused(poses):
    found, _ = readings(plate(11, 7), poses, np.random.default_rng(5))
    with pytest.raises(NotIdentifiableError, match="do not identify"):
        calibrate(found, BARE)


def test_nodes_that_no_reading_tells_are_unknown():
    """A map larger than what the plate covers: the nodes outside are NaN, those inside exact."""
    artifact = plate(11, 7)
    wide = replace(artifact, map_grid=replace(artifact.map_grid, size=9))
    found, truth = readings(wide, SIX, np.random.default_rng(6), sigma=0.0)
    emap = calibrate(found, BARE).error_map
    assert not emap.valid[0, 0] and emap.valid[2:7, 2:7].all()
    assert np.nanmax(np.abs(error_in_datum(emap, truth))) < 1e-11


@pytest.mark.parametrize(
    ("turn", "shift", "nodes", "count"),
    [
        (5, (1, 0), 9, 45),
        (5, (1, 0), 7, 27),
        (37, (1, 0), 9, 81),
        (37, (1.3, -0.7), 7, 43),
        (37, (1.3, -0.7), 9, 69),
    ],
)
def test_nodes_are_known_by_their_uncertainty_in_the_datum_of_the_known_ones(
    turn, shift, nodes, count
):
    """As a dense least squares has it, at nodes of the datum and at others; half of them do."""
    found, _ = readings(
        plate(11, nodes),
        ((0, (0, 0)), (turn, (0, 0)), (0, shift)),
        np.random.default_rng(10),
    )
    half = (nodes - 1) / 2
    known = np.abs(np.indices((nodes, nodes)) - half).max(axis=0) < 0.7499 * half
    for _ in range(2):
        known = dense(found, known)[1].max(axis=0) < 3
    assert known.sum() == count
    emap = calibrate(found, LINEAR).error_map
    assert np.array_equal(emap.valid, known)


def test_a_map_whose_middle_is_not_read_is_known_around_it():
    """By the dense solution in their datum; u of the others is beyond the noise of 3 readings."""
    found, _ = readings(
        plate(9, 7, "bilinear"), SIX, np.random.default_rng(1), linear=True
    )
    views = []
    for view in found.views:
        at = (
            view.view.pose.places(found.artifact, view.m, view.n)
            / found.artifact.grid_pitch_m
        )
        outside = np.maximum(np.abs(at.real), np.abs(at.imag)) > 2.5
        views.append(subset(view, outside, np.zeros(0, dtype=bool)))
    found = replace(found, views=tuple(views))
    result = calibrate(found, replace(LINEAR, causes=False, at_places=False))
    emap = result.error_map
    field, u = dense(found, emap.valid)
    np.testing.assert_array_equal(emap.valid, u.max(axis=0) < 3)
    assert not emap.valid[2:5, 2:5].any() and emap.valid.sum() == 40
    assert emap.gx[emap.valid] == pytest.approx(field[0][emap.valid], abs=1e-13)


def test_a_result_keeps_plate_and_map_apart():
    """RESULT.json has the plate, its error, and the grid of the map; both are read back."""
    found, _ = readings(plate(11, 7), SIX, np.random.default_rng(7))
    result = calibrate(found, BARE)
    data = result_to_dict(worded(result))
    assert data["map"] == {
        "grid_size": 7,
        "grid_pitch": pytest.approx(1 / 60),
        "interpolation": "bicubic",
    }
    again = result_from_dict(data, "RESULT.json")
    assert again.plate == found.artifact and again.artifact == found.artifact.field
    assert again.plate.map_grid == MapGrid(7, 0.1 / 6, Interpolation.BICUBIC)
    assert again.artifact_map.ax.shape == (11, 11) and again.error_map.gx.shape == (
        7,
        7,
    )


def waves(rng, length):
    """Return a stage error that varies over `length` pitches, 1 um: smooth, and no spline."""
    k, at = (
        rng.normal(size=(2, 150, 2)) / length / 10e-3,
        rng.uniform(0, 2 * np.pi, (2, 150)),
    )

    def stage(z):
        x, y = (
            np.cos(
                np.multiply.outer(z.real, along)
                + np.multiply.outer(z.imag, across)
                + start
            ).sum(axis=-1)
            for (along, across), start in zip(k.swapaxes(1, 2), at, strict=True)
        )
        return 1e-6 * np.sqrt(2 / 150) * (x + 1j * y)

    return stage


@pytest.mark.parametrize(("length", "rough"), [(6, False), (2, True)])
def test_a_map_that_does_not_suffice_is_contradicted_and_covers(length, rough):
    """The lack of fit is in U at the nodes, whether the test fails or not."""
    inside, contradicted = [], 0
    for seed in range(5):
        rng = np.random.default_rng([seed, length])
        found, truth = readings(
            plate(11, 7), SIX, rng, sigma=0.1e-6, stage=waves(rng, length)
        )
        result = trusted(found, BARE)
        u = np.stack([result.error_map.u_gx, result.error_map.u_gy])
        error = error_in_datum(result.error_map, truth)
        inside.append(np.mean(np.abs(error) < result.noise.k_xy * u))
        assert (
            "effect roughness" in [line.component for line in result.budget]
            or not rough
        )
        named = "roughness" in [cause.name for cause in result.verdict.causes]
        assert result.verdict.grade == ("enlarged" if named else "good")
        contradicted += named
    assert contradicted >= 4 if rough else contradicted == 0
    assert 0.93 < np.mean(inside) <= 1.0


@pytest.mark.parametrize(("off_m", "first"), [(2e-6, "roughness"), (50e-6, "reading")])
def test_the_likelier_of_a_rough_stage_and_a_reading_that_is_off_is_named_first(
    off_m, first
):
    rng = np.random.default_rng([1, 2])
    found, _ = readings(plate(11, 7), SIX, rng, sigma=20e-9, stage=waves(rng, 2))
    view = found.views[2]
    off = replace(view, dx=view.dx + off_m * (np.arange(len(view.m)) == 40))
    found = replace(found, views=(*found.views[:2], off, *found.views[3:]))
    causes = calibrate(found, Options(assumed=())).verdict.causes
    assert causes[0].name == first
    assert "reading" in [cause.name for cause in causes]


@pytest.mark.parametrize("bent", [False, True])
def test_a_bilinear_map_of_a_curved_stage_is_rough_and_not_a_bent_plate(bent):
    """What lies between the nodes goes into no term; a plate that is bent as well is found."""
    inside = []
    for seed in range(2):
        rng = np.random.default_rng([seed, 9])
        found, truth = readings(
            plate(9, 7, "bilinear"), SIX, rng, sigma=0.02e-6, stage=waves(rng, 3)
        )
        if bent:
            views = [
                replace(
                    v,
                    dy=v.dy
                    + (v.view.name == found.views[1].view.name) * 2e-6 * (v.m / 4) ** 2,
                )
                for v in found.views
            ]
            found = replace(found, views=tuple(views))
        result = trusted(found, BARE)
        named = [cause.name for cause in result.verdict.causes]
        assert "roughness" in named or bent
        assert ("plate_shape" in named) == bent
        u = np.stack([result.error_map.u_gx, result.error_map.u_gy])
        error = error_in_datum(result.error_map, truth)
        inside.append(np.mean(np.abs(error) < result.noise.k_xy * u))
    assert np.mean(inside) > 0.93


def test_terms_do_not_size_the_lack_of_fit_of_a_map_that_suffices():
    """A finer map hardly determines the microscope beside it: 5 µm followed from its value."""
    plan = plan_from_dict(
        {
            "plan_id": "p",
            "artifact": {"grid_size": 9, "grid_pitch": 0.008, "angular_count": 0},
            "map": {"grid_size": 7, "interpolation": "bicubic"},
            "views": [
                {"name": "a", "repeats": 2},
                {"name": "b", "rotation_deg": 90, "repeats": 2},
                {
                    "name": "c",
                    "rotation_deg": 37,
                    "translation_mm": [6, -4],
                    "repeats": 2,
                },
            ],
        },
        "",
    )
    spread = Spread(rotation="finite", correlation_pitches=4.0)
    for seed in range(6):
        rng = np.random.default_rng(seed)
        truth = random_truth(plan.artifact, 3, rng, spread)
        result = calibrate(
            simulate_measurements(truth, plan, rng, sigma_m=10e-9, visits=True)
        )
        assert 5e-9 < np.nanmean(result.error_map.u_gx) < 11e-9


def test_a_map_that_was_tried_is_the_remedy():
    """The nodes suffice for the stage once the map is bicubic, and the readings show that."""
    rng = np.random.default_rng([1, 9])
    wave = waves(rng, 4)
    found, _ = readings(plate(9, 7, "bilinear"), SIX, rng, sigma=0.02e-6, stage=wave)
    (cause,) = calibrate(found, Options(assumed=())).verdict.causes
    assert cause.name == "roughness" and [
        (remedy.kind, remedy.value) for remedy in cause.remedies
    ] == [("map", "7:bicubic")]
    better = replace(found, artifact=with_nodes(found.artifact, "7:bicubic", ""))
    assert better.artifact.field.grid_pitch_m == found.artifact.field.grid_pitch_m
    assert calibrate(better, Options(assumed=())).verdict.grade == "good"


def test_no_noise_and_no_roughness_is_no_lack():
    found, _ = readings(plate(11, 7), SIX, np.random.default_rng(1), sigma=0.0)
    result = calibrate(found, BARE)
    assert result.verdict.grade == "good" and not result.verdict.causes
    assert result.error_map.u_gx.max() < 1e-13


def test_the_lack_of_fit_is_sought_between_known_nodes_too():
    """One unknown corner takes away the middles beside it, and no other place."""
    artifact = plate(11, 7)
    found, _ = readings(artifact, SIX, np.random.default_rng(8))
    system = fit_joint(found, BARE).problem.system
    assert system.known_sites.all() and len(known_places(system)) == 13**2
    system.known_sites = system.known_sites.copy()
    system.known_sites[0, -1] = False
    places = known_places(system) / artifact.field.grid_pitch_m
    assert len(places) == 13**2 - 4
    assert not (np.abs(places - (-3 + 3j)) < 0.75).any()
    assert np.abs(places.real).max() == 3 and places.real[places.imag == 3].min() == -2


@pytest.mark.parametrize("turn", [0.1, -0.3])
def test_readings_are_turned_back_into_the_stage_frame(turn):
    """A step of one reading along stage x is one along x again, whatever the plate's rotation."""
    artifact, views = plate(11, 7), []
    rng = np.random.default_rng(9)
    found, _ = readings(artifact, SIX, rng)
    for view in found.views:
        pose, mark = view.view.pose, (view.m + 1j * view.n) * 10e-3
        lies = pose.phase * (np.exp(1j * turn) - 1) * mark
        views.append(replace(view, dx=view.dx + lies.real, dy=view.dy + lies.imag))
    step = np.zeros(len(views[2].m))
    step[40] = 1e-6
    moved = [*views[:2], replace(views[2], dx=views[2].dx + step), *views[3:]]
    before, after = (
        prepare(replace(found, views=tuple(each)), BARE)[0] for each in (views, moved)
    )
    change = (after.grid.y - before.grid.y)[2] * before.to_stage[2]
    at = views[2].m[40] + 5, views[2].n[40] + 5
    assert before.turn_rad == pytest.approx(turn, abs=0.01)
    assert change[at] == pytest.approx(1e-6, abs=0.1e-6)


def repeated(measurements, sigma, repeats=3):
    """Return readings that are means of so many repeats with a scatter of sigma, m."""
    views = [
        replace(
            view,
            count=np.full(len(view.m), repeats),
            sigma_xy=sigma,
            dof_xy=2 * (repeats - 1) * len(view.m),
        )
        for view in measurements.views
    ]
    return replace(measurements, views=tuple(views))


@pytest.mark.parametrize(("nodes", "untested"), [(17, False), (19, True)])
def test_a_map_of_too_many_nodes_is_tested_by_repeats_alone(nodes, untested):
    """Ripples that its nodes do not follow: no finer map shows them, but repeats do."""
    sigma = 20e-9
    ripple = 2 * np.pi / (1.6 * 22 / (nodes - 1) * 10e-3)
    measurements, _ = readings(
        plate(23, nodes),
        SIX,
        np.random.default_rng(1),
        sigma=sigma / np.sqrt(3),
        stage=lambda z: (
            40e-9 * (np.sin(ripple * z.real) + 1j * np.cos(ripple * z.imag))
        ),
    )
    once = calibrate(measurements, Options()).verdict
    assert (RoughnessUntested() in once.failed) is untested
    assert ("roughness" in [cause.name for cause in once.causes]) is not untested
    verdict = calibrate(repeated(measurements, sigma), Options()).verdict
    assert RoughnessUntested() not in verdict.failed
    assert "noise_contradicted" in [finding.name for finding in verdict.failed]


@pytest.mark.parametrize(
    ("poses", "untested"),
    [
        (((0, (0, 0)), (5, (0, 0)), (0, (1, 0))), True),
        (((0, (0, 0)), (5, (0, 0)), (0, (1, 0)), (90, (0, 0))), False),
    ],
)
def test_readings_too_few_for_a_finer_map_do_not_test_the_nodes(poses, untested):
    """A finer map of 15 x 15 nodes has 450 unknowns, and three views 460 equations for it."""
    measurements, _ = readings(plate(11, 9), poses, np.random.default_rng(5))
    verdict = calibrate(measurements, Options()).verdict
    assert (RoughnessUntested() in verdict.failed) is untested
    assert (adequacy_of(fit_joint(measurements, Options())) is None) is untested
    # ten marks read twice tell too little of the noise
    few = replace(repeated(measurements, 20e-9).views[0], dof_xy=20)
    scarcely = replace(measurements, views=(few, *measurements.views[1:]))
    failed = calibrate(scarcely, Options()).verdict.failed
    assert (RoughnessUntested() in failed) is untested
    exact, _ = readings(plate(11, 9), poses, np.random.default_rng(5), sigma=0.0)
    assert RoughnessUntested() not in calibrate(exact, BARE).verdict.failed


@pytest.mark.parametrize(("side", "untested"), [(4, True), (7, False)])
def test_few_marks_do_not_test_the_nodes_of_a_bilinear_map(side, untested):
    """Of 4 x 4 marks in three views 24 equations are left, of which misalignments take some."""
    poses = ((0, (0, 0)), (37, (0.3, 0.1)), (90, (-0.2, 0.4)))
    measurements, _ = readings(
        plate(side, 3, "bilinear"),
        poses,
        np.random.default_rng(5),
        stage=lambda z: 1e-7 * z,
    )
    often = repeated(measurements, 20e-9, repeats=4)
    for one in (measurements, often):
        failed = calibrate(one, Options()).verdict.failed
        assert (RoughnessUntested() in failed) is untested


@pytest.mark.parametrize("nodes", ["2", "-7", "7.0", "٧", ""])
def test_numbers_of_nodes_that_are_none_are_refused(nodes):
    with pytest.raises(InputError, match="is not NODES"):
        with_nodes(plate(9, 5, "bilinear"), f"{nodes}:bicubic", "--map")


AT_NODES = ((0, (0, 0)), (90, (0, 0)), (180, (0, 0)), (0, (1, 0)), (0, (0, 1)))


def between_nodes(result, stage):
    """Return errors of a map over its u at places between its nodes, without its datum."""
    used = StageMap(result)
    x, y = np.meshgrid(np.linspace(-0.04, 0.04, 41), np.linspace(-0.04, 0.04, 41))
    places = (x + 1j * y).ravel()
    errors = np.array(used.error(x, y)).reshape(2, -1)
    wrong = errors[0] + 1j * errors[1] - stage(places)
    ones = np.ones(len(places))
    datum = [
        np.concatenate([mode.real, mode.imag])
        for mode in (ones, 1j * ones, places, 1j * places)
    ]
    both = np.concatenate([wrong.real, wrong.imag])
    both -= np.array(datum).T @ np.linalg.lstsq(np.array(datum).T, both, rcond=None)[0]
    return both / np.array(used.uncertainty(x, y)).ravel()


@pytest.mark.parametrize("how", ["bilinear", "bicubic"])
def test_u_between_nodes_holds_where_every_reading_lies_at_a_node(how):
    """It was that of the nodes: 24 and 90 % of places in 2 u, and good."""

    def stage(z):
        x, y = z.real, z.imag
        return 3e-7 * np.sin(120 * x) * np.cos(80 * y) + 2e-7j * np.cos(90 * x + 60 * y)

    measured, _ = readings(
        plate(9, 9, how), AT_NODES, np.random.default_rng(3), stage=stage
    )
    result = calibrate(measured)
    assert not result.reads_between_nodes
    assert (np.abs(between_nodes(result, stage)) < 2).mean() > 0.95


def test_readings_between_the_nodes_are_seen():
    nine = plate(9, 9)
    for poses, seen in ((AT_NODES, False), (SIX, True)):
        views = readings(nine, poses, np.random.default_rng(0))[0].views
        assert reads_between_nodes([view.view for view in views], nine) is seen
    half_along_x = [
        View("as it is", 0.0, (0.0, 0.0)),
        View("half a pitch along x", 0.0, (0.5 * PITCH_M, 0.0)),
    ]
    assert not reads_between_nodes(half_along_x, nine)
