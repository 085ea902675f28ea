# SPDX-License-Identifier: Apache-2.0
"""Large fields, iterated or with a core that tells the rank: the same answers as small ones.

The limits of size are lowered, so that small fields take the ways of large ones.
"""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from selfcal_ros.errors import InputError, NotIdentifiableError
from selfcal_ros.estimation.api import calibrate, robust_calibrate
from selfcal_ros.estimation.joint import pcg
from selfcal_ros.estimation.normal import equations, systems
from selfcal_ros.estimation.normal.grid import GridSystem
from selfcal_ros.estimation.normal.systems import planned_system
from selfcal_ros.model.artifact import Artifact
from test.support.lattice_plans import in_datum, measured_in_datum, plan_of
from test.support.options import BARE, bare
from test.support.truth import hu_plan, random_truth, simulate_measurements

EXACT = 1e-12
ROOT = Path(__file__).parents[3]


def measured(plan, seed=1, **how):
    rng = np.random.default_rng(seed)
    truth = random_truth(plan.artifact, len(plan.views), rng)
    return truth, simulate_measurements(truth, plan, rng, **how)


def test_a_full_plate_needs_no_correction_for_missing_marks_and_a_site_that_lost_some_does():
    views = plan_of("0,90,tx", Artifact(7, 0.01)).views
    full = planned_system(Artifact(7, 0.01), views).grid
    assert np.abs(pcg.missing_mark_correction(full)).max() < 1e-15
    weight = full.weight.copy()
    weight[0, 2, 3] = 0.0  # in view 0 mark and site have one place
    found = pcg.missing_mark_correction(GridSystem(full.views.poses, weight))
    assert found[2, 3] == found.max() > 0.1 and found.min() >= 0


@pytest.fixture
def as_large(monkeypatch):
    """Return a call from which on every field counts as a large one."""
    def lower():
        monkeypatch.setattr(equations, "DIRECT_SITES", 0)
        monkeypatch.setattr(equations, "CORE", 9)
        systems.clear_cache()

    yield lower
    systems.clear_cache()


def same(a, b, tolerance):
    return np.array_equal(np.isnan(a), np.isnan(b)) and not np.nanmax(np.abs(a - b)) > tolerance


@pytest.mark.parametrize("missing", [0.0, 0.1])
def test_iterated_fields_have_the_map_of_factorised_ones(as_large, missing):
    _, readings = measured(hu_plan(Artifact(51, 0.002, 24)), sigma_m=2e-8, sigma_theta_rad=1e-7,
                           missing=missing)
    options = bare(uncertainty=False)
    direct = calibrate(readings, options)
    as_large()
    iterated = calibrate(readings, options)
    assert iterated.extra["solver"]["method"] == "conjugate gradients"
    assert iterated.extra["solver"]["relative_residual"] < 1e-11
    assert iterated.extra["solver"]["iterations"] < (150 if missing else 40)
    assert iterated.observability == direct.observability
    assert same(iterated.error_map.gx, direct.error_map.gx, 1e-15)
    assert same(iterated.error_map.g_theta, direct.error_map.g_theta, 1e-15)
    assert iterated.noise.sigma_xy == pytest.approx(direct.noise.sigma_xy, rel=1e-9)


def test_iteration_takes_fields_in_pieces(as_large):
    """With a fifth of three views missing, sites are cut off that nothing determines."""
    as_large()
    truth, readings = measured_in_datum(
        plan_of("0,90,tx", Artifact(51, 0.002)), 1,
        lambda some: calibrate(some, BARE).error_map.valid, missing=0.2)
    found = calibrate(readings, BARE)
    valid = found.error_map.valid
    assert 0.9 < valid.mean() < 1 and found.extra["solver"]["iterations"] < 150
    assert np.nanmax(np.abs(found.error_map.gx - truth.g[0])) < EXACT
    assert np.isnan(found.error_map.u_gx).all()
    assert found.findings[0].name == "no_uncertainty"
    single = [len(finding.details["sites"]) for finding in found.findings
              if finding.name == "unchecked"]
    assert single == [found.observability.unchecked_sites] and single[0] > 0


@pytest.mark.parametrize(("missing", "steps"), [(0.0, 26), (0.03, 42), (0.2, 112)])
def test_the_number_of_steps_does_not_grow_with_the_field(as_large, missing, steps):
    as_large()
    for size in (31, 91):
        _, readings = measured(plan_of("0,90,tx", Artifact(size, 0.002)), missing=missing)
        solver = calibrate(readings, bare(uncertainty=False)).extra["solver"]
        assert solver["iterations"] <= steps


