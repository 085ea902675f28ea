# SPDX-License-Identifier: Apache-2.0
"""Sites that single readings tell: against taking readings off one by one, and in the map."""

from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.lattice.connectivity import rest_on_one
from selfcal_ros.estimation.observability.plan_check import check_plan
from selfcal_ros.model.findings import Unchecked
from selfcal_ros.model.readings import Sense
from test.support.plans import plan_of
from test.support.truth import random_truth, simulate_measurements

SIGMA_M = 20e-9


def unchecked(sites, lines):
    return Unchecked(sites=tuple(map(tuple, sites)), lines=tuple(lines))


def one_by_one(site, mark):
    """Return the sites of which no reading is left once those alone at a site or mark are gone."""
    left = list(zip(site.tolist(), mark.tolist(), strict=True))
    alone = True
    while alone:
        alone = next(
            (
                r
                for r in left
                if [s for s, _ in left].count(r[0]) == 1
                or [m for _, m in left].count(r[1]) == 1
            ),
            None,
        )
        if alone:
            left.remove(alone)
    return set(site.tolist()) - {s for s, _ in left}


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("readings", [0, 1, 6, 12, 18, 24])
def test_sites_are_those_that_are_left_without_readings(readings, seed):
    rng = np.random.default_rng(seed)
    site, mark = rng.integers(0, 9, readings), rng.integers(0, 11, readings)
    found = rest_on_one(site, mark, n_sites=10, n_marks=11)
    assert set(np.flatnonzero(found).tolist()) == one_by_one(site, mark)


def test_a_mark_read_twice_at_a_site_is_checked():
    assert not rest_on_one(
        np.array([0, 0]), np.array([0, 0]), n_sites=1, n_marks=1
    ).any()


def measured(names, gone, *, sense=Sense.MICROSCOPE_MOVES, lines=(), size=5, size_y=0):
    """Return readings of Hu's noise without the marks `gone` and `lines`: {view: marks}, stated."""
    plan = plan_of(names, size, count=8, size_y=size_y, line=True, repeats=4)
    rng = np.random.default_rng(5)
    readings = simulate_measurements(
        random_truth(plan.artifact, len(plan.views), rng),
        plan,
        rng,
        sigma_m=SIGMA_M,
        sigma_theta_rad=2e-5,
        sense=sense,
    )
    views = []
    for view in readings.views:
        keep = np.array(
            [
                mark not in gone.get(view.view.name, ())
                for mark in zip(view.m.tolist(), view.n.tolist(), strict=True)
            ],
            bool,
        )
        rows = np.array(
            [k not in dict(lines).get(view.view.name, ()) for k in view.k.tolist()],
            bool,
        )
        views.append(
            replace(
                view,
                m=view.m[keep],
                n=view.n[keep],
                dx=view.dx[keep],
                dy=view.dy[keep],
                count=view.count[keep],
                k=view.k[rows],
                dtheta=view.dtheta[rows],
                count_theta=view.count_theta[rows],
            )
        )
    return replace(readings, views=tuple(views))


def off(readings, name, mark, by_m):
    """Return the readings with one mark of one view off along x."""
    return replace(
        readings,
        views=tuple(
            view
            if view.view.name != name
            else replace(
                view, dx=view.dx + by_m * ((view.m == mark[0]) & (view.n == mark[1]))
            )
            for view in readings.views
        ),
    )


# site (2, 1) is reached by mark (2, 1) in '0', by (1, -2) in '90' and by (1, 1) in 'tx'
ONE_LEFT = {"90": {(1, -2)}, "tx": {(1, 1)}}


@pytest.mark.parametrize("sense", list(Sense))
def test_an_error_of_a_reading_that_no_other_checks_is_in_the_map_and_said(sense):
    sign = 1 if sense is Sense.MICROSCOPE_MOVES else -1
    readings = measured("0, 90, tx", ONE_LEFT, sense=sense)
    good, bad = calibrate(readings), calibrate(off(readings, "0", (2, 1), 1e-6))
    at = (2 + 2 * sign, 2 + sign)
    moved = bad.error_map.gx - good.error_map.gx
    # the datum takes part of it
    assert moved[at] == pytest.approx(sign * 1e-6, rel=0.15)
    assert np.sort(abs(moved).ravel())[-2] < 0.15e-6
    assert bad.noise.sigma_xy_residuals == pytest.approx(
        good.noise.sigma_xy_residuals, rel=0.01
    )
    assert bad.verdict.qualified
    assert bad.findings == good.findings == (unchecked([[2 * sign, sign]], []),)
    assert (
        good.observability.unchecked_sites == 1
        and good.observability.unchecked_lines == 0
    )


@pytest.mark.parametrize("sense", list(Sense))
def test_an_error_of_a_line_that_no_other_checks_is_in_the_map_and_said(sense):
    readings = measured(
        "0, 90, tx", {}, sense=sense, lines={"90": {1}, "tx": {3}, "line": {2}}.items()
    )
    first = readings.views[0]
    bad = replace(first, dtheta=first.dtheta + 1e-3 * (first.k == 3))
    good, bad = (
        calibrate(readings),
        calibrate(replace(readings, views=(bad, *readings.views[1:]))),
    )
    moved = np.argmax(abs(bad.error_map.g_theta - good.error_map.g_theta))
    assert moved == (3 if sense is Sense.MICROSCOPE_MOVES else 5)
    assert bad.findings == good.findings == (unchecked([], [moved]),)


@pytest.mark.parametrize(
    ("names", "gone", "lines", "expected"),
    [
        ("0, 90, tx", {}, (), ()),
        # two readings are left of site (2, 1), but one of them is all that tells of mark (1, -2)
        (
            "0, 90, tx",
            {"tx": {(1, 1), (1, -2)}, "0": {(1, -2)}},
            (),
            (unchecked([[2, 1]], []),),
        ),
        # a mark that is read once tells nothing of its site, which others reach
        ("0, 90, tx, ty", {"tx": {(1, 1)}, "90": {(1, 1)}, "ty": {(1, 1)}}, (), ()),
        ("0, 90, tx, ty", ONE_LEFT, (), ()),
        (
            "0, 90, tx",
            {},
            {"90": {1}, "tx": {3}, "line": {2}}.items(),
            (unchecked([], [3]),),
        ),
    ],
)
def test_what_is_counted(names, gone, lines, expected):
    result = calibrate(measured(names, gone, lines=tuple(lines)))
    assert result.findings == expected
    seen = result.observability
    assert seen.unchecked_sites == sum(len(one.sites) for one in expected)
    assert seen.unchecked_lines == sum(len(one.lines) for one in expected)


def test_a_site_that_is_not_known_is_not_counted():
    readings = measured("0, 90, tx", {"0": {(2, 1)}, **ONE_LEFT})
    result = calibrate(readings)
    assert np.isnan(result.error_map.gx[4, 3]) and result.findings == ()


@pytest.mark.parametrize(
    ("names", "expected"), [("0, 90, tx", 12), ("0, 90, tx, -tx", 0)]
)
def test_a_plan_tells_where_it_leaves_sites_unchecked(names, expected):
    """Where no quarter turn reaches, one shift joins the sites of a row in a chain."""
    plan = plan_of(names, 7, size_y=3)
    assert check_plan(plan).observability.unchecked_sites == expected
    result = calibrate(measured(names, {}, size=7, size_y=3))
    assert result.observability.unchecked_sites == expected
    assert all(abs(m) > 1 for found in result.findings for m, _ in found.sites)
