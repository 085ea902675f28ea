# SPDX-License-Identifier: Apache-2.0
"""Parts of a field in the modes of the datum and of first order, over the known sites alone."""

import numpy as np
import pytest

from selfcal_ros.estimation.lattice.connectivity import Gauge

SHAPE = (5, 9)


def place():
    """Return positions (nx, ny) in units of the longer half width, and which sites count."""
    x, y = np.meshgrid(np.arange(-2, 3) / 4, np.arange(-4, 5) / 4, indexing="ij")
    known = np.random.default_rng(4).random(SHAPE) < 0.8
    return x, y, known


def o_and_r(gauge, field):
    """Return O and R of a field, times the half width."""
    return tuple(np.vdot(rows, field).real for rows in gauge.shear)


def test_nonorthogonality_and_scale_difference_are_those_of_the_known_sites():
    """Gx = O y + R x, Gy = O x - R y beside a shift, a turn and a scale; nonsense elsewhere."""
    x, y, known = place()
    field = (3e-7 * y - 2e-7 * x) + 1j * (3e-7 * x + 2e-7 * y)
    field += 5e-6 - 4e-6j + (7e-6 + 8e-6j) * (x + 1j * y)
    field[~known] = 1.0
    o, r = o_and_r(Gauge(x + 1j * y, known, scale=True), field)
    assert (o, r) == (pytest.approx(3e-7, rel=1e-8), pytest.approx(-2e-7, rel=1e-8))


def test_first_order_parts_of_any_field_are_those_of_a_dense_least_squares():
    x, y, known = place()
    gx, gy = np.random.default_rng(5).normal(0, 1e-7, (2, *SHAPE))
    one, none = np.ones(SHAPE), np.zeros(SHAPE)
    columns = [(one, none), (none, one), (-y, x), (x, y), (y, x), (x, -y)]
    design = np.array([np.concatenate([a[known], b[known]]) for a, b in columns]).T
    want = np.linalg.lstsq(design, np.concatenate([gx[known], gy[known]]), rcond=None)[
        0
    ]
    gauge = Gauge(x + 1j * y, known, scale=True)
    assert o_and_r(gauge, gx + 1j * gy) == pytest.approx(tuple(want[4:]), abs=1e-20)
