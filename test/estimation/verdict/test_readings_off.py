# SPDX-License-Identifier: Apache-2.0
"""A single reading that is off, in all its repeats, is named with its mark, its view, its size."""

from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.estimation.api import calibrate, robust_calibrate
from selfcal_ros.estimation.joint.solve import prepare
from selfcal_ros.estimation.options import Options
from selfcal_ros.estimation.terms.columns import ColumnBuilder
from selfcal_ros.estimation.verdict.causes import MOST, reading_columns
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.verdict import Grade
from selfcal_ros.reporting.words.findings import worded
from selfcal_ros.simulation.cell import CellSettings
from test.support.options import BARE
from test.support.results import covered
from test.support.truth import hu_plan, random_truth, simulate_measurements

ARTIFACT = Artifact(7, 0.01, 24)
SIGMA_M, SIGMA_RAD = 2e-8, 2e-5


def truth_and_readings(seed, *, repeats=1, visits=True):
    plan, rng = hu_plan(ARTIFACT, repeats), np.random.default_rng(seed)
    truth = random_truth(ARTIFACT, len(plan.views), rng)
    stands = CellSettings(
        sigma_xy_m=SIGMA_M,
        sigma_theta_rad=SIGMA_RAD,
        servo_sigma_m=1e-7,
        servo_sigma_theta_rad=0.0,
    )
    return truth, simulate_measurements(
        truth,
        plan,
        rng,
        sigma_m=SIGMA_M,
        sigma_theta_rad=SIGMA_RAD,
        settings=stands if visits else None,
    )


def measured(seed, **how):
    return truth_and_readings(seed, **how)[1]


def misread(readings, index, *, mark=None, by_m=(0.0, 0.0), line=None, by_rad=0.0):
    """Move a mark, or a line, in all repeats of one view."""
    view = readings.views[index]
    at = (
        (view.m == mark[0]) & (view.n == mark[1])
        if mark
        else np.zeros(len(view.m), dtype=bool)
    )
    turned = view.dtheta + by_rad * (view.k == line)
    views = list(readings.views)
    views[index] = replace(
        view, dx=view.dx + at * by_m[0], dy=view.dy + at * by_m[1], dtheta=turned
    )
    return replace(readings, views=tuple(views))


@pytest.mark.parametrize(
    ("index", "mark", "repeats", "visits"),
    [
        (1, (2, -1), 1, True),
        (1, (2, -1), 4, True),
        (0, (0, 3), 1, False),
        (3, (-3, 1), 4, False),
    ],
)
def test_a_mark_that_is_off_in_one_view_is_named(index, mark, repeats, visits):
    truth, readings = truth_and_readings(3, repeats=repeats, visits=visits)
    size, noise = 1e-6, SIGMA_M / np.sqrt(repeats)
    bad = misread(readings, index, mark=mark, by_m=(0.6 * size, -0.8 * size))
    clean, result = worded(calibrate(readings)), worded(calibrate(bad))
    name = readings.views[index].view.name
    cause = result.verdict.causes[0]
    # repeats show the noise, and by how much more than it the mark is off
    grade = Grade.ENLARGED if repeats == 1 else Grade.NOT_QUALIFIED
    assert clean.verdict.grade is Grade.GOOD and result.verdict.grade is grade
    assert covered(result, truth.g) >= 0.85
    assert cause.name == "reading" and cause.unit == "m" and cause.p < 5e-4
    assert cause.text.startswith(
        f"a reading of mark {mark} in view '{name}' that is off by "
    )
    # other views check it but in part: it is known to a few noises of a mean
    assert (
        cause.size == pytest.approx(size, abs=4.5 * cause.u)
        and noise < cause.u < 20 * noise
    )
    begins = (
        "Good within an enlarged U: " if repeats == 1 else "Not qualified: most likely "
    )
    assert result.verdict.sentence == begins + cause.text


