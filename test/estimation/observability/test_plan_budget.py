# SPDX-License-Identifier: Apache-2.0
"""The predicted budget is that of one dense least squares, and removals remove what they say."""

from dataclasses import replace
from math import pi

import numpy as np
import pytest

from selfcal_ros.estimation.observability import resistance as module
from selfcal_ros.estimation.observability.plan_check import check_stops, predict_plan
from selfcal_ros.estimation.observability.resistance import (
    effects_of_terms,
    plan_budget,
)
from selfcal_ros.estimation.terms.planned import Assumed
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.budget import READING_NOISE
from selfcal_ros.model.error_map import ThetaDatum
from selfcal_ros.model.terms import ModelTerm, default_terms, in_order, parse_terms
from selfcal_ros.model.view import Plan, View
from test.support.dense_terms import SIGMA, Dense
from test.support.plans import plan_of

TERMS = parse_terms(
    ["microscope:0.01", "drift:3e-9", "plate_strain:2e-7", "approach:2e-9"], ""
)


def budget_of(plan, terms, assumed, **how):
    return plan_budget(
        plan, terms, assumed, predict_plan(plan, ThetaDatum.ZERO_MEAN), **how
    )


def effects(budget, quantity="xy"):
    return {
        line.component: line.effect_rms
        for line in budget.lines
        if line.quantity == quantity
    }


def test_each_line_is_what_is_gained_if_its_term_is_known_as_well():
    plan = plan_of("0, 90, tx", 5, repeats=2)
    assumed = Assumed(SIGMA, drift_degree=2, order="x_then_y")
    found, dense = effects(budget_of(plan, TERMS, assumed)), Dense(plan, assumed)
    # terms are ordered by their name in the model, and each is added to those behind it
    named = {term.name: term for term in TERMS}
    order = in_order(named.values())
    gains = [SIGMA * dense.gain(tuple(order[at:])) for at in range(len(order) + 1)]
    assert found.pop(READING_NOISE) == pytest.approx(gains[-1], rel=1e-6)
    for term, more, less in zip(order, gains, gains[1:], strict=False):
        assert found[term.name] == pytest.approx(
            np.sqrt(more**2 - less**2), rel=1e-4
        ), term


def test_check_stops_are_further_visits():
    """They determine the microscope as in the dense matrix, which gives them their weights, too."""
    plan = plan_of("0, 90, tx", 9, repeats=2)
    plan, assumed = (
        replace(plan, views=check_stops(plan)[0].views),
        Assumed(SIGMA, turn_rad=1e-4),
    )
    found, dense = effects(budget_of(plan, TERMS[:1], assumed)), Dense(plan, assumed)
    wanted = SIGMA * np.sqrt(dense.gain(TERMS[:1]) ** 2 - dense.gain(()) ** 2)
    assert found["microscope"] == pytest.approx(wanted, rel=0.05)


def test_a_free_term_adds_to_the_noise():
    plan = plan_of("0, 90, tx", 5, repeats=4)
    assumed = Assumed(SIGMA, order="x_back_y_back")
    terms = parse_terms(["drift", "plate_strain:2e-7"], "")
    found, dense = (
        budget_of(plan, terms, assumed, declared=["plate_strain"]),
        Dense(plan, assumed),
    )
    free = SIGMA * dense.gain((terms[0],))
    assert effects(found)[READING_NOISE] == pytest.approx(free, rel=1e-6)
    assert effects(found)["plate_strain"] == pytest.approx(
        np.sqrt((SIGMA * dense.gain(terms)) ** 2 - free**2), rel=1e-4
    )
    assert [line.source for line in found.lines] == ["readings", "declared"]
    assert found.u_rms("xy") == pytest.approx(SIGMA * dense.gain(terms), rel=1e-6)
    assert found.u_rms("xy", noise_only=True) == effects(found)[READING_NOISE]
    assert sum(map(found.share, found.lines)) == pytest.approx(1)


LINES = Plan(
    "lines",
    Artifact(5, 0.01, 8),
    (
        View("0", 0.0, (0.0, 0.0), True, True, 2),
        View("90", pi / 2, (0.0, 0.0), True, True, 1),
        View("line", pi / 4, (0.0, 0.0), False, True, 3),
        View("tx", 0.0, (0.01, 0.0), True, True, 2),
    ),
)


def dense_lines(sizes, sigma):
    """Root mean square u of the angular map, rotations of views with marks known."""
    rows, weight = [], []
    keys = [
        (view, part)
        for view in range(4)
        for part in ("cos", "sin", "turn")
        if part != "turn" or LINES.views[view].grid
    ]
    for number, view in enumerate(LINES.views):
        turn = round(view.rotation_rad / (pi / 4))
        for k in range(8):
            row = np.zeros(17 + len(keys))
            row[(k + turn) % 8] += 1
            row[8 + k] += 1
            row[16] = not view.grid
            wave = {"cos": np.cos(k * pi / 4), "sin": np.sin(k * pi / 4), "turn": 1.0}
            for at, (of, part) in enumerate(keys):
                row[17 + at] = wave[part] * (of == number)
            rows.append(row)
            weight.append(view.repeats)
    prior = np.zeros((len(keys), 17 + len(keys)))
    for at, (_, part) in enumerate(keys):
        prior[at, 17 + at] = 1 / sizes[part == "turn"]
    design = np.concatenate([np.array(rows) * np.sqrt(weight)[:, None] / sigma, prior])
    norm = np.linalg.norm(design, axis=0)
    solve = np.linalg.pinv(design / norm, rcond=1e-11) / norm[:, None]
    to_map = (np.eye(8) - 1 / 8) @ solve[:8]
    return np.sqrt((to_map**2).sum(axis=1).mean())


