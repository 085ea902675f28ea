# SPDX-License-Identifier: Apache-2.0
"""A step that no stage has is asked about, however long the others are."""

import pytest

from selfcal_ros.compensation.plausible import require_plausible_line
from selfcal_ros.errors import InputError


def test_a_short_step_is_judged_by_its_own_length():
    """1 % of a distance, at least 1 µm: 900 µm over 100 mm are possible, 50 µm over 0.1 mm not."""
    require_plausible_line([0.0, 0.1], [0.0, 9e-4], "line.csv")
    with pytest.raises(InputError, match=r"changes by 50 µm within 0\.1 mm"):
        require_plausible_line([0.0, 0.1, 0.1001], [0.0, 9e-4, 9.5e-4], "line.csv")
