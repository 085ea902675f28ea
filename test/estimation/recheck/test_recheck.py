# SPDX-License-Identifier: Apache-2.0
"""A recheck against one dense least squares of both sessions, and what it refuses."""

import json
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.linalg import null_space
from scipy.stats import chi2, f

from selfcal_ros.errors import InputError, NoDataError, NotIdentifiableError
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.comparison.covariance import covariance_of, first_order_u
from selfcal_ros.estimation.joint import solve
from selfcal_ros.estimation.joint.problem import noise_estimate
from selfcal_ros.estimation.normal.angular import AngularSystem
from selfcal_ros.estimation.recheck.plate import known_plate
from selfcal_ros.estimation.recheck.solve import (
    _misfit,
    predict_recheck,
    recheck,
    recheck_of,
)
from selfcal_ros.estimation.recheck.views import (
    Effects,
    dof_of_residuals,
    map_of_lines,
)
from selfcal_ros.estimation.terms.columns import LineColumns
from selfcal_ros.estimation.verdict.uncertainty import INTERPOLATION
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.error_map import datum_modes
from selfcal_ros.model.readings import Sense, subset
from selfcal_ros.model.reference import ReferenceLength
from selfcal_ros.model.result import result_from_dict, result_to_dict
from selfcal_ros.model.terms import parse_terms
from selfcal_ros.model.verdict import Grade, Verdict
from selfcal_ros.model.view import Plan, View
from selfcal_ros.reporting.words.findings import worded
from selfcal_ros.simulation.cell import CellSettings
from selfcal_ros.simulation.machine import Spread, random_truth
from test.support import placed
from test.support.lattice_plans import plan_of
from test.support.options import BARE, STILL, bare
from test.support.truth import simulate_measurements
from test.support.two_sessions import MICROSCOPE, TwoSessions

PITCH = 0.01
QUIET = {"servo_sigma_m": 0.0, "servo_sigma_theta_rad": 0.0, "stop_sigma_m": 20e-6}
MODELS = {"none": "", "microscope": "microscope:0.01:0.01:0.002"}


@pytest.mark.parametrize(
    ("dof_noise", "p"), [(1e9, chi2.sf(100, 1)), (9, f.sf(100, 1, 9))]
)
def test_one_degree_of_freedom_can_contradict_the_plate(dof_noise, p):
    (finding,) = _misfit(100.0, 1, dof_noise)
    assert (finding.name, finding.size, finding.p) == (
        "plate_misfit",
        10,
        pytest.approx(p),
    )
    assert _misfit(2.0, 1, dof_noise) == _misfit(100.0, 0, dof_noise) == ()


@pytest.fixture(autouse=True)
def _equal_white_noise(monkeypatch):
    """What else noise may be enlarges both maps alike (`Together`)."""
    monkeypatch.setattr(solve, "MAX_NODES", 0)


def linear(model="none"):
    return replace(
        bare(
            causes=False,
            at_places=False,
            terms=STILL,
            misalignment_model=("linear" if model == "none" else "rigid"),
        ),
        assumed=parse_terms([MODELS[model]], ""),
    )


def saved(result):
    return result_from_dict(json.loads(json.dumps(result_to_dict(worded(result)))), "r")


def one_view(artifact, q=0, a=0, b=0, degrees=0.0):
    turn = q * np.pi / 2 + np.radians(degrees)
    return Plan(
        "again",
        artifact,
        (
            View(
                "again",
                turn,
                (a * PITCH, b * PITCH),
                True,
                artifact.angular_count > 0 and not degrees,
            ),
        ),
    )


@cache
def sessions(sense=Sense.MICROSCOPE_MOVES, pose=(0, 0, 0), microscope=False):
    """Readings of a calibration on the lattice, and of a view of a stage that has changed."""
    plan, rng = (
        plan_of("0,90,tx", Artifact(5, PITCH, 8), lines=1),
        np.random.default_rng(5),
    )
    truth = random_truth(
        plan.artifact,
        len(plan.views),
        rng,
        Spread(
            phi_rad=1e-5,
            microscope_scale=4e-3 * microscope,
            microscope_shear=5e-4 * microscope,
        ),
    )
    changed = replace(truth, g=truth.g + rng.normal(0, 3e-8, truth.g.shape))
    settings = CellSettings(sense, 20e-9, 2e-6, **QUIET)
    return tuple(
        simulate_measurements(one, its, rng, visits=True, settings=settings)
        for one, its in ((truth, plan), (changed, one_view(plan.artifact, *pose)))
    )


