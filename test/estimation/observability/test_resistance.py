# SPDX-License-Identifier: Apache-2.0
"""Terms of a plan against one dense least squares: all unknowns and columns in one matrix."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from selfcal_ros.errors import NotIdentifiableError
from selfcal_ros.estimation.normal.equations import planned_system
from selfcal_ros.estimation.observability import plan_check, resistance
from selfcal_ros.estimation.observability.plan_check import check_plan, predict_plan
from selfcal_ros.estimation.observability.resistance import (
    PlannedTerms,
    check_terms,
    nominal_sizes,
)
from selfcal_ros.estimation.terms.equations import require_terms_determined
from selfcal_ros.estimation.terms.planned import (
    Assumed,
    planned_equations,
    planned_inputs,
)
from selfcal_ros.model.error_map import ThetaDatum
from selfcal_ros.model.readings import Sense
from selfcal_ros.model.terms import ModelTerm, parse_terms
from selfcal_ros.model.view import ORDERS, View
from selfcal_ros.model.visit_order import visit_sequence
from test.support.dense_terms import SIGMA, Dense
from test.support.plans import plan_of
from test.support.refusals import in_words

LEVEL = 5e-4


SMALL = plan_of("0, 90, tx", 5, repeats=4)


@cache
def dense_of(plan, assumed, sense):
    return Dense(plan, assumed, sense)


@cache
def both(order, sense=Sense.MICROSCOPE_MOVES, degree=3):
    assumed = Assumed(SIGMA, 10e-6, degree, order)
    return PlannedTerms(SMALL, (), assumed), dense_of(SMALL, assumed, sense)


@pytest.mark.parametrize("sense", Sense)
@pytest.mark.parametrize("order", [*ORDERS, "raster@plate"])
@pytest.mark.parametrize("name", nominal_sizes())
def test_each_term_as_the_dense_matrix_has_it(name, order, sense):
    planned, dense = both(order, sense)
    size = {"microscope": 1e-4}.get(name, nominal_sizes()[name])
    found = planned.check(name, size, LEVEL)
    assert found.unseen_modes == dense.n_unseen([ModelTerm(name)])
    assert found.determined is (found.unseen_modes == 0)
    assert (found.effect_rms_m, found.effect_max_m) == pytest.approx(
        dense.effect([], name, size), rel=1e-6
    )
    assert found.power == pytest.approx(dense.power([], name, size, LEVEL), abs=0.08)


MODELS = [
    "drift",
    "drift,approach",
    "plate_scale:1e-7",
    "plate_shape:30e-9,drift",
    "microscope,plate_scale:2e-6,approach:5e-9",
    "plate_shape:1e-9,drift:3e-9",
]
UNLIKE = replace(
    plan_of("0, 90, tx, -ty", 5, size_y=3),
    views=tuple(
        replace(view, repeats=repeats)
        for view, repeats in zip(
            plan_of("0, 90, tx, -ty", 5).views, (2, 4, 3, 2), strict=True
        )
    ),
)
"""A plate of 5 x 3 marks, and views of unlike repeats."""


@pytest.mark.parametrize("name", nominal_sizes())
@pytest.mark.parametrize("size", ["", ":1e-7"], ids=["free", "sized"])
def test_columns_are_as_long_as_those_of_all_visits(name, size):
    """Means of marks and visits about them hold together what every visit has."""
    assumed = Assumed(SIGMA, 10e-6, 2, "serpentine@plate")
    system = planned_system(UNLIKE.artifact, UNLIKE.views)
    found = planned_equations(
        UNLIKE, system, parse_terms([name + size], "test"), assumed
    )
    dense = dense_of(UNLIKE, assumed, Sense.MICROSCOPE_MOVES)
    columns = dense.root[:, None] * dense.columns(name, free=not size)
    assert found.norm == pytest.approx(np.linalg.norm(columns, axis=0), rel=1e-9)


@pytest.mark.parametrize("sense", Sense)
@pytest.mark.parametrize("text", MODELS)
@pytest.mark.parametrize(
    ("plan", "order"), [(SMALL, "x_back_y_back"), (UNLIKE, "serpentine@plate")]
)
def test_models_as_the_dense_matrix_has_them(text, plan, order, sense):
    model = parse_terms([text], "test")
    assumed = Assumed(SIGMA, 10e-6, 2, order)
    planned, dense = PlannedTerms(plan, model, assumed), dense_of(plan, assumed, sense)
    alone = predict_plan(plan, ThetaDatum.ZERO_MEAN)
    seen = planned.with_free_terms(check_plan(plan).observability)
    free = [term for term in model if term.free]
    assert seen.deficiency == dense.n_unseen(free)
    if seen.identifiable:
        unit = min(view.repeats for view in plan.views) ** 0.5
        assert planned.predicted(alone).rms_xy == pytest.approx(
            dense.gain(model) * unit, rel=1e-6
        )
        assert alone.rms_xy == pytest.approx(dense.gain([]) * unit, rel=1e-9)
    sizes = nominal_sizes() | {"microscope": 1e-4}
    for found in check_terms(planned, sizes, LEVEL):
        others = [term for term in model if term.name != found.name]
        held = [term for term in others if term.free]
        assert found.unseen_modes == (
            dense.n_unseen([*held, ModelTerm(found.name)]) - dense.n_unseen(held)
        )
        if dense.n_unseen(held) == 0:
            assert (found.effect_rms_m, found.effect_max_m) == pytest.approx(
                dense.effect(others, found.name, sizes[found.name]), rel=1e-5
            )
            assert found.power == pytest.approx(
                dense.power(others, found.name, sizes[found.name], LEVEL), abs=0.08
            )


ORDER_TABLE = {  # order, repeats that are one turn of it: degree 1, 2, 3, 5
    ("raster", 1): (2, 5, 7, 11),
    ("there_and_back", 2): (0.843, 2, 2, 4),
    ("x_then_y", 2): (0.844, 0.847, 0.860, 0.887),
    ("x_back_y_back", 4): (0.843, 0.843, 0.845, 0.850),
    ("random", 1): (0.878, 0.907, 0.938, 1.015),
}
"""Hu's three grid views, N = 7: modes that a drift hides, or the gain for an averaged reading."""


