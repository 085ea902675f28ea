# SPDX-License-Identifier: Apache-2.0
"""What tells the rotation of a view without ids; nothing is named where nothing tells it."""

from dataclasses import replace
from math import pi

import numpy as np
import pytest

from selfcal_ros.collection.inputs import Kind, Reason, advice
from selfcal_ros.collection.marks.identify import (
    IdentityRules,
    _middle,
    identify_angular,
    identify_grid,
)
from selfcal_ros.collection.marks.rigid import (
    LARGEST_TURN_RAD,
    MotionEstimate,
    Rigid,
    fit_motion,
)
from selfcal_ros.model.artifact import Artifact, MapGrid
from selfcal_ros.model.view import View
from selfcal_ros.simulation.cell import CellSettings, plan_events
from test.support.collecting import START_NS, collect
from test.support.plans import plan_of
from test.support.truth import angular_deviation, random_truth

RULES = IdentityRules(5e-4, 0.5, 0.035)


def lines(count, degrees, *, named=(), rules=RULES, phi_rad=None, scatter=0.0):
    """Return what becomes of all lines of a plate that is turned by `degrees` too far."""
    k = np.arange(count)
    has_id = np.isin(k, named)
    noise = np.random.default_rng(4).normal(0, scatter, count)
    return k, identify_angular(
        Artifact(5, 0.01, count),
        View("v", 0.0, (0.0, 0.0), False, True),
        k * 2 * pi / count + np.deg2rad(degrees) + noise,
        ids=np.where(has_id, k, 0),
        has_id=has_id,
        rules=rules,
        phi_rad=phi_rad,
    )


@pytest.mark.parametrize("degrees", [0.0, 0.3, 0.51, -0.7, 1.0, -1.4])
def test_fine_lines_alone_are_not_taken_for_the_nearest(degrees):
    _, found = lines(360, degrees)
    assert set(found.reasons) == {Reason.ROTATION}


@pytest.mark.parametrize("degrees", [0.3, 0.51, -0.7, 1.0, -1.4])
@pytest.mark.parametrize("named", [(0,), (17, 250), tuple(range(0, 360, 7))])
def test_few_named_lines_tell_the_rotation_to_all_others(degrees, named):
    k, found = lines(360, degrees, named=named)
    assert set(found.reasons) == {None}
    np.testing.assert_array_equal(found.index, k)
    np.testing.assert_allclose(found.deviation, np.deg2rad(degrees), atol=1e-14)


@pytest.mark.parametrize(
    ("stated", "degrees", "reason"),
    [
        (0.45, 0.44, None),
        (0.45, -0.44, None),
        (0.46, 0.0, Reason.ROTATION),
        (0.2, 0.24, None),
        (0.2, 0.3, Reason.ROTATION),
        (0.2, -0.3, Reason.ROTATION),
        (0.2, 0.7, Reason.ROTATION),
        (0.0, 0.1, None),
    ],
)
def test_a_stated_largest_rotation_below_half_a_line_makes_the_nearest_line_the_one(
    stated, degrees, reason
):
    k, found = lines(
        360, degrees, rules=replace(RULES, max_rotation_rad=np.deg2rad(stated))
    )
    assert set(found.reasons) == {reason}
    if reason is None:
        np.testing.assert_array_equal(found.index, k)


@pytest.mark.parametrize("count", [4, 24, 72])
@pytest.mark.parametrize("degrees", [0.0, 0.3, 1.0, -1.9])
def test_coarse_lines_are_found_as_before(count, degrees):
    k, found = lines(count, degrees, scatter=2e-4)
    assert set(found.reasons) == {None}
    np.testing.assert_array_equal(found.index, k)


def test_coarse_lines_are_found_beyond_the_rotation_to_reckon_with():
    k, found = lines(24, 3.5)
    assert set(found.reasons) == {None}
    np.testing.assert_array_equal(found.index, k)
    assert set(lines(24, 4.0)[1].reasons) == {Reason.ROTATION}


@pytest.mark.parametrize("scatter", [0.0, 1e-3, 4e-3])
def test_lines_close_to_half_a_step_off_do_not_tear_their_median(scatter):
    k, found = lines(72, 1.99, scatter=scatter)  # half a line is 2.5 deg
    good = found.reasons == None  # noqa: E711
    assert good.mean() > 0.99
    np.testing.assert_array_equal(found.index[good], k[good])


