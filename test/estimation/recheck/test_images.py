# SPDX-License-Identifier: Apache-2.0
"""A recheck with images of several marks: dense linear algebra, populations, refusals."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag, toeplitz
from scipy.stats import binom

from selfcal_ros.errors import InputError
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.comparison.covariance import together
from selfcal_ros.estimation.joint.slow_motion import MotionOfStops, slow_correlation
from selfcal_ros.estimation.joint.solve import solve_joint
from selfcal_ros.estimation.options import Options
from selfcal_ros.estimation.recheck.plate import known_plate
from selfcal_ros.estimation.recheck.solve import (
    StopsOfImages,
    predict_recheck,
    recheck,
)
from selfcal_ros.model.error_map import datum_modes, remove_modes
from selfcal_ros.model.kept import SlowKept
from selfcal_ros.model.readings import Sense
from selfcal_ros.model.terms import ModelTerm
from selfcal_ros.simulation.cell import CellSettings
from test.estimation.joint.test_images import DISTORTED, MARK, datum, dense
from test.support.options import bare
from test.support.plans import image_plan
from test.support.truth import Spread, random_truth, simulate_measurements

LINEAR = bare(causes=False, at_places=False, misalignment_model="linear")
RUNS = 4
NO_DRIFT = (ModelTerm("drift", 0.0),)


def sessions(
    image_m,
    seed,
    *,
    size=7,
    turn=0,
    repeats=1,
    change=0.0,
    missing=0.0,
    sense=Sense.MICROSCOPE_MOVES,
    **spread,
):
    """Return truth after a change, the readings of a calibration and of a later view."""
    plan, rng = image_plan(size), np.random.default_rng(seed)
    again = image_plan(size, turns=(turn,), repeats=repeats)
    truth = random_truth(
        plan.artifact,
        3,
        rng,
        Spread(**{"phi_rad": 0.003, "correlation_pitches": 4.0} | spread),
    )
    settings = CellSettings(
        sigma_xy_m=MARK, image_xy_m=image_m, servo_sigma_m=0.0, sense=sense
    )
    later = replace(
        truth,
        t_m=truth.t_m[2:],
        phi_rad=truth.phi_rad[2:],
        plate_shape_m=truth.plate_shape_m[2:],
        g=truth.g + change * rng.normal(size=truth.g.shape),
    )
    return later, *(
        simulate_measurements(one, its, rng, settings=settings, missing=missing)
        for one, its in ((truth, plan), (later, again))
    )


def values(measurements) -> np.ndarray:
    """Return the readings of all views in the order of `dense`, x and y by turns."""
    return np.concatenate(
        [np.stack([view.dx, view.dy], axis=1).ravel() for view in measurements.views]
    )


def slow_covariance(measurements, slow) -> np.ndarray:
    """Return the covariance of the means of marks, along an axis, by partly slow motion, 1."""
    times = np.unique(
        np.concatenate([view.visits.stamp_ns for view in measurements.views])
    )
    means = []
    for view in measurements.views:
        visits, mean = view.visits, np.zeros((len(view.m), len(times)))
        share = 1 / np.bincount(visits.mark)[visits.mark]
        mean[visits.mark, np.searchsorted(times, visits.stamp_ns)] = share
        means.append(mean)
    mean, white = np.vstack(means), np.eye(len(times))
    motion = slow * toeplitz(slow_correlation(len(times))) + (1 - slow) * white
    return mean @ motion @ mean.T


@pytest.mark.parametrize(
    ("image", "missing", "repeats", "slow"),
    [(3.0, 0.0, 1, 0.0), (1.0, 0.06, 2, 0.0), (3.0, 0.0, 2, 0.8)],
)
def test_map_and_change_as_dense_linear_algebra(image, missing, repeats, slow):
    """The plate of the calibration with its noise, then generalised least squares, both dense."""
    _, before, after = sessions(
        image * MARK,
        5,
        size=5,
        missing=missing,
        repeats=repeats,
        change=3e-8,
        phi_rad=0.0,
    )
    first = solve_joint(before, LINEAR).result
    share, power, sites = first.kept.images.share, first.noise.sigma_xy**2, 25
    assert share > 0.3
    if slow:
        motion = SlowKept(1 - share, (1 - slow) * share, slow * share)
        images = replace(first.kept.images, motion=motion)
        first = replace(first, kept=replace(first.kept, images=images))
    found = recheck(after, LINEAR, known_plate(first, "r.json"))
    later = found.noise.sigma_xy**2

    (early, stops), (late, again) = dense(before), dense(after)
    one = np.eye(len(early)) * (1 - share) + share * np.kron(
        stops[:, None] == stops, np.eye(2)
    )
    weight = np.repeat(np.concatenate([view.count for view in after.views]), 2)
    mark = (1 - share) * power
    two = mark * np.eye(len(late)) + (later - mark) * np.kron(
        again[:, None] == again, np.eye(2)
    )
    two /= np.sqrt(np.outer(weight, weight))
    if slow:
        moved = (later - mark) * slow_covariance(after, slow)
        two = np.diag(mark / weight) + np.kron(moved, np.eye(2))
    noise = block_diag(power * one, two)
    # G and A of the calibration: the scale is the plate's
    inverse, project = np.linalg.pinv(early, rcond=1e-10), datum(before.artifact)
    z = (
        np.stack([before.artifact.m.ravel(), before.artifact.n.ravel()], axis=1).ravel()
        * 1.0
    )
    grown = np.outer(z, z) / (z @ z)
    old = project @ inverse[: 2 * sites]
    plate = inverse[2 * sites : 4 * sites] + grown @ inverse[: 2 * sites]
    plate = plate - (np.eye(2 * sites) - project - grown) @ plate
    # the later map from what the plate leaves, with the covariance of both
    of_plate, free = (
        late[:, 2 * sites : 4 * sites],
        np.delete(late, np.s_[2 * sites : 4 * sites], axis=1),
    )
    left = np.hstack([-of_plate @ plate, np.eye(len(late))])
    root = np.linalg.inv(np.linalg.cholesky(left @ noise @ left.T))
    gain = np.linalg.pinv(root @ free, rcond=1e-9) @ root @ left
    new = project @ gain[: 2 * sites]
    change = new - project @ np.hstack([old, np.zeros((len(old), len(late)))])
    y = np.concatenate([values(before), values(after)])
    recheck_of, shape = found.recheck, (5, 5)
    for rows, of, u in (
        (
            new,
            (found.error_map.gx, found.error_map.gy),
            (found.error_map.u_gx, found.error_map.u_gy),
        ),
        (change, (recheck_of.dx, recheck_of.dy), (recheck_of.u_dx, recheck_of.u_dy)),
    ):
        spread = np.sqrt(np.diag(rows @ noise @ rows.T))
        for axis in range(2):
            np.testing.assert_allclose(
                u[axis], spread[axis::2].reshape(shape), rtol=1e-5
            )
            np.testing.assert_allclose(
                of[axis],
                (rows @ y)[axis::2].reshape(shape),
                rtol=0,
                atol=1e-4 * spread.min(),
            )


@pytest.mark.parametrize("missing", [0.0, 0.06])
def test_both_maps_of_a_calibration_with_noise_of_images_as_dense_linear_algebra(
    missing,
):
    _, before, _ = sessions(3 * MARK, 5, size=5, missing=missing, phi_rad=0.0)
    first = solve_joint(before, LINEAR).result
    kept, project = together(first), datum(before.artifact)
    (matrix, stops), share = dense(before), first.kept.images.share
    inverse = np.linalg.pinv(matrix, rcond=1e-10)
    z = (
        np.stack([before.artifact.m.ravel(), before.artifact.n.ravel()], axis=1).ravel()
        * 1.0
    )
    grown = np.outer(z, z) / (z @ z)
    plate = inverse[50:100] + grown @ inverse[:50]
    plate = plate - (np.eye(50) - project - grown) @ plate
    both = np.vstack(
        [rows[axis::2] for rows in (project @ inverse[:50], plate) for axis in range(2)]
    )
    noise = np.eye(len(matrix)) * (1 - share) + share * np.kron(
        stops[:, None] == stops, np.eye(2)
    )
    wanted = first.noise.sigma_xy**2 * both @ noise @ both.T
    cover = kept.cover(kept.sites, kept.marks)[:-4, :-4]
    np.testing.assert_allclose(cover, wanted, rtol=0, atol=1e-6 * wanted.max())


def population(image_m, runs, **settings):
    """Return (error / u) of the new map and of the change in every run, and the results."""
    away, changes, results = [], [], []
    for seed in range(runs):
        later, before, after = sessions(image_m, seed, plate_shape_m=5e-9, **settings)
        first = calibrate(before, Options(causes=False, terms=NO_DRIFT))
        result = calibrate(
            after, Options(plate=first, plate_from="r.json", terms=NO_DRIFT)
        )
        emap, told = result.error_map, result.recheck
        modes = datum_modes(emap.artifact, scale=True)
        away.append(
            remove_modes(np.stack([emap.gx, emap.gy]) - later.g, modes)
            / np.stack([emap.u_gx, emap.u_gy])
        )
        if not settings.get("change"):
            changes.append(
                np.stack([told.dx, told.dy]) / np.stack([told.u_dx, told.u_dy])
            )
        results.append(result)
    return np.array(away), np.array(changes), results


def require_within(away: np.ndarray) -> None:
    """Require errors of the size of u; a map has some 20 independent ones."""
    assert 0.85 < np.sqrt((away**2).mean()) < 1.15
    assert (np.abs(away) < 2).mean() >= binom.ppf(
        1e-3, 20 * len(away), 0.9545
    ) / 20 / len(away)


@pytest.mark.parametrize(
    ("part", "settings"),
    [
        (0.3, {"sense": Sense.PLATE_MOVES, "turn": 180}),
        (1.0, {"repeats": 2, **DISTORTED}),
    ],
)
def test_an_unchanged_stage_is_found_within_its_uncertainty(part, settings):
    away, changes, results = population(part * MARK, RUNS, **settings)
    assert all(result.verdict.qualified or result.recheck.changed for result in results)
    require_within(away)
    require_within(changes)
    assert sum(result.recheck.changed for result in results) <= binom.ppf(
        0.999, RUNS, 0.05
    )


def test_a_changed_stage_is_said_to_have_changed():
    away, _, results = population(MARK, 3, change=2e-7)
    require_within(away)
    assert all(result.recheck.changed for result in results)


def test_what_a_view_with_images_will_tell_is_predicted():
    """Noise of images alone: the map of one image a site has its noise but for the datum's."""
    _, before, after = sessions(100 * MARK, 5, phi_rad=0.0)
    plate = known_plate(solve_joint(before, LINEAR).result, "r.json")
    planned = predict_recheck(
        replace(image_plan(7, turns=(0,)), artifact_from="r.json"), plate
    )
    result = recheck(after, LINEAR, plate)
    u = (
        np.stack([result.error_map.u_gx, result.error_map.u_gy])
        / plate.result.noise.sigma_xy
    )
    np.testing.assert_allclose(planned.map.u_xy, u, rtol=1e-6)
    assert 0.9 < planned.map.rms_xy < 1.3


