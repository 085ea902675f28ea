# SPDX-License-Identifier: Apache-2.0
"""A stage that does not stand at the sites of the marks, in the whole calibration."""

from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.estimation.api import calibrate, robust_calibrate
from selfcal_ros.estimation.joint import problem as fitting
from selfcal_ros.estimation.joint.solve import fit_joint, solve_joint
from selfcal_ros.estimation.options import Options
from selfcal_ros.estimation.quality.validation import validate
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.error_map import datum_modes, remove_modes
from selfcal_ros.model.readings import Sense
from selfcal_ros.model.result import result_to_dict
from selfcal_ros.model.terms import parse_terms
from selfcal_ros.reporting.words.findings import worded
from selfcal_ros.simulation.cell import CellSettings
from selfcal_ros.simulation.machine import Spread, random_truth
from test.support.lattice_plans import plan_of
from test.support.options import bare
from test.support.plans import plan_of as planned
from test.support.results import trusted
from test.support.truth import hu_plan, simulate_measurements

SIGMA_M = 20e-9
FOLLOWS = {"follow_mark": True}


def measured(
    plan,
    seed=1,
    *,
    t_m=1e-3,
    sense=Sense.MICROSCOPE_MOVES,
    length=4.0,
    missing=0.0,
    sigma_m=SIGMA_M,
    g_m=0.2e-6,
    **cell,
):
    """Return a smooth stage, and its readings; plates lie `t_m` (sigma) beside their places."""
    rng = np.random.default_rng(seed)
    truth = random_truth(
        plan.artifact,
        len(plan.views),
        rng,
        Spread(g_m=g_m, t_m=t_m, phi_rad=5e-4, correlation_pitches=length),
    )
    settings = CellSettings(
        sense, sigma_m, 2e-5, servo_sigma_m=0.0, servo_sigma_theta_rad=0.0, **cell
    )
    return truth, simulate_measurements(
        truth, plan, rng, settings=settings, missing=missing
    )


def off(truth, result):
    """Return error over u of both maps, (2, nx, ny)."""
    emap = result.error_map
    error = np.stack([emap.gx, emap.gy]) - truth.g
    return remove_modes(error, datum_modes(truth.artifact, scale=True)) / np.stack(
        [emap.u_gx, emap.u_gy]
    )


def maps_of(machines, *, size=11, **how):
    """Return the maps of machines in both senses: which qualify, which hold, error over u."""
    plan, qualified, holds, errors = hu_plan(Artifact(size, 0.01, 24), 5), [], [], []
    for seed in range(machines):
        truth, readings = measured(
            plan, seed, sense=tuple(Sense)[seed % 2], **FOLLOWS, **how
        )
        result = trusted(readings, bare())
        errors.append(off(truth, result))
        qualified.append(result.verdict.qualified)
        holds.append(np.mean(np.abs(errors[-1]) <= result.noise.k_xy) >= 0.85)
    return np.array(qualified), np.array(holds), np.sqrt(np.mean(np.square(errors)))


def test_plates_a_tenth_of_a_pitch_beside_cost_nothing():
    qualified, holds, z = maps_of(10)
    assert qualified.all() and holds.all()
    assert 0.97 <= z <= 1.03


def test_plates_two_tenths_beside_are_held_as_well():
    qualified, holds, z = maps_of(6, t_m=2e-3)
    assert qualified.sum() >= 5 and holds.all()
    assert z <= 1.05


def test_a_stage_too_rough_for_it_is_rather_not_qualified_than_wrong():
    qualified, holds, _ = maps_of(6, size=7, t_m=2e-3, length=2.0)
    assert (~qualified).sum() > (qualified & ~holds).sum()
    assert holds.sum() >= 5


@pytest.mark.parametrize("sense", Sense)
def test_taking_the_sites_for_the_places_makes_errors_larger_than_u(sense):
    errors = []
    for seed in range(6):
        truth, readings = measured(
            hu_plan(Artifact(9, 0.01, 24), 5), seed, sense=sense, **FOLLOWS
        )
        errors.append(off(truth, solve_joint(readings, bare(at_places=False)).result))
    assert np.sqrt(np.mean(np.square(errors))) > 1.05


def test_at_two_tenths_u_holds_the_noise_that_readings_between_nodes_have_more(
    monkeypatch,
):
    def ratio():
        return np.sqrt(
            np.mean(
                [
                    off(truth, solve_joint(readings, bare()).result) ** 2
                    for truth, readings in made
                ]
            )
        )

    made = [
        measured(plan_of("0,90,tx", Artifact(7, 0.01)), seed, t_m=2e-3, **FOLLOWS)
        for seed in range(6)
    ]
    held = ratio()
    monkeypatch.setattr(fitting, "FAR", np.inf)
    assert held == pytest.approx(1, abs=0.1)
    assert ratio() > 1.1 * held


