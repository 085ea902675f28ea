# SPDX-License-Identifier: Apache-2.0
"""Offsets of lines that are seen at a wrong scale: found, covered by U, told from a microscope."""

from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.options import Options
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.readings import Sense
from selfcal_ros.model.terms import parse_terms
from selfcal_ros.model.verdict import Grade
from selfcal_ros.reporting.words.findings import worded
from selfcal_ros.simulation.cell import CellSettings
from selfcal_ros.simulation.machine import Spread, random_truth
from test.support.truth import hu_plan, simulate_measurements

ARTIFACT = Artifact(5, 0.01, 24)
SPREAD = Spread(rotation="finite", phi_rad=1e-3)
BOTH = list(Sense)


def measured(
    factor, sense=Sense.MICROSCOPE_MOVES, *, spread=SPREAD, plan=None, seed=3, **how
):
    """Return a machine whose published offsets of lines are `factor` times the true ones."""
    plan, rng = plan or hu_plan(ARTIFACT, 4), np.random.default_rng(seed)
    truth = random_truth(
        ARTIFACT, len(plan.views), rng, replace(spread, line_factor=factor)
    )
    settings = CellSettings(sense, 2e-8, 2e-6, **{"servo_sigma_m": 0.0} | how)
    return truth, simulate_measurements(
        truth, plan, rng, settings=settings, visits=True
    )


def with_stops():
    plan = hu_plan(ARTIFACT, 4)
    return replace(
        plan,
        views=tuple(
            replace(view, check_marks=5, check_offset_m=20e-6) if view.grid else view
            for view in plan.views
        ),
    )


def scale_of(result):
    (term,) = (term for term in result.model.terms if term.name == "line_scale")
    (scale,) = term.estimates
    return scale


def off(result, truth):
    """Return the errors of the angular map over their uncertainties, rms."""
    wanted = truth.g_theta - truth.g_theta.mean()
    emap = result.error_map
    return float(np.sqrt(np.mean(((emap.g_theta - wanted) / emap.u_g_theta) ** 2)))


@pytest.mark.parametrize("sense", BOTH)
@pytest.mark.parametrize("factor", [0.95, 1.08])
def test_a_known_microscope_shows_the_scale_of_the_lines(factor, sense):
    """(1 + E) is what makes a true offset of one that was published."""
    truth, readings = measured(factor, sense)
    terms = parse_terms(["microscope:0", "line_scale:0.1"], "")
    result = calibrate(readings, Options(terms=terms))
    scale = scale_of(result)
    assert scale.value == pytest.approx(1 / factor - 1, abs=3 * scale.u)
    assert scale.u < 1e-3 and scale.unit == "m/m" and not scale.view
    assert result.verdict.grade is Grade.GOOD and off(result, truth) < 1.5
    # without the term the map is too small or too large by as much
    without = calibrate(
        readings, Options(terms=parse_terms(["microscope:0", "line_scale:0"], ""))
    )
    assert off(without, truth) > 3


@pytest.mark.parametrize("factor", [0.95, 1.05])
def test_check_stops_tell_the_lines_from_the_microscope(factor):
    truth, readings = measured(factor, plan=with_stops())
    result = worded(calibrate(readings, Options()))
    assert [cause.name for cause in result.verdict.causes] == ["line_scale"]
    assert result.verdict.grade is Grade.ENLARGED and off(result, truth) < 1.5
    cause = result.verdict.causes[0]
    assert cause.size == pytest.approx(1 / factor - 1, abs=3 * cause.u)
    small = "small" if factor < 1 else "large"
    assert cause.text.startswith(f"offsets of the lines too {small} by ")
    assert "microscope" not in cause.text


@pytest.mark.parametrize("spread", [replace(SPREAD, microscope_scale=0.06), SPREAD])
def test_without_them_either_may_be_at_fault(spread):
    truth, readings = measured(
        1.0 if spread.microscope_scale else 1 / 0.94, spread=spread, servo_sigma_m=5e-9
    )
    result = worded(calibrate(readings, Options()))
    microscope, lines = result.verdict.causes
    assert (microscope.name, lines.name) == ("microscope", "line_scale")
    assert microscope.size == pytest.approx(0.06, abs=3 * microscope.u + 2e-3)
    assert lines.size == pytest.approx(-0.06, abs=3 * lines.u + 5e-3)
    assert "shows lengths too short by" in microscope.text
    assert "or offsets of the lines too large by as much" in microscope.text
    assert "or a microscope that shows lengths too short by as much" in lines.text
    assert result.verdict.grade is Grade.ENLARGED and off(result, truth) < 1.5


@pytest.mark.parametrize("sense", BOTH)
def test_where_all_plates_lie_alike_it_is_a_part_of_the_uncertainty(sense):
    """A map of lines alone is as large as their offsets: 1 % of it is in U unless declared."""
    truth, readings = measured(1.01, sense, spread=replace(SPREAD, phi_rad=0.0))
    result = calibrate(readings, Options())
    exact = calibrate(readings, Options(terms=parse_terms(["line_scale:0"], "")))
    assert scale_of(result).u == pytest.approx(0.01, rel=0.05)
    added = result.kept.angular["line_scale"]
    wanted = truth.g_theta - truth.g_theta.mean()
    assert added == pytest.approx(
        0.01 * np.abs(wanted), abs=0.1 * 0.01 * np.abs(wanted).max()
    )
    u, exact_u = result.error_map.u_g_theta, exact.error_map.u_g_theta
    assert u**2 - exact_u**2 == pytest.approx(
        added**2, rel=0.05, abs=0.02 * (added**2).max()
    )


@pytest.mark.parametrize("sense", BOTH)
def test_a_stage_that_turns_to_the_lines_has_no_offsets_to_scale(sense):
    """Its mean angle is published: what lies there is not an offset."""
    truth, readings = measured(0.9, sense, follow_mark=True)
    result = calibrate(readings, Options(terms=parse_terms(["microscope:0"], "")))
    assert result.verdict.grade is Grade.GOOD and off(result, truth) < 1.5
    assert all(
        abs(view.axis_theta - np.mean(view.dtheta)) < 1e-6
        for view in readings.views
        if len(view.k)
    )


def test_noise_of_the_lines_shows_no_scale():
    for seed in range(4):
        _, readings = measured(1.0, seed=seed)
        scale = scale_of(calibrate(readings, Options()))
        assert abs(scale.value) < 3 * scale.u < 0.03
