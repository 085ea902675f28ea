# SPDX-License-Identifier: Apache-2.0
"""What is wrong with a machine is named, with its size; a clean one is qualified."""

from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.joint.model_fit import fit_model
from selfcal_ros.estimation.joint.solve import fit_joint, prepare
from selfcal_ros.estimation.terms.columns import Column
from selfcal_ros.estimation.verdict.causes import (
    _groups,
    find_explanations,
    scatter_of_views,
)
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.findings import ApproachUnknown, VisitedOnce
from selfcal_ros.model.terms import parse_terms
from selfcal_ros.model.verdict import Grade
from selfcal_ros.model.view import Plan, View
from selfcal_ros.reporting.words.findings import worded
from selfcal_ros.simulation.cell import CellSettings
from selfcal_ros.simulation.machine import Spread, random_truth
from test.support.options import bare
from test.support.results import covered
from test.support.truth import simulate_measurements

PITCH = 0.01
OPTIONS = bare(datum_theta="zero_mean", misalignment_model="rigid")
"""Nothing is assumed: what is wrong has to be found."""
CLEAN = Spread(encoder="independent", rotation="finite")
SETTINGS = CellSettings(
    sigma_xy_m=20e-9, sigma_theta_rad=2e-5, servo_sigma_m=0.0, servo_sigma_theta_rad=0.0
)


def plan_of(order="x_back_y_back", repeats=4):
    poses = (
        ("0", 0, (0, 0)),
        ("90", 1, (0, 0)),
        ("+x", 0, (1, 0)),
        ("-x", 0, (-1, 0)),
        ("+y", 0, (0, 1)),
    )
    grids = tuple(
        View(name, q * np.pi / 2, (a * PITCH, b * PITCH), True, True, repeats, order)
        for name, q, (a, b) in poses
    )
    line = View("line", np.pi / 12, (0.0, 0.0), False, True, repeats)
    return Plan("p", Artifact(7, PITCH, 24), (*grids, line))


def calibrated(
    spread=CLEAN,
    *,
    change=lambda truth: truth,
    plan=None,
    seed=1,
    spoil=lambda m: m,
    **how,
):
    """Return the truth and the result."""
    plan, rng = plan or plan_of(), np.random.default_rng(seed)
    truth = change(random_truth(plan.artifact, len(plan.views), rng, spread))
    readings = simulate_measurements(
        truth, plan, rng, settings=replace(SETTINGS, **how), visits=True
    )
    return truth, worded(calibrate(spoil(readings), OPTIONS))


def judged(*args, **how):
    return calibrated(*args, **how)[1]


def with_views(name, index, value, shape):
    """Return a change of a truth: one view has something of its own."""

    def change(truth):
        values = np.zeros((len(truth.phi_rad), *shape))
        values[index] = value
        return replace(truth, **{name: values})

    return change


def steadily(along_x_m):
    drift = np.zeros((2, 3))
    drift[0, 0] = along_x_m
    return with_views("drift_m", 1, drift, (2, 3))


def slipping(after, by_m):
    """Return a change of a truth: view 2 steps aside in the middle, as the walk of its plate."""

    def change(truth):
        steps = 400
        walk = np.zeros((len(truth.phi_rad), 2, steps + 1))
        walk[2, :, round(after * steps) :] = np.array(by_m)[:, None]
        return replace(truth, walk_m=walk)

    return change


