# SPDX-License-Identifier: Apache-2.0
"""What a result keeps for the covariances of its maps: as JSON and back, and damaged."""

import json

import numpy as np
import pytest

from selfcal_ros.model.kept import (
    Covariance,
    Factors,
    ImagesKept,
    Kept,
    SlowKept,
    kept_from_dict,
)

MAP, PLATE, LINES = (3, 2), (4, 5), 6
RNG = np.random.default_rng(1)
FULL = Kept(
    Factors(
        ("drift", "slip"),
        RNG.normal(size=(2, 2, *MAP)),
        {
            "plate": RNG.normal(size=(3, 2, *PLATE)),
            "lines": RNG.normal(size=(3, 2, LINES)),
            "microscope": RNG.normal(size=(3, 4)),
        },
        1,
        RNG.random((2, *PLATE)),
        ("line_scale", "line_scale"),
    ),
    {"drift": RNG.random(LINES)},
    RNG.random(2),
    ImagesKept(
        0.25,
        80.0,
        (0, 0, 1),
        ((0, 0), (1, -1), (0, 0)),
        SlowKept(0.75, 0.0, 0.4),
    ),
    {"xy": Covariance.of(np.array([[4.0, 1.0], [1.0, 2.0]]) * 1e-18)},
)


def test_json_keeps_all_of_it_to_the_last_bit():
    data = json.loads(json.dumps(FULL.to_dict()))
    found = kept_from_dict(data, MAP, PLATE, LINES)
    assert found.to_dict() == data
    assert found.images == FULL.images and found.factors.terms == FULL.factors.terms
    assert found.factors.with_map == 1
    assert found.factors.beside_terms == ("line_scale", "line_scale")
    del data["covariance_terms"]["beside"]["terms"]  # as older files
    del data["images"]["motion"]
    assert kept_from_dict(data, MAP, PLATE, LINES).images.motion is None
    assert kept_from_dict(data, MAP, PLATE, LINES).factors.beside_terms == ()
    np.testing.assert_array_equal(found.factors.of_map, FULL.factors.of_map)
    np.testing.assert_array_equal(
        found.factors.beside["lines"], FULL.factors.beside["lines"]
    )
    np.testing.assert_array_equal(found.angular["drift"], FULL.angular["drift"])
    np.testing.assert_allclose(
        found.covariances["xy"].matrix(2),
        np.array([[4.0, 1.0], [1.0, 2.0]]) * 1e-18,
        rtol=1e-6,
    )


def test_a_covariance_without_noise_is_kept():
    np.testing.assert_array_equal(
        Covariance.of(np.zeros((2, 2))).matrix(2), np.zeros((2, 2))
    )


@pytest.mark.parametrize("n", [0, 1, 3])
def test_a_covariance_of_another_number_of_values_is_refused(n):
    with pytest.raises(ValueError, match="reshape"):
        FULL.covariances["xy"].matrix(n)


def test_nothing_is_kept_of_nothing():
    assert Kept().to_dict() == {}
    found = kept_from_dict({"plan_id": "p"}, MAP, PLATE, LINES)
    assert (found.factors, found.added, found.images) == (None, None, None)
    assert not found.angular


def test_what_is_infinite_or_unknown_is_kept():
    """Marks without noise of their own, as in images without noise; lines without a map."""
    images = ImagesKept(1.0, np.inf, (0,), ((0, 0),))
    kept = Kept(angular={"drift": np.full(LINES, np.nan)}, images=images)
    found = kept_from_dict(
        json.loads(json.dumps(kept.to_dict(), allow_nan=False)), MAP, PLATE, LINES
    )
    assert found.images == images
    assert np.isnan(found.angular["drift"]).all()


@pytest.mark.parametrize(
    ("where", "value", "message"),
    [
        (
            ("covariance_terms", "factors"),
            [[[1.0, 2.0]]],
            "covariance_terms: no factors of this latt",
        ),
        (
            ("covariance_terms", "factors"),
            "no",
            "covariance_terms: no factors of this lattice",
        ),
        (
            ("covariance_terms", "terms"),
            ["drift"],
            "covariance_terms: no factors of this lattice",
        ),
        (
            ("covariance_terms", "beside", "plate"),
            [1.0, 2.0],
            "covariance_terms: no plate of this",
        ),
        (("covariance_terms", "beside", "lines"), None, "None is not of type list"),
        (
            ("covariance_terms", "beside", "microscope"),
            [[0.0] * 4],
            "beside the map of other factors",
        ),
        (
            ("covariance_terms", "beside", "with_map"),
            3,
            "beside the map of other factors",
        ),
        (
            ("covariance_terms", "beside", "with_map"),
            -1,
            "beside the map of other factors",
        ),
        (
            ("covariance_terms", "beside", "terms"),
            ["line_scale"],
            "covariance_terms: other terms than quantities beside the map",
        ),
        (
            ("covariance_terms", "effects_on_plate"),
            [[None]],
            "covariance_terms: no effects on the pl",
        ),
        (
            ("angular_terms", "drift"),
            [0.1] * (LINES + 1),
            "angular_terms: no contributions to these",
        ),
        (
            ("angular_terms", "drift"),
            "no",
            "angular_terms: no contributions to these lines",
        ),
        (("first_order_added",), [0.1], "first_order_added: not two variances"),
        (
            ("map_covariance", "xy"),
            [1.0, None],
            "map_covariance: not a triangle of numbers",
        ),
        (("map_covariance", "scale_xy"), "1", "'1' is not a number"),
        (("images", "share"), 1.5, "images: no noise of images"),
        (("images", "share"), None, "images: no noise of images"),
        (("images", "dof_mark"), -1.0, "images: no noise of images"),
        (("images", "step"), [[0], [1], [0]], "images: no noise of images"),
        (("images", "motion", "slow"), -0.1, "images: no noise of images"),
        (("images", "motion", "slow"), None, "images: no noise of images"),
    ],
)
def test_what_is_damaged_is_refused(where, value, message):
    data = json.loads(json.dumps(FULL.to_dict()))
    inner = data
    for key in where[:-1]:
        inner = inner[key]
    inner[where[-1]] = value
    with pytest.raises((KeyError, TypeError, ValueError), match=message):
        kept_from_dict(data, MAP, PLATE, LINES)
