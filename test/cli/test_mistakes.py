# SPDX-License-Identifier: Apache-2.0
"""What newcomers type wrong gets one line with the remedy, and the documented exit code."""

import pytest

from selfcal_ros.errors import InputError
from selfcal_ros.model.plan_form import plan_from_dict
from tools.mistakes import MISTAKES, wrong


def test_every_mistake_is_answered():
    assert len(MISTAKES) >= 83 and len(
        {mistake.command for mistake in MISTAKES}
    ) == len(MISTAKES)
    assert not wrong()


@pytest.mark.parametrize(
    ("turn", "asked"),
    [
        (1.5708, 90),
        (3.14159265, 180),
        (-1.571, -90),
        (6.283, 360),
        (1.5, 0),
        (90, 0),
        (1.6, 0),
        (0, 0),
        (7.854, 0),
    ],
)
def test_a_turn_in_rad_is_asked_about(turn, asked):
    plan = {
        "plan_id": "p",
        "artifact": {"grid_size": 5, "grid_pitch": 0.01, "angular_count": 0},
        "views": [{"name": "a", "rotation_deg": turn}],
    }
    if not asked:
        plan_from_dict(plan, "p.yaml")
        return
    with pytest.raises(InputError, match=rf"is it in rad\?; give {asked} for "):
        plan_from_dict(plan, "p.yaml")
