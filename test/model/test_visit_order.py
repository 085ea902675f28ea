# SPDX-License-Identifier: Apache-2.0
"""Visiting orders: written out by hand on a small plate, and what holds on any."""

import math
from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.errors import InputError
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.view import ORDERS, View, VisitOrder, parse_order
from selfcal_ros.model.visit_order import approach_signs, check_marks, visit_sequence

PLATE = Artifact(3, 0.01, 0, 5)
"""Three marks along x, five along y: no order may mix up its axes unseen."""
ONCE = View("v")


def sites(order, *, plate=PLATE, view=ONCE, **more):
    found = visit_sequence(
        plate, view, order=order, rng=np.random.default_rng(1), **more
    )
    return list(zip(found.i.tolist(), found.j.tolist(), strict=True))


def marks(order, *, plate=PLATE, view=ONCE):
    found = visit_sequence(plate, view, order=order)
    return list(zip(found.m.tolist(), found.n.tolist(), strict=True))


ALONG_X = [(i, j) for i in (-1, 0, 1) for j in (-2, -1, 0, 1, 2)]
ALONG_Y = [(i, j) for j in (-2, -1, 0, 1, 2) for i in (-1, 0, 1)]


def test_the_orders_written_out():
    assert sites("raster") == ALONG_X
    assert sites("serpentine") == [
        (-1, -2),
        (-1, -1),
        (-1, 0),
        (-1, 1),
        (-1, 2),
        (0, 2),
        (0, 1),
        (0, 0),
        (0, -1),
        (0, -2),
        (1, -2),
        (1, -1),
        (1, 0),
        (1, 1),
        (1, 2),
    ]
    four = View("v", repeats=4)
    # where a pass ends on the mark on which the next begins, that is one visit of two exposures
    assert sites("there_and_back", view=four) == [
        *ALONG_X,
        *ALONG_X[-2::-1],
        *ALONG_X[1:],
        *ALONG_X[-2::-1],
    ]
    assert sites("x_then_y", view=four) == 2 * (ALONG_X + ALONG_Y)
    assert sites("x_back_y_back", view=four) == [
        *ALONG_X,
        *ALONG_X[-2::-1],
        *ALONG_Y[1:],
        *ALONG_Y[-2::-1],
    ]
    assert sorted(sites("random")) == sorted(ALONG_X)
    assert sites("random") != ALONG_X


def test_a_turn_that_does_not_end_is_cut():
    assert sites("x_then_y", view=View("v", repeats=3)) == ALONG_X + ALONG_Y + ALONG_X
    assert sites("x_back_y_back", view=View("v", repeats=1)) == ALONG_X


def test_times_passes_and_counts():
    found = visit_sequence(PLATE, View("v", repeats=2), order="there_and_back")
    assert found.count.tolist() == [1] * 14 + [2] + [1] * 14
    assert found.time.tolist() == [*range(14), 14.5, *range(16, 30)]
    assert found.pass_number.tolist() == [0] * 15 + [1] * 14
    assert len(found) == 29


def test_consecutive_repeats_are_one_visit_of_one_pass():
    found = visit_sequence(
        PLATE, View("v", repeats=3), order="there_and_back", consecutive=True
    )
    assert list(zip(found.i, found.j, strict=True)) == ALONG_X
    assert found.count.tolist() == [3] * 15
    assert found.time.tolist() == [3 * visit + 1 for visit in range(15)]
    assert set(found.pass_number) == {0}


def test_the_stage_goes_the_same_way_and_the_marks_turn():
    plate = Artifact(3, 0.01)
    turned = View("v", math.pi / 2)
    assert sites("raster", plate=plate, view=turned) == sites("raster", plate=plate)
    # a quarter turn brings mark (m, n) to site (-n, m): the first site, (-1, -1), holds (-1, 1)
    assert marks("raster", plate=plate, view=turned)[:4] == [
        (-1, 1),
        (0, 1),
        (1, 1),
        (-1, 0),
    ]


