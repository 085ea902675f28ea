# SPDX-License-Identifier: Apache-2.0
"""The same problem put in two ways has one answer: order, turn, mirror, unit, datum."""

from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.estimation.api import calibrate, robust_calibrate
from selfcal_ros.estimation.joint.solve import solve_joint
from selfcal_ros.estimation.quality import validation
from selfcal_ros.estimation.quality.outliers import clean, noisy_views, residuals_of
from selfcal_ros.estimation.quality.validation import validate
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.readings import Sense, ViewReadings, subset
from selfcal_ros.model.reference import ReferenceLength
from test.support.lattice_plans import plan_of
from test.support.options import BARE, bare
from test.support.recalibrations import responses, sizes_of, values_of, with_values
from test.support.refusals import refused
from test.support.truth import Spread, hu_plan, random_truth, simulate_measurements
from test.support.two_ways import (
    maps_of,
    mirrored,
    mirrored_back,
    permuted,
    scaled,
    turned,
    turned_back,
    with_finite_rotations,
)

SIGMA_M, SIGMA_RAD = 2e-8, 2e-5
WIDE = Artifact(9, 0.01, 8, 5)
CASES = {
    "square": plan_of("0,90,180,2ty,90+tx", Artifact(7, 0.01, 12), lines=1),
    "wide": plan_of("0,90,tx,-tx,ty", WIDE, lines=1),
    "circle of 360": plan_of("0,90,tx", Artifact(5, 0.01, 360), lines=1),
}


def measured(plan, seed=3, *, spread=None, **how):
    rng = np.random.default_rng(seed)
    truth = random_truth(plan.artifact, len(plan.views), rng, spread)
    return truth, simulate_measurements(
        truth, plan, rng, **{"sigma_m": SIGMA_M, "sigma_theta_rad": SIGMA_RAD} | how
    )


def require_same(found, wanted, *, unit=1.0):
    for key, value in wanted.items():
        factor = unit if key.startswith(("gx", "gy", "u_gx", "u_gy")) else 1.0
        size = np.nanmax(abs(value), initial=1e-30)
        np.testing.assert_allclose(
            found[key] / factor, value, rtol=0, atol=1e-7 * size, err_msg=key
        )


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize(
    ("kind", "turned_kind", "missing"),
    [
        (None, None, 0.0),
        (None, None, 0.1),
        ("stage_x", "stage_y", 0.0),
        ("artifact", "artifact", 0.1),
    ],
)
def test_order_turn_mirror_and_unit_change_nothing_but_the_frame(
    name, kind, turned_kind, missing
):
    _, readings = measured(CASES[name], missing=missing)
    options, of_turned = (
        bare(reference=ReferenceLength(of, 3e-6, 1e-7) if of else None)
        for of in (kind, turned_kind)
    )
    wanted = maps_of(solve_joint(readings, options).result)
    require_same(maps_of(solve_joint(permuted(readings), options).result), wanted)
    backwards = replace(readings, views=readings.views[::-1])
    require_same(maps_of(solve_joint(backwards, options).result), wanted)
    require_same(turned_back(solve_joint(turned(readings), of_turned).result), wanted)
    require_same(mirrored_back(solve_joint(mirrored(readings), options).result), wanted)
    for unit in (50.0, 0.001):
        require_same(
            maps_of(solve_joint(scaled(readings, unit), options).result),
            wanted,
            unit=unit,
        )


@pytest.mark.parametrize("sense", Sense)
def test_the_angular_datum_decides_nothing_about_outliers(sense):
    """The stage does not satisfy the axis conditions: no fault of any single reading."""
    _, readings = measured(
        hu_plan(Artifact(7, 0.01, 24)), sigma_theta_rad=2e-6, sense=sense
    )
    views = [
        replace(
            view,
            dtheta=view.dtheta
            + 2e-4
            * (
                ((view.k + view.view.lattice_pose(readings.artifact).turn_lines) % 24)
                == 0
            ),
        )
        for view in readings.views
    ]
    bent = replace(readings, views=tuple(views))
    found = [clean(bent, bare(datum_theta=datum)) for datum in ("xy_axes", "zero_mean")]
    assert found[0].removed == found[1].removed == ()
    for one, two in zip(*(item.measurements.views for item in found), strict=True):
        assert np.array_equal(one.k, two.k)


def test_robust_knows_finite_rotations_of_a_rough_plate():
    """A plate error of 20 um turned by a degree moves 0.3 um: seventeen times the noise."""
    spread = Spread(a_m=20e-6, phi_rad=0.02)
    truth, readings = measured(
        plan_of("0,90,180,tx,ty", Artifact(9, 0.01)), spread=spread, linear=True
    )
    bent = with_finite_rotations(readings, truth)
    result = robust_calibrate(bent, BARE)
    assert result.parts.outliers.removed == () and result.parts.slips == ()
    assert result.parts.noisy_views == ()
    require_same(maps_of(result), maps_of(calibrate(bent, BARE)))


