# SPDX-License-Identifier: Apache-2.0
"""Marks without ids: found again under misalignments, turns and shifts; never a wrong one."""

from dataclasses import replace
from math import pi

import numpy as np
import pytest

from selfcal_ros.collection.inputs import Reason
from selfcal_ros.collection.marks import identify
from selfcal_ros.collection.marks.identify import (
    IdentityRules,
    identify_angular,
    identify_grid,
    wrap,
)
from selfcal_ros.collection.marks.rigid import (
    MotionEstimate,
    Rigid,
    RigidFit,
    fit_motion,
)
from selfcal_ros.model.artifact import Artifact, default_map_grid
from selfcal_ros.model.readings import Sense
from selfcal_ros.model.view import View
from test.support.collecting import collect, scene

RULES = IdentityRules(5e-4, 0.5, 0.035)
OFFSET_M = np.array([80e-6, -60e-6])  # 100 um
POSES = [
    (0, 0, 0),
    (1, 0, 0),
    (2, 0, 0),
    (3, 0, 0),
    (0, 1, 0),
    (1, 0, -1),
    (3, -2, 1),
    (37 / 90, 1.3, -0.7),
    (0.5, 0, 0),
    (211 / 90, -1.2, 0.6),
    (0, 0.5, 0),
]


def seen(artifact, view, phi, rng):
    """Return true marks (2, n) in the field and where they are read under a rigid misalignment."""
    pose = view.on_stage(artifact)
    marks, site = pose.marks_in_field(artifact)
    order = rng.permutation(marks.shape[1])
    marks, site = marks[:, order], site[:, order]
    nominal = site * artifact.grid_pitch_m
    about = (site - np.array(pose.shift)[:, None]) * artifact.grid_pitch_m
    moved = Rigid(phi, *OFFSET_M).at(about) + rng.normal(0, 5e-7, about.shape)
    return marks, nominal + moved, moved


@pytest.mark.parametrize("degrees", [0.3, -0.3, 1.0, -1.0])
@pytest.mark.parametrize(("size", "pitch"), [(11, 0.01), (21, 0.005), (101, 0.001)])
@pytest.mark.parametrize("pose", POSES, ids=str)
def test_grid_marks_without_ids_are_found(size, pitch, pose, degrees):
    artifact = Artifact(size, pitch, 24)
    q, a, b = pose
    view = View("v", q * pi / 2, (a * pitch, b * pitch), angular=False)
    if not view.is_on_lattice(artifact):
        artifact = replace(artifact, map_grid=default_map_grid(artifact))
    marks, read, moved = seen(
        artifact, view, np.deg2rad(degrees), np.random.default_rng(1)
    )
    no = np.zeros(marks.shape[1], dtype=bool)
    found = identify_grid(
        artifact, view, read, ids=np.zeros_like(marks), has_id=no, rules=RULES
    )
    assert (found.reasons == None).all()  # noqa: E711
    np.testing.assert_array_equal(found.index, marks)
    np.testing.assert_allclose(found.deviation, moved, rtol=0, atol=1e-15)
    assert found.rigid.phi_rad == pytest.approx(np.deg2rad(degrees), abs=2e-5)


@pytest.mark.parametrize("kept", [0.97, 0.5, 0.1])
def test_lost_marks_and_outliers_do_not_mislead_the_rest(kept):
    rng = np.random.default_rng(3)
    artifact, view = Artifact(21, 0.005, 72), View("v", pi / 2)
    marks, read, _ = seen(artifact, view, np.deg2rad(-0.3), rng)
    there = rng.random(marks.shape[1]) < kept
    marks, read = marks[:, there], read[:, there]
    stray = rng.random(marks.shape[1]) < 0.05
    read[:, stray] += rng.uniform(-1, 1, (2, stray.sum())) * 2.5e-3
    no = np.zeros(marks.shape[1], dtype=bool)
    found = identify_grid(
        artifact, view, read, ids=np.zeros_like(marks), has_id=no, rules=RULES
    )
    good = found.reasons == None  # noqa: E711
    assert good[~stray].all()
    np.testing.assert_array_equal(
        found.index[:, good & ~stray], marks[:, good & ~stray]
    )


