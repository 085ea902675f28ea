# SPDX-License-Identifier: Apache-2.0
"""Predicted uncertainties against the published bounds and Monte Carlo; suggested views."""

from dataclasses import replace
from itertools import combinations_with_replacement

import numpy as np
import pytest

from selfcal_ros.errors import InputError
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.joint.solve import solve_joint
from selfcal_ros.estimation.normal.equations import planned_system
from selfcal_ros.estimation.observability import plan_check, suggest
from selfcal_ros.estimation.observability.plan_check import (
    candidate_views,
    check_plan,
    predict,
    predict_plan,
)
from selfcal_ros.estimation.observability.suggest import (
    Against,
    best_plan,
    rank_next,
    score_plan,
    unused_name,
)
from selfcal_ros.estimation.terms.planned import Assumed
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.error_map import ThetaDatum
from selfcal_ros.model.terms import parse_terms
from selfcal_ros.model.view import ORDERS, View
from selfcal_ros.reporting.words.tables import search_text, step_text
from test.support.dense_terms import Dense
from test.support.options import BARE, bare
from test.support.plans import plan_of
from test.support.recalibrations import responses, sizes_of
from test.support.truth import hu_plan, random_truth, simulate_measurements

BOUNDS = {  # method, section 11: rms gain at N = 5, 11, 21
    "0, 90, tx": (0.800, 0.890, 0.949),
    "0, 90, 180, tx": (0.664, 0.763, 0.825),
    "0, 90, tx, ty": (0.622, 0.660, 0.686),
    "0, 90, 180, tx, ty": (0.532, 0.581, 0.612),
    "0, 90, 180, 270, tx, ty": (0.477, 0.530, 0.563),
}


@pytest.mark.parametrize("views", BOUNDS)
def test_gains_of_the_table(views):
    found = [
        predict_plan(plan_of(views, size), ThetaDatum.XY_AXES).rms_xy
        for size in (5, 11, 21)
    ]
    assert np.round(found, 3) == pytest.approx(BOUNDS[views], abs=1e-9)


@pytest.mark.parametrize(
    ("count", "datum", "gain"),
    [
        (24, "xy_axes", 0.752),
        (24, "zero_mean", 0.677),
        (72, "xy_axes", 1.129),
        (72, "zero_mean", 0.891),
    ],
)
def test_angular_gains(count, datum, gain):
    found = predict_plan(hu_plan(Artifact(11, 0.01, count)), ThetaDatum(datum))
    assert found.rms_theta == pytest.approx(gain, abs=5e-4)
    assert found.rms_xy == pytest.approx(0.890, abs=5e-4)


def test_prediction_is_the_uncertainty_that_the_solver_reports():
    plan = plan_of("0, 90, tx, ty", 7, count=12, line=True)
    rng = np.random.default_rng(2)
    readings = simulate_measurements(
        random_truth(plan.artifact, 5, rng),
        plan,
        rng,
        sigma_m=1e-8,
        sigma_theta_rad=1e-3,
    )
    result = calibrate(readings, BARE)
    found = predict_plan(plan, ThetaDatum.ZERO_MEAN)
    assert np.allclose(
        result.error_map.u_gx / result.noise.sigma_xy, found.u_xy[0], rtol=1e-4
    )
    assert np.allclose(
        result.error_map.u_gy / result.noise.sigma_xy, found.u_xy[1], rtol=1e-4
    )
    assert np.allclose(
        result.error_map.u_g_theta / result.noise.sigma_theta,
        found.u_theta,
        rtol=1e-4,
        atol=1e-3,
    )


def test_equal_repeats_change_nothing_for_an_averaged_reading():
    once, five = (
        predict_plan(plan_of("0, 90, tx", 5, repeats=r), ThetaDatum.XY_AXES)
        for r in (1, 5)
    )
    assert np.allclose(once.u_xy, five.u_xy, rtol=1e-12)


def test_large_fields_are_predicted_on_a_smaller_one_and_say_so(monkeypatch):
    monkeypatch.setattr(
        "selfcal_ros.estimation.observability.plan_check.UNASKED_SITES", 100
    )
    monkeypatch.setattr("selfcal_ros.estimation.observability.plan_check.PROXY_SIZE", 9)
    found = predict_plan(plan_of("0, 90, tx", 21), ThetaDatum.XY_AXES)
    assert found.u_xy.shape == (2, 9, 9)
    assert found.rms_xy < 0.949