@pytest.mark.parametrize("degrees", [90.0, -15.0, 12.0])
def test_named_lines_of_a_plate_that_was_put_in_wrongly_are_too_far(degrees):
    _, found = lines(72, degrees, named=range(72))
    assert set(found.reasons) == {Reason.TOO_FAR}
    k, found = lines(72, np.rad2deg(0.99 * LARGEST_TURN_RAD), named=range(72))
    assert set(found.reasons) == {None}
    np.testing.assert_array_equal(found.index, k)


def session(phi_deg, *, with_ids=False, **parameters):
    """Return readings of '0, 90, tx' and a view of lines alone, turned by `phi_deg`, K=360."""
    plan = plan_of("0, 90, tx", 5, count=360, line=True)
    truth = random_truth(plan.artifact, 4, np.random.default_rng(1))
    phi = truth.phi_rad.copy()
    phi[-1] = np.deg2rad(phi_deg)
    truth = replace(truth, phi_rad=phi)
    cell = CellSettings(with_ids=with_ids, servo_sigma_theta_rad=0.0)
    events = plan_events(
        truth, plan, settings=cell, rng=np.random.default_rng(2), start_ns=START_NS
    )
    return truth, plan, collect(events, **parameters)[0]


@pytest.mark.parametrize("phi_deg", [0.1, 0.6, -0.8])
def test_a_view_of_fine_lines_alone_is_never_identified_silently(phi_deg):
    truth, plan, found = session(phi_deg)
    assert found.all_rejected() == {"rotation_not_known": 360}
    assert found.views[3].rejected == {"rotation_not_known": 360}
    for index in range(3):  # where grid marks tell the rotation, all lines are read
        expected = angular_deviation(truth, index, plan.views[index])
        np.testing.assert_allclose(found.views[index].dtheta, expected, atol=1e-12)


@pytest.mark.parametrize(
    ("phi_deg", "remedy"),
    [
        (0.6, {"with_ids": True}),
        (-0.8, {"with_ids": True}),
        (0.4, {"max_rotation": 0.0078}),
        (-0.4, {"max_rotation": 0.0078}),
    ],
)
def test_each_remedy_that_the_advice_names_works(phi_deg, remedy):
    truth, plan, found = session(phi_deg, **remedy)
    assert found.all_rejected() == {}
    np.testing.assert_allclose(
        found.views[3].dtheta, angular_deviation(truth, 3, plan.views[3]), atol=1e-12
    )


def test_the_advice_is_one_line_with_the_count():
    assert advice({"duplicate": 3}) == []
    (line,) = advice({"rotation_not_known": 360, "duplicate": 3})
    assert line.startswith("360 detections rejected as rotation_not_known: ")
    assert "\n" not in line
    for remedy in ("ids", "grid marks in the same view", "max_rotation"):
        assert remedy in line


def turned(
    degrees,
    *,
    named,
    size=101,
    pitch=0.001,
    kept=1.0,
    offset=(1e-4, -5e-5),
    seed=0,
    rules=RULES,
    where=lambda m, n: m == m,
    placed_deg=0.0,
):
    """Return marks of a turned plate of which few carry ids, and what they are taken for.

    The plan asks for a turn by `placed_deg`, over a map that reaches beyond the plate.
    """
    rng = np.random.default_rng(seed)
    artifact = Artifact(
        size, pitch, 24, map_grid=MapGrid(5, size * pitch) if placed_deg else None
    )
    view = View("v", np.deg2rad(placed_deg), angular=False)
    marks = np.stack([artifact.m.ravel(), artifact.n.ravel()])
    has_id = np.zeros(marks.shape[1], dtype=bool)
    if named == "corner":
        has_id[0] = True
    else:
        has_id[rng.choice(marks.shape[1], named, replace=False)] = True
    there = ((rng.random(marks.shape[1]) < kept) & where(*marks)) | has_id
    marks, has_id = marks[:, there], has_id[there]
    nominal = np.stack(view.on_stage(artifact).turned(*marks * pitch))
    read = nominal + Rigid(np.deg2rad(degrees), *offset).at(nominal)
    read += rng.normal(0, 5e-7, read.shape)
    return marks, identify_grid(
        artifact, view, read, ids=np.where(has_id, marks, 0), has_id=has_id, rules=rules
    )