@pytest.mark.parametrize(("order", "repeats"), ORDER_TABLE)
def test_what_a_drift_hides_depends_on_the_visiting_order(order, repeats):
    plan = plan_of("0, 90, tx", 7, repeats=repeats)
    alone = predict_plan(plan, ThetaDatum.ZERO_MEAN)
    assert alone.rms_xy == pytest.approx(0.843, abs=5e-4)
    row = []
    for degree in (1, 2, 3, 5):
        planned = PlannedTerms(
            plan, [ModelTerm("drift")], Assumed(SIGMA, 10e-6, degree, order)
        )
        hidden = planned.check("drift", 1e-8, LEVEL).unseen_modes
        row.append(hidden or round(planned.predicted(alone).rms_xy, 3))
    assert tuple(row) == pytest.approx(ORDER_TABLE[order, repeats], abs=1e-9)


def test_free_terms_that_are_not_told_are_named_with_their_cure():
    plan = plan_of("0, 90, tx", 5)
    seen = check_plan(plan).observability
    planned = PlannedTerms(plan, parse_terms(["drift"], ""), Assumed(order="raster"))
    with pytest.raises(
        NotIdentifiableError, match=r"do not separate drift .*\(7 modes"
    ):
        require_terms_determined(planned.of_model, seen)
    found = planned.with_free_terms(seen)
    assert (found.rank, found.unknowns) == (seen.rank + 18 - 7, seen.unknowns + 18)
    assert (found.deficiency, found.identifiable) == (7, False)
    assert in_words(found.advice)[0].startswith(
        "drift: visit the marks in more than one order"
    )
    sized = PlannedTerms(plan, parse_terms(["drift:1e-8"], ""), Assumed(order="raster"))
    assert sized.with_free_terms(seen) == seen


def test_shifts_of_both_signs_damp_bent_plates():
    """Plates bent by 10 nm in each view: both shifts take most of it off the map."""

    def effect(text):
        return (
            PlannedTerms(plan_of(text, 11), (), Assumed())
            .check("plate_shape", 10e-9, LEVEL)
            .effect_rms_m
        )

    one_sided, both_sides = effect("0, 90, tx"), effect("0, 90, tx, -tx, ty, -ty")
    assert both_sides < 0.5 * one_sided


@pytest.mark.parametrize(
    ("views", "worst"), [("0, 90, tx", 34.8), ("0, 90, tx, -tx, ty, -ty", 8.5)]
)
def test_a_plate_bent_in_one_view_only(views, worst):
    """10 nm of (x^2 - y^2, -2xy), which no turn and no single shift tells from the stage."""
    plan = plan_of(views, 11)
    every = PlannedTerms(plan, (), Assumed()).all_terms
    found = []
    for view in range(len(plan.views)):
        b = [
            10 * ((c.term, c.view, c.component) == ("plate_shape", view, "z*^2 x"))
            for c in every.columns.columns
        ]
        moved = every.maps @ b
        found.append(max(abs(moved.real).max(), abs(moved.imag).max()))
    assert max(found) == pytest.approx(worst, abs=0.05)