def require_first_order(emap):
    """Require O and R of a map as a fit of its known nodes has them; return them as (2, 2 n)."""
    known = emap.valid
    x, y = (part[known] for part in (emap.artifact.x_m, emap.artifact.y_m))
    one, none = np.ones_like(x), np.zeros_like(x)
    along_x, along_y = (
        np.stack([one, none, -y, x, y, x]),
        np.stack([none, one, x, y, x, -y]),
    )
    values = np.concatenate([emap.gx[known], emap.gy[known]])
    fitted = np.linalg.lstsq(np.hstack([along_x, along_y]).T, values, rcond=None)[0]
    assert [emap.nonorthogonality, emap.scale_difference] == pytest.approx(
        fitted[4:], rel=1e-6
    )
    assert np.abs(fitted[4:]).min() > 1e-9
    return np.linalg.pinv(np.hstack([along_x, along_y]).T)[4:]


def require_same(result, wanted, *, rel=1e-5):
    """Require map, change and their covariances as one least squares has them."""
    emap, found = result.error_map, result.recheck
    for rows, values, u in (
        (wanted.after, (emap.gx, emap.gy), (emap.u_gx, emap.u_gy)),
        (wanted.change, (found.dx, found.dy), (found.u_dx, found.u_dy)),
    ):
        of, spread = wanted.of(rows)
        assert np.ravel(u)[wanted.known] == pytest.approx(spread, rel=rel)
        assert np.abs(np.ravel(values)[wanted.known] - of).max() < rel * spread.min()
        assert np.isnan(np.ravel(values)[~wanted.known]).all()
    chi2, dof = wanted.chi2
    test = found.significance_xy
    assert test.dof == dof
    assert test.chi2_ratio == pytest.approx(chi2 / dof, rel=100 * rel)
    if wanted.K:
        for rows, value, u in (
            (wanted.after_theta, emap.g_theta, emap.u_g_theta),
            (wanted.change_theta, found.d_theta, found.u_d_theta),
        ):
            of, spread = wanted.of(rows)
            assert u == pytest.approx(spread, rel=rel)
            assert np.abs(value - of).max() < rel * spread.min()
    shear = require_first_order(emap)
    assert first_order_u(result) == pytest.approx(
        wanted.of(shear @ wanted.after)[1], rel=rel
    )
    cover = covariance_of(result, "xy", emap.valid)
    assert cover == pytest.approx(wanted.after @ wanted.after.T, abs=rel * cover.max())
    if wanted.K:
        cover = covariance_of(result, "theta", np.isfinite(emap.g_theta))
        assert cover == pytest.approx(
            wanted.after_theta @ wanted.after_theta.T, abs=rel * cover.max()
        )
    u = np.linalg.norm(wanted.scale)
    assert found.scale.change == pytest.approx(wanted.scale @ wanted.y, abs=rel * u)
    assert found.scale.u == pytest.approx(u, rel=rel)


@pytest.mark.parametrize("sense", Sense)
@pytest.mark.parametrize("pose", [(0, 0, 0), (2, 0, 0), (3, 0, 0)])
@pytest.mark.parametrize("model", MODELS)
def test_a_view_on_the_lattice_as_one_least_squares_of_both_sessions(
    model, pose, sense
):
    before, after = sessions(sense, pose, model == "microscope")
    first = saved(calibrate(before, linear(model)))
    result = recheck(after, linear(model), known_plate(first, "r.json"))
    grid = placed.plate(5, 5, "bilinear", angular_count=8)
    require_same(
        result,
        TwoSessions(
            before,
            after,
            grid,
            first.noise.sigma_xy,
            MICROSCOPE if model == "microscope" else (),
            sigma_theta=first.noise.sigma_theta,
        ),
        rel=1e-5 if model == "none" else 1e-2,
    )


