# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import numpy as np
import pytest

from selfcal_ros.applications.laser.report import truth_of
from selfcal_ros.applications.laser.simulation import SetUp, simulation_from_dict
from selfcal_ros.errors import InputError
from selfcal_ros.files import read_yaml

CONFIG = Path(__file__).parents[3] / "config" / "step_diagonal"


@pytest.mark.parametrize(
    "path", sorted(CONFIG.glob("*.yaml")), ids=lambda path: path.name
)
def test_every_example_is_read(path):
    simulation = simulation_from_dict(read_yaml(path), path.name)
    assert simulation.machine.n_blocks == 6
    assert simulation.measurement.noise.repeats == 3
    assert set(simulation.measurement.setups) in (
        {"pp", "np"},
        {"ppp", "npp", "pnp", "ppn"},
    )


def test_units_and_places_of_every_key():
    simulation = simulation_from_dict(
        {
            "machine": {
                "steps_mm": [10, 5],
                "stacked": True,
                "ex_y": [0.1, 0.2, 0.7],
                "ey_y": [0.3, 0.4, 0.8],
                "turns_urad": {"y": [[1, 2, 3], [4, 5, 6], [7, 8, 9]]},
            },
            "setups": {
                "np": {
                    "laser_mrad": [1],
                    "mirror_mrad": [-2],
                    "to_machine": False,
                    "abbe_mm": [1, 2, 3],
                    "scale_ppm": 0.5,
                }
            },
            "noise": {"distance_nm": 1, "reading_nm": 2, "linear_nm": 3, "repeats": 4},
        },
        "s",
    )
    machine, setup = simulation.machine, simulation.measurement.setups["np"]
    assert machine.steps_m == pytest.approx((0.01, 0.005)) and machine.stacked
    np.testing.assert_allclose(
        machine.errors_m[1], [[1e-7, 3e-7], [2e-7, 4e-7], [7e-7, 8e-7]]
    )
    assert not machine.errors_m[0].any() and not machine.turns_rad[0].any()
    assert machine.turns_rad.shape == (2, 3, 3)  # axes, blocks, components
    np.testing.assert_allclose(
        machine.turns_rad[1], 1e-6 * np.arange(1, 10).reshape(3, 3)
    )
    assert setup.laser_rad == pytest.approx(
        (1e-3,)
    ) and setup.mirror_rad == pytest.approx((-2e-3,))
    assert not setup.to_machine and setup.scale == pytest.approx(5e-7)
    assert setup.abbe_m == pytest.approx((1e-3, 2e-3, 3e-3))
    noise = simulation.measurement.noise
    assert (noise.distance_m, noise.reading_m, noise.linear_m) == pytest.approx(
        (1e-9, 2e-9, 3e-9)
    )
    assert noise.repeats == 4


def test_a_setup_without_keys_is_aligned_exactly():
    simulation = simulation_from_dict(
        {"setups": {"pp": {}}, "machine": {"steps_mm": [10, 5], "ex_x": [0.0]}}, "s"
    )
    assert simulation.measurement.setups == {"pp": SetUp((0.0,), (0.0,))}


def test_the_seed_draws_the_machine():
    drawn = [
        simulation_from_dict(
            {
                "seed": seed,
                "machine": {"steps_mm": [10, 10], "blocks": 3, "sigma_um": 0.2},
            },
            "s",
        ).machine
        for seed in (1, 1, 2)
    ]
    np.testing.assert_array_equal(drawn[0].errors_m, drawn[1].errors_m)
    assert (drawn[0].errors_m != drawn[2].errors_m).any()
    assert drawn[0].errors_m.shape == (2, 3, 2)


def test_the_truth_of_the_case_study():
    truth = truth_of(simulation_from_dict({}, "s").machine)
    assert truth["squareness"] == pytest.approx(-1.22e-3)
    assert truth["straightness_x"] == pytest.approx(0.05e-3)
    assert truth["straightness_y"] == pytest.approx(0.11e-3)
    assert sum(truth["ex_x"]) == pytest.approx(1.14e-3) and truth["ey_x"][0] == 0
    assert not any(key.startswith("u_") for key in truth)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ([], "s: not a mapping of keys to values"),
        (
            {"sed": 1},
            "s: sed: unknown key; did you mean 'seed'? known are seed, machine",
        ),
        ({"seed": -1}, "s: seed: -1 is negative"),
        ({"machine": "other"}, "s: machine: not a mapping"),
        ({"machine": {}}, "machine: the key 'steps_mm' is missing"),
        ({"machine": {"steps_mm": [10, -1]}}, "a step is not positive"),
        ({"machine": {"steps_mm": [10, "a"]}}, "'a' is not a number"),
        (
            {"machine": {"steps_mm": [1, 1], "blocks": 0}},
            "blocks: 0 is not a whole number from 1",
        ),
        (
            {"machine": {"steps_mm": [1, 1], "sigma_um": -1}},
            "sigma_um: -1.0 is not a number from 0",
        ),
        (
            {"machine": {"steps_mm": [1, 1], "ex_x": [1], "blocks": 1}},
            "both listed and drawn",
        ),
        (
            {"machine": {"steps_mm": [1, 1], "ex_x": [1], "ey_y": [1, 2]}},
            "different lengths [1, 2]",
        ),
        (
            {"machine": {"steps_mm": [1, 1], "ez_x": [1]}},
            "ez_x: the machine has 2 steps only",
        ),
        ({"machine": {"steps_mm": [1, 1], "ex_x": 3}}, "ex_x: 3 is not of type list"),
        (
            {"machine": {"steps_mm": [1, 1], "stacked": 1}},
            "stacked: 1 is not of type bool",
        ),
        (
            {"machine": {"steps_mm": [1, 1], "ex_x": [0], "turns_urad": {"x": [1, 2]}}},
            "turns_urad: x: not 1 rotation vectors",
        ),
        (
            {"setups": {"ppp": {}}},
            "setups: ppp: unknown key; did you mean 'pp'? known are pp, np",
        ),
        ({"setups": {"pp": {"laser_mrad": 1}}}, "laser_mrad: 1 is not of type list"),
        ({"setups": {"pp": {"to_machine": "no"}}}, "'no' is not of type bool"),
        (
            {"noise": {"distance_nm": float("nan")}},
            "distance_nm: nan is not a number from 0",
        ),
        (
            {"noise": {"linear_nm": 10**30}},
            "is not a number from 0; give one within +-1e+09",
        ),
        ({"machine": {"steps_mm": [1e300, 1]}}, "1e+300 is not a number"),
        (
            {"noise": {"repeats": 1001}},
            "repeats: 1001 is not a whole number from 1 to 1000",
        ),
        (
            {"setups": {"pp": {"laser_mrad": []}}},
            "laser_mrad: [] is not a list of 1 numbers",
        ),
        (
            {"machine": {"steps_mm": [1, 1], "ex_x": []}},
            "ex_x: [] is not a list of 1 to 500 numbers",
        ),
        ({"noise": {"repeats": 1.5}}, "repeats: 1.5 is not of type int"),
    ],
)
def test_what_is_wrong_is_named(data, message):
    with pytest.raises(InputError) as caught:
        simulation_from_dict(data, "s")
    assert message in str(caught.value) and "\n" not in str(caught.value)
