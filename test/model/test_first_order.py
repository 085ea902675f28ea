# SPDX-License-Identifier: Apache-2.0
"""O and R of a map (Hu eq. 6)."""

import numpy as np
import pytest

from selfcal_ros.estimation.lattice.connectivity import Gauge
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.error_map import first_order


@pytest.mark.parametrize("artifact", [Artifact(5, 0.01), Artifact(9, 0.003, 0, 4)])
def test_o_and_r_are_found_beside_motion_and_scale(artifact):
    x, y = artifact.x_m, artifact.y_m
    gx = 4e-6 * y + 3e-6 * x + 1e-5 * x - 2e-5 * y + 1e-6
    gy = 4e-6 * x - 3e-6 * y + 1e-5 * y + 2e-5 * x - 2e-6
    gx[0, 0] = gy[0, 0] = np.nan
    assert first_order(artifact, np.stack([gx, gy])) == pytest.approx(
        (4e-6, 3e-6), rel=1e-9
    )


@pytest.mark.parametrize("known", [np.s_[:, 2], np.s_[1:3, 1:2], np.s_[:, :]])
def test_they_are_those_of_the_equations_where_few_sites_are_known(known):
    artifact = Artifact(5, 0.01)
    g_m = np.full((2, 5, 5), np.nan)
    g_m[:, *known] = np.random.default_rng(2).normal(0, 1e-7, (2, 5, 5))[:, *known]
    z = (artifact.x_m + 1j * artifact.y_m) / 0.02
    rows = Gauge(z, np.isfinite(g_m[0]), scale=True).shear
    field = np.nan_to_num(g_m[0] + 1j * g_m[1])
    by_equations = np.real(rows.conj() * field).sum(axis=(1, 2)) / 0.02
    assert first_order(artifact, g_m) == pytest.approx(by_equations, rel=1e-6)