@pytest.mark.parametrize(
    "text",
    [
        "line_scale",
        "line_eccentricity",
        "rotation",
        "drift",
        "line_scale:0.1",
        "plate_shape,line_eccentricity:1e-5",
    ],
)
def test_terms_of_the_model_are_judged_as_the_readings_would_be(text):
    """Also those for which plans are not judged otherwise, and those of the lines."""
    plan = plan_of("0, 90, tx", 5, count=8, line=True)
    terms, assumed = parse_terms(text.split(","), ""), Assumed()
    planned = PlannedTerms(plan, terms, assumed, ["line_scale"])
    alone = planned_equations(
        plan, planned_system(plan.artifact, plan.views), terms, assumed
    )
    assert planned.of_model.n == alone.n > 0
    assert (
        planned.of_model.unseen(planned.of_model.free).shape[1]
        == alone.unseen(alone.free).shape[1]
    )
    assert planned.of_model.columns.columns == alone.columns.columns
    named = [found.name for found in check_terms(planned, {"line_scale": 0.1}, LEVEL)]
    assert set(nominal_sizes()) < set(named)
    assert ("line_scale" in named) and ("line_eccentricity" in named) == (
        "city:" in text
    )


def test_the_assumed_offsets_are_misalignments_and_stop_errors():
    plan = plan_of("0, 90, tx", 31)
    exact = planned_inputs(
        plan.artifact, plan.views, Assumed(stop_error_m=1e-15, error_m=1e-15)
    ).visits
    for view, visits in zip(plan.views, exact, strict=True):
        found = visit_sequence(plan.artifact, view)
        place = 0.01 * (found.i + 1j * found.j) - complex(*view.translation_m)
        design = np.stack([np.ones_like(place), place], axis=1)
        (shift, slope), *_ = np.linalg.lstsq(design, visits.offset, rcond=None)
        np.testing.assert_allclose(design @ (shift, slope), visits.offset, atol=1e-12)
        # in the frame of the plate, which lies turned itself
        turn = -np.angle(1 - slope)
        assert slope == pytest.approx(1 - np.exp(-1j * turn), abs=1e-12)
        assert 1e-5 < abs(turn) < 3 * np.radians(0.3)
        assert 1e-6 < abs(shift) < 3 * 30e-6 * 2**0.5
        # the same draws with stop errors, or errors of stage and plate: those have their size
        for more, size in (
            ({"stop_error_m": 5e-6, "error_m": 1e-15}, 5e-6),
            ({"stop_error_m": 1e-15, "error_m": 2e-6}, 2e-6 * 2**0.5),
        ):
            rough = planned_inputs(plan.artifact, plan.views, Assumed(**more))
            added = rough.visits[plan.views.index(view)].offset - visits.offset
            n = len(added)
            for part in (added.real, added.imag):
                assert np.var(part) * n / size**2 == pytest.approx(
                    n, abs=5 * (2 * n) ** 0.5
                )


def test_a_power_is_the_rate_of_drawn_tests():
    """No term at all: the test finds one as often as its level says."""
    found = PlannedTerms(SMALL, (), Assumed()).check("approach", 1e-15, 0.05)
    assert found.power == pytest.approx(
        0.05, abs=5 * (0.05 * 0.95 / resistance.DRAWS) ** 0.5
    )
    assert PlannedTerms(SMALL, (), Assumed()).check("approach", 1e-5, 0.05).power == 1.0


def test_large_fields_are_judged_on_a_smaller_one(monkeypatch):
    monkeypatch.setattr(plan_check, "UNASKED_SITES", 100)
    monkeypatch.setattr(plan_check, "PROXY_SIZE", 9)
    large, small = (
        PlannedTerms(plan_of("0, 90, tx", size), (), Assumed()) for size in (21, 9)
    )
    assert check_terms(large, {}, LEVEL) == check_terms(small, {}, LEVEL)


def test_a_shift_along_a_diagonal_tells_bent_plates_from_the_stage():
    plan = plan_of("0, 90, tx, -tx, ty, -ty", 5)
    corner = View("corner", 0.0, (0.01, 0.01), True, False)
    found = [
        PlannedTerms(replace(plan, views=views), (), Assumed())
        .check("plate_shape", 1e-8, LEVEL)
        .unseen_modes
        for views in (plan.views, (*plan.views, corner))
    ]
    assert found == [1, 0]
    assert (
        Dense(replace(plan, views=(*plan.views, corner)), Assumed()).n_unseen(
            [ModelTerm("plate_shape")]
        )
        == 0
    )