def test_of_the_plate_the_same_marks_follow_each_other_in_every_view():
    plate = Artifact(3, 0.01)
    turned = View("v", math.pi / 2)
    assert marks("raster@plate", plate=plate, view=turned) == marks(
        "raster", plate=plate
    )
    assert sites("raster@plate", plate=plate, view=turned)[:4] == [
        (1, -1),
        (0, -1),
        (-1, -1),
        (1, 0),
    ]


def test_marks_off_the_field_are_not_visited():
    shifted = View("v", 0.0, (0.01, 0.0))
    assert sites("raster", view=shifted) == [(i, j) for i, j in ALONG_X if i >= 0]
    assert marks("raster", view=shifted)[0] == (-1, -2)
    # lines still turn about at their own ends
    raised = View("v", 0.0, (0.0, 0.01))
    assert sites("serpentine", view=raised)[:6] == [
        (-1, -1),
        (-1, 0),
        (-1, 1),
        (-1, 2),
        (0, 2),
        (0, 1),
    ]


@pytest.mark.parametrize("suffix", ["", "@plate"])
@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("consecutive", [True, False])
def test_every_mark_is_exposed_as_often_as_the_view_asks(order, suffix, consecutive):
    plate, view = Artifact(5, 0.01, 0, 7), View("v", math.pi, (0.01, -0.02), repeats=5)
    found = visit_sequence(
        plate,
        view,
        order=order + suffix,
        consecutive=consecutive,
        rng=np.random.default_rng(2),
    )
    assert (abs(found.i) <= 2).all() and (abs(found.j) <= 3).all()
    np.testing.assert_array_equal(found.i, -found.m + 1)
    np.testing.assert_array_equal(found.j, -found.n - 2)
    _, at = np.unique(100 * found.m + found.n, return_inverse=True)
    assert set(np.bincount(at, found.count)) == {5.0}
    assert len(np.unique(at)) == 4 * 5
    assert found.count.sum() == 100
    # times are the means of runs of whole numbers that follow each other
    np.testing.assert_allclose(
        found.time, np.cumsum(found.count) - (found.count + 1) / 2
    )


def test_the_order_of_the_view_holds_unless_another_is_asked_for():
    view = View("v", visit_order="raster")
    assert sites("", view=view) == ALONG_X
    assert sites("serpentine", view=view) == sites("serpentine")
    assert sites("") == sites("serpentine")


def test_lines_are_no_visits():
    assert (
        len(visit_sequence(Artifact(3, 0.01, 8), View("v", math.pi / 4, grid=False)))
        == 0
    )


def test_a_random_order_needs_chance():
    with pytest.raises(
        ValueError, match=r"^a random visiting order needs a source of chance$"
    ):
        visit_sequence(PLATE, View("v"), order="random")


@pytest.mark.parametrize(
    "text", ["spiral", "raster@stage", "@plate", "raster@plate@plate", "Raster"]
)
def test_orders_that_are_not_known(text):
    with pytest.raises(InputError) as caught:
        parse_order(text, "here")
    assert str(caught.value) == (
        f"here: '{text}' is not a visiting order; use one of raster, serpentine, there_and_back, "
        "x_then_y, x_back_y_back, random, if need be with @plate"
    )


def test_text_and_order_are_one():
    assert parse_order("x_then_y@plate") == VisitOrder("x_then_y", True)
    for name in ORDERS:
        assert str(parse_order(name)) == name
        assert str(parse_order(name + "@plate")) == name + "@plate"


def test_the_side_from_which_a_place_is_reached():
    assert approach_signs(np.array([2.0, 2.0, 3.0, 3.0, 1.0, 1.0, 5.0])).tolist() == [
        0,
        0,
        1,
        1,
        -1,
        -1,
        1,
    ]
    assert approach_signs(np.array([0.0, 0.1, 1.0, 0.9, 0.0]), 0.2).tolist() == [
        0,
        0,
        1,
        1,
        -1,
    ]
    assert approach_signs(np.array([0.0, 0.2, 0.0]), 0.2).tolist() == [0, 0, 0]
    assert approach_signs(np.zeros(0)).tolist() == []


