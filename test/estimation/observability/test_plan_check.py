# SPDX-License-Identifier: Apache-2.0
"""What a plan sees and what it leaves unseen: Qiao's tables, named modes, cures, missing marks."""

from dataclasses import replace
from math import gcd

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from selfcal_ros.errors import NotIdentifiableError
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.normal.equations import planned_system
from selfcal_ros.estimation.observability import plan_check, rank
from selfcal_ros.estimation.observability.plan_check import (
    candidate_views,
    check_plan,
    find_cures,
    predict_plan,
)
from selfcal_ros.estimation.observability.rank import (
    identifies,
    is_unseen,
    plan_observability,
    smaller,
    unseen_modes,
)
from selfcal_ros.model.artifact import MapGrid
from selfcal_ros.model.view import View
from selfcal_ros.reporting.words.observability import describe_view, with_advice
from selfcal_ros.settings.estimator import read_plan
from test.support.options import BARE, bare
from test.support.plans import POSES, QIAO_TABLES, plan_of
from test.support.refusals import in_words
from test.support.sources import ROOT
from test.support.truth import Spread, random_truth, simulate_measurements


def dense_rank(plan):
    """Return Qiao's rank by brute force: the matrix of his eqs. 1 and 5 as it stands."""
    artifact, (hx, hy) = plan.artifact, plan.artifact.half
    nx, ny = artifact.shape
    sites = nx * ny
    rows = []
    for index, view in enumerate(plan.views):
        pose = view.lattice_pose(artifact)
        cos, sin = ((1, 0), (0, 1), (-1, 0), (0, -1))[pose.quarter_turns]
        for m in range(-hx, hx + 1):
            for n in range(-hy, hy + 1):
                x, y = cos * m - sin * n, sin * m + cos * n
                i, j = x + pose.shift[0], y + pose.shift[1]
                if abs(i) > hx or abs(j) > hy:
                    continue
                mark, site = (m + hx) * ny + n + hy, (i + hx) * ny + j + hy
                for axis, turn in enumerate(((cos, -sin), (sin, cos))):
                    row = np.zeros(4 * sites + 3 * len(plan.views))
                    row[axis * sites + site] = 1
                    row[2 * sites + mark], row[3 * sites + mark] = turn
                    row[4 * sites + 3 * index] = (-y, x)[axis]
                    row[4 * sites + 3 * index + 1 + axis] = 1
                    rows.append(row)
    one, x, y = np.ones(sites), artifact.m.ravel(), artifact.n.ravel()
    for parts in ((one, None), (None, one), (-y, x), (x, y)):
        for base in (0, 2 * sites) if parts[0] is not x else (0,):
            row = np.zeros(4 * sites + 3 * len(plan.views))
            for axis, part in enumerate(parts):
                if part is not None:
                    row[base + axis * sites : base + (axis + 1) * sites] = part
            rows.append(row)
    return np.linalg.matrix_rank(np.array(rows))


@pytest.mark.parametrize("size", [3, 5, 7, 9, 11])
@pytest.mark.parametrize(
    ("views", "rank", "extra"), QIAO_TABLES, ids=lambda v: str(v)[:16]
)
def test_all_rank_tables_of_qiao(views, rank, extra, size):
    seen = plan_observability(plan_of(views, size))
    assert (seen.rank, seen.unknowns) == (rank(size), 4 * size**2 + extra)
    assert seen.deficiency == seen.unknowns - seen.rank
    assert seen.identifiable == (seen.deficiency == 0)


@settings(max_examples=25, deadline=None)
@given(
    st.lists(st.sampled_from(sorted(POSES)), min_size=1, max_size=4),
    st.sampled_from([(3, 0), (5, 0), (5, 3)]),
)
def test_rank_is_that_of_the_dense_matrix(names, shape):
    if shape[1]:
        names = [name for name in names if POSES[name][0] % 2 == 0] or ["0"]
    plan = plan_of(", ".join(names), shape[0], size_y=shape[1])
    seen, dense = plan_observability(plan), dense_rank(plan)
    assert seen.rank == dense
    assert identifies(plan.artifact, plan.views) == (dense == seen.unknowns)


@pytest.mark.parametrize("views", ["-tx, -ty, 90tx", "-tx, 90tx, tx2"])
def test_few_sites_of_a_small_plate_leave_nothing_to_eliminate(views):
    plan = plan_of(views, 3)
    assert plan_observability(plan).rank == dense_rank(plan)


