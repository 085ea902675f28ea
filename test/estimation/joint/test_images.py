# SPDX-License-Identifier: Apache-2.0
"""Noise that the marks of an image share: estimated, and in U, against dense linear algebra."""

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.stats import binom, chi2

from selfcal_ros.applications.papers.methods import calibrate_by_law
from selfcal_ros.errors import InputError
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.comparison.covariance import covariance_of
from selfcal_ros.estimation.joint.camera import Distortion, straight_slope
from selfcal_ros.estimation.joint.images import image_noise
from selfcal_ros.estimation.joint.solve import solve_joint
from selfcal_ros.estimation.lattice.readings import angular_data, grid_data
from selfcal_ros.estimation.normal.equations import system_of
from selfcal_ros.estimation.options import Options
from selfcal_ros.estimation.terms.visits import term_inputs
from selfcal_ros.model.readings import Sense
from selfcal_ros.model.result import result_from_dict, result_to_dict
from selfcal_ros.model.terms import ModelTerm
from selfcal_ros.model.view import View
from selfcal_ros.reporting.words.findings import worded
from selfcal_ros.simulation import physics
from selfcal_ros.simulation.cell import CellSettings
from test.support.options import STILL
from test.support.plans import image_plan
from test.support.truth import Spread, random_truth, simulate_measurements

MARK = 2e-8
ALONE = Options(assumed=())


def measured(
    image_m: float,
    seed: int,
    *,
    size: int = 7,
    repeats: int = 1,
    missing: float = 0.0,
    sense: Sense = Sense.MICROSCOPE_MOVES,
    servo_m: float = 0.0,
    **spread,
):
    """Return truth and readings of two turns with images of 3 x 3 marks."""
    plan, rng = image_plan(size, repeats=repeats), np.random.default_rng(seed)
    truth = random_truth(
        plan.artifact,
        2,
        rng,
        Spread(**{"phi_rad": 0.003, "correlation_pitches": 4.0} | spread),
    )
    settings = CellSettings(
        sigma_xy_m=MARK, image_xy_m=image_m, servo_sigma_m=servo_m, sense=sense
    )
    return truth, simulate_measurements(
        truth, plan, rng, settings=settings, missing=missing
    )


def dense(measurements):
    """Return the matrix of (2.2), rows x then y of every reading, and the stop of each reading.

    Unknowns: G and A, x then y of each site and mark, then tx, ty of each sub-view, then phi of
    each view of the plan: its plate is placed once.
    """
    (nx, ny), (hx, hy) = measurements.artifact.shape, measurements.artifact.half
    count = sum(len(view.m) for view in measurements.views)
    placed = list(dict.fromkeys(view.view.plan_view for view in measurements.views))
    offsets = 4 * nx * ny + 2 * len(measurements.views)
    rows, stops = np.zeros((2 * count, offsets + len(placed))), []
    place = 0
    for number, view in enumerate(measurements.views):
        turn = round(view.view.rotation_rad / (np.pi / 2))
        cosine, sine = ((1, 0), (0, 1))[turn]
        a, b = (
            round(t / measurements.artifact.grid_pitch_m)
            for t in view.view.translation_m
        )
        for m, n in zip(view.m, view.n, strict=True):
            x, y = cosine * m - sine * n, sine * m + cosine * n
            site = (x + a + hx) * ny + y + b + hy
            mark = (m + hx) * ny + n + hy
            stops.append((view.view.rotation_rad, site))
            at, own = 2 * place, 4 * nx * ny + 2 * number
            rows[at, 2 * site] = rows[at + 1, 2 * site + 1] = 1
            rows[at : at + 2, 2 * (nx * ny + mark) : 2 * (nx * ny + mark) + 2] = [
                [cosine, -sine],
                [sine, cosine],
            ]
            rows[at : at + 2, offsets + placed.index(view.view.plan_view)] = -y, x
            rows[at, own] = rows[at + 1, own + 1] = 1
            place += 1
    return rows, np.unique(stops, axis=0, return_inverse=True)[1].reshape(-1)


def datum(artifact) -> np.ndarray:
    """Return the projector of a map, x and y of each site, on that without the four modes."""
    x, y = artifact.m.ravel().astype(float), artifact.n.ravel().astype(float)
    zero, one = np.zeros_like(x), np.ones_like(x)
    modes = np.stack(
        [
            np.stack(pair, axis=1).ravel()
            for pair in ((one, zero), (zero, one), (-y, x), (x, y))
        ]
    )
    basis = np.linalg.qr(modes.T)[0]
    return np.eye(2 * x.size) - basis @ basis.T


@cache
def whole(missing: float = 0.0):
    _, measurements = measured(3 * MARK, 5, missing=missing, size=5)
    matrix, stops = dense(measurements)
    return measurements, matrix, stops, np.linalg.pinv(matrix, rcond=1e-10)