def test_uneven_weights_are_factorised_or_iterated_to_the_truth(as_large, monkeypatch):
    truth, readings = measured(plan_of("0,90,tx,ty", Artifact(31, 0.002)), missing=0.03)
    readings = replace(readings, views=tuple(
        replace(view, count=1 + np.arange(len(view.m)) % 3) for view in readings.views))
    as_large()
    factorised = calibrate(readings, BARE)
    assert factorised.extra["solver"]["method"] == "multifrontal"
    monkeypatch.setattr(equations, "UNEVEN_SITES", 0)
    systems.clear_cache()
    iterated = calibrate(readings, BARE)
    assert iterated.extra["solver"]["method"] == "conjugate gradients"
    for found in (factorised.error_map, iterated.error_map):
        expected = in_datum(truth.g, found.valid, readings.artifact, scale=True)
        assert np.nanmax(np.abs(found.gx - expected[0])) < EXACT


def test_an_iteration_that_stalls_says_so(as_large, monkeypatch):
    _, readings = measured(hu_plan(Artifact(21, 0.002)), sigma_m=1e-8)
    as_large()
    monkeypatch.setattr(pcg, "MAX_ITERATIONS", 3)
    with pytest.raises(InputError, match=r"^weights: the residual stays at .* after 3 iterations"):
        calibrate(readings, BARE)


@pytest.mark.parametrize(("names", "missing"), [
    ("0,tx,ty", 0.0), ("0,180,tx", 0.0), ("0,90", 0.0), ("0,90,180,270", 0.0), ("0,tx,ty", 0.05)])
def test_deficient_plans_are_refused_at_any_size(as_large, names, missing):
    _, readings = measured(plan_of(names, Artifact(21, 0.005)), missing=missing)
    with pytest.raises(NotIdentifiableError) as small:
        calibrate(readings, BARE)
    as_large()
    with pytest.raises(NotIdentifiableError) as large:
        calibrate(readings, BARE)
    assert large.value.observability == small.value.observability


def test_the_core_of_a_large_field_tells_its_rank_alone(as_large):
    """Uncertainty and robust estimate of a field of which only a core was ranked."""
    _, readings = measured(hu_plan(Artifact(21, 0.005, 24)), sigma_m=2e-8, sigma_theta_rad=1e-7)
    wanted = bare(uncertainty=True)
    small, weighed = calibrate(readings, wanted), robust_calibrate(readings, wanted)
    as_large()
    large = calibrate(readings, wanted)
    assert large.extra["solver"]["method"] == "multifrontal"
    for name in ("gx", "gy", "g_theta", "u_gx", "u_gy", "u_g_theta"):
        a, b = getattr(small.error_map, name), getattr(large.error_map, name)
        assert same(a, b, 1e-9 * np.nanmax(np.abs(a))), name
    assert large.observability == small.observability
    again = robust_calibrate(readings, wanted)
    assert same(again.error_map.gx, weighed.error_map.gx, 1e-15)


SCRIPT = """
import hashlib, numpy as np
from selfcal_ros.estimation.normal import systems, equations
from selfcal_ros.estimation.normal.grid import GridSystem
from selfcal_ros.estimation.normal.systems import planned_system
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.options import Options
from selfcal_ros.model.artifact import Artifact
from test.support.truth import hu_plan, random_truth, simulate_measurements
plan, rng = hu_plan(Artifact(61, 0.01, 24)), np.random.default_rng(0)
data = simulate_measurements(random_truth(plan.artifact, 4, rng), plan, rng, sigma_m=1e-8,
                             sigma_theta_rad=1e-7)
for limit in (equations.DIRECT_SITES, 0):
    equations.DIRECT_SITES = equations.MAX_DIRECT_SITES = limit
    systems.clear_cache()
    found = calibrate(data, Options(uncertainty=None if limit else False)).error_map
    parts = (found.gx, found.gy, found.g_theta, found.u_gx)
    print(hashlib.sha256(b"".join(part.tobytes() for part in parts)).hexdigest())
"""


def test_the_number_of_threads_changes_no_bit(monkeypatch, capsys):
    """Factorised and iterated, here with one thread and in a process with several."""
    for name in ("DIRECT_SITES", "MAX_DIRECT_SITES"):  # which are set back afterwards
        monkeypatch.setattr(equations, name, getattr(equations, name))
    with threadpool_limits(1):
        exec(SCRIPT, {})
    systems.clear_cache()
    alone = capsys.readouterr().out
    several = subprocess.run([sys.executable, "-c", SCRIPT], text=True, capture_output=True,
                             check=True, cwd=ROOT,
                             env={**os.environ, "OPENBLAS_NUM_THREADS": "5"}).stdout
    assert len(set(alone.split())) == 2
    assert several == alone
