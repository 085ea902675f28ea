# SPDX-License-Identifier: Apache-2.0
"""A linear model, Hu's law included, gets the tests of the default one."""

from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.applications.papers.methods import calibrate_by
from selfcal_ros.estimation.options import Options
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.terms import ModelTerm
from selfcal_ros.model.verdict import Grade
from selfcal_ros.reporting.words.findings import worded
from selfcal_ros.simulation.cell import CellSettings
from selfcal_ros.simulation.machine import Spread, random_truth
from test.support.options import bare
from test.support.results import covered
from test.support.truth import hu_plan, simulate_measurements

SETTINGS = CellSettings(
    sigma_xy_m=20e-9, sigma_theta_rad=2e-5, servo_sigma_m=0.0, servo_sigma_theta_rad=0.0
)
FLAT = Spread(encoder="independent", rotation="finite", phi_rad=1e-7)
LINEAR = bare(misalignment_model="linear")
METHODS = pytest.mark.parametrize("method", ["law", "joint"])


def judged(method, options=LINEAR, spread=FLAT, *, repeats=5, **how):
    plan, rng = hu_plan(Artifact(7, 0.01, 24), repeats), np.random.default_rng(3)
    truth = random_truth(plan.artifact, 4, rng, spread)
    readings = simulate_measurements(
        truth, plan, rng, settings=replace(SETTINGS, **how), visits=True
    )
    return truth, worded(calibrate_by(method, readings, options))


@METHODS
def test_a_linear_plate_is_qualified(method):
    verdict = judged(method)[1].verdict
    assert verdict.grade is Grade.GOOD and not verdict.causes
    assert verdict.sentence.startswith("Good: ")


@METHODS
def test_a_plate_that_really_turns_is_told_with_its_largest_turn(method):
    truth, found = judged(method, spread=replace(FLAT, phi_rad=5e-3))
    # the rotation that all views share is the theta of the stage's datum, and small
    largest = np.abs(truth.phi_rad).max() * 1e3
    assert found.verdict.grade is Grade.NOT_QUALIFIED and not found.verdict.causes
    head, _, tail = found.verdict.reasons[0].partition(" mrad")
    assert head.startswith("the model is linear, but the plate was turned by up to ")
    assert float(head.rpartition(" ")[2]) == pytest.approx(largest, abs=0.02)
    assert "leave out --misalignment linear" in tail
    assert found.verdict.sentence == f"Not qualified: {found.verdict.reasons[0]}"


@pytest.mark.parametrize(
    ("method", "options", "repeats"),
    [
        ("joint", LINEAR, 1),
        ("law", LINEAR, 1),
        (
            "joint",
            Options(
                misalignment_model="linear",
                terms=(ModelTerm("microscope"), ModelTerm("drift")),
            ),
            2,
        ),
    ],
)
def test_rotations_are_named_where_nothing_tells_the_noise_or_terms_take_them_up(
    method, options, repeats
):
    """A turned microscope, strain, and lines of the other sign were named instead."""
    turned = {
        "spread": replace(FLAT, phi_rad=1e-2),
        "repeats": repeats,
        "servo_sigma_m": 1e-7,
    }
    verdict = judged(method, options, **turned)[1].verdict
    assert verdict.grade is Grade.NOT_QUALIFIED and not verdict.causes
    assert "the plate was turned by up to" in verdict.sentence
    default = replace(options, misalignment_model="rigid")
    assert judged("joint", default, **turned)[1].verdict.grade is Grade.GOOD


@METHODS
def test_a_turned_microscope_is_named(method):
    truth, found = judged(
        method, spread=replace(FLAT, microscope_rotation_rad=2e-3), stop_sigma_m=20e-6
    )
    assert [cause.name for cause in found.verdict.causes] == ["microscope"]
    assert found.verdict.causes[0].size == pytest.approx(
        2e-3, abs=4 * found.verdict.causes[0].u
    )
    assert not any("linear" in reason for reason in found.verdict.reasons)
    if method == "law":  # which cannot hold it
        assert found.verdict.grade is Grade.NOT_QUALIFIED
    else:
        assert found.verdict.grade is Grade.ENLARGED
        assert covered(found, truth.g) >= 0.85


@METHODS
def test_a_linear_model_assumes_nothing(method):
    """Strain that is assumed would take finite rotations for its own."""
    turned = replace(FLAT, phi_rad=5e-3)
    _, found = judged(method, Options(misalignment_model="linear"), turned)
    _, alone = judged(method, LINEAR, turned)
    assert found.model.terms == () and found.verdict.grade is alone.verdict.grade
    assert [r.partition(": ")[0] for r in found.verdict.reasons] == [
        r.partition(": ")[0] for r in alone.verdict.reasons
    ]
    np.testing.assert_array_equal(found.error_map.u_gx, alone.error_map.u_gx)


@METHODS
def test_a_linear_model_asks_for_the_sign_of_the_offsets(method):
    """By the scatter of the stage, or nobody knows it: rotations show it with lines alone."""
    linear = Options(misalignment_model="linear")
    verdict = judged(method, linear)[1].verdict
    assert verdict.grade is Grade.NOT_QUALIFIED
    assert all("shows the sign of " in reason for reason in verdict.reasons)
    scatter = {"servo_sigma_m": 1e-7, "servo_sigma_theta_rad": 1e-4}
    assert judged(method, linear, **scatter)[1].verdict.grade is Grade.GOOD
    turned = judged(method, linear, replace(FLAT, phi_rad=3e-4))[1].verdict
    assert [found.name for found in turned.failed] == ["sign_shown_by_lines"]
    stood = judged(method, linear, replace(FLAT, phi_rad=3e-4), servo_sigma_m=1e-8)[
        1
    ].verdict
    assert stood.grade is Grade.GOOD


@METHODS
def test_nothing_is_looked_for_where_nobody_asks(method):
    found = judged(method, replace(LINEAR, causes=False), replace(FLAT, phi_rad=5e-3))
    assert (
        found[1].verdict.grade is Grade.NOT_QUALIFIED
        and len(found[1].verdict.reasons) == 1
    )


@METHODS
def test_axes_that_the_stage_does_not_have_are_not_qualified(method):
    axes = replace(LINEAR, datum_theta="xy_axes")
    own = judged(method, axes)[1].verdict
    assert own.grade is Grade.NOT_QUALIFIED
    assert any(
        "does not satisfy the axis conditions" in reason for reason in own.reasons
    )
    kept = judged(method, axes, replace(FLAT, encoder="xy_axes"))[1]
    assert kept.verdict.grade is Grade.GOOD