@pytest.mark.parametrize("named", [1, 2, 3, "corner"])
@pytest.mark.parametrize(
    ("degrees", "offset"),
    [(0.7, (1e-4, -5e-5)), (-2.0, (1e-4, -5e-5)), (0.7, (2.3e-3, -1.4e-3))],
)
def test_few_named_marks_are_anchors_of_all_others(named, degrees, offset):
    for seed in range(3):
        marks, found = turned(degrees, named=named, offset=offset, seed=seed)
        assert set(found.reasons) == {None}
        np.testing.assert_array_equal(found.index, marks)


@pytest.mark.parametrize("named", [1, 2, 5])
def test_anchors_reach_over_lost_marks(named):
    marks, found = turned(0.7, named=named, kept=0.1)
    assert set(found.reasons) == {None}
    np.testing.assert_array_equal(found.index, marks)


@pytest.mark.parametrize("placed_deg", [0.0, 37.0, 90.0, 211.0])
def test_marks_without_ids_at_one_side_of_a_turned_plate_tell_its_rotation_themselves(
    placed_deg,
):
    """There they are by more than half a pitch beside their places."""
    marks, found = turned(
        0.9, named=0, where=lambda m, n: m < -40, placed_deg=placed_deg
    )
    assert set(found.reasons) == {None}
    np.testing.assert_array_equal(found.index, marks)


def test_marks_out_of_reach_of_what_is_known_are_not_guessed():
    _, alone = turned(0.7, named=0, where=lambda m, n: (m == -50) & (n > 47))
    assert set(alone.reasons) == {Reason.ROTATION}
    marks, found = turned(0.7, named="corner", where=lambda m, n: (m > 40) & (n == 50))
    assert set(found.reasons[1:]) == {Reason.ROTATION}
    assert found.reasons[0] is None
    assert found.index[:, 0].tolist() == marks[:, 0].tolist()


@pytest.mark.parametrize("seed", range(40))
def test_no_mark_is_ever_taken_for_another(seed):
    rng = np.random.default_rng(seed)
    largest = float(rng.choice([0.0, 0.002, 0.035, 0.19]))
    pitch = float(rng.choice([0.01, 0.0005]))
    named = int(rng.integers(0, 4))
    offset = rng.uniform(-1, 1, 2) * pitch * (2.5 if named else 0.25)
    side = rng.integers(-25, 10)
    marks, found = turned(
        np.rad2deg(rng.uniform(-1, 1) * largest),
        named=named,
        size=51,
        pitch=pitch,
        offset=offset,
        kept=float(rng.choice([1, 0.3, 0.05])),
        seed=seed,
        rules=IdentityRules(5e-4, 0.5, largest),
        where=lambda m, n: (m > side) | (n < -22),
    )
    good = found.reasons == None  # noqa: E711
    np.testing.assert_array_equal(found.index[:, good], marks[:, good])
    assert set(found.reasons) <= {None, Reason.ROTATION, Reason.AMBIGUOUS}


def test_two_named_marks_one_of_them_misread_tell_nothing():
    artifact, (m, n) = Artifact(21, 0.005, 24), np.mgrid[-10:11, -10:11].reshape(2, -1)
    marks = np.stack([m, n])
    has_id = ((m == -3) & (n == 0)) | ((m == 3) & (n == 0))
    ids = np.where(has_id, marks, 0)
    ids[1, (m == 3) & (n == 0)] = 1
    found = identify_grid(
        artifact, View("v"), marks * 0.005, ids=ids, has_id=has_id, rules=RULES
    )
    good = (found.reasons == None) & ~has_id  # noqa: E711
    np.testing.assert_array_equal(found.index[:, good], marks[:, good])


@pytest.mark.parametrize("sense", [1, -1])
def test_a_fit_never_turns_further_than_the_largest_turn(sense):
    p = np.array([[-0.02, 0.02, 0.0, 0.0], [0.0, 0.0, -0.02, 0.02]])
    found = fit_motion(p, Rigid(sense * 2 * LARGEST_TURN_RAD).at(p)).rigid
    assert found.phi_rad == pytest.approx(sense * LARGEST_TURN_RAD)


