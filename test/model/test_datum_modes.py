# SPDX-License-Identifier: Apache-2.0
"""Slopes of the XY error along the four half axes, as numbers and as rows over the sites."""

import numpy as np
import pytest

from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.error_map import half_axis_slopes, slope_rows

PLATE = Artifact(9, 0.005, 8, 7)  # rectangular


def half_axes(artifact):
    """Return the sites (i, j) of +X, +Y, -X, -Y, and which component counts with which sign."""
    hx, hy = artifact.half
    return [
        ([(i, hy) for i in range(hx + 1, 2 * hx + 1)], 1, 1),
        ([(hx, j) for j in range(hy + 1, 2 * hy + 1)], 0, -1),
        ([(i, hy) for i in range(hx)], 1, 1),
        ([(hx, j) for j in range(hy)], 0, -1),
    ]


def slopes_of(artifact, g, known):
    """Return the slopes by numpy's polynomial fit over the sites that are known."""
    out = []
    for sites, component, sign in half_axes(artifact):
        at = [site for site in sites if known[site]]
        along = [(artifact.x_m if component else artifact.y_m)[site] for site in at]
        out.append(sign * np.polyfit(along, [g[component][site] for site in at], 1)[0])
    return np.array(out)


def test_a_turned_field_turns_every_half_axis():
    g = 2e-6 * np.stack([-PLATE.y_m, PLATE.x_m]) + 1e-3
    assert half_axis_slopes(PLATE, g) == pytest.approx(4 * [2e-6], rel=1e-9)


def test_slopes_are_those_of_a_straight_line_through_each_half_axis():
    g = np.random.default_rng(5).normal(size=(2, *PLATE.shape, 3))
    found = half_axis_slopes(PLATE, g)
    assert found.shape == (4, 3)
    everywhere = np.ones(PLATE.shape, dtype=bool)
    for column in range(3):
        assert found[:, column] == pytest.approx(
            slopes_of(PLATE, g[..., column], everywhere), rel=1e-9
        )


def test_a_half_axis_of_one_site_has_no_slope():
    assert np.isnan(half_axis_slopes(Artifact(3, 0.01, 8), np.ones((2, 3, 3)))).all()


def test_rows_give_the_slopes_over_the_sites_that_are_known():
    rng = np.random.default_rng(6)
    g, known = rng.normal(size=(2, *PLATE.shape)), np.ones(PLATE.shape, dtype=bool)
    known[6, 3] = known[4, 5] = False  # one of four sites on +X, one of three on +Y
    rows = slope_rows(PLATE.x_m + 1j * PLATE.y_m, known)
    field = np.where(known, g[0] + 1j * g[1], 7.0)
    found = np.real(np.conj(rows) * field).sum(axis=(1, 2))
    assert found == pytest.approx(slopes_of(PLATE, g, known), rel=1e-9)


def test_half_axes_with_less_than_two_known_sites_have_rows_of_zeros():
    known = np.ones(PLATE.shape, dtype=bool)
    known[:3, 3] = False  # leaves one site on -X
    rows = slope_rows(PLATE.x_m + 1j * PLATE.y_m, known)
    assert [bool(row.any()) for row in rows] == [True, True, False, True]