def general(pose, sigma=20e-9, seed=3, change=0.0, how="bicubic", nodes=5):
    """Readings of six general views, and of one more of a changed stage."""
    rng, artifact = np.random.default_rng(seed), placed.plate(7, nodes, how)
    before, truth = placed.readings(artifact, placed.SIX, rng, linear=True, sigma=sigma)
    field = truth.field + change * rng.normal(size=truth.field.shape)

    def stage(at):
        return placed.rows(artifact, np.ravel(at)) @ field.ravel()

    after, other = placed.readings(
        artifact,
        [pose],
        rng,
        linear=True,
        sigma=sigma,
        stage=lambda at: stage(at).reshape(np.shape(at)),
    )
    # of the same plate
    (view,) = after.views
    inside = view.view.pose.in_field(artifact)
    moved = np.exp(1j * view.view.rotation_rad) * (truth.plate - other.plate)[inside]
    return before, replace(
        after, views=(replace(view, dx=view.dx + moved.real, dy=view.dy + moved.imag),)
    )


@pytest.mark.parametrize(
    ("pose", "nodes"),
    [
        ((0, (0, 0)), 5),
        ((4, (0.1, -0.1)), 5),
        ((90, (0.5, 0.5)), 5),
        ((4, (0.1, -0.1)), 3),
    ],
)
def test_a_view_off_the_lattice_as_one_least_squares_of_both_sessions(pose, nodes):
    before, after = general(pose, change=3e-8, nodes=nodes)
    first = saved(calibrate(before, linear()))
    result = recheck(after, linear(), known_plate(first, "r.json"))
    assert result.error_map.valid.sum() > nodes**2 / 2
    assert {found.name for found in result.verdict.failed} <= {"changed_or_drifted"}
    require_same(
        result,
        TwoSessions(
            before,
            after,
            before.artifact,
            first.noise.sigma_xy,
            known=result.error_map.valid,
        ),
        rel=1e-4,
    )


@cache
def calibrated():
    return saved(calibrate(sessions()[0], linear()))


def two_views_again(seed, sigma):
    """Return a calibration on the lattice, and two views of the same stage and plate."""
    plan, again = (plan_of(views, Artifact(5, PITCH)) for views in ("0,90,tx", "0,90"))
    rng = np.random.default_rng(seed)
    truth = random_truth(plan.artifact, 3, rng, Spread(phi_rad=1e-5))
    of_views = {
        name: getattr(truth, name)[:2] for name in ("t_m", "phi_rad", "plate_shape_m")
    }
    settings = CellSettings(sigma_xy_m=sigma, **QUIET)
    return tuple(
        simulate_measurements(one, its, rng, visits=True, settings=settings)
        for one, its in ((truth, plan), (replace(truth, **of_views), again))
    )


@pytest.mark.parametrize(
    "sessions_of",
    [
        two_views_again,
        lambda seed, sigma: general((4, (0.1, -0.1)), sigma, seed, nodes=3),
    ],
    ids=["on the lattice", "a map of few nodes"],
)
def test_residuals_of_noise_have_the_square_of_their_degrees_of_freedom(sessions_of):
    """As many as there are readings less the nodes and misalignments that they determine."""
    ratios = []
    for seed in range(5):
        before, after = sessions_of(seed, 20e-9)
        plate = known_plate(calibrate(before, linear()), "r.json")
        found = recheck_of(after, linear(), plate)
        square = found.square * (found.xy.sigma / 20e-9) ** 2
        ratios.append(square / dof_of_residuals(found.problem))
    assert np.mean(ratios) == pytest.approx(1, abs=0.2)


def test_terms_with_sizes_are_part_of_the_noise():
    """Strain of the plate in this view is not to be told from the map's own first-order terms."""
    _, after = sessions()
    plate, size = known_plate(calibrated(), "r.json"), 2e-6
    plain = recheck(after, linear(), plate)
    strained = recheck(
        after, replace(linear(), terms=parse_terms([f"plate_strain:{size}"], "")), plate
    )
    x, y = plain.artifact.x_m, plain.artifact.y_m
    both = np.hypot(x, y) * size  # stretch and shear; a scale is not part of the map
    for name in ("u_gx", "u_gy"):
        u, more = (getattr(result.error_map, name) for result in (plain, strained))
        assert more == pytest.approx(np.hypot(u, both), rel=1e-6)
    more = strained.recheck.scale.u
    assert more == pytest.approx(np.hypot(plain.recheck.scale.u, size), rel=1e-6)
    np.testing.assert_allclose(strained.error_map.gx, plain.error_map.gx, atol=1e-15)
    sources = ["reading noise", "known plate", "terms"]
    assert [line.component for line in strained.budget if line.quantity == "xy"] == [
        *sources,
        "interpolation",
    ]