def test_a_line_that_is_off_in_one_view_is_named():
    truth, readings = truth_and_readings(4)
    bad = worded(calibrate(misread(readings, 1, line=5, by_rad=-1e-3), BARE))
    assert calibrate(readings, BARE).verdict.grade is Grade.GOOD
    assert bad.verdict.grade is Grade.ENLARGED
    (item,) = bad.verdict.enlarged_by
    assert (item.name, item.unit) == ("reading", "rad")
    # one of 24 lines is off by so much, and nobody knows which
    assert item.u_rms == pytest.approx(1e-3 / np.sqrt(24), rel=0.2)
    off = bad.error_map.g_theta - truth.g_theta
    assert (
        np.mean(abs(off - off.mean()) <= bad.noise.k_theta * bad.error_map.u_g_theta)
        >= 0.85
    )
    (cause,) = bad.verdict.causes
    assert (cause.name, cause.unit) == ("reading", "rad")
    assert cause.size == pytest.approx(-1e-3, abs=4.5 * cause.u)
    assert SIGMA_RAD < cause.u < 4 * SIGMA_RAD
    assert cause.text.startswith(
        f"a reading of line 5 in view 'rot90' that is off by "
        f"{-cause.size * 180 * 3600 / np.pi:.1f} ± "
    )
    assert (cause.view, cause.mark) == ("rot90", (5,))
    lines = {line.component: line for line in bad.budget if line.quantity == "theta"}
    assert (lines["effect reading"].value, lines["effect reading"].u) == (
        cause.size,
        cause.u,
    )
    assert lines["effect reading"].effect_rms == pytest.approx(item.u_rms)
    nodes = [
        line.effect_rms**2 for name, line in lines.items() if name != "interpolation"
    ]
    assert sum(nodes) == pytest.approx(np.mean(bad.error_map.u_g_theta**2))


def test_the_remedy_that_is_named_mends_it():
    readings = measured(3)
    bad = misread(readings, 1, mark=(2, -1), by_m=(1e-6, 0.0), line=5, by_rad=1e-3)
    assert {cause.unit for cause in calibrate(bad).verdict.causes} == {"m", "rad"}
    assert robust_calibrate(bad).verdict.grade is Grade.GOOD


def test_nothing_is_said_of_exact_readings():
    plan, rng = hu_plan(ARTIFACT), np.random.default_rng(1)
    exact = simulate_measurements(
        random_truth(ARTIFACT, 4, rng), plan, rng, sigma_m=0.0, sigma_theta_rad=0.0
    )
    assert calibrate(exact).verdict.grade is Grade.GOOD


def test_those_with_the_largest_residuals_are_tried():
    """By hand: a plate of 3 x 3 marks, two readings that stand out, one in a turned view."""
    plan = hu_plan(Artifact(3, 0.01, 4))
    rng = np.random.default_rng(0)
    readings = simulate_measurements(
        random_truth(plan.artifact, 4, rng), plan, rng, sigma_m=1e-8
    )
    inputs = prepare(readings, Options())[0].inputs
    residuals = np.zeros(inputs.weight.shape, dtype=complex)
    residuals[1, 0, 2], residuals[0, 1, 1] = 3e-8j, 2e-8
    made = ColumnBuilder(inputs)
    suspects = list(reading_columns(made, residuals, np.array([1, -1j, 1])))
    columns = made.build()
    assert [(view, place) for _, view, place in suspects[:2]] == [
        (1, (0, 2)),
        (0, (1, 1)),
    ]
    assert len(suspects) == MOST and len(columns.columns) == 2 * MOST
    first = columns.grid[np.array(suspects[0][0])]
    assert np.count_nonzero(columns.grid) == 2 * MOST
    # stage x, then stage y, in the plate's frame
    assert first[:, 1, 0, 2].tolist() == [-1j, 1]
    assert [c.component for c in columns.columns[:2]] == ["x", "y"]
