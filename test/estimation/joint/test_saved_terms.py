# SPDX-License-Identifier: Apache-2.0
"""The factors of a covariance that a result keeps: how large a field, which way round."""

from types import SimpleNamespace

import numpy as np
import pytest

from selfcal_ros.estimation.joint.solve import saved_terms
from selfcal_ros.estimation.terms.columns import Column, TermColumns, WithinMarks
from selfcal_ros.model.readings import Sense

SIGMA = 3.0
"""Standard deviation of the one coefficient, in units of the noise of a reading."""


def cover_of(field, known):
    """Return the covariance of a map that one coefficient moves by `field`, complex (nx, ny)."""
    grid = SimpleNamespace(n_sites=field.size, views=SimpleNamespace(shape=field.shape))
    return SimpleNamespace(
        system=SimpleNamespace(grid=grid),
        maps_of_terms=lambda: (np.where(known, field, 0.0).reshape(-1, 1), None),
        terms=SimpleNamespace(covariance=np.array([[SIGMA**2]])),
    )


def kept(shape, sense=Sense.MICROSCOPE_MOVES, size=float("inf")):
    """Return the field, which sites are known, and what is kept of it."""
    rng = np.random.default_rng(1)
    field = rng.normal(size=(*shape, 2)) @ [1, 1j]
    known = rng.random(shape) < 0.9
    columns = TermColumns(
        (Column("plate_scale", 1, "b", size),),
        np.zeros((1, 2, *shape)),
        WithinMarks(np.zeros((1, 1)), np.zeros(1), 0.0, 0),
        [],
    )
    return (
        field,
        known,
        saved_terms(
            cover_of(field, known), columns, sense, {"microscope": np.zeros((1, 4))}
        ),
    )


@pytest.mark.parametrize(
    ("shape", "is_kept"),
    [
        ((3, 5), True),
        ((31, 31), True),
        ((1, 961), True),
        ((1, 962), False),
        ((31, 33), False),
        ((33, 31), False),
        ((33, 33), False),
    ],
)
def test_factors_are_kept_up_to_31_by_31_sites(shape, is_kept):
    _, _, found = kept(shape)
    assert (found is not None) == is_kept


@pytest.mark.parametrize(
    ("size", "names"), [(float("inf"), [""]), (1e-6, ["plate_scale"])]
)
@pytest.mark.parametrize("sense", Sense)
def test_a_factor_is_what_a_standard_deviation_of_the_coefficient_does_to_the_map(
    sense, size, names
):
    """With the plate moving the map is seen from the other end: H(x) = -G(-x)."""
    field, known, found = kept((5, 3), sense, size)
    moved = SIGMA * np.where(known, field, 0.0)
    if sense is Sense.PLATE_MOVES:
        moved = -moved[::-1, ::-1]
    assert list(found.terms) == names
    (factor,) = found.of_map
    turned = factor[0] + 1j * factor[1]
    sign = np.sign((turned * moved.conj()).sum().real)  # L L' is the same for -L
    assert turned == pytest.approx(sign * moved, rel=1e-6)
