# SPDX-License-Identifier: Apache-2.0
"""Maps combined: weights, what is shared, the part between runs, coverage, false alarms."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import binom, chi2, f

from selfcal_ros.apply import StageMap
from selfcal_ros.errors import InputError
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.comparison.combine import (
    Member,
    RunValues,
    _families,
    _of_run,
    _run,
    combine,
    mean_of,
    variance_between,
)
from selfcal_ros.estimation.comparison.covariance import covariance_of
from selfcal_ros.estimation.joint.problem import coverage_factor
from selfcal_ros.estimation.options import Options
from selfcal_ros.estimation.verdict.uncertainty import effect_everywhere, enlarged
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.budget import BudgetLine
from selfcal_ros.model.error_map import datum_modes, remove_modes
from selfcal_ros.model.kept import Covariance, Kept
from selfcal_ros.model.readings import Sense
from selfcal_ros.model.reference import ReferenceLength
from selfcal_ros.model.result import result_from_dict, result_to_dict
from selfcal_ros.model.terms import parse_terms
from selfcal_ros.model.verdict import Enlargement, Grade, Verdict
from selfcal_ros.outputs import plain
from selfcal_ros.reporting.words.findings import worded
from selfcal_ros.simulation.cell import CellSettings
from selfcal_ros.simulation.machine import Spread
from selfcal_ros.simulation.machine import random_truth as random_machine
from test.support.maps import random_map, result_of
from test.support.options import bare
from test.support.truth import hu_plan, random_truth, simulate_measurements
from tools.combining import ARTIFACT, Case, combined, judged

NO_SHAPES = np.zeros((4, 0))
GTC_DOF = 7.518796992481201


def run_of(values, variance, *, common=0.0, shares=True, dof=np.inf):
    values = np.asarray(values, dtype=float)
    n = len(values)
    return RunValues(
        values, variance * np.eye(n), common * np.ones((n, n)), shares, dof
    )


def calibrated(seed, *, options=None, artifact=ARTIFACT, truth=None, sigma=2e-8):
    rng = np.random.default_rng(seed)
    truth = truth or random_truth(artifact, 4, np.random.default_rng(99))
    readings = simulate_measurements(
        truth, hu_plan(artifact, 2), rng, sigma_m=sigma, sigma_theta_rad=2e-5
    )
    return calibrate(readings, options or bare(causes=False))


def part(name, result):
    return Member(name, result.error_map, result)


def run_at(run_id, **changed):
    """Return run A with another map, and what tells when it was recorded."""
    times = dict.fromkeys(
        ("first_exposure", "last_exposure"), "2026-01-01T00:00:00+00:00"
    )
    return replace(
        A,
        run_id=run_id,
        error_map=replace(A.error_map, **changed),
        provenance=replace(A.provenance, **times),
    )


def thrice(result):
    """Return a run three times, apart by a tenth of u: equal maps are of one recording."""
    off = 0.1 * result.error_map.u_gx
    return [
        part(
            name,
            replace(
                result,
                error_map=replace(
                    result.error_map, gx=result.error_map.gx + sign * off
                ),
            ),
        )
        for name, sign in zip("abc", (1, -1, 0), strict=True)
    ]


def scaled(emap, by):
    return replace(
        emap,
        **{name: by * getattr(emap, name) for name in ("gx", "gy", "u_gx", "u_gy")},
    )


A, B, C = (calibrated(seed) for seed in (1, 2, 3))


def test_weights_are_inverse_variances_and_what_is_shared_does_not_average_out():
    """Two runs of variance 1 and 3, no scatter between them, and a common error of variance 4."""
    values = np.array([1.0, -1.0, 2.0, 0.0])
    runs = [run_of(values, 1.0, common=4.0), run_of(values, 3.0, common=4.0)]
    found = mean_of(runs, np.zeros((4, 0)), NO_SHAPES)
    np.testing.assert_allclose(found.weights, [0.75, 0.25])
    np.testing.assert_allclose(found.values, values)
    np.testing.assert_allclose(found.covariance, 0.75 * np.eye(4) + 4.0, rtol=1e-12)
    np.testing.assert_allclose(found.u, np.sqrt(4.75))
    assert not found.between.any()
    other = mean_of(
        [runs[0], replace(runs[1], shares=False)], np.zeros((4, 0)), NO_SHAPES
    )
    np.testing.assert_allclose(other.covariance, 0.75 * np.eye(4) + 0.75**2 * 4.0)


def test_the_common_part_cancels_between_runs_of_one_machine_alone():
    """E_n of two runs: the difference over its U, where a common error counts for others only."""
    runs = [
        run_of([2.0, 0, 0, 0], 1.0, common=8.0),
        run_of(np.zeros(4), 1.0, common=8.0),
    ]
    alike = mean_of(runs, np.zeros((4, 0)), NO_SHAPES).deviations[0]
    assert alike.e_n[0] == pytest.approx(2 / (2.0 * np.sqrt(2)), rel=1e-3)
    of_other = mean_of(
        [runs[0], replace(runs[1], shares=False)], np.zeros((4, 0)), NO_SHAPES
    )
    assert of_other.deviations[0].e_n[0] == pytest.approx(
        2 / (2.0 * np.sqrt(10)), rel=1e-3
    )
    assert (
        alike.e_n[0] == -mean_of(runs, np.zeros((4, 0)), NO_SHAPES).deviations[1].e_n[0]
    )


def test_mandel_and_paule_for_equal_variances_is_a_difference_of_variances():
    """Sample variance of 1, 2, 6 is 7: with 3 within the runs 4 are left between, with 8 none."""
    values = np.array([[1.0], [2.0], [6.0]])
    assert variance_between(values, np.full(3, 3.0)) == pytest.approx(4.0)
    assert variance_between(values, np.full(3, 8.0)) == 0.0
    unequal = variance_between(values, np.array([1.0, 2.0, 3.0]))
    weight = 1 / (np.array([1.0, 2.0, 3.0]) + unequal)
    assert weight @ (
        values[:, 0] - weight @ values[:, 0] / weight.sum()
    ) ** 2 == pytest.approx(2.0)


def test_scatter_in_a_shape_enters_u_with_the_pattern_of_that_shape():
    shape = np.array([[3.0], [1.0], [-1.0], [-3.0]])
    runs = [run_of(amplitude * shape[:, 0], 0.01) for amplitude in (-1.0, 0.0, 1.0)]
    found = mean_of(runs, np.zeros((4, 0)), shape)
    size = found.between / (shape[:, 0] ** 2)
    np.testing.assert_allclose(size, size[0])
    # amplitudes of the unit shape: ±√20, 0
    assert 20 * size[0] == pytest.approx((20 - 0.01) / 3)
    assert found.p_between < 1e-6 and found.dof == pytest.approx(2.0, rel=0.02)
    np.testing.assert_allclose(np.diag(found.covariance), found.u**2)
    assert found.covariance[0, 3] < 0 < found.covariance[0, 1]


def test_the_probability_of_the_scatter_is_that_of_chi_squared_and_of_two_shapes():
    """Amplitudes -1, 0, 1 of a unit shape with variance 0.5: chi^2 is 4 with 2 dof; rest: none."""
    shape = np.full((4, 1), 0.5)
    runs = [run_of(amplitude * shape[:, 0], 0.5) for amplitude in (-1.0, 0.0, 1.0)]
    found = mean_of(runs, np.zeros((4, 0)), shape)
    assert found.p_between == pytest.approx(2 * chi2.sf(4.0, 2), rel=1e-6)


def test_what_is_shared_is_known_and_adds_degrees_of_freedom():
    shape = np.array([[3.0], [1.0], [-1.0], [-3.0]])
    alone, shared = (
        mean_of(
            [
                run_of(amplitude * shape[:, 0], 0.01, common=common)
                for amplitude in (-1.0, 0.0, 1.0)
            ],
            np.zeros((4, 0)),
            shape,
        )
        for common in (0.0, 7.0)
    )
    ratio = np.min(shared.u**4 / (alone.within + alone.between) ** 2 * alone.dof)
    assert shared.dof == pytest.approx(ratio, rel=0.02) and shared.dof > 10 * alone.dof


def test_a_single_number_that_differs_between_two_runs_has_one_degree_of_freedom():
    """At the nodes that it moves: half of them it leaves alone, and the median would be large."""
    shape = np.array([[1.0], [0.0], [0.0], [-1.0]])
    single = mean_of(
        [run_of(a * shape[:, 0], 0.01) for a in (-1.0, 1.0)], np.zeros((4, 0)), shape
    )
    assert single.dof == pytest.approx(1.0, rel=1e-12)


def test_the_datum_of_a_run_changes_nothing():
    emap, at = B.error_map, ARTIFACT
    moved = replace(
        B,
        error_map=replace(
            emap,
            gx=emap.gx + 1e-5 - 2e-5 * at.y_m + 3e-5 * at.x_m,
            gy=emap.gy - 2e-5 + 2e-5 * at.x_m + 3e-5 * at.y_m,
            g_theta=emap.g_theta + 1e-4,
        ),
    )
    plain_one, other = (combine([part("a", A), part("b", b)]) for b in (B, moved))
    np.testing.assert_allclose(other.xy.values, plain_one.xy.values, atol=1e-17)
    np.testing.assert_allclose(other.theta.values, plain_one.theta.values, atol=1e-17)
    np.testing.assert_allclose(other.xy.u, plain_one.xy.u, rtol=1e-6)


def test_three_equal_runs_give_their_map_with_a_third_of_the_variance():
    found = combine(thrice(A)).result
    np.testing.assert_allclose(found.error_map.gx, A.error_map.gx, atol=1e-18)
    np.testing.assert_allclose(
        found.error_map.g_theta,
        A.error_map.g_theta - A.error_map.g_theta.mean(),
        atol=1e-18,
    )
    np.testing.assert_allclose(
        found.error_map.u_gy * np.sqrt(3), A.error_map.u_gy, rtol=1e-9
    )
    assert found.error_map.nonorthogonality == pytest.approx(
        A.error_map.nonorthogonality
    )
    assert found.error_map.scale_difference == pytest.approx(
        A.error_map.scale_difference
    )
    assert found.verdict.grade is Grade.GOOD


def test_the_mean_keeps_its_covariance_in_its_file():
    found = combine([part("a", A), part("b", B)])
    read = result_from_dict(plain(result_to_dict(worded(found.result))), "mean")
    known = found.known.copy()
    whole = covariance_of(read, "xy", known)
    np.testing.assert_allclose(whole, found.xy.covariance, atol=1e-6 * whole.max())
    known[0, 1] = False
    chosen = np.tile(known.ravel(), 2)
    np.testing.assert_array_equal(
        covariance_of(read, "xy", known), whole[np.ix_(chosen, chosen)]
    )
    angular = covariance_of(read, "theta", np.ones(ARTIFACT.angular_count, dtype=bool))
    np.testing.assert_allclose(
        angular, found.theta.covariance, atol=1e-6 * angular.max()
    )
    a, b = StageMap(read).length_uncertainty()
    assert 0 < a < 1e-6 and b >= 0
    damaged = replace(read, kept=Kept(covariances={"xy": Covariance(np.ones(1), 1.0)}))
    with pytest.raises(InputError, match="no covariance of this map"):
        covariance_of(damaged, "xy", known)


def test_an_assumed_microscope_is_shared_by_all_runs():
    """The variance of its factors in one run is that in the mean of three of its equals."""
    truth = random_truth(Artifact(5, 0.01), 4, np.random.default_rng(4))
    result = calibrate(
        simulate_measurements(
            truth,
            hu_plan(truth.artifact, 2),
            np.random.default_rng(5),
            sigma_m=2e-8,
            visits=True,
        ),
        Options(causes=False, terms=parse_terms(["microscope:2e-5"], "")),
    )
    found = combine(thrice(result))
    factors = result.kept.factors.of_map
    of = np.array(result.kept.factors.terms) == "microscope"
    assert of.any()
    shared = (factors[of] ** 2).sum(axis=0).ravel() * result.noise.sigma_xy**2
    np.testing.assert_allclose(
        found.xy.common, shared, rtol=0.02, atol=1e-3 * shared.max()
    )
    u = np.concatenate([result.error_map.u_gx.ravel(), result.error_map.u_gy.ravel()])
    np.testing.assert_allclose(found.xy.within, (u**2 - shared) / 3, rtol=0.02)


def with_lines_seen_by(factor, terms, *, phi_rad=0.0, runs=4, recheck=False):
    """Return the angles of a stage whose offsets of lines are off by a factor, and runs of it."""
    rng, plan = np.random.default_rng(3), hu_plan(Artifact(5, 0.01, 24), 4)
    spread = Spread(phi_rad=phi_rad, g_theta_rad=1e-3, line_factor=factor)
    truth = random_machine(plan.artifact, len(plan.views), rng, spread)
    settings = CellSettings(
        Sense.PLATE_MOVES, sigma_xy_m=2e-8, sigma_theta_rad=2e-6, servo_sigma_m=5e-9
    )
    options = Options(causes=False, terms=parse_terms(terms, ""))
    of_first = {
        name: getattr(truth, name)[:1] for name in ("t_m", "phi_rad", "plate_shape_m")
    }
    later, again = replace(truth, **of_first), replace(plan, views=plan.views[:1])
    members = []
    for run in range(runs):
        readings = simulate_measurements(
            truth, plan, rng, settings=settings, visits=True
        )
        result = calibrate(readings, options)
        if recheck:
            readings = simulate_measurements(
                later, again, rng, settings=settings, visits=True
            )
            result = calibrate(
                readings, replace(options, plate=result, plate_from=f"{run}.json")
            )
        members.append(part(str(run), result))
    return truth.g_theta - truth.g_theta.mean(), members


def of_scales(runs):
    """Return what scales of lines and microscope add to the variance of theta, mean of the runs."""
    return np.mean(
        [
            angular.get("microscope", 0.0) ** 2 + angular["line_scale"] ** 2
            for angular in (run.result.kept.angular for run in runs)
        ],
        axis=0,
    )


def of_theta(run):
    return _run(run, "theta", np.isfinite(run.error_map.g_theta), without_length=False)


def test_what_rechecks_share_does_not_average_out():
    """They do not keep it apart: of four with a plate each, u is no less than that of one."""
    truth, runs = with_lines_seen_by(0.985, ["microscope:0.01"], recheck=True)
    found = combine(runs).result
    emap = found.error_map
    away = abs(emap.g_theta - truth) / emap.u_g_theta
    assert np.mean(away < found.noise.k_theta) > 0.9
    u_of_runs = np.mean([run.error_map.u_g_theta for run in runs], axis=0)
    assert 0.9 < np.mean(emap.u_g_theta / u_of_runs) < 1.3


def test_noise_that_the_detections_of_rechecks_declare_averages_out():
    """It is of type B, as is what they share; without a budget all of it may be what they share."""
    noise = BudgetLine(
        quantity="xy",
        component="reading noise",
        kind="B",
        unit="m",
        effect_rms=1e-9,
        source="declared",
    )
    plates = [
        SimpleNamespace(calibration=SimpleNamespace(readings={"sha256": plate}))
        for plate in ("first", "second")
    ]
    averaged, shared = (
        combine(
            [
                part(name, replace(result, budget=budget, recheck=plate))
                for name, result, plate in zip("ab", (A, B), plates, strict=True)
            ]
        ).xy
        for budget in ((noise,), ())
    )
    assert not averaged.common.any()
    np.testing.assert_allclose(shared.common, 2 * averaged.within, rtol=0.02)


def test_a_scale_of_the_lines_that_is_assumed_does_not_average_out():
    """1.5 times what is assumed, in all runs: the mean is as far off as each of them."""
    truth, runs = with_lines_seen_by(0.985, ["microscope:0.01"])
    found = combine(runs)
    emap, noise = found.result.error_map, found.result.noise
    assert np.mean(abs(emap.g_theta - truth) < noise.k_theta * emap.u_g_theta) > 0.9
    assert found.result.verdict.grade is Grade.GOOD
    shared = of_scales(runs)
    np.testing.assert_allclose(
        found.theta.common, shared, rtol=0.01, atol=1e-3 * shared.max()
    )
    assert (emap.u_g_theta**2 > 0.99 * shared).all()
    for run in runs:
        values = of_theta(run)
        assert np.linalg.eigvalsh(values.covariance)[0] > -1e-12 * shared.max()
        whole = covariance_of(run.result, "theta", np.ones(24, dtype=bool))
        np.testing.assert_allclose(
            np.diag(whole), run.error_map.u_g_theta**2, rtol=1e-4
        )


def test_of_two_scales_whose_difference_alone_is_seen_either_is_shared():
    """A plate turned by 1 mrad compares the lines with a microscope that is known to 1 %."""
    _, runs = with_lines_seen_by(1.0, ["microscope:0.01"], phi_rad=1e-3, runs=2)
    shared = of_scales(runs)
    np.testing.assert_allclose(
        combine(runs).theta.common, shared, rtol=0.05, atol=0.01 * shared.max()
    )


def test_a_scale_of_the_lines_that_each_run_determines_averages_out():
    _, runs = with_lines_seen_by(0.985, ["microscope:0"], phi_rad=1e-3, runs=2)
    found = combine(runs)
    assert not found.theta.common.any()
    within = np.sum([np.diag(of_theta(run).covariance) for run in runs], axis=0) / 4
    np.testing.assert_allclose(found.theta.within, within, rtol=0.1)


@pytest.mark.parametrize("lacking", ["names", "factors"])
def test_lines_of_results_that_do_not_say_what_is_whose_average_no_better(lacking):
    """Older files name no terms that leave the map as it is, and large fields keep no factors."""
    _, runs = with_lines_seen_by(1.0, ["microscope:0.01"], runs=2)
    named = combine(runs).theta
    older = []
    for run in runs:
        kept = run.result.kept
        factors = replace(kept.factors, beside_terms=())
        kept = replace(kept, factors=factors if lacking == "names" else None)
        older.append(replace(run, result=replace(run.result, kept=kept)))
    found = combine(older).theta
    assert found.common.sum() > 0.95 * named.common.sum()
    assert all(
        np.linalg.eigvalsh(of_theta(run).covariance)[0] > -1e-20 for run in older
    )


def test_an_assumed_approach_is_shared_by_all_runs():
    """It is no term of the model, but adds to U what readings from one side do not determine."""
    effect = effect_everywhere("approach", A.error_map, size_m=10e-9)
    found = combine(thrice(enlarged(A, [effect])))
    shared = remove_modes(effect.xy, datum_modes(ARTIFACT, scale=True)).ravel() ** 2
    np.testing.assert_allclose(
        found.xy.common, shared, rtol=0.05, atol=0.01 * shared.max()
    )
    np.testing.assert_allclose(found.xy.within, combine(thrice(A)).xy.within, rtol=0.05)


def test_what_enlarged_both_maps_of_a_run_is_named_of_both():
    of_map = Enlargement("line_scale", 1e-8, 2e-8)
    of_lines = Enlargement("line_scale", 1e-6, 2e-6, "rad")
    verdict = Verdict(Grade.ENLARGED, enlarged_by=(of_map, of_lines))
    found = combine(thrice(replace(A, verdict=verdict))).result
    for item, wanted in zip(found.verdict.enlarged_by, (of_map, of_lines), strict=True):
        assert (item.name, item.unit) == (wanted.name, wanted.unit)
        assert item.u_rms == pytest.approx(wanted.u_rms)
        assert item.u_max == pytest.approx(wanted.u_max)


def test_what_enlarged_runs_is_stated_as_it_enters_their_mean():
    """By its weight; slips of runs are not one error. It was stated as in the worst run alone."""
    slip = Enlargement("slip", 3e-8, 6e-8)
    slipped = replace(A, verdict=Verdict(Grade.ENLARGED, enlarged_by=(slip,)))
    one_of_three = [*thrice(slipped)[:1], *thrice(A)[1:]]
    for runs, factor in (
        (one_of_three, 1 / 3),
        (thrice(slipped), 1 / np.sqrt(3)),
    ):
        (item,) = combine(runs).result.verdict.enlarged_by
        assert item.name == "slip" and item.unit == "m"
        assert item.u_rms == pytest.approx(factor * slip.u_rms)
        assert item.u_max == pytest.approx(factor * slip.u_max)


def test_what_enlarged_rechecks_is_stated_in_full():
    """All but their noise enters their mean as it is: the plate they are known from is one."""
    slip = Enlargement("slip", 3e-8, 6e-8)
    verdict = Verdict(Grade.ENLARGED, enlarged_by=(slip,))
    plates = [
        SimpleNamespace(calibration=SimpleNamespace(readings={"sha256": plate}))
        for plate in ("first", "second")
    ]
    rechecks = [
        part(name, replace(result, verdict=verdict, recheck=plate))
        for name, result, plate in zip("ab", (A, B), plates, strict=True)
    ]
    (item,) = combine(rechecks).result.verdict.enlarged_by
    assert item.u_rms == pytest.approx(slip.u_rms)


def test_a_reference_length_is_kept_once():
    reference = Options(
        assumed=(),
        causes=False,
        reference=ReferenceLength("artifact", 1e-5, 2e-6, "PTB 1"),
    )
    runs = [
        part(name, calibrated(seed, options=reference))
        for name, seed in (("a", 1), ("b", 2))
    ]
    kept, removed = (combine(runs, keep_scale=keep) for keep in (True, False))
    place = np.concatenate([ARTIFACT.x_m.ravel(), ARTIFACT.y_m.ravel()]) * 2e-6
    np.testing.assert_allclose(kept.xy.common, place**2, rtol=1e-3, atol=1e-22)
    assert not removed.xy.common.any()
    assert removed.result.reference is None
    assert kept.result.reference.certificate == "PTB 1"
    scale = np.polyfit(ARTIFACT.x_m.ravel(), kept.result.error_map.gx.ravel(), 1)[0]
    each = [
        np.polyfit(ARTIFACT.x_m.ravel(), p.error_map.gx.ravel(), 1)[0] for p in runs
    ]
    assert min(each) < scale < max(each)
    with pytest.raises(InputError, match="c has no reference length"):
        combine([*runs, part("c", C)], keep_scale=True)


def test_the_length_that_large_maps_share_does_not_average_out():
    artifact, rng = Artifact(33, 0.01), np.random.default_rng(3)
    base = random_map(artifact, 1)
    length = ReferenceLength("artifact", 0.0, 1e-7, "PTB 1")
    of_length = np.stack([artifact.x_m, artifact.y_m]) * 1e-7
    u = np.hypot(3e-9, of_length)
    runs = []
    for name in "abc":
        noise = rng.normal(0, 3e-9, u.shape)
        emap = replace(
            base, gx=base.gx + noise[0], gy=base.gy + noise[1], u_gx=u[0], u_gy=u[1]
        )
        result = replace(result_of(emap), input={}, reference=length)
        runs.append(Member(name, emap, result))
    found = combine(runs, keep_scale=True)
    assert found.xy.covariance.ndim == 1
    np.testing.assert_allclose(
        found.xy.common, of_length.ravel() ** 2, rtol=0.01, atol=1e-19
    )


def test_lengths_of_different_certificates_explain_that_magnifications_differ():
    """1 µm/m apart with u of 1 µm/m each: the maps differ by less than their uncertainties."""
    runs = []
    for name, error in (("PTB 1", 1e-5), ("laser 7", 1.1e-5)):
        length = ReferenceLength("artifact", error, 1e-6, name)
        options = Options(assumed=(), causes=False, reference=length)
        runs.append(part(name, calibrated(len(runs) + 1, options=options)))
    found = combine(runs, keep_scale=True)
    assert not found.xy.common.any()
    assert found.result.verdict.grade is Grade.GOOD
    assert all(run.agrees for run in found.result.parts.combined.runs)


def certified_as(result, name, error, at):
    length = ReferenceLength("artifact", error, 2e-6, name).at_temperature(at)
    return replace(result, reference=length)


def test_warnings_of_runs_are_those_of_their_mean():
    """Once each, with the files; a mean had none."""
    runs = [
        part(name, replace(result, warnings=warnings))
        for name, result, warnings in (
            ("a", A, ("the clock stepped", "backlash")),
            ("b", B, ("backlash",)),
            ("c", C, ()),
        )
    ]
    mean = worded(combine(runs).result)
    assert mean.warnings == ("a: the clock stepped", "a, b: backlash")
    read = worded(result_from_dict(plain(result_to_dict(mean)), "mean"))
    assert read.warnings == mean.warnings


def test_a_run_that_disagrees_is_named_where_the_scatter_is_chance():
    found = combine([part("a", A), part("b", B)]).result
    for agrees, text in (
        ((True, None), "Good: the runs agree within their uncertainties"),
        ((False, True), "though a disagrees with the others at 5 %"),
    ):
        runs = list(found.parts.combined.runs)
        runs[0] = replace(runs[0], agrees=agrees[0], agrees_theta=agrees[1])
        parts = replace(
            found.parts, combined=replace(found.parts.combined, runs=tuple(runs))
        )
        sentence = worded(replace(found, parts=parts)).verdict.sentence
        assert sentence.endswith(text)


def test_numbers_of_certificates_are_told_apart_where_they_are_divided():
    keys = [
        ReferenceLength("artifact", 0.0, 1e-7, text).certificate_key
        for text in ("PTB 1-23", "ptb1/23", "PTB 12-3", "--")
    ]
    assert keys[0] == keys[1] != keys[2] and not keys[3]


def test_one_certificate_is_one_length_however_it_is_spelled():
    """Its u, 2 µm/m, does not average out; runs that state it with other numbers are refused."""
    at = "20.4:0:5e-7:0"
    spelled = [
        part(name, certified_as(result, name, 1e-5, at))
        for name, result in (("PTB 5.2-0815", A), ("ptb 5.2 0815 ", B))
    ]
    other = part("c", certified_as(C, "DKD 7", 1e-5, at))
    place = np.concatenate([ARTIFACT.x_m.ravel(), ARTIFACT.y_m.ravel()]) * 2e-6
    for runs in (spelled, [spelled[0], other]):
        common = combine(runs, keep_scale=True).xy.common
        np.testing.assert_allclose(common, place**2, rtol=1e-3, atol=1e-22)
    for error, at_other, stated in (
        (
            1.2e-5,
            at,
            "relative_error of the certificate 'PTB 5.2-0815' is 1.2e-05, and 1e-05",
        ),
        (1e-5, "21:0:8e-6:0", "expansion_per_k .* is 8e-06, and 5e-07 in PTB 5.2-0815"),
    ):
        wrong = part("c", certified_as(C, "PTB 5.2-0815", error, at_other))
        with pytest.raises(InputError, match=f"c: {stated}"):
            combine([*spelled, wrong], keep_scale=True)
        assert combine([*spelled, wrong]).result.reference is None


def test_magnifications_that_differ_have_one_degree_of_freedom():
    """Two runs whose scales are 10 µm/m apart, as of a stage that was 1 K warmer: U covers both.

    It was shared out among the cubic polynomials, with more degrees of freedom than runs tell.
    """
    length = ReferenceLength("artifact", 1e-5, 1e-7, "PTB 1")
    options = Options(assumed=(), causes=False, reference=length)
    runs = [part(name, calibrated(len(name), options=options)) for name in ("a", "bb")]
    warmer = replace(
        runs[1].error_map,
        gx=runs[1].error_map.gx + 1e-5 * ARTIFACT.x_m,
        gy=runs[1].error_map.gy + 1e-5 * ARTIFACT.y_m,
    )
    runs[1] = part("warmer", replace(runs[1].result, error_map=warmer))
    found = combine(runs, keep_scale=True)
    assert found.result.verdict.grade is Grade.ENLARGED
    of_scale = "is their scale: compare the certificates, and the temperatures of plate"
    assert of_scale in worded(found.result).verdict.sentence
    assert found.result.noise.k_xy == pytest.approx(coverage_factor(1.0), rel=1e-3)
    place = np.concatenate([ARTIFACT.x_m.ravel(), ARTIFACT.y_m.ravel()])
    assert np.corrcoef(found.xy.between, place**2)[0, 1] > 0.999
    scale = place / (place @ place)
    u_scale = np.sqrt(scale @ found.xy.covariance @ scale)
    assert u_scale == pytest.approx(1e-5 / 2, rel=0.05)


def test_the_part_between_runs_has_the_pattern_of_a_polynomial_and_of_a_wave():
    """x y in Gx and two waves per turn, amplitudes -1, 0, 1 of 1 µm and 1 mrad."""
    x, y = ARTIFACT.x_m / 0.03, ARTIFACT.y_m / 0.03
    field = remove_modes(
        np.stack([x * y, np.zeros_like(x)]), datum_modes(ARTIFACT, scale=True)
    )
    wave = np.cos(
        2 * np.arange(ARTIFACT.angular_count) * 2 * np.pi / ARTIFACT.angular_count
    )
    runs = []
    for amplitude in (-1.0, 0.0, 1.0):
        emap = A.error_map
        runs.append(
            part(
                str(amplitude),
                replace(
                    A,
                    input={},
                    error_map=replace(
                        emap,
                        gx=emap.gx + 1e-6 * amplitude * field[0],
                        gy=emap.gy + 1e-6 * amplitude * field[1],
                        g_theta=emap.g_theta + 1e-3 * amplitude * wave,
                    ),
                ),
            )
        )
    found = combine(runs)
    assert np.corrcoef(found.theta.between, wave**2)[0, 1] > 0.999
    assert found.theta.between.max() == pytest.approx(1e-6 / 3, rel=0.01)
    whole = field.reshape(2, -1).ravel() ** 2
    assert np.corrcoef(found.xy.between, whole)[0, 1] > 0.999
    assert found.xy.between.max() == pytest.approx(whole.max() * 1e-12 / 3, rel=0.01)


def test_a_map_of_other_origin_has_its_own_u_and_no_correlations():
    """Twice the u of the calibration: a fifth of the weight of both."""
    emap = A.error_map
    other = replace(
        thrice(A)[0].error_map,
        u_gx=2 * emap.u_gx,
        u_gy=2 * emap.u_gy,
        u_g_theta=2 * emap.u_g_theta,
    )
    found = combine([part("a", A), Member("b", other)])
    np.testing.assert_allclose(found.xy.weights, [0.8, 0.2], atol=0.02)
    np.testing.assert_allclose(found.theta.weights, [0.8, 0.2], atol=0.03)
    assert "xy" not in found.result.kept.covariances
    assert covariance_of(found.result, "xy", found.known).ndim == 1


@pytest.mark.parametrize(
    ("kind", "size"), [("none", 0.0), ("white", 20e-9), ("smooth", 20e-9)]
)
def test_coverage_and_false_alarms(kind, size):
    """95.45 % within U; E_n beyond 1 in 4.55 % of the nodes, and 5 % of runs, without a part.

    The limits are those of 4 standard errors of sets, which scatter by up to 12 %.
    """
    sets = [judged((Case(3, kind, size), 5000 + seed)) for seed in range(20)]
    assert 0.93 < np.mean([one.covered_xy for one in sets]) < 0.995
    assert np.mean([one.covered_theta for one in sets]) > 0.95
    runs = 3 * len(sets)
    disagree = runs * np.mean([one.disagree for one in sets])
    if kind == "none":
        assert np.mean([one.beyond for one in sets]) == pytest.approx(0.0455, abs=0.015)
        assert disagree <= binom.ppf(0.999, runs, 0.05)
        assert sum(one.between for one in sets) <= binom.ppf(0.999, len(sets), 0.05)
    else:
        assert disagree > 0.8 * runs and all(one.between for one in sets)
    assert sum(one.stands_out for one in sets) <= binom.ppf(0.999, len(sets), 0.05)


def test_the_run_that_differs_is_named():
    runs = [calibrated(seed) for seed in range(10, 14)]
    emap = runs[2].error_map
    noise = np.random.default_rng(1).normal(0, 8e-8, (2, *ARTIFACT.shape))
    off = remove_modes(noise, datum_modes(ARTIFACT, scale=True))
    runs[2] = replace(
        runs[2], error_map=replace(emap, gx=emap.gx + off[0], gy=emap.gy + off[1])
    )
    found = combine([part(str(i), run) for i, run in enumerate(runs)]).result
    rows = found.parts.combined.runs
    assert [row.stands_out for row in rows] == [False, False, True, False]
    assert not rows[2].agrees and rows[2].e_n_rms > 2 * rows[0].e_n_rms
    assert found.verdict.grade is Grade.ENLARGED
    assert found.verdict.enlarged_by[0].name == "between_runs"
    assert (
        "the 4 runs differ by more than their uncertainties"
        in worded(found).verdict.sentence
    )
    u = next(line for line in found.budget if line.component == "between runs")
    total = np.mean([found.error_map.u_gx**2, found.error_map.u_gy**2])
    assert 0 < u.effect_rms < np.sqrt(total)
    parts = [line for line in found.budget if line.quantity == "xy"][:3]
    assert sum(line.effect_rms**2 for line in parts) == pytest.approx(total)


def test_runs_agree_where_p_is_above_the_level():
    rows = combine(
        [part(name, one) for name, one in zip("abc", (A, B, C), strict=True)]
    ).result.parts.combined.runs
    assert all(row.agrees and 0.05 < row.p <= 1 for row in rows)


def test_sites_that_a_run_does_not_know_are_unknown():
    hole = B.error_map.gx.copy()
    hole[1, 2] = np.nan
    found = combine(
        [part("a", A), part("b", replace(B, error_map=replace(B.error_map, gx=hole)))]
    ).result
    assert np.isnan(found.error_map.gx[1, 2]) and np.isnan(found.error_map.u_gx[1, 2])
    assert np.isnan(found.error_map.gx).sum() == 1
    assert worded(found).warnings == (
        "sites that are not known in all runs are unknown in the mean: 1",
    )


def test_large_fields_are_combined_by_their_variances():
    """Beyond 31 x 31 sites correlations are not kept: independent nodes, three maps, u / 3^1/2."""
    artifact, rng = Artifact(41, 0.01), np.random.default_rng(3)
    base = random_map(artifact, 1)
    u = np.full(artifact.shape, 3e-9)
    maps = [
        replace(
            base,
            gx=base.gx + rng.normal(0, u),
            gy=base.gy + rng.normal(0, u),
            u_gx=u,
            u_gy=u,
        )
        for _ in range(3)
    ]
    found = combine(
        [
            Member(name, emap, replace(result_of(emap), input={}))
            for name, emap in zip("abc", maps, strict=True)
        ]
    )
    assert found.xy.covariance.ndim == 1 and not found.result.kept.covariances
    emap = found.result.error_map
    np.testing.assert_allclose(emap.u_gx, 3e-9 / np.sqrt(3), rtol=0.05)
    assert all(
        not run.test.correlated and not run.test.significant
        for run in found.xy.deviations
    )
    beyond = np.mean([abs(run.e_n) > 1 for run in found.xy.deviations])
    assert beyond == pytest.approx(0.0455, abs=0.01)


def test_the_degrees_of_freedom_of_a_deviation_are_those_of_gtc():
    """dof(x1 - x2) by GTC 1.5.1, ureal(0, 2, 5) - ureal(0, 1, 8): E_n has its k."""
    runs = [run_of([9.0, 0, 0, 0], 4.0, dof=5.0), run_of(np.zeros(4), 1.0, dof=8.0)]
    e_n = mean_of(runs, np.zeros((4, 0)), NO_SHAPES).deviations[0].e_n[0]
    assert e_n == pytest.approx(
        9.0 / (coverage_factor(GTC_DOF) * np.sqrt(5.0)), rel=1e-6
    )


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ([part("a", A)], "a single map"),
        (
            [Member("a", A.error_map), Member("b", B.error_map)],
            "no RESULT.json among them",
        ),
        (
            [part("a", A), part("b", replace(B, verdict=Verdict(Grade.NOT_QUALIFIED)))],
            "b: its calibration is not qualified",
        ),
        (
            [
                part("a", replace(A, input={"sha256": "1"})),
                part("b", replace(A, input={"sha256": "1"})),
            ],
            "b: of the same recording as a",
        ),
        (
            [part("a", A), part("b", replace(A, run_id="other"))],
            "b: of the same readings as a: their maps are equal",
        ),
        (
            [part("a", run_at("1")), part("b", run_at("1", gx=B.error_map.gx))],
            "b: of the same recording as a",
        ),
        (
            [part("a", A), Member("b", scaled(B.error_map, 1e6))],
            r"b: .* of a: is it in µm\?",
        ),
        (
            [
                part("a", A),
                Member("b", replace(B.error_map, g_theta=1e6 * B.error_map.g_theta)),
            ],
            r"b: .* of a: is it in µrad\?",
        ),
        (
            [part("a", A), part("b", calibrated(1, artifact=Artifact(5, 0.01, 12)))],
            "the lattices differ",
        ),
        (
            [
                part("a", A),
                part(
                    "b",
                    replace(
                        B,
                        error_map=replace(
                            B.error_map, u_gx=np.full(ARTIFACT.shape, np.nan)
                        ),
                    ),
                ),
            ],
            "fewer than three sites are known",
        ),
    ],
)
def test_what_cannot_be_combined_is_refused(parts, message):
    with pytest.raises(InputError, match=message):
        combine(parts)


def test_runs_at_the_same_simulated_time_are_told_apart_by_their_noise():
    noise = replace(A.noise, sigma_xy_repeats=1.1 * A.noise.sigma_xy_repeats)
    other = replace(run_at("1", gx=B.error_map.gx), noise=noise)
    assert combine([part("a", run_at("1")), part("b", other)]).result.verdict.qualified


def test_a_table_as_coarse_as_its_errors_is_no_other_unit():
    """A map of a tenth of the accuracy is combined; its errors are larger, as its u says."""
    rng, u = np.random.default_rng(1), 20 * A.error_map.u_gx
    coarse = replace(
        A.error_map,
        gx=A.error_map.gx + rng.normal(0, u),
        gy=A.error_map.gy + rng.normal(0, u),
        u_gx=u,
        u_gy=u,
    )
    assert combine([part("a", A), Member("b", coarse)]).xy.weights[0] > 0.99


def test_sets_of_runs_differ_by_their_seed_alone():
    same = [combined(Case(2, "square", 1e-7), seed)[0].xy.values for seed in (1, 1, 2)]
    np.testing.assert_array_equal(same[0], same[1])
    assert np.abs(same[0] - same[2]).max() > 1e-8


def test_what_shapes_leave_of_a_run_has_the_variance_of_the_other_directions():
    rng = np.random.default_rng(3)
    basis = np.linalg.qr(rng.normal(size=(8, 8)))[0]
    q, shapes, others = basis[:, :2], basis[:, 2:4], basis[:, 4:]
    # nothing along the datum
    variances = np.array([3.0, 1.0, 2.0, 4.0, 6.0, 8.0]) * 1e-16
    free = basis[:, 2:]
    values = rng.normal(size=(3, 6)) @ free.T
    runs = [
        replace(run_of(one, 0.0), covariance=free * variances @ free.T)
        for one in values
    ]
    *of_shapes, rest = _families(runs, q, shapes)
    np.testing.assert_allclose(
        [family.within[0] for family in of_shapes], [3e-16, 1e-16]
    )
    np.testing.assert_allclose(rest.within, 5e-16)
    assert rest.most == 4  # of 8 values are independent
    np.testing.assert_allclose(
        rest.values, np.sqrt(2) * values @ others @ others.T, atol=1e-12
    )
    np.testing.assert_allclose(rest.share, (others**2).sum(axis=1))


@pytest.mark.parametrize("size", [0.5, 3.0])
def test_a_run_stands_out_by_the_F_test_of_its_distance(size):
    """Four runs of equal variance, with a part between them and without, and 30 nodes each."""
    nodes = 30
    values = size * np.random.default_rng(3).normal(size=(4, nodes))
    runs = [run_of(one, 1.0) for one in values]
    found = mean_of(runs, np.zeros((nodes, 0)), np.zeros((nodes, 0)))
    assert bool(found.between.any()) == (size > 1)
    for run, (one, deviation) in enumerate(zip(values, found.deviations, strict=True)):
        others = np.delete(values, run, axis=0)
        of_run = ((one - others.mean(axis=0)) ** 2).sum() / (1 + 1 / 3)
        ratio = of_run / others.var(axis=0, ddof=1).sum()
        expected = f.sf(ratio, nodes, 2 * nodes)
        assert deviation.p_scatter == pytest.approx(expected, rel=1e-6)


def test_the_mean_of_runs_of_few_degrees_of_freedom_has_those_of_both():
    """Variances of 5 degrees of freedom each: their sum has 10 (Welch-Satterthwaite)."""
    nodes = 10_000
    run = RunValues(np.zeros(nodes), np.ones(nodes), np.zeros(nodes), True, 5.0)
    found = mean_of([run, run], np.zeros((nodes, 0)), np.zeros((nodes, 0)))
    assert found.dof == pytest.approx(10, rel=0.01)


@pytest.mark.parametrize(
    ("p", "p_z", "both"), [(0.01, 0.3, 0.02), (0.3, 0.01, 0.02), (0.7, 0.6, 1.0)]
)
def test_the_probability_of_a_run_is_twice_that_of_its_worse_test(p, p_z, both):
    found = _of_run(
        SimpleNamespace(
            e_n=np.array([0.5, -2.0, 0.5, -0.5]),
            p_scatter=0.04,
            test=SimpleNamespace(p=p, p_z=p_z, significant=both < 0.05),
        ),
        "_theta",
        0.05,
    )
    assert found == {
        "e_n_rms_theta": pytest.approx(np.sqrt(4.75 / 4)),
        "e_n_largest_theta": 2.0,
        "beyond_theta": 0.25,
        "p_theta": both,
        "agrees_theta": both == 1.0,
        "stands_out_theta": True,
    }


def test_a_recheck_is_not_combined_with_what_its_plate_is_known_from():
    one, other = (
        part(f"{name}.json", replace(result, input={"sha256": name}))
        for result, name in ((A, "a"), (B, "b"))
    )
    assert combine([one, other])

    def rechecked(run, of):
        calibration = SimpleNamespace(readings={"sha256": of})
        return replace(
            run,
            result=replace(
                run.result, recheck=SimpleNamespace(calibration=calibration)
            ),
        )

    assert combine([one, rechecked(other, "c")])
    for pair in (
        [one, rechecked(other, "a")],
        [rechecked(other, "a"), one],
        [rechecked(one, "c"), rechecked(other, "c")],
    ):
        with pytest.raises(
            InputError, match=r"of the same plate errors as .*one calibration"
        ):
            combine(pair)