def test_the_lines_have_a_budget_of_their_own():
    sizes, sigma = (3e-6, 2e-6), 4e-6
    terms = (ModelTerm("line_eccentricity", sizes[0]), ModelTerm("rotation", sizes[1]))
    # marks so good that they tell the rotations
    found = budget_of(LINES, terms, Assumed(1e-12, sigma_rad=sigma))
    assert found.u_rms("theta") == pytest.approx(dense_lines(sizes, sigma), rel=1e-3)
    assert effects(found, "theta")[READING_NOISE] == pytest.approx(
        dense_lines((1e-12, 1e-12), sigma), rel=1e-3
    )
    assert effects(found, "theta")["line_eccentricity"] == pytest.approx(
        np.sqrt(
            dense_lines(sizes, sigma) ** 2 - dense_lines((1e-12, sizes[1]), sigma) ** 2
        ),
        rel=1e-3,
    )
    assert np.isnan(budget_of(plan_of("0, 90, tx", 5), (), Assumed()).u_rms("theta"))


def test_a_removal_leaves_what_it_says():
    plan = plan_of("0, 90, tx", 7, repeats=2)
    assumed = Assumed(1e-9, turn_rad=3e-4)
    # costs most
    terms = tuple(term for term in default_terms() if term.name != "plate_shape")
    found = budget_of(plan, terms, assumed)
    removal = found.removals["xy", "microscope"]
    assert removal.kind == "check_stops"
    with_it = budget_of(replace(plan, views=removal.step.views), terms, assumed)
    assert removal.effect_rms == pytest.approx(effects(with_it)["microscope"], rel=1e-9)
    assert removal.effect_rms < module.REMOVED * effects(found)["microscope"]
    # strain of its own in each view is told by no single view more
    strain = found.removals["xy", "plate_strain"]
    assert (strain.kind, strain.step, strain.effect_rms) == ("certificate", None, 0.0)
    once = replace(plan, views=tuple(replace(view, repeats=1) for view in plan.views))
    moving = budget_of(once, parse_terms(["drift:1e-8"], ""), Assumed(1e-9))
    assert moving.removals["xy", "drift"].kind == "order"
    assert moving.removals["xy", "drift"].step.order == "x_back_y_back"
    circle = budget_of(
        LINES, parse_terms(["line_eccentricity:1e-5"], ""), Assumed(1e-9)
    )
    removal = circle.removals["theta", "line_eccentricity"]
    assert (removal.kind, removal.step.view.name) == ("view", "180deg")
    ratio = removal.effect_rms / effects(circle, "theta")["line_eccentricity"]
    assert 0.5 < ratio < module.REMOVED


def test_a_larger_assumption_changes_what_the_readings_leave_of_it_and_nothing_declared():
    plan, assumed = (
        plan_of("0, 90, tx", 5, repeats=2),
        Assumed(1e-9, order="x_back_y_back"),
    )
    terms = parse_terms(["plate_strain:7e-8", "plate_shape:5e-9"], "")
    larger = parse_terms(["plate_strain:7e-8", "plate_shape:15e-9"], "")
    found = budget_of(
        plan, terms, assumed, declared=["plate_strain", "drift", "approach"]
    )
    wanted = budget_of(
        plan, larger, assumed, declared=["plate_strain", "drift", "approach"]
    )
    assert found.u_rms("xy", if_larger=True) == pytest.approx(
        wanted.u_rms("xy"), rel=1e-9
    )
    assert found.u_rms("xy", if_larger=True) > 2 * found.u_rms("xy")


def test_removals_of_a_large_field_are_tried_on_a_small_one(monkeypatch):
    sizes = []
    monkeypatch.setattr(
        module,
        "effects_of_terms",
        lambda plan, *more: (
            sizes.append(plan.artifact.shape),
            effects_of_terms(plan, *more),
        )[1],
    )
    found = budget_of(plan_of("0, 90, tx", 15), default_terms(), Assumed(1e-9))
    # with the drift, and with larger sizes
    assert sizes.count((15, 15)) == 4 and set(sizes) == {(15, 15), (11, 11)}
    before = effects_of_terms(
        plan_of("0, 90, tx", 15),
        [*default_terms(), ModelTerm("drift", 25e-9)],
        Assumed(1e-9),
    )
    assert effects(found)["microscope"] == pytest.approx(
        np.sqrt(before["microscope"][0].mean())
    )
