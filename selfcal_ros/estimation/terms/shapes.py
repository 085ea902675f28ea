# SPDX-License-Identifier: Apache-2.0
"""Columns at the marks, stored as complex shapes; a column is 1 or i times a shape.

Most terms come in pairs, the same along x and along y, and most belong to one view: a drift of
degree 3 in five views has 30 columns of 5 x 441 numbers each, and 15 shapes of 441. Up to the
misalignments the equations are linear over the complex numbers and computed for the shapes; the
products of the columns follow:

    Re(conj(u c) v d) = Re(conj(u) v <c, d>),     u, v in {1, i}
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from selfcal_ros.estimation.terms.visits import ViewVisits, squares_within

AtVisits = list[dict[int, np.ndarray]]


@dataclass(frozen=True, eq=False)
class Shapes:
    """Shapes at the means of the marks, and the columns made of them.

    Attributes
    ----------
    n : int
        Number of shapes, q.
    lattice : tuple of int
        Marks along x and y.
    rows : tuple of int array
        Indices of the shapes of each view, (k,); all others are 0 in it.
    values : tuple of complex array
        Their values, (k, marks), plate frame; 0 where not read.
    of_column : int array (p,)
        The shape of each column.
    unit : complex array (p,)
        1 or i, the factor of the shape.
    """

    n: int
    lattice: tuple[int, int]
    rows: tuple[np.ndarray, ...]
    values: tuple[np.ndarray, ...]
    of_column: np.ndarray
    unit: np.ndarray

    @cached_property
    def grid(self) -> np.ndarray:
        """The expanded columns, complex (p, views, nx, ny)."""
        out = np.zeros((len(self.unit), len(self.rows), *self.lattice), dtype=complex)
        for view, (rows, values) in enumerate(zip(self.rows, self.values, strict=True)):
            at = np.full(self.n, -1)
            at[rows] = np.arange(len(rows))
            here = np.flatnonzero(at[self.of_column] >= 0)
            out[here, view] = (self.unit[here, None] * values[at[self.of_column[here]]]).reshape(
                -1, *self.lattice)
        return out

    def of_columns(self, each: np.ndarray) -> np.ndarray:
        """Return values linear in the shapes, complex (..., q), for the columns, (..., p)."""
        return each[..., self.of_column] * self.unit

    def products(self, inner: np.ndarray) -> np.ndarray:
        """Return real inner products of the columns, (p, p), from those of the shapes, (q, q)."""
        pairs = inner[self.of_column[:, None], self.of_column]
        return (pairs * (self.unit.conj()[:, None] * self.unit)).real

    def against(self, inner: np.ndarray) -> np.ndarray:
        """Return Re(conj(column) e), (p,), from the sums of conj(e) times the shapes, (q,)."""
        return self.of_columns(inner).real

    def sums(self, field: np.ndarray) -> np.ndarray:
        """Return the sums of conj(field) times each shape, (q,); field (views, nx, ny)."""
        out = np.zeros(self.n, dtype=complex)
        for rows, values, one in zip(self.rows, self.values, field, strict=True):
            out[rows] += values @ one.reshape(-1).conj()
        return out

    def squares(self, weight: np.ndarray) -> np.ndarray:
        """Return the weighted sum of squares of each column, (p,); weight (views, nx, ny)."""
        out = np.zeros(self.n)
        for rows, values, one in zip(self.rows, self.values, weight, strict=True):
            out[rows] += (values.real**2 + values.imag**2) @ one.reshape(-1)
        return out[self.of_column]

    def combined(self, coefficients: np.ndarray, only: np.ndarray | None = None) -> np.ndarray:
        """Return the sum of coefficients (p,) times columns, complex (views, nx, ny).

        `only`, bool (p,), selects columns.
        """
        here = slice(None) if only is None else only
        each: np.ndarray = np.zeros(self.n, dtype=complex)
        np.add.at(each, self.of_column[here], (coefficients * self.unit)[here])
        out = np.empty((len(self.rows), *self.lattice), dtype=complex)
        for one, rows, values in zip(out, self.rows, self.values, strict=True):
            one[...] = (each[rows] @ values).reshape(self.lattice)
        return out

    def part(self, columns: np.ndarray) -> "Shapes":
        """Return some of the columns, bool (p,); the shapes are the same."""
        return replace(self, of_column=self.of_column[columns], unit=self.unit[columns])

    def replaced(self, shapes: Sequence[int], means: Sequence[Mapping[int, np.ndarray]]
                 ) -> "Shapes":
        """Return the columns with new values of some shapes, in their views."""
        values = list(self.values)
        for view, rows in enumerate(self.rows):
            at = [(np.flatnonzero(rows == shape), mean[view])
                  for shape, mean in zip(shapes, means, strict=True) if view in mean]
            if at:
                values[view] = values[view].copy()
            for place, mine in at:
                values[view][place] = mine
        return replace(self, values=tuple(values))


@dataclass(frozen=True, eq=False)
class LineColumns:
    """Columns of the readings of lines: indices, int (q,), and values (q, views, K)."""

    at: np.ndarray
    values: np.ndarray

    def sums(self, weighted: np.ndarray, power: int = 1) -> np.ndarray:
        """Return the sums of values, to a power, times `weighted` (views, K), (q,)."""
        return np.array([(value**power * weighted).sum() for value in self.values], dtype=float)


NO_LINES = LineColumns(np.zeros(0, dtype=int), np.zeros((0, 0, 0)))


def shapes_of(means: Sequence[Mapping[int, np.ndarray]], of_column: Sequence[int],
              unit: Sequence[complex], weight: np.ndarray) -> Shapes:
    """Return shapes given by their values in their views.

    Parameters
    ----------
    means : sequence of dict
        Values of each shape at the marks (marks,), by view.
    of_column, unit : sequences (p,)
        Shape of each column, and 1 or i.
    weight : float array (views, nx, ny)
        Weights of the readings, in the shape of the lattice.
    """
    rows, values = [], []
    for view in range(len(weight)):
        here = [at for at, mean in enumerate(means) if view in mean]
        rows.append(np.array(here, dtype=int))
        values.append(np.array([means[at][view] for at in here], dtype=complex).reshape(
            len(here), weight[0].size))
    return Shapes(len(means), weight.shape[1:], tuple(rows), tuple(values),
                  np.array(of_column, dtype=int), np.array(unit, dtype=complex))


def shapes_in_full(columns: np.ndarray) -> Shapes:
    """Return columns given in all views, complex (p, views, nx, ny)."""
    p, views = columns.shape[:2]
    every = np.arange(p)
    return Shapes(p, columns.shape[2:], (every,) * views,
                  tuple(columns[:, view].reshape(p, -1) for view in range(views)),
                  every, np.ones(p, dtype=complex))


@dataclass(frozen=True, eq=False)
class WithinMarks:
    """Information on the coefficients from the visits of each mark: see `visits`.

    Attributes
    ----------
    gram : float array (p, p)
        Weighted inner products of the columns about the means of their marks.
    right : float array (p,)
        The same with the deviations, m times the column's unit.
    total : float
        Weighted sum of squares of the deviations about the means of their marks, m^2.
    dof : int
        Its degrees of freedom.
    """

    gram: np.ndarray
    right: np.ndarray
    total: float
    dof: int


def within_marks(visits: Sequence[ViewVisits | None], at: AtVisits, shapes: Shapes) -> WithinMarks:
    """Return within-mark sums lost by averaging.

    Parameters
    ----------
    visits : sequence of ViewVisits or None
        Visits of each view.
    at : list of dict
        Values of each shape at the visits, as in `TermColumns`.
    shapes : Shapes
        Those at the means, and the columns.
    """
    n = len(shapes.unit)
    dof = sum(2 * (len(view.mark) - len(np.unique(view.mark)))
              for view in visits if view is not None and view.repeated)
    nothing = WithinMarks(np.zeros((n, n)), np.zeros(n), squares_within(visits), dof)
    return within_anew(visits, at, shapes, before=nothing, changed=np.arange(shapes.n))


def within_anew(visits: Sequence[ViewVisits | None], at: AtVisits, shapes: Shapes, *,
                before: WithinMarks, changed: np.ndarray) -> WithinMarks:
    """Return the same, with the products of the shapes `changed` recomputed."""
    n_marks = shapes.lattice[0] * shapes.lattice[1]
    inner: np.ndarray = np.zeros((shapes.n, shapes.n), dtype=complex)
    against: np.ndarray = np.zeros(shapes.n, dtype=complex)
    for view, seen in enumerate(visits):
        mine = [k for k in changed if view in at[k]]
        if seen is None or not (seen.repeated and mine):
            continue
        here = [k for k in range(shapes.n) if view in at[k]]
        # about the means of their marks: then those of the others drop out
        moved = seen.about_means(np.array([at[k][view] for k in mine]), n_marks)
        weighted = np.conj(moved) * seen.weight
        inner[np.ix_(mine, here)] += weighted @ np.array([at[k][view] for k in here]).T
        against[mine] += (weighted @ seen.y).conj()
    gram, right, own = before.gram.copy(), before.right.copy(), np.isin(shapes.of_column, changed)
    gram[own], right[own] = shapes.products(inner)[own], shapes.against(against)[own]
    gram[:, own] = gram[own].T
    square = gram[np.ix_(own, own)]
    gram[np.ix_(own, own)] = (square + square.T) / 2
    return WithinMarks(gram, right, before.total, before.dof)
