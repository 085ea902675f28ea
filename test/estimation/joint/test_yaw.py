# SPDX-License-Identifier: Apache-2.0
"""The yaw of the stage from images: against dense linear algebra, known truth, and its signs."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.joint.camera import yaw_of
from selfcal_ros.estimation.joint.solve import solve_joint
from selfcal_ros.estimation.options import Options
from selfcal_ros.model.readings import Sense
from selfcal_ros.model.terms import ModelTerm, parse_terms
from selfcal_ros.simulation.cell import CellSettings
from selfcal_ros.simulation.physics import between_sites
from test.estimation.joint.test_images import (
    MARK,
    datum,
    dense,
    measured,
    population,
    within,
)
from test.support.options import STILL
from test.support.plans import image_plan
from test.support.truth import Spread, random_truth, simulate_measurements

PITCH = 1e-3

TURNED = 1e-3
"""Effect of offsets (noise 60 nm) on columns of a yaw (1 mm), from one step to the next."""


def of_yaw(measurements):
    """Return the columns of a yaw at each site, rows as in `dense`.

    Marks are beside the places of their cells by their offsets, a cell as a whole by the mean of
    those on the optical axis; their mean over the sites is a turn of the camera.
    """
    (nx, ny), (hx, hy) = measurements.artifact.shape, measurements.artifact.half
    rows, place = np.zeros((2 * sum(len(v.m) for v in measurements.views), nx * ny)), 0
    axis = {
        v.view.plan_view: v.visits for v in measurements.views if v.view.cell == (0, 0)
    }
    for view in measurements.views:
        seen, on_axis = view.visits, axis[view.view.plan_view]
        ox, oy = (
            getattr(seen, of) - getattr(seen, of).mean() + getattr(on_axis, of).mean()
            for of in ("offset_x", "offset_y")
        )
        beside = {
            (int(view.m[at]), int(view.n[at])): (ox[visit], oy[visit])
            for visit, at in enumerate(seen.mark)
        }
        turned = round(view.view.rotation_rad / (np.pi / 2))
        # the plate, with all its marks, lies shifted by minus the place of the cell
        dx, dy = (-round(t / PITCH) * PITCH for t in view.view.translation_m)
        for m, n in zip(view.m, view.n, strict=True):
            x, y = ((m, n), (-n, m))[turned]
            site = round((x - dx / PITCH + hx) * ny + y - dy / PITCH + hy)
            rows[place, site], rows[place + 1, site] = dy, -dx  # -i (dx + i dy)
            more_x, more_y = beside[m, n]
            about = (np.arange(nx * ny) == site) - 1 / (nx * ny)
            rows[place] += about * more_y
            rows[place + 1] -= about * more_x
            place += 2
    return rows


@pytest.mark.parametrize("missing", [0.0, 0.06])
def test_yaw_and_map_are_those_of_one_dense_least_squares(missing):
    _, measurements = measured(
        3 * MARK,
        5,
        missing=missing,
        size=5,
        rotation="linear",
        phi_rad=1e-5,
        t_m=1e-6,
        stage_yaw_rad=2e-5,
    )
    solved = solve_joint(
        measurements,
        Options(
            assumed=(),
            terms=(ModelTerm("yaw"),),
            misalignment_model="linear",
            at_places=False,
        ),
    )
    matrix, stops = dense(measurements)
    matrix = np.hstack([matrix, of_yaw(measurements) / PITCH])
    inverse = np.linalg.pinv(matrix, rcond=1e-10)
    y = np.concatenate(
        [np.stack([v.dx, v.dy], axis=1).ravel() for v in measurements.views]
    )
    noises = solved.model.problem.images.noises(solved.model.fitted.residuals)
    assert noises.image > 2 * noises.mark > 0
    covariance = noises.mark**2 * np.eye(len(y)) + noises.image**2 * np.kron(
        stops[:, None] == stops, np.eye(2)
    )
    sites = np.prod(measurements.artifact.shape)
    to_yaw = (np.eye(sites) - 1 / sites) @ inverse[-sites:] / PITCH
    yaw = yaw_of(solved.model, measurements.sense)
    np.testing.assert_allclose(yaw.yaw, to_yaw @ y, atol=TURNED * yaw.yaw.std())
    np.testing.assert_allclose(
        yaw.u_yaw, np.sqrt(np.diag(to_yaw @ covariance @ to_yaw.T)), rtol=TURNED
    )
    to_map = datum(measurements.artifact) @ inverse[: 2 * sites]
    emap = solved.result.error_map
    g = np.stack([emap.gx, emap.gy], axis=-1).ravel()
    np.testing.assert_allclose(g, to_map @ y, atol=TURNED * g.std())
    u = np.stack([emap.u_gx, emap.u_gy], axis=-1).ravel()
    np.testing.assert_allclose(
        u, np.sqrt(np.diag(to_map @ covariance @ to_map.T)), rtol=TURNED
    )


def at_places(matrix, measurements, field):
    """Return the matrix of `dense` for G where the stage stood: at its indicated place less G.

    G between the sites is the bicubic spline through them; `field` is G, x and y of each site.
    """
    out, place, (nx, ny) = matrix.copy(), 0, measurements.artifact.shape
    along, across = (CubicSpline(np.arange(n), np.eye(n)) for n in (nx, ny))
    for view in measurements.views:
        seen = view.visits
        stood = dict(
            zip(
                seen.mark.tolist(),
                (seen.dx - seen.offset_x + 1j * (seen.dy - seen.offset_y)).tolist(),
                strict=True,
            )
        )
        for reading in range(len(view.m)):
            site = int(out[place, : 2 * nx * ny : 2].argmax())
            error = complex(*field[2 * site : 2 * site + 2])
            for _ in range(6):
                away = (stood[reading] - error) / PITCH
                weight = np.outer(
                    along(site // ny + away.real), across(site % ny + away.imag)
                )
                error = complex(*(weight.ravel() @ field.reshape(-1, 2)))
            for axis in range(2):
                out[place + axis, axis : 2 * nx * ny : 2] = weight.ravel()
            place += 2
    return out


@pytest.mark.parametrize(
    ("stop_m", "image_m", "near"),
    [(0.0, 3 * MARK, 1e-3), (3e-5, 3 * MARK, 0.015), (3e-5, 0.3 * MARK, 0.015)],
)
def test_yaw_where_the_stage_stood_is_that_of_dense_linear_algebra(
    stop_m, image_m, near
):
    """Plates 30 um beside, stops off the sites; the equations are those of the sites.

    So the estimate is the place at which what the stage's error differs there, taken off, stands
    still.
    """
    plan, rng = image_plan(5, repeats=1), np.random.default_rng(5)
    truth = random_truth(
        plan.artifact,
        2,
        rng,
        Spread(
            phi_rad=1e-5,
            t_m=3e-5,
            stage_yaw_rad=2e-5,
            rotation="linear",
            correlation_pitches=4.0,
        ),
    )
    measurements = simulate_measurements(
        truth,
        plan,
        rng,
        settings=CellSettings(
            sigma_xy_m=MARK, image_xy_m=image_m, servo_sigma_m=stop_m
        ),
    )
    solved = solve_joint(
        measurements,
        Options(assumed=(), terms=(ModelTerm("yaw"),), misalignment_model="linear"),
    )
    matrix, stops = dense(measurements)
    whole = np.hstack([matrix, of_yaw(measurements) / PITCH])
    inverse, sites = np.linalg.pinv(whole, rcond=1e-10), np.prod(plan.artifact.shape)
    project = datum(plan.artifact)
    y = np.concatenate(
        [np.stack([v.dx, v.dy], axis=1).ravel() for v in measurements.views]
    )
    field = project @ inverse[: 2 * sites] @ y
    for _ in range(4):
        moved = np.zeros_like(whole)
        moved[:, : 2 * sites] = (at_places(matrix, measurements, field) - matrix)[
            :, : 2 * sites
        ] @ project
        estimate = np.linalg.solve(np.eye(len(inverse)) + inverse @ moved, inverse)
        field = project @ estimate[: 2 * sites] @ y
    emap, yaw = solved.result.error_map, yaw_of(solved.model, measurements.sense)
    np.testing.assert_allclose(
        np.stack([emap.gx, emap.gy], axis=-1).ravel(),
        field,
        atol=1e-3 * emap.u_gx.mean(),
    )
    noises = solved.model.problem.images.noises(solved.model.fitted.residuals)
    covariance = noises.mark**2 * np.eye(len(y)) + noises.image**2 * np.kron(
        stops[:, None] == stops, np.eye(2)
    )
    to_yaw = (np.eye(sites) - 1 / sites) @ estimate[-sites:] / PITCH
    np.testing.assert_allclose(yaw.yaw, to_yaw @ y, atol=1e-3 * yaw.u_yaw.mean())
    np.testing.assert_allclose(
        yaw.u_yaw, np.sqrt(np.diag(to_yaw @ covariance @ to_yaw.T)), rtol=near
    )


def test_only_a_constant_yaw_is_the_cameras():
    """What is free beside the unknowns of the maps is one yaw for all sites."""
    _, measurements = measured(0.0, 1, size=5)
    alone = dense(measurements)[0]
    both = np.hstack([alone, of_yaw(measurements) / PITCH])
    values, vectors = np.linalg.eigh(both.T @ both)
    free = vectors[-both.shape[1] + alone.shape[1] :, values < 1e-9 * values[-1]]
    free = free[:, np.abs(free).max(axis=0) > 1e-9]
    assert np.linalg.matrix_rank(free, tol=1e-6) == 1
    assert np.ptp(free, axis=0).max() < 1e-9


def turns(truth, found) -> np.ndarray:
    """Return (yaw - truth) / u at the nodes."""
    true = between_sites(truth.artifact, truth.yaw, np.stack([found.x, found.y]))
    return (found.yaw - (true - true.mean())) / found.u_yaw


@pytest.mark.parametrize(
    ("size", "sense", "rad", "runs"),
    [(7, Sense.MICROSCOPE_MOVES, 1e-5, 3), (7, Sense.PLATE_MOVES, 3e-5, 3)],
)
def test_yaw_and_map_of_a_stage_that_turns_are_within_their_uncertainties(
    size, sense, rad, runs
):
    away, results = population(MARK, size, runs, sense=sense, stage_yaw_rad=rad)
    assert all(
        found.verdict.qualified and not found.verdict.causes for _, found in results
    )
    within(away, 20)
    within(np.array([turns(truth, found.stage_yaw) for truth, found in results]), 20)


def test_a_stage_that_does_not_turn_shows_none():
    _, results = population(MARK, 5, 6, options=Options(causes=False))
    p = [found.stage_yaw.p for _, found in results]
    assert sum(each < 0.05 for each in p) <= 2
    assert min(p) > 1e-3


@pytest.mark.parametrize(
    ("size", "more"), [(2e-4, ()), (1e-3, ()), (1e-3, ("yaw:1e-3",))]
)
def test_a_stage_that_yaws_smoothly_by_more_than_assumed_bends_no_plate(size, more):
    """The yaw that is linear looks like a plate bent in the second view."""
    truth, _ = measured(0.0, 3, phi_rad=1e-3, t_m=1e-5)
    slope = np.linspace(-size, size, 7)[:, None] + np.zeros(7)
    truth = replace(truth, yaw=slope)
    measurements = simulate_measurements(
        truth,
        image_plan(7, repeats=1),
        np.random.default_rng(3),
        settings=CellSettings(sigma_xy_m=MARK, servo_sigma_m=0.0),
    )
    found = calibrate(measurements, Options(terms=(*STILL, *parse_terms(more, "test"))))
    causes = {cause.name: cause for cause in found.verdict.causes}
    assert list(causes) == ["yaw"] * (size == 1e-3 and not more)
    emap = found.error_map
    within(
        ((np.stack([emap.gx, emap.gy]) - truth.g) / np.stack([emap.u_gx, emap.u_gy]))[
            None
        ],
        20,
    )
    if causes:
        (tried, *_) = causes["yaw"].remedies
        assert tried.kind == "model"
        given = replace(Options(), terms=(*STILL, *parse_terms([tried.value], "test")))
        assert not calibrate(measurements, given).verdict.causes


def test_a_plate_bent_in_one_view_is_told_from_a_stage_that_yaws_linearly():
    """One rotation of all cells tells them apart; the map, and the yaw, are freed from the bend."""
    away, turned = [], []
    for seed, (bend_m, yaw_rad) in enumerate([(1e-7, 0.0), (-1e-7, 1e-4)]):
        truth, _ = measured(0.0, seed, phi_rad=1e-3, t_m=1e-5)
        shape = np.zeros((2, 2, 3))
        shape[1] = [[0, bend_m, 0], [-bend_m, 0, 0]]
        slope = np.linspace(-yaw_rad, yaw_rad, 7)[:, None] + np.zeros(7)
        truth = replace(truth, yaw=slope, plate_shape_m=shape)
        found = calibrate(
            simulate_measurements(
                truth,
                image_plan(7, repeats=1),
                np.random.default_rng(seed),
                settings=CellSettings(sigma_xy_m=MARK, servo_sigma_m=0.0),
            ),
            Options(terms=STILL),
        )
        assert [cause.name for cause in found.verdict.causes] == ["plate_shape"]
        assert found.verdict.qualified
        of = {
            (one.component, one.view): one.value
            for term in found.model.terms
            if term.name == "plate_shape"
            for one in term.estimates
        }
        for name in ("z^2 y", "|z|^2 y"):  # (xy, -x^2) = -i/2 (z^2 + |z|^2)
            assert of[name, "90"] - of[name, "0"] == pytest.approx(
                -bend_m / 2, abs=MARK
            )
        emap = found.error_map
        away.append(
            (np.stack([emap.gx, emap.gy]) - truth.g) / np.stack([emap.u_gx, emap.u_gy])
        )
        turned.append(turns(truth, found.stage_yaw))
    # u has the largest size that the readings allow
    within(np.array(away), 20, least=0.85)
    within(np.array(turned), 20)


def test_left_out_of_the_model_it_is_named():
    _, measurements = measured(MARK, 3, stage_yaw_rad=3e-5)
    blind = calibrate(measurements, Options(assumed=()))
    assert [cause.name for cause in blind.verdict.causes][:1] == ["yaw"]


def test_a_larger_one_than_assumed_enlarges_the_uncertainty():
    _, measurements = measured(MARK, 3, stage_yaw_rad=3e-4)
    found = calibrate(measurements)
    (cause,) = found.verdict.causes
    assert cause.name == "yaw"
    assert 2e-4 < cause.size < 1.5e-3
    assert found.verdict.qualified


def test_one_line_of_marks_shows_it_too():
    plan, rng = image_plan(7), np.random.default_rng(2)
    image = replace(plan.views[0].image, ny=1)
    more = replace(plan.views[0], name="shifted", translation_m=(PITCH, 0.0))
    plan = replace(
        plan, views=tuple(replace(v, image=image) for v in (*plan.views, more))
    )
    truth = random_truth(
        plan.artifact,
        3,
        rng,
        Spread(phi_rad=1e-4, stage_yaw_rad=5e-5, correlation_pitches=4.0),
    )
    found = calibrate(
        simulate_measurements(
            truth, plan, rng, settings=CellSettings(sigma_xy_m=MARK, servo_sigma_m=0.0)
        )
    )
    assert found.camera is None
    away = turns(truth, found.stage_yaw)
    assert 0.6 < np.sqrt((away**2).mean()) < 1.5
    assert found.stage_yaw.p < 1e-3
