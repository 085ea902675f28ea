# SPDX-License-Identifier: Apache-2.0
"""What is left beside columns: by hand, for columns that are at right angles to each other."""

from types import SimpleNamespace

import numpy as np
import pytest

from selfcal_ros.estimation.terms.equations import Score, Sums
from selfcal_ros.estimation.verdict.causes import Candidates, Group, select_explanations

LENGTHS = np.array([2.0, 0.5, 4.0])
"""Of three columns that all marks' means tell alone, in weighted readings."""
FOUND = np.array([6.0, -8.0, 0.0])
"""What each takes off the readings, times its length: squares of 6, 8 and 0."""


def unchanged(right: np.ndarray) -> np.ndarray:
    """Return the right-hand sides of columns that no noise of the position feigns."""
    return right


def pool(sums: Sums) -> Candidates:
    """Return the columns, with `sums` of squares left before any of them is held."""
    gram = np.diag(LENGTHS**2)
    equations = SimpleNamespace(
        unbiased=gram,
        unbiased_sums=unchanged,
        norm=LENGTHS,
        limit=lambda rows: 1e-9,
        projected=SimpleNamespace(gram=gram),
    )
    return Candidates(
        equations, Score(FOUND * LENGTHS, np.zeros(3), sums), np.zeros(3), np.zeros(3)
    )


def rows(*numbers: int) -> np.ndarray:
    return np.isin(np.arange(3), numbers)


def noise(sums: Sums, taken: np.ndarray) -> tuple[float, float]:
    """Return variance and degrees of freedom of what the columns `taken` leave."""
    left = pool(sums)
    return left.noise(left.explain(taken))


@pytest.mark.parametrize(
    ("taken", "squares"),
    [((), 0), ((0,), 36), ((1,), 64), ((0, 1), 100), ((0, 1, 2), 100)],
)
def test_columns_explain_the_squares_of_their_parts(taken, squares):
    found = pool(Sums(164.0, 10, 0.0, 0)).explain(rows(*taken))
    assert (found.explained, found.rank) == (pytest.approx(squares), len(taken))
    here = rows(*taken)
    assert found.values == pytest.approx(np.array([3.0, -16.0, 0.0])[here])
    assert found.inverse == pytest.approx(np.diag(1 / LENGTHS[here] ** 2))


@pytest.mark.parametrize(
    ("dof", "taken", "left", "dof_left"),
    [
        (10, (), 164, 10),
        (10, (0,), 128, 9),
        (10, (0, 1), 64, 8),
        (10, (0, 1, 2), 64, 7),
        (3, (0, 1), 64, 1),
        (4, (0, 1, 2), 64, 1),
    ],
)
def test_the_noise_beside_columns_has_a_degree_of_freedom_less_for_each(
    dof, taken, left, dof_left
):
    variance, found = noise(Sums(164.0, dof, float("nan"), 0), rows(*taken))
    assert (variance, found) == (
        pytest.approx(left / dof_left),
        pytest.approx(dof_left),
    )


@pytest.mark.parametrize(
    ("dof", "dof_within", "taken"),
    [
        (2, 0, (0, 1)),
        (3, 0, (0, 1, 2)),
        (1, 0, (1,)),
        (1, 1, (0, 1)),
        (2, 1, (0, 1, 2)),
    ],
)
def test_where_columns_take_all_degrees_of_freedom_no_noise_is_left(
    dof, dof_within, taken
):
    variance, found = noise(Sums(164.0, dof, 5.0, dof_within), rows(*taken))
    assert np.isnan(variance) and found == 0


@pytest.mark.parametrize(
    ("within", "dof_within", "variance", "dof"),
    [
        (9.0, 90, 8.0, 8),
        (2000.0, 90, (64 + 2000) / 98, 98),
        (30.0, 1, (64 + 30) / 9, 9),
    ],
)
def test_the_larger_of_the_noises_of_marks_and_of_all_visits_counts(
    within, dof_within, variance, dof
):
    """Marks alone: 64 / 8; all visits have the squares within the marks in addition."""
    found = noise(Sums(164.0, 10, within, dof_within), rows(0, 1))
    assert found == (pytest.approx(variance), pytest.approx(dof))