@pytest.fixture
def few_draws(monkeypatch):
    """Draw the limits of predictions roughly: what is compared here is the prediction."""
    monkeypatch.setattr(validation, "N_DRAWS", 16)


@pytest.mark.parametrize("sense", Sense)
def test_validation_predicts_by_the_model_that_was_fitted(sense, few_draws):
    plan = plan_of("0,90,180,tx,ty", Artifact(7, 0.01))
    truth, readings = measured(
        plan, sense=sense, spread=Spread(a_m=20e-6, phi_rad=0.02), linear=True
    )
    wanted = validate(readings, bare(misalignment_model="linear"), folds=1)
    bent = with_finite_rotations(readings, truth)
    for one, two in zip(validate(bent, BARE, folds=1), wanted, strict=True):
        assert one.n_grid == two.n_grid and one.why == two.why
        if one.n_grid:
            # a held-out whole view is placed anew, so that only the noise turns a little
            assert one.rms_m == pytest.approx(two.rms_m, rel=0.03)
            assert one.ratio == pytest.approx(two.ratio, rel=0.03)


def test_validation_does_not_depend_on_the_order_of_readings(few_draws):
    _, readings = measured(CASES["square"])
    wanted = validate(readings, BARE, folds=2)
    for one, two in zip(
        validate(permuted(readings), BARE, folds=2), wanted, strict=True
    ):
        assert (one.n_grid, one.n_angular, one.why) == (
            two.n_grid,
            two.n_angular,
            two.why,
        )
        assert one.rms_m == pytest.approx(two.rms_m, nan_ok=True)
        assert one.rms_rad == pytest.approx(two.rms_rad, nan_ok=True)


def test_views_with_too_few_readings_to_tell_are_not_called_noisy():
    """Three views of 5 x 5 marks leave 38 numbers over, three of them to each view's noise."""
    plan = plan_of("0,90,tx", Artifact(5, 0.01))
    for seed in range(25):
        readings = measured(plan, seed)[1]
        assert noisy_views(residuals_of(readings, BARE), readings) == ()


@pytest.mark.parametrize(
    ("sigma_m", "sigma_rad", "limit_m"),
    [
        (2e-8, 0.0, 3e-8),
        (1e-3, 0.0, 1.5e-3),
        (1e-6, 1e-13, 1.5e-6),
        (0.0, 2e-5, 1e-12),
        (1e-15, 1e-3, 1e-12),
        (0.0, 0.0, 1e-16),
    ],
)
def test_one_kind_of_readings_may_be_exact(sigma_m, sigma_rad, limit_m):
    """Twenty orders of magnitude between the weights shall not lose what the lighter one tells."""
    truth, readings = measured(
        CASES["square"], sigma_m=sigma_m, sigma_theta_rad=sigma_rad
    )
    for solve in (calibrate, robust_calibrate):
        emap = solve(readings).error_map
        error = np.sqrt(
            np.mean(np.square([emap.gx - truth.g[0], emap.gy - truth.g[1]]))
        )
        assert error < limit_m
        left = emap.g_theta - truth.g_theta
        assert np.sqrt(np.mean((left - left.mean()) ** 2)) < 3 * max(
            sigma_rad, sigma_m * 50, 1e-15
        )


def test_a_view_that_was_never_read_is_missed_by_name():
    """Planned, but without a reading: the advice must not count on it."""
    _, readings = measured(CASES["square"])
    gone = {1, 4}  # both views turned by a quarter
    views = tuple(
        ViewReadings(view.view) if i in gone else view
        for i, view in enumerate(readings.views)
    )
    with refused("add a view turned by 90°"):
        calibrate(replace(readings, views=views), BARE)


