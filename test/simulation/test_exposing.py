# SPDX-License-Identifier: Apache-2.0
"""Exposures of a simulated camera: all marks in the field, each where it lies on the plate."""

import numpy as np
import pytest
import yaml

from selfcal_ros.simulation.rendering import Exposure
from selfcal_ros.simulation.spec import read_simulation

SIM = {
    "plan": {
        "plan_id": "p",
        "artifact": {"grid_size": 3, "grid_pitch": 1e-4, "angular_count": 0},
        "views": [{"name": "a"}, {"name": "b", "rotation_deg": 90}],
    },
    "truth": {"g": 0.0, "a": 0.0, "t": 0.0, "phi": 0.0},
    "cell": {"servo_sigma": 0.0},
    "camera": {"width": 100, "height": 100, "mark_size": 3e-5},
}


def test_the_marks_around_lie_as_on_the_plate(tmp_path):
    """Without any error; the first mark of the serpentine is at a corner of the field."""
    (tmp_path / "sim.yaml").write_text(yaml.safe_dump(SIM))
    _, arrivals, _ = read_simulation(tmp_path / "sim.yaml").run()
    found = [event for _, event in arrivals if isinstance(event, Exposure)]
    assert len(found) == 18
    for event in (found[0], found[9]):
        assert event.offsets.min(axis=1) == pytest.approx([0, 0], abs=1e-12)
        assert event.offsets.max(axis=1) == pytest.approx([2e-4, 2e-4])
    assert found[0].angle == 0 and found[9].angle == pytest.approx(np.pi / 2)