def test_what_has_changed_is_read_as_it_was_written():
    written = recheck(sessions()[1], linear(), known_plate(calibrated(), "r.json"))
    data = result_to_dict(worded(written))
    assert {"of", "changed", "p", "largest", "dx", "largest_theta"} < set(
        data["recheck"]
    )
    read = saved(written)
    assert read.recheck.to_dict() == data["recheck"]
    np.testing.assert_array_equal(read.recheck.u_dy, written.recheck.u_dy)
    assert type(read.recheck.largest) is type(written.recheck.largest)
    data["recheck"]["largest"] = 3
    with pytest.raises(InputError, match="r: damaged result"):
        result_from_dict(data, "r")


def test_the_noise_is_that_of_many_or_larger_repeats_or_of_the_calibration():
    _, after = sessions()
    plate = known_plate(calibrated(), "r.json")
    assert recheck(after, linear(), plate).noise.sigma_xy == plate.result.noise.sigma_xy
    view, before = after.views[0], plate.result.noise.sigma_xy
    for dof, shown, sigma in (
        (29, 2e-8, before),
        (29, 1.25 * before, before),  # as one of ten would be
        (29, 5e-8, 5e-8),
        (30, 2e-8, 2e-8),
    ):
        more = replace(
            after, views=(replace(view, sigma_xy=shown, dof_xy=dof, visits=None),)
        )
        assert recheck(more, linear(), plate).noise.sigma_xy == pytest.approx(sigma)


def test_repeats_that_are_identical_average_nothing():
    """Their mean has the noise of one reading: changes were found in five of six stages."""
    _, after = sessions()
    plate = known_plate(calibrated(), "r.json")
    once = recheck(after, linear(), plate)
    view = after.views[0]
    same = replace(view, count=4 * view.count, sigma_xy=0.0, dof_xy=150, visits=None)
    again = recheck(replace(after, views=(same,)), linear(), plate)
    assert again.noise.sigma_xy == pytest.approx(2 * once.noise.sigma_xy)
    assert again.error_map.u_gx == pytest.approx(once.error_map.u_gx)


def test_the_noise_is_what_detections_declare_if_that_is_larger():
    """With a declaration of 60 nm that of the calibration, 19 nm, was used, as with 96 repeats."""
    _, after = sessions()
    plate = known_plate(calibrated(), "r.json")
    before = plate.result.noise.sigma_xy
    view = replace(after.views[0], sigma_xy=5e-8, visits=None)
    for dof, declared, sigma in (
        (0, 1e-10, before),
        (0, 6e-8, 6e-8),
        (96, 1e-10, 5e-8),
        (96, 6e-8, 6e-8),
    ):
        declaring = replace(view, dof_xy=dof, u=declared / np.sqrt(view.count))
        found = recheck(replace(after, views=(declaring,)), linear(), plate)
        assert found.noise.sigma_xy == pytest.approx(sigma)
        assert found.noise.sigma_xy_declared == pytest.approx(declared)
        by_detections = sigma == declared
        line = found.budget[0]  # as that of a calibration
        assert (line.component, line.kind, line.source) == (
            "reading noise",
            "B" if by_detections else "A",
            "declared" if by_detections else "readings",
        )


def test_marks_and_lines_that_are_missing_are_unknown():
    _, after = sessions()
    view = after.views[0]
    kept, lines = view.m > -2, view.k > 1
    fewer = replace(after, views=(subset(view, kept, lines),))
    result = recheck(fewer, linear(), known_plate(calibrated(), "r.json"))
    np.testing.assert_array_equal(
        result.error_map.valid, np.tile(np.arange(-2, 3)[:, None] > -2, 5)
    )
    np.testing.assert_array_equal(
        np.isfinite(result.error_map.g_theta), np.arange(8) > 1
    )
    assert abs(np.nansum(result.error_map.gx)) < 1e-15
    assert np.nansum(result.error_map.g_theta) == pytest.approx(0, abs=1e-15)


@pytest.mark.filterwarnings("error")
def test_a_view_that_is_only_partly_read_is_said():
    plate, after = known_plate(calibrated(), "r.json"), sessions()[1]
    view = after.views[0]
    few = subset(view, np.arange(len(view.m)) < 12, np.ones(len(view.k), dtype=bool))
    for part, warned in ((view, False), (few, True)):
        found = worded(recheck(replace(after, views=(part,)), linear(), plate))
        said = (
            "is only partly in the map: 12 of 25 marks and 8 of 8 lines became readings"
        )
        assert any(said in text for text in result_to_dict(found)["warnings"]) is warned


