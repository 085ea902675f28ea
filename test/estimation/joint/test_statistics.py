# SPDX-License-Identifier: Apache-2.0
"""Predicted uncertainties: the published bounds, every reading moved in turn, noise."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from selfcal_ros.errors import InputError
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.joint.problem import coverage_factor
from selfcal_ros.estimation.joint.solve import solve_joint
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.error_map import ThetaDatum
from selfcal_ros.model.readings import Sense, subset
from selfcal_ros.model.reference import ReferenceKind, ReferenceLength
from selfcal_ros.reporting.words.findings import worded
from test.support.lattice_plans import in_datum, plan_of
from test.support.map_covariance import map_covariance
from test.support.options import BARE, MARKS, bare, reference_length
from test.support.recalibrations import responses, sizes_of, values_of, with_values
from test.support.truth import Spread, hu_plan, random_truth, simulate_measurements

TABLE = {  # method, section 11: rms of u(G) / sigma of a reading for N = 5, 11, 21
    "0,90,tx": (0.800, 0.890, 0.949),
    "0,90,180,tx": (0.664, 0.763, 0.825),
    "0,90,tx,ty": (0.622, 0.660, 0.686),
    "0,90,180,tx,ty": (0.532, 0.581, 0.612),
    "0,90,180,270,tx,ty": (0.477, 0.530, 0.563),
}


def measured(plan, seed=1, **how):
    rng = np.random.default_rng(seed)
    truth = random_truth(plan.artifact, len(plan.views), rng)
    return truth, simulate_measurements(truth, plan, rng, **how)


@pytest.mark.parametrize("names", TABLE)
@pytest.mark.parametrize("size", [5, 11, 21])
def test_rms_uncertainty_is_the_published_bound(names, size):
    _, readings = measured(plan_of(names, Artifact(size, 0.01)), sigma_m=1e-8)
    found = calibrate(readings, bare(causes=False))
    emap = found.error_map
    rms = np.sqrt(np.mean([emap.u_gx**2, emap.u_gy**2])) / found.noise.sigma_xy
    assert round(rms, 3) == TABLE[names][(5, 11, 21).index(size)]


@pytest.mark.parametrize(
    ("lines", "datum", "bound"),
    [
        (24, "xy_axes", 0.752),
        (24, "zero_mean", 0.677),
        (72, "xy_axes", 1.129),
        (72, "zero_mean", 0.891),
    ],
)
def test_angular_bounds(lines, datum, bound):
    """With XY readings so good that the rotations are known (method, section 11)."""
    _, readings = measured(
        hu_plan(Artifact(11, 0.01, lines)), sigma_m=1e-12, sigma_theta_rad=1e-5
    )
    found = calibrate(readings, bare(datum_theta=ThetaDatum(datum), causes=False))
    rms = np.sqrt(np.mean(found.error_map.u_g_theta**2)) / found.noise.sigma_theta
    assert round(rms, 3) == bound


def stated(readings, sigma, sigma_theta):
    """Return the readings with their noise stated, so that the weights are fixed."""
    return replace(
        readings,
        views=tuple(
            replace(
                view,
                sigma_xy=sigma,
                dof_xy=1000,
                sigma_theta=sigma_theta,
                dof_theta=1000,
            )
            for view in readings.views
        ),
    )


def map_numbers(options):
    """Return a function from readings to G and Gtheta in one row."""
    quick = replace(options, uncertainty=False, causes=False)

    def solve(readings):
        emap = solve_joint(readings, quick).result.error_map
        return np.concatenate([emap.gx.ravel(), emap.gy.ravel(), emap.g_theta])

    return solve


LINEAR = bare(misalignment_model="linear")


@pytest.mark.parametrize(("missing", "sigma_theta"), [(0.0, 1e-5), (0.2, 2e-8)])
def test_uncertainty_is_that_of_every_reading_moved_in_turn(missing, sigma_theta):
    """Also with angular readings so good that they steer the rotations, and unequal repeats.

    The solution is linear in the readings: the squares of its answers to one standard deviation
    of each add up to its variance, with nothing left to chance. A few true re-solves, also of the
    model of finite rotations, show that draws of noise are sums of these answers.
    """
    sigma, rng = 2e-8, np.random.default_rng(3)
    plan = hu_plan(Artifact(5, 0.01, 12))
    for options, exact, tolerance in ((LINEAR, True, 1e-6), (BARE, False, 0.03)):
        _, readings = measured(
            plan, seed=12, missing=missing, sense=Sense.PLATE_MOVES, linear=exact
        )
        readings = stated(
            replace(
                readings,
                views=tuple(
                    replace(view, count=1 + (view.m + 2 * view.n) % 3)
                    for view in readings.views
                ),
            ),
            sigma,
            sigma_theta,
        )
        solve, sizes = map_numbers(options), sizes_of(readings, sigma, sigma_theta)
        emap = calibrate(readings, options).error_map
        u = np.concatenate([emap.u_gx.ravel(), emap.u_gy.ravel(), emap.u_g_theta])
        known = np.isfinite(u)
        assert known.sum() > 0.8 * len(u)
        if exact:
            answers = responses(solve, readings, sizes)[:, known]
        assert np.sqrt((answers**2).sum(axis=0)) == pytest.approx(u[known], rel=1e-8)
        for _ in range(3):
            draw = rng.normal(size=len(sizes))
            moved = solve(with_values(readings, values_of(readings) + draw * sizes))
            errors = (moved - solve(readings))[known] - draw @ answers
            assert np.abs(errors / u[known]).max() < tolerance


def test_covariance_is_that_of_every_reading_moved_in_turn():
    sigma, artifact = 2e-8, Artifact(7, 0.01)
    _, readings = measured(
        plan_of("0,90,tx", artifact), seed=4, sense=Sense.PLATE_MOVES, linear=True
    )
    readings = stated(readings, sigma, 1.0)
    cover = map_covariance(readings, LINEAR)
    i, j = np.array([0, 3, 6]), np.array([1, 3, 6])
    answers = responses(map_numbers(LINEAR), readings, sizes_of(readings, sigma, 1.0))
    answers = answers[:, : 2 * 49].reshape(-1, 2, *artifact.shape)
    at_nodes = answers[:, :, i, j].reshape(len(answers), -1)
    predicted = cover.nodes(i, j)
    size = np.sqrt(np.outer(np.diag(predicted), np.diag(predicted)))
    assert np.abs((at_nodes.T @ at_nodes - predicted) / size).max() < 1e-8
    emap = calibrate(readings, LINEAR).error_map
    assert np.sqrt(np.diag(predicted)) == pytest.approx(
        np.r_[emap.u_gx[i, j], emap.u_gy[i, j]], rel=1e-9
    )


def test_coverage_factor_grows_with_few_degrees_of_freedom():
    assert coverage_factor(float("inf")) == pytest.approx(2.0, abs=1e-3)
    assert coverage_factor(10) == pytest.approx(2.28, abs=0.01)


@pytest.mark.parametrize("kind", ReferenceKind)
@pytest.mark.parametrize("sense", Sense)
def test_a_reference_length_sets_the_scale_and_its_uncertainty(kind, sense):
    """In the linear model, where a scale is a datum and nothing else."""
    sigma, scale = 2e-8, 3e-6
    artifact = Artifact(5, 0.01)
    plan = plan_of("0,90,tx", artifact)
    _, clean = measured(plan, seed=2, sense=sense, missing=0.05, linear=True)
    linear = bare(misalignment_model="linear")
    free = calibrate(clean, linear)
    grown = np.stack([artifact.x_m, artifact.y_m])
    if kind is ReferenceKind.ARTIFACT:
        reached = in_datum(
            np.stack([free.artifact_map.ax, free.artifact_map.ay]),
            np.isfinite(free.artifact_map.ax),
            artifact,
            scale=False,
        )
        good = np.isfinite(reached)
        value = (reached[good] @ grown[good]) / (grown[good] @ grown[good])
        reference = ReferenceLength(kind, value - scale, 2e-6)
    elif kind is ReferenceKind.MARKS:
        plate = free.artifact_map
        one, two = ((m + 2, n + 2) for m, n in MARKS)
        apart = grown[:, *two] - grown[:, *one]
        now = apart + [a[two] - a[one] for a in (plate.ax, plate.ay)]
        value = np.hypot(*now) / np.hypot(*apart) - 1
        reference = reference_length(kind, value - scale, 2e-6)
    else:
        axis = 0 if kind is ReferenceKind.STAGE_X else 1
        error = free.error_map.gx if axis == 0 else free.error_map.gy
        known = np.isfinite(error)
        value = np.polyfit(grown[axis][known], error[known], 1)[0]
        reference = ReferenceLength(kind, value + scale, 2e-6)
    found = calibrate(clean, replace(linear, reference=reference))
    known = found.error_map.valid
    assert found.error_map.gx[known] == pytest.approx(
        (free.error_map.gx + scale * artifact.x_m)[known], abs=1e-14
    )
    assert found.error_map.gy[known] == pytest.approx(
        (free.error_map.gy + scale * artifact.y_m)[known], abs=1e-14
    )
    assert (
        np.nanmax(
            abs(found.artifact_map.ax - free.artifact_map.ax + scale * artifact.x_m)
        )
        < 1e-14
    )
    readings, options = stated(clean, sigma, 1.0), replace(linear, reference=reference)
    emap = calibrate(readings, options).error_map
    answers = responses(map_numbers(options), readings, sizes_of(readings, sigma, 1.0))
    longer = replace(
        reference, relative_error=reference.relative_error + reference.u_relative
    )
    of_length = map_numbers(replace(linear, reference=longer))(readings) - map_numbers(
        options
    )(readings)
    spread = np.sqrt((answers**2).sum(axis=0) + of_length**2)
    predicted = np.concatenate([emap.u_gx.ravel(), emap.u_gy.ravel()])
    known = np.isfinite(predicted)
    assert spread[known] == pytest.approx(predicted[known], rel=1e-8)


@pytest.mark.parametrize("sense", Sense)
def test_a_reference_length_of_a_plate_that_turns_is_met_exactly(sense):
    """A stage that indicates 3e-6 too much, and a plate whose length is certified."""
    plan = plan_of("0,90,tx", Artifact(5, 0.01))
    truth = random_truth(plan.artifact, 3, np.random.default_rng(2))
    grown = np.stack([plan.artifact.x_m, plan.artifact.y_m])
    plate_scale = (truth.a * grown).sum() / (grown**2).sum()
    long = replace(truth, g=truth.g + 3e-6 * grown)
    readings = simulate_measurements(long, plan, np.random.default_rng(1), sense=sense)
    found = calibrate(
        readings, bare(reference=ReferenceLength("artifact", plate_scale))
    )
    assert np.abs(found.error_map.gx - long.g[0]).max() < 1e-12
    assert np.abs(found.error_map.gy - long.g[1]).max() < 1e-12


def test_a_reference_must_be_a_small_number():
    with pytest.raises(InputError, match="not a relative error"):
        ReferenceLength("artifact", 1.0)
    with pytest.raises(InputError, match="not a standard uncertainty"):
        ReferenceLength("stage_x", 0.0, -1e-6)


class TestNoise:
    plan = hu_plan(Artifact(11, 0.01, 24), repeats=5)

    def test_residuals_and_repeats_agree_on_honest_readings(self):
        _, readings = measured(self.plan, sigma_m=1e-8, sigma_theta_rad=1e-6)
        noise = calibrate(readings, BARE).noise
        assert noise.sigma_xy == noise.sigma_xy_repeats == pytest.approx(1e-8)
        assert noise.dof_xy_residuals == 2 * (121 + 121 + 110) - (493 - 7)
        low, high = (
            chi2.ppf([1e-4, 1 - 1e-4], noise.dof_xy_residuals) / noise.dof_xy_residuals
        )
        assert low < (noise.sigma_xy_residuals / 1e-8) ** 2 < high
        low, high = (
            chi2.ppf([1e-4, 1 - 1e-4], noise.dof_theta_residuals)
            / noise.dof_theta_residuals
        )
        assert low < (noise.sigma_theta_residuals / 1e-6) ** 2 < high
        assert calibrate(readings, BARE).findings == ()

    def test_residuals_that_exceed_repeats_are_told(self):
        _, readings = measured(self.plan, sigma_m=1e-8, sigma_theta_rad=1e-6)
        calm = replace(
            readings,
            views=tuple(
                replace(view, sigma_xy=view.sigma_xy / 3) for view in readings.views
            ),
        )
        found = worded(calibrate(calm, BARE))
        text = " ".join(found.verdict.reasons)
        assert "grid readings: residuals show a noise of" in text
        assert "something other than random noise" in text
        assert "angular readings" not in text
        assert not found.verdict.qualified
        assert found.noise.sigma_xy == found.noise.sigma_xy_residuals
        assert found.noise.dof_xy == found.noise.dof_xy_residuals

    def test_repeats_that_exceed_residuals_are_told_and_count(self):
        _, readings = measured(self.plan, sigma_m=1e-8, sigma_theta_rad=1e-6)
        wild = replace(
            readings,
            views=tuple(
                replace(view, sigma_xy=view.sigma_xy * 2) for view in readings.views
            ),
        )
        found = worded(calibrate(wild, BARE))
        assert "the stated noise is too large" in found.verdict.reasons[0]
        assert found.noise.sigma_xy == found.noise.sigma_xy_repeats

    @pytest.mark.parametrize("sigma_m", [1e-8, 0.0])
    def test_repeats_identical_to_the_last_bit_tell_no_noise(self, sigma_m):
        _, readings = measured(self.plan, sigma_m=sigma_m, sigma_theta_rad=1e-6)
        stuck = replace(
            readings,
            views=tuple(replace(view, sigma_xy=0.0) for view in readings.views),
        )
        found = calibrate(stuck, BARE)
        assert found.verdict.qualified
        if sigma_m:
            assert found.noise.sigma_xy == found.noise.sigma_xy_residuals
            assert np.isnan(found.noise.p_xy)

    def test_without_repeats_the_residuals_speak(self):
        _, readings = measured(hu_plan(Artifact(11, 0.01, 24)), sigma_m=1e-8)
        noise = calibrate(readings, BARE).noise
        assert noise.sigma_xy == noise.sigma_xy_residuals
        assert noise.dof_xy_repeats == 0 and np.isnan(noise.sigma_xy_repeats)

    def test_declared_uncertainties_are_the_noise(self):
        _, readings = measured(hu_plan(Artifact(11, 0.01)), sigma_m=1e-8)
        declared = replace(
            readings,
            views=tuple(
                replace(view, u=np.full(len(view.m), 1e-8)) for view in readings.views
            ),
        )
        found = calibrate(declared, BARE)
        of = found.noise  # eight degrees of freedom, with those of the residuals
        squares = 8 * 1e-8**2 + of.dof_xy_residuals * of.sigma_xy_residuals**2
        assert of.sigma_xy == pytest.approx(
            np.sqrt(squares / (8 + of.dof_xy_residuals))
        )
        assert np.sqrt(np.mean(found.error_map.u_gx**2)) == pytest.approx(
            0.89 * found.noise.sigma_xy, rel=0.02
        )


def test_an_encoder_that_does_not_follow_the_axes_is_told_and_bends_nothing():
    plan = hu_plan(Artifact(11, 0.01, 24))
    rng = np.random.default_rng(1)
    truth = random_truth(plan.artifact, 4, rng, Spread(encoder="xy_axes"))
    g_theta = truth.g_theta.copy()
    g_theta[6] += 1e-4
    readings = simulate_measurements(
        replace(truth, g_theta=g_theta), plan, rng, sigma_m=1e-9, sigma_theta_rad=1e-6
    )
    axes = worded(calibrate(readings, bare(datum_theta="xy_axes")))
    free = calibrate(readings, bare(datum_theta="zero_mean"))
    assert not axes.verdict.qualified and len(axes.verdict.reasons) == 1
    reason = axes.verdict.reasons[0]
    assert reason.startswith("theta: the stage does not satisfy the axis conditions")
    assert reason.endswith("use zero_mean")
    assert free.verdict.qualified
    assert axes.error_map.gx.tobytes() == free.error_map.gx.tobytes()
    assert np.abs(free.error_map.g_theta - (g_theta - g_theta.mean())).max() < 1e-5


def test_half_axes_that_are_not_known_as_a_whole_are_refused():
    plan, rng = (
        plan_of("0,90,tx", Artifact(3, 0.01, 8), lines=1),
        np.random.default_rng(1),
    )
    readings = simulate_measurements(random_truth(plan.artifact, 4, rng), plan, rng)
    axes = bare(datum_theta="xy_axes")
    with pytest.raises(InputError) as caught:
        calibrate(readings, axes)
    assert str(caught.value) == (
        "theta datum xy_axes: the half axis along +x has one site, which gives no "
        "slope; measure what is missing there, or use zero_mean"
    )
    _, readings = measured(hu_plan(Artifact(7, 0.01, 24)))
    end = replace(
        readings,
        views=tuple(  # the site at the end of -y is never visited
            without_site(view, (0, -3), readings.artifact) for view in readings.views
        ),
    )
    with pytest.raises(InputError, match="half axis along -y is known at 2 of 3 sites"):
        calibrate(end, axes)
    assert calibrate(end, bare(datum_theta="zero_mean")).observability.identifiable


def without_site(view, site, artifact):
    """Return readings without the mark that lay on one site."""
    if not len(view.m):
        return view
    i, j = view.view.lattice_pose(artifact).site_of(view.m, view.n)
    keep = (i != site[0]) | (j != site[1])
    return replace(
        view,
        m=view.m[keep],
        n=view.n[keep],
        dx=view.dx[keep],
        dy=view.dy[keep],
        count=view.count[keep],
    )


@pytest.mark.parametrize("degrees", [0.3, 2.0])
def test_finite_rotations_need_and_take_the_rigid_model(degrees):
    plan = plan_of("0,90,tx", Artifact(7, 0.01))
    truth, readings = measured(plan)
    phi = np.deg2rad(degrees) * np.array([1.0, -0.7, 0.4])
    truth = replace(truth, phi_rad=phi)
    views = []
    for index, (view, q) in enumerate(zip(readings.views, (0, 1, 0), strict=True)):
        shift = view.view.translation_m[0] / 0.01
        place = (view.m + 1j * view.n) * 0.01
        back = 1j**q
        site = (
            np.round((place * back).real / 0.01 + shift).astype(int) + 3,
            np.round((place * back).imag / 0.01).astype(int) + 3,
        )
        plate = truth.a[0] + 1j * truth.a[1]
        stage = (truth.g[0] + 1j * truth.g[1])[site]
        marks = place + plate[view.m + 3, view.n + 3]
        v = (
            stage
            + np.exp(1j * phi[index]) * back * marks
            - back * place
            + complex(*truth.t_m[index])
        )
        views.append(replace(view, dx=v.real, dy=v.imag))
    bent = replace(readings, views=tuple(views))
    rigid = calibrate(bent, BARE)
    linear = calibrate(bent, bare(misalignment_model="linear"))
    assert np.abs(rigid.error_map.gx - truth.g[0]).max() < 1e-12
    assert np.abs(rigid.error_map.gy - truth.g[1]).max() < 1e-12
    assert [view.phi for view in rigid.views] == pytest.approx(list(phi), abs=1e-12)
    assert np.abs(linear.error_map.gx - truth.g[0]).max() > 1e-9


@pytest.mark.parametrize("kind", [ReferenceKind.STAGE_X, ReferenceKind.STAGE_Y])
def test_a_length_of_the_stage_is_the_slope_of_the_known_sites(kind):
    """Sites of an edge that no view reads: the known ones do not lie about the centre."""
    artifact = Artifact(7, 0.01)
    _, clean = measured(plan_of("0,90,tx,ty", artifact), seed=4, linear=True)
    views = []
    for view in clean.views:
        at = view.view.lattice_pose(artifact).site_of(view.m, view.n)
        views.append(subset(view, (at[0] < 2) & (at[1] > -3), np.zeros(0, dtype=bool)))
    reference = ReferenceLength(kind, 5e-6, 1e-6)
    emap = calibrate(
        replace(clean, views=tuple(views)),
        replace(bare(misalignment_model="linear"), reference=reference),
    ).error_map
    assert not emap.valid.all() and emap.valid.sum() > 20
    along, error = (
        (artifact.x_m, emap.gx)
        if kind is ReferenceKind.STAGE_X
        else (artifact.y_m, emap.gy)
    )
    assert abs(along[emap.valid].mean()) > 1e-3
    slope = np.polyfit(along[emap.valid], error[emap.valid], 1)[0]
    assert slope == pytest.approx(5e-6, abs=1e-12)
