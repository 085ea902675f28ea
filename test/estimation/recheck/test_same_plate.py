# SPDX-License-Identifier: Apache-2.0
"""Another plate, and the known one placed otherwise than planned, are not a changed stage."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.checks.placing import PlacingError
from selfcal_ros.estimation.recheck import plate as of_plate
from selfcal_ros.estimation.recheck.plate import known_plate
from selfcal_ros.estimation.recheck.solve import recheck
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.error_map import rms
from selfcal_ros.model.readings import Sense
from selfcal_ros.model.result import result_from_dict, result_to_dict
from selfcal_ros.model.terms import ModelTerm
from selfcal_ros.model.verdict import Grade
from selfcal_ros.model.view import Plan, View
from selfcal_ros.reporting.words.findings import worded
from selfcal_ros.simulation.cell import CellSettings
from selfcal_ros.simulation.machine import Spread, random_truth
from test.support import placed
from test.support.lattice_plans import plan_of
from test.support.options import BARE
from test.support.truth import simulate_measurements

ARTIFACT = Artifact(7, 0.01)
HIDDEN = [(0, (1, 0)), (90, (0, 0)), (180, (0, 0)), (270, (0, -1))]


@cache
def calibrated(sense):
    """Return the truth, and what a calibration of it makes known."""
    plan, rng = plan_of("0,90,180,tx,ty", ARTIFACT), np.random.default_rng(2)
    truth = random_truth(
        ARTIFACT, len(plan.views), rng, Spread(correlation_pitches=4.0)
    )
    readings = simulate_measurements(
        truth, plan, rng, settings=CellSettings(sense, 20e-9)
    )
    result = calibrate(readings, BARE)
    return truth, known_plate(
        result_from_dict(result_to_dict(worded(result)), "r"), "r.json"
    )


def once_more(sense, degrees=0.0, shift=(0, 0), *, repeats=2, **changes):
    """Return readings of one more view, of a truth with some parts changed."""
    truth, _ = calibrated(sense)
    view = View(
        "again",
        np.radians(degrees),
        tuple(0.01 * part for part in shift),
        True,
        False,
        repeats=repeats,
    )
    changed = replace(truth, t_m=truth.t_m[:1], phi_rad=truth.phi_rad[:1], **changes)
    return simulate_measurements(
        changed,
        Plan("again", ARTIFACT, (view,)),
        np.random.default_rng(7),
        settings=CellSettings(sense, 20e-9),
    )


def said_to_lie(after, degrees, shift=(0, 0)):
    """Return the readings of a view as those of the sites of another pose, as if without ids."""
    (seen,), turn = after.views, np.exp(1j * np.radians(degrees))
    at = (
        seen.view.pose.places(ARTIFACT, seen.m, seen.n) / 0.01 - complex(*shift)
    ) / turn
    view = View(
        "again", np.radians(degrees), tuple(0.01 * part for part in shift), True, False
    )
    m, n = np.rint(at.real).astype(int), np.rint(at.imag).astype(int)
    on = np.maximum(abs(m), abs(n)) <= ARTIFACT.half[0]
    order = np.lexsort((n[on], m[on]))
    part = {name: getattr(seen, name)[on][order] for name in ("dx", "dy", "count")}
    return replace(
        after,
        views=(
            replace(
                seen, view=view, m=m[on][order], n=n[on][order], **part, visits=None
            ),
        ),
    )


@pytest.mark.parametrize("sense", Sense)
@pytest.mark.parametrize("pose", HIDDEN)
def test_a_plate_that_lies_at_another_pose_is_named(pose, sense):
    _, plate = calibrated(sense)
    real = once_more(sense, *pose)
    assert recheck(real, BARE, plate).verdict.grade is Grade.GOOD
    turned = (
        f"turned by {pose[0]}°, not by 0°"
        if pose[0]
        else "shifted by (+1, +0) pitches, not by (+0, +0) pitches"
    )
    with pytest.raises(PlacingError) as error:
        recheck(said_to_lie(real, 0), BARE, plate)
    assert turned in str(error.value) and "view 'again'" in str(error.value)
    with pytest.raises(PlacingError, match=r"lies (turned|shifted) by"):
        recheck(said_to_lie(real, 90, (0, 1)), BARE, plate)


@pytest.mark.parametrize("sense", Sense)
def test_another_plate_is_not_a_changed_stage(sense):
    truth, plate = calibrated(sense)
    rng = np.random.default_rng(8)
    other = once_more(sense, a=truth.a + rng.normal(0, 3e-7, truth.a.shape))
    result = worded(recheck(other, BARE, plate))
    assert result.verdict.grade is Grade.NOT_QUALIFIED and not result.findings
    assert "another plate, or the plate has changed" in result.verdict.sentence
    assert "check which plate it is" in result.verdict.sentence


@pytest.mark.parametrize("seed", range(5))
def test_a_plate_of_the_same_drawing_is_another_plate_though_it_differs_little(seed):
    """By five u of its marks each: the map would be as far off, and its U not."""
    truth, plate = calibrated(Sense.MICROSCOPE_MOVES)
    marks = plate.result.artifact_map
    u = rms(np.stack([marks.u_ax, marks.u_ay, plate.result.error_map.u_gx]))
    rng = np.random.default_rng(seed)
    other = once_more(
        Sense.MICROSCOPE_MOVES, a=truth.a + rng.normal(0, 5 * u, truth.a.shape)
    )
    assert [found.name for found in recheck(other, BARE, plate).verdict.failed] == [
        "other_plate"
    ]


@pytest.mark.parametrize("seed", range(5))
def test_another_machine_with_another_plate_is_not_a_changed_stage(seed):
    """The stages differ smoothly, as much as the plates do from mark to mark; no pose is named."""
    _, plate = calibrated(Sense.MICROSCOPE_MOVES)
    other = random_truth(
        ARTIFACT, 1, np.random.default_rng(seed), Spread(correlation_pitches=4.0)
    )
    size = np.std(other.g) / np.std(other.a)
    result = recheck(
        once_more(Sense.MICROSCOPE_MOVES, g=other.g, a=size * other.a), BARE, plate
    )
    assert [found.name for found in result.verdict.failed] == ["other_plate"]


def test_what_neighbours_do_not_share_is_found_beneath_a_continuous_field():
    """A bend and a step are of a stage, as much of each mark by itself is not."""
    half, rng = np.arange(-7.0, 8.0), np.random.default_rng(1)
    z = (half[:, None] + 1j * half).ravel()
    white = rng.normal(size=len(z)) + 1j * rng.normal(size=len(z))
    for field in (0.05 * (z.real**2 + 1j * z.real * z.imag), 2.0 * (z.real > 2)):
        assert not of_plate._of_marks(z, field + 0.02 * white, 0.1)
        assert of_plate._of_marks(z, field + white, 0.1)
    assert of_plate._of_marks(z, white, 0.1) and not of_plate._of_marks(z, white, 1.0)


@pytest.mark.parametrize("size", [5e-7, 1e-5])
def test_a_bent_stage_is_not_another_plate(size):
    truth, plate = calibrated(Sense.MICROSCOPE_MOVES)
    x, y = ARTIFACT.x_m / 0.03, ARTIFACT.y_m / 0.03
    for bent in (
        size * np.stack([x * y, x**2]),
        size * np.stack([np.sin(4 * y), np.sin(4 * x)]),
        5e-7 * np.stack([x > 0.4, x * 0]),
    ):
        result = worded(
            recheck(once_more(Sense.MICROSCOPE_MOVES, g=truth.g + bent), BARE, plate)
        )
        assert result.recheck.changed
        assert result.verdict.sentence.startswith(
            "Changed since r.json: calibrate again, provided"
        )


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("part", ["a", "g"])
@pytest.mark.parametrize(("number", "size"), [(1, 3e-7), (4, 5e-7), (1, 1e-5)])
def test_marks_that_changed_by_themselves_and_a_stage_there_are_told_alike(
    seed, part, number, size
):
    """Dirt on a mark moves the datum of the map, and U knows nothing of it."""
    truth, plate = calibrated(Sense.MICROSCOPE_MOVES)
    rng = np.random.default_rng(seed)
    values = getattr(truth, part).copy()
    marks = rng.choice(49, number, replace=False)
    angle = rng.uniform(0, 2 * np.pi, number)
    values.reshape(2, -1)[:, marks] += size * np.stack([np.cos(angle), np.sin(angle)])
    result = worded(
        recheck(once_more(Sense.MICROSCOPE_MOVES, **{part: values}), BARE, plate)
    )
    (found,) = result.verdict.failed
    assert found.name == "changed_or_marks" and found.others < number
    m, n = found.mark
    assert (m + 3) * 7 + n + 3 in marks
    assert found.away == pytest.approx(size, abs=1e-7)
    assert f"mark ({m}, {n}) lies" in result.verdict.sentence


def test_a_scale_that_has_changed_is_the_headline():
    truth, plate = calibrated(Sense.MICROSCOPE_MOVES)
    grown = 5e-6 * np.stack([ARTIFACT.x_m, ARTIFACT.y_m])
    for sign in (1, -1):
        result = worded(
            recheck(
                once_more(Sense.MICROSCOPE_MOVES, a=truth.a + sign * grown), BARE, plate
            )
        )
        found = result.recheck
        assert found.scale.changed and not found.changed
        assert abs(abs(found.scale.change) - 5e-6) < 3 * found.scale.u
        assert result.verdict.sentence.startswith("Scale changed since r.json by ")
        assert "temperature of the plate or of the encoders" in result.warnings[0]
        assert result.verdict.grade is Grade.GOOD
    same = worded(recheck(once_more(Sense.MICROSCOPE_MOVES), BARE, plate))
    assert same.verdict.sentence.startswith("Still good") and not same.warnings


def test_a_scale_that_one_pass_shows_may_be_drift():
    """A raster pass that drifts by 0.3 µm along its slow axis reads like a longer plate."""
    truth, plate = calibrated(Sense.MICROSCOPE_MOVES)
    grown = 5e-6 * np.stack([ARTIFACT.x_m, ARTIFACT.y_m])
    once = once_more(Sense.MICROSCOPE_MOVES, a=truth.a + grown, repeats=1)
    result = worded(recheck(once, BARE, plate))
    assert result.recheck.scale.changed and result.recheck.passes == 1
    for text in (result.verdict.sentence, result.warnings[0]):
        assert text.startswith("Scale changed or drifted since r.json by ")
        assert "a single pass cannot tell a change from drift" in text
        assert "temperature" not in text


def test_a_change_that_one_pass_shows_is_not_qualified_unless_drift_is_declared():
    truth, plate = calibrated(Sense.MICROSCOPE_MOVES)
    bent = 3e-7 * np.stack([ARTIFACT.y_m**2, ARTIFACT.x_m**2]) / 9e-4
    one, two = (
        once_more(Sense.MICROSCOPE_MOVES, g=truth.g + bent, repeats=repeats)
        for repeats in (1, 2)
    )
    drift = replace(BARE, terms=(*BARE.terms, ModelTerm("drift", 1e-8)))
    for readings, options, told in (
        (one, BARE, False),
        (two, BARE, True),
        (one, drift, True),
    ):
        result = worded(recheck(readings, options, plate))
        assert result.recheck.changed and result.verdict.qualified is told
        assert (
            "cannot tell a change from drift" in result.verdict.sentence
        ) is not told
        assert result.verdict.sentence.startswith("Changed since r.json") is told


def test_a_view_off_the_lattice_that_lies_a_quarter_turn_on():
    rng, artifact = np.random.default_rng(4), placed.plate(9, 5)
    poses = [*placed.SIX, (37, (0.0, 0.0)), (127, (0.0, 0.0))]
    readings, _ = placed.readings(artifact, poses, rng)
    plate = known_plate(
        result_from_dict(
            result_to_dict(
                worded(calibrate(replace(readings, views=readings.views[:6]), BARE))
            ),
            "r",
        ),
        "r.json",
    )
    seen, turned = readings.views[6:]
    assert (
        recheck(replace(readings, views=(turned,)), BARE, plate).verdict.grade
        is Grade.GOOD
    )
    lies = replace(turned, view=seen.view, m=-turned.n, n=turned.m)
    with pytest.raises(PlacingError, match="the plate lies turned by 127°, not by 37°"):
        recheck(replace(readings, views=(lies,)), BARE, plate)


def test_a_negative_turn_is_named_between_0_and_360_degrees():
    _, plate = calibrated(Sense.MICROSCOPE_MOVES)
    with pytest.raises(PlacingError, match="turned by 0°, not by 270°"):
        recheck(said_to_lie(once_more(Sense.MICROSCOPE_MOVES), -90), BARE, plate)