def test_a_mark_that_is_not_known_but_visited_twice_is_left_out():
    """The calibration has not read it: map and u are those of a view without it."""
    before, again = (
        sessions()[0],
        replace(one_view(Artifact(5, PITCH, 8)).views[0], repeats=2),
    )
    kept = [
        replace(
            subset(view, (view.m != 1) | (view.n != -2), np.ones(len(view.k), bool)),
            visits=None,
        )
        for view in before.views
    ]
    plate = known_plate(
        saved(calibrate(replace(before, views=tuple(kept)), linear())), "r.json"
    )
    assert plate.together.marks.sum() == 24
    plan, rng = Plan("again", before.artifact, (again,)), np.random.default_rng(6)
    truth = random_truth(plan.artifact, 1, rng, Spread(phi_rad=1e-5))
    after = simulate_measurements(
        truth,
        plan,
        rng,
        visits=True,
        settings=CellSettings(Sense.MICROSCOPE_MOVES, 20e-9, 2e-6, **QUIET),
    )
    view = after.views[0]
    fewer = subset(view, (view.m != 1) | (view.n != -2), np.ones(len(view.k), bool))
    whole, part = (
        recheck(replace(after, views=(replace(one, visits=seen),)), linear(), plate)
        for one, seen in ((view, view.visits), (fewer, None))
    )
    assert whole.error_map.gx == pytest.approx(
        part.error_map.gx, abs=1e-15, nan_ok=True
    )
    assert whole.error_map.u_gx == pytest.approx(
        part.error_map.u_gx, rel=1e-9, nan_ok=True
    )


def test_a_plate_of_another_kind_is_not_the_one_that_is_known():
    _, after = general((0, (0, 0)))
    with pytest.raises(
        InputError,
        match="its plate has 5 x 5 marks 10 mm apart and 8 lines, not "
        "7 x 7 marks 10 mm apart and no lines",
    ):
        recheck(after, linear(), known_plate(calibrated(), "r.json"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"verdict": Verdict(Grade.NOT_QUALIFIED)},
            "is not qualified, so its plate is not known",
        ),
        ({"views": ()}, "does not contain the covariance of its plate"),
        (
            {"recheck": SimpleNamespace(of="first.json")},
            "which does not calibrate a plate; name the calibration that it used, first.json",
        ),
    ],
)
def test_results_without_a_known_plate(change, message):
    with pytest.raises(InputError, match=f"r.json: .*{message}"):
        known_plate(replace(calibrated(), **change), "r.json")


def test_what_one_view_cannot_tell_is_refused():
    plate, (_, after) = known_plate(calibrated(), "r.json"), sessions()
    with pytest.raises(InputError, match="term 'drift'; give it a size, drift:SIZE"):
        recheck(after, replace(linear(), terms=parse_terms(["drift"], "")), plate)
    with pytest.raises(
        InputError, match="a recheck always uses the reference length of"
    ):
        recheck(
            after,
            replace(linear(), reference=ReferenceLength("artifact", 0.0, 0.0)),
            plate,
        )
    nothing = replace(
        after,
        views=(
            replace(
                after.views[0],
                m=np.zeros(0, int),
                n=np.zeros(0, int),
                dx=np.zeros(0),
                dy=np.zeros(0),
                count=np.zeros(0, int),
                visits=None,
            ),
        ),
    )
    with pytest.raises(NoDataError, match="no known mark was read"):
        recheck(nothing, linear(), plate)
    before, few = general((0, (3.2, 3.1)))
    with pytest.raises(
        NotIdentifiableError, match=r"leaves .* of 25 nodes of the map unknown"
    ):
        recheck(
            few, linear(), known_plate(saved(calibrate(before, linear())), "r.json")
        )


