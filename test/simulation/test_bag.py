# SPDX-License-Identifier: Apache-2.0
"""The bag of a simulation is there as a whole, or not at all."""

import json
import re

import numpy as np
import pytest
import yaml

from selfcal_ros.bagio.offline import read_truth
from selfcal_ros.errors import InputError
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.simulation.bag import write_simulation, write_truth
from selfcal_ros.simulation.machine import random_truth
from selfcal_ros.simulation.spec import read_simulation
from test.support.sessions import plan_file, small_plan


@pytest.fixture
def simulation(tmp_path):
    plan_file(tmp_path, small_plan("0", repeats=1))
    (tmp_path / "sim.yaml").write_text(yaml.safe_dump({"plan": "plan.yaml", "seed": 7}))
    return read_simulation(tmp_path / "sim.yaml")


def test_what_is_broken_off_leaves_nothing(simulation, tmp_path):
    place = tmp_path / "made" / "bag"
    seen = []

    def progress(done, total):
        seen.append(place.exists())
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_simulation(simulation, place, progress=progress)
    assert seen == [False]
    assert list(place.parent.iterdir()) == []


def test_the_whole_bag_has_its_name(simulation, tmp_path):
    place = tmp_path / "made" / "bag"
    assert sum(write_simulation(simulation, place).values()) > 0
    assert {path.name for path in place.iterdir()} == {
        "bag_0.mcap",
        "metadata.yaml",
        "truth.json",
    }
    assert list(place.parent.iterdir()) == [place]
    assert read_truth(place)["seed"] == 7
    with pytest.raises(
        InputError, match=f"^{place}: exists already; remove it or name another folder$"
    ):
        write_simulation(simulation, place)


def test_a_place_where_no_folder_can_be_made_is_one_line(simulation, tmp_path):
    (tmp_path / "file").write_text("")
    place = tmp_path / "file" / "bag"
    with pytest.raises(
        InputError, match=f"^{re.escape(str(place))}: cannot be created "
    ):
        write_simulation(simulation, place)


def test_each_part_of_the_truth_is_written_under_its_name(tmp_path):
    truth = random_truth(Artifact(5, 0.01), 2, np.random.default_rng(3))
    write_truth(tmp_path / "truth.json", truth)
    written = json.loads((tmp_path / "truth.json").read_text())
    assert (
        np.abs(truth.a[0] - truth.a[1]).max()
        > 0
        < np.abs(truth.g[0] - truth.g[1]).max()
    )
    for name, value in (
        ("gx", truth.g[0]),
        ("gy", truth.g[1]),
        ("ax", truth.a[0]),
        ("ay", truth.a[1]),
        ("phi", truth.phi_rad),
        ("t", truth.t_m),
    ):
        np.testing.assert_array_equal(written[name], value)
