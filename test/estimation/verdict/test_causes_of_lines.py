# SPDX-License-Identifier: Apache-2.0
"""Marks and lines that turn differently: found, named where it matters, and kept apart."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import kstest

from selfcal_ros.collection.inputs import Kind, Phase
from selfcal_ros.collection.reduce import with_collected
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.checks.wiring import WiringError
from selfcal_ros.estimation.joint.model_fit import fit_model
from selfcal_ros.estimation.joint.solve import prepare
from selfcal_ros.estimation.options import Options
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.findings import Remedy
from selfcal_ros.model.readings import Sense
from selfcal_ros.model.terms import ModelTerm, parse_terms
from selfcal_ros.model.verdict import Grade
from selfcal_ros.model.view import Plan, View
from selfcal_ros.reporting.summary.sections import summary_text
from selfcal_ros.reporting.words.findings import worded
from selfcal_ros.simulation.cell import CellSettings
from selfcal_ros.simulation.machine import Spread, random_truth
from test.support.collecting import collect, scene
from test.support.options import BARE, bare
from test.support.results import covered
from test.support.truth import hu_plan, simulate_measurements

ARTIFACT = Artifact(7, 0.01, 24)
FINE_RAD, COARSE_RAD = 2e-7, 2e-5
"""Noise of lines: 2e-7 rad is 6 nm at the edge of the plate, less than that of a mark."""


def truth_and_readings(seed, sigma_rad, *, repeats=2, spread=None, **how):
    plan, rng = hu_plan(ARTIFACT, repeats), np.random.default_rng(seed)
    truth = random_truth(
        ARTIFACT, len(plan.views), rng, spread or Spread(rotation="finite")
    )
    settings = CellSettings(
        sigma_xy_m=2e-8,
        sigma_theta_rad=sigma_rad,
        **{"servo_sigma_m": 0.0, "servo_sigma_theta_rad": 0.0} | how,
    )
    return truth, simulate_measurements(
        truth, plan, rng, settings=settings, visits=True
    )


def measured(*args, **how):
    return truth_and_readings(*args, **how)[1]


def turned(readings, index, by_rad):
    """Turn the plate between the marks and the lines of a view."""
    views = list(readings.views)
    views[index] = replace(views[index], dtheta=views[index].dtheta + by_rad)
    return replace(readings, views=tuple(views))


def apart(size_rad=1e-12, **how):
    """Options with lines that turn against marks by themselves, by so much or as they like."""
    return bare(terms=(ModelTerm("rotation", size_rad),), **how)


def probability(readings):
    """Return the probability of rotations as different as those of marks and lines."""
    (test,) = fit_model(prepare(readings, apart())[0]).sizes
    return test.p


@pytest.mark.parametrize(("index", "by_rad"), [(1, 4e-6), (3, -4e-6)])
def test_a_plate_that_turns_between_marks_and_lines_is_named(index, by_rad):
    truth, readings = truth_and_readings(1, FINE_RAD)
    clean = calibrate(readings, BARE)
    result = worded(calibrate(turned(readings, index, by_rad), BARE))
    name = readings.views[index].view.name
    assert clean.verdict.grade is Grade.GOOD and result.verdict.grade is Grade.ENLARGED
    assert covered(clean, truth.g) >= 0.85 and covered(result, truth.g) >= 0.85
    (cause,) = result.verdict.causes
    assert (cause.name, cause.unit) == ("rotation", "rad") and cause.p < 5e-4
    # the median of three views is the datum: a third one may carry noise of the same size
    assert cause.size == pytest.approx(by_rad, abs=6 * cause.u) and cause.u < 0.1 * abs(
        by_rad
    )
    way = "counter-clockwise" if cause.size > 0 else "clockwise"
    assert cause.text.startswith(
        f"lines turned {way} by {abs(cause.size) * 206264.8:.3f} ± "
    )
    assert cause.view == name and Remedy("view", name) in cause.remedies
    assert "check whether the plate moved between marks and lines" in cause.text


ASKEW = Spread(rotation="finite", encoder="independent", phi_rad=1e-3)
"""Plates that lie turned by 1 mrad (sigma)."""

SCALES = ["microscope", "line_scale"]
"""Of marks and lines that turn unequally nobody knows which are seen at a wrong scale."""


@pytest.mark.parametrize(
    ("spread", "by_rad", "names", "sense"),
    [
        (ASKEW, 4e-6, ["rotation"], Sense.MICROSCOPE_MOVES),
        (ASKEW, -4e-6, ["rotation"], Sense.PLATE_MOVES),
        (replace(ASKEW, microscope_scale=0.06), 0.0, SCALES, Sense.PLATE_MOVES),
        (replace(ASKEW, line_factor=0.94), 0.0, SCALES, Sense.MICROSCOPE_MOVES),
        (replace(ASKEW, plate_strain=2e-6), 0.0, ["plate_strain"], Sense.PLATE_MOVES),
    ],
)
def test_what_turns_lines_against_marks_is_told_from_what_is_assumed(
    spread, by_rad, names, sense
):
    """No size grows for a turn of lines, and no turn of lines is named where a size is wrong."""
    truth, readings = truth_and_readings(
        5, FINE_RAD, spread=spread, sense=sense, servo_sigma_m=2e-8
    )
    result = calibrate(turned(readings, 3, by_rad), Options())
    told = names != ["plate_strain"]  # Hu's views do not determine two of its modes
    assert result.verdict.grade is (Grade.ENLARGED if told else Grade.NOT_QUALIFIED)
    assert [cause.name for cause in result.verdict.causes] == names
    assert [term.name for term in result.model.terms if term.size_used] == names
    assert covered(result, truth.g) >= 0.85


@pytest.mark.parametrize("seed", range(4))
def test_scales_of_offsets_that_explain_a_plate_that_grew_are_not_the_only_cause(seed):
    """Where plates lie turned by mrad: both scales by 9 % look like 1 um/m, E phi^2."""
    artifact = Artifact(11, 0.01, 24)
    plan, rng = hu_plan(artifact, 5), np.random.default_rng(seed)
    truth = replace(
        random_truth(
            artifact, 4, rng, Spread(rotation="finite", encoder="independent")
        ),
        phi_rad=np.array([7e-3, 0.4e-3, 7.1e-3, -3.8e-3]),
        plate_scale=np.array([0, 1e-6, 0, 0]),
    )
    settings = CellSettings(
        sigma_xy_m=2e-8, sigma_theta_rad=np.deg2rad(1e-3), servo_sigma_m=2e-8
    )
    readings = simulate_measurements(truth, plan, rng, settings=settings, visits=True)
    result = calibrate(readings, Options())
    assert [cause.name for cause in result.verdict.causes] == [
        "line_scale",
        "plate_strain",
    ]
    assert covered(result, truth.g) > 0.9
    error = result.error_map.g_theta - truth.g_theta
    error -= error.mean()
    assert (abs(error) < 2 * result.error_map.u_g_theta).mean() > 0.8


@pytest.mark.parametrize(
    "options", [BARE, Options(), apart()], ids=["bare", "assumed", "held"]
)
def test_what_moves_no_map_disqualifies_nothing(options):
    # all lines were read in every view: a turn of all lines of one moves none against another
    readings = turned(measured(2, COARSE_RAD), 1, 1e-4)
    assert probability(readings) < 1e-6
    verdict = calibrate(readings, options).verdict
    assert verdict.grade is Grade.GOOD and verdict.causes == ()


def test_without_an_uncertainty_it_cannot_be_said_to_be_harmless():
    readings = turned(measured(2, COARSE_RAD), 1, 1e-4)
    verdict = calibrate(readings, bare(uncertainty=False)).verdict
    assert [cause.name for cause in verdict.causes] == ["rotation"]
    assert verdict.grade is Grade.NOT_QUALIFIED


@pytest.mark.parametrize(
    "options", [BARE, Options(), apart(np.inf)], ids=["bare", "assumed", "free"]
)
def test_offsets_of_lines_with_the_other_sign_are_no_bent_plate(options):
    readings = measured(3, COARSE_RAD, servo_sigma_m=2e-8)
    wrong = replace(
        readings, views=tuple(replace(v, dtheta=-v.dtheta) for v in readings.views)
    )
    assert calibrate(readings, options).verdict.grade is Grade.GOOD
    with pytest.raises(WiringError, match="offset_theta has the other sign"):
        calibrate(wrong, options)  # the angular map would be that of another stage


def test_another_cause_comes_first_for_it_turns_the_marks_as_well():
    """A microscope of another scale shows plates turned by more, and lines know nothing of it."""
    spread = Spread(rotation="finite", microscope_scale=5e-3)
    readings = measured(4, FINE_RAD, spread=spread, repeats=4, stop_sigma_m=20e-6)
    assert probability(readings) < 1e-6
    for by_rad, names in ((0.0, ["microscope"]), (1e-5, ["microscope", "rotation"])):
        causes = calibrate(turned(readings, 1, by_rad), BARE).verdict.causes
        assert [cause.name for cause in causes] == names
        assert causes[0].size == pytest.approx(5e-3, abs=4.5 * causes[0].u)
    held = bare(terms=parse_terms(["microscope"], ""))
    assert calibrate(readings, held).verdict.grade is Grade.GOOD
    (left,) = calibrate(turned(readings, 1, 1e-5), held).verdict.causes
    assert left.name == "rotation" and left.size == pytest.approx(1e-5, abs=6 * left.u)


def test_a_line_that_is_off_is_named_beside_it():
    readings = turned(measured(1, FINE_RAD), 1, 1e-5)
    view = readings.views[3]
    off = replace(view, dtheta=view.dtheta + 5e-6 * (view.k == 7))
    both = replace(readings, views=(*readings.views[:3], off))
    causes = worded(calibrate(both, BARE)).verdict.causes
    assert {cause.name for cause in causes} == {"rotation", "reading"}
    assert "a reading of line 7 in view 'shift_x'" in causes[-1].text


def test_free_a_turn_of_the_lines_moves_nothing():
    readings = measured(1, FINE_RAD)
    bent = turned(readings, 1, 4e-6)
    one, other = (calibrate(r, apart(np.inf)).error_map for r in (readings, bent))
    together = calibrate(bent, bare(causes=False)).error_map
    for name, moved in (("gx", 1e-10), ("gy", 1e-10), ("g_theta", 0.0)):
        assert abs(getattr(one, name) - getattr(other, name)).max() < 1e-14
        assert abs(getattr(together, name) - getattr(one, name)).max() > moved


def test_the_probability_is_one():
    """Of good readings it is even between 0 and 1, with noise from repeats."""
    found = [probability(measured(seed, FINE_RAD)) for seed in range(25)]
    assert kstest(found, "uniform").pvalue > 1e-3


def test_one_common_view_tells_nothing():
    grids = [
        View(name, q * np.pi / 2, (a * 0.01, 0.0), True, name == "0", 2)
        for name, q, a in (("0", 0, 0), ("90", 1, 0), ("+x", 0, 1))
    ]
    views = (
        *grids,
        *(
            View(f"lines {k}", k * np.pi / 12, (0.0, 0.0), False, True, 2)
            for k in (1, 6)
        ),
    )
    plan, rng = Plan("p", ARTIFACT, views), np.random.default_rng(0)
    readings = simulate_measurements(random_truth(ARTIFACT, 5, rng), plan, rng)
    assert prepare(readings, apart())[0].terms == ()


def test_lines_without_noise_turn_by_rounding_alone():
    assert calibrate(measured(1, 0.0), BARE).verdict.causes == ()


def test_a_plate_that_turns_while_its_lines_are_read_hides_no_other_fault():
    """A turning inflates the scatter of repeats by as much as an error of the circle residuals."""
    sigma_rad = 1e-5
    cell = scene(
        "0, 90, tx", count=24, line=True, repeats=2, seed=4, sigma_theta_rad=sigma_rad
    )
    readings, _ = collect(cell.events)
    assert calibrate(readings).verdict.grade is Grade.GOOD
    assert with_collected(calibrate(readings), readings.views).parts.turned is None

    begun = [one.stamp_ns for one in cell.commands if one.phase is Phase.MEASURE]
    stamps = np.array([one.stamp_ns for one in cell.detections])
    lines = np.array([one.kind == Kind.ANGULAR for one in cell.detections])
    for view, rng in enumerate(map(np.random.default_rng, range(len(begun)))):
        of_view = np.flatnonzero(
            lines & (np.searchsorted(begun, stamps) == view + 1)
        ).tolist()
        size, phase = rng.normal(), rng.uniform(0, 2 * np.pi)
        for index, part in zip(of_view, np.linspace(-1, 1, len(of_view)), strict=True):
            line = cell.detections[index]
            turning = 4 * (-1) ** view * (part**2 - 1 / 3)
            oval = 2 * size * np.cos(4 * np.pi * line.k / 24 + phase)
            cell.spoil(
                index, offset_theta=line.offset_theta + sigma_rad * (turning + oval)
            )
    readings, _ = collect(cell.events)
    result = with_collected(calibrate(readings), readings.views)
    assert result.noise.sigma_theta_repeats < 1.3 * sigma_rad
    assert not result.verdict.qualified
    assert result.parts.turned == ("0", "90", "tx", "line")
    assert (
        "turned slowly while they were read, in '0', '90', 'tx', 'line': "
        in summary_text(result)
    )