@pytest.mark.parametrize(
    ("how", "gone", "free"),
    [
        ("bicubic", lambda m, n: m > 5, 0),
        ("bilinear", lambda m, n: np.maximum(abs(m), abs(n)) < 2, 1),
    ],
)
def test_nodes_that_the_readings_do_not_determine_are_unknown(how, gone, free):
    """By the null space of the view's dense matrix, over the nodes without motion."""
    before, after = general((4, (0.1, -0.1)), how=how)
    view, artifact = after.views[0], after.artifact
    kept = ~gone(view.m, view.n)
    after = replace(after, views=(subset(view, kept, np.zeros(0, bool)),))
    result = recheck(
        after, linear(), known_plate(saved(calibrate(before, linear())), "r.json")
    )
    m, n, valid = view.m[kept], view.n[kept], result.error_map.valid.ravel()
    w = placed.rows(artifact, view.view.pose.places(artifact, m, n)) + 0j
    turn = np.exp(1j * view.view.rotation_rad)
    design = np.hstack(
        [w, 1j * w, np.column_stack([turn * 1j * (m + 1j * n), 0 * m + 1, 0 * m + 1j])]
    )
    null = null_space(np.vstack([design.real, design.imag]), rcond=1e-9)[:50]
    modes = datum_modes(artifact.field, scale=False).reshape(3, -1).T
    here = np.tile(valid, 2)
    left = null - modes @ np.linalg.lstsq(modes[here], null[here], rcond=None)[0]
    size = np.linalg.norm(left, axis=1).reshape(2, -1).max(axis=0)
    assert size[valid].max() < 1e-7
    assert (size > 1e-3).sum() >= free and 12 <= valid.sum() <= 24 - free


def test_the_budget_of_lines_adds_up_to_their_u():
    before = calibrated()
    found = recheck(sessions()[1], linear(), known_plate(before, "r.json"))
    lines = {line.component: line for line in found.budget if line.quantity == "theta"}
    noise, plate = lines["reading noise"], lines["known plate"]
    assert (noise.unit, noise.u) == ("rad", found.noise.sigma_theta)
    assert (noise.kind, plate.kind) == ("A", "B")
    assert plate.dof == before.noise.dof_of("theta")
    assert 0 < plate.effect_rms < noise.effect_rms
    total = sum(
        line.effect_rms**2
        for component, line in lines.items()
        if component != INTERPOLATION
    )
    assert total == pytest.approx(np.mean(found.error_map.u_g_theta**2))


def test_the_budget_is_of_the_known_nodes_alone():
    """Nodes that the readings do not determine have variances, without a meaning."""
    before, after = general((4, (0.1, -0.1)), how="bicubic")
    after = replace(
        after, views=(subset(after.views[0], after.views[0].m <= 5, np.zeros(0, bool)),)
    )
    found = recheck(
        after, linear(), known_plate(saved(calibrate(before, linear())), "r.json")
    )
    emap = found.error_map
    lines = [
        line
        for line in found.budget
        if line.effect_max and line.component != INTERPOLATION
    ]
    u = np.concatenate([emap.u_gx[emap.valid], emap.u_gy[emap.valid]])
    assert np.count_nonzero(~emap.valid) > 0 and len(lines) >= 2
    assert np.sqrt(sum(line.effect_rms**2 for line in lines)) == pytest.approx(
        np.sqrt(np.mean(u**2))
    )
    assert all(line.effect_rms <= line.effect_max <= u.max() for line in lines)


def test_a_map_with_as_many_nodes_as_marks_needs_more_than_one_view():
    """72 marks do not tell 81 nodes, none of them: the last column had the smallest u of all."""
    rng, artifact = np.random.default_rng(4), placed.plate(9, 9)
    before, _ = placed.readings(artifact, placed.SIX, rng, linear=True)
    plate = known_plate(saved(calibrate(before, linear())), "r.json")
    after, _ = placed.readings(artifact, [(0, (0.3, 0))], rng, linear=True)
    planned = Plan("again", artifact, (after.views[0].view,))
    for what in (
        lambda: recheck(after, linear(), plate),
        lambda: predict_recheck(planned, plate),
    ):
        with pytest.raises(
            NotIdentifiableError,
            match=r"leaves 81 of 81 nodes of the map unknown: "
            "measure more .*, or give the map fewer",
        ):
            what()


def test_another_plate_beneath_a_map_with_fewer_nodes_than_marks_is_named():
    before, after = general((0, (0, 0)))
    plate = known_plate(saved(calibrate(before, linear())), "r.json")
    assert recheck(after, linear(), plate).verdict.grade is Grade.GOOD
    rng, view = np.random.default_rng(1), after.views[0]
    other = replace(
        after, views=(replace(view, dx=view.dx + rng.normal(0, 3e-7, len(view.m))),)
    )
    result = recheck(other, linear(), plate)
    assert [found.name for found in result.verdict.failed] == ["other_plate"]