@pytest.mark.parametrize("missing", [0.0, 0.06])
def test_u_holds_the_noise_that_marks_of_an_image_share(missing):
    measurements, matrix, stops, inverse = whole(missing)
    result = calibrate(measurements, ALONE)
    camera = result.camera
    mark, image = camera.noise_mark, camera.noise_image
    assert image > 2 * mark > 0
    sites = np.prod(measurements.artifact.shape)
    gain = datum(measurements.artifact) @ inverse[: 2 * sites]
    together = np.kron(stops[:, None] == stops, np.eye(2))
    covariance = mark**2 * np.eye(len(matrix)) + image**2 * together
    u = np.sqrt(np.diag(gain @ covariance @ gain.T))
    found = result.error_map
    shape = measurements.artifact.shape
    np.testing.assert_allclose(found.u_gx, u[::2].reshape(shape), rtol=1e-5)
    np.testing.assert_allclose(found.u_gy, u[1::2].reshape(shape), rtol=1e-5)
    alone = np.hypot(mark, image) * np.sqrt(np.diag(gain @ gain.T))
    assert u.mean() > 1.8 * alone.mean()
    # the plate has the scale of stage and plate together: noise of images moves it little
    artifact = measurements.artifact
    z = np.stack([artifact.m.ravel(), artifact.n.ravel()], axis=1).ravel().astype(float)
    both = inverse[2 * sites : 4 * sites] + np.outer(z, z @ inverse[: 2 * sites]) / (
        z @ z
    )
    kept = np.eye(2 * sites) - datum(artifact) - np.outer(z, z) / (z @ z)
    gain = both - kept @ both
    u = np.sqrt(np.diag(gain @ covariance @ gain.T))
    np.testing.assert_allclose(
        result.artifact_map.u_ax, u[::2].reshape(shape), rtol=1e-5
    )
    np.testing.assert_allclose(
        result.artifact_map.u_ay, u[1::2].reshape(shape), rtol=1e-5
    )
    assert (
        u.mean() < 0.9 * np.hypot(mark, image) * np.sqrt(np.diag(gain @ gain.T)).mean()
    )


@pytest.mark.parametrize("sense", Sense)
def test_covariance_of_a_saved_map_holds_the_noise_that_marks_of_an_image_share(sense):
    _, measurements = measured(3 * MARK, 5, missing=0.06, size=5, sense=sense)
    matrix, stops = dense(measurements)
    result = calibrate(measurements, ALONE)
    camera = result.camera
    covariance = camera.noise_mark**2 * np.eye(
        len(matrix)
    ) + camera.noise_image**2 * np.kron(stops[:, None] == stops, np.eye(2))
    gain = (
        datum(measurements.artifact) @ np.linalg.pinv(matrix, rcond=1e-10)[:50]
    ).reshape(5, 5, 2, -1)
    if sense is Sense.PLATE_MOVES:
        gain = -gain[::-1, ::-1]
    known = result.error_map.valid.copy()
    known[0, 1] = False
    rows = np.concatenate([gain[known, 0], gain[known, 1]])
    found = covariance_of(result, "xy", known)
    wanted = rows @ covariance @ rows.T
    assert found.shape == (48, 48)
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-9 * wanted.max())


def test_images_are_drawn_once_for_each_system():
    measurements = whole(0.0)[0]
    grid = grid_data(measurements)
    system = system_of(grid, angular_data(measurements))

    def images():
        return image_noise(
            measurements.artifact,
            [v.view for v in measurements.views],
            system,
            inputs=term_inputs(measurements, grid),
            terms=(),
        )

    assert images() is images()


@pytest.mark.parametrize("missing", [0.0, 0.06])
def test_draws_show_what_either_noise_leaves_in_the_residuals(missing):
    measurements, matrix, stops, inverse = whole(missing)
    system = system_of(grid_data(measurements), angular_data(measurements))
    grid = grid_data(measurements)
    images = image_noise(
        measurements.artifact,
        [v.view for v in measurements.views],
        system,
        inputs=term_inputs(measurements, grid),
        terms=(),
    )
    left = np.eye(len(matrix)) - matrix @ inverse
    together = np.kron(stops[:, None] == stops, np.eye(2))
    expected = [
        [np.trace(left), np.trace(left @ together @ left)],
        [np.trace(left @ together @ left), np.trace(together @ left @ together @ left)],
    ]
    # the two noises are independent
    expected = np.append(expected, np.zeros((2, 1)), axis=1)
    spread = images.drawn.std(axis=0) / np.sqrt(len(images.drawn))
    away = images.drawn.mean(axis=0) - expected
    assert (np.abs(away) < 4 * spread).all()
    assert images.marks == pytest.approx(
        np.mean([(stops == stop).sum() for stop in stops])
    )


