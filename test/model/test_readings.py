# SPDX-License-Identifier: Apache-2.0
"""What readings say of themselves where nothing was read."""

import math

from selfcal_ros.model.readings import ViewReadings
from selfcal_ros.model.view import View


def test_a_view_of_which_nothing_was_read_holds_nothing():
    nothing = ViewReadings(View("v"))
    assert (nothing.used, nothing.dof_xy, nothing.dof_theta, nothing.rejected) == (0, 0, 0, {})
    assert math.isnan(nothing.sigma_xy) and math.isnan(nothing.sigma_theta)
    assert nothing.visits is None
    for values in (nothing.m, nothing.n, nothing.dx, nothing.dy, nothing.count, nothing.u,
                   nothing.k, nothing.dtheta, nothing.count_theta, nothing.u_theta):
        assert values.shape == (0,)
