# SPDX-License-Identifier: Apache-2.0
"""The bag of a simulation is there as a whole, or not at all."""

import re

import pytest
import yaml

from selfcal_ros.bagio.offline import read_truth
from selfcal_ros.errors import InputError
from selfcal_ros.simulation.bag import write_simulation
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
    assert {path.name for path in place.iterdir()} == {"bag_0.mcap", "metadata.yaml", "truth.json"}
    assert list(place.parent.iterdir()) == [place]
    assert read_truth(place)["seed"] == 7
    with pytest.raises(InputError, match=f"^{place}: exists already; remove it or name another "
                                         "folder$"):
        write_simulation(simulation, place)


def test_a_place_where_no_folder_can_be_made_is_one_line(simulation, tmp_path):
    (tmp_path / "file").write_text("")
    place = tmp_path / "file" / "bag"
    with pytest.raises(InputError, match=f"^{re.escape(str(place))}: cannot be created "):
        write_simulation(simulation, place)