def test_what_lies_nearly_between_marks_tells_nothing_of_the_view():
    """29 of 49 detections lie 0.4 pitches beside a mark, to three sides: the turn is that of 20."""
    artifact, view, p = Artifact(7, 0.01, 8), View("v"), 0.01
    marks = np.stack([artifact.m.ravel(), artifact.n.ravel()])
    read = Rigid(2e-3, *OFFSET_M).at(marks * p) + marks * p
    stray = np.arange(49) % 9 < 5
    read[:, stray] += 0.4 * p * np.array([[1, -1, 0], [0, 0, 1]])[:, np.arange(29) % 3]
    found = identify_grid(
        artifact, view, read, ids=0 * marks, has_id=np.zeros(49, bool), rules=RULES
    )
    assert set(found.reasons[stray]) == {Reason.AMBIGUOUS}
    assert set(found.reasons[~stray]) == {None}
    assert (found.rigid.phi_rad, found.rigid.tx_m, found.rigid.ty_m) == pytest.approx(
        (2e-3, *OFFSET_M), abs=1e-12
    )


def test_named_and_unnamed_marks_go_together():
    artifact, view = Artifact(21, 0.005, 72), View("v", -pi / 2, (0.005, 0.0))
    rng = np.random.default_rng(3)
    marks, read, _ = seen(artifact, view, np.deg2rad(0.3), rng)
    has_id = rng.random(marks.shape[1]) < 0.5
    found = identify_grid(
        artifact,
        view,
        read,
        ids=np.where(has_id, marks, 77),
        has_id=has_id,
        rules=RULES,
    )
    np.testing.assert_array_equal(found.index, marks)
    assert (found.reasons == None).all()  # noqa: E711


@pytest.mark.parametrize(
    ("beyond", "reason"),
    [
        (0.20, None),
        (0.30, Reason.TOO_FAR),
        (0.40, Reason.AMBIGUOUS),
        (0.74, Reason.AMBIGUOUS),
        (0.76, Reason.TOO_FAR),
        (1.40, Reason.TOO_FAR),
        (3.00, Reason.TOO_FAR),
    ],
)
@pytest.mark.parametrize("axis", [0, 1])
def test_what_stands_beside_the_plate_is_of_no_mark_from_three_quarters_of_a_pitch(
    axis, beyond, reason
):
    """All other marks are named: the view's own motion is known. 0.3 is beyond a quarter pitch."""
    artifact, pitch = Artifact(7, 0.01, 8, 5), 0.01
    read = np.stack([artifact.m.ravel(), artifact.n.ravel()]) * pitch
    marks = np.rint(read / pitch).astype(int)
    edge = int(
        np.flatnonzero((marks[axis] == artifact.half[axis]) & (marks[1 - axis] == -1))[
            0
        ]
    )
    has_id = np.arange(marks.shape[1]) != edge
    read[axis, edge] += beyond * pitch
    found = identify_grid(
        artifact,
        View("v"),
        read,
        ids=marks,
        has_id=has_id,
        rules=IdentityRules(5e-3, 0.5, 0.035),
    )
    assert found.reasons[edge] == reason
    assert (found.reasons[has_id] == None).all()  # noqa: E711


def test_an_empty_view_and_a_single_mark():
    artifact, view = Artifact(5, 0.01, 8), View("v")
    none = identify_grid(
        artifact,
        view,
        np.zeros((2, 0)),
        ids=np.zeros((2, 0), int),
        has_id=np.zeros(0, bool),
        rules=RULES,
    )
    assert none.index.shape == (2, 0)
    one = identify_grid(
        artifact,
        view,
        np.array([[0.0101], [-0.0199]]),
        ids=np.zeros((2, 1), int),
        has_id=np.zeros(1, bool),
        rules=RULES,
    )
    assert one.index.tolist() == [[1], [-2]]
    assert one.reasons.tolist() == [None]


@pytest.mark.parametrize("count", [24, 72, 360])
@pytest.mark.parametrize("degrees", [0.3, -0.3])
@pytest.mark.parametrize("turn", [0, 1, 5])
@pytest.mark.parametrize("told", [True, False])
def test_lines_without_ids_are_found(count, degrees, turn, told):
    rules = RULES if count < 360 else IdentityRules(5e-4, 0.5, 0.0078)
    artifact, rng = Artifact(11, 0.01, count), np.random.default_rng(2)
    step, phi = 2 * pi / count, np.deg2rad(degrees)
    view = View("v", turn * step, (0.0, 0.0), False, True)
    k = rng.permutation(count)
    v = phi + rng.normal(0, np.deg2rad(0.01), count)
    read = (k + turn) * step + v + 2 * pi * rng.integers(-2, 3, count)
    found = identify_angular(
        artifact,
        view,
        read,
        ids=np.zeros(count, int),
        has_id=np.zeros(count, bool),
        rules=rules,
        phi_rad=phi if told else None,
    )
    assert (found.reasons == None).all()  # noqa: E711
    np.testing.assert_array_equal(found.index, k)
    np.testing.assert_allclose(found.deviation, v, rtol=0, atol=1e-14)