@pytest.mark.parametrize("order", ORDERS)
def test_an_order_begins_again_after_its_passes(order):
    if order == "random":
        assert parse_order(order).passes == 1
        return
    n = PLATE.m.size
    # exposures, not visits: where passes meet on a mark there is one visit less
    found = visit_sequence(PLATE, View("v", repeats=8), order=order)
    each = np.repeat(found.i * 100 + found.j, found.count).reshape(8, n)
    same = [p for p in (1, 2, 4, 8) if (each == np.tile(each[:p], (8 // p, 1))).all()]
    assert parse_order(order + "@plate").passes == same[0]


CHECKED = replace(ONCE, check_marks=3, check_offset_m=2e-5)


@pytest.mark.parametrize(
    ("repeats", "before"), [(1, 1), (2, 1), (3, 2), (4, 2), (5, 3)]
)
def test_check_stops_come_half_way_side_by_side_in_the_same_order(repeats, before):
    found = visit_sequence(PLATE, replace(CHECKED, repeats=repeats), order="raster")
    where = list(zip(found.i, found.j, strict=True))
    stops = slice(15 * before, 15 * before + 12)
    assert where[: stops.start] == before * ALONG_X
    assert where[stops.stop :] == (repeats - before) * ALONG_X
    one = [(0, 0), (0, 1), (-1, -1)]  # of two as near the first
    assert where[stops] == 4 * one
    assert (found.aside_m[:, stops] * 1e5).T.tolist() == [
        *3 * [[2, 0]],
        *3 * [[-2, 0]],
        *3 * [[0, 2]],
        *3 * [[0, -2]],
    ]
    assert np.count_nonzero(found.aside_m) == 12
    assert found.count.tolist() == len(found) * [1]
    assert found.time.tolist() == list(range(len(found)))
    assert (np.diff(found.pass_number) >= 0).all()
    assert (found.pass_number[stops] - before).tolist() == [
        0,
        0,
        0,
        1,
        1,
        1,
        2,
        2,
        2,
        3,
        3,
        3,
    ]
    assert found.pass_number[-1] == repeats + 3


def test_check_stops_part_the_two_exposures_where_the_stage_turns_back():
    """Consecutive repeats are one visit, a check stop is always one exposure."""
    found = visit_sequence(PLATE, replace(CHECKED, repeats=2), order="there_and_back")
    assert found.count.tolist() == 42 * [1]
    together = visit_sequence(
        PLATE, replace(CHECKED, repeats=3), order="raster", consecutive=True
    )
    assert together.count.tolist() == 15 * [3] + 12 * [1]
    assert together.time.tolist() == [*range(1, 45, 3), *range(45, 57)]


def test_check_stops_are_along_the_axes_of_the_stage_whatever_the_turn():
    view = replace(CHECKED, rotation_rad=math.pi / 2)
    turned = visit_sequence(Artifact(5, 0.01, 0), view)
    straight = visit_sequence(Artifact(5, 0.01, 0), CHECKED)
    assert turned.aside_m.tolist() == straight.aside_m.tolist()
    assert (
        turned.i[turned.aside_m.any(axis=0)].tolist()
        == straight.i[straight.aside_m.any(axis=0)].tolist()
    )
    # the mark that lies there
    assert (
        turned.m[turned.aside_m.any(axis=0)].tolist()
        == straight.j[straight.aside_m.any(axis=0)].tolist()
    )


def test_a_view_without_grid_marks_has_no_check_stops():
    assert len(visit_sequence(PLATE, replace(CHECKED, grid=False))) == 0


def test_marks_of_check_stops_spread_over_what_lies_in_the_field():
    def chosen(number, i, j):
        sites = np.array([part.ravel() for part in np.meshgrid(i, j, indexing="ij")])
        return sites[:, check_marks(sites, number)].T.tolist()

    field = np.arange(-4, 5)
    assert chosen(5, field, field) == [[0, 0], [2, 2], [-2, 2], [-2, -2], [2, -2]]
    assert chosen(1, field, field) == [[0, 0]]
    assert chosen(5, field[2:], field) == [[1, 0], [2, 2], [-1, 2], [-1, -2], [2, -2]]
    every = chosen(9, np.arange(-1, 2), np.arange(-1, 2))
    assert len({tuple(site) for site in every}) == 9
    # no more than there are
    assert chosen(20, np.arange(-1, 2), np.arange(-1, 2)) == every