def population(
    image_m: float, size: int, runs: int, *, options: Options | None = None, **settings
):
    """Return (G - truth) / u of every node and run, and the truths and results."""
    away, results = [], []
    for seed in range(runs):
        truth, measurements = measured(image_m, seed, size=size, **settings)
        found = calibrate(measurements, options or Options(terms=STILL))
        emap = found.error_map
        error = np.stack([emap.gx, emap.gy]) - truth.g
        away.append(error / np.stack([emap.u_gx, emap.u_gy]))
        results.append((truth, found))
    return np.array(away), results


def within(away: np.ndarray, independent: int, *, least: float = 1.0) -> None:
    """Assert that about 95.45 % lie within 2 u; `independent`: numbers that a run has.

    And that u is not larger than the errors over `least`, as far as that many numbers show.
    """
    n = len(away) * independent
    assert binom.ppf(1e-4, n, 0.9545) <= (np.abs(away) < 2).mean() * n
    low, high = np.sqrt(chi2.ppf([0.001, 0.999], n) / n)
    assert least * low < np.sqrt((away**2).mean()) < high


def away_of(truth, camera) -> np.ndarray:
    """Return (error of the camera - truth) / u at every cell, (2, cells)."""
    place, error, u = (
        np.array(
            [[getattr(cell, f"{name}{axis}") for cell in camera.cells] for axis in "xy"]
        )
        for name in ("", "d", "u_d")
    )
    return (error - (physics.seen_offset(truth, place) - place)) / u


DISTORTED = {
    "microscope_distortion": 0.02,
    "microscope_field_m": 1.414e-3,
    "microscope_scale": 0.005,
    "microscope_rotation_rad": -0.003,
}
"""2 % in the corner of the image, and an error of scale and turn."""


@pytest.mark.parametrize(
    ("part", "size", "sense", "runs"),
    [
        (0.3, 7, Sense.MICROSCOPE_MOVES, 4),
        (1.0, 7, Sense.PLATE_MOVES, 3),
        (3.0, 7, Sense.MICROSCOPE_MOVES, 6),
    ],
)  # the more images share, the fewer numbers a run has
def test_stage_camera_and_noises_are_found_within_their_uncertainties(
    part, size, sense, runs
):
    away, results = population(part * MARK, size, runs, sense=sense, **DISTORTED)
    assert all(found.verdict.qualified for _, found in results)
    within(away, 20)
    cameras = [found.camera for _, found in results]
    within(np.array([away_of(truth, found.camera) for truth, found in results]), 9)
    assert all(camera.degree == 3 for camera in cameras)
    mark, image = (
        np.mean([getattr(camera, name) ** 2 for camera in cameras])
        for name in ("noise_mark", "noise_image")
    )
    dof = sum(found.kept.images.dof_mark for _, found in results)
    assert mark == pytest.approx(MARK**2, rel=3 * np.sqrt(2 / dof))
    assert image == pytest.approx((part * MARK) ** 2, rel=0.15)
    # published offsets are (1 + E)^-1 times the true ones, then distorted
    for camera in cameras:
        assert camera.scale == pytest.approx(-0.005, abs=1e-4)
        assert camera.rotation == pytest.approx(0.003, abs=1e-4)
        radial = next(c.x for c in camera.coefficients if c.power == (2, 1))
        assert radial == pytest.approx(0.02 / 1.414e-3**2, rel=0.03)


@pytest.mark.parametrize("sense", list(Sense))
def test_repeats_are_compared_with_the_scale_that_the_camera_shows(sense):
    """Every stop is 1 um off, so that the repeats show the pixel size to 0.1 %."""
    off = {
        "microscope_scale": 0.005,
        "microscope_rotation_rad": -0.02,
        "microscope_distortion": 0.02,
        "microscope_field_m": 1.414e-3,
    }
    _, readings = measured(MARK, 0, repeats=4, sense=sense, servo_m=1e-6, **off)
    assert calibrate(readings, Options(causes=False)).verdict.qualified
    longer = np.diag([1.0, 1.0, 1.01, 1.01])
    views = tuple(
        replace(
            view,
            motion=replace(
                view.motion, products=longer @ view.motion.products @ longer
            ),
        )
        for view in readings.views
    )
    failed = calibrate(
        replace(readings, views=views), Options(causes=False)
    ).verdict.failed
    assert [one.name for one in failed] == ["scale_of_offsets"]