def test_a_stage_that_is_white_there_is_not_qualified():
    _, readings = measured(hu_plan(Artifact(7, 0.01, 24), 5), length=0.0, **FOLLOWS)
    verdict = calibrate(readings, bare()).verdict
    assert not verdict.qualified
    assert "off_sites" in [cause.name for cause in verdict.causes]


def test_micrometres_off_the_sites_are_nothing():
    _, readings = measured(
        hu_plan(Artifact(11, 0.01, 24), 5), stop_sigma_m=5e-6, t_m=30e-6
    )
    one, two = (calibrate(readings, Options(at_places=at)) for at in (True, False))
    assert not np.array_equal(one.error_map.gx, two.error_map.gx)
    for name in ("gx", "gy"):
        apart = getattr(one.error_map, name) - getattr(two.error_map, name)
        assert np.abs(apart).max() < 0.03 * one.error_map.u_gx.min()
    assert one.error_map.u_gx == pytest.approx(two.error_map.u_gx, rel=1e-3)


def test_a_stage_at_the_sites_has_the_same_result_to_the_bit():
    _, readings = measured(hu_plan(Artifact(11, 0.01, 24), 5), t_m=30e-6)
    one, two = (
        result_to_dict(worded(calibrate(readings, Options(at_places=at))))
        for at in (True, False)
    )
    for made in (one, two):
        made["provenance"].pop("created", None)
    assert one == two


@pytest.mark.parametrize("terms", ["", "approach"])
def test_repeats_scatter_by_their_noise_alone(terms):
    """Stops 0.5 mm (sigma) beside differ by what the stage error does over 0.5 mm."""
    _, readings = measured(
        hu_plan(Artifact(11, 0.01), 5), t_m=0.0, stop_sigma_m=0.5e-3, sigma_m=5e-9
    )
    options = bare(terms=parse_terms([terms], ""), causes=False)
    there, at_sites = (
        calibrate(readings, replace(options, at_places=at)).noise.sigma_xy_repeats
        for at in (True, False)
    )
    assert there == pytest.approx(5e-9, rel=0.05)
    assert at_sites > 5.5e-9


def test_readings_held_out_are_predicted_where_the_stage_stood():
    _, readings = measured(hu_plan(Artifact(11, 0.01, 24), 5), g_m=1e-6, **FOLLOWS)
    there, at_sites = (
        validate(readings, bare(at_places=at), folds=2) for at in (True, False)
    )
    assert not any(part.exceeds for part in there)
    for one, other in zip(there[:2], at_sites[:2], strict=True):
        assert other.rms_m > 1.5 * one.rms_m


def test_the_worst_reading_is_found_and_no_other():
    _, readings = measured(hu_plan(Artifact(11, 0.01, 24), 5), **FOLLOWS)
    spoilt = readings.views[1].dx + np.where(np.arange(121) == 50, 3e-7, 0.0)
    visits = readings.views[1].visits
    more = replace(visits, dx=visits.dx + np.where(visits.mark == 50, 3e-7, 0.0))
    views = list(readings.views)
    views[1] = replace(views[1], dx=spoilt, visits=more)
    found = robust_calibrate(replace(readings, views=tuple(views)), bare())
    (removed,) = (
        finding for finding in found.findings if finding.name == "outliers_removed"
    )
    assert removed.number == 1 and removed.first[0].view == "rot90"
    assert removed.first[0].mark == (int(views[1].m[50]), int(views[1].n[50]))


@pytest.mark.parametrize("seed", [0, 2])
def test_residuals_many_times_the_offsets_are_no_microscope(seed):
    """Of a stage that follows its marks, whose encoders err by 0.4 um from mark to mark.

    The microscope saw nothing of it, but its offsets, freed from the residuals as their noise,
    explained these: a tenth of them was left, and some maps were good.
    """
    plan = planned("0, 90, tx, ty", 7, repeats=2)
    rng = np.random.default_rng(seed)
    truth = random_truth(plan.artifact, len(plan.views), rng)
    settings = CellSettings(sigma_xy_m=SIGMA_M, **FOLLOWS)
    readings = simulate_measurements(truth, plan, rng, settings=settings, visits=True)
    views = []
    for view in readings.views:
        x, y = rng.normal(0, 4e-7, (2, len(view.m)))
        visits, mark = view.visits, view.visits.mark
        visits = replace(visits, dx=visits.dx + x[mark], dy=visits.dy + y[mark])
        views.append(replace(view, visits=visits, dx=view.dx + x, dy=view.dy + y))
    model = fit_joint(replace(readings, views=tuple(views)), Options())
    system = model.problem.system
    total = (system.grid.weight * np.abs(model.fitted.residuals) ** 2).sum()
    sigma = np.sqrt(total / system.dof_grid)  # of one of two readings
    assert sigma == pytest.approx(np.sqrt(2) * 4e-7, rel=0.1)
    assert model.fitted.xy.residuals == pytest.approx(sigma, rel=0.05)