CASES = {
    "turned": (
        "microscope",
        2e-3,
        "a microscope turned counter-clockwise by ",
        {"spread": replace(CLEAN, microscope_rotation_rad=2e-3), "stop_sigma_m": 20e-6},
    ),
    "turned back": (
        "microscope",
        -2e-3,
        "a microscope turned clockwise by ",
        {
            "spread": replace(CLEAN, microscope_rotation_rad=-2e-3),
            "stop_sigma_m": 20e-6,
        },
    ),
    "scaled": (
        "microscope",
        5e-3,
        "a microscope that shows lengths too short by ",
        {"spread": replace(CLEAN, microscope_scale=5e-3), "stop_sigma_m": 20e-6},
    ),
    "drift": (
        "drift",
        500e-9,
        "along x during view '90'",
        {"change": steadily(500e-9)},
    ),
    "grown": (
        "plate_scale",
        2e-6,
        "in view '+x' than in view '0'",
        {"change": with_views("plate_scale", 2, 2e-6, ())},
    ),
    "backlash": (
        "approach",
        50e-9,
        "an indicated x that changes by ±(",
        {"spread": replace(CLEAN, backlash_x_m=50e-9)},
    ),
    "slip": (
        "slip",
        250e-9,
        "of view '+x'",
        {"change": slipping(0.45, (200e-9, -150e-9))},
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_what_is_wrong_is_named_first_with_its_size(name):
    term, size, said, how = CASES[name]
    truth, result = calibrated(**how)
    verdict = result.verdict
    assert verdict.grade is Grade.ENLARGED and verdict.reasons
    assert term in {item.name for item in verdict.enlarged_by}
    assert covered(result, truth.g) >= 0.85
    cause = verdict.causes[0]
    assert (cause.name, said in cause.text) == (term, True), cause.text
    assert cause.p < 5e-4
    assert cause.effect_max > cause.effect_rms > 0
    if term == "slip":  # its place is one of twelve that are tried
        assert cause.size == pytest.approx(size, rel=0.25)
    else:
        assert cause.size == pytest.approx(size, abs=4.5 * cause.u)
        assert cause.u < 0.1 * abs(size)
    assert verdict.sentence.startswith(f"Good within an enlarged U: {cause.text}")


def test_clean_machines_are_qualified_and_name_no_cause():
    verdicts = [judged(seed=seed).verdict for seed in range(30)]
    # seven tests of 5e-4 and two of 1e-3: two of thirty once in a thousand
    assert sum(not v.qualified for v in verdicts) <= 1
    assert sum(bool(v.causes) for v in verdicts) <= 1
    good = next(v for v in verdicts if v.qualified)
    assert good.grade is Grade.GOOD
    assert good.sentence == "Good: residuals and the noise of readings agree"


def louder(readings, by, *, visits):
    """Let the repeats of view 3 scatter more, by a factor, with their visits or without."""
    views = list(readings.views)
    view, seen = views[3], views[3].visits
    number = np.bincount(seen.mark)
    means = [np.bincount(seen.mark, of) / number for of in (seen.dx, seen.dy)]
    dx, dy = (
        mean[seen.mark] + by * (of - mean[seen.mark])
        for mean, of in zip(means, (seen.dx, seen.dy), strict=True)
    )
    seen = replace(seen, dx=dx, dy=dy) if visits else None
    views[3] = replace(view, sigma_xy=by * view.sigma_xy, visits=seen)
    return replace(readings, views=tuple(views))


@pytest.mark.parametrize("visits", [False, True])
def test_a_noisy_view_is_named(visits):
    loud = []

    def spoil(readings):
        spoilt = louder(readings, 3, visits=visits)
        loud.append(spoilt.views[3].sigma_xy)
        return spoilt

    truth, result = calibrated(spoil=spoil)
    verdict = result.verdict
    names = [cause.name for cause in verdict.causes]
    assert "noise" in names and verdict.grade is Grade.ENLARGED
    assert covered(result, truth.g) >= 0.85
    # nobody knows which nodes rest on the view: u is as for its noise everywhere
    clean = judged()
    wider = result.error_map.u_gx / clean.error_map.u_gx
    assert wider == pytest.approx(loud[0] / clean.noise.sigma_xy, rel=1e-3)
    cause = verdict.causes[names.index("noise")]
    assert " times as much noise in view '-x' as in" in cause.text
    assert cause.view == "-x" and cause.size == pytest.approx(3, rel=0.1)


def test_the_noise_of_a_view_is_that_of_its_visits_less_what_terms_explain():
    """Visits from either side differ by up to 100 nm, with a noise of 20 nm."""
    plan, rng = plan_of(), np.random.default_rng(1)
    truth = random_truth(plan.artifact, 6, rng, CASES["backlash"][3]["spread"])
    readings = simulate_measurements(truth, plan, rng, settings=SETTINGS, visits=True)
    options = replace(OPTIONS, terms=parse_terms(["approach"], ""))
    views = scatter_of_views(readings, fit_joint(readings, options))
    seen = {view.view.name: view.visits for view in readings.views if view.visits}
    assert seen.keys() == {name for name, *_ in views}
    for name, sigma, dof in views:
        mark = seen[name].mark
        assert dof == 2 * (len(mark) - len(np.unique(mark)))
        assert sigma == pytest.approx(SETTINGS.sigma_xy_m, rel=0.2)


def test_an_effect_without_consequence_disqualifies_nothing():
    # a steady drift of a view read there and back along both axes does not reach the map
    verdict = judged(change=steadily(25e-9)).verdict
    assert verdict.grade is Grade.GOOD


def test_causes_can_be_left_out():
    readings_of = CASES["backlash"][3]
    plan, rng = plan_of(), np.random.default_rng(1)
    truth = random_truth(plan.artifact, 6, rng, readings_of["spread"])
    readings = simulate_measurements(truth, plan, rng, settings=SETTINGS, visits=True)
    assert calibrate(readings, replace(OPTIONS, causes=False)).verdict.causes == ()
    assert calibrate(readings, OPTIONS).verdict.causes[0].name == "approach"


def test_the_effect_of_a_cause_is_what_holding_it_does_to_the_map():
    plan, rng = plan_of(), np.random.default_rng(1)
    truth = random_truth(
        plan.artifact,
        len(plan.views),
        rng,
        replace(CLEAN, microscope_rotation_rad=2e-3),
    )
    readings = simulate_measurements(
        truth, plan, rng, visits=True, settings=replace(SETTINGS, stop_sigma_m=20e-6)
    )
    found = find_explanations(fit_model(prepare(readings, OPTIONS)[0]), slips=False)[0]
    without, held = (
        calibrate(readings, replace(OPTIONS, causes=False, terms=terms)).error_map
        for terms in ((), parse_terms(["microscope"], ""))
    )
    moved = np.stack([held.gx - without.gx, held.gy - without.gy])
    assert found.name == "microscope"
    assert found.effect_m == pytest.approx(np.sqrt((moved**2).mean()), rel=0.02)
    cause = calibrate(readings, OPTIONS).verdict.causes[0]
    assert cause.effect_rms == pytest.approx(found.effect_m, rel=0.02)
    assert cause.effect_max == pytest.approx(np.hypot(*moved).max(), rel=0.02)


@pytest.mark.parametrize(
    ("consecutive", "repeats", "terms", "said"),
    [
        (True, 4, (), True),
        (False, 4, (), False),
        (True, 1, (), False),
        (True, 4, ("drift:1e-8",), False),
        (True, 4, ("plate_scale:1e-8",), True),
    ],
)
def test_repeats_that_are_of_one_time_are_said_to_be(consecutive, repeats, terms, said):
    plan, rng = plan_of("serpentine", repeats), np.random.default_rng(1)
    truth = random_truth(plan.artifact, len(plan.views), rng, CLEAN)
    readings = simulate_measurements(
        truth,
        plan,
        rng,
        visits=True,
        settings=replace(SETTINGS, consecutive=consecutive),
    )
    result = calibrate(readings, replace(OPTIONS, terms=parse_terms(terms, "")))
    assert result.verdict.qualified
    assert result.findings == ((VisitedOnce(),) if said else ())


@pytest.mark.parametrize(("known", "said"), [(0, True), (2, True), (4, False)])
def test_an_encoder_without_the_ways_to_the_marks_is_said_to_hide_backlash(known, said):
    """Of five visits `known` have a direction of approach along x."""
    plan, rng = plan_of("there_and_back", 4), np.random.default_rng(1)
    readings = simulate_measurements(
        random_truth(plan.artifact, len(plan.views), rng, CLEAN),
        plan,
        rng,
        visits=True,
        settings=SETTINGS,
    )
    views = list(readings.views)
    for at, view in enumerate(views):
        if view.visits is not None:
            is_known = np.arange(len(view.visits.mark)) % 5 < known
            signs = (view.visits.approach_x * is_known).astype(np.int8)
            visits = replace(view.visits, approach_x=signs)
            views[at] = replace(view, visits=visits)
    result = calibrate(replace(readings, views=tuple(views)), OPTIONS)
    assert result.verdict.qualified
    assert result.findings == ((ApproachUnknown(),) if said else ())


def test_a_term_on_which_no_reading_depends_is_said_to_be_left_out():
    """These views have lines, but no images of several marks."""
    plan, rng = plan_of("serpentine", 4), np.random.default_rng(1)
    truth = random_truth(plan.artifact, len(plan.views), rng, CLEAN)
    readings = simulate_measurements(truth, plan, rng, visits=True, settings=SETTINGS)
    terms = parse_terms(
        ["yaw", "line_scale:0.01", "line_eccentricity:0", "drift:1e-8"], ""
    )
    result = calibrate(readings, replace(OPTIONS, terms=terms))
    assert [finding.text for finding in worded(result).findings] == [
        "no reading depends on yaw: it is not in the model; leave it out"
    ]


@pytest.mark.parametrize(("lost", "said"), [(0, False), (20, False), (60, True)])
def test_a_view_whose_repeats_contradict_each_other_is_named(lost, said):
    """20 of 220 readings may be chance, 60 of 260 are more than that."""
    plan, rng = plan_of("serpentine", 4), np.random.default_rng(1)
    truth = random_truth(plan.artifact, len(plan.views), rng, CLEAN)
    readings = simulate_measurements(truth, plan, rng, visits=True, settings=SETTINGS)
    first, *others = readings.views
    first = replace(
        first, used=200, rejected={"outlier_among_repeats": lost, "low_score": 99}
    )
    result = worded(calibrate(replace(readings, views=(first, *others)), OPTIONS))
    assert [found.name for found in result.findings] == ["repeats_contradict"] * said
    for found in result.findings:
        assert (found.view, found.details) == (
            first.view.name,
            {"rejected": lost, "of": 260},
        )
        assert found.text == (
            f"60 of 260 readings of view '{first.view.name}' contradict the other repeats of their "
            "marks and were left out: the plate slipped within the view, or a second publisher "
            "sent readings (ros2 topic info -v); measure it again"
        )


def test_a_drift_is_tried_as_a_whole_in_each_view_and_in_each_view_steadily():
    found = [(view, part) for view in range(3) for part in ("x P1", "y P1", "x P2")]
    columns = [Column("drift", view, part, np.inf) for view, part in found]
    tried = [
        [found[at] for at in group.rows]
        for group in _groups(columns, ["approach", "drift"])
    ]
    assert tried == [
        found,
        *(
            rows
            for view in range(3)
            for rows in (
                [one for one in found if one[0] == view],
                [one for one in found if one[0] == view and one[1] != "x P2"],
            )
        ),
    ]