def test_offsets_of_repeats_are_straightened_with_the_turn_of_the_camera():
    """True offsets are minus the motion; published ones have the camera's error, (x, y) mixed."""
    rng, place = np.random.default_rng(4), 3e-4 - 2e-4j
    camera = Distortion(
        ((1, 0), (0, 1), (2, 1)),
        np.array([0, 0.004 + 0.03j, 0.002 - 0.005j, 2e4 + 1e4j]),
    )
    true = place + rng.normal(0, 1e-7, 500) + 2e-7j * rng.normal(0, 1, 500)
    published = true.copy()
    for _ in range(30):
        published = true + camera.at(published)
    moved, seen = -(true - true.mean()), published - published.mean()
    rows = np.stack([moved.real, moved.imag, seen.real, seen.imag])
    straight = np.eye(4)
    straight[2:, 2:] = straight_slope(camera, complex(published.mean()))
    slopes = straight @ rows @ rows.T @ straight.T
    on_motion = np.linalg.solve(slopes[:2, :2], slopes[:2, 2:])
    np.testing.assert_allclose(on_motion, -np.eye(2), atol=2e-5)
    assert (
        abs(np.linalg.solve(slopes[:2, :2], (rows @ rows.T)[:2, 2:]) + np.eye(2)).max()
        > 0.02
    )


def test_degrees_of_freedom_are_those_of_the_maps_variance():
    power, dof = [], []
    for seed in range(30):
        found = solve_joint(measured(3 * MARK, seed, size=5)[1], ALONE).result
        power.append((found.error_map.u_gx**2).mean())
        dof.append(found.noise.dof_xy)
    shown = 2 * np.mean(power) ** 2 / np.var(power, ddof=1)
    # 95.45 % of such variances lie within 0.55 and 1.6
    assert 0.6 < np.mean(dof) / shown < 1.6
    assert np.mean(dof) < 100


def test_an_approach_alike_at_every_visit_of_a_site_is_no_cause():
    """Rotations of the views let readings tell it from the stage by rounding and worse."""
    _, measurements = measured(0.3 * MARK, 1155, size=7, **DISTORTED)
    assert calibrate(measurements).verdict.causes == ()
    equations = solve_joint(
        measurements, Options(terms=(ModelTerm("approach", 1e-8),))
    ).model.equations
    rows = equations.rows(["approach"])
    share = np.diag(equations.information)[rows] / equations.norm[rows] ** 2
    assert np.abs(share).max() < 1e-14


def test_a_camera_without_distortion_has_a_linear_error():
    _, results = population(MARK, 5, 5, repeats=2)
    cameras = [found.camera for _, found in results]
    assert sum(camera.degree == 1 for camera in cameras) >= 4
    assert not any(found.verdict.causes for _, found in results)
    scale = [camera.scale / camera.u_scale for camera in cameras]
    assert np.sqrt(np.mean(np.square(scale))) < 1.8


def test_images_in_one_line_show_no_distortion_of_the_camera():
    plan, rng = image_plan(5), np.random.default_rng(2)
    image = replace(plan.views[0].image, ny=1)
    more = View("shifted", 0.0, (0.0, 1e-3), angular=False)
    plan = replace(
        plan, views=tuple(replace(v, image=image) for v in (*plan.views, more))
    )
    truth = random_truth(plan.artifact, 3, rng, Spread(phi_rad=0.003))
    found = calibrate(simulate_measurements(truth, plan, rng, sigma_m=MARK))
    assert found.camera is None and found.stage_yaw is not None
    assert found.observability.identifiable


def test_hus_law_refuses_images():
    _, measurements = measured(MARK, 1, size=5)
    with pytest.raises(
        InputError,
        match="Hu's law cannot use images of several marks; solve with --method",
    ):
        calibrate_by_law(measurements, Options())


def test_noise_of_offsets_taken_for_a_microscope_makes_no_variance_negative():
    """A draw whose noise, in a view that hardly turns, looks like a microscope's strain."""
    plan, rng = image_plan(7), np.random.default_rng(3)
    truth = random_truth(
        plan.artifact, 3, rng, Spread(phi_rad=0.003, correlation_pitches=4.0)
    )
    settings = CellSettings(sigma_xy_m=MARK, image_xy_m=MARK, servo_sigma_m=0.0)
    found = calibrate(
        simulate_measurements(truth, plan, rng, settings=settings),
        Options(terms=tuple(ModelTerm(name, 0.0) for name in ("drift", "approach"))),
    )
    assert [cause.name for cause in found.verdict.causes] == ["microscope"]
    for u in (
        found.error_map.u_gx,
        found.error_map.u_gy,
        found.artifact_map.u_ax,
        found.artifact_map.u_ay,
    ):
        assert (u > 0.2 * MARK).all()


def test_a_result_of_marks_without_noise_of_their_own_is_read_again():
    """Their degrees of freedom are infinite, which JSON has no number for."""
    found = calibrate(measured(2e-7, 3)[1], ALONE)
    assert found.kept.images.share == 1 and np.isinf(found.kept.images.dof_mark)
    data = json.loads(json.dumps(result_to_dict(worded(found)), allow_nan=False))
    assert result_from_dict(data, "r").kept.images == found.kept.images