def test_next_views_are_ranked_by_what_they_give():
    plan = hu_plan(Artifact(11, 0.01, 24))
    now, ranked = rank_next(plan)
    assert now.rms_xy == pytest.approx(0.890, abs=5e-4)
    values = [item.score.rms_xy for item in ranked]
    assert np.all(np.diff(np.round(values, 8)) >= 0)
    by_text = {step_text(item, plan): item.score for item in ranked}
    added = by_text["add an unturned view shifted by +1 pitch along Y"]
    assert added.rms_xy == pytest.approx(0.660, abs=5e-4)
    assert by_text["add a view turned by 180°"].rms_xy == pytest.approx(0.763, abs=5e-4)
    line = by_text["add an angular view turned by 1 line (15°)"]
    assert line.rms_xy == pytest.approx(now.rms_xy) and line.rms_theta < now.rms_theta
    again = by_text["measure view 'rot90' 2 times, not 1"]
    assert added.rms_xy < again.rms_xy < now.rms_xy
    _, by_max = rank_next(plan, criterion="max")
    assert by_max[0].score.max_xy == min(item.score.max_xy for item in by_max)


def test_a_deficient_plan_is_cured_first():
    plan = plan_of("0, tx, ty", 5)
    now, ranked = rank_next(plan)
    assert now.deficiency == 2 and not np.isfinite(now.rms_xy)
    assert ranked[0].score.deficiency == 0
    assert "turned by" in step_text(ranked[0], plan)
    assert ranked[-1].score.deficiency == 2


def test_suggested_views_keep_the_repeats_and_have_names_of_their_own():
    plan = plan_of("0, 90, tx", 5, repeats=3)
    plan = replace(plan, views=(replace(plan.views[0], name="0deg"), *plan.views[1:]))
    _, ranked = rank_next(plan)
    views = [item.view for item in ranked if item.repeat_of is None]
    assert {view.repeats for view in views} == {3}
    assert "0deg_2" in {view.name for view in views}
    assert {item.view.repeats for item in ranked if item.repeat_of is not None} == {6}


@pytest.fixture
def few_candidates(monkeypatch):
    few = [
        view
        for view in candidate_views(Artifact(3, 0.01), angular=False)
        if view.name
        in ("0deg", "90deg", "180deg", "270deg", "0deg+x", "0deg+y", "0deg-x")
    ]
    for module in (suggest, plan_check):
        monkeypatch.setattr(module, "candidate_views", lambda *_, **__: few)
    return few


@pytest.mark.parametrize("criterion", ("rms", "max"))
def test_best_plan_of_three_views_is_the_best_of_all(criterion, few_candidates):
    plan, score, how = best_plan(
        Artifact(3, 0.01), 3, angular=False, criterion=criterion
    )
    assert search_text(how) == "all 28 plans tried"
    every = [
        score_plan(replace(plan, views=(few_candidates[0], *views))).key(criterion)
        for views in combinations_with_replacement(few_candidates, 2)
    ]
    assert score.key(criterion) == min(every)


def test_exchange_finds_what_trying_all_finds(monkeypatch, few_candidates):
    artifact = Artifact(3, 0.01)
    _, best, how = best_plan(artifact, 4, angular=False)
    assert search_text(how) == "all 84 plans tried"
    monkeypatch.setattr(suggest, "EXHAUSTIVE", 1)
    plan, found, how = best_plan(artifact, 4, angular=False)
    assert search_text(how) == "greedy choice, then exchange of single views"
    assert found.key("rms") == best.key("rms")
    assert len({view.name for view in plan.views}) == 4


def test_best_plan_measures_the_angular_map_too():
    plan, score, _ = best_plan(
        Artifact(3, 0.01, 24), 4, angular=True, like=View("", repeats=5)
    )
    assert check_plan(plan).observability.identifiable
    assert plan.views[-1].grid is False and {view.repeats for view in plan.views} == {5}
    assert np.isfinite(score.rms_theta) and score.rms_theta > 0


def test_large_plates_are_searched_small_and_judged_in_full(few_candidates):
    _, score, how = best_plan(Artifact(21, 0.01), 3, angular=False)
    assert search_text(how) == "all 28 plans tried on a field of 11 x 11 sites"
    assert score.rms_xy == pytest.approx(0.949, abs=5e-4)


@pytest.mark.parametrize(("n", "angular"), [(2, False), (3, True), (0, False)])
def test_too_few_views_are_refused(n, angular):
    with pytest.raises(InputError, match="cannot identify the stage"):
        best_plan(Artifact(5, 0.01, 8), n, angular=angular)


def test_gain_is_that_of_every_reading_moved_in_turn():
    plan = plan_of("0, 90, tx", 5)
    system = planned_system(plan.artifact, plan.views)
    found = predict(system, plan.artifact, ThetaDatum.XY_AXES)
    rng = np.random.default_rng(7)
    readings = simulate_measurements(
        random_truth(plan.artifact, 3, rng), plan, rng, linear=True
    )
    options = bare(misalignment_model="linear", uncertainty=False)

    def solve(moved):
        emap = solve_joint(moved, options).result.error_map
        return np.array([emap.gx.ravel(), emap.gy.ravel()])

    answers = responses(solve, readings, sizes_of(readings, 1e-8, 1.0)) / 1e-8
    assert np.sqrt((answers**2).sum(axis=0).mean()) == pytest.approx(
        found.rms_xy, rel=1e-6
    )


