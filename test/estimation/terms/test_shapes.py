# SPDX-License-Identifier: Apache-2.0
"""Shapes and the columns that are 1 or i times one: all as for the columns in full."""

import numpy as np
import pytest

from selfcal_ros.estimation.terms.columns import shapes_of

VIEWS, LATTICE, MARKS = 3, (3, 5), 15
OF_COLUMN, UNIT = [0, 0, 1, 2, 2, 3, 1], [1, 1j, 1j, 1, 1j, 1, 1]


def drawn(seed, *shape):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(*shape, 2)) @ [1, 1j]


@pytest.fixture
def made():
    """Return seven columns of four shapes: of one view, of all, of two, of none but the last."""
    values = drawn(1, 4, VIEWS, MARKS)
    where = ([1], [0, 1, 2], [0, 2], [2])
    means = [
        {view: values[at, view] for view in views} for at, views in enumerate(where)
    ]
    full = np.zeros((len(UNIT), VIEWS, *LATTICE), dtype=complex)
    for column, (at, unit) in enumerate(zip(OF_COLUMN, UNIT, strict=True)):
        for view in where[at]:
            full[column, view] = unit * values[at, view].reshape(LATTICE)
    return shapes_of(means, OF_COLUMN, UNIT, np.ones((VIEWS, *LATTICE))), full


def test_the_columns_in_full_are_one_or_i_times_their_shapes(made):
    shapes, full = made
    assert np.array_equal(shapes.grid, full)
    assert [rows.tolist() for rows in shapes.rows] == [[1, 2], [0, 1], [1, 2, 3]]


def test_inner_products_are_those_of_the_columns(made):
    shapes, full = made
    every = np.zeros((4, VIEWS * MARKS), dtype=complex)
    for at, column in ((0, 0), (1, 6), (2, 3), (3, 5)):
        every[at] = full[column].reshape(-1)
    rows = full.reshape(len(UNIT), -1)
    assert shapes.products(every.conj() @ every.T) == pytest.approx(
        (rows.conj() @ rows.T).real
    )
    other = drawn(2, VIEWS, *LATTICE)
    assert shapes.against(shapes.sums(other)) == pytest.approx(
        (rows.conj() @ other.reshape(-1)).real
    )
    weight = np.abs(drawn(3, VIEWS, *LATTICE))
    assert shapes.squares(weight) == pytest.approx(
        (weight * abs(full) ** 2).sum(axis=(1, 2, 3))
    )
    linear = drawn(4, 6, VIEWS * MARKS)
    assert shapes.of_columns(linear @ every.T) == pytest.approx(linear @ rows.T)


@pytest.mark.parametrize("only", [None, np.arange(7) % 3 > 0])
def test_columns_are_added_up_by_their_coefficients(made, only):
    shapes, full = made
    coefficients = np.random.default_rng(5).normal(size=len(UNIT))
    wanted = np.tensordot(
        coefficients if only is None else coefficients * only, full, axes=1
    )
    assert shapes.combined(coefficients, only) == pytest.approx(wanted)


def test_some_columns_are_the_same_columns(made):
    shapes, full = made
    some = np.array([True, False, True, True, False, True, False])
    assert np.array_equal(shapes.chosen(some).grid, full[some])