@pytest.mark.parametrize(
    ("views", "asks"),
    [
        ("0", False),
        ("-tx, -ty, 90tx", False),
        ("90tx, tx, ty", False),
        ("0, 90, tx", True),
    ],
)
def test_no_matrix_is_made_where_a_count_says_no(monkeypatch, views, asks):
    """One view joins each mark to one site; then one mark is never read, then no corner visited."""
    asked: list = []
    monkeypatch.setattr(rank, "deficiency", lambda system: asked.append(system) or 0)
    plan = plan_of(views)
    asked_anew = identifies.__wrapped__(plan.artifact, plan.views)
    assert (asked_anew, len(asked)) == (asks, asks)


def test_an_arbitrary_field_is_seen_by_hus_plan_and_not_by_one_view():
    field = np.random.default_rng(1).normal(size=(2, 5, 5))
    for views, unseen in (("0, 90, tx", False), ("0, 90", False), ("0", True)):
        plan = plan_of(views)
        assert (
            is_unseen(
                planned_system(plan.artifact, plan.views), field[0] + 1j * field[1]
            )
            is unseen
        )


def test_no_error_is_unseen_and_the_least_one_is_not():
    plan, field = plan_of("0, 90, tx"), np.zeros((5, 5), dtype=complex)
    system = planned_system(plan.artifact, plan.views)
    assert is_unseen(system, field)
    field[1, 3] = 1e-9
    assert not is_unseen(system, field)


def names(views, **kwargs):
    plan = plan_of(views, **kwargs)
    return [
        mode.name for mode in unseen_modes(planned_system(plan.artifact, plan.views))
    ]


def test_groups_that_no_reading_joins_are_counted_and_the_smallest_is_named():
    """Every second site of a row of 5 hangs together: three with the ends, two between them."""
    plan = plan_of("0, tx2", 5, size_y=3)
    assert (
        "6 groups of sites that no reading connects: each may move independently; the smallest "
        "is (-1, -1), (1, -1)"
    ) in in_words(check_plan(plan).observability.modes)


def test_shifts_along_both_axes_leave_exactly_nonorthogonality_and_scale_difference():
    for size in (3, 5, 11):
        assert names("0, tx, ty", size=size) == ["nonorthogonality", "scale_difference"]
        assert plan_observability(plan_of("0, tx, ty", size)).deficiency == 2


@pytest.mark.parametrize("size", [3, 5, 7, 11])
def test_four_turns_leave_half_of_n_squared_less_5_fields(size):
    """Those that a quarter turn maps to itself, without rotation and scale, which are datum."""
    orbits = (size**2 - 1) // 4  # of sites under a quarter turn; the centre stays
    seen = check_plan(plan_of("0, 90, 180, 270", size)).observability
    assert seen.deficiency == 2 * orbits - 2 == (size**2 - 5) // 2
    assert seen.modes[0].numbers == seen.deficiency


@pytest.mark.parametrize(
    ("views", "expected"),
    [
        ("0", ["every_field"]),
        ("tx", ["every_field", "sites_never_visited", "marks_never_read"]),
        ("0, 90", ["rotation_symmetric"]),
        ("0, 90, 180, 270", ["rotation_symmetric"]),
        ("0, 180", ["nonorthogonality", "scale_difference", "rotation_symmetric"]),
        (
            "0, tx",
            ["nonorthogonality", "scale_difference", "bending_x", "line_offsets"],
        ),
        (
            "0, ty",
            ["nonorthogonality", "scale_difference", "bending_y", "line_offsets"],
        ),
        ("0, 180, tx", ["nonorthogonality", "scale_difference", "line_offsets"]),
        ("0, tx2, ty2", ["nonorthogonality", "scale_difference", "periodic_fields"]),
        ("0, 90, tx", []),
    ],
)
def test_unseen_modes_by_name(views, expected):
    assert names(views, size=7) == expected


def test_angular_lines_see_the_bending_that_shifts_alone_do_not():
    assert "bending_x" in names("0, tx", size=7)
    assert "bending_x" not in names("0, tx", size=7, count=8, line=True)


