# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.joint import solve
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.readings import Sense
from selfcal_ros.model.result import result_from_dict, result_to_dict
from selfcal_ros.reporting.words.findings import worded
from test.support.options import BARE, bare
from test.support.truth import hu_plan, random_truth, simulate_measurements


def measured(sense=Sense.MICROSCOPE_MOVES, *, visits=False, missing=0.0):
    """Return noisy readings in Hu's views, by the papers' linear model."""
    rng = np.random.default_rng(11)
    artifact = Artifact(7, 0.01, 8)
    plan = hu_plan(artifact, 2)
    truth = random_truth(artifact, len(plan.views), rng)
    return simulate_measurements(
        truth,
        plan,
        rng,
        sigma_m=2e-8,
        sigma_theta_rad=1e-5,
        sense=sense,
        missing=missing,
        visits=visits,
        linear=True,
    )


@pytest.mark.parametrize("sense", list(Sense))
def test_residuals_are_what_maps_and_misalignment_leave_of_the_readings(sense):
    """Written out mark by mark from the published model, in the stage frame."""
    measurements = measured(sense, missing=0.1)
    result = calibrate(measurements, bare(misalignment_model="linear"))
    emap, amap, artifact = result.error_map, result.artifact_map, result.artifact
    h, pitch, lines = artifact.half[0], artifact.grid_pitch_m, artifact.angular_count
    seen = 0
    for view, found, kept in zip(
        measurements.views,
        result.views,
        result.parts.residuals.views,
        strict=True,
    ):
        assert kept.view == view.view.name
        pose = view.view.lattice_pose(artifact)
        turns = pose.turn_lines
        for k, value in zip(view.k, view.dtheta, strict=True):
            at = (k + turns) % lines
            stage = (
                -emap.g_theta[-at] if sense is Sense.PLATE_MOVES else emap.g_theta[at]
            )
            expected = value - (stage + amap.a_theta[k] + found.phi)
            assert kept.dtheta[k] == pytest.approx(expected, abs=2e-12)
        if not len(view.m):
            assert kept.dx is None
            continue
        for m, n, dx, dy in zip(view.m, view.n, view.dx, view.dy, strict=True):
            turn = 1j**pose.quarter_turns
            arm = turn * complex(m, n) * pitch
            i, j = pose.site_of(m, n)
            sites = (-i + h, -j + h) if sense is Sense.PLATE_MOVES else (i + h, j + h)
            stage = complex(emap.gx[sites], emap.gy[sites])
            if sense is Sense.PLATE_MOVES:
                stage = -stage
            plate = turn * complex(amap.ax[m + h, n + h], amap.ay[m + h, n + h])
            expected = complex(dx, dy) - (
                stage + plate + 1j * found.phi * arm + complex(found.tx, found.ty)
            )
            assert kept.dx[m + h, n + h] == pytest.approx(expected.real, abs=2e-13)
            assert kept.dy[m + h, n + h] == pytest.approx(expected.imag, abs=2e-13)
            seen += 1
        assert np.isfinite(kept.dx).sum() == len(view.m)
    assert seen > 100


def test_a_course_follows_the_readings_of_each_visit():
    """A jump of the plate half-way through a view is in the course of that view."""
    measurements = measured(visits=True)
    views = list(measurements.views)
    visits = views[0].visits
    late = visits.stamp_ns > np.median(visits.stamp_ns)
    jumped = replace(visits, dx=visits.dx + np.where(late, 5e-7, 0))
    means = np.bincount(visits.mark, visits.count * jumped.dx) / np.bincount(
        visits.mark, visits.count
    )
    views[0] = replace(views[0], dx=means, visits=jumped)
    kept = calibrate(
        replace(measurements, views=tuple(views)), bare(causes=False)
    ).parts.residuals.views
    course = kept[0].course
    early = course.time_s < np.median(course.time_s)
    assert course.dx[~early].mean() - course.dx[early].mean() == pytest.approx(
        5e-7, rel=0.1
    )
    assert abs(course.dy[~early].mean() - course.dy[early].mean()) < 2e-8
    assert sum(course.count) == visits.count.sum()


