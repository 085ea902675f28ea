# SPDX-License-Identifier: Apache-2.0
"""What a result of the step diagonals says beside its numbers."""

import numpy as np
import pytest

from selfcal_ros.applications.laser.data import StepDiagonal
from selfcal_ros.applications.laser.identify import identify_ibaraki
from selfcal_ros.applications.laser.report import outcome
from test.support.laser import planar


@pytest.mark.parametrize(("steps", "blocks"), [((0.03, 0.04), 4), ((0.3, 0.4), 6)])
@pytest.mark.parametrize(
    ("ppm", "advised"),
    [(-2.02, True), (-1.98, False), (0.0, False), (1.98, False), (2.02, True)],
)
def test_the_laser_is_doubted_beyond_2_ppm_of_the_diagonal(steps, blocks, ppm, advised):
    """A perfect machine of 0.2 m and 3 m, all of whose readings are too long by one share."""
    exact = planar(steps, np.zeros((2, blocks, 2)))
    data = StepDiagonal(
        exact.steps_m,
        exact.diagonals,
        exact.samples_m * (1 + ppm * 1e-6),
        exact.linear_m,
    )
    off_um = ppm * np.hypot(*steps) * blocks
    expected = [
        f"the diagonals differ from those calculated from the linear errors by "
        f"{off_um:.3g} µm: the laser is off the machine's diagonal, or the linear errors "
        "are of another state of the machine"
    ]
    found = outcome(identify_ibaraki(data), data, warnings=["before"])
    assert found["warnings"] == ["before", *(expected if advised else [])]
    assert found["closure"]["lengths"] == pytest.approx(off_um * 1e-3, abs=1e-9)