def test_unseen_modes_in_words():
    def modes(views, size, **kwargs):
        return in_words(check_plan(plan_of(views, size, **kwargs)).observability.modes)

    assert modes("0, 180, tx, ty", 5) == [
        "non-orthogonality of the axes: Gx = O y, Gy = O x",
        "scale difference of the axes: Gx = R x, Gy = -R y",
    ]
    assert modes("0, 90", 5, count=8) == [
        "rotation-symmetric fields: every field that a quarter turn maps to itself "
        "(10 numbers beside the datum)",
        "angular map: patterns that repeat every 2 lines",
    ]
    half = modes("0, 180", 5)[-1]
    assert "half turn" in half
    rows = modes("0, 180, tx", 5)[-1]
    assert rows.endswith("opposite in opposite rows")
    double = modes("0, tx2, ty2", 7)[-1]
    assert double == (
        "patterns that repeat every 2 pitches along x and every 2 pitches along y "
        "(6 numbers beside the datum)"
    )


@pytest.mark.parametrize(
    ("views", "first"),
    [
        ("0, 90", "add an unturned view shifted by +1 pitch along X"),
        ("0, tx, ty", "add a view turned by 90°"),
        (
            "0",
            "add a view turned by 90° and an unturned view shifted by +1 pitch along X",
        ),
    ],
)
def test_advice_names_the_missing_view(views, first):
    assert in_words(check_plan(plan_of(views)).observability.advice)[0] == first


@pytest.mark.parametrize(
    ("views", "size"), [("tx", 3), ("0, 180", 5), ("0, 180, +tx, -tx", 5)]
)
def test_every_cure_cures_and_nothing_smaller_does(views, size):
    plan = plan_of(views, size, count=8)
    cures = list(find_cures(plan))
    assert cures
    for cure in cures:
        assert plan_observability(
            replace(plan, views=(*plan.views, *cure))
        ).identifiable
        if len(cure) > 1:
            for left_out in range(len(cure)):
                part = cure[:left_out] + cure[left_out + 1 :]
                assert not plan_observability(
                    replace(plan, views=(*plan.views, *part))
                ).identifiable


@settings(max_examples=40, deadline=None)
@given(st.lists(st.integers(0, 23), min_size=1, max_size=4))
def test_turns_identify_the_circle_if_they_generate_it(turns):
    plan = plan_of("0, 90, tx", 3, count=24)
    lines = tuple(
        View(f"l{i}", turn * np.pi / 12, (0.0, 0.0), False, True)
        for i, turn in enumerate(turns)
    )
    grid = tuple(replace(view, angular=view.name == "0") for view in plan.views)
    step = gcd(24, *turns)
    seen = plan_observability(replace(plan, views=(*grid, *lines)))
    assert seen.deficiency == step - 1


def test_two_turns_that_only_together_generate_the_circle():
    grid = plan_of("0, 90, tx", 3, count=24)
    eight, nine = (
        View(f"l{k}", k * np.pi / 12, (0.0, 0.0), False, True) for k in (8, 9)
    )
    assert (
        check_plan(replace(grid, views=(*grid.views, nine))).observability.deficiency
        == 2
    )
    assert (
        check_plan(replace(grid, views=(*grid.views, eight))).observability.deficiency
        == 1
    )
    assert check_plan(
        replace(grid, views=(*grid.views, eight, nine))
    ).observability.identifiable


def test_missing_marks_change_the_verdict():
    plan = plan_of("0, 90, tx", 5)
    rng = np.random.default_rng(1)
    readings = simulate_measurements(random_truth(plan.artifact, 3, rng), plan, rng)
    assert calibrate(readings, BARE).observability.identifiable
    shifted = readings.views[2]
    gone = replace(
        shifted,
        **{
            name: getattr(shifted, name)[:1] for name in ("m", "n", "dx", "dy", "count")
        },
    )
    with pytest.raises(NotIdentifiableError, match="do not identify the stage"):
        calibrate(replace(readings, views=(*readings.views[:2], gone)), BARE)


def test_candidates_and_their_description():
    artifact = plan_of("0", 5, count=8).artifact
    views = candidate_views(artifact, angular=True)
    assert len(views) == len({view.name for view in views}) == 21
    texts = [describe_view(view, artifact) for view in views]
    assert texts[-1] == "an angular view turned by 1 line (45°)"
    assert "a view turned by 270° and shifted by -1 pitch along Y" in texts
    tall = plan_of("0", 5, size_y=9).artifact
    assert all(
        describe_view(view, tall) for view in candidate_views(tall, angular=False)
    )


def test_shifts_are_described_to_a_thousandth_of_a_pitch():
    artifact = plan_of("0", 5).artifact
    third = View("third", 0.0, (artifact.grid_pitch_m / 3, 0.0), True, False)
    assert (
        describe_view(third, artifact)
        == "an unturned view shifted by +0.333 pitch along X"
    )


