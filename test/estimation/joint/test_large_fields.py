# SPDX-License-Identifier: Apache-2.0
"""Large fields: limits, a core that tells the rank, any number of threads.

The limits are lowered, so that small fields take the ways of large ones.
"""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from selfcal_ros.errors import InputError
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.joint import solve
from selfcal_ros.estimation.normal import equations
from selfcal_ros.estimation.observability import rank
from selfcal_ros.estimation.observability.rank import deficiency, identifies
from selfcal_ros.estimation.options import Options
from selfcal_ros.model.artifact import Artifact
from test.support.lattice_plans import plan_of
from test.support.truth import random_truth, simulate_measurements

ROOT = Path(__file__).parents[3]


@pytest.mark.parametrize(
    ("names", "identified"),
    [
        ("0,tx,ty", False),
        ("0,180,tx", False),
        ("0,90", False),
        ("0,90,180,270", False),
        ("0,90,tx", True),
    ],
)
def test_the_middle_of_a_large_plan_tells_what_the_whole_does(
    monkeypatch, names, identified
):
    plan, sizes = plan_of(names, Artifact(21, 0.005)), []
    assert identifies(plan.artifact, plan.views) == identified

    def counted(system):
        sizes.append(system.grid.n_sites)
        return deficiency(system)

    monkeypatch.setattr(rank, "FULL_SIZE", 9)
    monkeypatch.setattr(rank, "deficiency", counted)
    asked_anew = identifies.__wrapped__(plan.artifact, plan.views)
    assert asked_anew == identified
    assert not identified or sizes == [81]


def test_the_uncertainty_of_a_large_field_is_given_on_request(monkeypatch):
    rng, plan = np.random.default_rng(1), plan_of("0,90,tx", Artifact(11, 0.01))
    truth = random_truth(plan.artifact, len(plan.views), rng)
    readings = simulate_measurements(truth, plan, rng, sigma_m=2e-8)
    wanted = calibrate(readings, Options())
    monkeypatch.setattr(solve, "UNASKED_SITES", 11 * 11 - 1)
    plain, asked = (
        calibrate(readings, Options()),
        calibrate(readings, Options(uncertainty=True)),
    )
    assert "no_uncertainty" in [finding.name for finding in plain.findings]
    assert np.isnan(plain.error_map.u_gx).all()
    np.testing.assert_array_equal(plain.error_map.gx, wanted.error_map.gx)
    np.testing.assert_array_equal(asked.error_map.u_gx, wanted.error_map.u_gx)


def test_more_than_401_rows_of_marks_are_refused():
    assert Artifact(401, 0.001).shape == (401, 401)
    with pytest.raises(
        InputError,
        match=r"^artifact grid_size: 402 rows of marks are more than "
        r"401; use every other mark: half the rows, twice the pitch$",
    ):
        Artifact(402, 0.001)


SCRIPT = """
import hashlib, numpy as np
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.options import Options
from selfcal_ros.model.artifact import Artifact
from test.support.truth import hu_plan, random_truth, simulate_measurements
plan, rng = hu_plan(Artifact(61, 0.01, 24)), np.random.default_rng(0)
data = simulate_measurements(random_truth(plan.artifact, 4, rng), plan, rng, sigma_m=1e-8,
                             sigma_theta_rad=1e-7)
found = calibrate(data, Options()).error_map
parts = (found.gx, found.gy, found.g_theta, found.u_gx)
print(hashlib.sha256(b"".join(part.tobytes() for part in parts)).hexdigest())
"""


def test_the_number_of_threads_changes_no_bit(capsys):
    """Here with one thread and in a process with several."""
    equations.system_of.cache_clear()
    with threadpool_limits(1):
        exec(SCRIPT, {})
    alone = capsys.readouterr().out
    several = subprocess.run(
        [sys.executable, "-c", SCRIPT],
        text=True,
        capture_output=True,
        check=True,
        cwd=ROOT,
        env={**os.environ, "OPENBLAS_NUM_THREADS": "5"},
    ).stdout
    assert several == alone
