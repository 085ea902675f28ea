# SPDX-License-Identifier: Apache-2.0
"""One k for the uncertainty of a map: in the result, the summary, the budget and the report."""

import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import t as student

from selfcal_ros.compensation.export import provenance
from selfcal_ros.compensation.frame import MachineFrame
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.options import Options
from selfcal_ros.estimation.terms import equations
from selfcal_ros.estimation.verdict.uncertainty import budgets
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.reference import ReferenceLength
from selfcal_ros.model.result import result_from_dict, result_to_dict
from selfcal_ros.model.terms import parse_terms
from selfcal_ros.outputs import plain
from selfcal_ros.reporting.chapters import chapters
from selfcal_ros.reporting.summary.sections import error_section, state_sentence
from selfcal_ros.simulation.cell import CellSettings
from selfcal_ros.simulation.machine import Spread, random_truth
from test.support.options import bare
from test.support.truth import hu_plan, simulate_measurements

SETTINGS = CellSettings(
    sigma_xy_m=20e-9,
    sigma_theta_rad=2e-5,
    servo_sigma_m=0.0,
    servo_sigma_theta_rad=0.0,
    stop_sigma_m=20e-6,
)
REFERENCE = ReferenceLength("artifact", 0.0, 3e-6)


def measured(size=3, settings=SETTINGS):
    plan, rng = hu_plan(Artifact(size, 0.01, 24), 1), np.random.default_rng(2)
    truth = random_truth(plan.artifact, 4, rng, Spread(phi_rad=1e-4))
    return simulate_measurements(truth, plan, rng, settings=settings, visits=True)


def calibrated(size=3, **how):
    result = calibrate(measured(size), bare(**how))
    return result_from_dict(json.loads(json.dumps(result_to_dict(result))), "r.json")


@pytest.mark.parametrize(
    "how",
    [{"reference": REFERENCE}, {"terms": parse_terms(["plate_shape:100e-9"], "")}, {}],
)
def test_one_k_is_read_everywhere(how):
    result = calibrated(**how)
    k, dof = (result_to_dict(result)[name]["xy"] for name in ("coverage_factor", "dof"))
    assert k == pytest.approx(student.ppf(0.97725, dof), rel=1e-12)
    assert result.noise.k_xy == k
    nodes, anywhere = budgets(result)[:2]
    assert (nodes.k, nodes.dof) == (k, dof)
    assert nodes.k >= anywhere.k and nodes.dof <= anywhere.dof
    u = np.stack([result.error_map.u_gx, result.error_map.u_gy])
    assert nodes.u_rms == pytest.approx(np.sqrt((u**2).mean()), rel=1e-6)
    facts = " ".join(text for _, text in error_section(result).facts)
    shown = "> 100000" if how.get("terms") else f"{dof:.0f}"
    assert f"(k={k:.3g}, 95.45 %, {shown} degrees of freedom)" in facts
    assert f"(k={k:.3g})" in state_sentence(result)
    assert any(
        line.endswith(f"; U: k = {k:.3g} for 95.45 %")
        for line in provenance(result, MachineFrame())
    )
    (table,) = (
        section.table
        for chapter in chapters(result, None)
        for section in chapter.sections
        if section.title.startswith("Two kinds of U")
    )
    row = next(row for row in table if row[0] == "x or y, at the nodes")
    assert row[6] == f"{k:.2f}"
    said = float(re.search(r"U ([\d.]+) µm rms", facts)[1])
    assert float(row[3]) == pytest.approx(said, rel=0.02)


def test_what_is_known_beforehand_adds_degrees_of_freedom():
    with_it, without = calibrated(reference=REFERENCE), calibrated()
    noise, own = with_it.noise, without.noise
    assert (noise.dof_xy, own.dof_map_xy) == (own.dof_xy, own.dof_xy)
    u2 = np.mean(np.stack([with_it.error_map.u_gx, with_it.error_map.u_gy]) ** 2)
    artifact = with_it.artifact
    known = np.mean(np.stack([artifact.x_m, artifact.y_m]) ** 2) * 9e-12
    # GUM G.2b with one component of finite degrees of freedom
    assert noise.dof_map_xy == pytest.approx(
        own.dof_xy * (u2 / (u2 - known)) ** 2, rel=1e-9
    )
    assert noise.k_xy < own.k_xy


def test_a_term_that_its_size_holds_adds_degrees_of_freedom_and_one_that_is_told_does_not():
    held = calibrated(terms=parse_terms(["plate_shape:3e-9"], "")).noise
    told = calibrated(5, terms=parse_terms(["microscope:1e-2"], "")).noise
    assert held.dof_map_xy > held.dof_xy
    assert told.dof_map_xy == told.dof_xy


def test_an_assumed_eccentricity_adds_degrees_of_freedom_to_the_angles(monkeypatch):
    """By GUM G.2b, with the noise of the lines as the one component of finite degrees."""
    monkeypatch.setattr(equations, "DOUBT_LEVEL_OF_FEW", 0.0)
    settings = replace(SETTINGS, sigma_theta_rad=2e-6)
    result = calibrate(
        measured(settings=settings), Options(terms=parse_terms(["microscope"], ""))
    )
    u2 = np.mean(result.error_map.u_g_theta**2)
    parts = result.kept.angular
    assert {"line_eccentricity", "line_scale"} < set(parts)
    assumed = sum(np.mean(u**2) for u in parts.values())
    dof = result.noise.dof_theta * (u2 / (u2 - assumed)) ** 2
    assert 0.01 < assumed / u2 < 1
    assert result.noise.dof_map_theta == pytest.approx(dof, rel=1e-9)
    assert result.noise.k_theta == pytest.approx(student.ppf(0.97725, dof), rel=1e-12)
    assert next(
        b for b in budgets(result) if b.quantity == "theta"
    ).dof == pytest.approx(dof)


def test_declared_noise_has_a_budget_with_k_after_it_is_read():
    found = calibrated()
    declared = replace(
        found,
        noise=replace(
            found.noise,
            **dict.fromkeys(
                ("dof_xy", "dof_map_xy", "dof_theta", "dof_map_theta"), math.inf
            ),
        ),
    )
    again = result_from_dict(
        json.loads(json.dumps(plain(result_to_dict(declared)))), "r.json"
    )
    for budget in budgets(again):
        assert budget.k == pytest.approx(2.0, abs=1e-4)
        assert budget.U_rms == pytest.approx(2 * budget.u_rms, rel=1e-4)


def test_a_map_without_degrees_of_freedom_has_those_of_its_noise():
    result = calibrated(reference=REFERENCE)
    nan = float("nan")
    bare = replace(
        result, noise=replace(result.noise, dof_map_xy=nan, dof_map_theta=nan)
    )
    assert bare.noise.dof_of("xy") == result.noise.dof_xy == budgets(bare)[0].dof
    assert bare.noise.dof_of("theta") == result.noise.dof_theta