def test_smaller_fields_keep_room_for_the_shifts():
    plan = plan_of("0, 90, tx2", 21)
    assert smaller(plan, 5).artifact.shape == (7, 7)
    assert smaller(plan, 51).artifact.shape == (21, 21)
    assert smaller(plan_of("0, 180", 21, size_y=5), 9).artifact.shape == (9, 5)
    assert smaller(plan_of("0, 90, ty", 41, size_y=61), 31).artifact.shape == (21, 31)
    assert smaller(plan_of("0, 90, ty2", 9, size_y=61), 31).artifact.shape == (7, 31)


def test_a_plate_stepped_over_a_wider_map_is_judged_whole():
    """On a smaller plate its steps would leave gaps in the map."""
    plan = read_plan(ROOT / "config/plans/stepped.yaml")
    assert plan.artifact.is_stepped and smaller(plan, 11) is plan
    own_nodes = replace(plan.artifact, map_grid=MapGrid(5, 0.03))
    assert not own_nodes.is_stepped


@pytest.mark.parametrize(("size", "size_y"), [(21, 31), (31, 21), (11, 21)])
def test_long_fields_are_predicted_on_long_ones(size, size_y, monkeypatch):
    """A square would promise two thirds of the uncertainty, and half of the largest one."""
    plan = plan_of("0, 90, tx, ty", size, size_y=size_y)
    full = predict_plan(plan, "xy_axes")
    monkeypatch.setattr(plan_check, "UNASKED_SITES", 100)
    monkeypatch.setattr(plan_check, "PROXY_SIZE", 11)
    found = predict_plan(plan, "xy_axes")
    assert found.u_xy.size < full.u_xy.size
    assert found.rms_xy == pytest.approx(full.rms_xy, rel=0.1)
    assert found.max_xy == pytest.approx(full.max_xy, rel=0.2)


def test_a_deficient_measurement_is_refused_with_its_modes_and_cures():
    plan = plan_of("0, tx, ty", 5)
    rng = np.random.default_rng(1)
    readings = simulate_measurements(random_truth(plan.artifact, 3, rng), plan, rng)
    with pytest.raises(NotIdentifiableError) as refusal:
        calibrate(readings, BARE)
    error = with_advice(refusal.value)
    assert str(error).startswith(
        "the marks that were read do not identify the stage (2 modes undetermined): "
        "add a view turned by 90°; or add a view "
    )
    assert [mode.name for mode in error.observability.modes] == [
        "nonorthogonality",
        "scale_difference",
    ]
    assert error.observability.advice[1].text == "or add a view turned by 270°"
    assert with_advice(error) is error


@pytest.mark.parametrize("datum", ["xy_axes", "zero_mean"])
def test_lines_may_be_measured_in_views_of_their_own(datum):
    plan = plan_of("0, 90, tx", 5, count=12)
    grid = tuple(replace(view, angular=False) for view in plan.views)
    lines = tuple(
        View(f"line {s}", s * np.pi / 6, (0.0, 0.0), False, True) for s in (0, 1)
    )
    plan = replace(plan, views=(*grid, *lines))
    assert plan_observability(plan).identifiable
    assert plan_observability(replace(plan, views=(*grid, lines[0]))).deficiency == 11
    rng = np.random.default_rng(2)
    truth = random_truth(
        plan.artifact,
        5,
        rng,
        Spread(encoder="xy_axes" if datum == "xy_axes" else "independent"),
    )
    result = calibrate(simulate_measurements(truth, plan, rng), bare(datum_theta=datum))
    shift = truth.g_theta.mean() if datum == "zero_mean" else 0.0
    assert np.abs(result.error_map.g_theta - truth.g_theta + shift).max() < 1e-15
    # the rotation of the lines' own views and the constant of the plate's lines are one datum
    assert np.allclose(
        [v.phi for v in result.views[:3]], truth.phi_rad[:3], rtol=0, atol=1e-13
    )
    assert np.isnan([v.phi for v in result.views[3:]]).all()


@pytest.mark.parametrize(
    ("views", "rank"),
    [
        ("0, 90, tx", 4 * 101**2 + 9),
        ("0, 180, tx", 4 * 101**2 - 101 + 10),
        ("0, tx, ty", 4 * 101**2 + 7),
        ("0, 90", (7 * 101**2 + 17) // 2),
    ],
)
def test_large_fields_have_the_rank_of_the_formula(views, rank):
    assert plan_observability(plan_of(views, 101)).rank == rank