def test_sets_of_all_sizes_are_each_as_a_dense_solution_has_them():
    """The sixth column is the sum of two: with both of them it tells nothing more."""
    rng = np.random.default_rng(8)
    readings = rng.normal(size=(12, 6)) * [1.0, 1e3, 1.0, 1e-3, 1.0, 1.0]
    readings[:, 5] = readings[:, 0] + readings[:, 2]
    marks, left = readings[:8], rng.normal(size=12)
    equations = SimpleNamespace(
        unbiased=readings.T @ readings,
        unbiased_sums=unchanged,
        norm=np.sqrt((readings**2).sum(axis=0)),
        limit=lambda rows: 1e-9,
        projected=SimpleNamespace(gram=marks.T @ marks),
    )
    pool = Candidates(
        equations,
        Score(
            marks.T @ left[:8],
            readings[8:].T @ left[8:],
            Sums(float(left[:8] @ left[:8]), 8, float(left[8:] @ left[8:]), 4),
        ),
        np.zeros(6),
        np.zeros(6),
    )
    sets = [
        (),
        (3,),
        (0, 1),
        (1, 3, 4),
        (5,),
        (0, 2, 5),
        (0, 2),
        (0, 1, 2, 3, 4, 5),
        (1, 5),
    ]
    for chosen in sets:
        found = pool.explain(np.isin(np.arange(6), chosen))
        used = readings[:, list(chosen)]
        values = np.linalg.pinv(used) @ left
        rank = np.linalg.matrix_rank(used) if chosen else 0
        assert found.rank == rank and found.columns.tolist() == list(chosen)
        rest = left - used @ values
        assert found.explained == pytest.approx(left @ left - rest @ rest)
        assert used @ found.values == pytest.approx(used @ values, abs=1e-9)
        assert found.between == pytest.approx(rest[:8] @ rest[:8])
        follows = used @ np.linalg.pinv(used)
        assert found.dof_between == pytest.approx(8 - np.trace(follows[:8, :8]))


def test_terms_of_the_model_stay_within_what_their_sizes_allow():
    """Columns that the model has, with coefficients, against a least squares with prior rows."""
    rng = np.random.default_rng(3)
    columns, y = rng.normal(size=(30, 4)), rng.normal(size=30)
    prior = np.array([4.0, 9.0, 0.0, 0.0])
    rows = np.diag(np.sqrt(prior))[:2]
    taken = np.zeros(4)
    taken[:2] = np.linalg.lstsq(
        np.vstack([columns[:, :2], rows[:, :2]]),
        np.concatenate([y, np.zeros(2)]),
        rcond=None,
    )[0]
    left = y - columns @ taken
    equations = SimpleNamespace(
        unbiased=columns.T @ columns,
        unbiased_sums=unchanged,
        norm=np.sqrt((columns**2).sum(axis=0)),
        limit=lambda rows: 1e-9,
        projected=SimpleNamespace(gram=columns.T @ columns),
    )
    pool = Candidates(
        equations,
        Score(
            columns.T @ left, np.zeros(4), Sums(float(left @ left), 30, float("nan"), 0)
        ),
        prior,
        taken,
    )
    both = pool.explain(np.array([True, True, True, False]))
    whole = np.linalg.lstsq(
        np.vstack([columns[:, :3], rows[:, :3]]),
        np.concatenate([y, np.zeros(2)]),
        rcond=None,
    )[0]
    assert both.values + taken[:3] == pytest.approx(whole)
    alone = pool.explain(np.array([True, True, False, False]))
    assert alone.explained == pytest.approx(0, abs=1e-9)


def test_at_most_four_causes_are_named_the_likeliest_first():
    """Six terms of one column each, at right angles; each takes more off than the one before."""
    names = ["a", "b", "c", "d", "e", "f"]
    equations = SimpleNamespace(
        unbiased=np.eye(6),
        unbiased_sums=unchanged,
        norm=np.ones(6),
        limit=lambda rows: 1e-9,
        maps=np.zeros((4, 6)),
        turned=np.zeros((3, 6)),
        projected=SimpleNamespace(gram=np.eye(6)),
        system=SimpleNamespace(known_sites=np.ones(4), known_lines=np.ones(3)),
        columns=SimpleNamespace(columns=tuple(names)),
    )
    parts = np.arange(1.0, 7.0) * 1e-6
    many = Candidates(
        equations,
        Score(
            parts, np.zeros(6), Sums(float(parts @ parts) + 1e-14, 100, float("nan"), 0)
        ),
        np.zeros(6),
        np.zeros(6),
    )
    groups = [Group(name, np.arange(6) == number) for number, name in enumerate(names)]
    found = select_explanations(many, groups, np.zeros(6, dtype=bool))
    assert [item.name for item in found] == ["f", "e", "d", "c"]
    assert [float(item.values[0]) for item in found] == pytest.approx(
        [6e-6, 5e-6, 4e-6, 3e-6]
    )