def test_readings_of_zero_alone_take_a_reference():
    still = Spread(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    _, readings = measured(
        CASES["square"], sigma_m=0.0, sigma_theta_rad=0.0, spread=still
    )
    options = bare(reference=ReferenceLength("stage_x", 1e-6, 1e-6))
    emap = calibrate(readings, options).error_map
    assert np.allclose(emap.gx, 1e-6 * emap.artifact.x_m, rtol=1e-9, atol=0)


def test_a_line_of_a_fine_circle_that_is_read_once_cannot_be_checked():
    _, readings = measured(CASES["circle of 360"])
    views = tuple(
        subset(view, np.ones(len(view.m), dtype=bool), (view.k != 7) | (row == 0))
        for row, view in enumerate(readings.views)
    )
    left = residuals_of(replace(readings, views=views), BARE)
    assert left.lines.redundancy[0, 7] < 1e-9 and np.isnan(left.lines.squares[0, 7])
    assert left.lines.redundancy.sum() == pytest.approx(left.lines.dof)
    # lines beside the gap are checked by fewer readings than the others
    assert np.ptp(left.lines.redundancy[left.lines.redundancy > 0.05]) > 0.1


ROUGH = Spread(a_m=20e-6, phi_rad=0.02)
PAPERS = bare(datum_theta="xy_axes", misalignment_model="linear")
LINEAR = bare(misalignment_model="linear")
SHIFTS = plan_of("0,90+tx,2ty,270-2tx+ty,tx", Artifact(5, 0.01, 12), lines=1)
FOUR = plan_of("0,90,tx", Artifact(5, 0.01, 4), lines=1)


def numbers_of(result):
    return np.concatenate(
        [maps_of(result)[key].ravel() for key in ("gx", "gy", "g_theta")]
    )


@pytest.mark.parametrize(
    ("plan", "sense", "missing", "options"),
    [
        (SHIFTS, Sense.PLATE_MOVES, 0.2, PAPERS),
        (FOUR, Sense.MICROSCOPE_MOVES, 0.0, PAPERS),
        (FOUR, Sense.PLATE_MOVES, 0.0, LINEAR),
    ],
)
def test_uncertainties_are_those_of_every_reading_moved_in_turn(
    plan, sense, missing, options
):
    _, readings = measured(
        plan,
        sense=sense,
        missing=missing,
        sigma_m=0.0,
        sigma_theta_rad=0.0,
        spread=Spread(encoder="xy_axes"),
        linear=True,
    )
    readings = replace(
        readings,
        views=tuple(
            replace(
                view,
                sigma_xy=SIGMA_M,
                dof_xy=1000,
                sigma_theta=SIGMA_RAD,
                dof_theta=1000,
            )
            for view in readings.views
        ),
    )
    quick = replace(options, uncertainty=False, causes=False)
    answers = responses(
        lambda moved: numbers_of(solve_joint(moved, quick).result),
        readings,
        sizes_of(readings, SIGMA_M, SIGMA_RAD),
    )
    found = maps_of(calibrate(readings, options))
    u = np.concatenate([found["u_" + key].ravel() for key in ("gx", "gy", "g_theta")])
    known = np.isfinite(u)
    assert known.sum() > 0.8 * len(u)
    np.testing.assert_allclose(
        u[known], np.sqrt((answers[:, known] ** 2).sum(axis=0)), rtol=1e-6
    )


@pytest.mark.parametrize(
    ("plan", "sense", "missing"),
    [(SHIFTS, Sense.PLATE_MOVES, 0.2), (CASES["square"], Sense.MICROSCOPE_MOVES, 0.0)],
)
def test_uncertainties_are_the_scatter_of_recalibrations_of_rough_plates(
    plan, sense, missing
):
    """Finite rotations of a plate that errs by 20 um, noise told by the residuals alone."""
    rng = np.random.default_rng(11)
    truth, clean = measured(
        plan,
        sense=sense,
        missing=missing,
        sigma_m=0.0,
        sigma_theta_rad=0.0,
        spread=ROUGH,
        linear=True,
    )
    clean = with_finite_rotations(clean, truth)
    options = bare(causes=False)
    wanted, squares = maps_of(calibrate(clean, options)), {"xy": [], "theta": []}
    for _ in range(30):
        draw = rng.normal(size=len(values_of(clean))) * sizes_of(
            clean, SIGMA_M, SIGMA_RAD
        )
        moved = with_values(clean, values_of(clean) + draw)
        found = maps_of(solve_joint(moved, options).result)
        for key, kind in (("gx", "xy"), ("gy", "xy"), ("g_theta", "theta")):
            z = (found[key] - wanted[key]) / found["u_" + key]
            squares[kind].append(z[np.isfinite(z)] ** 2)
    for kind, tolerance in (("xy", 0.1), ("theta", 0.35)):
        values = np.concatenate(squares[kind])
        assert values.mean() == pytest.approx(1, abs=tolerance)
        assert np.mean(values < 4) == pytest.approx(0.95, abs=tolerance / 4)


@pytest.mark.parametrize("factor", [1e-3, 50.0])
def test_finite_rotations_settle_in_any_unit(factor):
    _, readings = measured(CASES["square"], spread=ROUGH)
    wanted, found = calibrate(readings, BARE), calibrate(scaled(readings, factor), BARE)
    assert np.allclose(
        found.error_map.gx / factor, wanted.error_map.gx, rtol=0, atol=1e-14
    )
    assert [v.phi for v in found.views] == pytest.approx(
        [v.phi for v in wanted.views], abs=2e-13
    )


def test_a_plate_laid_exactly_has_settled():
    straight = Spread(phi_rad=0.0, t_m=0.0)
    truth, readings = measured(
        CASES["square"], spread=straight, sigma_m=0.0, sigma_theta_rad=0.0
    )
    found = calibrate(readings, BARE)
    assert np.abs(found.error_map.gx - truth.g[0]).max() < 1e-15