def test_a_plate_calibrated_with_one_mark_an_image_does_not_tell_its_noise():
    _, before, after = sessions(MARK, 1, size=5)
    first = calibrate(before)
    alone = replace(first, kept=replace(first.kept, images=None))
    with pytest.raises(
        InputError, match="not separated into that of images and that of marks"
    ):
        calibrate(after, Options(plate=alone, plate_from="r.json"))


def slow_session(seed, repeats, *, change_m=0.0, times=1, within_m=None):
    """Return a calibration and a recheck with slow motion, `times` as large in the latter.

    `within_m` is the scatter of its exposures within a visit.
    """
    plan, rng = (
        image_plan(7, turns=(0, 90, 180), repeats=2),
        np.random.default_rng(seed),
    )
    again = image_plan(7, turns=(0,), repeats=repeats)
    spread = Spread(phi_rad=5e-4, correlation_pitches=4.0)
    truth = random_truth(plan.artifact, 3, rng, spread)
    settings = CellSettings(sigma_xy_m=MARK, flicker_xy_m=2 * MARK, servo_sigma_m=0.0)
    bent = (truth.artifact.m**2 / truth.artifact.m.max() ** 2, 0 * truth.artifact.m)
    later = replace(
        truth,
        t_m=truth.t_m[2:],
        phi_rad=truth.phi_rad[2:],
        plate_shape_m=truth.plate_shape_m[2:],
        g=truth.g + change_m * np.stack(bent),
    )
    before = simulate_measurements(truth, plan, rng, settings=settings)
    settings = replace(settings, flicker_xy_m=times * settings.flicker_xy_m)
    after = simulate_measurements(later, again, rng, settings=settings)
    if within_m is not None:
        views = [replace(v, sigma_xy=within_m, dof_xy=60) for v in after.views]
        after = replace(after, views=tuple(views))
    first = calibrate(before, Options(causes=False))
    return first, calibrate(after, Options(plate=first, plate_from="r.json"))