def test_the_course_of_marks_visited_once_is_that_of_their_residuals():
    measurements = measured(visits=True)
    kept = calibrate(measurements, BARE).parts.residuals.views
    for view, entry in zip(measurements.views, kept, strict=True):
        if not len(view.m):
            assert entry.course is None
            continue
        course, count = entry.course, view.visits.count
        first = min(v.visits.stamp_ns.min() for v in measurements.views if len(v.m))
        assert np.average(course.dx, weights=course.count) == pytest.approx(
            np.average(entry.dx[np.isfinite(entry.dx)]), abs=1e-12
        )
        mean_s = np.average((view.visits.stamp_ns - first) / 1e9, weights=count)
        assert np.average(course.time_s, weights=course.count) == pytest.approx(
            mean_s, abs=1e-3
        )
        assert (np.diff(course.time_s) > 0).all()


@pytest.mark.parametrize("parts", [1, 8, 60, 200])
def test_each_part_of_a_course_is_a_mean_of_readings_in_the_order_of_time(
    monkeypatch, parts
):
    """Two visits a mark, in an order of their own, with unequal repeats: part by part."""
    monkeypatch.setattr(solve, "MAX_PARTS", parts)
    rng, measurements = np.random.default_rng(2), measured(visits=True)
    views, about = [], []
    for view in measurements.views[:2]:
        visits = replace(
            view.visits,
            count=rng.integers(1, 6, len(view.visits.mark)),
            stamp_ns=rng.permutation(view.visits.stamp_ns),
        )
        count = np.bincount(visits.mark, visits.count)
        dx, dy = (
            np.bincount(visits.mark, visits.count * values) / count
            for values in (visits.dx, visits.dy)
        )
        views.append(
            replace(view, count=count.astype(int), dx=dx, dy=dy, visits=visits)
        )
        about.append((visits.dx - dx[visits.mark], visits.dy - dy[visits.mark]))
    views += measurements.views[2:]
    kept = calibrate(
        replace(measurements, views=tuple(views)), bare(causes=False)
    ).parts.residuals.views
    first = min(view.visits.stamp_ns.min() for view in views if len(view.m))
    for view, (dx, dy), entry in zip(views[:2], about, kept[:2], strict=True):
        visits, course = view.visits, entry.course
        at = view.m[visits.mark] + 3, view.n[visits.mark] + 3
        found = {
            "time_s": (visits.stamp_ns - first) / 1e9,
            "dx": entry.dx[at] + dx,
            "dy": entry.dy[at] + dy,
        }
        chosen = [
            part
            for part in np.array_split(np.argsort(visits.stamp_ns), parts)
            if len(part)
        ]
        assert len(chosen) == len(course.count)
        for number, part in enumerate(chosen):
            assert course.count[number] == visits.count[part].sum()
            for name, values in found.items():
                mean = (values[part] * visits.count[part]).sum() / visits.count[
                    part
                ].sum()
                assert getattr(course, name)[number] == pytest.approx(
                    mean, abs=1e-3 if name == "time_s" else 2e-13
                )


def test_residuals_survive_the_json_form_and_are_left_out_of_large_results(monkeypatch):
    measurements = measured()
    result = calibrate(measurements, BARE)
    data = result_to_dict(worded(result))
    again = result_from_dict(data, "r.json").parts.residuals.views
    own = result.parts.residuals.views
    assert [e.view for e in again] == [e.view for e in own]
    np.testing.assert_array_equal(again[3].dx, own[3].dx)
    monkeypatch.setattr(solve, "MAX_READINGS", 49 + 49 + 42 - 1)
    assert calibrate(measurements, BARE).parts.residuals is None
    monkeypatch.setattr(solve, "MAX_READINGS", 49 + 49 + 42)
    assert calibrate(measurements, BARE).parts.residuals is not None