def test_a_plate_that_cannot_turn_is_not_turned():
    p = np.array([[-0.02, 0.02, 0.0, 0.0], [0.0, 0.0, -0.02, 0.02]])
    fit = fit_motion(p, Rigid(1e-3, 1e-6, 2e-6).at(p))
    assert fit.rigid.phi_rad == pytest.approx(1e-3, rel=1e-5)
    found = fit.known(0.01, 0.0)
    assert (found.rigid.phi_rad, found.phi_error_rad) == (0.0, 0.0)
    assert found.rigid.at(np.zeros(2)) == pytest.approx([1e-6, 2e-6], rel=1e-5)
    single = fit_motion(p[:, :1], np.array([[1e-6], [2e-6]])).known(0.01, 0.035)
    assert (single.rigid.phi_rad, single.phi_error_rad) == (0.0, 0.035)


def test_a_rotation_is_told_to_the_lines_only_where_enough_marks_agree_on_it():
    p = np.array([[-0.01, 0.0, 0.01], [0.0, 0.0, 0.0]])
    assert fit_motion(p[:, :2], 0 * p[:, :2]).phi_error_rad == np.inf
    assert fit_motion(p, 0 * p).phi_error_rad == 0.0
    off = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 2e-4]])
    fit = fit_motion(p, off)
    assert abs(fit.rigid.phi_rad) < fit.phi_error_rad
    repeated = fit_motion(np.repeat(p, 9, axis=1), np.repeat(off, 9, axis=1))
    assert repeated.marks == 3
    assert repeated.phi_error_rad == pytest.approx(fit.phi_error_rad)
    one, nine = fit.known(0.01, 0.035), repeated.known(0.01, 0.035)
    assert nine.phi_error_rad == pytest.approx(one.phi_error_rad)
    assert nine.offset_error_m == pytest.approx(one.offset_error_m)
    assert fit_motion(p, off + 1.0).known(0.01, 0.035).phi_error_rad == pytest.approx(
        one.phi_error_rad
    )


def test_named_marks_of_a_plate_that_was_put_in_a_quarter_turn_off_are_too_far():
    artifact = Artifact(5, 0.01, 0)
    marks = np.stack([artifact.m.ravel(), artifact.n.ravel()])
    found = identify_grid(
        artifact,
        View("v"),
        np.stack([-marks[1], marks[0]]) * 0.01,
        ids=marks,
        has_id=np.ones(25, bool),
        rules=RULES,
    )
    good = found.reasons == None  # noqa: E711
    assert good.sum() == 1 and (marks[:, good] == 0).all()
    assert set(found.reasons[~good]) == {Reason.TOO_FAR}


@pytest.mark.parametrize("centre", [0.0, 0.3, 0.5, -0.45, 1.2])
def test_the_median_on_a_circle_does_not_depend_on_where_it_is_cut(centre):
    off = np.array([-0.2, -0.15, 0.0, 0.05, 0.1])
    found = _middle((centre + off) * 2.0, 2.0) / 2.0
    assert abs(found) <= 0.5
    assert (found - centre + 0.5) % 1.0 == pytest.approx(0.5)
    assert _middle(np.zeros(0), 2.0) == 0.0


def test_grid_marks_that_disagree_leave_fine_lines_unread():
    plan = plan_of("0", 5, count=360)
    truth = random_truth(plan.artifact, 1, np.random.default_rng(1))
    events = list(
        plan_events(
            truth,
            plan,
            settings=CellSettings(with_ids=False),
            rng=np.random.default_rng(2),
            start_ns=START_NS,
        )
    )
    grid = [e for e in events if getattr(e, "kind", None) == Kind.GRID]
    few = [e for e in events if e not in grid[3:]]
    few[few.index(grid[2])] = replace(grid[2], offset_y=grid[2].offset_y + 4e-4)
    found, _ = collect(few)
    assert found.all_rejected()["rotation_not_known"] == 360
    few = [e for e in events if e not in grid[3:]]
    assert collect(few)[0].all_rejected() == {}


def test_a_prediction_is_the_less_sure_the_further_it_lies_from_where_the_offset_is_known():
    at = np.array([[0.3, 0.0], [0.4, 0.0]])
    assert MotionEstimate(phi_error_rad=0.01).error_at(at) == pytest.approx([5e-3, 0.0])
    known = MotionEstimate(Rigid(), (0.3, 0.0), 1e-6, 0.01)
    assert known.error_at(at) == pytest.approx([1e-6 + 4e-3, 1e-6 + 3e-3])