def test_a_stage_read_beside_its_sites_where_the_calibration_was_as_well():
    """With visits and a smooth stage; the plate lies 0.5 mm beside, the stage follows the marks."""
    artifact = Artifact(7, PITCH)
    plan, rng = plan_of("0,90,tx", artifact), np.random.default_rng(2)
    truth = random_truth(
        artifact, 3, rng, Spread(correlation_pitches=5.0, t_m=0, phi_rad=1e-3, g_m=2e-6)
    )
    settings = CellSettings(
        sigma_xy_m=5e-9, follow_mark=True, **(QUIET | {"stop_sigma_m": 0})
    )
    first = saved(
        calibrate(
            simulate_measurements(truth, plan, rng, visits=True, settings=settings),
            BARE,
        )
    )
    beside = replace(truth, t_m=np.array([[5e-4, -4e-4]]), phi_rad=truth.phi_rad[:1])
    after = simulate_measurements(
        beside, one_view(artifact), rng, visits=True, settings=settings
    )
    plate = known_plate(first, "r.json")
    found = recheck(after, BARE, plate).recheck
    assert not found.changed
    at_sites = recheck(after, replace(BARE, at_places=False), plate).recheck
    assert at_sites.changed and at_sites.rms > 1.5 * found.rms


@pytest.mark.parametrize("sense", Sense)
def test_lines_of_two_views_as_one_generalised_least_squares(sense):
    """Some are not read; the plate is known with a dense covariance, and a term has a size."""
    rng, count, sigma, turns = np.random.default_rng(8), 7, 2e-6, (0, 3)
    weight = rng.integers(1, 4, (2, count)).astype(float) * (
        rng.random((2, count)) < 0.8
    )
    root, y = (
        3e-6 * rng.normal(size=(2 * count, count)),
        1e-5 * rng.normal(size=(2, count)),
    )
    before, of_term, plate = (
        root @ root.T,
        rng.normal(size=(2, count)),
        1e-5 * rng.normal(size=count),
    )
    columns = np.concatenate(
        [np.tile(np.eye(count)[:, None], (1, 2, 1)), of_term[None]]
    )
    effects = Effects.of(
        np.append(np.ones(count), 4e-6),
        np.append(np.arange(count), -1),
        plate=plate,
        before=before,
        length=np.zeros(count),
    )
    noise = noise_estimate((sigma, 99), (np.nan, 0), np.nan)
    found = map_of_lines(
        AngularSystem(turns, weight, known_plate=True),
        y,
        LineColumns(np.arange(count + 1), columns),
        effects,
        sense=sense,
        noise=noise,
    )

    view, line = np.nonzero(weight)
    at = (line + np.array(turns)[view]) % count
    if sense is Sense.PLATE_MOVES:  # H(k) = -G(-k)
        design, at = -np.eye(count)[-at % count], -at % count
    else:
        design = np.eye(count)[at]
    known, of_plate = np.isin(np.arange(count), at), np.eye(count)[line]
    cover = (
        np.diag(sigma**2 / weight[view, line])
        + of_plate @ before[count:, count:] @ of_plate.T
    )
    cover += 4e-6**2 * np.outer(of_term[view, line], of_term[view, line])
    white = np.linalg.inv(np.linalg.cholesky(cover))
    gain = (
        np.linalg.pinv(white @ np.hstack([design, np.eye(2)[view]]), rcond=1e-9) @ white
    )
    rows = gain[:count][known]
    rows = rows - rows.mean(axis=0)
    np.testing.assert_array_equal(found.known, known)
    np.testing.assert_allclose(
        found.values, rows @ (y[view, line] - plate[line]), atol=1e-15
    )
    whole = sum(found.covariances(0.0).values())
    np.testing.assert_allclose(whole, rows @ cover @ rows.T, atol=1e-20)
    np.testing.assert_allclose(found.from_plate, rows @ of_plate, atol=1e-9)


def test_lines_without_noise_are_refused():
    """There is nothing to judge their change by, however noisy the marks are."""
    _, after = sessions()
    plate = known_plate(
        replace(calibrated(), noise=replace(calibrated().noise, sigma_theta=1e-14)),
        "r.json",
    )
    with pytest.raises(InputError, match="no noise against which to judge a change"):
        recheck(after, linear(), plate)
