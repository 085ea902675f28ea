# SPDX-License-Identifier: Apache-2.0
"""SIM.yaml: what it may say, what it must say, and that a seed gives the same messages."""

import numpy as np
import pytest
import yaml

from selfcal_ros.errors import InputError
from selfcal_ros.model.readings import Sense
from selfcal_ros.simulation.spec import read_simulation

PLAN = {"plan_id": "p", "artifact": {"grid_size": 5, "grid_pitch": 0.01, "angular_count": 4},
        "views": [{"name": "a"}, {"name": "b", "rotation_deg": 90}]}


def simulation(folder, data):
    path = folder / "sim.yaml"
    path.write_text(data if isinstance(data, str) else yaml.safe_dump(data))
    return read_simulation(path)


def test_a_plan_alone_is_a_simulation(tmp_path):
    made = simulation(tmp_path, {"plan": PLAN})
    assert (made.seed, made.compression, made.start_ns) == (0, "zstd", 1_700_000_000_000_000_000)
    assert made.settings.sense is Sense.MICROSCOPE_MOVES
    assert [view.name for view in made.plan.views] == ["a", "b"]
    truth, arrivals, ledger = made.run()
    assert ledger == {}
    assert len(truth.phi_rad) == 2
    assert len(arrivals) > 100


def test_every_key_reaches_its_place(tmp_path):
    (tmp_path / "plan.yaml").write_text(yaml.safe_dump(PLAN))
    made = simulation(tmp_path, {
        "plan": "plan.yaml", "seed": 5, "truth": {"g": 1e-6, "phi": 0.0},
        "noise": {"sigma_xy": 1e-8, "sigma_theta": 2e-6}, "start_time": 12.5, "compression": "lz4",
        "cell": {"sense": "plate_moves", "encoder_rate": 1000, "with_ids": False,
                 "exposure_period": 0.02, "declare_sigma": True, "servo_sigma": 0.0},
        "faults": {"lost": 0.1, "delay": 0.2, "clock_step_s": 0.3}})
    assert (made.seed, made.start_ns, made.compression) == (5, 12_500_000_000, "lz4")
    assert (made.spread.g_m, made.spread.phi_rad, made.spread.a_m) == (1e-6, 0.0, 0.3e-6)
    cell = made.settings
    assert (cell.sense, cell.encoder_rate_hz, cell.with_ids, cell.exposure_period_s) == (
        Sense.PLATE_MOVES, 1000, False, 0.02)
    assert (cell.sigma_xy_m, cell.sigma_theta_rad, cell.declare_sigma) == (1e-8, 2e-6, True)
    assert (made.faults.lost, made.faults.delay_s, made.faults.clock_step_s) == (0.1, 0.2, 0.3)


def test_a_seed_gives_the_same_messages(tmp_path):
    data = {"plan": PLAN, "noise": {"sigma_xy": 1e-8}, "faults": {"lost": 0.1, "delay": 0.1}}
    first, again, other = (simulation(tmp_path, {**data, "seed": seed}).run()
                           for seed in (1, 1, 2))
    np.testing.assert_array_equal(first[0].g, again[0].g)
    assert first[1:] == again[1:]
    assert first[1] != other[1]


@pytest.mark.parametrize(("data", "message"), [
    ("[1]", "sim.yaml: not a mapping; see docs/simulate.md"),
    ({}, "sim.yaml: the key 'plan' is missing; name a PLAN.yaml"),
    ({"plan": PLAN, "sed": 1}, "sim.yaml: sed: unknown key; known are cell, compression"),
    ({"plan": "no.yaml"}, "no.yaml: no such file; check the path"),
    ({"plan": {**PLAN, "views": []}}, "sim.yaml: plan: the plan has no views; add at least one"),
    ({"plan": PLAN, "compression": "gzip"}, "compression: 'gzip' is not known; choose zstd, lz4"),
    ({"plan": PLAN, "truth": {"gx": 1}}, "sim.yaml: truth: gx: unknown key; known are g, a, "),
    ({"plan": PLAN, "truth": 5}, "sim.yaml: truth: not a mapping; see docs/simulate.md"),
    ({"plan": PLAN, "noise": {"sigma_xy": "1 um"}}, "sigma_xy: '1 um' is not a number; mend"),
    ({"plan": PLAN, "cell": {"sense": "both"}}, "cell: sense: 'both' is not known; choose one of "),
    ({"plan": PLAN, "faults": {"lots": 0.1}}, "faults: lots: unknown key; known are lost, "),
    ({"plan": PLAN, "cell": {"encoder_rate": 100}}, "simulated cell: 100 Hz gives fewer than 2.5"),
])
def test_what_is_refused_and_how(tmp_path, data, message):
    with pytest.raises(InputError) as caught:
        simulation(tmp_path, data)
    assert message in str(caught.value)
