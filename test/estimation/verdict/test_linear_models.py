# SPDX-License-Identifier: Apache-2.0
"""A linear model, Hu's law included, gets the tests of the default one."""

from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.estimation.api import calibrate
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

SETTINGS = CellSettings(sigma_xy_m=20e-9, sigma_theta_rad=2e-5, servo_sigma_m=0.0,
                        servo_sigma_theta_rad=0.0)
FLAT = Spread(encoder="independent", rotation="finite", phi_rad=1e-7)
LINEAR = [bare(method="law"), bare(misalignment_model="linear")]
NAMES = ["law", "linear"]


def judged(options, spread=FLAT, *, repeats=5, **how):
    plan, rng = hu_plan(Artifact(7, 0.01, 24), repeats), np.random.default_rng(3)
    truth = random_truth(plan.artifact, 4, rng, spread)
    readings = simulate_measurements(truth, plan, rng, settings=replace(SETTINGS, **how),
                                     visits=True)
    return truth, worded(calibrate(readings, options))


@pytest.mark.parametrize("options", LINEAR, ids=NAMES)
def test_a_linear_plate_is_qualified(options):
    verdict = judged(options)[1].verdict
    assert verdict.grade is Grade.GOOD and not verdict.causes
    assert verdict.sentence.startswith("Good: ")


@pytest.mark.parametrize("options", LINEAR, ids=NAMES)
def test_a_plate_that_really_turns_is_told_with_its_largest_turn(options):
    truth, found = judged(options, replace(FLAT, phi_rad=5e-3))
    # the rotation that all views share is the theta of the stage's datum, and small
    largest = np.abs(truth.phi_rad).max() * 1e3
    assert found.verdict.grade is Grade.NOT_QUALIFIED and not found.verdict.causes
    head, _, tail = found.verdict.reasons[0].partition(" mrad")
    assert head.startswith("the model is linear, but the plate was turned by up to ")
    assert float(head.rpartition(" ")[2]) == pytest.approx(largest, abs=0.02)
    assert "leave out --misalignment linear" in tail
    assert found.verdict.sentence == f"Not qualified: {found.verdict.reasons[0]}"


@pytest.mark.parametrize(("options", "repeats"), [
    (bare(misalignment_model="linear"), 1), (bare(method="law"), 1),
    (Options(misalignment_model="linear",
             terms=(ModelTerm("microscope"), ModelTerm("drift"))), 2)])
def test_rotations_are_named_where_nothing_tells_the_noise_or_terms_take_them_up(options, repeats):
    """A turned microscope, strain, and lines of the other sign were named instead."""
    verdict = judged(options, replace(FLAT, phi_rad=1e-2), repeats=repeats, servo_sigma_m=1e-7)[
        1].verdict
    assert verdict.grade is Grade.NOT_QUALIFIED and not verdict.causes
    assert "the plate was turned by up to" in verdict.sentence
    default = replace(options, method="joint", misalignment_model="rigid")
    assert judged(default, replace(FLAT, phi_rad=1e-2), repeats=repeats, servo_sigma_m=1e-7)[
        1].verdict.grade is Grade.GOOD


@pytest.mark.parametrize("options", LINEAR, ids=NAMES)
def test_a_turned_microscope_is_named(options):
    truth, found = judged(options, replace(FLAT, microscope_rotation_rad=2e-3),
                          stop_sigma_m=20e-6)
    assert [cause.name for cause in found.verdict.causes] == ["microscope"]
    assert found.verdict.causes[0].size == pytest.approx(2e-3, abs=4 * found.verdict.causes[0].u)
    assert not any("linear" in reason for reason in found.verdict.reasons)
    if options.method == "law":  # which cannot hold it
        assert found.verdict.grade is Grade.NOT_QUALIFIED
    else:
        assert found.verdict.grade is Grade.ENLARGED
        assert covered(found, truth.g) >= 0.85


LINEAR_BY_DEFAULT = [{"method": "law"}, {"misalignment_model": "linear"}]


@pytest.mark.parametrize("how", LINEAR_BY_DEFAULT, ids=NAMES)
def test_a_linear_model_assumes_nothing(how):
    """Strain that is assumed would take finite rotations for its own."""
    _, found = judged(Options(**how), replace(FLAT, phi_rad=5e-3))
    _, alone = judged(bare(**how), replace(FLAT, phi_rad=5e-3))
    assert found.model.terms == () and found.verdict.grade is alone.verdict.grade
    assert [r.partition(": ")[0] for r in found.verdict.reasons] == [
        r.partition(": ")[0] for r in alone.verdict.reasons]
    np.testing.assert_array_equal(found.error_map.u_gx, alone.error_map.u_gx)


@pytest.mark.parametrize("how", LINEAR_BY_DEFAULT, ids=NAMES)
def test_a_linear_model_asks_for_the_sign_of_the_offsets(how):
    """By the scatter of the stage, by finite rotations, or nobody knows it."""
    verdict = judged(Options(**how))[1].verdict
    assert verdict.grade is Grade.NOT_QUALIFIED
    assert all("shows the sign of " in reason for reason in verdict.reasons)
    scatter = {"servo_sigma_m": 1e-7, "servo_sigma_theta_rad": 1e-4}
    assert judged(Options(**how), **scatter)[1].verdict.grade is Grade.GOOD
    assert judged(Options(**how), replace(FLAT, phi_rad=3e-4))[1].verdict.grade is Grade.GOOD


@pytest.mark.parametrize("options", LINEAR, ids=NAMES)
def test_nothing_is_looked_for_where_nobody_asks(options):
    found = judged(replace(options, causes=False), replace(FLAT, phi_rad=5e-3))
    assert found[1].verdict.grade is Grade.NOT_QUALIFIED and len(found[1].verdict.reasons) == 1


@pytest.mark.parametrize("options", LINEAR, ids=NAMES)
def test_axes_that_the_stage_does_not_have_are_not_qualified(options):
    own = judged(replace(options, datum_theta="xy_axes"))[1].verdict
    assert own.grade is Grade.NOT_QUALIFIED
    assert any("does not satisfy the axis conditions" in reason for reason in own.reasons)
    kept = judged(replace(options, datum_theta="xy_axes"), replace(FLAT, encoder="xy_axes"))[1]
    assert kept.verdict.grade is Grade.GOOD