@pytest.mark.parametrize(
    ("taken", "name"),
    [
        ([], "90"),
        (["0"], "90"),
        (["90"], "90_2"),
        (["90", "90_3"], "90_2"),
        (["90_2", "90"], "90_3"),
        (["90", "90_2", "90_3", "90_4"], "90_5"),
    ],
)
def test_a_name_that_is_taken_gets_the_next_free_number(taken, name):
    assert unused_name("90", [View(one) for one in taken]) == name


BENT = parse_terms(["plate_shape:30e-9"], "")


def test_a_score_against_terms_is_that_of_one_dense_least_squares():
    plan = plan_of("0, 90, tx", 5, repeats=2)
    terms = parse_terms(["plate_shape:30e-9,drift:5e-8"], "")
    found = score_plan(plan, against=Against(terms, Assumed(order="serpentine")))
    dense = Dense(plan, Assumed(order="serpentine"))
    assert found.rms_xy == pytest.approx(dense.gain(terms) * 2**0.5, rel=1e-6)
    assert found.rms_xy > 1.5 * score_plan(plan).rms_xy


def test_bent_plates_ask_for_a_shift_the_other_way():
    plan = plan_of("0, 90, tx", 11, repeats=5)
    _, alone = rank_next(plan)
    now, ranked = rank_next(plan, against=Against(BENT))
    assert ranked[0].score.rms_xy < 0.5 * now.rms_xy

    def shifts(items):
        return [item.view.lattice_pose(plan.artifact).shift for item in items]

    assert shifts(ranked[:3]) == [(-1, 0)] * 3
    # by noise alone a shift along y is as good
    assert set(shifts(alone[:3])) == {(-1, 0), (0, 1), (0, -1)}
    by_text = {step_text(item, plan): item.score.rms_xy for item in ranked}
    back, on = (
        by_text[f"add an unturned view shifted by {a} pitch along X"]
        for a in ("-1", "+1")
    )
    assert back < 0.7 * on
    # a plate's shape does not ask in which order it is visited
    assert not any(item.order for item in ranked)


def test_a_drift_asks_for_another_order():
    plan = plan_of("0, 90, tx", 7)
    plan = replace(
        plan, views=tuple(replace(view, visit_order="raster") for view in plan.views)
    )
    drift = Against(parse_terms(["drift:5e-7"], ""))
    now, ranked = rank_next(plan, against=drift)
    orders = {item.order: item for item in ranked if item.order}
    assert set(orders) == set(ORDERS) - {"raster"}
    best = orders["x_back_y_back"]
    assert (
        step_text(best, plan)
        == "visit the marks in the order x_back_y_back, 4 repeats for 1"
    )
    assert {view.visit_order for view in best.views} == {"x_back_y_back"}
    assert {view.repeats for view in best.views} == {4} and best.view is None
    assert best.score.rms_xy < orders["x_then_y"].score.rms_xy < now.rms_xy
    assert best.score.rms_xy == pytest.approx(0.845 / 2, abs=1e-3)
    added = next(
        item
        for item in ranked
        if step_text(item, plan).startswith("add a view turned by 180")
    )
    assert (
        added.views == (*plan.views, added.view) and added.view.visit_order == "raster"
    )


def test_free_terms_that_are_not_told_are_a_deficiency():
    plan = plan_of("0, 90, tx", 5)
    free = Against(parse_terms(["drift"], ""), Assumed(order="raster"))
    assert score_plan(plan, against=free).deficiency == 7
    assert score_plan(plan, against=free).rms_xy == np.inf


def test_what_terms_hide_is_better_than_a_plan_that_is_deficient_without_them():
    """Of such a plan nobody counts what the terms would hide besides."""
    free = Against(parse_terms(["drift"], ""), Assumed(order="raster"))
    hidden, none = (
        score_plan(plan_of(text, 5), against=free)
        for text in ("0, 90, tx", "0, tx, ty")
    )
    assert (
        hidden.of_terms
        and not none.of_terms
        and 0 < none.deficiency < hidden.deficiency
    )
    assert hidden.key("rms") < none.key("rms")
    assert score_plan(plan_of("0, 90, tx", 5)).key("max") < hidden.key("max")


def test_the_best_plan_against_bent_plates_shifts_both_ways(few_candidates):
    plan, found, _ = best_plan(
        Artifact(5, 0.01), 4, angular=False, against=Against(BENT)
    )
    every = [
        score_plan(
            replace(plan, views=(few_candidates[0], *views)), against=Against(BENT)
        )
        for views in combinations_with_replacement(few_candidates, 3)
    ]
    assert found.key("rms") == min(score.key("rms") for score in every)


def test_progress_tells_how_many_plans_were_judged(few_candidates):
    calls = []
    rank_next(plan_of("0, 90, tx", 3), progress=lambda *at: calls.append(at))
    n = len(few_candidates) + 3
    assert calls == [(k, n) for k in range(1, n + 1)]