def test_a_turn_of_more_than_half_a_line_needs_the_grid_to_tell_it():
    artifact, view = Artifact(11, 0.01, 360), View("v")
    phi, k = np.deg2rad(0.8), np.arange(360)
    read = k * 2 * pi / 360 + phi
    found = identify_angular(
        artifact,
        view,
        read,
        ids=0 * k,
        has_id=np.zeros(360, bool),
        rules=RULES,
        phi_rad=phi,
    )
    np.testing.assert_array_equal(found.index, k)
    np.testing.assert_allclose(found.deviation, phi, atol=1e-14)


@pytest.mark.parametrize("sense", list(Sense))
def test_a_session_without_ids_reads_what_one_with_ids_reads(sense):
    plan = {"size": 11, "count": 24, "line": True, "sense": sense, "seed": 6}
    named, _ = collect(
        scene("0, 90, 270, tx", **plan).events, measurement_sense=str(sense)
    )
    bare, _ = collect(
        scene("0, 90, 270, tx", **plan, with_ids=False).events,
        measurement_sense=str(sense),
    )
    assert bare.all_rejected() == named.all_rejected() == {}
    for a, b in zip(named.views, bare.views, strict=True):
        for name in ("m", "n", "dx", "dy", "k", "dtheta"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


@pytest.mark.parametrize("phi", [0.0, 5e-3, -0.02])
def test_a_rigid_motion_is_fitted_through_outliers(phi):
    rng = np.random.default_rng(5)
    p = rng.uniform(-0.05, 0.05, (2, 200))
    deviation = Rigid(phi, *OFFSET_M).at(p)
    deviation[:, :20] += rng.uniform(-1e-3, 1e-3, (2, 20))
    fit = fit_motion(p, deviation).rigid
    assert fit.phi_rad == pytest.approx(phi, abs=1e-9)
    assert (fit.tx_m, fit.ty_m) == pytest.approx(tuple(OFFSET_M), abs=1e-10)
    np.testing.assert_allclose(
        Rigid(pi / 2).at(np.array([[1.0], [0.0]])), [[-1.0], [1.0]]
    )
    np.testing.assert_allclose(
        Rigid(phi, 1.0, 2.0).undo(p + Rigid(phi, 1.0, 2.0).at(p)), p, atol=1e-15
    )


def test_wrapped_angles_lie_within_half_a_turn_and_inner_ones_keep_their_bits():
    inner = np.linspace(-3.14, 3.14, 1001)
    np.testing.assert_array_equal(wrap(inner), inner)
    np.testing.assert_allclose(wrap(inner + 6 * pi), inner, atol=1e-14)
    assert wrap(np.array([pi]))[0] == pi


def test_estimate_and_fit_are_folded_by_the_same_whole_pitches():
    known = MotionEstimate(Rigid(1e-3, 0.0123, -0.0288), (0.0, 0.0), 1e-4, 1e-4)
    fit = RigidFit(Rigid(1.2e-3, 0.0124, -0.0287), (0.0, 0.0), 9, 1e-3, 1e-12)
    straight = View("v").on_stage(Artifact(5, 0.01))
    folded, moved = identify._folded(straight, known, fit, 0.01)
    for found, wanted in (
        (folded.rigid, (1e-3, 0.0023, 0.0012)),
        (moved.rigid, (1.2e-3, 0.0024, 0.0013)),
    ):
        assert (found.phi_rad, found.tx_m, found.ty_m) == pytest.approx(
            wanted, abs=1e-12
        )
    assert (folded.offset_error_m, moved.marks) == (1e-4, 9)


@pytest.mark.parametrize("told", [True, False])
@pytest.mark.parametrize("count", [7, 24])
def test_lines_are_found_at_any_turn_of_a_fourier_map(count, told):
    rng, phi = np.random.default_rng(4), np.deg2rad(0.3)
    artifact, step = Artifact(11, 0.01, count, harmonics=3), 2 * pi / count
    view = View("v", np.deg2rad(101.3), grid=False)
    k = rng.permutation(count)
    v = phi + rng.normal(0, np.deg2rad(0.01), count)
    read = k * step + view.rotation_rad + v + 2 * pi * rng.integers(-2, 3, count)
    for has_id in (np.zeros(count, bool), np.arange(count) % 2 > 0):
        found = identify_angular(
            artifact,
            view,
            read,
            ids=k,
            has_id=has_id,
            rules=RULES,
            phi_rad=phi if told else None,
        )
        assert (found.reasons == None).all()  # noqa: E711
        np.testing.assert_array_equal(found.index, k)
        np.testing.assert_allclose(found.deviation, v, rtol=0, atol=1e-13)
