# SPDX-License-Identifier: Apache-2.0
"""The geometry that RViz shows of a map: signs, enlargement, colours, unknown sites."""

from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.model.artifact import Artifact
from selfcal_ros.nodes.filling import (
    CERTAIN,
    UNCERTAIN,
    UNKNOWN,
    enlargement,
    map_geometry,
)
from test.support.maps import random_map

PITCH = 0.01


def one_error(shape=(5, 5), at=(4, 1), g=(3e-7, -4e-7)):
    """Return a map whose only error is `g` at the site (i, j) `at`."""
    emap = random_map(Artifact(shape[0], PITCH, 8, shape[1]), 3)
    gx, gy = np.zeros(shape), np.zeros(shape)
    gx[at], gy[at] = g
    return replace(
        emap, gx=gx, gy=gy, u_gx=np.full(shape, 3e-9), u_gy=np.full(shape, 4e-9)
    )


def test_a_vector_points_from_the_nominal_site_along_the_error():
    shape = map_geometry(one_error())
    tails, heads = shape.ends[0::2], shape.ends[1::2]
    np.testing.assert_array_equal(tails, shape.sites)
    site = np.flatnonzero(np.any(heads != tails, axis=1))
    # m = 2, n = -1
    np.testing.assert_allclose(tails[site], [[0.02, -0.01, 0.0]], atol=1e-15)
    assert shape.factor == 20_000  # 0.5 um becomes the 10 mm of a pitch
    np.testing.assert_allclose(
        heads[site] - tails[site], [[6e-3, -8e-3, 0.0]], rtol=1e-12
    )
    assert shape.legend == (
        "stage error (indicated - true), enlarged 20,000 x, longest 0.5 um; dark: u = "
        "0.005 um (k=1)"
    )
    assert shape.legend_at[1] < shape.sites[:, 1].min()


@pytest.mark.parametrize(
    "longest, factor",
    [
        (0.9e-6, 10_000),
        (1e-6, 10_000),
        (1.1e-6, 5_000),
        (4e-6, 2_000),
        (5e-6, 2_000),
        (0.0, 1),
        (0.02, 1),
    ],
)
def test_the_enlargement_is_round_and_keeps_vectors_apart(longest, factor):
    assert enlargement(PITCH, longest) == pytest.approx(factor, rel=1e-12)


def test_the_colour_grows_darker_with_the_uncertainty():
    emap = one_error()
    emap.u_gx[0, 0] = emap.u_gy[0, 0] = 0.0
    emap.u_gx[4, 4] = np.nan
    emap.u_gx[2, 2], emap.u_gy[2, 2] = 6e-9, 8e-9
    colours = dict(
        zip(
            map(tuple, np.rint(map_geometry(emap).sites[:, :2] / PITCH).tolist()),
            map_geometry(emap).colours,
            strict=True,
        )
    )
    np.testing.assert_allclose(colours[-2, -2], CERTAIN)
    np.testing.assert_allclose(colours[0, 0], UNCERTAIN)
    np.testing.assert_allclose(colours[2, 2], UNKNOWN)
    np.testing.assert_allclose(colours[1, 1], np.add(CERTAIN, UNCERTAIN) / 2)


def test_unknown_sites_are_left_out():
    emap = random_map(Artifact(5, PITCH, 8), 3, unknown=((0, 0), (4, 2)))
    assert len(map_geometry(emap).sites) == 23


def test_a_map_without_any_site_is_an_empty_picture():
    shape = map_geometry(
        random_map(Artifact(3, PITCH, 8), 3, unknown=tuple(np.ndindex(3, 3)))
    )
    assert len(shape.sites) == len(shape.ends) == len(shape.colours) == 0


def test_a_large_and_oblong_field_is_thinned_evenly_about_its_centre():
    shape = map_geometry(random_map(Artifact(103, PITCH, 8, 5), 3))
    assert shape.spacing_m == pytest.approx(3 * PITCH)
    marks = np.rint(shape.sites[:, :2] / PITCH).astype(int)
    assert set(marks[:, 0]) == set(range(-51, 52, 3))
    assert set(marks[:, 1]) == {0}