@pytest.mark.parametrize(("repeats", "seeds"), [(1, (4, 7, 19)), (2, (10, 17, 27))])
def test_slow_motion_is_no_change_of_the_stage(repeats, seeds):
    """Seeds of which all were said to have changed, p down to 1e-5, with motion taken as white."""
    for seed in seeds:
        first, result = slow_session(seed, repeats)
        motion = first.kept.images.motion
        assert motion.slow > 3 * motion.white
        assert not result.recheck.changed
        sigma = np.hypot(MARK, 2 * MARK)
        assert result.noise.sigma_xy == pytest.approx(sigma, rel=0.3)


def test_exposures_of_one_visit_do_not_show_how_large_slow_motion_is():
    first, result = slow_session(4, 1, within_m=MARK)
    assert not result.recheck.changed
    assert result.noise.sigma_xy == pytest.approx(first.noise.sigma_xy, rel=0.1)


@pytest.mark.parametrize(("motion_m", "dof"), [(1e-11, 60), (1e-5, 15)])
def test_four_marks_of_an_image_that_move_together_are_as_one(motion_m, dof):
    """White motion: repeats that show nothing else have a quarter of the degrees of freedom."""
    white = MotionOfStops(np.eye(1), 1.0, 1.0)
    images = StopsOfImages(np.zeros((1, 2, 2), dtype=int), MARK**2, motion_m**2, white)
    assert images.repeats(MARK, 60) == pytest.approx((MARK, dof), rel=1e-3)


def test_identical_exposures_average_nothing():
    """Nor does the noise of the marks, by which it is tested whether the plate fits."""
    _, before, after = sessions(2 * MARK, 3)
    first = calibrate(before, Options(causes=False))
    recheck_of = Options(plate=first, plate_from="r.json")
    views = [
        replace(view, count=4 * view.count, sigma_xy=0.0, dof_xy=3 * len(view.m))
        for view in after.views
    ]
    once, again = (
        calibrate(one, recheck_of)
        for one in (after, replace(after, views=tuple(views)))
    )
    assert again.verdict.grade is once.verdict.grade
    assert again.error_map.u_gx == pytest.approx(once.error_map.u_gx)
    assert again.recheck.p == pytest.approx(once.recheck.p)


def test_a_change_is_found_beside_slow_motion():
    assert slow_session(0, 1, change_m=2e-7)[1].recheck.changed


def test_few_repeats_that_show_more_slow_motion_than_the_calibration_count():
    first, result = slow_session(0, 2, times=2)
    assert result.noise.sigma_xy > 1.5 * first.noise.sigma_xy
    assert result.noise.dof_xy < 30 and not result.recheck.changed
